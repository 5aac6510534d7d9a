"""Guard: admits or rejects every call of gRPC, REST and WebSocket by its key and scopes.

A call that no table here names needs the scope ``admin``, so a new call is closed by default.
"""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Mapping
from time import monotonic
from urllib.parse import urlsplit

from ddakf_api.errors import PermissionDenied, ResourceExhausted, Unauthenticated
from ddakf_api.v1 import tracking_pb2 as pb

from ..token_bucket import TokenBucket
from .keys import KeyRing
from .principal import ANONYMOUS, STRANGER, Principal, Scope
from .refusals import Refusals

_SERVICE = "/" + pb.DESCRIPTOR.services_by_name["TrackingService"].full_name + "/"
OPEN: frozenset[Scope] = frozenset()  # no key needed
READ, STREAM, ADMIN = (frozenset({scope}) for scope in (Scope.READ, Scope.STREAM, Scope.ADMIN))
READ_OWN = frozenset({Scope.READ, Scope.STREAM})  # a key with the scope stream reads its own sessions
GRPC_SCOPES: dict[str, frozenset[Scope]] = {
    _SERVICE + "GetServerInfo": OPEN,
    "/grpc.health.v1.Health/Check": OPEN,
    "/grpc.health.v1.Health/Watch": OPEN,
    "/grpc.health.v1.Health/List": OPEN,
    **{_SERVICE + name: READ_OWN for name in ("GetSession", "ListSessions", "WatchSession", "GetSessionHistory")},
    **{_SERVICE + name: STREAM for name in ("CreateSession", "RestoreSession", "Track")},
    **{_SERVICE + name + "Session": STREAM for name in ("Update", "Reset", "Delete", "Snapshot")},
    **{_SERVICE + name: STREAM for name in ("CreateMesh", "GetMesh", "ListMeshes", "DeleteMesh")},
}
"""Sufficient scopes by method; one of them is enough."""

OPEN_PATHS = frozenset({"/", "/healthz", "/readyz", "/v1/info", "/docs", "/openapi.json"})
_OPEN_FOLDER = "/assets/"  # of the dashboard's page
_MINUTE = 60.0  # seconds; as many calls as a minute's may come at once
_FORWARDING = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip")


class Guard:
    """Identifies the caller and checks the scopes.

    Args:
        keys: the valid keys.
        anonymous: calls without a key are allowed everything.
        local: restricts ``anonymous`` to calls from this machine. It excludes calls that a proxy forwards, and web pages
            whose host name was made to resolve to this machine.
        refusals: where the transports record the calls that are not admitted.
    """

    def __init__(self, keys: KeyRing, refusals: Refusals, *, anonymous: bool, local: bool):
        self._keys, self.refusals, self._anonymous, self._local = keys, refusals, anonymous, local
        self._buckets: dict[str, TokenBucket] = {}  # of calls, by key

    async def admit(self, presented_key: str | None, sufficient: frozenset[Scope], headers: Mapping[str, str]) -> Principal:
        """The principal of a call. The catalog of sessions checks ownership.

        Args:
            presented_key: None: no key.
            sufficient: scopes, of which one is enough.
            headers: of the call, in lower case.

        Raises:
            Unauthenticated: a key is needed, or the presented key is unknown (even where no key is needed).
            PermissionDenied: the key has no sufficient scope. ResourceExhausted: it calls more often than it may.
        """
        if presented_key is None:
            remote = _remote_origin(headers) if self._local else ""
            if self._anonymous and not remote:
                return ANONYMOUS
            if not sufficient:
                return STRANGER
            raise Unauthenticated(f"a key is needed{remote}: send it as 'authorization: Bearer KEY'")
        principal = await self._keys.principal(presented_key)
        if sufficient and not any(principal.allows(scope) for scope in sufficient):
            raise PermissionDenied(f"this needs a key with the scope {' or '.join(sorted(sufficient))}")
        self._require_rate(principal)
        return principal

    def _require_rate(self, principal: Principal) -> None:
        rate = principal.requests_per_minute
        bucket = self._buckets.setdefault(principal.id, TokenBucket(_MINUTE))
        if pause := bucket.wait(rate / _MINUTE, monotonic()):
            message = f"the key may make {rate:g} requests per minute; try again in {math.ceil(pause)} s"
            raise ResourceExhausted(message, retry_after=pause)


def _remote_origin(headers: Mapping[str, str]) -> str:
    """Reason why a call over loopback may come from another machine; empty: it does not."""
    if proxied := next((name for name in _FORWARDING if name in headers), ""):
        return f", as a proxy has forwarded this ({proxied})"
    host = headers.get("host", "")
    if not host or "origin" in headers:  # a page with an origin; see OriginCheck
        return ""
    return "" if is_own_name(host) else f", as this was sent to {host[:80]!r} (allow_anonymous lets it in)"


def bearer_key(value: str | None) -> str | None:
    """The key of an authorization header. Any other value is returned unchanged and later rejected as unknown."""
    if value is None:
        return None
    kind, _, key = value.partition(" ")
    return key.strip() if kind.lower() == "bearer" else value


def http_scopes(scope) -> frozenset[Scope]:
    """Sufficient scopes of an HTTP or WebSocket call: GET and watchers need to read, changes need ``stream``."""
    path = scope["path"].rstrip("/\n") or "/"  # route patterns accept a trailing line feed
    if path in OPEN_PATHS or path.startswith(_OPEN_FOLDER):
        return OPEN
    sessions = path == "/v1/sessions" or path.startswith(("/v1/sessions/", "/v1/sessions:"))
    reading = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
    if path in ("/metrics", "/v1/recording") and reading:
        return READ
    if path == "/v1/sample" and reading:
        return READ_OWN
    if scope["type"] == "http" and (path == "/v1/meshes" or path.startswith("/v1/meshes/")):
        return STREAM  # those of the key
    if not sessions:
        return ADMIN
    if scope["type"] == "websocket":
        return READ_OWN if path.endswith("/watch") else STREAM
    # a snapshot is enough to restore the session elsewhere
    return READ_OWN if reading and not path.endswith("/snapshot") else STREAM


def is_own_name(host: str) -> bool:
    """Whether a Host header is an address or "localhost". Any other name may have been made to resolve to this machine."""
    try:
        name = urlsplit("//" + host).hostname or ""
        return name == "localhost" or bool(ipaddress.ip_address(name))
    except ValueError:
        return False
