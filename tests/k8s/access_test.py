"""What the control plane's service account may do, by its own token, and what it may not."""

import base64
import json
import ssl
import urllib.error
import urllib.request

from cluster import SOURCE, SPACE, ClusterTest, apply, kubectl

ELSEWHERE = "default"


def collection(group, resource, space=SPACE):
    return f"{'/api/v1' if group == 'v1' else '/apis/' + group}/namespaces/{space}/{resource}"


PODS, LEASES = collection("v1", "pods"), collection("coordination.k8s.io/v1", "leases")
WORLDS, EVENTS = collection("aureole.dev/v1alpha1", "worlds"), collection("v1", "events")
CONFIG_MAPS, CLAIMS = collection("v1", "configmaps"), collection("v1", "persistentvolumeclaims")
MERGE = "application/merge-patch+json"


def named(kind, name, **fields):
    return {"apiVersion": "v1", "kind": kind, "metadata": {"name": name}, **fields}


POD = named("Pod", "access", spec={"restartPolicy": "Never", "containers": [{"name": "c", "image": "localhost/nothing:1",
                                                                             "imagePullPolicy": "Never"}]})
LEASE = {**named("Lease", "aureole-control"), "apiVersion": "coordination.k8s.io/v1"}
CLAIM = named("PersistentVolumeClaim", "access", spec={"accessModes": ["ReadWriteOnce"],
                                                       "resources": {"requests": {"storage": "1Mi"}}})
EVENT = named("Event", "access", involvedObject={"kind": "World", "namespace": SPACE, "name": "access"}, reason="Access",
              message="may be written", type="Normal")
WORLD = {"apiVersion": "aureole.dev/v1alpha1", "kind": "World", "metadata": {"name": "access"},
         "spec": {"worldFrom": {"configMap": "access", "key": "world.json"}, "storage": {"emptyDir": {}}}}

# What it needs, in an order that works: each must succeed, or find what is there already (409); a Pod that has not
# started has no log yet (400).
NEEDED = [
    ("GET", WORLDS, None), ("GET", WORLDS + "?watch=1&timeoutSeconds=1", None), ("GET", WORLDS + "/access", None),
    ("PATCH", WORLDS + "/access/status", {"status": {"phase": "Pending"}}),
    ("PATCH", WORLDS + "/access/scale", {"spec": {"replicas": 2}}),
    ("GET", CONFIG_MAPS + "/access", None),
    ("GET", collection("v1", "services") + "/aureole-control", None),
    ("POST", CLAIMS, CLAIM), ("GET", CLAIMS + "/access", None),
    ("POST", PODS, POD), ("GET", PODS + "?labelSelector=a%3Db", None), ("GET", PODS + "?watch=1&timeoutSeconds=1", None),
    ("GET", PODS + "/access", None), ("PATCH", PODS + "/access", {"metadata": {"labels": {"aureole.dev/role": "none"}}}),
    ("GET", PODS + "/access/log", None),
    ("DELETE", PODS + "/access", None),
    ("POST", EVENTS, EVENT), ("PATCH", EVENTS + "/access", {"count": 2}),
    ("POST", LEASES, LEASE), ("GET", LEASES + "/aureole-control", None),
]

