"""The example clients in Node and Python, written from the interface files alone, play in a running world.

Usage: examples_test.py BIN_DIRECTORY SOURCE_DIRECTORY
"""

import json
import pathlib
import shutil
import signal
import subprocess
import sys
import tempfile
import unittest

BIN = pathlib.Path(sys.argv[1])
SOURCE = pathlib.Path(sys.argv[2])
EXAMPLES = SOURCE / "client" / "examples"


class Examples(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        cls.directory = tempfile.TemporaryDirectory()
        cls.up = subprocess.Popen([BIN / "aureole", "up", SOURCE / "tests" / "worlds" / "demo.json"],
                                  stdout=subprocess.PIPE, text=True)
        line = ""
        while not line.startswith("servers: "):
            line = cls.up.stdout.readline()
            assert line, "the run ended"
        cls.servers = line.split()[1:]

    @classmethod
    def tearDownClass(cls):
        cls.up.send_signal(signal.SIGINT)
        cls.up.communicate(timeout=30)
        cls.directory.cleanup()

    def play(self, *command):
        proto = ["--proto", str(SOURCE / "proto")]
        done = subprocess.run([*map(str, command), "--server", self.servers[2], "--spawn=-3,40,2", *proto],
                              capture_output=True, text=True, timeout=100)
        self.assertEqual(done.returncode, 0, done.stdout + done.stderr)
        played = json.loads(done.stdout)
        self.assertGreaterEqual(int(next(v for k, v in played.items() if "spawned" in k)), 2**61)
        done = subprocess.run([*map(str, command), "--server", self.servers[0], "--watch", "2", *proto],
                              capture_output=True, text=True, timeout=100)
        self.assertEqual(done.returncode, 0, done.stderr)
        self.assertGreater(json.loads(done.stdout.splitlines()[-1])["bodies"], 200)
        done = subprocess.run([*map(str, command), "--server"], capture_output=True, text=True, timeout=100)
        self.assertEqual(done.returncode, 2, "wrong usage")

    def test_python(self):
        self.play("/usr/bin/python3", EXAMPLES / "python" / "watch.py")

    def test_node(self):
        node = pathlib.Path(self.directory.name) / "node"
        shutil.copytree(EXAMPLES / "node", node, ignore=shutil.ignore_patterns("node_modules"))
        done = subprocess.run(["npm", "ci", "--no-audit", "--no-fund"], cwd=node, capture_output=True, text=True, timeout=200)
        self.assertEqual(done.returncode, 0, done.stdout + done.stderr)
        self.play("node", node / "watch.js")


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1], verbosity=2)
