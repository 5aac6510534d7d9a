"""Durability: killed workers, a killed server, an orderly restart, with real processes, signals and files."""

from __future__ import annotations

import contextlib
import os
import signal
import sqlite3
import threading

import httpx
import pytest
from ddakf_api import API_VERSION
from ddakf_api.errors import Draining, SessionNotFound, StreamTakenOver, Unavailable, WorkerLost
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_client import Frame, connect
from ddakf_service.background_tasks import BackgroundTasks
from ddakf_service.commands.service_process import ServiceProcess
from ddakf_service.observability.metrics import Metrics
from ddakf_service.sessions.recovery.durability import Durability, Irrecoverable
from ddakf_service.sessions.recovery.tenure import Tenure
from ddakf_service.sessions.session import Session
from ddakf_service.store.files.checkpoints import unpack
from ddakf_service.workers.pool import worker_lost
from ports import lasting_port

from ...conftest import TIMEOUT, Api, Talk, eventually, fork_server, frame_of, request_of, running, workers

pytestmark = pytest.mark.slow


WARM = 100.0  # seconds until a spare worker is ready


def has_spare(service) -> bool:
    return "ddakf_workers_spare 1.0" in httpx.get(service.http + "/metrics").text


class Restartable:
    """A service that restarts with its data and its ports."""

    def __init__(self, folder):
        ports = [str(lasting_port()) for _ in range(2)]
        self._data = folder / "data"
        self.arguments = ["--workers", "1", "--spare-workers", "0", "--checkpoint-every", "4", "--drain-grace", "1"]
        self.arguments += ["--grpc-port", ports[0], "--http-port", ports[1], "--data-dir", str(self._data)]
        self.log = folder / "service.log"
        self.start()

    def start(self) -> None:
        self.process = ServiceProcess(self.arguments, log=self.log)
        self.process.wait_until_ready()

    def registered(self, name: str) -> list[pb.Session]:
        """The session as a restarted server would load it."""
        with contextlib.closing(sqlite3.connect(self._data / "ddakf.sqlite")) as database:
            rows = database.execute("SELECT message FROM sessions WHERE id = ?", [name.removeprefix("sessions/")]).fetchall()
        return [pb.Session.FromString(message) for (message,) in rows]

    def checkpointed(self, name: str) -> int:
        """Applied frames of the newest written checkpoint."""
        with contextlib.closing(sqlite3.connect(self._data / "ddakf.sqlite")) as database:
            ((uid,),) = database.execute("SELECT uid FROM sessions WHERE id = ?", [name.removeprefix("sessions/")])
        newest = max((self._data / "checkpoints").glob(f"*/{uid:016x}/*.checkpoint"))
        return unpack(newest.read_bytes()).snapshot.session.statistics.frames_applied

    def restart(self, number: int) -> None:
        self.process.stop(number)
        self.start()


@pytest.fixture(scope="module")
def durable(tmp_path_factory):
    """A service whose workers the tests may kill."""
    with running(["--workers", "1", "--checkpoint-every", "4"], tmp_path_factory.mktemp("durable")) as service:
        yield service


@pytest.fixture(scope="module")
def restartable(tmp_path_factory):
    service = Restartable(tmp_path_factory.mktemp("restartable"))
    yield service
    service.process.stop()


def worker_of(service) -> int:
    return workers(service.pid)[0]  # the spare is younger


def test_the_sessions_of_a_killed_worker_go_on(durable, sheet):
    """Their streams stay open; frames since the checkpoint are lost, and a notice says so."""
    eventually(lambda: has_spare(durable), WARM)
    api = Api(durable.grpc)
    names = [api.create(sheet).name for _ in range(3)]
    talks = [Talk(api, name) for name in names[:2]]
    for number in range(1, 7):
        for talk in talks:
            assert talk.ask(frame_of(sheet, number))[-1].result.sequence_number == number
    os.kill(worker_of(durable), signal.SIGKILL)
    answers = [talk.ask(frame_of(sheet, 7)) for talk in talks]
    for name, seen in zip(names, answers, strict=False):
        (notice,) = (response.notice for response in seen if response.HasField("notice"))
        statistics = api.get(name).statistics
        assert notice.kind == pb.NOTICE_KIND_RESUMED
        assert notice.value == statistics.frames_lost == 2, "frames since the checkpoint at the fourth"
        assert (statistics.recoveries, statistics.frames_applied, statistics.last_sequence_number) == (1, 7, 7)
    assert list(api.track(names[2], [request_of(frame_of(sheet, 1))]))[-1].result.frames_applied == 1, "one without a stream"
    for talk in talks:
        talk.end()
    for name in names:
        api.delete(name)
    api.channel.close()


