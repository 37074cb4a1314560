"""What operators do to a running world: restart everything, drain a node."""

import time

from cluster import WorldTest, get, kubectl, wait_for

STOP_S = 1  # longest; about 0.3 is what the clock's metrics can tell


def budget():
    status = get("pdb", "aureole-regions")["status"]
    return status["currentHealthy"], status["desiredHealthy"], status["disruptionsAllowed"]


class Maintenance(WorldTest):
    def setUp(self):
        super().setUp()
        wait_for(lambda: self.world.ticks.now() > 100, "tick 100")
        self.before = self.world.incarnations()
        self.since = time.monotonic()

    def nothing_is_lost(self):
        self.world.runs()
        self.world.ticks.goes_on(50)
        self.measure("longest stop", self.world.ticks.longest_stop(self.since), STOP_S)
        self.measure("speed meanwhile", self.world.ticks.dilation(self.since), unit="")
        self.assert_exact()

    def test_all_regions_are_restarted_one_after_the_other(self):
        for region in range(4):
            kubectl("delete", "pod", self.world.pod_of(region)["metadata"]["name"], "--wait=false")
            wait_for(lambda: self.left(self.before, region), "another region in its place")
            self.world.runs()
            self.world.ticks.goes_on(25)
        self.nothing_is_lost()

    def test_control_plane_is_rolled_out_anew(self):
        kubectl("rollout", "restart", "deployment/aureole-control")
        kubectl("rollout", "status", "deployment/aureole-control", "--timeout=90s")
        tick = int(self.world.status()["tick"])
        wait_for(lambda: int(self.world.status()["tick"]) > tick + 100, "a status by a new leader")
        self.assertEqual(self.world.incarnations(), self.before, "no region is restarted")
        self.nothing_is_lost()

    def test_drained_node_is_empty_and_its_regions_are_elsewhere(self):
        node = self.world.pod_of(0)["spec"]["nodeName"]
        there = [r["region"] for r in self.world.status()["regions"] if r["node"] == node]
        self.addCleanup(kubectl, "uncordon", node, space=None)
        kubectl("drain", node, "--ignore-daemonsets", "--force", "--delete-emptydir-data", "--timeout=120s", space=None, timeout=150)
        self.measure("drain", time.monotonic() - self.since)
        self.nothing_is_lost()
        self.assert_the_rest_stayed(self.before, there)
        self.assertNotIn(node, [r.get("node") for r in self.world.status()["regions"]])

    def test_budget_lets_only_one_region_be_evicted_at_a_time(self):
        wait_for(lambda: budget() == (4, 3, 1), "four regions, of which three must stay")


class WithoutReplicas(WorldTest):
    """A World that does not say how many regions it has."""

    spec = {"replicas": None}

    def test_world_without_replicas_has_a_budget_and_its_node_is_drained(self):
        wait_for(lambda: get("world", self.world.name)["spec"].get("replicas") == 4, "the number of its layout")
        wait_for(lambda: budget() == (4, 3, 1), "four regions, of which three must stay")
        node = self.world.pod_of(0)["spec"]["nodeName"]
        self.addCleanup(kubectl, "uncordon", node, space=None)
        kubectl("drain", node, "--ignore-daemonsets", "--force", "--delete-emptydir-data", "--timeout=120s", space=None, timeout=150)
        self.measure("drain", time.monotonic() - self.began)
        self.world.runs()
        self.assert_exact()
