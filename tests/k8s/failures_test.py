"""Region servers that die, and storage that fails, under load: the world goes on, exactly."""

import os
import shutil
import signal
import subprocess
import tempfile
import time

from cluster import BIN, WorldTest, kubectl, needs_the_machine, signal_pod, wait_for

AGAIN_S = 10
LEAVES_S = 1  # longest stop when a region leaves in order; about 0.3 is what the clock's metrics can tell


class Load:
    """Clients that watch the whole world while it is hurt."""

    def __init__(self, world, clients=8):
        self._process = subprocess.Popen([BIN / "aureole", "load", "--server", world.servers()[0], "--clients", str(clients),
                                          "--rate", "20", "--duration", "10m"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)

    def end(self):
        self._process.kill()
        self._process.wait()


class UnderLoad(WorldTest):
    """Bodies that are thrown at the corner where all four regions meet, and clients."""

    file = "corner-storm.json"

    def setUp(self):
        super().setUp()
        load = Load(self.world)
        self.addCleanup(load.end)
        # There is a checkpoint, and many bodies fly.
        wait_for(lambda: self.world.ticks.now() > 250, "tick 250")
        self.before = self.world.incarnations()

    def goes_on_after(self, hurt, regions):
        """Hurts the world, and returns the seconds until it ticks again; everything is exact, and no other region moved."""
        tick = self.world.ticks.now()
        began = time.monotonic()
        hurt()
        wait_for(lambda: all(self.world.incarnations().get(r, 0) > self.before[r] for r in regions), "next incarnations")
        self.world.ticks.goes_on(50)
        self.world.runs()
        self.measure("longest stop", self.world.ticks.longest_stop(began), AGAIN_S)
        self.assert_exact(tick)
        self.assert_others_stayed(self.before, regions)
        self.measure("speed since", self.world.ticks.dilation(began), unit="")

    @needs_the_machine
    def test_killed_process_is_replaced_and_no_body_is_lost_or_doubled(self):
        self.goes_on_after(lambda: signal_pod(self.world.pod_of(1)["metadata"]["name"], signal.SIGKILL), [1])

    @needs_the_machine
    def test_two_processes_killed_at_once_are_replaced(self):
        def kill():
            for region in (0, 3):
                signal_pod(self.world.pod_of(region)["metadata"]["name"], signal.SIGKILL)

        self.goes_on_after(kill, [0, 3])

    def test_region_of_a_deleted_pod_leaves_and_the_world_does_not_stop(self):
        tick = self.world.ticks.now()
        began = time.monotonic()
        kubectl("delete", "pod", self.world.pod_of(2)["metadata"]["name"], "--wait=false")
        wait_for(lambda: self.left(self.before, 2), "another region in its place")
        self.world.ticks.goes_on(50)
        self.world.runs()
        self.measure("longest stop", self.world.ticks.longest_stop(began), LEAVES_S)
        self.assert_exact(tick)
        self.assert_the_rest_stayed(self.before, [2])
        self.measure("speed since", self.world.ticks.dilation(began), unit="")

    def test_pod_deleted_without_grace_is_replaced(self):
        self.goes_on_after(lambda: kubectl("delete", "pod", self.world.pod_of(2)["metadata"]["name"], "--wait=false",
                                           "--grace-period=0", "--force"), [2])

    @needs_the_machine
    def test_frozen_process_is_replaced_and_changes_nothing_when_it_wakes(self):
        pod = self.world.pod_of(1)["metadata"]["name"]
        frozen = signal_pod(pod, signal.SIGSTOP)
        tick = self.world.ticks.now()
        wait_for(lambda: self.world.incarnations().get(1, 0) > self.before[1], "the next incarnation")
        for pid in frozen:
            try:
                os.kill(pid, signal.SIGCONT)
            except ProcessLookupError:
                pass  # it was ended first
        self.world.ticks.goes_on(50)
        self.assert_exact(tick)
        self.assert_others_stayed(self.before, [1])


@needs_the_machine
class Storage(WorldTest):
    """A region whose checkpoints cannot be written goes on, and the World says so."""

    def events_say(self, *words):
        wait_for(lambda: any(all(w in message for w in words) for _, message in self.world.events()),
                 f"an event with {words}, of {self.world.events()}")

    def checkpoints(self, number):
        """The directory of the region's first incarnation."""
        return self.world.directory / self.world.name / f"region-{number}" / "i1"

    def test_volume_that_becomes_read_only_is_an_event(self):
        wait_for(lambda: (self.checkpoints(2) / "checkpoint").exists(), "a checkpoint")
        self.checkpoints(2).chmod(0o500)
        self.events_say("region 2", "not protected")
        wait_for(lambda: self.world.condition("Degraded").get("status") == "True", "the condition Degraded")
        self.world.ticks.goes_on(50)
        self.checkpoints(2).chmod(0o700)
        self.events_say("region 2", "is protected")
        self.assert_exact()

    def test_damaged_checkpoint_ends_the_run_and_is_an_event(self):
        wait_for(lambda: (self.checkpoints(1) / "checkpoint").exists(), "a checkpoint")
        pod = self.world.pod_of(1)["metadata"]["name"]
        # It is replaced every second by a good one: hold the directory still, then damage what is there.
        self.checkpoints(1).chmod(0o500)
        file = self.checkpoints(1) / "checkpoint"
        content = bytearray(file.read_bytes())
        content[len(content) // 2] ^= 0xFF
        file.write_bytes(content)
        signal_pod(pod, signal.SIGKILL)
        self.events_say("region 1", "the checkpoint's check sum is wrong")
        wait_for(lambda: self.world.status().get("phase") == "Failed", "the phase Failed")


@needs_the_machine
class FullDisk(WorldTest):
    def setUp(self):
        # One file system for the checkpoints of all regions, so small that it is full soon.
        self.disk = tempfile.mkdtemp(prefix="aureole-k8s-disk-")
        subprocess.run(["mount", "-t", "tmpfs", "-o", "size=4m,uid=65532,gid=65532", "tmpfs", self.disk], check=True)
        self.addCleanup(shutil.rmtree, self.disk, ignore_errors=True)
        self.addCleanup(subprocess.run, ["umount", "-l", self.disk])
        self.spec = {"storage": {"hostPath": self.disk}}
        super().setUp()

    def test_full_disk_is_an_event_and_the_world_goes_on(self):
        subprocess.run(["dd", "if=/dev/zero", f"of={self.disk}/ballast", "bs=64k"], capture_output=True)
        wait_for(lambda: any("not protected" in m and "No space left" in m for _, m in self.world.events()), "an event")
        self.world.ticks.goes_on(50)
        os.remove(f"{self.disk}/ballast")
        self.assert_exact()
