"""What the tests do to a cluster: kubectl, Worlds and what is said about them, processes and nodes of the local cluster.

Environment, set by `./dev test-k8s`: KUBECONFIG; KUBECTL, the program; AUREOLE_BIN, the built programs; AUREOLE_IMAGE,
the image's name; AUREOLE_IMAGE_FILE, its archive; AUREOLE_KUBE, the directory of scripts of the local cluster, unset when
the cluster is another one, whose nodes cannot be killed.
"""

import contextlib
import json
import os
import pathlib
import re
import shutil
import signal
import subprocess
import tempfile
import threading
import time
import unittest
import urllib.request

SOURCE = pathlib.Path(__file__).resolve().parents[2]
BIN = pathlib.Path(os.environ.get("AUREOLE_BIN", SOURCE / "build/release/bin"))
KUBECTL = os.environ.get("KUBECTL", "kubectl")
KUBE = os.environ.get("AUREOLE_KUBE")
IMAGE = os.environ.get("AUREOLE_IMAGE", "localhost/aureole:test")
SPACE = "aureole"
CONTROL = "app.kubernetes.io/name=aureole-control"
LEADER = CONTROL + ",aureole.dev/role=leader"
DEADLINE_S = 90
TICK_S = 0.016  # of all worlds here
HASH_EVERY = 125

measured = []  # (test, what, value, bar), for the table


class Refused(Exception):
    """kubectl failed; the text is what it said."""


def kubectl(*arguments, stdin=None, space=SPACE, timeout=DEADLINE_S):
    command = [KUBECTL, *(["-n", space] if space else []), *map(str, arguments)]
    done = subprocess.run(command, input=stdin, capture_output=True, text=True, timeout=timeout)
    if done.returncode != 0:
        raise Refused(done.stderr.strip() or done.stdout.strip())
    return done.stdout


def get(*arguments, **keywords):
    return json.loads(kubectl("get", *arguments, "-o", "json", **keywords))


def apply(*objects, **keywords):
    text = json.dumps({"apiVersion": "v1", "kind": "List", "items": list(objects)})
    return kubectl("apply", "-f", "-", stdin=text, **keywords)


def pods(selector):
    return get("pods", "-l", selector)["items"]


def wait_for(condition, what, seconds=DEADLINE_S, pause=0.2):
    until = time.monotonic() + seconds
    while True:
        value = condition()
        if value:
            return value
        if time.monotonic() > until:
            raise AssertionError(f"not within {seconds} s: {what}")
        time.sleep(pause)


def aureole(*arguments, timeout=DEADLINE_S):
    done = subprocess.run([BIN / "aureole", *map(str, arguments)], capture_output=True, text=True, timeout=timeout)
    if done.returncode != 0:
        raise AssertionError(f"aureole {arguments[0]}: {done.stderr or done.stdout}")
    return done.stdout


def is_ready(pod):
    return any(c["type"] == "Ready" and c["status"] == "True" for c in pod.get("status", {}).get("conditions", []))


def deploy():
    """The control plane, as k8s/overlays/local has it; returns when a leader acts."""
    kubectl("apply", "-k", SOURCE / "k8s/overlays/local")
    kubectl("wait", "--for=condition=Established", "--timeout=30s", "crd/worlds.aureole.dev", space=None)
    kubectl("rollout", "status", "deployment/aureole-control", f"--timeout={DEADLINE_S}s")
    return leader()


def leader():
    def ready_leader():
        found = [p for p in pods(LEADER) if is_ready(p) and "deletionTimestamp" not in p["metadata"]]
        return found[0] if len(found) == 1 else None

    return wait_for(ready_leader, "one leader")


# ------------------------------------------------------------------------------------------------------------- nodes


def processes(pod):
    """Host process ids of the pod's containers; of its programs, not of the pause container."""
    ids = [c["containerID"].rpartition("/")[2] for c in pod["status"].get("containerStatuses", []) if "containerID" in c]
    found = []
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            with contextlib.suppress(OSError):
                cgroup = pathlib.Path("/proc", entry, "cgroup").read_text()
                if any(i in cgroup for i in ids) and pathlib.Path("/proc", entry, "cmdline").read_bytes():
                    found.append(int(entry))
    return found


def signal_pod(name, number):
    """Sends a signal to the pod's own program, from the host: the kubelet does not know of it."""
    found = [p for p in processes(get("pod", name)) if pathlib.Path("/proc", str(p), "comm").read_text().startswith("aureole")]
    assert found, f"pod {name} has no process"
    for pid in found:
        os.kill(pid, number)
    return found


def _kube_state():
    assets = os.environ.get("K8S_ASSETS", os.path.expanduser("~/.cache/kube-assets"))
    return pathlib.Path(os.environ.get("K8S_STATE", assets + "/run"))


def kill_kubelet(node):
    """The node is lost to the cluster; its containers go on."""
    file = _kube_state() / "pid" / f"{node}-kubelet"
    os.kill(int(file.read_text()), signal.SIGKILL)


