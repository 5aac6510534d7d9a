"""Spans divide the time of a frame; without a collector OpenTelemetry is not imported."""

from __future__ import annotations

import itertools
import re
import subprocess
import sys
import threading
from pathlib import Path

import pytest
from ddakf_api.errors import InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.observability.tracing import ENDPOINT_VARIABLES, STAGES, NoTracer, frame_spans, tracer_for
from ddakf_service.streaming.frame_message import FrameMessage

from ..conftest import TIMEOUT

pytest.importorskip("opentelemetry.sdk")
from .collector import Collector, attributes_of

pytestmark = pytest.mark.slow

FRAME = FrameMessage.of(pb.Frame(sequence_number=5, capture_time=0.5, point_cloud=pb.PointCloud(point_count=77)))


@pytest.fixture
def collector(monkeypatch):
    collector = Collector()
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", collector.endpoint)
    yield collector
    collector.close()


def result(**timings) -> pb.Result:
    return pb.Result(state=pb.TRACKER_STATE_TRACKING, reliability=0.75, coverage=0.5, timings=timings)


def test_a_frame_is_a_span_with_its_parts_inside(collector):
    tracer = tracer_for(1.0, "here")
    answer = result(queue=0.01, decode=0.002, fuse=0.003, total=0.003, encode=0.001, server=0.02)
    tracer.applied("s-1", FRAME, answer, "raw", "realtime")
    tracer.close()
    whole, *inside = sorted(collector.spans(), key=lambda span: span.name != "frame")
    assert [span.name for span in inside] == ["queue", "decode", "fuse", "encode"]
    assert {span.parent_span_id for span in inside} == {whole.span_id}
    assert {span.trace_id for span in inside} == {whole.trace_id}
    assert whole.end_time_unix_nano - whole.start_time_unix_nano == 20_000_000
    assert inside[0].start_time_unix_nano == whole.start_time_unix_nano
    for before, after in itertools.pairwise(inside):
        assert before.end_time_unix_nano == after.start_time_unix_nano
    attributes = attributes_of(whole)
    assert (attributes["ddakf.session"], attributes["ddakf.sequence_number"], attributes["ddakf.points"]) == ("s-1", 5, 77)
    assert (attributes["ddakf.state"], attributes["ddakf.codec"], attributes["ddakf.flow"]) == ("tracking", "raw", "realtime")
    assert collector.resource()["service.name"] == "ddakf"
    assert collector.resource()["service.instance.id"] == "here"


def test_a_refused_frame_is_a_span_that_failed(collector):
    tracer = tracer_for(1.0, "here")
    tracer.refused("s-1", FRAME, InvalidFrame(field="capture_time", expected="later", got="earlier"), 0.001)
    tracer.close()
    (span,) = collector.spans()
    assert span.status.code == span.status.STATUS_CODE_ERROR
    assert "capture_time" in span.status.message
    assert attributes_of(span)["ddakf.error"] == "InvalidFrame"


def test_the_sample_is_the_share_of_frames(collector):
    tracer = tracer_for(0.5, "here")
    for _ in range(400):
        tracer.applied("s-1", FRAME, result(server=0.01), "raw", "realtime")
    tracer.close()
    assert 120 < len(collector.spans()) < 280  # 8 standard deviations


def test_a_collector_that_is_away_holds_nobody_up(monkeypatch):
    """More frames than the queue holds are recorded while an export hangs. What does not fit is dropped, the oldest first."""
    monkeypatch.setenv("OTEL_EXPORTER_OTLP_ENDPOINT", "http://127.0.0.1:9")
    tracer, recorded, exported, in_time = tracer_for(1.0, "here"), threading.Event(), [], []

    def export(spans) -> None:
        in_time.append(recorded.wait(TIMEOUT))
        recorded.set()  # one wait is enough
        exported.extend(span.attributes["ddakf.session"] for span in spans)

    monkeypatch.setattr(tracer._exporter, "export", export)
    for i in range(5000):
        tracer.applied(f"s-{i}", FRAME, result(server=0.01), "raw", "realtime")
    recorded.set()
    tracer.close()
    assert all(in_time), "a frame has waited for the export"
    assert len(exported) < 5000
    assert exported[-2000:] == [f"s-{i}" for i in range(3000, 5000)]


def test_without_an_endpoint_there_are_no_spans(monkeypatch):
    for name in ENDPOINT_VARIABLES:
        monkeypatch.delenv(name, raising=False)
    assert isinstance(tracer_for(1.0, "here"), NoTracer)
    program = "import sys, ddakf_service.commands.serve, ddakf_service.server; sys.exit('opentelemetry.sdk' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", program], timeout=TIMEOUT).returncode == 0


def test_parts_are_all_timings_but_the_sums():
    timings = {name: 0.001 for name in ("encode", "reliability", "new stage", *STAGES, "queue", "decode", "total", "server")}
    names = [name for name, _, _ in frame_spans(timings, 0)]
    assert names == ["queue", "decode", *STAGES, "new stage", "encode"]


def test_the_sample_of_the_documents_has_the_spans_and_attributes_of_a_frame(collector):
    text = (Path(__file__).parents[3] / "docs/operations.md").read_text()
    head, _, inside = re.search(r"```\n(frame .*?)```", text, re.S)[1].partition("  queue ")
    assert re.findall(r"(\w+) [\d.]+", "queue " + inside) == ["queue", "decode", *STAGES, "encode"]
    tracer = tracer_for(1.0, "here")
    tracer.applied("s-1", FRAME, result(server=0.02), "raw", "realtime")
    tracer.close()
    assert set(re.findall(r"(ddakf\.\w+)=", head)) == set(attributes_of(collector.spans()[0]))
