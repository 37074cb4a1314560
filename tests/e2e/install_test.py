"""What a user installs is enough to build a program against: with find_package, and with pkg-config.

Usage: install_test.py BIN_DIRECTORY SOURCE_DIRECTORY
"""

import os
import pathlib
import signal
import subprocess
import sys
import tempfile
import unittest

BIN = pathlib.Path(sys.argv[1])
SOURCE = pathlib.Path(sys.argv[2])
EXAMPLE = SOURCE / "client" / "examples" / "cpp"


def run(*command, **kwargs):
    done = subprocess.run(list(map(str, command)), capture_output=True, text=True, timeout=280, **kwargs)
    if done.returncode != 0:
        raise AssertionError(f"{command}\n{done.stdout}\n{done.stderr}")
    return done.stdout


class Installed(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.directory = tempfile.TemporaryDirectory()
        cls.path = pathlib.Path(cls.directory.name)
        cls.prefix = cls.path / "prefix"
        run("cmake", "--install", BIN.parent, "--prefix", cls.prefix)
        cls.up = subprocess.Popen([cls.prefix / "bin" / "aureole", "up", SOURCE / "tests" / "worlds" / "demo.json"],
                                  stdout=subprocess.PIPE, text=True)
        line = ""
        while not line.startswith("servers: "):
            line = cls.up.stdout.readline()
            assert line, "the run ended"
        cls.server = line.split()[1]

    @classmethod
    def tearDownClass(cls):
        cls.up.send_signal(signal.SIGINT)
        cls.up.communicate(timeout=30)
        cls.directory.cleanup()

    def play(self, program):
        self.assertIn("world demo, 4 servers", run(program, self.server))

    def test_program_finds_the_package_with_cmake(self):
        build = self.path / "build"
        run("cmake", "-S", EXAMPLE, "-B", build, f"-DCMAKE_PREFIX_PATH={self.prefix}")
        run("cmake", "--build", build)
        self.play(build / "drop")

    def test_program_finds_the_package_with_pkg_config(self):
        found = list(self.prefix.rglob("aureole.pc"))
        self.assertEqual(len(found), 1)
        environment = {**os.environ, "PKG_CONFIG_PATH": str(found[0].parent)}
        flags = run("pkg-config", "--cflags", "--libs", "aureole", env=environment).split()
        run("c++", "-std=c++20", EXAMPLE / "drop.cc", "-o", self.path / "drop", *flags)
        self.play(self.path / "drop")

    def test_interface_files_are_installed(self):
        self.assertTrue((self.prefix / "share/aureole/proto/aureole/v1/simulation.proto").exists())


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1], verbosity=2)
