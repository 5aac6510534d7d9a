"""Where sessions are computed: an interface, and the processes of this machine that implement it."""

from .pool import Health, Limits, Memory, WorkerPool, worker_lost

__all__ = ["Health", "Limits", "Memory", "WorkerPool", "worker_lost"]
