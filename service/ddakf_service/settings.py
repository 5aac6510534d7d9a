"""Settings of the service: flags override the environment, which overrides a file, which overrides the defaults."""

from __future__ import annotations

import os
import re
import socket
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field, ValidationError
from pydantic_core import PydanticCustomError
from pydantic_settings import BaseSettings, EnvSettingsSource, NoDecode, SettingsConfigDict

from ddakf.errors import InvalidConfig

ENV_PREFIX = "DDAKF_"
CONFIG_VARIABLE = ENV_PREFIX + "CONFIG"

# A user of an unconfigured server gains nothing from more workers, and each takes memory.
DEFAULT_MAX_WORKERS = 4


def _default_workers() -> int:
    return min(len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1, DEFAULT_MAX_WORKERS)


def _default_data_dir() -> str:
    return str(Path(os.environ.get("XDG_STATE_HOME") or Path.home() / ".local" / "state") / "ddakf")


def _split(origins: object) -> object:
    return [origin.strip() for origin in origins.split(",")] if isinstance(origins, str) else origins


def _origin(text: str) -> str:
    if text != "*" and not _ORIGIN_FORM.fullmatch(text):
        raise PydanticCustomError("origin", "origins such as https://example.org, separated by commas, or *")
    return text


_ORIGIN_FORM = re.compile(r"https?://[a-z0-9.:\[\]-]+")
_SECRET = re.compile(r"(://[^:@/]*:).*@|(\b[\w-]*(?:password|secret|token|key)[\w-]*=)[^&]*", re.IGNORECASE)
_Origin = Annotated[str, AfterValidator(_origin)]


class Settings(BaseSettings):
    """All settings. Each field is also a flag, a key of the file and the variable ``DDAKF_<FIELD>``."""

    model_config = SettingsConfigDict(env_prefix=ENV_PREFIX, extra="forbid", frozen=True, validate_default=True)

    host: str = Field("127.0.0.1", min_length=1, description="address to listen on")
    grpc_port: int = Field(7701, ge=0, le=65535, description="port of gRPC; 0 takes a free one")
    http_port: int = Field(7702, ge=0, le=65535, description="port of REST, WebSocket and metrics; 0 takes a free one")
    cors_origins: Annotated[tuple[_Origin, ...], NoDecode, BeforeValidator(_split)] = Field(
        (), description="origins of pages that may use the HTTP port, separated by commas; * for any"
    )
    request_timeout: float = Field(60.0, gt=0, description="seconds for a request to arrive; over HTTP headers and body")
    keepalive: float = Field(20.0, gt=0, description="seconds between pings of a WebSocket client, and for the pong")
    workers: int = Field(
        default_factory=_default_workers,
        ge=1,
        le=256,
        description=f"worker processes; the default is one per core, at most {DEFAULT_MAX_WORKERS}",
    )
    spare_workers: int = Field(1, ge=0, le=16, description="warm processes in reserve that replace a lost worker at once")
    recycle_frames: int = Field(0, ge=0, description="frames after which a worker is replaced in order; 0: never")
    recycle_memory_bytes: int = Field(
        6 << 30, ge=0, description="bytes in memory at which a worker is replaced in order; 0: never"
    )

    max_sessions: int = Field(64, ge=1, description="sessions at a time")
    max_memory_bytes: int = Field(4 << 30, ge=1 << 20, description="estimated bytes of the sessions of one worker")
    max_message_bytes: int = Field(64 << 20, ge=1 << 16, le=1 << 30, description="largest request, bytes")
    max_points: int = Field(500_000, ge=1, description="points in one frame")
    max_image_pixels: int = Field(1 << 21, ge=1, le=1 << 26, description="pixels of a depth image")
    max_vertices: int = Field(100_000, ge=3, description="vertices of a garment")
    max_faces: int = Field(300_000, ge=1, description="triangles of a garment or body")
    max_body_vertices: int = Field(100_000, ge=3, description="vertices of a body")

    default_flow: Literal["realtime", "lossless"] = Field(
        "realtime", description="default flow mode: realtime drops old frames, lossless tracks all"
    )
    lossless_queue: int = Field(8, ge=1, le=1024, description="queued frames of a lossless session before reading stops")
    max_watchers: int = Field(16, ge=0, le=1024, description="watchers per session")
    max_frame_rate: float = Field(0.0, ge=0, description="frames per second of a session; 0: not limited")
    idle_timeout: float = Field(300.0, gt=0, description="seconds without a frame after which a session ends")
    departure_timeout: float = Field(
        60.0, gt=0, description="seconds that a session waits for its client after its stream ends; at most idle_timeout"
    )
    max_lifetime: float = Field(0.0, ge=0, description="seconds from the creation to the end of a session; 0: not limited")
    reader_timeout: float = Field(30.0, gt=0, description="a stream ends when its client reads nothing for so many seconds")
    frame_timeout: float = Field(30.0, gt=0, description="seconds per frame before its worker counts as hung and is replaced")
    warm_timeout: float = Field(900.0, gt=0, description="seconds for a worker to compile and to track its first frame")
    drain_grace: float = Field(5.0, ge=0, description="seconds for clients to leave after the notice of a shutdown")
    successor: str = Field("", description="host:port for clients to connect to after a shutdown; empty: this server")

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
    history_days: float = Field(30.0, gt=0, description="retention of history and of ended sessions, days")
    server_id: str = Field(
        default_factory=socket.gethostname,
        min_length=1,
        max_length=255,
        description="unique name of this server in its database: it restores only the sessions of this name",
    )

    allow_anonymous: bool = Field(False, description="calls without a key are allowed also on addresses other than loopback")
    require_keys: bool = Field(False, description="calls need a key also on loopback, for a proxy on the same machine")
    max_sessions_per_key: int = Field(16, ge=1, description="sessions at a time of a key without a quota of its own")
    max_streams_per_key: int = Field(64, ge=1, description="streams and watchers of a key at a time")
    tls_certificate: str = Field("", description="PEM file with the certificate chain; empty: no encryption")
    tls_key: str = Field("", description="PEM file with its private key")
    tls_client_ca: str = Field("", description="PEM file with authorities: clients need a certificate signed by one")

    trace_sample: float = Field(
        0.01, ge=0, le=1, description="share of the frames whose spans are exported where OTEL_EXPORTER_OTLP_ENDPOINT is set"
    )
    log_level: Literal["debug", "info", "warning", "error"] = Field("info", description="lowest level that is logged")
    log_format: Literal["text", "json"] = Field("text", description="one line of text or one JSON object per event")

    @classmethod
    def settings_customise_sources(cls, settings_cls, init_settings, **_):
        # load() merges the layers itself, because it also reports the layer of each value.
        return (init_settings,)


