"""What replicas cost in bytes stays within its bars.

Usage: bench_test.py BIN_DIRECTORY SOURCE_DIRECTORY
"""

import json
import pathlib
import subprocess
import sys
import unittest

BENCH = str(pathlib.Path(sys.argv[1]) / "aureole-bench")


class ClientBytes(unittest.TestCase):
    @classmethod
    def setUpClass(cls):
        out = subprocess.run([BENCH, "clients", "--ticks", "240", "--json"], capture_output=True, check=True, timeout=120)
        cls.result = json.loads(out.stdout)

    def bytes_of(self, scene, encoding, period=1):
        (row,) = [r for r in self.result["rows"]
                  if (r["scene"], r["encoding"], r["period"]) == (scene, encoding, period)]
        return row["bytes_per_body"], row["moving"]

    def test_moving_bodies_are_cheap(self):
        for period in (1, 6):
            cost, moving = self.bytes_of("all thrown", "columns", period)
            self.assertGreater(moving, 0.99)
            self.assertLessEqual(cost, 15)
            cost, moving = self.bytes_of("20 % thrown", "columns", period)
            self.assertGreater(moving, 0.2)
            self.assertLessEqual(cost, 3.2)
        self.assertLessEqual(self.bytes_of("all thrown", "bits")[0], 10)
        self.assertLessEqual(self.bytes_of("20 % thrown", "bits")[0], 2.1)

    def test_bodies_at_rest_cost_nothing(self):
        for encoding in ("columns", "bits"):
            cost, moving = self.bytes_of("at rest", encoding)
            self.assertEqual(moving, 0)
            self.assertLessEqual(1000 * cost, 20, "a frame has a head, and nothing for each body")

    def test_901_cubes_of_which_few_move(self):
        self.assertGreaterEqual(self.result["quiet_seconds"], 5)
        self.assertLessEqual(self.result["quiet_kbit_per_s"], 250)


if __name__ == "__main__":
    unittest.main(argv=sys.argv[:1], verbosity=2)
