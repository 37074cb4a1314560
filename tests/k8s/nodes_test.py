"""A node is lost to the cluster while its containers run on: the case that fencing is for."""

import time

from cluster import WorldTest, kill_kubelet, leader, needs_the_machine, processes, repair_nodes, wait_for

LOST_S = 45  # 16 s until the node counts as lost, 5 s that Pods tolerate it, and the replacement


@needs_the_machine
class LostNode(WorldTest):
    def test_regions_of_a_lost_node_are_replaced_elsewhere_and_their_old_servers_fenced(self):
        wait_for(lambda: self.world.ticks.now() > 100, "tick 100")
        before = self.world.incarnations()
        # Not that of the leader: what is lost with it is another test's.
        spared = leader()["spec"]["nodeName"]
        regions = {}
        for pod in self.world.pods():
            regions.setdefault(pod["spec"]["nodeName"], []).append(pod)
        node, lost = next((n, p) for n, p in sorted(regions.items()) if n != spared)
        numbers = [int(p["metadata"]["labels"]["aureole.dev/region"]) for p in lost]
        self.addCleanup(repair_nodes)
        since = time.monotonic()
        kill_kubelet(node)
        wait_for(lambda: all(self.world.incarnations().get(r, 0) > before[r] for r in numbers), "next incarnations", 120)
        self.world.runs(seconds=120)
        self.measure("node lost to all regions ready", time.monotonic() - since, LOST_S)
        self.measure("longest stop", self.world.ticks.longest_stop(since))
        # The old ones were not stopped: they are there still, and nobody hears them.
        alive = [p["metadata"]["name"] for p in lost if processes(p)]
        self.measure("old servers that run on", len(alive), unit="")
        for region in numbers:
            self.assertNotEqual(self.world.pod_of(region)["spec"]["nodeName"], node)
        self.world.ticks.goes_on(200)
        self.assert_exact()
        self.assert_others_stayed(before, numbers)
        # And when the node is back, nothing changes.
        repair_nodes()
        now = self.world.incarnations()
        self.world.ticks.goes_on(200)
        self.assertEqual(self.world.incarnations(), now)
        self.assert_exact()
        wait_for(lambda: not any(processes(p) for p in lost), "the end of the old servers")