def test_the_frame_that_a_killed_worker_had_is_tracked_again(durable, sheet):
    eventually(lambda: has_spare(durable), WARM)
    api = Api(durable.grpc)
    name = api.create(sheet).name
    talk = Talk(api, name)
    for number in range(1, 6):
        talk.ask(frame_of(sheet, number))
    victim = worker_of(durable)
    os.kill(victim, signal.SIGSTOP)
    talk.send(frame_of(sheet, 6))
    talk.await_arrival()
    os.kill(victim, signal.SIGKILL)
    notice, result = next(talk.answers), next(talk.answers)
    assert notice.notice.value == 1
    assert result.result.sequence_number == 6
    talk.end()
    api.delete(name)
    api.channel.close()


def test_without_a_spare_frames_wait_and_who_asks_is_told(restartable, sheet):
    """The only worker dies, and the next one takes longer to come than the timeout of clients."""
    api, service = Api(restartable.process.grpc), restartable.process
    name = api.create(sheet).name
    talk = Talk(api, name)
    talk.ask(frame_of(sheet, 1))
    source = fork_server(service.pid)
    os.kill(source, signal.SIGSTOP)
    os.kill(worker_of(service), signal.SIGKILL)
    talk.send(frame_of(sheet, 2))
    notices = [next(talk.answers).notice for _ in range(3)]
    assert [notice.kind for notice in notices] == [pb.NOTICE_KIND_WAITING] * 3
    assert notices[0].value < notices[1].value < notices[2].value
    with pytest.raises(Unavailable, match="waits for a worker") as reset:
        api.call("ResetSession", pb.ResetSessionRequest(name=name))
    assert reset.value.retry_after > 0
    with pytest.raises(Unavailable, match="waits for a worker"):
        Talk(api, name, takeover=True)
    with pytest.raises(StreamTakenOver):
        list(talk.answers)
    os.kill(source, signal.SIGCONT)
    eventually(lambda: api.get(name).statistics.recoveries == 1, WARM)
    again = Talk(api, name)
    assert again.ask(frame_of(sheet, 3))[-1].result.sequence_number == 3
    again.end()
    api.delete(name)
    api.channel.close()


def test_a_restore_that_takes_long_is_told(durable, sheet):
    """The spare worker stands still when it gets the session."""
    api = Api(durable.grpc)
    eventually(lambda: has_spare(durable), WARM)
    name = api.create(sheet).name
    talk = Talk(api, name)
    talk.ask(frame_of(sheet, 1))
    worker, spare = workers(durable.pid)
    os.kill(spare, signal.SIGSTOP)
    os.kill(worker, signal.SIGKILL)
    talk.send(frame_of(sheet, 2))
    notice = next(talk.answers).notice
    os.kill(spare, signal.SIGCONT)
    assert notice.kind == pb.NOTICE_KIND_WAITING
    assert "worker was lost" in notice.message
    assert next(answer for answer in talk.answers if answer.HasField("result")).result.sequence_number == 2
    talk.end()
    api.delete(name)
    api.channel.close()


def test_a_frame_is_forgotten_once_however_often_its_session_goes_back_to_a_checkpoint():
    session = Session("unlucky", pb.Session(), pb.Session(), pb.SessionLimits(idle_timeout=10))
    forgotten = []
    for applied, checkpoint in ((10, 4), (13, 4), (17, 15)):
        session.statistics.frames_applied = applied
        forgotten.append(session.record_recovery(pb.SessionStatistics(frames_applied=checkpoint)))
    assert forgotten == [6, 3, 2]
    assert session.statistics.frames_lost == 11


def test_a_checkpoint_counts_frames_that_were_not_registered_yet():
    session = Session("registered-early", pb.Session(), pb.Session(), pb.SessionLimits(idle_timeout=10))
    session.statistics.frames_applied = 2
    assert session.record_recovery(pb.SessionStatistics(frames_applied=10)) == 0
    assert session.statistics.frames_applied == 10


def durability_with(give_up) -> Durability:
    return Durability(None, None, Metrics(), 30, give_up, Tenure(), BackgroundTasks())


def test_a_session_that_takes_worker_after_worker_down_ends():
    given_up = []
    durability = durability_with(lambda session, reason: given_up.append((session.name, reason)))
    session = Session("deadly", pb.Session(), pb.Session(), pb.SessionLimits(idle_timeout=10))
    for _ in range(3):
        durability.record_worker_loss(session, worker_lost("deadly", suspected=True))
    assert not session.has_worker
    with pytest.raises(Irrecoverable, match="4 workers were lost over its frames"):
        durability.record_worker_loss(session, worker_lost("deadly", suspected=True))
    ((name, reason),) = given_up
    assert name == "sessions/deadly"
    assert isinstance(reason, WorkerLost)


