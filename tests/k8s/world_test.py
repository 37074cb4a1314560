"""A World from `kubectl apply` on: its servers, what kubectl tells of it, what clients see, and that it is exact."""

import json
import time

from cluster import CONTROL, SOURCE, World, WorldTest, aureole, deploy, get, kubectl, pods, wait_for

READY_S = 15


class Start(WorldTest):
    spec = {"duration": "30s"}

    def test_four_regions_are_ready_within_seconds_of_the_apply(self):
        self.measure("apply to all regions ready", self.began - self.world.since, READY_S)

    def test_kubectl_tells_the_story(self):
        self.world.ticks.goes_on()
        line = kubectl("get", "aw", self.world.name, "--no-headers").split()
        self.assertEqual(line[:3], [self.world.name, "Running", "4/4"])
        self.assertGreater(int(line[3]), 0)
        self.assertGreater(int(line[4]), 200)
        self.assertGreater(float(line[5]), 0)
        status = self.world.status()
        self.assertEqual(self.world.condition("Ready").get("status"), "True")
        self.assertEqual(status["observedGeneration"], get("world", self.world.name)["metadata"]["generation"])
        self.assertEqual([r["region"] for r in status["regions"]], [0, 1, 2, 3])
        self.assertEqual(sum(int(r["bodies"]) for r in status["regions"]), int(status["bodies"]))
        nodes = {p["metadata"]["name"]: p["spec"]["nodeName"] for p in self.world.pods()}
        for region in status["regions"]:
            self.assertEqual(region["node"], nodes[region["pod"]])
            self.assertEqual(int(region["incarnation"]), 1)
        described = kubectl("describe", "world", self.world.name)
        self.assertIn("Events:", described)
        self.assertTrue(self.world.events())

    def test_pods_are_owned_named_and_without_rights(self):
        world = get("world", self.world.name)
        found = self.world.pods()
        self.assertEqual(sorted(p["metadata"]["name"] for p in found), [f"{self.world.name}-r{r}-i1" for r in range(4)])
        for pod in found:
            (owner,) = pod["metadata"]["ownerReferences"]
            self.assertEqual((owner["kind"], owner["uid"], owner["controller"]), ("World", world["metadata"]["uid"], True))
            self.assertFalse(pod["spec"]["automountServiceAccountToken"])
            self.assertTrue(pod["spec"]["securityContext"]["runAsNonRoot"])
            for container in pod["spec"]["containers"]:
                self.assertTrue(container["securityContext"]["readOnlyRootFilesystem"])
                self.assertNotIn("cpu", container.get("resources", {}).get("limits", {}))

    def test_regions_are_spread_over_the_nodes(self):
        on = {n["metadata"]["name"]: 0 for n in get("nodes", space=None)["items"] if not n["spec"].get("taints")}
        for pod in self.world.pods():
            on[pod["spec"]["nodeName"]] += 1
        self.measure("regions of nodes", "/".join(str(n) for n in sorted(on.values(), reverse=True)), unit="")
        self.assertLessEqual(max(on.values()) - min(on.values()), 1, on)

    def test_clients_of_any_server_see_every_body(self):
        self.world.ticks.goes_on()
        for server in self.world.servers():
            seen = json.loads(aureole("watch", "--server", server, "--bodies", "--json"))["bodies"]
            ids = [b["body"] for b in seen]
            self.assertEqual(len(ids), len(set(ids)))
            # Fountains add bodies between the two looks.
            self.assertLessEqual(abs(len(ids) - int(self.world.status()["bodies"])), 20)
            self.assertGreater(len(ids), 200)
        out = json.loads(aureole("top", "--server", self.world.servers()[2], "--duration", "2s", "--json").splitlines()[-1])
        self.assertEqual([r["server"] for r in out["regions"]], self.world.servers())

    def test_its_hashes_are_those_of_the_undivided_world_to_the_end(self):
        wait_for(lambda: self.world.status().get("phase") == "Finished", "its end")
        last = self.world.status()["hash"]
        self.assertEqual(int(last["tick"]), int(30 / 0.016))
        self.assertEqual(int(last["bodies"]), int(self.world.status()["bodies"]))
        self.assert_exact_so_far()

    def test_deleted_world_leaves_no_pod(self):
        kubectl("delete", "world", self.world.name, "--timeout=60s")
        wait_for(lambda: not self.world.pods(), "its pods to go")

    def test_world_deleted_while_no_control_plane_runs_leaves_no_pod(self):
        self.addCleanup(deploy)
        self.addCleanup(kubectl, "scale", "deployment/aureole-control", "--replicas=2")
        kubectl("scale", "deployment/aureole-control", "--replicas=0")
        wait_for(lambda: not pods(CONTROL), "the end of the control plane")
        began = time.monotonic()
        kubectl("delete", "world", self.world.name, "--timeout=60s")
        # Servers wait 10 s for a control plane that lets them leave, and have 30 s; kubelets take their time to tell.
        wait_for(lambda: not self.world.pods(), "its pods to go")
        self.measure("deleted to all pods gone", time.monotonic() - began)


class Refusals(WorldTest):
    """What only the control plane can know is said on the World."""

    def setUp(self):
        pass

    def refused(self, word, **spec):
        world = World("refused", "demo.json", replicas=4, **spec).start()
        self.addCleanup(world.end)
        wait_for(lambda: word in world.condition("Ready").get("message", ""), f"a condition that says '{word}': {world.status()}")
        self.assertEqual(world.condition("Ready")["status"], "False")
        self.assertEqual(world.pods(), [])

    def test_bad_world_file_is_refused_with_its_field(self):
        wrong = json.loads((SOURCE / "tests/worlds/demo.json").read_text())
        wrong["bodies"][0]["shpe"] = {}
        self.refused("bodies[0].shpe", world=wrong)

    def test_missing_config_map_is_named(self):
        world = World("without-a-file", "demo.json", replicas=4)
        del world.object["spec"]["world"]
        world.object["spec"]["worldFrom"] = {"configMap": "nowhere", "key": "world.json"}
        world.start()
        self.addCleanup(world.end)
        wait_for(lambda: "nowhere" in world.condition("Ready").get("message", ""), f"a condition: {world.status()}")


class FromAConfigMap(WorldTest):
    def setUp(self):
        self.world = World("from-a-config-map", "border-pile.json", replicas=2)
        kubectl("create", "configmap", "pile", f"--from-file=world.json={self.world.file}")
        self.addCleanup(kubectl, "delete", "configmap", "pile")
        del self.world.object["spec"]["world"]
        self.world.object["spec"]["worldFrom"] = {"configMap": "pile", "key": "world.json"}
        self.world.start()
        self.addCleanup(self.world.end)

    def test_world_may_be_in_a_config_map(self):
        self.world.runs(2)
        self.assert_exact()
