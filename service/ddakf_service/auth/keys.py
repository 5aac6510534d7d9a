"""API keys: made once, shown once, kept as hashes.

A key is ``ddakf_ID_SECRET``: the id finds it, the secret has 256 random bits. So many cannot be guessed or enumerated, which is
why one SHA-256 of the secret is enough at rest; slow hashes are for what people choose.
"""

from __future__ import annotations

import asyncio
import contextlib
import hashlib
import hmac
import logging
import re
import secrets
from collections.abc import Callable, Iterable, Set
from dataclasses import dataclass
from time import monotonic
from typing import Protocol

from ddakf_api.errors import Unauthenticated, Unavailable

from .principal import Principal, Scope

log = logging.getLogger(__name__)

PREFIX = "ddakf"
_PATTERN = re.compile(rf"{PREFIX}_([0-9a-f]{{12}})_([A-Za-z0-9_-]{{43}})")
_REFRESH = 5.0  # seconds until a change of the keys is noticed
_UNKNOWN_REFRESH = 0.5  # seconds between looks for a key that is not known yet
_NOBODY = bytes(32)


@dataclass(frozen=True)
class Key:
    """A key as it is stored.

    Attributes:
        id: 12 hexadecimal digits, the middle of the key.
        digest: SHA-256 of the secret.
        name: whom it is for.
        created, revoked: seconds since the epoch; revoked None: in force.
    """

    id: str
    digest: bytes
    name: str
    scopes: frozenset[Scope]
    created: float
    max_sessions: int = 0
    revoked: float | None = None

    @property
    def principal(self) -> Principal:
        return Principal(self.id, self.scopes, self.max_sessions)


class KeyStore(Protocol):
    """Where keys are kept; blocking."""

    def all(self) -> Iterable[Key]:
        """All, the revoked ones too."""

    def add(self, key: Key) -> None:
        """Keeps a new one."""

    def revoke(self, key_id: str, at: float) -> bool:
        """Whether there was one in force."""


def generate(name: str, scopes: Iterable[Scope], created: float, max_sessions: int = 0) -> tuple[Key, str]:
    """A new key as it is stored, and as its holder gets it."""
    key_id, secret = secrets.token_hex(6), secrets.token_urlsafe(32)
    key = Key(key_id, _digest(secret), name, frozenset(scopes), created, max_sessions)
    return key, f"{PREFIX}_{key_id}_{secret}"


def _digest(secret: str) -> bytes:
    return hashlib.sha256(secret.encode()).digest()


class KeyRing:
    """The keys in force, in memory; a change in the store is followed within some seconds.

    Args:
        store: where they are kept.
        on_revoked: told the ids of all keys that were in force since the start and are not any more, each time they are read.
    """

    def __init__(self, store: KeyStore, on_revoked: Callable[[Set[str]], None]):
        self._store, self._on_revoked = store, on_revoked
        self._keys: dict[str, Key] = {}
        self._seen: set[str] = set()
        self._read = False
        self._began = -_REFRESH  # when that was tried last (monotonic clock)
        self._loading: asyncio.Lock = asyncio.Lock()
        self._task: asyncio.Task | None = None

    async def start(self) -> None:
        """Loads the keys and keeps following them."""
        async with self._loading:
            await self._load()
        self._task = asyncio.create_task(self._follow())

    async def stop(self) -> None:
        if self._task:
            self._task.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await self._task

    async def principal(self, presented: str) -> Principal:
        """Whose key this is.

        Raises:
            Unauthenticated: nobody's, or a revoked one's. Which of the two is not said.
            Unavailable: the keys could not be read yet.
        """
        matched = _PATTERN.fullmatch(presented)
        key_id, secret = matched.groups() if matched else ("", "")
        if matched and key_id not in self._keys:
            await self._look()  # perhaps it is new
            if not self._read:
                raise Unavailable("the keys cannot be read now; try again later", retry_after=_REFRESH)
        key = self._keys.get(key_id)
        # the comparison takes as long for unknown keys as for known ones
        right = hmac.compare_digest(_digest(secret), key.digest if key else _NOBODY)
        if key is None or not right:
            raise Unauthenticated("the key is not known, or not any more")
        return key.principal

    def __len__(self) -> int:
        return len(self._keys)

    async def _follow(self) -> None:
        while True:
            await asyncio.sleep(_REFRESH)
            try:
                async with self._loading:
                    await self._load()
            except Exception:  # without this the next revoked key would be in force for ever
                log.exception("a change of the keys could not be followed")

    async def _look(self) -> None:
        """Reads the keys, unless others have since this was asked; not more often than every so often, however many ask."""
        asked = monotonic()
        async with self._loading:
            if self._began < asked:
                await asyncio.sleep(self._began + _UNKNOWN_REFRESH - asked)
                await self._load()

    async def _load(self) -> None:
        """What is known stays in force while the store cannot be read. The caller holds the lock."""
        self._began = monotonic()
        try:
            keys = await asyncio.to_thread(lambda: list(self._store.all()))
        except Exception as error:  # of any database driver
            log.warning("the keys could not be read: %s", type(error).__name__)
            return
        self._keys, self._read = {key.id: key for key in keys if key.revoked is None}, True
        self._seen |= self._keys.keys()
        self._on_revoked(self._seen - self._keys.keys())
