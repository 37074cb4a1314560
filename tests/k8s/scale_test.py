"""Regions come and go while the world runs: by `kubectl scale world`, and by the load."""

from cluster import WorldTest, kubectl, wait_for


class Scale(WorldTest):
    file, spec, regions = "border-pile.json", {}, 2

    def test_world_is_scaled_from_two_to_six_to_three_without_a_stop(self):
        for wanted in (6, 3):
            kubectl("scale", "world", self.world.name, f"--replicas={wanted}")
            self.world.runs(wanted)
            self.world.ticks.goes_on(100)
            self.assertEqual(int(self.world.status().get("replicas", 0)), wanted)
            wait_for(lambda: len([p for p in self.world.pods() if p["status"]["phase"] == "Running"]) == wanted, "its pods")
        self.measure("longest stop (aim: 2 s)", self.world.ticks.longest_stop(self.began), 10)
        self.assert_exact()


class ScaleByLoad(WorldTest):
    """The pile falls and is struck, 230 bodies; most of them sleep after half a minute."""

    file, regions = "border-pile.json", 1
    spec = {"regions": {"min": 1, "max": 6, "framePercent": 1000, "awakeBodies": 150, "upAfter": "2s", "downAfter": "5s"}}

    def test_world_is_scaled_by_its_load_and_back_without_a_stop(self):
        def members():
            return int(self.world.status().get("replicas", 0))

        wait_for(lambda: members() > 2, "more regions")
        wait_for(lambda: 0 < members() <= 2, "fewer regions again", 180)
        wait_for(lambda: len([p for p in self.world.pods() if p["status"]["phase"] == "Running"]) == members(), "their pods")
        wanted = kubectl("get", "world", self.world.name, "-o", "jsonpath={.spec.replicas}")
        self.assertEqual(int(wanted), members())
        said = [message for reason, message in self.world.events() if reason == "Scaled"]
        self.assertTrue(any(m.startswith("scaled from 1 to ") and "bodies awake" in m for m in said), said)
        self.measure("longest stop (aim: 2 s)", self.world.ticks.longest_stop(self.began), 10)
        self.assert_exact()
