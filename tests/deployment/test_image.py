"""The image runs as it says: own command and user, read-only root, one volume. `make image-test` builds it first."""

from __future__ import annotations

import contextlib
import json
import os
import platform
import re
import signal
import subprocess
import sys
import time
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import httpx
import numpy as np
import pytest
from ddakf_client import Frame, Notice, connect
from ports import lasting_port
from traffic import Usage

from ddakf import data
from ddakf.evaluation.sensors import Sensor
from ddakf.kernels import cache

from .containers import Container, Runtime, await_ready, runtime

IMAGE = os.environ.get("DDAKF_IMAGE", "")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(not IMAGE, reason="DDAKF_IMAGE names no image: `make image-test` builds one and runs these tests"),
]

ROOT = Path(__file__).resolve().parents[2]
VERSION = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
MOST_BYTES = {"full": 600e6, "slim": 400e6, "s3": 500e6, "ray": 900e6}
FIRST_FRAME = 5.0  # processor seconds from the start of the container to the first result
BUSY = 6  # times as many seconds where other programs take the processors
BASELINE = "x86-64-v2" if platform.machine() == "x86_64" else "generic"
TOOLS = {"sh", "bash", "dash", "gcc", "cc", "g++", "clang", "ld", "make", "apt", "dpkg", "node", "npm", "pip", "pip3", "uv"}
FRAMES = 40
SHIRT = data.sample()


class Service(NamedTuple):
    """A container with the service, and its addresses."""

    container: Container
    grpc: str
    http: str


@pytest.fixture(scope="module")
def image(tmp_path_factory) -> Iterator[Runtime]:
    found = runtime(IMAGE, tmp_path_factory.mktemp("containers"))
    yield found
    found.close()


@pytest.fixture(scope="module")
def variant(image) -> str:
    """full, slim, s3 or ray."""
    return image.inspect().config["Labels"]["org.opencontainers.image.ref.name"].rpartition("-")[2]


@pytest.fixture(scope="module")
def clouds() -> list[Frame]:
    camera, rng = Sensor("front"), np.random.default_rng(1)
    captured = [camera.capture(SHIRT, k, rng) for k in range(1, FRAMES + 1)]
    return [Frame(cloud.points, k / 30, cloud.sensor_origin) for k, cloud in enumerate(captured, 1)]


@pytest.fixture
def volume(tmp_path) -> Path:
    folder = tmp_path / "volume"
    folder.mkdir()
    return folder


def start(image: Runtime, volume: Path, grpc: int, http: int, **more: str) -> Service:
    """Runs the image's own command, with more variables."""
    environment = more | {"DDAKF_GRPC_PORT": str(grpc), "DDAKF_HTTP_PORT": str(http), "DDAKF_ALLOW_ANONYMOUS": "true",
                   "DDAKF_SERVER_ID": "image-test", "DDAKF_LOG_FORMAT": "json", "DDAKF_WORKERS": "1"}  # fmt: skip
    return Service(image.run(volume, environment, (grpc, http)), f"127.0.0.1:{grpc}", f"http://127.0.0.1:{http}")


def is_ready(service: Service) -> bool:
    with contextlib.suppress(httpx.TransportError):
        return httpx.get(f"{service.http}/readyz", timeout=5).status_code == 200
    return False


@pytest.fixture
def service(image, volume) -> Iterator[Service]:
    service = start(image, volume, lasting_port(), lasting_port())
    try:
        await_ready(lambda: is_ready(service), service.container, 60)
        yield service
    finally:
        with contextlib.suppress(AssertionError, ProcessLookupError):
            service.container.kill(signal.SIGTERM)
            service.container.wait()


def test_what_the_image_says(image, variant):
    config = image.inspect().config
    labels = {name.removeprefix("org.opencontainers.image."): value for name, value in config["Labels"].items()}
    assert labels["version"] == VERSION
    assert labels["licenses"] == "Apache-2.0"
    assert re.fullmatch(r"[0-9a-f]{12}", labels["revision"])
    assert re.fullmatch(r"20\d\d-\d\d-\d\dT\d\d:\d\d:\d\dZ", labels["created"])
    assert config["Cmd"] == ["ddakf", "serve"]
    assert config["User"] == "10001:10001"
    if variant != "ray":  # whose containers Ray and KubeRay start and watch
        assert set(config["Volumes"]) == {"/var/lib/ddakf"}
        assert config["Healthcheck"]["Test"][0] == "CMD"


def test_its_size(image, variant):
    size = image.inspect().size
    print(f"{IMAGE}: {size / 1e6:.0f} MB")
    assert size < MOST_BYTES[variant]


def test_it_has_no_tools(image, variant):
    if variant == "ray":
        pytest.skip("Ray and KubeRay start processes with a shell")
    look = "import os; print(*{n for p in os.get_exec_path() if os.path.isdir(p) for n in os.listdir(p)})"
    done = image.execute("/opt/ddakf/bin/python", "-c", look)
    assert done.returncode == 0, done.stderr
    assert "ddakf" in done.stdout.split()
    assert not TOOLS & set(done.stdout.split())


def test_its_root_cannot_be_written(image):
    done = image.execute("/opt/ddakf/bin/python", "-c", "open('/tmp/x', 'w')")
    assert "Read-only file system" in done.stderr