OTHER_LEASE = {**LEASE, "metadata": {"name": "other"}}
# What it must not do, and would be worth something to a thief of its token.
REFUSED = [
    ("GET", collection("v1", "secrets"), None), ("GET", collection("v1", "secrets") + "/aureole-tls", None),
    ("POST", collection("v1", "secrets"), named("Secret", "access")),
    ("GET", "/api/v1/nodes", None), ("GET", "/api/v1/namespaces", None), ("GET", "/api/v1/persistentvolumes", None),
    ("GET", "/api/v1/pods", None), ("GET", "/apis/aureole.dev/v1alpha1/worlds", None),
    ("GET", collection("v1", "pods", ELSEWHERE), None), ("POST", collection("v1", "pods", ELSEWHERE), POD),
    ("GET", collection("v1", "configmaps", ELSEWHERE) + "/kube-root-ca.crt", None),
    ("GET", collection("aureole.dev/v1alpha1", "worlds", ELSEWHERE), None),
    ("GET", collection("coordination.k8s.io/v1", "leases", "kube-system"), None),
    ("POST", WORLDS, {**WORLD, "metadata": {"name": "mine"}}), ("DELETE", WORLDS + "/access", None),
    ("PATCH", WORLDS + "/access", {"spec": {"replicas": 3}}),
    ("POST", PODS + "/access/exec?command=sh", None), ("POST", PODS + "/access/eviction", None),
    ("DELETE", PODS, None),
    ("GET", CONFIG_MAPS, None), ("PATCH", CONFIG_MAPS + "/access", {"data": {"a": "b"}}),
    ("DELETE", CLAIMS + "/access", None), ("GET", EVENTS, None),
    ("GET", LEASES, None), ("GET", LEASES + "/other", None), ("DELETE", LEASES + "/aureole-control", None),
    ("PUT", LEASES + "/other", OTHER_LEASE),
    ("GET", collection("v1", "services"), None), ("PATCH", collection("v1", "services") + "/aureole-control", {}),
    ("GET", collection("apps/v1", "deployments"), None),
    ("GET", collection("rbac.authorization.k8s.io/v1", "roles"), None),
    ("POST", collection("rbac.authorization.k8s.io/v1", "rolebindings"),
     {**named("RoleBinding", "mine", roleRef={"apiGroup": "rbac.authorization.k8s.io", "kind": "ClusterRole", "name": "admin"}),
      "apiVersion": "rbac.authorization.k8s.io/v1"}),
    ("POST", collection("v1", "serviceaccounts") + "/aureole-control/token",
     {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": {"audiences": []}}),
]


class Access(ClusterTest):
    @classmethod
    def setUpClass(cls):
        kubectl("apply", "-k", SOURCE / "k8s/overlays/local")
        kubectl("wait", "--for=condition=Established", "--timeout=30s", "crd/worlds.aureole.dev", space=None)
        # Nobody acts on it: the name of its ConfigMap is that of no world.
        apply(WORLD, named("ConfigMap", "access", data={"world.json": "{}"}))
        request = {"apiVersion": "authentication.k8s.io/v1", "kind": "TokenRequest", "spec": {"audiences": []}}
        answer = kubectl("create", "--raw", collection("v1", "serviceaccounts") + "/aureole-control/token", "-f", "-",
                         stdin=json.dumps(request))
        cls.token = json.loads(answer)["status"]["token"]
        (context,) = json.loads(kubectl("config", "view", "--raw", "--minify", "--flatten", "-o", "json", space=None))["clusters"]
        cls.server = context["cluster"]["server"]
        authority = context["cluster"]["certificate-authority-data"]
        cls.tls = ssl.create_default_context(cadata=base64.b64decode(authority).decode())

    @classmethod
    def tearDownClass(cls):
        for kind in ("world", "configmap", "pvc", "event", "pod"):
            kubectl("delete", kind, "access", "--ignore-not-found", "--wait=false")

    def ask(self, method, path, body, token=None):
        headers = {"Authorization": f"Bearer {token or self.token}",
                   "Content-Type": MERGE if method == "PATCH" else "application/json"}
        request = urllib.request.Request(self.server + path, method=method, headers=headers,
                                         data=None if body is None else json.dumps(body).encode())
        try:
            with urllib.request.urlopen(request, context=self.tls, timeout=20) as answer:
                return answer.status, answer.read()
        except urllib.error.HTTPError as e:
            return e.code, e.read()

    def test_everything_that_the_control_plane_needs_is_allowed(self):
        for method, path, body in NEEDED:
            with self.subTest(f"{method} {path}"):
                code, text = self.ask(method, path, body)
                self.assertTrue(200 <= code < 300 or code in (400, 409), f"{code}: {text[:300]}")
        self.measure("requests allowed", len(NEEDED), unit="")

    def test_lease_and_pod_of_the_leader_may_be_written(self):
        self.ask("POST", LEASES, LEASE)
        code, text = self.ask("GET", LEASES + "/aureole-control", None)
        self.assertEqual(code, 200)
        stale = json.loads(text)
        stale["metadata"]["resourceVersion"] = "1"  # a conflict: it is allowed, and takes nothing from the real leader
        self.assertEqual(self.ask("PUT", LEASES + "/aureole-control", stale)[0], 409)
        pod = json.loads(kubectl("get", "pods", "-l", "app.kubernetes.io/name=aureole-control", "-o", "json"))["items"][0]
        self.assertEqual(self.ask("PATCH", f"{PODS}/{pod['metadata']['name']}", {"metadata": {"annotations": {"seen": "1"}}})[0], 200)

    def test_everything_else_is_refused(self):
        for method, path, body in REFUSED:
            with self.subTest(f"{method} {path}"):
                code, text = self.ask(method, path, body)
                self.assertEqual(code, 403, text[:300])
        self.measure("requests refused (403)", len(REFUSED), unit="")

    def test_a_wrong_token_is_nobody(self):
        self.assertEqual(self.ask("GET", PODS, None, token="wrong")[0], 401)

    def test_region_servers_have_no_token_at_all(self):
        # They run as the default account of the namespace, which may do nothing.
        answer = kubectl("auth", "can-i", "--list", f"--as=system:serviceaccount:{SPACE}:default")
        self.assertNotIn("pods", answer)
        self.assertNotIn("worlds", answer)