class SettingSource(NamedTuple):
    """Layer of a value ("flag", "environment", "file" or "default") and its name there."""

    layer: str
    name: str

    def __str__(self) -> str:
        return f"{self.layer} {self.name}".rstrip()


def load(
    flags: Mapping[str, Any] | None = None, config_file: str | Path | None = None
) -> tuple[Settings, dict[str, SettingSource]]:
    """Reads all layers.

    Args:
        flags: values of the command line, by field name.
        config_file: a TOML file; defaults to the file that ``DDAKF_CONFIG`` names, if any.

    Returns:
        the settings, and the layer of each field.

    Raises:
        InvalidConfig: with the setting, the expected and the given value.
    """
    path = config_file or os.environ.get(CONFIG_VARIABLE)
    layers = {
        "flag": dict(flags or {}),
        "environment": EnvSettingsSource(Settings)(),
        "file": _read_file(Path(path)) if path else {},
    }
    values: dict[str, Any] = {}
    sources = {name: SettingSource("default", "") for name in Settings.model_fields}
    for layer in reversed(layers):
        for name, value in layers[layer].items():
            values[name] = value
            sources[name] = SettingSource(layer, _name_in(layer, name, path))
    try:
        return Settings(**values), sources
    except ValidationError as error:
        raise _as_invalid_config(error, sources) from None


def shown(name: str, value: Any) -> str:
    """A value as text, without the password, key or token of a URL."""
    if not name.endswith("_url"):
        return str(value)
    return _SECRET.sub(lambda m: f"{m[1]}***@" if m[1] else f"{m[2]}***", str(value))


def flag_of(name: str) -> str:
    """The command-line flag of a field."""
    return "--" + name.replace("_", "-")


def _name_in(layer: str, name: str, path) -> str:
    if layer == "flag":
        return flag_of(name)
    if layer == "environment":
        return ENV_PREFIX + name.upper()
    return str(path)


def _read_file(path: Path) -> dict[str, Any]:
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise InvalidConfig("config", "a readable TOML file", f"{path}: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise InvalidConfig("config", "a TOML file", f"{path}: {error}") from None


def _as_invalid_config(error: ValidationError, sources: Mapping[str, SettingSource]) -> InvalidConfig:
    first = error.errors(include_url=False)[0]
    name = str(first["loc"][0])
    if first["type"] == "extra_forbidden":
        return InvalidConfig(
            name, f"one of the settings {', '.join(Settings.model_fields)}", f"an unknown name from {sources[name]}"
        )
    expected = first["msg"].removeprefix("Input should be ").split(", unable to")[0]
    return InvalidConfig(name, expected, f"{shown(name, first['input'])!r} from {sources[name]}")
