"""Prometheus metrics of the service."""

from __future__ import annotations

import functools
import math

from ddakf_api.v1 import tracking_pb2 as pb
from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, ProcessCollector, disable_created_metrics

_CACHED_LABELS = 512  # cached label lookups; bounded, because clients may send any number as a codec
_LATENCY_BUCKETS = (0.001, 0.002, 0.005, 0.01, 0.015, 0.02, 0.033, 0.05, 0.066, 0.1, 0.2, 0.5, 1.0, 2.0, 5.0)
_STAGE_BUCKETS = (0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.033, 0.066, 0.1, 0.5, 1.0)


class Metrics:
    """The metrics of ``/metrics``, each with its description. Labels have few values: never a session's id."""

    def __init__(self):
        disable_created_metrics()  # an unused second time series for each counter
        self.registry = CollectorRegistry()
        add = {"registry": self.registry}
        self.frames = Counter("ddakf_frames_total", "Frames by outcome", ["outcome"], **add)
        by_codec = ["codec", "flow"]
        self.frame_seconds = Histogram(
            "ddakf_frame_seconds", "Time from the arrival of a frame to its result", by_codec, buckets=_LATENCY_BUCKETS, **add
        )
        self.stage_seconds = Histogram(
            "ddakf_frame_stage_seconds", "Time of one stage of a frame", ["stage", *by_codec], buckets=_STAGE_BUCKETS, **add
        )
        self.reliability = Histogram(
            "ddakf_frame_reliability", "Reliability of a frame", buckets=[i / 10 for i in range(1, 11)], **add
        )
        self.curtailed = Counter("ddakf_frames_curtailed_total", "Applied frames of which a budget left work out", **add)
        self.lighter = Counter(
            "ddakf_frames_lighter_total", "Applied frames of lighter trackers, while workers have too little time", **add
        )
        self.warnings = Counter("ddakf_frame_warnings_total", "Signs of wrong input in applied frames", ["code"], **add)
        self.sessions = Gauge("ddakf_sessions", "Live sessions", **add)
        self.sessions_limit = Gauge("ddakf_sessions_limit", "Live sessions that the server takes at most", **add)
        self.streams = Gauge("ddakf_streams", "Sessions with an open stream", **add)
        self.watchers = Gauge("ddakf_watchers", "Watchers of sessions", **add)
        self.calls_refused = Counter("ddakf_calls_refused_total", "Calls that were not admitted", ["reason"], **add)
        self.workers = Gauge("ddakf_workers", "Workers that should accept frames, as configured", **add)
        self.workers_ready = Gauge("ddakf_workers_ready", "Workers that accept frames", **add)
        self.worker_restarts = Counter("ddakf_worker_restarts_total", "Workers that were lost and replaced", **add)
        self.store_up = Gauge("ddakf_store_up", "1 if a part of the store works, else 0", ["part"], **add)
        self.store_errors = Counter("ddakf_store_errors_total", "Failed attempts to reach or write the store", ["part"], **add)
        self.store_dropped = Counter(
            "ddakf_store_dropped_total", "Rows dropped from a full queue while the database failed", **add
        )
        self.store_free = Gauge("ddakf_store_free_bytes", "Free bytes of the disk with data_dir; +Inf without one", **add)
        self.store_free.set(math.inf)
        self.checkpoint_seconds = Histogram(
            "ddakf_checkpoint_seconds", "Time to write a checkpoint", buckets=_LATENCY_BUCKETS, **add
        )
        self.checkpoint_bytes = Counter("ddakf_checkpoint_bytes_total", "Bytes of written checkpoints", **add)
        self.workers_spare = Gauge("ddakf_workers_spare", "Warm workers in reserve", **add)
        self.workers_recycled = Counter("ddakf_workers_recycled_total", "Workers that were replaced in order", **add)
        self.recoveries = Counter("ddakf_session_recoveries_total", "Restores of sessions after the loss of their worker", **add)
        self.penalties = Counter(
            "ddakf_session_penalties_total", "Sessions penalised for frames beyond their limit", ["penalty"], **add
        )
        self.session_moves = Counter(
            "ddakf_session_moves_total", "Sessions that came from another server, or went to one", ["move"], **add
        )
        self.lease_held = Gauge("ddakf_lease_held", "1 if this server may answer for its sessions, else 0", **add)
        self.lease_held.set(1)
        self.build_info = Gauge("ddakf_build_info", "1; the program", ["version", "build"], **add)
        ProcessCollector(registry=self.registry)
        for outcome in ("applied", "dropped", "late", "rejected", "costly", "failed"):
            self.frames.labels(outcome)
        for code in pb.WarningCode.values()[1:]:
            self.warnings.labels(_warning_name(code))
        for reason in ("no_key", "invalid_key", "scope", "rate", "unread_keys", "origin"):
            self.calls_refused.labels(reason)
        for move in ("taken", "handed_over", "lost"):
            self.session_moves.labels(move)
        for penalty in ("slowed", "isolated", "ended"):
            self.penalties.labels(penalty)
        # Cached lookups: every frame needs a dozen.
        self._applied = self.frames.labels("applied")
        self._frame_seconds = functools.lru_cache(_CACHED_LABELS)(self.frame_seconds.labels)
        self._stage_seconds = functools.lru_cache(_CACHED_LABELS)(self.stage_seconds.labels)

    def observe(self, result: pb.Result, codec: str, flow: str) -> None:
        """Counts an applied frame; see :func:`codec_of` and :func:`flow_of`."""
        self._applied.inc()
        self._frame_seconds(codec, flow).observe(result.timings["server"])
        self.reliability.observe(result.reliability)
        if result.usage.widening > 1.0:
            self.curtailed.inc()
        if result.usage.lighter:
            self.lighter.inc()
        for warning in result.warnings:
            self.warnings.labels(_warning_name(warning.code)).inc()
        for stage, seconds in result.timings.items():
            if stage != "server":
                self._stage_seconds(stage, codec, flow).observe(seconds)


def codec_of(measurement: str | None, codec: int) -> str:
    """Label of a codec: "morton_zstd", "depth_png", ..., or "none".

    Args:
        measurement: "point_cloud" or "depth_image"; None: the frame has neither.
        codec: PointCodec of a cloud, DepthCompression of an image.
    """
    if measurement == "point_cloud":
        return _label(pb.PointCodec, codec, pb.POINT_CODEC_MORTON_ZSTD, "POINT_CODEC_")
    if measurement == "depth_image":
        return "depth_" + _label(pb.DepthCompression, codec, pb.DEPTH_COMPRESSION_NONE, "DEPTH_COMPRESSION_")
    return "none"


def flow_of(mode: pb.FlowMode) -> str:
    """Flow mode as a label: "realtime" or "lossless"."""
    return _label(pb.FlowMode, mode, pb.FLOW_MODE_REALTIME, "FLOW_MODE_")


def _warning_name(code: int) -> str:
    """Code of a warning as a label: "length_unit", ..."""
    return _label(pb.WarningCode, code, pb.WARNING_CODE_UNSPECIFIED, "WARNING_CODE_")


@functools.lru_cache(_CACHED_LABELS)
def _label(enum, value: int, default: int, prefix: str) -> str:
    value = value or default
    return enum.Name(value).removeprefix(prefix).lower() if value in enum.values() else "unknown"
