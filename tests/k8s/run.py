"""Runs the tests of this directory on the cluster of $KUBECONFIG and prints a table.

Usage: run.py [--filter REGEX]; `./dev test-k8s` prepares all that they need.
"""

import argparse
import pathlib
import re
import sys
import time
import unittest

sys.dont_write_bytecode = True
sys.path.insert(0, str(pathlib.Path(__file__).resolve().parent))
import cluster  # noqa: E402


class Result(unittest.TextTestResult):
    def startTest(self, test):
        self.began = time.monotonic()
        super().startTest(test)

    def stopTest(self, test):
        super().stopTest(test)
        rows.append((test.id(), time.monotonic() - self.began))


def tests_of(suite):
    for item in suite:
        if isinstance(item, unittest.TestSuite):
            yield from tests_of(item)
        else:
            yield item


parser = argparse.ArgumentParser()
parser.add_argument("--filter", default="")
options = parser.parse_args()
rows = []
# What takes nodes away comes last.
order = ["image", "manifests", "access", "production", "world", "failures", "leader", "maintenance", "nodes"]
found = list(tests_of(unittest.defaultTestLoader.discover(pathlib.Path(__file__).parent, "*_test.py")))
found.sort(key=lambda t: order.index(t.id().split("_test.")[0]) if t.id().split("_test.")[0] in order else 0)
chosen = [t for t in found if re.search(options.filter, t.id())]
if not chosen:
    sys.exit(f"no test matches '{options.filter}'")
result = unittest.TextTestRunner(resultclass=Result, verbosity=2, stream=sys.stdout).run(unittest.TestSuite(chosen))

# Of a subtest, its test.
bad = {getattr(t, "test_case", t).id(): "FAILED" for t, _ in result.failures + result.errors}
bad |= {t.id(): "skipped" for t, _ in result.skipped}
width = max(len(name) for name, _ in rows) if rows else 0
print()
for name, seconds in rows:
    print(f"{name:{width}}  {bad.get(name, 'passed'):8} {seconds:6.1f} s")
    for test, what, value, bar in cluster.measured:
        if test == name:
            print(f"{'':{width}}    {what}: {value}{'  (' + bar + ')' if bar else ''}")
failed = len(result.failures) + len(result.errors)
passed = sum(name not in bad for name, _ in rows)
print(f"\n{passed} passed, {failed} failed, {len(result.skipped)} skipped")
sys.exit(not result.wasSuccessful())
