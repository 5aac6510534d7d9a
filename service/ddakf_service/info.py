"""Server info: versions, codecs and limits for the handshake."""

from __future__ import annotations

from ddakf_api import API_VERSION
from ddakf_api.codec import CODECS, DEPTH_CODECS, draco
from ddakf_api.v1 import tracking_pb2 as pb

import ddakf
from ddakf.physics.fabric import PRESETS

from .build import build
from .settings import Settings
from .workers.messages.encode import RESULT_ENCODINGS


def server_info(settings: Settings, draining: bool) -> pb.ServerInfo:
    """The response of the handshake."""
    return pb.ServerInfo(
        api_version=API_VERSION,
        server_version=ddakf.__version__,
        point_codecs=[c for c in CODECS.values() if c != pb.POINT_CODEC_DRACO or draco.installed()],
        depth_compressions=DEPTH_CODECS.values(),
        result_encodings=RESULT_ENCODINGS,
        fabrics=PRESETS,
        max_message_bytes=settings.max_message_bytes,
        max_limits=pb.SessionLimits(
            max_points=settings.max_points,
            max_frame_rate=settings.max_frame_rate,
            idle_timeout=settings.idle_timeout,
            max_lifetime=settings.max_lifetime,
            max_frames_in_flight=settings.lossless_queue,
            departure_timeout=settings.idle_timeout,
        ),
        max_vertices=settings.max_vertices,
        max_body_vertices=settings.max_body_vertices,
        draining=draining,
        build=build(),
    )
