"""Gateways that share sessions: two services on one PostgreSQL and one store of checkpoints, streamed to, killed and stopped."""

from __future__ import annotations

import contextlib
import os
import signal
import uuid
from collections.abc import Iterator

import httpx
import pytest
from ddakf_api.errors import SessionBusy, SessionExists, SessionExpired, SessionNotFound, StreamTakenOver
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.commands.service_process import ServiceProcess
from ports import lasting_port

from ...conftest import TIMEOUT, Api, Talk, eventually, frame_of, held, make_sheet, request_of
from ...lossless_stream import LosslessStream

pytestmark = pytest.mark.slow

SHEET = make_sheet()
EVERY = 5  # frames between two checkpoints
SPAN = 2.0  # seconds of a lease
LOSSLESS = pb.FLOW_MODE_LOSSLESS


class Gateway:
    """A service that shares its sessions, on a port that it has again after a restart."""

    def __init__(self, name: str, folder, url: str, checkpoints: str = ""):
        self._folder, self.name, self.address = folder, name, f"127.0.0.1:{lasting_port()}"
        self._arguments = ["--workers", "1", "--spare-workers", "0", "--server-id", name, "--data-dir", str(folder / name)]
        self._arguments += ["--database-url", url, "--checkpoint-url", checkpoints or f"file://{folder}/checkpoints"]
        self._arguments += ["--share-sessions", "--lease-seconds", str(SPAN), "--gateway-address", self.address]
        self._arguments += ["--checkpoint-every", str(EVERY), "--drain-grace", "0.5", "--departure-timeout", "60"]
        self._arguments += ["--grpc-port", self.address.rpartition(":")[2]]
        self._starts = 0
        self.start()

    def start(self) -> None:
        self._starts += 1
        self.process = ServiceProcess(self._arguments, log=self._folder / f"{self.name}-{self._starts}.log")
        self.process.wait_until_ready()
        self.api, self.http = Api(self.address), self.process.http

    def stop(self, number: int = signal.SIGTERM) -> int:
        self.api.channel.close()
        return self.process.stop(number)

    def get(self, path: str, **parameters) -> dict:
        return httpx.get(f"{self.http}/v1/{path}", params=parameters, timeout=TIMEOUT).raise_for_status().json()

    def metric(self, name: str) -> float:
        lines = httpx.get(f"{self.http}/metrics", timeout=TIMEOUT).text.splitlines()
        return next(float(line.rpartition(" ")[2]) for line in lines if line.startswith(name + " "))

    def moves(self, move: str) -> float:
        return self.metric(f'ddakf_session_moves_total{{move="{move}"}}')


@pytest.fixture(scope="module")
def gateways(postgres, tmp_path_factory) -> Iterator[tuple[Gateway, Gateway]]:
    with pair(postgres, tmp_path_factory.mktemp("gateways")) as gateways:
        yield gateways


@pytest.fixture
def gateways_on_s3(postgres, moto, tmp_path, monkeypatch) -> Iterator[tuple[Gateway, Gateway]]:
    """Their checkpoints are in a bucket."""
    import s3fs

    access = {"endpoint_url": f"http://127.0.0.1:{moto}", "key": "a", "secret": "b"}
    for name, value in access.items():
        monkeypatch.setenv(f"FSSPEC_S3_{name.upper()}", value)
    bucket = f"gateways-{uuid.uuid4()}"
    s3fs.S3FileSystem(skip_instance_cache=True, **access).mkdir(bucket)
    with pair(postgres, tmp_path, f"s3://{bucket}/checkpoints") as gateways:
        yield gateways


@contextlib.contextmanager
def pair(postgres, folder, checkpoints: str = "") -> Iterator[tuple[Gateway, Gateway]]:
    """Two gateways, which must end in order."""
    url = postgres.new_database(f"gateways-{uuid.uuid4()}")
    one, two = (Gateway(name, folder, url, checkpoints) for name in ("one", "two"))
    yield one, two
    assert {gateway.stop() for gateway in (one, two)} == {0}


@pytest.fixture
def name(gateways) -> Iterator[str]:
    """A new session of the first gateway."""
    one, two = gateways
    name = one.api.create(SHEET).name
    yield name
    with contextlib.suppress(SessionNotFound):
        two.api.delete(name)


def shifted(number: int) -> pb.Frame:
    return frame_of(SHEET, number, shift=(0.001 * number, 0, 0))


def asked(gateway: Gateway, name: str, numbers: range, **start) -> list[pb.Result]:
    """The results of frames in a stream of their own."""
    responses = gateway.api.track(name, [request_of(shifted(number)) for number in numbers], flow=LOSSLESS, **start)
    return [response.result for response in responses if response.HasField("result")]


