"""The container's files agree with the repository: what they copy exists, what they set is a setting, ports are the defaults."""

import re
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from ddakf.kernels import cache

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILE = (ROOT / "docker/Dockerfile").read_text(encoding="utf-8")
INSTALL = (ROOT / "docker/install").read_text(encoding="utf-8")
COMPOSE = ROOT / "docker/compose.yaml"
DOCUMENT = (ROOT / "docs/container.md").read_text(encoding="utf-8")
# Variables of compose, of the library and of the tools, which the service does not read as settings
OTHERS = {f"DDAKF_{name}" for name in ("CONFIG", "KERNEL_CACHE", "COMPILED_KERNELS", "PUBLISH", "BUILD", "API_KEY", "IMAGE",
                                       "IMAGES", "MEMORY_LIMIT", "RAY_IMAGE", "DOMAIN", "GRPC", "HTTP")}  # fmt: skip


def _ignored(path: str) -> bool:
    """Whether .dockerignore keeps a path out of the build; the last pattern that matches it or a parent decides."""
    ignored = False
    parents = [path, *map(str, Path(path).parents)]
    for line in (ROOT / ".dockerignore").read_text(encoding="utf-8").splitlines():
        pattern = line.strip().removeprefix("!").removeprefix("**/")
        if pattern and not line.startswith("#") and any(fnmatch(parent, pattern) for parent in parents):
            ignored = not line.startswith("!")
    return ignored


def _settings() -> dict:
    return pytest.importorskip("ddakf_service.settings").Settings.model_fields


def test_what_is_installed_reaches_the_build():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
    places = [*project["tool"]["uv"]["workspace"]["members"], *project["tool"]["setuptools"]["package-dir"].values()]
    for path in (*places, "pyproject.toml", "uv.lock", "setup.py", "README.md", "LICENSE"):
        assert not _ignored(path), path
    for path in (".git", ".venv", "tests", "out"):
        assert _ignored(path), path


def test_the_files_of_the_build_exist():
    named = set(re.findall(r"/src/([\w/.-]+)", DOCKERFILE + INSTALL))
    assert {"docker/install", "docker/rootfs", "docker/healthy"} <= named
    for path in named:
        assert (ROOT / path).is_file(), path
        assert not _ignored(path), path


def test_every_extra_that_the_image_installs_exists():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]["optional-dependencies"]
    assert set(re.findall(r"--extra (\w+)", INSTALL)) == {"service", "postgres", "tracing"} <= set(extras)


def test_exposed_ports_are_the_defaults():
    defaults = {str(_settings()[name].default) for name in ("grpc_port", "http_port")}
    assert set(re.search(r"^EXPOSE (.*)$", DOCKERFILE, re.MULTILINE)[1].split()) == defaults
    assert defaults <= set(re.findall(r":(\d+):\1", COMPOSE.read_text(encoding="utf-8")))


def test_variables_are_settings():
    known = {f"DDAKF_{name.upper()}" for name in _settings()} | OTHERS
    for text in (DOCKERFILE, INSTALL, COMPOSE.read_text(encoding="utf-8"), DOCUMENT):
        assert set(re.findall(r"DDAKF_[A-Z_]*[A-Z]", text)) <= known


def test_the_levels_of_the_kernels_are_known():
    levels = re.search(r'^ARG KERNEL_CPUS="(.*)"$', DOCKERFILE, re.MULTILINE)[1].split()
    assert levels == [name for name in reversed(cache.LEVELS) if name != "generic"]
    assert cache.COMPILED in DOCKERFILE


def test_compose_is_well_formed():
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    services = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]
    service = services["ddakf"]
    assert (COMPOSE.parent / service["build"]["context"] / service["build"]["dockerfile"]).is_file()
    assert service["read_only"]
    assert "/var/lib/ddakf" in {volume.partition(":")[2] for volume in service["volumes"]}
    assert {profile for other in services.values() for profile in other.get("profiles", ())} == {"postgres", "ray", "tls"}
    for name, other in services.items():
        for volume in other.get("volumes", ()):
            source = volume.partition(":")[0]
            assert not source.startswith(".") or (COMPOSE.parent / source).is_dir(), f"{name}: {source}"


def test_the_gateway_of_compose_shares_what_its_ray_node_needs():
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    services = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]
    head, worker, gateway = (services[f"ray-{name}"] for name in ("head", "worker", "gateway"))
    assert {gateway[name] for name in ("network_mode", "pid", "ipc")} == {"service:ray-head"}
    assert "ray:/tmp/ray" in set(head["volumes"]) & set(gateway["volumes"])
    assert "ports" not in gateway
    environments = [head["environment"], worker["environment"], gateway["environment"]]
    assert all(own["RAY_AUTH_MODE"] == "token" and own["RAY_AUTH_TOKEN"] == "${RAY_AUTH_TOKEN:-}" for own in environments)
    assert {port.rpartition("}:")[2] for port in head["ports"]} == {"7701:7701", "7702:7702"}
    assert len({service["image"] for service in (head, worker, gateway)}) == 1
    environment = gateway["environment"]
    assert environment["DDAKF_WORKER_KIND"] == "ray"
    assert f"--address={environment['DDAKF_RAY_ADDRESS']}" in worker["command"]
    processors = int(next(part for part in worker["command"] if "num-cpus" in part).rpartition("=")[2])
    actors = int(environment["DDAKF_WORKERS"]) + int(environment["DDAKF_SPARE_WORKERS"])
    assert "--num-cpus=0" in head["command"]
    assert processors * worker["deploy"]["replicas"] >= actors


