"""Client of the ddakf garment tracking service over gRPC, with NumPy arrays as inputs and outputs.

with connect("127.0.0.1:7701") as client, client.create_session(vertices, faces) as session:
    for result in session.track(frames):
        show(result.vertices, result.sigma)
"""

from ddakf_api import errors
from ddakf_api.codec import CODECS, DEFAULT_CODEC, DEFAULT_STEP
from ddakf_api.errors import ServiceError

from ddakf_client.aio import AsyncClient, AsyncSession, aconnect
from ddakf_client.client import Client, Session, connect
from ddakf_client.frames import Frame
from ddakf_client.history import History, StateChange
from ddakf_client.results import (
    FrameError,
    InputWarning,
    Limits,
    MeshInfo,
    Notice,
    Result,
    ServerInfo,
    SessionInfo,
    Usage,
    WarningCount,
)
from ddakf_client.tls import tls_credentials

__all__ = [
    "CODECS",
    "DEFAULT_CODEC",
    "DEFAULT_STEP",
    "AsyncClient",
    "AsyncSession",
    "Client",
    "Frame",
    "FrameError",
    "History",
    "InputWarning",
    "Limits",
    "MeshInfo",
    "Notice",
    "Result",
    "ServerInfo",
    "ServiceError",
    "Session",
    "SessionInfo",
    "StateChange",
    "Usage",
    "WarningCount",
    "aconnect",
    "connect",
    "errors",
    "tls_credentials",
]
