"""The manifests: both kinds of kubectl render them alike, the API server takes them, and refuses bad Worlds by field."""

import copy
import json
import re
import shutil
import subprocess

from cluster import KUBECTL, SOURCE, ClusterTest, Refused, kubectl, wait_for

K8S = SOURCE / "k8s"
WORLDS = SOURCE / "tests/worlds"


def rendered(overlay, program=KUBECTL):
    done = subprocess.run([program, "kustomize", K8S / overlay], capture_output=True, text=True)
    if done.returncode != 0:
        raise Refused(done.stderr)
    return done.stdout


def objects(text):
    """Of YAML that kubectl reads; custom resources must be known to the API server."""
    out = subprocess.run([KUBECTL, "create", "--dry-run=client", "--validate=false", "-o", "json", "-f", "-"], input=text,
                         capture_output=True, text=True, check=True).stdout
    read = json.loads(out) if out.startswith("{\n    \"apiVersion\": \"v1\",\n    \"items\"") else None
    found, decoder, at = [], json.JSONDecoder(), 0
    while read is None and at < len(out.rstrip()):
        value, at = decoder.raw_decode(out, at)
        found.append(value)
        at += len(out[at:]) - len(out[at:].lstrip())
    return {(o["kind"], o["metadata"]["name"]): o for o in (found if read is None else read["items"])}


WORLD = {"apiVersion": "aureole.dev/v1alpha1", "kind": "World", "metadata": {"name": "refused"},
         "spec": {"world": {"name": "refused", "layout": {"columns": {"edges": [0]}},
                            "bodies": [{"shape": {"sphere": {"radius": 1}}, "position": {"y": 3}}]},
                  "replicas": 2, "storage": {"emptyDir": {}}}}

GONE = object()
# path in the World, its value, the field that the refusal must name
BAD = [
    ("metadata.name", "Refused", "metadata.name"),
    ("metadata.name", "1refused", "metadata.name"),
    ("metadata.name", "r" * 41, "metadata.name"),
    ("spec", GONE, "spec"),
    ("spec.world", GONE, "spec.world"),
    ("spec.worldFrom", {"configMap": "c", "key": "k"}, "spec"),
    ("spec.world", "a file", "spec.world"),
    ("spec.world.name", GONE, "spec.world.name"),
    ("spec.world.name", "with space", "spec.world.name"),
    ("spec.world.gravity", {"y": "down"}, "spec.world.gravity.y"),
    ("spec.world.gravity", [0, -9.81, 0], "spec.world.gravity"),
    ("spec.world.tick", "16ms", "spec.world.tick"),
    ("spec.world.tick", 0.016, "spec.world.tick"),
    ("spec.world.iterations", 0, "spec.world.iterations"),
    ("spec.world.speed_limit", -1, "spec.world.speed_limit"),
    ("spec.world.tolerances", {"speed": 0}, "spec.world.tolerances.speed"),
    ("spec.world.exchange", {"delay": 4}, "spec.world.exchange.delay"),
    ("spec.world.exchange", {"delay": 1, "policy": "GUESS"}, "spec.world.exchange.policy"),
    ("spec.world.layout", {"columns": {"edges": [0]}, "grid": {}}, "spec.world.layout"),
    ("spec.world.layout", {}, "spec.world.layout"),
    ("spec.world.layout", {"columns": {"edges": [10000000]}}, "spec.world.layout.columns.edges"),
    ("spec.world.layout", {"columns": {"edges": list(range(64))}}, "spec.world.layout.columns.edges"),
    ("spec.world.layout", {"rectangles": {"regions": []}}, "spec.world.layout.rectangles.regions"),
    ("spec.world.materials", {"ice": {"friction": -0.1}}, "spec.world.materials.ice.friction"),
    ("spec.world.shapes", {"two": {"sphere": {"radius": 1}, "box": {}}}, "spec.world.shapes.two"),
    ("spec.world.bodies", [{"position": {"y": 3}}], "spec.world.bodies.shape"),
    ("spec.world.bodies", [{"shape": {"named": "a"}, "mass": 0}], "spec.world.bodies.mass"),
    ("spec.world.bodies", [{"shape": {"named": "a"}, "mass": "heavy"}], "spec.world.bodies.mass"),
    ("spec.world.bodies", [{"shape": {"named": "a"}, "mass": 1, "density": 1}], "spec.world.bodies"),
    ("spec.world.bodies", [{"shape": {"named": "a"}, "position": {"x": True}}], "spec.world.bodies.position.x"),
    ("spec.world.joints", [{"a": 1, "b": 2}], "spec.world.joints"),
    ("spec.world.injectors", [{"rate": 5, "volumes": [{}], "kinds": [{}]}], "spec.world.injectors.duration"),
    ("spec.world.injectors", [{"rate": -5, "duration": "1s", "volumes": [{}], "kinds": [{}]}], "spec.world.injectors.rate"),
    ("spec.storage", GONE, "spec.storage"),
    ("spec.storage", {}, "spec.storage"),
    ("spec.storage", {"emptyDir": {}, "hostPath": "/data"}, "spec.storage"),
    ("spec.storage", {"hostPath": "data"}, "spec.storage.hostPath"),
    ("spec.storage", {"hostPath": "/"}, "spec.storage.hostPath"),
    ("spec.storage", {"volumeClaim": {"storageClassName": "fast"}}, "spec.storage.volumeClaim.size"),
    ("spec.replicas", 0, "spec.replicas"),
    ("spec.replicas", 65, "spec.replicas"),
    ("spec.replicas", "four", "spec.replicas"),
    ("spec.regions", {"min": 0}, "spec.regions.min"),
    ("spec.regions", {"max": 65}, "spec.regions.max"),
    ("spec.regions", {"max": 8, "framePercent": 0}, "spec.regions.framePercent"),
    ("spec.regions", {"max": 8, "awakeBodies": -1}, "spec.regions.awakeBodies"),
    ("spec.regions", {"max": 8, "upAfter": "soon"}, "spec.regions.upAfter"),
    ("spec.regions", {"max": 8, "downAfter": 60}, "spec.regions.downAfter"),
    ("spec.checkpointSeconds", 0, "spec.checkpointSeconds"),
    ("spec.duration", "60", "spec.duration"),
    ("spec.hashEvery", -1, "spec.hashEvery"),
    ("spec.policy", "Panic", "spec.policy"),
    ("spec.imagePullPolicy", "Sometimes", "spec.imagePullPolicy"),
    ("spec.tolerations", [{"operator": "Maybe"}], "spec.tolerations.operator"),
    ("spec.nodeSelector", {"zone": 3}, "spec.nodeSelector.zone"),
]


