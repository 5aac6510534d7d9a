"""Settings of the service, each with its default, its range and its meaning."""

from __future__ import annotations

import os
import re
import socket
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from pydantic_core import PydanticCustomError
from pydantic_settings import BaseSettings, NoDecode, SettingsConfigDict

ENV_PREFIX = "DDAKF_"
RECORDING_SUFFIXES = (".mcap", ".npz")

# A user of an unconfigured server gains nothing from more workers, and each takes memory.
DEFAULT_MAX_WORKERS = 4


def _default_workers() -> int:
    return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, DEFAULT_MAX_WORKERS)


def _default_data_dir() -> str:
    return str(Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "ddakf")


def _split_origins(origins: object) -> object:
    return [origin.strip() for origin in origins.split(",") if origin.strip()] if isinstance(origins, str) else origins


def _origin(text: str) -> str:
    if text != "*" and not _ORIGIN_FORM.fullmatch(text):
        raise PydanticCustomError("origin", "origins such as https://example.org, separated by commas, or *")
    return text


def _address(text: str) -> str:
    found = _ADDRESS_FORM.fullmatch(text)
    if text and not (found and 0 < int(found[1]) < 1 << 16):
        raise PydanticCustomError("address", "HOST:PORT, such as 192.0.2.1:7701, or nothing")
    return text


def _recording_file(text: str) -> str:
    if text and not (text.lower().endswith(RECORDING_SUFFIXES) and Path(text).is_file()):
        raise PydanticCustomError("recording", f"a file that ends in {' or '.join(RECORDING_SUFFIXES)}, or nothing")
    return text


_ORIGIN_FORM = re.compile(r"https?://[a-z0-9.:\[\]-]+")
_ADDRESS_FORM = re.compile(r"(?:[\w.-]+|\[[0-9A-Fa-f:.]+\]):([0-9]{1,5})", re.ASCII)
_Origin = Annotated[str, AfterValidator(_origin)]


