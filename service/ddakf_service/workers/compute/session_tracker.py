"""Tracker of a session, and the lighter one that goes on for it while its worker has too little time."""

from __future__ import annotations

import logging
from concurrent.futures import Executor, Future, wait

import ddakf

log = logging.getLogger(__name__)


class SessionTracker:
    """The two trackers of a session, of which one is in use. The other one goes on from it when their turn changes.

    Args:
        tracker: with the session's configuration.
        builder: builds the lighter one, beside frames.
    """

    def __init__(self, tracker: ddakf.Tracker, builder: Executor):
        self._own, self._builder = tracker, builder
        self._lighter: Future[ddakf.Tracker] | None = None
        self.is_lighter = False

    def prepare(self) -> None:
        """Builds the lighter tracker before it is needed."""
        self._built()

    def await_lighter(self, patience: float) -> None:
        """Returns when the lighter tracker is built, or after as many seconds."""
        if self._lighter is not None:
            wait([self._lighter], patience)

    @property
    def has_lighter(self) -> bool:
        """There is a lighter tracker, or may be one: the lightest configurations and meshes of one's own have none."""
        return self._lighter is None or not self._lighter.done() or self._lighter.result() is not None

    def of_frame(self, lighter: bool) -> ddakf.Tracker:
        """The tracker of the next frame: the session's own, or if wanted the lighter one as soon as it is built."""
        if not lighter:
            return self.own()
        built = self._built()
        if built is None:
            return self._own
        if not self.is_lighter:
            built.continue_from(self._own)
            self.is_lighter = True
        return built

    def own(self) -> ddakf.Tracker:
        """The tracker with the session's configuration, after the last frame; it tracks the next one."""
        own, self.is_lighter = self.brought_up(), False
        return own

    def brought_up(self) -> ddakf.Tracker:
        """The tracker with the session's configuration, after the last frame; the one in use goes on from where it is."""
        if self.is_lighter:
            self._own.continue_from(self._lighter.result())
        return self._own

    def _built(self) -> ddakf.Tracker | None:
        """The lighter tracker; None while it is built, and where there is none."""
        if self._lighter is None:
            config = self._own.config
            lighter = config.lighter()
            self._lighter = self._builder.submit(self._build, lighter) if lighter != config else _nothing()
        return self._lighter.result() if self._lighter.done() else None

    def _build(self, config: ddakf.Config) -> ddakf.Tracker | None:
        try:
            return self._own.configured(config)
        except Exception:
            log.exception("no lighter tracker can be built")
            return None


def _nothing() -> Future[None]:
    future: Future[None] = Future()
    future.set_result(None)
    return future
