"""A node is lost, with its containers or without: what runs on is fenced, what is gone is replaced."""

import signal
import time

from cluster import WorldTest, kill_kubelet, leader, needs_the_machine, processes, repair_nodes, signal_pod, wait_for

# The node counts as lost after 16 s, its Pods tolerate that for 5 s, and have 30 s to end, which nobody does.
REPLACED_S = 90
# Nothing is scheduled to the dead machine, though the cluster does not know yet.
AGAIN_S = 20


@needs_the_machine
class LostNode(WorldTest):
    def setUp(self):
        super().setUp()
        wait_for(lambda: self.world.ticks.now() > 100, "tick 100")
        self.before = self.world.incarnations()
        # Not that of the leader: what is lost with it is another test's.
        spared = leader()["spec"]["nodeName"]
        there = {}
        for pod in self.world.pods():
            there.setdefault(pod["spec"]["nodeName"], []).append(pod)
        self.node, self.lost = next((n, p) for n, p in sorted(there.items()) if n != spared)
        self.regions = [int(p["metadata"]["labels"]["aureole.dev/region"]) for p in self.lost]
        self.addCleanup(repair_nodes)
        self.since = time.monotonic()

    def replaced(self, seconds):
        wait_for(lambda: all(self.world.incarnations().get(r, 0) > self.before[r] for r in self.regions), "next incarnations", 120)
        self.world.runs(seconds=120)
        self.measure("node lost to all regions ready", time.monotonic() - self.since, seconds)
        self.measure("longest stop", self.world.ticks.longest_stop(self.since))
        for region in self.regions:
            self.assertNotEqual(self.world.pod_of(region)["spec"]["nodeName"], self.node)

    def test_regions_of_a_lost_node_are_replaced_elsewhere_and_their_old_servers_fenced(self):
        old = {pid for pod in self.lost for pid in processes(pod)}
        self.assertTrue(old)
        kill_kubelet(self.node)
        self.replaced(REPLACED_S)
        self.world.ticks.goes_on(200)
        self.assert_exact()
        self.assert_others_stayed(self.before, self.regions)
        # When the node is back, nothing changes, and what is left of the old servers goes.
        repair_nodes()
        now = self.world.incarnations()
        self.world.ticks.goes_on(200)
        self.assertEqual(self.world.incarnations(), now)
        self.assert_exact()
        wait_for(lambda: not any(processes(p) for p in self.lost), "the end of the old servers")

    def test_regions_of_a_machine_that_dies_are_replaced_on_others(self):
        kill_kubelet(self.node)
        for pod in self.lost:
            signal_pod(pod["metadata"]["name"], signal.SIGKILL)
        self.replaced(AGAIN_S)
        for region in self.regions:
            self.assertEqual(self.world.incarnations()[region], self.before[region] + 1, "at the first try")
        self.assert_exact()
        self.assert_others_stayed(self.before, self.regions)
