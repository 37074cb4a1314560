"""`kubectl scale world`: regions come and go while the world runs."""

from cluster import WorldTest, kubectl, wait_for


class Scale(WorldTest):
    file, spec, regions = "border-pile.json", {"regions": {"min": 1, "max": 8}}, 2

    def test_world_is_scaled_from_two_to_six_to_three_without_a_stop(self):
        for wanted in (6, 3):
            kubectl("scale", "world", self.world.name, f"--replicas={wanted}")
            self.world.runs(wanted)
            self.world.ticks.goes_on(100)
            self.assertEqual(int(self.world.status().get("replicas", 0)), wanted)
            wait_for(lambda: len([p for p in self.world.pods() if p["status"]["phase"] == "Running"]) == wanted, "its pods")
        self.measure("longest stop (aim: 2 s)", self.world.ticks.longest_stop(self.began), 10)
        self.assert_exact()
