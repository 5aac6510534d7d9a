"""API keys: created and shown once, stored as hashes.

A key is ``ddakf_ID_SECRET``: the id selects the stored key, the secret has 256 random bits. They cannot be guessed, so one
SHA-256 protects the stored secret; a slow hash is for passwords that people choose.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import logging
import re
import secrets
import time
from collections.abc import Callable, Iterable, Mapping, Set
from dataclasses import dataclass
from datetime import UTC, datetime
from time import monotonic
from typing import NamedTuple, Protocol

from ddakf_api.errors import Unauthenticated, Unavailable

from ..observability.logs import FailureLog
from .principal import Principal, Scope

log = logging.getLogger(__name__)

PREFIX = "ddakf"
_PATTERN = re.compile(rf"{PREFIX}_([0-9a-f]{{12}})_([A-Za-z0-9_-]{{43}})")
_REFRESH = 5.0  # seconds between reads of the stored keys
_UNKNOWN_KEY_REFRESH = 0.5  # seconds between reads on behalf of unknown keys
_EMPTY_DIGEST = bytes(32)


class KeyLimits(NamedTuple):
    """Limits of a key; 0 and None: none of its own.

    Attributes:
        max_sessions: at a time. frames_per_second: of all its streams. requests_per_minute: calls, streams included.
        expires: seconds since 1970.
    """

    max_sessions: int = 0
    frames_per_second: float = 0.0
    requests_per_minute: float = 0.0
    expires: float | None = None


NO_LIMITS = KeyLimits()


@dataclass(frozen=True)
class Key:
    """A stored key.

    Attributes:
        id: 12 hexadecimal digits, the middle part of the key.
        digest: SHA-256 of the secret.
        name: purpose or holder.
        created, revoked: seconds since 1970; revoked None: valid.
        limits: what its principal may do.
    """

    id: str
    digest: bytes
    name: str
    scopes: frozenset[Scope]
    created: float
    limits: KeyLimits = NO_LIMITS
    revoked: float | None = None

    @property
    def principal(self) -> Principal:
        limits = self.limits
        return Principal(self.id, self.scopes, limits.max_sessions, limits.frames_per_second, limits.requests_per_minute)

    def has_expired(self) -> bool:
        return self.limits.expires is not None and time.time() >= self.limits.expires

    def matches(self, presented_key: str) -> bool:
        """Whether a text is this key."""
        matched = _PATTERN.fullmatch(presented_key)
        return matched is not None and matched[1] == self.id and hmac.compare_digest(_digest(matched[2]), self.digest)


class KeyStore(Protocol):
    """Storage of keys; its methods block."""

    def all(self) -> Iterable[Key]:
        """All keys, with the revoked ones."""

    def add(self, key: Key) -> None:
        """Stores a new key."""

    def revoke(self, key_id: str, at: float) -> bool:
        """Revokes a key; False without a valid key of this id."""


def generate(name: str, scopes: Iterable[Scope], created: float, limits: KeyLimits = NO_LIMITS) -> tuple[Key, str]:
    """A new key: as stored, and as text for its holder."""
    key_id, secret = secrets.token_hex(6), secrets.token_urlsafe(32)
    key = Key(key_id, _digest(secret), name, frozenset(scopes), created, limits)
    return key, f"{PREFIX}_{key_id}_{secret}"


def id_of(presented_key: str) -> str:
    """The id within a key, which is no secret; empty: the text has not the form of a key."""
    matched = _PATTERN.fullmatch(presented_key)
    return matched[1] if matched else ""


def utc(seconds: float) -> str:
    """A time since 1970 as ISO 8601."""
    return datetime.fromtimestamp(seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def _digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode()).digest()


class KeyRing:
    """The valid keys in memory; follows changes of the store within some seconds.

    Args:
        store: the stored keys.
        on_revoked: called after each read with the ids of all keys that were revoked or have expired since the start.
        on_loaded: called after the first read.

    Attributes:
        loaded: the keys have been read.
    """

    def __init__(
        self, store: KeyStore, on_revoked: Callable[[Set[str]], None], on_loaded: Callable[[], None] = lambda: None
    ):
        self._store, self._on_revoked, self._on_loaded = store, on_revoked, on_loaded
        self._keys: dict[str, Key] = {}
        self._in_force: dict[str, Key] = {}
        self._known_ids: set[str] = set()
        self.loaded = False
        self._failures = FailureLog(log, "the keys cannot be read, known ones stay valid", "the keys can be read again")
        self._load_started = -_REFRESH  # time of the last attempt (monotonic clock, seconds)
        self._load_lock: asyncio.Lock = asyncio.Lock()
        self._task: asyncio.Task | None = None

    async def start(self) -> None:
        """Loads the keys and starts to follow their changes."""
        async with self._load_lock:
            await self._load()
        self._task = asyncio.create_task(self._follow())

    async def stop(self) -> None:
        if self._task:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task

    async def principal(self, presented_key: str) -> Principal:
        """The principal of a key.

        Raises:
            Unauthenticated: the key has expired; or it is unknown or revoked, and the message does not tell which.
            Unavailable: the keys have not been read yet.
        """
        matched = _PATTERN.fullmatch(presented_key)
        key_id, secret = matched.groups() if matched else ("", "")
        if matched and key_id not in self._keys:
            await self._load_unknown()  # the key may be new
            if not self.loaded:
                raise Unavailable("the keys cannot be read now; try again later", retry_after=_REFRESH)
        key = self._keys.get(key_id)
        # the comparison takes the same time for unknown keys
        right = hmac.compare_digest(_digest(secret), key.digest if key else _EMPTY_DIGEST)
        if key is None or not right:
            raise Unauthenticated("the key is not known, or not any more")
        if key.has_expired():
            raise Unauthenticated(f"the key expired at {utc(key.limits.expires)}: ask for a new one")
        return key.principal

    def __len__(self) -> int:
        return len(self._keys)

    async def _follow(self) -> None:
        while True:
            await asyncio.sleep(_REFRESH)
            try:
                async with self._load_lock:
                    await self._load()
            except Exception:  # the loop must go on: a key revoked later would stay valid
                log.exception("the keys could not be read again")

    async def _load_unknown(self) -> None:
        """Reads the keys, unless another call has done so since; at most every :data:`_UNKNOWN_KEY_REFRESH` seconds."""
        requested_at = monotonic()
        async with self._load_lock:
            if self._load_started < requested_at:
                await asyncio.sleep(self._load_started + _UNKNOWN_KEY_REFRESH - requested_at)
                await self._load()

    async def _load(self) -> None:
        """Reads the keys. They stay valid while the store cannot be read. The caller holds the lock."""
        self._load_started = monotonic()
        try:
            keys = await asyncio.to_thread(lambda: list(self._store.all()))
        except Exception as error:  # of any driver
            self._failures.fails(error)
            if self.loaded:
                self._enforce()
            return
        self._failures.works()
        self._keys = {key.id: key for key in keys if key.revoked is None}
        self._enforce()

    def _enforce(self) -> None:
        """Acts on the keys that were read, some of which may have expired since."""
        first, self.loaded = not self.loaded, True
        before, self._in_force = self._in_force, {key.id: key for key in self._keys.values() if not key.has_expired()}
        self._known_ids |= self._in_force.keys()
        if not first:
            self._log_changes(before)
        self._on_revoked(self._known_ids - self._in_force.keys())
        if first:
            self._on_loaded()

    def _log_changes(self, before: Mapping[str, Key]) -> None:
        for key_id in self._in_force.keys() - before.keys():
            log.info("a key was created", extra={"key": key_id, "scopes": " ".join(sorted(self._in_force[key_id].scopes))})
        for key_id in before.keys() - self._in_force.keys():
            log.info("a key has expired" if key_id in self._keys else "a key was revoked", extra={"key": key_id})