def changed(path, value):
    world = copy.deepcopy(WORLD)
    *above, last = path.split(".")
    at = world
    for name in above:
        at = at[name]
    if value is GONE:
        del at[last]
    else:
        at[last] = value
    return world


def offer(world):
    """To the API server itself: kubectl checks nothing."""
    return kubectl("create", "--dry-run=server", "--validate=false", "-o", "json", "-f", "-", stdin=json.dumps(world))


class Manifests(ClusterTest):
    @classmethod
    def setUpClass(cls):
        kubectl("apply", "-k", K8S / "overlays/local")
        kubectl("wait", "--for=condition=Established", "--timeout=30s", "crd/worlds.aureole.dev", space=None)

    def test_local_overlay_is_accepted_again_and_changes_nothing(self):
        said = kubectl("apply", "-k", K8S / "overlays/local").splitlines()
        self.assertGreaterEqual(len(said), 14)
        self.assertEqual([s for s in said if not s.endswith(" unchanged")], [])

    def test_old_and_new_kubectl_render_the_local_overlay_alike(self):
        others = {p for p in (shutil.which("kubectl"), KUBECTL) if p}
        kinds = [objects(rendered("overlays/local", p)) for p in others]
        for other in kinds[1:]:
            self.assertEqual(other, kinds[0])
        self.assertEqual(len(kinds[0]), 14)

    def test_local_overlay_keeps_to_the_old_api(self):
        versions = {o["apiVersion"] for o in objects(rendered("overlays/local")).values()}
        self.assertIn("policy/v1beta1", versions)
        self.assertNotIn("policy/v1", versions)

    def test_production_overlay_has_whole_cores_certificates_and_tokens(self):
        try:
            found = objects(rendered("overlays/production").replace("policy/v1\n", "policy/v1beta1\n"))
        except Refused:  # the kustomize of kubectl 1.20 is 2.0.3
            found = objects(rendered("overlays/production", shutil.which("kubectl")).replace("policy/v1\n", "policy/v1beta1\n"))
        deployment = found["Deployment", "aureole-control"]
        self.assertEqual(deployment["spec"]["replicas"], 2)
        pod = deployment["spec"]["template"]["spec"]
        (container,) = pod["containers"]
        self.assertEqual(container["resources"]["requests"], container["resources"]["limits"])
        self.assertEqual(container["resources"]["requests"]["cpu"], "1")
        self.assertIn("--tls", container["args"])
        self.assertIn("--tokens", container["args"])
        self.assertNotIn("--insecure", container["args"])
        self.assertEqual({v.get("secret", {}).get("secretName") for v in pod["volumes"]} - {None}, {"aureole-tls", "aureole-tokens"})
        self.assertEqual({c["topologyKey"] for c in pod["topologySpreadConstraints"]},
                         {"topology.kubernetes.io/zone", "kubernetes.io/hostname"})
        kubectl("apply", "--dry-run=server", "-f", "-", stdin=json.dumps({"apiVersion": "v1", "kind": "List",
                                                                          "items": list(found.values())}))

    def test_no_pod_of_ours_may_do_more_than_it_must(self):
        pod = objects(rendered("overlays/local"))["Deployment", "aureole-control"]["spec"]["template"]["spec"]
        (container,) = pod["containers"]
        self.assertTrue(pod["securityContext"]["runAsNonRoot"])
        self.assertEqual(pod["securityContext"]["seccompProfile"], {"type": "RuntimeDefault"})
        self.assertEqual(container["securityContext"], {"allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True,
                                                        "capabilities": {"drop": ["ALL"]}})
        self.assertNotIn("cpu", container["resources"]["limits"])

    def test_dashboard_and_alerts_ask_for_metrics_that_exist(self):
        source = (SOURCE / "server/region/metrics.cc").read_text()
        there = set(re.findall(r'"(aureole_[a-z_]+)"', source))
        self.assertGreater(len(there), 15)
        for file in ("dashboard.json", "alerts.yaml"):
            text = (K8S / "base" / file).read_text()
            asked = {re.sub("_(bucket|sum|count)$", "", m) for m in re.findall(r"\baureole_[a-z_]+", text)}
            self.assertEqual(asked - there, set(), file)
        self.assertGreaterEqual(len(json.loads((K8S / "base/dashboard.json").read_text())["panels"]), 10)


