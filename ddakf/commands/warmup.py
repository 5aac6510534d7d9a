"""Loading of every kernel, compiled where the cache lacks it, by tracking a small garment over a small body."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from contextlib import suppress

import numpy as np
from numba.core import event

from ddakf.config import Config
from ddakf.files.cache import drop_unused, used
from ddakf.first_frame import tube
from ddakf.kernels import cache
from ddakf.tracker import Tracker

Progress = Callable[[str, int, int, str], None]
"""Called as ``progress(activity, done, total, name)``; activity is "loading", and "compiling" once the cache lacked a kernel."""


def warm(progress: Progress = lambda activity, done, total, name: None) -> None:
    """Loads every kernel from the cache, or compiles it, by tracking a small garment.

    Args:
        progress: called before each step, when the first kernel is compiled, and at the end with ``done == total``.
    """
    garment, body = tube(0.22, 36, 32), tube(0.2, 10, 8)
    cloud = garment.vertices[garment.faces].mean(axis=1)
    cloud = np.concatenate([cloud, garment.vertices])
    astray = np.array([[0.0, 0.1, 0.5], [0.3, 0.2, 0.3], [-0.4, 0.3, 0.1]])  # what a filter removes
    eye = np.array([0.0, 0.0, 2.0])
    sensors = np.where(np.concatenate([cloud, astray])[:, 2:] > 0.0, eye, -eye)
    layers = dataclasses.replace(Config(), physics=dataclasses.replace(Config().physics, self_collision=1e8, strain_sd=1e-4))
    working = dataclasses.replace(Config().discretisation, working_vertices_least=100, working_vertices_most=200)
    fine = dataclasses.replace(Config(), discretisation=working)  # the tube is fine beside so few vertices
    near = ((0.0, 0.0), (0.03, 1 / 30))  # where it is, and 3 cm farther for cluster alignment: shift and time, m and s
    far = (0.5, 1.5)  # elsewhere, which is searched after a gap
    steps = [
        ("cloud alone", None, Config(), dict(sensor_origin=None), (*near, far)),
        ("one camera and a body", body, Config(), dict(sensor_origin=eye, body_vertices=body.vertices), near),
        ("several cameras", None, Config(), dict(sensor_origin=sensors), near),
        ("soft layers that collide", None, layers, dict(sensor_origin=None), near),
        ("a fine template", None, fine, dict(sensor_origin=None), near),
        ("colours", None, Config(), dict(sensor_origin=eye, colors=np.full((len(cloud) + len(astray), 3), 128, np.uint8)), near),
        ("the paper's preset", None, Config.paper(), dict(sensor_origin=None), near),
    ]
    announcer = _Announcer(progress, len(steps))
    with event.install_listener("numba:compile", announcer):
        for name, skeleton, config, how, places in steps:
            announcer.next_step(name)
            tracker = Tracker(garment, body=skeleton, config=config)
            for shift, timestamp in places:
                tracker.step(np.concatenate([cloud + [shift, 0, 0], astray]), timestamp=timestamp, **how)
        Tracker(garment).step(cloud[cloud[:, 2] > 0.0], timestamp=0.0)  # one side, whose bulge tells the sensor's place
    _drop_other_versions()
    announcer.next_step("done")


def _drop_other_versions() -> None:
    for folder in cache.folders():
        with suppress(OSError):  # another user's, or read-only, as in an image
            used(folder)
    place = cache.directory()
    drop_unused([*place.glob("*-*"), *place.parent.glob("kernels-*")])  # the latter of versions up to 0.1


class _Announcer(event.Listener):
    """Calls ``progress`` before each step, and when the first kernel is compiled."""

    def __init__(self, progress: Progress, total: int):
        self._progress, self._total, self._done = progress, total, -1
        self._activity, self._name = "loading", ""

    def next_step(self, name: str) -> None:
        self._done, self._name = self._done + 1, name
        self._progress(self._activity, self._done, self._total, self._name)

    def on_start(self, event: event.Event) -> None:
        """A kernel is compiled."""
        if self._activity == "loading":
            self._activity = "compiling"
            self._progress(self._activity, self._done, self._total, self._name)

    def on_end(self, event: event.Event) -> None:
        """Nothing to announce."""
