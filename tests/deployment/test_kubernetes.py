"""Kubernetes manifests: every overlay renders, has the form of the API, and agrees with service, image and document."""

from __future__ import annotations

import copy
import functools
import json
import os
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml
from ddakf_service.sessions.service import _LAST_CHECKPOINTS_TIMEOUT
from ddakf_service.settings import ENV_PREFIX, Settings

from ddakf.commands import cli

from .conftest import ROOT, program
from .test_monitoring import exposed

FOLDER = ROOT / "docker/kubernetes"
OVERLAYS = sorted(path.name for path in (FOLDER / "overlays").iterdir())
DOCUMENT = (ROOT / "docs/kubernetes.md").read_text(encoding="utf-8")
DOCKERFILE = (ROOT / "docker/Dockerfile").read_text(encoding="utf-8")
ISOLATED = 1  # worker of low priority, for sessions whose frames exceed their limit
NETWORK_PROCESS = 3 << 29  # bytes, of the sessions of four workers (docs/operations.md, memory), and of the template
OLDEST = "1.30"  # the first with a sleep before SIGTERM
SECRET, RAY_SECRET = "ddakf-storage", "ddakf-ray"  # made by hand
PORTS = {name: Settings.model_fields[f"{name}_port"].default for name in ("grpc", "http")}
RESTORE = yaml.safe_load((FOLDER / "restore.yaml").read_text(encoding="utf-8"))
UNITS = {"Mi": 1 << 20, "Gi": 1 << 30}


def settings_of(text: str) -> dict[str, str]:
    """The variables of a file for the environment."""
    return dict(line.split("=", 1) for line in text.splitlines() if line and not line.startswith("#"))


EXAMPLE = settings_of((FOLDER / "overlays/shared/storage.env.example").read_text(encoding="utf-8"))


class Rendered:
    """The objects of an overlay."""

    def __init__(self, text: str):
        self.objects: list[dict] = list(yaml.safe_load_all(text))

    def of(self, kind: str) -> list[dict]:
        return [item for item in self.objects if item["kind"] == kind]

    def one(self, kind: str, name: str = "ddakf") -> dict:
        (found,) = (item for item in self.of(kind) if item["metadata"]["name"] == name)
        return found

    @property
    def gateway(self) -> dict:
        """The gateways' pod."""
        return self.one("StatefulSet")["spec"]["template"]

    @property
    def container(self) -> dict:
        (found,) = self.gateway["spec"]["containers"]
        return found

    @property
    def variables(self) -> dict[str, str]:
        """What the service finds in its environment, with the example of the Secret."""
        found = {}
        for source in self.container["envFrom"]:
            if "secretRef" in source:
                found |= EXAMPLE
            else:
                found |= self.one("ConfigMap", source["configMapRef"]["name"])["data"]
        return found | {entry["name"]: entry["value"] for entry in self.container["env"] if "value" in entry}

    @property
    def settings(self) -> Settings:
        own = {name: value for name, value in self.variables.items() if name.startswith(ENV_PREFIX)}
        values = {name.removeprefix(ENV_PREFIX).lower(): value for name, value in own.items()}
        return Settings(**values | {"gateway_address": values.get("gateway_address", "").replace("$(", "").replace(")", "")})

    def ray_groups(self) -> Iterator[tuple[str, dict]]:
        """Groups of Ray's nodes by name."""
        for cluster in self.of("RayCluster"):
            yield "headgroup", cluster["spec"]["headGroupSpec"]
            for group in cluster["spec"]["workerGroupSpecs"]:
                yield group["groupName"], group

    def pods(self) -> Iterator[tuple[dict[str, str], dict]]:
        """Labels and contents of all pods; those of Ray with the labels that KubeRay adds."""
        yield self.gateway["metadata"]["labels"], self.gateway["spec"]
        for name, group in self.ray_groups():
            (cluster,) = self.of("RayCluster")
            yield {"ray.io/cluster": cluster["metadata"]["name"], "ray.io/group": name}, group["template"]["spec"]