@contextlib.contextmanager
def streaming(*addresses: str) -> Iterator[LosslessStream]:
    """A stream with its first answers; every frame has an answer at its end."""
    stream = LosslessStream(*addresses)
    stream.start()
    try:
        eventually(lambda: len(stream.answered) >= 3 * EVERY)
        yield stream
        goes_on(stream)
    finally:
        stream.end()
    assert sorted(set(stream.answered)) == list(range(1, stream.sent + 1))


def goes_on(stream: LosslessStream) -> None:
    before = len(stream.answered)
    eventually(lambda: len(stream.answered) >= before + 3 * EVERY)


def test_every_gateway_shows_all_sessions(gateways, name):
    one, two = gateways
    other = two.api.create(SHEET, labels={"of": "two"}).name
    for gateway in gateways:
        listed = [session["name"] for session in gateway.get("sessions")["sessions"]]
        assert {name, other} <= set(listed)
        pages = [gateway.get("sessions", page_size=1)]
        while token := pages[-1]["next_page_token"]:
            pages.append(gateway.get("sessions", page_size=1, page_token=token))
        assert [session["name"] for page in pages for session in page["sessions"]] == listed
        assert [session["name"] for session in gateway.get("sessions", labels="of=two")["sessions"]] == [other]
        assert gateway.get(other)["garment_vertex_count"] == len(SHEET.vertices)
        assert gateway.get(other, view="SESSION_VIEW_FULL")["garment"]["vertices"]["data"]
    assert one.api.get(name).limits == two.api.get(name).limits
    two.api.delete(other)
    assert httpx.get(f"{one.http}/v1/{other}").status_code == 404


def test_an_id_belongs_to_one_session_of_all_gateways(gateways):
    one, two = gateways
    name = one.api.create(SHEET, session_id="of-all").name
    with pytest.raises(SessionExists):
        two.api.create(SHEET, session_id="of-all")
    two.api.delete(name)
    for gateway in (one, two, one):  # free again at once
        assert gateway.api.create(SHEET, session_id="of-all").name == name
        gateway.api.delete(name)


def test_a_session_without_a_stream_comes_to_the_gateway_that_is_asked(gateways, name):
    """It continues exactly: the results are those of a session that has stayed."""
    one, two = gateways
    stayed = one.api.create(SHEET).name
    moved = [*asked(one, name, range(1, 8)), *asked(two, name, range(8, 12)), *asked(one, name, range(12, 14))]
    at_home = asked(one, stayed, range(1, 14))
    assert [result.sequence_number for result in moved] == list(range(1, 14))
    assert [result.vertices for result in moved] == [result.vertices for result in at_home]
    assert [result.sigma for result in moved] == [result.sigma for result in at_home]
    statistics = one.api.get(name).statistics
    assert (statistics.frames_applied, statistics.frames_lost) == (13, 0)
    eventually(lambda: two.api.get(name).statistics.frames_applied == 13)
    one.api.delete(stayed)


def test_a_repeated_creation_finds_its_session_wherever_that_went(gateways):
    one, two = gateways
    name = one.api.create(SHEET, request_id="wandering").name
    asked(two, name, range(1, 4))
    for gateway in (one, two, one):
        assert gateway.api.create(SHEET, request_id="wandering").name == name
    two.api.delete(name)


def test_calls_of_an_idle_session_work_at_every_gateway(gateways, name):
    _, two = gateways
    request = pb.UpdateSessionRequest(session=pb.Session(name=name, labels={"a": "b"}))
    assert two.api.call("UpdateSession", request).labels == {"a": "b"}
    assert two.api.call("ResetSession", pb.ResetSessionRequest(name=name)).labels == {"a": "b"}
    assert two.api.call("SnapshotSession", pb.SnapshotSessionRequest(name=name)).data


def test_a_session_with_a_stream_stays_unless_another_takes_over(gateways, name):
    one, two = gateways
    talk = Talk(one.api, name, flow=LOSSLESS)
    for number in range(1, 4):
        talk.ask(shifted(number))
    for refused in (
        lambda: asked(two, name, range(4, 5)),
        lambda: two.api.call("ResetSession", pb.ResetSessionRequest(name=name)),
        lambda: next(two.api.stub.WatchSession(pb.WatchSessionRequest(name=name, api_version="1.0"))),
    ):
        with pytest.raises(Exception, match=f"on the server 'one' at {one.address}") as failure:
            refused()
        assert isinstance(failure.value, SessionBusy) or "SessionBusy" in str(failure.value.trailing_metadata())
    talk.ask(shifted(4))
    (result,) = asked(two, name, range(5, 6), takeover=True)
    assert result.frames_applied == 5
    with pytest.raises(StreamTakenOver):
        next(talk.answers)