def repair_nodes():
    subprocess.run([pathlib.Path(KUBE) / "up.sh"], check=True, capture_output=True, timeout=180)
    kubectl("wait", "--for=condition=Ready", "node", "--all", "--timeout=90s", space=None)


def needs_the_machine(test):
    """For tests that reach around the API to processes and nodes, which only the local cluster allows."""
    return unittest.skipUnless(KUBE, "the nodes of this cluster are other machines")(test)


# ------------------------------------------------------------------------------------------------------------ worlds


class Ticks:
    """How a World's clock goes, by the metrics of its servers, five times a second."""

    def __init__(self, world):
        self._world = world
        self.seen = []  # (monotonic time, tick)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self):
        while not self._stop.wait(0.1):
            best = 0
            for region in self._world.status().get("regions", []):
                host = region.get("endpoint", "").rpartition(":")[0]
                if host:
                    with contextlib.suppress(OSError, ValueError):
                        text = urllib.request.urlopen(f"http://{host}:9100/metrics", timeout=0.3).read().decode()
                        found = re.search(r"^aureole_tick\{[^}]*\} (\S+)", text, re.M)
                        best = max(best, int(float(found[1])) if found else 0)
            if best:
                self.seen.append((time.monotonic(), best))

    def end(self):
        self._stop.set()
        self._thread.join()

    def now(self):
        return self.seen[-1][1] if self.seen else 0

    def goes_on(self, ticks=25, seconds=DEADLINE_S):
        """Returns when the clock has gone on by so many ticks from the largest one seen."""
        start = max((tick for _, tick in self.seen), default=0)
        wait_for(lambda: self.now() > start + ticks, f"a tick after {start + ticks}", seconds, 0.05)

    def longest_stop(self, since=0.0):
        """Seconds in which no tick was seen, the longest; about 0.3 s when nothing stops."""
        last_tick, last_time, longest = 0, None, 0.0
        for at, tick in self.seen:
            if at < since:
                continue
            if tick > last_tick:
                longest = max(longest, at - last_time if last_time else 0.0)
                last_tick, last_time = tick, at
        return longest

    def dilation(self, since=0.0):
        """Simulated over wall time."""
        seen = [s for s in self.seen if s[0] >= since]
        return (seen[-1][1] - seen[0][1]) * TICK_S / (seen[-1][0] - seen[0][0]) if len(seen) > 1 else 0.0


