"""The browser viewer: its own tests, in Debian's Chromium, against real region servers (client/viewer/test).

Usage: viewer_test.py BIN_DIRECTORY SOURCE_DIRECTORY
"""

import os
import pathlib
import subprocess
import sys
import unittest

BIN = pathlib.Path(sys.argv[1])
VIEWER = pathlib.Path(sys.argv[2]) / "client" / "viewer"


class Viewer(unittest.TestCase):
    def run_in_viewer(self, *command):
        done = subprocess.run(command, cwd=VIEWER, capture_output=True, text=True, timeout=280,
                              env={**os.environ, "AUREOLE_BIN": str(BIN.resolve())})
        self.assertEqual(done.returncode, 0, done.stdout[-8000:] + done.stderr[-4000:])
        return done.stdout

    def test_its_own_tests_pass(self):
        installed = VIEWER / "node_modules" / ".package-lock.json"
        lock = VIEWER / "package-lock.json"
        if not installed.exists() or installed.stat().st_mtime < lock.stat().st_mtime:
            self.run_in_viewer("npm", "ci", "--no-audit", "--no-fund")
        out = self.run_in_viewer("npm", "test")
        self.assertRegex(out, r"pass [1-9]")
        print(out[-3000:])


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1], verbosity=2)
