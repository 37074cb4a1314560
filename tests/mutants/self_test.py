#!/usr/bin/env python3
"""Holds the mutants' runner on a small project: what goes red, survives, or is no verdict at all."""

import pathlib
import subprocess
import sys
import tempfile

PROJECT = {
    ".gitignore": "/build/\n",
    "CMakePresets.json": """{"version": 4, "configurePresets": [
        {"name": "release", "generator": "Ninja", "binaryDir": "${sourceDir}/build/release"}]}""",
    "CMakeLists.txt": """cmake_minimum_required(VERSION 3.24)
project(small LANGUAGES CXX)
set(CMAKE_RUNTIME_OUTPUT_DIRECTORY ${CMAKE_BINARY_DIR}/bin)
add_executable(adds main.cc)
enable_testing()
add_test(NAME Adds COMMAND adds)
add_test(NAME Never COMMAND never_built)
""",
    "main.cc": """#include <cstdlib>

int Add(int a, int b) { return a + b; }

int main() {
  if (Add(0, 0) > 0) std::abort();
  if (Add(0, 1) < 0) std::exit(3);
  while (Add(1, 0) < 0) {
  }
  return Add(1, 1) == 2 ? 0 : 1;
}
""",
}

# name -> (checks, the new line, verdict, words of the row)
MUTANTS = {
    "wrong-sum": ("# test: ^Adds$", "return a * b;", "red", "Adds"),
    "wrong-sum-command": ("# command: adds", "return a * b;", "red", "adds"),
    "invariant": ("# command: adds", "return a + b + 1;", "red", "stopped by an invariant"),
    "hangs": ("# command: adds\n# timeout: 1", "return b - 2 * a;", "red", "no end after 1 s"),
    "equal": ("# test: ^Adds$\n# command: adds", "return b + a;", "SURVIVED", "stays green"),
    "half": ("# command: adds\n# command: true", "return a * b;", "SURVIVED", "stays green: true"),
    "no-verdict": ("# command: adds", "return a - 2 * b;", "FAULT", "ended with 3"),
    "does-not-build": ("# test: ^Adds$", "return c;", "FAULT", "does not build"),
    "stale": ("# test: ^Adds$", None, "FAULT", "no longer applies"),
}


def patch_text(checks, line):
    old = "int Add(int a, int b) { return a + b; }"
    if line is None:
        old, line = "int Add(long a) { return a; }", "return 0;"
    return (f"# why: a sum is a sum\n{checks}\n# target: adds\n"
            f"--- a/main.cc\n+++ b/main.cc\n@@ -2,3 +2,3 @@\n \n-{old}\n"
            f"+int Add(int a, int b) {{ {line} }}\n \n")


def run(directory, *names):
    return subprocess.run([sys.executable, pathlib.Path(__file__).with_name("run"), "--source", directory, "--patches",
                           directory / "patches", *names], capture_output=True, text=True, check=False)


def expect(condition, words, done):
    if not condition:
        sys.exit(f"self-test: {words}\n{done.stdout}{done.stderr}")


def main():
    with tempfile.TemporaryDirectory() as name:
        directory = pathlib.Path(name)
        subprocess.run(["git", "init", "-q", directory], check=True)
        for path, text in PROJECT.items():
            (directory / path).write_text(text)
        (directory / "patches").mkdir()
        for mutant, (checks, line, _, _) in MUTANTS.items():
            (directory / "patches" / f"{mutant}.patch").write_text(patch_text(checks, line))

        done = run(directory)
        rows = {row.split()[0]: row for row in done.stdout.splitlines() if row.split() and row.split()[0] in MUTANTS}
        for mutant, (_, _, verdict, words) in MUTANTS.items():
            expect(rows.get(mutant, "  ").split()[1:2] == [verdict], f"{mutant} should be {verdict}", done)
            expect(words in done.stdout, f"{mutant} should say '{words}'", done)
        expect(done.returncode == 1, "a survivor should make the exit code 1", done)
        expect((directory / "main.cc").read_text() == PROJECT["main.cc"], "the sources should be untouched", done)

        done = run(directory, "wrong-sum", "invariant")
        expect(done.returncode == 0, "red mutants alone should make the exit code 0", done)
        done = run(directory, "nobody")
        expect(done.returncode == 2 and "no mutant 'nobody'" in done.stderr, "an unknown name should be refused", done)

        for text, words in (("# test: ^Never$", "did not run every test"), ("# test: ^Nothing$", "no test matches"),
                            ("# command: false", "red without any patch"), ("# command: nowhere", "no program"),
                            ("# tset: ^Adds$", "KEY"), ("", "needs")):
            (directory / "patches" / "broken.patch").write_text(patch_text(text, "return a * b;"))
            done = run(directory, "broken")
            expect(done.returncode == 1 and words in done.stderr, f"'{text}' should be refused with '{words}'", done)
    print(f"self-test: {len(MUTANTS)} mutants judged as they should be")


if __name__ == "__main__":
    main()
