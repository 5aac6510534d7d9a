"""Components shared by the operations on sessions and the streams."""

from __future__ import annotations

from typing import NamedTuple

from ..background_tasks import BackgroundTasks
from ..settings import Settings
from ..workers.pool import WorkerPool
from .catalog import SessionCatalog
from .limits.admission import Admission
from .limits.penalties import Penalties
from .ownership import Ownership
from .recovery.durability import Durability
from .recovery.persistence import Persistence
from .recovery.tracker_access import TrackerAccess


class SessionComponents(NamedTuple):
    """One of each per server, created by :class:`.service.Sessions`."""

    pool: WorkerPool
    settings: Settings
    admission: Admission
    catalog: SessionCatalog
    persistence: Persistence
    durability: Durability
    penalties: Penalties
    tracker_access: TrackerAccess
    ownership: Ownership
    tasks: BackgroundTasks
