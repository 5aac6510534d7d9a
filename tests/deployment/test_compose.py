"""Compose runs the file with every profile. `make compose-test` builds the images, and starts an engine where there is none."""

from __future__ import annotations

import os
import re
import secrets
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import yaml
from ddakf_client import Frame, connect

from ddakf import data

from ..service.conftest import eventually
from .conftest import ROOT

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not os.environ.get("DDAKF_COMPOSE"), reason="`make compose-test` makes the images and runs these tests"),
]

GRPC, HTTP = "127.0.0.1:7701", "http://127.0.0.1:7702"
PATIENCE = 180.0  # seconds
DOMAIN = "localhost"
KEY = re.compile(r"^ddakf_\S+$", re.M)


def run(*command: str, **options) -> str:
    ended = subprocess.run(command, capture_output=True, text=True, timeout=600, check=False, **options)
    assert ended.returncode == 0, f"{' '.join(map(str, command))}\n{ended.stdout}{ended.stderr}"
    return ended.stdout


class Project:
    """The services of some profiles, from ``docker compose``, or from version 1 of it without what that does not know.

    Args:
        variables: of the environment, as ``docker/postgres.env`` has them.
    """

    def __init__(self, folder: Path, profiles: tuple[str, ...], variables: dict[str, str]):
        file, self._environment = ROOT / "docker/compose.yaml", {**os.environ, **variables}
        self._compose = ["docker", "compose"]
        if subprocess.run([*self._compose, "version"], capture_output=True, check=False).returncode:
            self._compose = [shutil.which("docker-compose") or pytest.skip("Compose is not installed")]
            file = folder / "compose.yaml"
            file.write_text(of_version_1((ROOT / "docker/compose.yaml").read_text(), profiles, variables))
        self._compose += ["--file", str(file), "--project-directory", str(ROOT / "docker"), "--project-name", "ddakf-test"]
        for profile in profiles:
            self._compose += ["--profile", profile]

    def up(self, *services: str) -> None:
        run(*self._compose, "up", "--detach", "--no-build", *services, env=self._environment)

    def down(self) -> None:
        run(*self._compose, "down", "--volumes", "--timeout", "5", env=self._environment)

    def execute(self, service: str, *command: str) -> str:
        return run("docker", "exec", self.container(service), *command)

    def container(self, service: str, number: int = 1) -> str:
        """The id of a service's container."""
        names = [f"label=com.docker.compose.{name}" for name in
                 ("project=ddakf-test", f"service={service}", f"container-number={number}")]  # fmt: skip
        filters = [part for name in names for part in ("--filter", name)]
        return run("docker", "ps", "--all", "--quiet", *filters).strip()

    def state(self, service: str, field: str) -> str:
        return run("docker", "inspect", "--format", f"{{{{.State.{field}}}}}", self.container(service)).strip()

    def key(self, service: str, scope: str = "stream") -> str:
        return KEY.search(self.execute(service, "ddakf", "keys", "create", f"test-{time.time_ns()}", "--scope", scope))[0]


def of_version_1(text: str, profiles: tuple[str, ...], variables: dict[str, str]) -> str:
    """The file without alternatives of variables, optional dependencies and restarts with them, and without some services."""
    domain = variables.get("DDAKF_DOMAIN")
    origins = "${DDAKF_CORS_ORIGINS:-${DDAKF_DOMAIN:+https://${DDAKF_DOMAIN}}}"
    assert origins in text
    text = text.replace(origins, f"https://{domain}" if domain else '""')
    content = {name: value for name, value in yaml.safe_load(text).items() if name in ("services", "volumes")}
    services = content["services"]
    for name in os.environ.get("DDAKF_COMPOSE_WITHOUT", "").split():
        del services[name]
    for service in services.values():
        needed = service.get("depends_on")
        if isinstance(needed, dict):
            for other, condition in list(needed.items()):
                absent = set(services[other].get("profiles", ())) - set(profiles)
                if not condition.pop("required", True) and absent:
                    del needed[other]
                condition.pop("restart", None)
    return yaml.safe_dump(content)