def test_a_deletion_elsewhere_ends_the_stream(gateways, name):
    one, two = gateways
    talk = Talk(one.api, name, flow=LOSSLESS)
    talk.ask(shifted(1))
    refused = httpx.delete(f"{two.http}/v1/{name}", headers={"If-Match": '"another"'})
    assert refused.status_code == 412
    etag = one.api.call("UpdateSession", pb.UpdateSessionRequest(session=pb.Session(name=name, labels={"a": "b"}))).etag
    still = httpx.delete(f"{two.http}/v1/{name}", headers={"If-Match": f'"{int(etag) - 1}"'})
    assert still.status_code == 412, "it sees the change at once"
    assert talk.ask(shifted(2))[-1].result.frames_applied == 2, "a deletion that is refused ends nothing"
    two.api.delete(name)
    with pytest.raises((StreamTakenOver, SessionNotFound)):
        next(talk.answers)
    with pytest.raises(SessionNotFound):
        one.api.get(name)


def test_an_orderly_stop_moves_the_sessions_without_a_lost_frame(gateways):
    one, two = gateways
    with streaming(one.address, two.address) as stream:
        idle = one.api.create(SHEET).name
        asked(one, idle, range(1, 8))
        assert one.stop() == 0
        goes_on(stream)
        assert {"draining", "reconnect", "resumed"} <= set(stream.notices)
        assert stream.forgotten == 0
        assert [result.frames_applied for result in asked(two, idle, range(8, 10))] == [8, 9]
        one.start()
        two.api.delete(idle)
    assert stream.answered == list(range(1, stream.sent + 1))


@pytest.mark.parametrize("store", ["gateways", "gateways_on_s3"], ids=["file", "s3"])
def test_a_killed_gateway_costs_the_frames_since_its_checkpoint_and_no_answer(request, store):
    one, two = request.getfixturevalue(store)
    with streaming(one.address, two.address) as stream:
        one.stop(signal.SIGKILL)
        goes_on(stream)
        assert "resumed" in stream.notices
        assert stream.forgotten <= 2 * EVERY
        assert two.moves("taken") >= 1
        one.start()
    print(f"gateway killed: {stream.longest:.2f} s without an answer, {stream.forgotten:.0f} frames forgotten")


def test_a_gateway_that_was_held_up_answers_and_writes_nothing_of_a_session_that_has_gone(gateways, name):
    one, two = gateways
    talk = Talk(one.api, name, flow=LOSSLESS)
    for number in range(1, EVERY + 2):
        talk.ask(shifted(number))
    eventually(lambda: two.api.get(name).statistics.frames_applied == EVERY + 1)
    lost = one.moves("lost")
    with held([one.process.pid]):
        (result,) = asked(two, name, range(EVERY + 2, EVERY + 3), takeover=True)
        assert result.frames_applied == EVERY + 2
        talk.send(shifted(EVERY + 3))
    told = []
    with pytest.raises(StreamTakenOver):
        told.extend(response.WhichOneof("message") for response in talk.answers)
    assert set(told) <= {"notice"}
    eventually(lambda: one.moves("lost") == lost + 1)
    (result,) = asked(two, name, range(EVERY + 3, EVERY + 4))
    assert result.frames_applied == EVERY + 3
    for gateway in gateways:
        eventually(lambda: gateway.api.get(name).statistics.frames_applied == EVERY + 3)  # noqa: B023


def test_frames_wait_while_the_leases_cannot_be_renewed(gateways, postgres, name):
    one, _ = gateways
    talk = Talk(one.api, name, flow=LOSSLESS)
    talk.ask(shifted(1))
    postgres.stop()
    try:
        eventually(lambda: one.metric("ddakf_lease_held") == 0)
        talk.send(shifted(2))
        assert next(talk.answers).notice.kind == pb.NOTICE_KIND_WAITING
    finally:
        postgres.start()
    seen = [next(talk.answers)]
    while not seen[-1].HasField("result"):
        seen.append(next(talk.answers))
    assert seen[-1].result.frames_applied == 2
    talk.end()
    for gateway in gateways:
        eventually(lambda: httpx.get(f"{gateway.http}/readyz").json()["status"] == "ready")  # noqa: B023


def test_a_restarted_gateway_has_its_sessions_again(gateways, name):
    one, two = gateways
    asked(one, name, range(1, 8))
    os.kill(one.process.pid, signal.SIGKILL)
    one.process.wait()
    one.start()
    assert [result.sequence_number for result in asked(one, name, range(8, 9))] == [8]
    assert name in [session["name"] for session in two.get("sessions")["sessions"]]


def test_a_session_that_was_left_with_its_gateway_expires(gateways):
    one, two = gateways
    limits = pb.SessionLimits(idle_timeout=1.0, departure_timeout=1.0)
    name = one.api.create(SHEET, limits=limits).name
    one.stop(signal.SIGKILL)
    try:
        eventually(lambda: ended(two, name))
    finally:
        one.start()


def ended(gateway: Gateway, name: str) -> bool:
    try:
        gateway.api.get(name)
    except SessionExpired:
        return True
    return False