@functools.cache
def kubectl() -> str:
    """The path of kubectl; the test skips where it is missing, or older than the clusters that the manifests are for."""
    found = program("kubectl", "kubernetes-client")
    about = subprocess.run([found, "version", "--client", "--output=json"], capture_output=True, timeout=60, check=True)
    version = json.loads(about.stdout)["clientVersion"]["gitVersion"]
    if tuple(map(int, re.match(r"v(\d+)\.(\d+)", version).groups())) < tuple(map(int, OLDEST.split("."))):
        pytest.skip(f"kubectl {version} does not read the manifests: {OLDEST} or newer does")
    return found


@functools.cache
def rendered(overlay: str) -> Rendered:
    command = [kubectl(), "kustomize", FOLDER / "overlays" / overlay]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert ended.returncode == 0, ended.stderr
    assert not ended.stderr  # deprecated fields
    return Rendered(ended.stdout)


@pytest.fixture(params=OVERLAYS)
def overlay(request) -> Rendered:
    return rendered(request.param)


@functools.cache
def validator():
    reason = "kubernetes-validate is not installed: pip install 'ddakf[kubernetes-tests]'"
    return pytest.importorskip("kubernetes_validate", reason=reason)


def containers(pod: dict) -> list[dict]:
    return [*pod["containers"], *pod.get("initContainers", ())]


def bytes_of(quantity: str) -> int:
    return int(quantity[:-2]) * UNITS[quantity[-2:]]


@pytest.mark.parametrize("version", [OLDEST, "newest"])
def test_every_object_has_the_form_of_the_api(overlay, version):
    kubernetes = validator()
    number = kubernetes.latest_version() if version == "newest" else version
    for item in (*overlay.objects, RESTORE):
        if item["kind"] != "RayCluster":
            kubernetes.validate(item, number, strict=True)
    for name, group in overlay.ray_groups():
        pod = {"apiVersion": "v1", "kind": "PodTemplate", "metadata": {"name": name}, "template": group["template"]}
        kubernetes.validate(pod, number, strict=True)


def test_a_misspelled_field_has_not_the_form():
    kubernetes = validator()
    wrong = copy.deepcopy(rendered("single").one("StatefulSet"))
    wrong["spec"]["template"]["spec"]["containers"][0]["readynessProbe"] = {}
    with pytest.raises(kubernetes.ValidationError):
        kubernetes.validate(wrong, OLDEST, strict=True)


def test_every_variable_is_a_setting_with_a_valid_value(overlay):
    known = {f"{ENV_PREFIX}{name.upper()}" for name in Settings.model_fields}
    assert {name for name in overlay.variables if name.startswith(ENV_PREFIX)} <= known
    assert overlay.settings
    assert overlay.gateway["spec"]["enableServiceLinks"] is False  # DDAKF_PORT and others of the Service ddakf


def test_the_example_of_the_secret_has_variables_of_the_service_and_of_the_store():
    assert {name for name in EXAMPLE if not name.startswith("FSSPEC_S3_")} == {"DDAKF_DATABASE_URL", "DDAKF_CHECKPOINT_URL"}
    assert SECRET in DOCUMENT


def test_a_variable_names_only_those_before_it(overlay):
    for _, pod in overlay.pods():
        for container in containers(pod):
            before: set[str] = set()
            for entry in container.get("env", ()):
                assert set(re.findall(r"\$\((\w+)\)", entry.get("value", ""))) <= before
                before.add(entry["name"])


def test_what_an_object_names_is_there(overlay):
    names = {kind: {item["metadata"]["name"] for item in overlay.of(kind)} for kind in ("ConfigMap", "ServiceAccount")}
    for _, pod in overlay.pods():
        assert pod["serviceAccountName"] in names["ServiceAccount"]
        assert pod["automountServiceAccountToken"] is False
        volumes = {volume["name"] for volume in pod.get("volumes", ())}
        volumes |= {claim["metadata"]["name"] for claim in overlay.one("StatefulSet")["spec"].get("volumeClaimTemplates", ())}
        for container in containers(pod):
            assert {mount["name"] for mount in container["volumeMounts"]} <= volumes
            for source in container.get("envFrom", ()):
                (kind, reference), *_ = source.items()
                assert reference["name"] in (names["ConfigMap"] if kind == "configMapRef" else {SECRET})
    assert all(account["automountServiceAccountToken"] is False for account in overlay.of("ServiceAccount"))