def project(folder: Path, *profiles: str, up: tuple[str, ...] = (), **variables: str) -> Iterator[Project]:
    """A project that runs."""
    made = Project(folder, profiles, variables)
    try:
        made.up(*up)
        yield made
    finally:
        made.down()


@pytest.fixture(scope="module")
def default(tmp_path_factory) -> Iterator[Project]:
    yield from project(tmp_path_factory.mktemp("default"))


@pytest.fixture(scope="module")
def complete(default, tmp_path_factory) -> Iterator[Project]:
    """With PostgreSQL and TLS, instead of the default."""
    default.down()
    lines = (ROOT / "docker/postgres.env").read_text().splitlines()
    variables = dict(line.split("=", 1) for line in lines if not line.startswith(("#", "COMPOSE_PROFILES")))
    yield from project(tmp_path_factory.mktemp("complete"), "postgres", "tls", DDAKF_DOMAIN=DOMAIN, **variables)


@pytest.fixture(scope="module")
def ray(complete, tmp_path_factory) -> Iterator[Project]:
    """The gateway with Ray actors alone."""
    complete.down()
    yield from project(tmp_path_factory.mktemp("ray"), "ray", up=("ray-gateway",), RAY_AUTH_TOKEN=secrets.token_hex(32))


def doctor(*arguments: str) -> str:
    program = "import sys; from ddakf.commands.cli import main; sys.exit(main())"
    return run(sys.executable, "-c", program, "doctor", *arguments)


def is_ready() -> bool:
    with httpx.Client(base_url=HTTP, timeout=5) as service:
        return answers(service, "/readyz")


def test_the_service_is_healthy_and_tracks(default):
    eventually(lambda: default.state("ddakf", "Health.Status") == "healthy", PATIENCE)
    findings = doctor("--server", GRPC, "--api-key", default.key("ddakf"))
    assert "session      20 frames" in findings
    assert "access       a call without a key is refused" in findings


def test_the_service_is_another_user_and_writes_nothing_but_its_volume(default):
    look = "import os; print(os.getuid(), os.access('/', os.W_OK), os.access('/var/lib/ddakf', os.W_OK))"
    assert default.execute("ddakf", "python", "-c", look).split() == ["10001", "False", "True"]


def test_prometheus_reads_the_metrics_with_its_key_and_evaluates_the_rules(default):
    assert default.state("metrics-key", "ExitCode") == "0"
    with httpx.Client(base_url="http://127.0.0.1:9090/api/v1", timeout=30) as prometheus:

        def up() -> bool:
            found = prometheus.get("/query", params={"query": "up{job='ddakf'}"}).json()["data"]["result"]
            return [series["value"][1] for series in found] == ["1"]

        eventually(up, PATIENCE)
        groups = prometheus.get("/rules").json()["data"]["groups"]
        eventually(lambda: default.state("prometheus", "Health.Status") == "healthy", PATIENCE)
    assert len([rule for group in groups for rule in group["rules"]]) >= 11


@pytest.mark.skipif("grafana" in os.environ.get("DDAKF_COMPOSE_WITHOUT", ""), reason="there is no image of Grafana")
def test_grafana_has_the_dashboards_and_the_source(default):
    with httpx.Client(base_url="http://127.0.0.1:3000/api", auth=("admin", "admin"), timeout=30) as grafana:
        eventually(lambda: answers(grafana, "/health"), PATIENCE)
        titles = {found["title"] for found in grafana.get("/search", params={"type": "dash-db"}).json()}
        assert titles >= {"ddakf: service", "ddakf: tracking"}
        assert [source["url"] for source in grafana.get("/datasources").json()] == ["http://prometheus:9090"]


def answers(client: httpx.Client, path: str) -> bool:
    try:
        return client.get(path).status_code == 200
    except httpx.TransportError:
        return False


