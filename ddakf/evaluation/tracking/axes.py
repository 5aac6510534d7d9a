"""Axes of a recording: whether a template that was not found fits its points when it is turned to another axis."""

from __future__ import annotations

from dataclasses import replace
from itertools import islice

import numpy as np

import ddakf
from ddakf.config import Start
from ddakf.errors import DdakfError
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.tracking.sources import Source
from ddakf.mesh import Mesh

DOUBTED = 0.5  # mean reliability of a run, below which the axes are doubted
FRAMES = 5  # with points, on which each turn is tried
FOUND, BETTER = 0.6, 0.25  # least reliability of a turn that fits, and how much higher than without a turn
AXES = ("x", "y", "z", "-x", "-y", "-z")


def fitting_turn(source: Source, config: ddakf.Config) -> str:
    """The sentence that says how a template of other axes than the points has to be turned; empty: no turn helps.

    Either the points or the template may have another axis up than the configuration says; headings are searched about the axis
    of the points.

    Args:
        source: of a recording whose template was not found.
        config: of the tracker.
    """
    frames, up = list(islice((frame for frame in source if len(frame.points)), FRAMES)), config.start.up
    before, found = _reliability(source.garment, frames, config, np.eye(3)), {}
    for other in AXES:
        if other == up:
            continue
        for rotation, upward in ((turn(other, up), up), (turn(up, other), other)):
            turned = replace(config, start=replace(config.start, up=upward))
            found[_reliability(source.garment, frames, turned, rotation)] = rotation
    best = max(found)
    if best < max(FOUND, before + BETTER):
        return ""
    vertices = ", ".join(map(_coordinate, found[best]))
    then = _coordinate(Start(up=up).to_y_up[1] @ found[best].T)
    fits = f"turned to [{vertices}] it fits the first points, at a reliability of {best:.2f} instead of {before:.2f}"
    config_of = f'--config \'{{"start": {{"up": "{then}"}}}}\''
    return f"template: expected the axes of the points; {fits}: turn its file, and if {then} of the points is up add {config_of}"


def turn(before: str, after: str) -> np.ndarray:
    """(3, 3) rotation of a mesh with one axis up to one with another axis up."""
    return Start(up=after).to_y_up.T @ Start(up=before).to_y_up


def _reliability(garment: Mesh, frames: list[CapturedFrame], config: ddakf.Config, rotation: np.ndarray) -> float:
    """The reliability after some frames of a garment that is turned about its middle."""
    middle = garment.vertices.mean(axis=0)
    tracker = ddakf.Tracker(Mesh((garment.vertices - middle) @ rotation.T + middle, garment.faces), config=config)
    reliability = 0.0
    try:
        for frame in frames:
            how = {"sensor_origin": frame.sensor_origin, "colors": frame.colors}
            reliability = tracker.step(frame.points, timestamp=frame.timestamp, **how).reliability
    except DdakfError:
        return 0.0
    return reliability


def _coordinate(row: np.ndarray) -> str:
    """The coordinate that a row of such a rotation takes, as of a configuration's ``up``."""
    axis = int(np.abs(row).argmax())
    return ("-" if row[axis] < 0 else "") + "xyz"[axis]
