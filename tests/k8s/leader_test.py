"""The control plane itself fails: the standby takes over, the servers go on, and an old leader changes nothing."""

import os
import signal
import time

from cluster import CONTROL, WorldTest, deploy, get, kubectl, leader, needs_the_machine, pods, signal_pod, wait_for

TAKEN_OVER_S = 20


class Leader(WorldTest):
    file = "demo.json"

    def setUp(self):
        # Containers that were killed before would be started again later than these.
        kubectl("rollout", "restart", "deployment/aureole-control")
        deploy()
        super().setUp()
        wait_for(lambda: self.world.ticks.now() > 100, "tick 100")
        self.before = self.world.incarnations()
        self.old = leader()["metadata"]["name"]
        self.epoch = self.transitions()

    def transitions(self):
        return get("lease", "aureole-control")["spec"].get("leaseTransitions", 0)

    def holder(self):
        return get("lease", "aureole-control")["spec"].get("holderIdentity", "")

    def taken_over(self, since, bar=TAKEN_OVER_S):
        """Another one leads, says so, and knows the world; the servers did not notice."""
        wait_for(lambda: self.transitions() > self.epoch and self.holder(), "the next leader")
        self.measure("until another leads", time.monotonic() - since, bar)
        # It may be the same Pod, with a new container.
        wait_for(lambda: [p for p in pods(CONTROL + ",aureole.dev/role=leader") if p["metadata"]["name"] in self.holder()],
                 "the leader's label")
        tick = int(self.world.status()["tick"])
        wait_for(lambda: int(self.world.status()["tick"]) > tick + 100, "a status by the new leader")
        self.measure("until it tells the World's state", time.monotonic() - since)
        self.assertEqual(self.world.incarnations(), self.before)
        self.assertLess(self.world.ticks.longest_stop(since), 2)
        self.assert_exact()

    @needs_the_machine
    def test_killed_leader_is_succeeded_and_no_region_restarts(self):
        since = time.monotonic()
        signal_pod(self.old, signal.SIGKILL)
        self.taken_over(since)

    def test_deleted_leader_hands_over_at_once(self):
        since = time.monotonic()
        kubectl("delete", "pod", self.old, "--wait=false")
        self.taken_over(since, 10)

    @needs_the_machine
    def test_frozen_leader_is_succeeded_and_changes_nothing_when_it_wakes(self):
        since = time.monotonic()
        frozen = signal_pod(self.old, signal.SIGSTOP)
        try:
            self.taken_over(since)
            now = self.holder()
        finally:
            for pid in frozen:
                try:
                    os.kill(pid, signal.SIGCONT)
                except ProcessLookupError:
                    pass  # its probes failed, and the kubelet ended it
        self.world.ticks.goes_on(300)
        self.assertEqual(self.holder(), now)
        labelled = [p["metadata"]["name"] for p in pods(CONTROL + ",aureole.dev/role=leader")]
        self.assertEqual(len(labelled), 1)
        self.assertNotEqual(labelled, [self.old])
        self.assertEqual(self.world.incarnations(), self.before)
        self.assert_exact()

    @needs_the_machine
    def test_region_that_dies_while_nobody_leads_is_replaced_by_the_next_leader(self):
        names = [p["metadata"]["name"] for p in pods(CONTROL) if "deletionTimestamp" not in p["metadata"]]
        region = self.world.pod_of(3)["metadata"]["name"]
        for name in names:
            signal_pod(name, signal.SIGKILL)
        signal_pod(region, signal.SIGKILL)
        wait_for(lambda: self.world.incarnations().get(3, 0) > self.before[3], "the next incarnation")
        self.world.ticks.goes_on(50)
        self.assert_exact()
        self.assert_others_stayed(self.before, [3])
