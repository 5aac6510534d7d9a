"""OpenTelemetry spans: one per sampled frame, with a child span per stage.

They are exported over OTLP/HTTP if ``OTEL_EXPORTER_OTLP_ENDPOINT`` is set; only then is the SDK imported. OpenTelemetry's
other variables (headers, service name, batch sizes) apply as usual.
"""

from __future__ import annotations

import importlib
import os
import random
import threading
import time
from collections.abc import Iterable, Mapping
from typing import Protocol

from ddakf_api.errors import ServiceError
from ddakf_api.v1 import tracking_pb2 as pb

import ddakf
from ddakf.errors import InvalidConfig

ENDPOINT_VARIABLES = ("OTEL_EXPORTER_OTLP_TRACES_ENDPOINT", "OTEL_EXPORTER_OTLP_ENDPOINT")

# The stages of the tracker in the order in which `Tracker.step` calls them.
STAGES = (
    *("input", "predict", "preprocess", "coarse"),
    *("associate", "robust", "adapt", "physics", "fuse", "uncertainty", "reliability", "output"),
)
_NO_SPANS = {"total", "server"}  # sums of other timings
_SECOND = 1_000_000_000
_LAST_EXPORT = 2.0  # seconds


class TracedFrame(Protocol):
    """The fields of a frame that its span has."""

    sequence_number: int
    capture_time: float
    point_count: int


class Tracer(Protocol):
    """Receiver of every frame; never waits."""

    def applied(self, session_id: str, frame: TracedFrame, result: pb.Result, codec: str, flow: str) -> None:
        """Records a tracked frame, whose result has all timings."""

    def refused(self, session_id: str, frame: TracedFrame, error: ServiceError, seconds: float) -> None:
        """Records a frame that was rejected ``seconds`` after its arrival."""

    def close(self) -> None:
        """Exports the queued spans; blocks for some seconds at most."""


class NoTracer:
    """Discards every frame; used without a collector."""

    def applied(self, session_id, frame, result, codec, flow) -> None:
        pass

    def refused(self, session_id, frame, error, seconds) -> None:
        pass

    def close(self) -> None:
        pass


class OtlpTracer:
    """Exports the spans of a share of the frames in a thread of its own; drops spans under load.

    Args:
        sample: share of the frames, 0 to 1.
        server_id: exported as ``service.instance.id``.
    """

    def __init__(self, sample: float, server_id: str):
        from opentelemetry.exporter.otlp.proto.http.trace_exporter import OTLPSpanExporter
        from opentelemetry.sdk.resources import Resource
        from opentelemetry.sdk.trace import TracerProvider
        from opentelemetry.sdk.trace.export import BatchSpanProcessor
        from opentelemetry.trace import SpanKind, Status, StatusCode, set_span_in_context

        attributes = {"service.version": ddakf.__version__, "service.instance.id": server_id}
        if "OTEL_SERVICE_NAME" not in os.environ:
            attributes["service.name"] = "ddakf"
        self._sample = sample
        self._provider = TracerProvider(resource=Resource.create(attributes), shutdown_on_exit=False)
        self._exporter = OTLPSpanExporter()
        self._provider.add_span_processor(BatchSpanProcessor(self._exporter))
        self._tracer = self._provider.get_tracer("ddakf_service", ddakf.__version__)
        self._kind, self._context_of = SpanKind.SERVER, set_span_in_context
        self._failed = lambda text: Status(StatusCode.ERROR, text)

    def applied(self, session_id: str, frame: TracedFrame, result: pb.Result, codec: str, flow: str) -> None:
        if random.random() >= self._sample:
            return
        begin, end = _span(result.timings["server"])
        attributes = {
            **_identity(session_id, frame),
            "ddakf.codec": codec,
            "ddakf.flow": flow,
            "ddakf.state": pb.TrackerState.Name(result.state).removeprefix("TRACKER_STATE_").lower(),
            "ddakf.reliability": result.reliability,
            "ddakf.coverage": result.coverage,
        }
        span = self._tracer.start_span("frame", kind=self._kind, start_time=begin, attributes=attributes)
        inside = self._context_of(span)
        for name, start, stop in frame_spans(result.timings, begin):
            self._tracer.start_span(name, context=inside, start_time=start).end(stop)
        span.end(end)

    def refused(self, session_id: str, frame: TracedFrame, error: ServiceError, seconds: float) -> None:
        if random.random() >= self._sample:
            return
        begin, end = _span(seconds)
        attributes = {**_identity(session_id, frame), "ddakf.error": type(error).__name__}
        span = self._tracer.start_span("frame", kind=self._kind, start_time=begin, attributes=attributes)
        span.set_status(self._failed(str(error)))
        span.end(end)

    def close(self) -> None:
        # The provider would wait half a minute for an unresponsive collector.
        patience = threading.Timer(_LAST_EXPORT, self._exporter.shutdown)
        patience.start()
        self._provider.shutdown()
        patience.cancel()


def tracer_for(sample: float, server_id: str) -> Tracer:
    """The tracer selected by the environment.

    Raises:
        InvalidConfig: an endpoint is set, but OpenTelemetry is not installed.
    """
    variable = next((name for name in ENDPOINT_VARIABLES if os.environ.get(name)), None)
    if variable is None or sample == 0:
        return NoTracer()
    try:
        importlib.import_module("opentelemetry.exporter.otlp.proto.http.trace_exporter")
    except ImportError:
        raise InvalidConfig(variable, "OpenTelemetry to be installed: pip install 'ddakf[tracing]'", "none") from None
    return OtlpTracer(sample, server_id)


def frame_spans(timings: Mapping[str, float], begin: int) -> Iterable[tuple[str, int, int]]:
    """Name, start and end (nanoseconds) of a frame's child spans, in sequence from ``begin``.

    A stage of several passes is one span, as long as all its passes.
    """
    known = ("queue", "decode", *STAGES)
    others = sorted(set(timings) - set(known) - _NO_SPANS - {"encode"})
    for name in (*known, *others, "encode"):
        if name in timings:
            end = begin + int(timings[name] * _SECOND)
            yield name, begin, end
            begin = end


def _span(seconds: float) -> tuple[int, int]:
    """Start and end of a span that ends now, nanoseconds since 1970."""
    end = time.time_ns()
    return end - int(seconds * _SECOND), end


def _identity(session_id: str, frame: TracedFrame) -> dict:
    return {
        "ddakf.session": session_id,
        "ddakf.sequence_number": frame.sequence_number,
        "ddakf.capture_time": frame.capture_time,
        "ddakf.points": frame.point_count,
    }
