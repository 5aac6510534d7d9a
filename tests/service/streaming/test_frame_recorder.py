"""Frame recorder: every refused frame is counted, few of them are logged."""

from __future__ import annotations

import logging
from types import SimpleNamespace

import pytest
from ddakf_api.errors import InvalidFrame
from ddakf_api.v1 import tracking_pb2 as pb
from ddakf_service.observability.metrics import Metrics
from ddakf_service.observability.tracing import NoTracer
from ddakf_service.sessions.session import Session
from ddakf_service.streaming import frame_recorder
from ddakf_service.streaming.frame_message import FrameMessage


@pytest.fixture
def clock(monkeypatch):
    clock = SimpleNamespace(now=0.0)
    monkeypatch.setattr(frame_recorder, "monotonic", lambda: clock.now)
    return clock


def test_refused_frames_are_logged_once_per_second_and_session(clock, caplog):
    metrics, history = Metrics(), SimpleNamespace(count=lambda *_: None)
    recorder = frame_recorder.FrameRecorder(metrics, history, NoTracer())
    sessions = [Session(name, pb.Session(), pb.Session(), pb.SessionLimits()) for name in ("some", "other")]
    error = InvalidFrame(field="deadline", expected="a number", got="none")
    with caplog.at_level(logging.INFO, frame_recorder.__name__):
        for number in range(1, 2501):
            clock.now += 1 / 1024
            recorder.refused(sessions[0], FrameMessage(b"", number), error, clock.now)
        recorder.refused(sessions[1], FrameMessage(b"", 1), error, clock.now)
    assert [(line.session, line.sequence, line.frames) for line in caplog.records] == [
        ("some", 1, 1),
        ("some", 1025, 1024),
        ("some", 2049, 1024),
        ("other", 1, 1),
    ]
    assert [session.statistics.frames_rejected for session in sessions] == [2500, 1]
    assert metrics.frames.labels("rejected").collect()[0].samples[0].value == 2501