def test_the_database_of_compose_is_that_of_its_url():
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    services = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]
    lines = (ROOT / "docker/postgres.env").read_text().splitlines()
    variables = dict(line.split("=", 1) for line in lines if not line.startswith("#"))
    url = urlsplit(variables["DDAKF_DATABASE_URL"])
    database = services["postgres"]["environment"]
    assert (url.username, url.path[1:]) == (database["POSTGRES_USER"], database["POSTGRES_DB"])
    assert url.password == variables["POSTGRES_PASSWORD"]
    assert url.hostname == "postgres"
    assert variables["COMPOSE_PROFILES"] == services["postgres"]["profiles"][0]
    assert services["ddakf"]["environment"]["DDAKF_DATABASE_URL"] == "${DDAKF_DATABASE_URL:-}"


def test_the_sessions_of_the_workers_fit_the_limit_of_memory_of_compose():
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    services = yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"]
    own, most, spare = services["ddakf"], 4, _settings()["spare_workers"].default  # DDAKF_WORKERS is at most 4 by default
    default = lambda text: re.fullmatch(r"\$\{\w+:-(\d+)(g?)\}", text).groups()  # noqa: E731
    limit, unit = default(own["mem_limit"])
    memory, recycle = (int(default(own["environment"][f"DDAKF_{name}_MEMORY_BYTES"])[0]) for name in ("MAX", "RECYCLE"))
    assert unit == "g"
    assert most * memory < int(limit) << 30
    assert (most + spare + 1) * recycle + (3 << 29) < int(limit) << 30  # one of low priority, and the network process
    assert {service["mem_limit"] for name, service in services.items() if name.startswith("ray-")} == {own["mem_limit"]}


def test_containers_that_run_on_keep_little_of_their_logs():
    yaml = pytest.importorskip("yaml", reason="PyYAML is not installed")
    for name, service in yaml.safe_load(COMPOSE.read_text(encoding="utf-8"))["services"].items():
        assert service["logging"]["options"] == {"max-size": "20m", "max-file": "5"}, name


def test_variables_of_compose_come_from_the_file_that_each_command_reads():
    """A command with variables of its own would leave the next one without them, and with another database."""
    documents = [*(ROOT / "docs").glob("*.md"), ROOT / "README.md", COMPOSE, ROOT / "docker/postgres.env"]
    for document in documents:
        assert not re.search(r"--env-file|--profile (postgres|tls)|\w=\S* docker compose", document.read_text(encoding="utf-8"))
    assert "/.env" in (ROOT / "docs/deployment.md").read_text(encoding="utf-8")
    assert (ROOT / "docker/.gitignore").read_text() == ".env\n"


@pytest.mark.slow
@pytest.mark.parametrize("path", ["docker/compose.yaml", ".github/workflows/ci.yaml", ".github/workflows/release.yaml",
                                  "CITATION.cff"])  # fmt: skip
def test_a_file_has_the_form_of_its_schema(path):
    pytest.importorskip("check_jsonschema", reason="check-jsonschema is not installed")
    schema = {"compose.yaml": "vendor.compose-spec", "CITATION.cff": "vendor.citation-file-format"}.get(Path(path).name)
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", schema or "vendor.github-workflows", ROOT / path]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=250, check=False)
    assert ended.returncode == 0, ended.stdout + ended.stderr


def test_a_release_tries_and_pushes_every_variant_of_the_image():
    variants = re.search(r"build \[(.*)\]", (ROOT / "docker/build").read_text())[1].split("|")
    release = (ROOT / ".github/workflows/release.yaml").read_text()
    for suffix in ("" if variant == "full" else f"-{variant}" for variant in variants):
        assert f"make image{suffix}-test\n" in release
        assert f'"$version{suffix}"' in release


def test_workflows_and_hooks_call_what_exists():
    targets = set(re.findall(r"^([a-z\d-]+(?: [a-z\d-]+)*):", (ROOT / "Makefile").read_text(), re.M))
    targets = {name for names in targets for name in names.split()}
    for path in (*(ROOT / ".github/workflows").glob("*.yaml"), ROOT / ".pre-commit-config.yaml"):
        text = path.read_text()
        assert set(re.findall(r"\bmake ([a-z\d-]+)", text)) <= targets, path.name
        for script in re.findall(r"\.venv/bin/python ([\w/.]+)", text):
            assert (ROOT / script).is_file(), path.name
