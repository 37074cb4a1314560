"""The production overlay with a World: certificates and tokens from Secrets, down to the region servers and clients."""

import json
import pathlib
import shutil
import subprocess
import tempfile

from cluster import BIN, IMAGE, KUBECTL, SOURCE, ClusterTest, World, aureole, kubectl, wait_for

SPACE = "aureole-production"


def rendered():
    """The overlay, in a namespace of its own, with the image of these tests and what this API server knows."""
    for program in (KUBECTL, shutil.which("kubectl")):  # the one of 1.20 cannot read it
        if program:
            done = subprocess.run([program, "kustomize", SOURCE / "k8s/overlays/production"], capture_output=True, text=True)
            if done.returncode == 0:
                break
    text = done.stdout.replace("namespace: aureole\n", f"namespace: {SPACE}\n").replace("  name: aureole\n", f"  name: {SPACE}\n")
    text = text.replace("registry.example.com/aureole:latest", IMAGE)
    if "policy/v1\n" not in kubectl("api-versions", space=None) + "\n":
        text = text.replace("policy/v1\n", "policy/v1beta1\n")
    return text


class Production(ClusterTest):
    @classmethod
    def setUpClass(cls):
        directory = tempfile.TemporaryDirectory()
        cls.addClassCleanup(directory.cleanup)
        cls.path = pathlib.Path(directory.name)
        cls.addClassCleanup(kubectl, "delete", "namespace", SPACE, "--wait=false", "--ignore-not-found", space=None)
        kubectl("apply", "-f", "-", stdin=rendered(), space=None)
        aureole("certificates", cls.path)
        token = aureole("token", "anna", "--world", "demo", "--rights", "watch", "--tokens", cls.path / "tokens.json")
        (cls.path / "anna.token").write_text(token)
        files = [f"--from-file={cls.path / name}" for name in ("ca.crt", "tls.crt", "tls.key")]
        kubectl("create", "secret", "generic", "aureole-tls", *files, space=SPACE)
        kubectl("create", "secret", "generic", "aureole-tokens", f"--from-file={cls.path / 'tokens.json'}", space=SPACE)
        kubectl("rollout", "status", "deployment/aureole-control", "--timeout=90s", space=SPACE)

    def status(self):
        return json.loads(kubectl("get", "world", "demo", "-o", "json", space=SPACE)).get("status", {})

    def test_world_runs_with_certificates_and_only_clients_with_a_token_see_it(self):
        world = World("demo", "demo.json", replicas=4)
        self.addCleanup(shutil.rmtree, world.directory or self.path / "none", ignore_errors=True)
        kubectl("apply", "-f", "-", stdin=json.dumps(world.object), space=SPACE)
        self.addCleanup(kubectl, "delete", "world", "demo", "--timeout=60s", space=SPACE)
        wait_for(lambda: self.status().get("phase") == "Running", "a running world")
        server = self.status()["regions"][2]["endpoint"]
        tls, token = ("--tls-ca", self.path / "ca.crt"), ("--token-file", self.path / "anna.token")
        seen = json.loads(aureole("watch", "--server", server, *tls, *token, "--bodies", "--json"))
        self.assertGreater(len(seen["bodies"]), 200)
        for without, reason in (((*tls,), "NO_TOKEN"), ((), "--tls-ca")):
            done = subprocess.run([BIN / "aureole", "watch", "--server", server, *without, "--bodies"], capture_output=True,
                                  text=True, timeout=60)
            self.assertNotEqual(done.returncode, 0)
            self.assertIn(reason, done.stderr)

    def test_control_planes_are_spread_and_have_whole_cores(self):
        found = json.loads(kubectl("get", "pods", "-l", "app.kubernetes.io/name=aureole-control", "-o", "json", space=SPACE))["items"]
        self.assertEqual(len({p["spec"]["nodeName"] for p in found}), 2)
        self.assertEqual({p["status"]["qosClass"] for p in found}, {"Guaranteed"})