def test_a_session_whose_workers_others_take_down_goes_on():
    durability = durability_with(None)
    session = Session("neighbour", pb.Session(), pb.Session(), pb.SessionLimits(idle_timeout=10))
    for _ in range(10):
        durability.record_worker_loss(session, worker_lost("neighbour"))
    assert not session.has_worker
    assert not session.worker_losses


def test_sessions_of_a_killed_server_go_on_after_its_restart(restartable, sheet):
    api = Api(restartable.process.grpc)
    name = api.create(sheet, "survivor", labels={"who": "me"}, limits=pb.SessionLimits(max_points=500)).name
    ended = api.create(sheet, "ended").name
    api.delete(ended)
    request = pb.CreateSessionRequest(api_version="1.0", session_id="again", request_id="the-same")
    request.session.garment.CopyFrom(api.call("GetSession", pb.GetSessionRequest(name=name, view=pb.SESSION_VIEW_FULL)).garment)
    again = api.call("CreateSession", request).name
    talk = Talk(api, name)
    for number in range(1, 7):
        talk.ask(frame_of(sheet, number))
    before = api.get(name)
    eventually(lambda: [found.statistics.frames_applied for found in restartable.registered(name)] == [6])
    restartable.restart(signal.SIGKILL)
    api = Api(restartable.process.grpc)
    listed = {session.name: session for session in api.call("ListSessions", pb.ListSessionsRequest()).sessions}
    assert set(listed) == {name, again}
    after = listed[name]
    assert (after.state, after.limits, dict(after.labels)) == (pb.SESSION_STATE_IDLE, before.limits, {"who": "me"})
    assert (after.create_time, after.etag) == (before.create_time, before.etag)
    assert api.get(name).config_json == before.config_json
    assert after.statistics.frames_applied == 6
    talk = Talk(api, name)
    assert talk.started.last_sequence_number == 4, "the checkpoint's"
    assert talk.started.last_capture_time == frame_of(sheet, 4).capture_time
    assert talk.ask(frame_of(sheet, 7))[-1].result.sequence_number == 7
    statistics = api.get(name).statistics
    assert (statistics.frames_applied, statistics.frames_lost, statistics.recoveries) == (7, 2, 1)
    talk.end()
    assert api.call("CreateSession", request).name == again, "the same request creates once, restart or not"
    full = api.call("GetSession", pb.GetSessionRequest(name=again, view=pb.SESSION_VIEW_FULL))
    assert full.garment == request.session.garment
    with pytest.raises(SessionNotFound, match="deleted"):
        api.get(ended)
    for one in (name, again):
        api.delete(one)
    api.channel.close()


@pytest.mark.parametrize(("number", "lost"), [(signal.SIGKILL, 2), (signal.SIGTERM, 0)])
def test_the_client_library_comes_back_by_itself(restartable, sheet, number, lost):
    """The server ends in the middle of a stream and restarts; the client's loop continues."""
    notices, sequences, restarted = [], [], threading.Event()

    def frames():
        for i in range(1, 31):
            if i == 19:
                restarted.wait()
            yield Frame(sheet.vertices, i / 30)

    def tracked_and_written() -> bool:
        """All sent frames are tracked, and the checkpoint of the sixteenth is written."""
        applied = [found.statistics.frames_applied for found in restartable.registered(session.name)]
        return applied == [18] and restartable.checkpointed(session.name) == 16

    service = restartable.process
    with connect(service.grpc) as client, client.create_session(sheet, flow="lossless") as session:
        for result in session.track(frames(), resume=110, on_notice=notices.append):
            sequences.append(result.sequence)
            if result.sequence == 17:  # the answer to the next one is on its way
                eventually(tracked_and_written)
                restartable.restart(number)
                restarted.set()
        info = session.info()
    assert sequences == [*range(1, 31)], "each frame is answered once"
    resumed = [notice.value for notice in notices if notice.kind == "resumed"]
    assert resumed == [max(lost - 1, 0)], "of the frames whose answers the client has seen"
    assert (info.recoveries, info.lost) == (1, lost)


def test_a_client_of_a_server_that_restarts_in_mid_stream_misses_no_answer(restartable, sheet):
    """The grace of the stop ends while a frame is in the worker and others wait. One of them will be refused."""
    numbers, notices, api = [], [], Api(restartable.process.grpc)

    def frames():
        for i in range(1, 41):
            if i == 20:
                eventually(lambda: len(numbers) == 19)
                os.kill(worker, signal.SIGSTOP)
            if i == 24:
                restart()
            yield Frame(sheet.vertices, 0.0 if i == 22 else i / 30)

    def restart():
        told = api.stub.WatchSession(pb.WatchSessionRequest(name=session.name, api_version=API_VERSION), timeout=TIMEOUT)
        kinds = (response.notice.kind for response in told if response.HasField("notice"))
        eventually(lambda: next(kinds) == pb.NOTICE_KIND_WAITING)  # a frame is in the worker
        os.kill(restartable.process.pid, signal.SIGTERM)
        eventually(lambda: next(kinds) == pb.NOTICE_KIND_RECONNECT)  # the stream is over
        os.kill(worker, signal.SIGCONT)
        assert restartable.process.wait() == 0
        restartable.start()

    worker = worker_of(restartable.process)
    with connect(restartable.process.grpc) as client, client.create_session(sheet, flow="lossless") as session:
        for answer in session.track(frames(), resume=110, on_error="yield", on_notice=notices.append, timeout=TIMEOUT):
            numbers.append(answer.sequence)
        assert session.info().lost == 0
    assert numbers == [*range(1, 41)]
    assert [notice.message.partition(", ")[2] for notice in notices if "again:" in notice.message] == ["1 answers are repeated"]
    api.channel.close()