class Worlds(ClusterTest):
    setUpClass = Manifests.setUpClass

    def test_good_world_is_accepted_and_nothing_of_it_is_lost(self):
        said = json.loads(offer(WORLD))
        self.assertEqual(said["spec"], WORLD["spec"])

    def test_every_shipped_world_is_accepted_whole(self):
        files = [*WORLDS.glob("*.json"), *WORLDS.glob("paper/*.json")]
        self.assertGreater(len(files), 15)
        for file in files:
            world = changed("spec.world", json.loads(file.read_text()))
            with self.subTest(file.name):
                self.assertEqual(json.loads(offer(world))["spec"]["world"], world["spec"]["world"])

    def test_every_bad_world_is_refused_with_its_field(self):
        for path, value, field in BAD:
            with self.subTest(path=path, value=value):
                with self.assertRaises(Refused) as refusal:
                    offer(changed(path, value))
                self.assertRegex(str(refusal.exception).replace("[0]", ""), re.escape(field) + r"\b")
        self.measure("bad Worlds refused", len(BAD), unit="")

    def test_misspelt_field_of_a_world_reaches_the_control_plane(self):
        for path in ("bodees", "bodies", "gravity", "layout"):
            wrong = {"bodees": [], "bodies": [{"shape": {"named": "a"}, "shpe": 1}], "gravity": {"yy": 1},
                     "layout": {"columns": {"edgs": [0]}}}[path]
            said = json.loads(offer(changed("spec.world." + path, wrong)))
            self.assertEqual(said["spec"]["world"][path], wrong)

    def test_example_is_the_shipped_world(self):
        kubectl("apply", "--dry-run=server", "-f", K8S / "examples/demo.yaml")
        (example,) = objects((K8S / "examples/demo.yaml").read_text()).values()
        self.assertEqual(example["spec"]["world"], json.loads((WORLDS / "demo.json").read_text()))

    def test_scale_and_status_are_subresources_with_columns(self):
        world = changed("metadata.name", "columns")
        # Nobody serves this namespace.
        space = "aureole-columns"
        kubectl("create", "namespace", space, space=None)
        self.addCleanup(kubectl, "delete", "namespace", space, "--wait=false", space=None)
        wait_for(lambda: self.created(world, space), "a World")
        path = f"/apis/aureole.dev/v1alpha1/namespaces/{space}/worlds/columns"
        world = json.loads(kubectl("get", "--raw", path, space=None))
        world["status"] = {"phase": "Running", "regionsReady": "2/2", "tick": 4711, "bodies": 17, "realTimeFactor": 0.98,
                           "replicas": 2, "selector": "aureole.dev/world=columns", "hash": {"tick": 4700, "hash": "0" * 16},
                           "regions": [{"region": 0, "home": {"min_x": -5}}], "record": {"regions": [{"wasReady": True}]}}
        kubectl("replace", "--raw", path + "/status", "-f", "-", stdin=json.dumps(world), space=None)
        line = kubectl("get", "aw", "columns", "--no-headers", space=space).split()
        self.assertEqual(line[:6], ["columns", "Running", "2/2", "4711", "17", "0.98"])
        kept = json.loads(kubectl("get", "--raw", path, space=None))
        self.assertEqual(kept["status"], world["status"])
        kubectl("scale", "world", "columns", "--replicas=5", space=space)
        scale = json.loads(kubectl("get", "--raw", path + "/scale", space=None))
        self.assertEqual((scale["spec"]["replicas"], scale["status"]["replicas"], scale["status"]["selector"]),
                         (5, 2, "aureole.dev/world=columns"))
        with self.assertRaisesRegex(Refused, "spec.replicas"):
            kubectl("scale", "world", "columns", "--replicas=65", space=space)

    def created(self, world, space):
        try:
            return kubectl("create", "-f", "-", stdin=json.dumps(world), space=space)
        except Refused as e:
            if "AlreadyExists" in str(e):
                return True
            raise