class Settings(BaseSettings):
    """All settings. Each field is also a flag, a key of the file and the variable ``DDAKF_<FIELD>``."""

    model_config = SettingsConfigDict(
        env_prefix=ENV_PREFIX, extra="forbid", frozen=True, validate_default=True, allow_inf_nan=False
    )

    host: str = Field("127.0.0.1", min_length=1, description="address to listen on")
    grpc_port: int = Field(7701, ge=0, le=65535, description="port of gRPC; 0 takes a free one")
    http_port: int = Field(7702, ge=0, le=65535, description="port of REST, WebSocket and metrics; 0 takes a free one")
    cors_origins: Annotated[tuple[_Origin, ...], NoDecode, BeforeValidator(_split_origins)] = Field(
        (), description="origins of pages that may use the HTTP port, separated by commas; * for any"
    )
    request_timeout: float = Field(60.0, gt=0, description="seconds for a request to arrive; over HTTP its headers and body")
    keepalive: float = Field(
        20.0, gt=0, description="seconds between pings of a WebSocket client, and within which it must answer"
    )
    workers: int = Field(
        default_factory=_default_workers,
        ge=1,
        le=256,
        description=f"worker processes; the default is one per core, at most {DEFAULT_MAX_WORKERS}",
    )
    worker_kind: Literal["local", "ray"] = Field("local", description="workers are processes of this machine, or Ray actors")
    ray_address: str = Field(
        "auto", min_length=1, description="Ray cluster of the actors; auto: that of this machine, or of RAY_ADDRESS"
    )
    spare_workers: int = Field(1, ge=0, le=16, description="warm processes in reserve that replace a lost worker at once")
    recycle_frames: int = Field(0, ge=0, description="frames after which a spare takes over from a worker; 0: never")
    recycle_memory_bytes: int = Field(
        6 << 30, ge=0, description="bytes of memory of a worker at which a spare takes over from it; 0: never"
    )

    max_sessions: int = Field(64, ge=1, description="largest number of live sessions")
    max_memory_bytes: int = Field(
        4 << 30, ge=1 << 20, description="largest estimated memory of the sessions of one worker, bytes"
    )
    max_message_bytes: int = Field(64 << 20, ge=1 << 16, le=1 << 30, description="largest request, bytes")
    max_points: int = Field(500_000, ge=1, description="largest number of points in one frame")
    max_image_pixels: int = Field(1 << 21, ge=1, le=1 << 26, description="largest number of pixels of a depth image")
    max_vertices: int = Field(100_000, ge=3, description="largest number of vertices of a garment")
    max_faces: int = Field(300_000, ge=1, description="largest number of triangles of a garment or body")
    max_body_vertices: int = Field(100_000, ge=3, description="largest number of vertices of a body")

    default_flow: Literal["realtime", "lossless"] = Field(
        "realtime", description="default flow mode: realtime drops old frames, lossless tracks all"
    )
    lossless_queue: int = Field(
        8, ge=1, le=1024, description="frames of a lossless session that may wait before the server stops reading"
    )
    max_watchers: int = Field(16, ge=0, le=1024, description="largest number of watchers per session")
    max_frame_rate: float = Field(0.0, ge=0, description="largest frame rate of a session, frames per second; 0: not limited")
    idle_timeout: float = Field(300.0, gt=0, description="seconds without frames or calls on the tracker that end a session")
    departure_timeout: float = Field(
        60.0, gt=0, description="seconds that a session waits for its client after its stream ends; at most idle_timeout"
    )
    max_lifetime: float = Field(0.0, ge=0, description="seconds from the creation to the end of a session; 0: not limited")
    reader_timeout: float = Field(
        30.0, gt=0, description="seconds without reading after which a client's stream, watch or HTTP answer ends"
    )
    frame_timeout: float = Field(30.0, gt=0, description="seconds per frame before its worker counts as hung and is replaced")
    frame_limit: float = Field(
        0.5,
        gt=0,
        description="largest processor time of a frame: so many seconds x (1 + vertices / 20,000 + points / 100,000)",
    )
    costly_slow_after: int = Field(
        3, ge=1, description="frames beyond frame_limit after which a session may send one per second; 100 within it undo one"
    )
    costly_isolate_after: int = Field(
        6, ge=1, description="frames beyond frame_limit after which a session moves to a worker of low priority"
    )
    costly_end_after: int = Field(12, ge=1, description="frames beyond frame_limit after which a session ends")
    warm_timeout: float = Field(900.0, gt=0, description="seconds for a worker to compile and to track its first frame")
    drain_grace: float = Field(5.0, ge=0, description="seconds for clients to leave after the notice of a shutdown")
    successor: Annotated[str, AfterValidator(_address)] = Field(
        "", description="address, host:port, to which clients connect after a shutdown; empty: this server"
    )

    data_dir: str = Field(
        default_factory=_default_data_dir,
        min_length=1,
        description="folder of the durable state, for one server only; none: in memory",
    )
    database_url: str = Field(
        "",
        description="registry, history and keys: sqlite:///FILE, postgresql+psycopg://USER:PASSWORD@HOST/DATABASE; "
        "empty: SQLite in data_dir",
    )
    checkpoint_url: str = Field("", description="checkpoints: an fsspec URL, file:///... or s3://...; empty: in data_dir")
    checkpoint_every: int = Field(30, ge=1, description="frames between two checkpoints of a session")
    checkpoint_keep: int = Field(2, ge=1, le=100, description="stored checkpoints per session")
    share_sessions: bool = Field(
        False,
        description="any server of this database may serve any session; needs PostgreSQL, and one checkpoint_url for all of them",
    )
    lease_seconds: float = Field(
        5.0, ge=1, le=600, description="seconds after which other servers may take the sessions of one that has vanished"
    )
    gateway_address: Annotated[str, AfterValidator(_address)] = Field(
        "", description="address, host:port, by which other gateways send clients here; empty: all use one load balancer"
    )
    history_days: float = Field(30.0, gt=0, description="days for which history and ended sessions are kept")
    server_id: str = Field(
        default_factory=socket.gethostname,
        min_length=1,
        max_length=255,
        description="unique name of this server in its database: it restores only the sessions of this name",
    )

    allow_anonymous: bool = Field(False, description="calls without a key are allowed also on addresses other than loopback")
    require_keys: bool = Field(False, description="calls need a key also on loopback, for a proxy on the same machine")
    max_sessions_per_key: int = Field(16, ge=1, description="largest number of live sessions of a key without a quota of its own")
    max_streams_per_key: int = Field(64, ge=1, description="largest number of open streams and watchers of a key")
    max_meshes_per_key: int = Field(
        64, ge=0, description="largest number of uploaded meshes of a key, or of all callers without one"
    )
    max_mesh_bytes_per_key: int = Field(256 << 20, ge=0, description="largest size of the uploaded meshes of a key, bytes")
    tls_certificate: str = Field("", description="PEM file with the certificate chain; empty: no encryption")
    tls_key: str = Field("", description="PEM file with the private key of the certificate")
    tls_client_ca: str = Field(
        "", description="PEM file with authorities, one of which must have signed the certificate of every client"
    )

    recording: Annotated[str, AfterValidator(_recording_file)] = Field(
        "", description="recording (.mcap) or result of `ddakf track --out` (.npz) that the dashboard shows; empty: none"
    )
    trace_sample: float = Field(
        0.01, ge=0, le=1, description="share of the frames whose spans are exported where OTEL_EXPORTER_OTLP_ENDPOINT is set"
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="lowest level that is logged")
    log_format: Literal["text", "json"] = Field("text", description="one line of text or one JSON object per event")

    @model_validator(mode="after")
    def _check_pairs(self) -> Settings:
        given = self.model_fields_set  # a default departure_timeout is lowered to the idle_timeout
        if "departure_timeout" in given and self.departure_timeout > self.idle_timeout:
            expected = f"at most the idle_timeout, {self.idle_timeout:g}"
            raise PydanticCustomError("pair", expected, {"setting": "departure_timeout"})
        if self.share_sessions and not (self.database_url.startswith("postgresql") and self.checkpoint_url):
            expected = "false without a checkpoint_url and a database_url of PostgreSQL"
            raise PydanticCustomError("pair", expected, {"setting": "share_sessions"})
        if self.allow_anonymous and self.require_keys:
            raise PydanticCustomError("pair", "false where require_keys is set", {"setting": "allow_anonymous"})
        for later, earlier in (("costly_isolate_after", "costly_slow_after"), ("costly_end_after", "costly_isolate_after")):
            if getattr(self, later) < (least := getattr(self, earlier)):
                raise PydanticCustomError("pair", f"at least {earlier}, {least}", {"setting": later})
        for name in given & {"recycle_frames", "recycle_memory_bytes"}:
            if getattr(self, name) and not self.spare_workers:
                raise PydanticCustomError("pair", "0 where spare_workers is 0: a spare replaces the worker", {"setting": name})
        return self

    @classmethod
    def settings_customise_sources(cls, settings_cls, init_settings, **_):
        # load() merges the layers itself, because it also reports the layer of each value.
        return (init_settings,)