def test_ports_are_those_of_the_service(overlay):
    ports = {port["name"]: port["containerPort"] for port in overlay.container["ports"]}
    assert ports == PORTS
    for service in overlay.of("Service"):
        assert {port["targetPort"]: port["port"] for port in service["spec"]["ports"]} == PORTS


def test_probes_ask_what_the_service_answers(overlay):
    routes = "".join(path.read_text() for path in (ROOT / "service/ddakf_service/transports/rest").glob("*.py"))
    container = overlay.container
    probes = {kind: container[f"{kind}Probe"]["httpGet"] for kind in ("startup", "liveness", "readiness")}
    for probe in probes.values():
        assert probe["port"] == "http"
        assert f'@app.get("{probe["path"]}"' in routes
    assert (probes["liveness"]["path"], probes["readiness"]["path"]) == ("/healthz", "/readyz")


def test_pods_are_restricted_and_have_the_user_of_the_image(overlay):
    users = set(re.findall(r"^USER (\d+):(\d+)$", DOCKERFILE, re.MULTILINE))
    ((user, group),) = users
    for _, pod in overlay.pods():
        context = pod["securityContext"]
        assert (context["runAsUser"], context["runAsGroup"], context["fsGroup"]) == (int(user), int(group), int(group))
        assert context["runAsNonRoot"]
        assert context["seccompProfile"] == {"type": "RuntimeDefault"}
        for container in containers(pod):
            assert container["securityContext"] == {
                "allowPrivilegeEscalation": False, "readOnlyRootFilesystem": True, "capabilities": {"drop": ["ALL"]}
            }  # fmt: skip
            resources = container["resources"]
            assert {"cpu", "memory"} <= set(resources["requests"])
            assert bytes_of(resources["requests"]["memory"]) <= bytes_of(resources["limits"]["memory"])
            assert "/tmp" in {mount["mountPath"] for mount in container["volumeMounts"]}


def test_the_pod_is_given_the_time_of_a_drain(overlay):
    before = overlay.container["lifecycle"]["preStop"]["sleep"]["seconds"]
    needed = before + overlay.settings.drain_grace + _LAST_CHECKPOINTS_TIMEOUT
    assert overlay.gateway["spec"]["terminationGracePeriodSeconds"] >= needed + 10


def test_selectors_match_pods(overlay):
    labels = [pod for pod, _ in overlay.pods()]
    gateway = overlay.one("StatefulSet")["spec"]
    own = gateway["selector"]["matchLabels"]
    selectors = [own, *(service["spec"]["selector"] for service in overlay.of("Service"))]
    assert all(selector == own for selector in selectors)
    assert own.items() <= gateway["template"]["metadata"]["labels"].items()
    budget = overlay.one("PodDisruptionBudget")["spec"]["selector"]["matchLabels"]
    policy = overlay.one("NetworkPolicy")["spec"]["podSelector"]["matchLabels"]
    assert budget == policy == own
    others = [item["spec"]["selector"]["matchLabels"] for item in overlay.of("PodDisruptionBudget")]
    for item in overlay.of("NetworkPolicy"):
        spec = item["spec"]
        peers = [peer for rule in [*spec["ingress"], *spec["egress"]] for peer in [*rule.get("from", ()), *rule.get("to", ())]]
        others += [spec["podSelector"]["matchLabels"], *(p["podSelector"]["matchLabels"] for p in peers if "podSelector" in p)]
    for pod_labels, pod in overlay.pods():
        for spread in pod.get("topologySpreadConstraints", ()):
            assert spread["labelSelector"]["matchLabels"].items() <= pod_labels.items()
    assert all(any(selector.items() <= pod.items() for pod in labels) for selector in others)


def test_each_gateway_has_a_name_and_an_address_of_its_own(overlay):
    headless = overlay.one("StatefulSet")["spec"]["serviceName"]
    assert overlay.one("Service", headless)["spec"]["clusterIP"] == "None"
    assert overlay.variables["DDAKF_SERVER_ID"] == "$(POD_NAME)"
    if overlay.settings.share_sessions:
        place = f"$(POD_NAME).{headless}.$(POD_NAMESPACE).svc.cluster.local:{PORTS['grpc']}"
        assert overlay.variables["DDAKF_GATEWAY_ADDRESS"] == place