class World:
    """A World of the cluster, from tests/worlds/FILE; all that it says of itself is kept. Fields that are None are left out."""

    def __init__(self, name, file, **spec):
        self.name = name
        self.file = SOURCE / "tests/worlds" / file
        self.directory = None
        if KUBE:  # all nodes are on this machine
            self.directory = pathlib.Path(tempfile.mkdtemp(prefix="aureole-k8s-"))
            os.chown(self.directory, 65532, 65532)
            storage = {"hostPath": str(self.directory)}
        else:
            storage = {"volumeClaim": {"size": "1Gi"}}
        self.object = {
            "apiVersion": "aureole.dev/v1alpha1", "kind": "World", "metadata": {"name": name},
            "spec": {"world": json.loads(self.file.read_text()), "image": IMAGE,
                     "imagePullPolicy": "Never" if IMAGE.startswith("localhost/") else "IfNotPresent",
                     "resources": {"requests": {"cpu": "50m", "memory": "64Mi"}},
                     "storage": storage, "hashEvery": HASH_EVERY, **spec}}
        self.object["spec"] = {k: v for k, v in self.object["spec"].items() if v is not None}
        self.hashes = {}  # tick: (hash, bodies), all that were ever said
        self._last = {}
        self._watch = None

    def start(self):
        apply(self.object)
        self.since = time.monotonic()
        self._watch = subprocess.Popen([KUBECTL, "-n", SPACE, "get", "world", self.name, "-w", "-o", "json"],
                                       stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        threading.Thread(target=self._read, daemon=True).start()
        self.ticks = Ticks(self)
        return self

    def _read(self):
        decoder, text = json.JSONDecoder(), ""
        for line in self._watch.stdout:
            text += line
            if line.startswith("}"):
                self._last, text = decoder.decode(text), ""
                said = self.status().get("hash")
                if said:
                    self.hashes[int(said["tick"])] = (said["hash"], int(said["bodies"]))

    def status(self):
        return self._last.get("status", {})

    def condition(self, kind):
        return next((c for c in self.status().get("conditions", []) if c["type"] == kind), {})

    def pods(self):
        return pods(f"aureole.dev/world={self.name}")

    def pod_of(self, region):
        """The newest that still runs."""
        found = [p for p in self.pods() if p["metadata"]["labels"]["aureole.dev/region"] == str(region)
                 and p["status"]["phase"] in ("Pending", "Running") and "deletionTimestamp" not in p["metadata"]]
        return max(found, key=lambda p: int(p["metadata"]["labels"]["aureole.dev/incarnation"]), default=None)

    def incarnations(self):
        return {r["region"]: int(r["incarnation"]) for r in self.status().get("regions", []) if "incarnation" in r}

    def servers(self):
        return [r["endpoint"] for r in self.status().get("regions", []) if r.get("endpoint")]

    def runs(self, regions=4, seconds=DEADLINE_S):
        """Returns when all regions are ready and the clock goes."""
        wanted = f"{regions}/{regions}"
        wait_for(lambda: self.status().get("phase") == "Running" and self.status().get("regionsReady") == wanted,
                 f"{wanted} regions (they are {self.status().get('regionsReady')}, {self.status().get('phase')}: "
                 f"{self.condition('Ready').get('message')})", seconds, 0.05)

    def events(self):
        uid = self._last["metadata"]["uid"]  # there may have been others of this name
        found = get("events", "--field-selector", f"involvedObject.uid={uid}")
        return [(e["reason"], e["message"]) for e in found["items"]]

    def logs(self):
        out = ""
        for pod in self.pods():
            with contextlib.suppress(Refused):
                out += f"--- {pod['metadata']['name']} on {pod['spec'].get('nodeName')}, {pod['status']['phase']}\n"
                out += kubectl("logs", "--tail=15", pod["metadata"]["name"])
        return out

    def hash_after(self, tick, seconds=DEADLINE_S):
        wait_for(lambda: any(t > tick for t in self.hashes), f"a state hash after tick {tick}", seconds)

    def whole(self, last):
        """The hashes of the same world on one server up to the tick `last`, as `hashes` has them."""
        out = json.loads(aureole("up", self.file, "--undivided", "--no-real-time", "--json", "--hash-every", HASH_EVERY,
                                 "--duration", f"{last * TICK_S:.3f}s", timeout=300))
        return {h["tick"]: (h["hash"], h["bodies"]) for h in out["hashes"]}

    def end(self):
        self.ticks.end()
        self._watch.kill()
        self._watch.communicate()
        kubectl("delete", "world", self.name, "--wait=false", "--ignore-not-found")
        with contextlib.suppress(AssertionError):
            wait_for(lambda: not [p for p in self.pods() if p["status"]["phase"] == "Running"], "end of its pods", 60)
        if self.directory:
            shutil.rmtree(self.directory, ignore_errors=True)


class ClusterTest(unittest.TestCase):
    def measure(self, what, value, bar=None, unit=" s"):
        """Says it in the table; fails when it is more than the bar."""
        text = f"{value:.2f}{unit}" if isinstance(value, float) else f"{value}{unit}"
        measured.append((self.id(), what, text, "" if bar is None else f"<= {bar}{unit}"))
        if bar is not None:
            self.assertLessEqual(value, bar, what)


class WorldTest(ClusterTest):
    """One running World per test."""

    file, spec, regions = "demo.json", {}, 4

    @classmethod
    def setUpClass(cls):
        deploy()

    def setUp(self):
        name = re.sub("[^a-z0-9]+", "-", self.id().rpartition(".")[2].removeprefix("test_"))[:32].strip("-")
        self.world = World(name, self.file, **{"replicas": self.regions, **self.spec}).start()
        self.addCleanup(self.world.end)
        self.addCleanup(self._say_why)
        self.world.runs(self.regions)
        self.began = time.monotonic()

    def _say_why(self):
        result = self._outcome.result
        failed = any(test is self for test, _ in result.failures + result.errors)
        if failed:
            print(f"\n--- status: {json.dumps({k: v for k, v in self.world.status().items() if k != 'record'})}"
                  f"\n--- events: {self.world.events()}\n{self.world.logs()}", flush=True)

    def assert_exact(self, after=0):
        """Every state hash that was said is that of the undivided world, bodies included; one comes after `after`."""
        self.world.hash_after(max(after, self.world.ticks.now()))
        self.assert_exact_so_far()

    def assert_exact_so_far(self):
        hashes = dict(self.world.hashes)
        whole = self.world.whole(max(hashes))
        differ = {t: (h, whole.get(t)) for t, h in hashes.items() if h != whole.get(t)}
        self.assertEqual(differ, {}, "tick: (what it was, what it is on one server)")
        self.measure("hashes equal to the undivided world's", len(hashes), unit="")

    def assert_others_stayed(self, before, regions):
        """No region of those before but these has another incarnation; one that was to take a place may still be ending."""
        now = self.world.incarnations()
        rest = {r: i for r, i in before.items() if r not in regions}
        self.assertEqual({r: now.get(r) for r in rest}, rest)
        for region in regions:
            self.assertGreater(now[region], before[region])

    def left(self, before, region):
        """Whether the region has left, and another one, maybe of the same name, is in its place."""
        return self.world.incarnations().get(region) != before[region]

    def assert_the_rest_stayed(self, before, left):
        """These regions have left; the others have the servers that they had."""
        now = self.world.incarnations()
        rest = {r: i for r, i in before.items() if r not in left}
        self.assertEqual({r: now.get(r) for r in rest}, rest)
        for region in left:
            self.assertNotEqual(now.get(region), before[region])