def test_its_packages_can_be_imported(image, variant):
    names = "numpy numba grpc uvloop zstandard DracoPy sqlalchemy alembic fastapi uvicorn psycopg opentelemetry.sdk ssl sqlite3"
    added = {"s3": ["s3fs"], "ray": ["s3fs", "ray"]}.get(variant, [])
    done = image.execute("/opt/ddakf/bin/python", "-c", f"import {', '.join(names.split() + added)}")
    assert done.returncode == 0, done.stderr


def test_the_first_frame_comes_soon_after_the_start(image, volume, clouds):
    """Where other programs take the processors, it is the processor time that counts: one of its own gives as much a second. The
    seconds have a wide bound, since a start that waits for something uses no processor."""
    seconds, used = first_frame(image, volume, clouds[0])
    assert used < FIRST_FRAME
    assert seconds < BUSY * FIRST_FRAME


def test_the_kernels_of_the_baseline_are_complete(image, volume, clouds):
    """A processor of that level tracks a frame without compiling."""
    own = {"NUMBA_CPU_NAME": BASELINE, "NUMBA_CPU_FEATURES": "", "DDAKF_KERNEL_CACHE": f"/opt/ddakf/kernels/{BASELINE}"}
    first_frame(image, volume, clouds[0], **own)


def first_frame(image: Runtime, volume: Path, cloud: Frame, **environment: str) -> tuple[float, float]:
    """Seconds from the start of a container to its first result, and its processor seconds until then."""
    grpc, http = lasting_port(), lasting_port()
    started = time.monotonic()
    service = start(image, volume, grpc, http, **environment)
    try:
        ready = await_ready(lambda: is_ready(service), service.container, 60)
        with connect(service.grpc) as client, client.create_session(SHIRT.template, SHIRT.garment_faces) as session:
            session.reset(SHIRT.garment_vertices[0])
            next(iter(session.track([cloud])))
            first, used = time.monotonic() - started, Usage(service.container.pid).cpu_seconds()
    finally:
        service.container.kill(signal.SIGTERM)
        service.container.wait()
    print(f"ready after {ready:.1f} s, first frame after {first:.1f} s, of the processors {used:.1f} s")
    assert "compiling" not in service.container.log()
    return first, used


def test_its_user(service):
    status = Path(f"/proc/{service.container.pid}/status").read_text()
    assert set(re.search(r"^Uid:\s+(.*)$", status, re.M)[1].split()) == {"10001"}


def test_the_kernels_of_this_processor_s_level_are_taken(image):
    """The best one that the image has; the baseline is always there."""
    look = "import os; from ddakf.kernels import cache; print(cache.directory().parent, *os.listdir(os.environ[cache.COMPILED]))"
    done = image.execute("/opt/ddakf/bin/python", "-c", look)
    assert done.returncode == 0, done.stderr
    taken, *levels = done.stdout.split()
    assert BASELINE in levels
    best = next(level for level in cache.supported() if level in levels)
    assert taken == f"/opt/ddakf/kernels/{best}"


def test_the_sample_from_outside(service):
    program = "import sys; from ddakf.commands.cli import main; sys.exit(main())"
    command = [sys.executable, "-c", program, "track", ROOT / "ddakf/data/sample.npz", "--frames", ":30", "--json"]
    done = subprocess.run([*command, "--server", service.grpc], capture_output=True, text=True, timeout=250, check=False)
    assert done.returncode == 0, done.stderr
    figures = json.loads(done.stdout)
    assert figures["frames"] == 29


def test_the_health_check(image, variant, service):
    if variant == "ray":
        pytest.skip("it has none: KubeRay's probes take its place")
    port = service.http.rpartition(":")[2]
    healthy = ["/opt/ddakf/bin/python", "-c", f"import os; os.environ['DDAKF_HTTP_PORT'] = '{port}'; "
               "exec(compile(open('/usr/bin/healthy').read(), 'healthy', 'exec'))"]  # fmt: skip
    if type(image).__name__ == "Docker":
        pytest.skip("another container's loopback is not this one's")
    assert image.execute(*healthy).returncode == 0


def test_a_stop_is_orderly(service, clouds):
    notices: list[Notice] = []
    with connect(service.grpc) as client:
        session = client.create_session(SHIRT.template, SHIRT.garment_faces, flow="lossless")
        session.reset(SHIRT.garment_vertices[0])

        def frames() -> Iterator[Frame]:
            for number, cloud in enumerate(clouds):
                if number == 5:
                    service.container.kill(signal.SIGTERM)
                yield cloud
                time.sleep(0.05)

        results = list(session.track(frames(), on_notice=notices.append, resume=0.0))
    assert "draining" in {notice.kind for notice in notices}
    assert len(results) == FRAMES
    assert service.container.wait() == 0
    assert not is_ready(service)


def test_a_kill_costs_no_frame(image, volume, clouds):
    grpc, http = lasting_port(), lasting_port()
    service, again = start(image, volume, grpc, http), None
    await_ready(lambda: is_ready(service), service.container, 60)
    try:
        with connect(service.grpc) as client:
            session = client.create_session(SHIRT.template, SHIRT.garment_faces, flow="lossless")
            session.reset(SHIRT.garment_vertices[0])
            answered = []
            for result in session.track(clouds, resume=60.0):
                answered.append(result.sequence)
                if len(answered) == FRAMES // 2:
                    service.container.kill(signal.SIGKILL)
                    service.container.wait()
                    again = start(image, volume, grpc, http)
            assert answered == sorted(answered)
            assert set(answered) == set(range(1, FRAMES + 1))
            assert result.state == "tracking"
    finally:
        if again is not None:
            again.container.kill(signal.SIGTERM)
            again.container.wait()