def test_the_data_lies_in_a_volume(overlay):
    data = next(mount["mountPath"] for mount in overlay.container["volumeMounts"] if mount["name"] == "data")
    assert Path(overlay.settings.data_dir).is_relative_to(data)
    claims = [claim["metadata"]["name"] for claim in overlay.one("StatefulSet")["spec"].get("volumeClaimTemplates", ())]
    assert claims == ([] if overlay.settings.share_sessions else ["data"])


def test_one_pod_without_shared_sessions_and_a_scaled_set_with_them(overlay):
    scalers, replicas = overlay.of("HorizontalPodAutoscaler"), overlay.one("StatefulSet")["spec"].get("replicas")
    if not overlay.settings.share_sessions:
        assert (scalers, replicas) == ([], 1)
        return
    (scaler,) = (item["spec"] for item in scalers)
    target = overlay.one("StatefulSet")
    assert scaler["scaleTargetRef"] == {"kind": "StatefulSet", "name": "ddakf", "apiVersion": target["apiVersion"]}
    assert replicas is None  # an apply would undo the autoscaler's number
    assert scaler["minReplicas"] >= 2
    (metric,) = scaler["metrics"]
    assert metric["pods"]["metric"]["name"] in exposed()
    assert int(metric["pods"]["target"]["averageValue"]) == overlay.settings.workers


def test_the_rule_of_the_document_gives_the_autoscaler_its_metric():
    (rule,) = yaml.safe_load(re.search(r"```yaml\n(rules:\n.*?)```", DOCUMENT, re.DOTALL)[1])["rules"]
    (metric,) = rendered("shared").one("HorizontalPodAutoscaler")["spec"]["metrics"]
    assert metric["type"] == "Pods"
    assert rule["seriesQuery"].partition("{")[0] == metric["pods"]["metric"]["name"]
    assert set(rule["resources"]["overrides"]) == {"namespace", "pod"}


def test_the_sessions_of_local_workers_fit_the_limit_of_memory(overlay):
    settings = overlay.settings
    if settings.worker_kind == "local":
        limit = bytes_of(overlay.container["resources"]["limits"]["memory"])
        assert settings.workers * settings.max_memory_bytes < limit
        most = settings.workers + settings.spare_workers + ISOLATED
        assert most * settings.recycle_memory_bytes + NETWORK_PROCESS < limit
        assert int(overlay.container["resources"]["requests"]["cpu"]) > settings.workers  # and the network process


def test_the_ray_cluster_has_the_form_that_kuberay_reads():
    cluster = rendered("ray").one("RayCluster", "ddakf-ray")
    assert cluster["apiVersion"] == "ray.io/v1"
    spec = cluster["spec"]
    assert set(spec) == {"rayVersion", "enableInTreeAutoscaling", "headGroupSpec", "workerGroupSpecs"}
    assert set(spec["headGroupSpec"]) == {"serviceType", "rayStartParams", "template"}
    for group in spec["workerGroupSpecs"]:
        assert set(group) == {"groupName", "replicas", "minReplicas", "maxReplicas", "rayStartParams", "template"}
        assert group["minReplicas"] <= group["replicas"] <= group["maxReplicas"]
    for _, group in rendered("ray").ray_groups():
        assert all(isinstance(value, str) for value in group["rayStartParams"].values())
    locked = tomllib.loads((ROOT / "uv.lock").read_text(encoding="utf-8"))["package"]
    assert spec["rayVersion"] == next(package["version"] for package in locked if package["name"] == "ray")


def test_rays_nodes_have_a_processor_for_each_worker_of_the_most_gateways():
    overlay = rendered("ray")
    settings, groups = overlay.settings, dict(overlay.ray_groups())
    gateways = overlay.one("HorizontalPodAutoscaler")["spec"]["maxReplicas"]
    trackers = groups["trackers"]
    (container,) = trackers["template"]["spec"]["containers"]
    processors = trackers["rayStartParams"]["num-cpus"]
    assert container["resources"]["requests"]["cpu"] == processors
    assert container["readinessProbe"]["tcpSocket"]["port"] == int(trackers["rayStartParams"]["node-manager-port"])
    assert groups["headgroup"]["rayStartParams"]["num-cpus"] == "0"
    assert int(processors) * trackers["replicas"] >= gateways * (settings.workers + settings.spare_workers + ISOLATED)