def test_a_new_container_has_the_sessions_of_the_volume(default):
    key, sample = default.key("ddakf"), data.sample()
    with connect(GRPC, api_key=key) as client:
        session = client.create_session(sample.template, sample.garment_faces, flow="lossless")
        frames = [Frame(vertices[::2], number / 30) for number, vertices in enumerate(sample.garment_vertices[:20], 1)]
        assert len(list(session.track(frames))) == len(frames)
    run("docker", "stop", "--time", "30", default.container("ddakf"))
    assert default.state("ddakf", "ExitCode") == "0"
    run("docker", "start", default.container("ddakf"))
    eventually(is_ready, PATIENCE)
    with connect(GRPC, api_key=key) as client:
        again = client.open_session(session.session_id)
        assert again.info().last_sequence == len(frames)
        again.delete()


def test_encryption_and_postgresql(complete, tmp_path):
    eventually(lambda: complete.state("ddakf", "Health.Status") == "healthy", PATIENCE)
    authority, key = tmp_path / "root.crt", complete.key("ddakf")

    def has_authority() -> bool:
        copied = ["docker", "cp", f"{complete.container('tls')}:/data/caddy/pki/authorities/local/root.crt", authority]
        return subprocess.run(copied, capture_output=True, check=False).returncode == 0

    eventually(has_authority, PATIENCE)
    here = ["--server", f"{DOMAIN}:443", "--http", f"{DOMAIN}:443", "--tls-ca", str(authority), "--api-key", key]
    assert "session      20 frames" in doctor(*here)
    query = "psql -h 127.0.0.1 -U ddakf -d ddakf -Atc 'SELECT count(*) FROM sessions'"
    assert complete.execute("postgres", "sh", "-c", f"PGPASSWORD=change-me {query}").strip() == "1"


def test_a_stream_outlives_a_ray_node_that_vanishes(ray):
    """Its network ends, and no connection is closed."""
    eventually(is_ready, PATIENCE)
    key = ray.key("ray-gateway", "admin")
    eventually(lambda: "ddakf_workers_spare 2.0" in metrics(key), PATIENCE)
    sample, notices, answered = data.sample(), [], []
    wanted = threading.Event()

    def frames() -> Iterator[Frame]:
        number = 0
        while not wanted.is_set():
            number += 1
            yield Frame(sample.garment_vertices[number % 20][::2], number / 10)
            time.sleep(0.1)

    with connect(GRPC, api_key=key, timeout=PATIENCE) as client:
        session = client.create_session(sample.template, sample.garment_faces, flow="lossless")
        for result in session.track(frames(), on_notice=lambda notice: notices.append(notice.kind)):
            answered.append(result.sequence)
            if len(answered) == 30:
                node = busiest(ray, "ray-worker", 2)
                run("docker", "network", "disconnect", "--force", "ddakf-test_default", node)
            if "resumed" in notices and len(answered) > 60:
                wanted.set()
        session.delete()
    assert answered == list(range(1, len(answered) + 1))
    log = run("docker", "logs", ray.container("ray-gateway"))
    assert "invalid message" not in log


def metrics(key: str) -> str:
    return httpx.get(f"{HTTP}/metrics", headers={"authorization": f"Bearer {key}"}, timeout=30).text


def busiest(project: Project, service: str, count: int) -> str:
    """The container of a service that uses the processor most."""
    containers = [project.container(service, number) for number in range(1, count + 1)]
    look = "import pathlib; print(sum(sum(map(int, p.read_text().rpartition(')')[2].split()[11:13])) " \
           "for p in pathlib.Path('/proc').glob('[0-9]*/stat')))"  # fmt: skip
    used = lambda name: int(run("docker", "exec", name, "python", "-c", look))  # noqa: E731
    before = {name: used(name) for name in containers}
    time.sleep(2.0)
    return max(containers, key=lambda name: used(name) - before[name])
