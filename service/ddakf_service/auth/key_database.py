"""Key database: API keys in the service's database."""

from __future__ import annotations

from collections.abc import Iterable

import sqlalchemy as sa

from ..store.tables.database import Database
from ..store.tables.schema import api_keys
from .keys import PREFIX, Key, KeyLimits
from .principal import Scope


class DatabaseKeyStore:
    """A :class:`~.keys.KeyStore` in an open database; raises ``Unavailable`` while it cannot be reached."""

    def __init__(self, database: Database):
        self._database = database

    def all(self) -> Iterable[Key]:
        """All keys, oldest first."""
        rows = self._database.read_now(lambda c: c.execute(sa.select(api_keys).order_by(api_keys.c.create_time)).all())
        return [_key(row) for row in rows]

    def add(self, key: Key) -> None:
        values = {
            "hash": key.digest,
            "prefix": f"{PREFIX}_{key.id}",
            "name": key.name,
            "scopes": " ".join(sorted(key.scopes)),
            "max_sessions": key.limits.max_sessions,
            "frames_per_second": key.limits.frames_per_second,
            "requests_per_minute": key.limits.requests_per_minute,
            "create_time": key.created,
            "expire_time": key.limits.expires,
        }
        self._database.read_now(lambda c: c.execute(sa.insert(api_keys).values(values)))

    def revoke(self, key_id: str, at: float) -> bool:
        in_force = sa.and_(api_keys.c.prefix == f"{PREFIX}_{key_id}", api_keys.c.revoke_time.is_(None))
        change = sa.update(api_keys).where(in_force).values(revoke_time=at)
        return self._database.read_now(lambda c: c.execute(change)).rowcount > 0


def _key(row) -> Key:
    return Key(
        id=row.prefix.removeprefix(f"{PREFIX}_"),
        digest=row.hash,
        name=row.name,
        scopes=frozenset(Scope(scope) for scope in row.scopes.split()),
        created=row.create_time,
        limits=KeyLimits(row.max_sessions, row.frames_per_second, row.requests_per_minute, row.expire_time),
        revoked=row.revoke_time,
    )