def test_a_frame_that_was_tracked_while_its_stream_ended_is_known_to_the_next_stream(restartable, sheet):
    """The grace of a stop ends while a frame is in the worker: it is tracked and counted, and answered after the restart."""
    api = Api(restartable.process.grpc)
    name = api.create(sheet).name
    talk = Talk(api, name, flow=pb.FLOW_MODE_LOSSLESS)
    talk.ask(frame_of(sheet, 1))
    worker = worker_of(restartable.process)
    os.kill(worker, signal.SIGSTOP)
    talk.send(frame_of(sheet, 2))
    talk.send(frame_of(sheet, 3))  # waits, and is dropped
    os.kill(restartable.process.pid, signal.SIGTERM)
    told = []
    with pytest.raises(Draining):
        told.extend(answer.notice.kind for answer in talk.answers)
    assert told == [pb.NOTICE_KIND_DRAINING, pb.NOTICE_KIND_RECONNECT]
    os.kill(worker, signal.SIGCONT)
    assert restartable.process.wait() == 0
    restartable.start()
    api = Api(restartable.process.grpc)
    again = Talk(api, name, flow=pb.FLOW_MODE_LOSSLESS, answered_through=1)
    assert (again.started.last_sequence_number, again.started.repeated_answers) == (2, 1)
    repeated = next(again.answers).result
    assert (repeated.sequence_number, repeated.frames_applied) == (2, 2)
    assert len(repeated.vertices.data) == 12 * len(sheet.vertices)
    assert again.ask(frame_of(sheet, 3))[-1].result.frames_applied == 3
    again.end()
    api.delete(name)


def test_a_start_with_another_database_leaves_the_checkpoints(restartable, sheet, tmp_path):
    """As where a variable with its address was forgotten."""
    api = Api(restartable.process.grpc)
    name = api.create(sheet).name
    talk = Talk(api, name)
    for number in range(1, 9):
        talk.ask(frame_of(sheet, number, shift=(0.001 * number, 0, 0)))
    talk.end()
    api.channel.close()
    restartable.process.stop(signal.SIGTERM)
    other = ServiceProcess([*restartable.arguments, "--database-url", f"sqlite:///{tmp_path}/other"], log=restartable.log)
    other.wait_until_ready()
    eventually(lambda: "1 checkpoints are of sessions that this database does not have" in restartable.log.read_text())
    other.stop(signal.SIGTERM)
    restartable.start()
    api = Api(restartable.process.grpc)
    talk = Talk(api, name)
    assert talk.started.last_sequence_number == 8
    assert talk.ask(frame_of(sheet, 9, shift=(0.009, 0, 0)))[-1].result.frames_applied == 9
    assert api.get(name).statistics.frames_lost == 0
    talk.end()
    api.delete(name)
    api.channel.close()


def test_an_orderly_restart_forgets_nothing(restartable, sheet):
    """Tracking with and without a restart gives the same bits."""
    api = Api(restartable.process.grpc)
    names = [api.create(sheet).name for _ in range(2)]
    for name in names:
        talk = Talk(api, name)
        for number in range(1, 6):
            talk.ask(frame_of(sheet, number, shift=(0.001 * number, 0, 0)))
        talk.end()
    snapshot = api.call("SnapshotSession", pb.SnapshotSessionRequest(name=names[1])).data
    restartable.restart(signal.SIGTERM)
    api = Api(restartable.process.grpc)
    undisturbed = api.call("RestoreSession", pb.RestoreSessionRequest(api_version="1.0", data=snapshot)).name
    talks = [Talk(api, name) for name in (names[0], undisturbed)]
    assert talks[0].started.last_sequence_number == 5
    results = [talk.ask(frame_of(sheet, 6, shift=(0.006, 0, 0)))[-1].result for talk in talks]
    assert results[0].vertices == results[1].vertices
    assert results[0].sigma == results[1].sigma
    for talk in talks:
        talk.end()
    for name in [*names, undisturbed]:
        api.delete(name)
    api.channel.close()