def test_a_gateway_has_a_node_of_ray_beside_it():
    overlay = rendered("ray")
    pod, settings = overlay.gateway["spec"], overlay.settings
    (node,) = pod["initContainers"]
    assert settings.worker_kind == "ray"
    (cluster,) = overlay.of("RayCluster")
    assert settings.ray_address == f"{cluster['metadata']['name']}-head-svc:6379"
    assert node["restartPolicy"] == "Always"
    assert {f"--address={settings.ray_address}", "--num-cpus=0", "--block"} <= set(node["command"])
    assert f"--node-manager-port={node['startupProbe']['tcpSocket']['port']}" in node["command"]
    assert pod["shareProcessNamespace"]
    places = [{(m["name"], m["mountPath"]) for m in container["volumeMounts"]} for container in (node, overlay.container)]
    assert RAY_SECRET in DOCUMENT
    for _, pod in overlay.pods():
        for container in containers(pod):
            variables = {entry["name"]: entry for entry in container["env"]}
            assert variables["RAY_AUTH_MODE"]["value"] == "token"
            reference = {"secretKeyRef": {"name": RAY_SECRET, "key": "token"}}
            assert variables["RAY_AUTH_TOKEN"]["valueFrom"] == reference
    assert {"/tmp", "/dev/shm"} <= {path for _, path in places[0] & places[1]}
    assert {container["image"] for _, pod in overlay.pods() for container in containers(pod)} == {"ddakf:ray"}


def test_the_pod_of_a_restore_is_like_that_of_the_server_and_has_its_volume():
    single = rendered("single")
    own, server = RESTORE["spec"], single.gateway["spec"]
    (container,) = own["containers"]
    for name in ("serviceAccountName", "automountServiceAccountToken", "enableServiceLinks", "securityContext"):
        assert own[name] == server[name], name
    for name in ("image", "securityContext", "volumeMounts"):
        assert container[name] == single.container[name], name
    (claim,) = single.one("StatefulSet")["spec"]["volumeClaimTemplates"]
    volumes = {volume["name"]: volume for volume in own["volumes"]}
    assert volumes["data"]["persistentVolumeClaim"] == {"claimName": f"{claim['metadata']['name']}-ddakf-0"}
    assert "labels" not in RESTORE["metadata"], "no Service sends clients there"


def test_the_commands_of_the_document_save_and_restore_a_folder(tmp_path):
    """A folder is the volume, and this machine the cluster."""
    volume = tmp_path / "volume"
    volume.mkdir()
    assert cli.main(["keys", "create", "test", "--scope", "read", "--data-dir", str(volume / "state")]) == 0
    document = (ROOT / "docs/operations-backup.md").read_text(encoding="utf-8").partition("### On Kubernetes")[2]
    lines = [line for line in document.partition("\n## ")[0].splitlines() if line.startswith(("kubectl", "python"))]
    variables = {**os.environ, "DDAKF_DATA_DIR": str(volume / "state"), "PYTHONPATH": os.pathsep.join(sys.path)}
    programs = {"ddakf": f"{sys.executable} -c 'import sys; from ddakf.commands.cli import main; sys.exit(main())'",
                "python": sys.executable}  # fmt: skip
    for line in lines:
        command = line.partition(" -- ")[2] if line.startswith("kubectl") else line
        if command:
            name, _, rest = command.replace("/var/lib/ddakf", str(volume)).partition(" ")
            subprocess.run(["sh", "-c", f"{programs[name]} {rest}"], cwd=tmp_path, env=variables, timeout=120, check=True)
    assert (tmp_path / "backup.tar").read_bytes() == (volume / "backup.tar").read_bytes()
    assert sorted(path.name for path in volume.iterdir()) == ["backup.tar", "before-restore", "state"]
    assert (volume / "state/ddakf.sqlite").is_file()


def test_the_document_has_every_overlay_and_the_images_are_built():
    for name in OVERLAYS:
        assert f"`{name}`" in DOCUMENT
    build = (ROOT / "docker/build").read_text()
    for name in OVERLAYS:
        tag = rendered(name).container["image"].partition(":")[2]
        assert tag == "latest" or re.search(rf"^  {tag}\) ", build, re.MULTILINE)
