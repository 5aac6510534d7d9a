"""Components shared by the operations on sessions and the streams."""

from __future__ import annotations

from typing import NamedTuple

from ..settings import Settings
from ..workers.pool import WorkerPool
from .admission import Admission
from .catalog import SessionCatalog
from .durability import Durability
from .persistence import Persistence
from .tracker_access import TrackerAccess


class SessionComponents(NamedTuple):
    """One of each per server, created by :class:`.service.Sessions`."""

    pool: WorkerPool
    settings: Settings
    admission: Admission
    catalog: SessionCatalog
    persistence: Persistence
    durability: Durability
    tracker_access: TrackerAccess
