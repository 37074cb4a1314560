"""The image: what is in it, and that its programs run as they must in a Pod: no root, nothing to write to, no shell."""

import io
import json
import os
import tarfile
import unittest

from cluster import IMAGE, SOURCE, ClusterTest, apply, get, kubectl, wait_for

LIMIT_MB = 60


def pod(name, command, **security):
    return {"apiVersion": "v1", "kind": "Pod", "metadata": {"name": name},
            "spec": {"restartPolicy": "Never", "automountServiceAccountToken": False,
                     "securityContext": {"runAsNonRoot": True, **security},
                     "containers": [{"name": "c", "image": IMAGE,
                                     "imagePullPolicy": "Never" if IMAGE.startswith("localhost/") else "IfNotPresent",
                                     "command": command, "securityContext": {"readOnlyRootFilesystem": True,
                                                                             "allowPrivilegeEscalation": False,
                                                                             "capabilities": {"drop": ["ALL"]}}}]}}


@unittest.skipUnless("AUREOLE_IMAGE_FILE" in os.environ, "the image is not one that was made here")
class Archive(ClusterTest):
    @classmethod
    def setUpClass(cls):
        with tarfile.open(os.environ["AUREOLE_IMAGE_FILE"]) as outer:
            (cls.manifest,) = json.load(outer.extractfile("manifest.json"))
            cls.config = json.load(outer.extractfile(cls.manifest["Config"]))
            with tarfile.open(fileobj=io.BytesIO(outer.extractfile("layer.tar").read())) as layer:
                cls.files = {m.name.removeprefix("."): m for m in layer.getmembers()}

    def test_it_is_small(self):
        size = os.stat(os.environ["AUREOLE_IMAGE_FILE"]).st_size / 1e6
        self.measure("image", size, LIMIT_MB, " MB")

    def test_it_holds_the_three_programs_and_no_other(self):
        programs = sorted(n for n, m in self.files.items() if m.isfile() and m.mode & 0o111 and "/lib" not in n)
        self.assertEqual(programs, ["/bin/aureole", "/bin/aureole-control", "/bin/aureole-region"])

    def test_it_runs_as_a_user_and_nothing_in_it_is_set_uid(self):
        self.assertEqual(self.config["config"]["User"], "65532:65532")
        self.assertEqual([n for n, m in self.files.items() if m.mode & 0o6000], [])
        writable = sorted(n for n, m in self.files.items() if m.mode & 0o002)
        self.assertEqual(writable, ["/data", "/tmp"])


class Programs(ClusterTest):
    @classmethod
    def setUpClass(cls):
        kubectl("apply", "-k", SOURCE / "k8s/overlays/local")

    def ends(self, name, command, **security):
        kubectl("delete", "pod", name, "--ignore-not-found")
        apply(pod(name, command, **security))
        self.addCleanup(kubectl, "delete", "pod", name, "--wait=false")

        def ended():
            status = get("pod", name)["status"]
            if status["phase"] in ("Succeeded", "Failed"):
                return status["containerStatuses"][0]["state"]["terminated"]
            waiting = (status.get("containerStatuses") or [{}])[0].get("state", {}).get("waiting", {})
            return waiting if "Error" in waiting.get("reason", "") else None

        return wait_for(ended, f"end of pod {name}")

    def test_every_program_starts_without_root_and_without_a_writable_file_system(self):
        for program in ("aureole", "aureole-control", "aureole-region"):
            ended = self.ends(f"image-{program}", [f"/bin/{program}", "--help"])
            self.assertEqual(ended.get("exitCode"), 0, f"{program}: {ended}, {kubectl('logs', f'image-{program}')}")

    def test_there_is_no_shell(self):
        for shell in ("sh", "bash", "busybox"):
            ended = self.ends(f"image-{shell}", [f"/bin/{shell}", "-c", "true"])
            self.assertNotEqual(ended.get("exitCode"), 0)
            self.assertIn("no such file", ended.get("message", ""))

    def test_health_check_of_nobody_fails_by_name(self):
        ended = self.ends("image-health", ["/bin/aureole-region", "--health-check", "127.0.0.1:1"])
        self.assertEqual(ended["exitCode"], 1)
