"""The one place where a call is let through or refused, for gRPC, REST and WebSocket alike.

What is not named in a table here needs the scope ``admin``: a new call is closed until somebody opens it.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Mapping
from urllib.parse import urlsplit

from ddakf_api.errors import PermissionDenied, Unauthenticated
from ddakf_api.v1 import tracking_pb2 as pb

from .keys import KeyRing
from .principal import ANONYMOUS, Principal, Scope

_SERVICE = "/" + pb.DESCRIPTOR.services_by_name["TrackingService"].full_name + "/"
OPEN: frozenset[Scope] = frozenset()  # nobody is asked for a key
READ, STREAM, ADMIN = (frozenset({scope}) for scope in (Scope.READ, Scope.STREAM, Scope.ADMIN))
READ_OWN = frozenset({Scope.READ, Scope.STREAM})  # those who stream may read what is theirs
GRPC_SCOPES: dict[str, frozenset[Scope]] = {
    _SERVICE + "GetServerInfo": OPEN,
    "/grpc.health.v1.Health/Check": OPEN,
    "/grpc.health.v1.Health/Watch": OPEN,
    "/grpc.health.v1.Health/List": OPEN,
    **{_SERVICE + name: READ_OWN for name in ("GetSession", "ListSessions", "WatchSession", "GetSessionHistory")},
    **{_SERVICE + name: STREAM for name in ("CreateSession", "RestoreSession", "Track")},
    **{_SERVICE + name + "Session": STREAM for name in ("Update", "Reset", "Delete", "Snapshot")},
}
"""By method the scopes of which one is enough."""

OPEN_PATHS = frozenset({"/healthz", "/readyz", "/v1/info", "/docs", "/docs/oauth2-redirect", "/redoc", "/openapi.json"})
_FORWARDING = ("forwarded", "x-forwarded-for", "x-forwarded-host", "x-real-ip")


class Guard:
    """Finds out who calls, and whether they may.

    Args:
        keys: those in force.
        anonymous: calls without a key are anyone's, and allowed everything.
        local: but only those of this machine, not what a proxy forwards, nor a page whose name was made to point here.
    """

    def __init__(self, keys: KeyRing, *, anonymous: bool, local: bool):
        self._keys, self._anonymous, self._local = keys, anonymous, local

    async def admit(self, presented: str | None, enough: frozenset[Scope], headers: Mapping[str, str]) -> Principal:
        """Who presents this key, if they have one of the scopes that are enough; what is theirs is known to the sessions.

        Args:
            presented: the key; None: no key.
            headers: of the call, in lower case.

        Raises:
            Unauthenticated: no key where one is needed, or one that is not known, even where none is needed.
            PermissionDenied: the key's scopes do not include this.
        """
        if presented is None:
            elsewhere = _elsewhere(headers) if self._local else ""
            if not enough or (self._anonymous and not elsewhere):
                return ANONYMOUS
            raise Unauthenticated(f"a key is needed{elsewhere}: send it as 'authorization: Bearer KEY'")
        principal = await self._keys.principal(presented)
        if enough and not any(principal.allows(scope) for scope in enough):
            raise PermissionDenied(f"this needs a key with the scope {' or '.join(sorted(enough))}")
        return principal


def _elsewhere(headers: Mapping[str, str]) -> str:
    """Why a call that comes over loopback may be of somebody elsewhere; empty: it is not."""
    if proxied := next((name for name in _FORWARDING if name in headers), ""):
        return f", as a proxy has forwarded this ({proxied})"
    host = headers.get("host", "")
    if not host or "origin" in headers:  # of a page that says whose it is; see OriginCheck
        return ""
    return "" if is_own_name(host) else f", as this was sent to {host[:80]!r} (allow_anonymous lets it in)"


def bearer_key(value: str | None) -> str | None:
    """The key of an authorization header; what is none is presented as it is, and refused as unknown."""
    if value is None:
        return None
    kind, _, key = value.partition(" ")
    return key.strip() if kind.lower() == "bearer" else value


def http_scopes(scope) -> frozenset[Scope]:
    """The scopes of which one is enough: reading is for GET and for watchers, what changes something for those who stream."""
    path = scope["path"].rstrip("/\n") or "/"  # the patterns of routes let one line feed pass at the end
    if path in OPEN_PATHS:
        return OPEN
    sessions = path == "/v1/sessions" or path.startswith(("/v1/sessions/", "/v1/sessions:"))
    reading = scope["type"] == "http" and scope["method"] in ("GET", "HEAD")
    if path == "/metrics" and reading:
        return READ
    if not sessions:
        return ADMIN
    if scope["type"] == "websocket":
        return READ_OWN if path.endswith("/watch") else STREAM
    # whoever has a snapshot can have the session elsewhere
    return READ_OWN if reading and not path.endswith("/snapshot") else STREAM


def is_own_name(host: str) -> bool:
    """Whether a Host header has an address or "localhost", rather than a name that anybody may have made to point here."""
    try:
        name = urlsplit("//" + host).hostname or ""
        return name == "localhost" or bool(ipaddress.ip_address(name))
    except ValueError:
        return False
