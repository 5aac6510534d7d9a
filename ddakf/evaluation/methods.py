"""The methods that trials compare: variants of the tracker's configuration, and the baselines, all behind one call per frame."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from ddakf.config import Config
from ddakf.errors import InvalidArgument
from ddakf.evaluation.baselines import BASELINES, Baseline, baseline
from ddakf.evaluation.protocols import NOTHING_SAID, Scored
from ddakf.evaluation.source import Frame
from ddakf.mesh import Mesh
from ddakf.tracker import Tracker


class Estimate(NamedTuple):
    """What a method says about one frame; the fields after the first are None where it says nothing about them."""

    vertices: np.ndarray  # (V, 3) m
    covariance: np.ndarray | None = None  # (V, 3, 3) m^2
    observed: np.ndarray | None = None  # (V,) bool
    reliability: float | None = None
    paper_score: float | None = None
    coverage: float | None = None
    state: str | None = None
    effective_sample_size: float | None = None  # of a particle filter


Method = Callable[[Frame], Estimate]
Maker = Callable[[Mesh, np.ndarray, Mesh | None], Method]  # of garment, start (V, 3) in metres, and body


def ablations() -> dict[str, Config]:
    """The default without each of its five changes to the paper's method, one at a time."""
    default = Config()
    association = default.associate
    blind = replace(association, facing_cosine=-1.0, normal_cosine=-1.0, hidden_depth=100.0)
    once = replace(association, iterations=1, least_iterations=1)
    alone = replace(default.physics, motion_rigidity=0.0, rest_rigidity=0.0, uneven_rigidity=0.0)
    return {
        "no-planes": replace(default, associate=replace(association, tangential_sd=default.adapt.initial_sd)),
        "one-association": replace(without_levels(), associate=once),
        "no-visibility": replace(default, associate=blind),
        "no-correlation": replace(default, physics=alone),
        "no-carrying": replace(default, predict=replace(default.predict, carry_reach=0.0)),
    }


def refinements() -> dict[str, Config]:
    """The default without each of what was added beyond the five changes, one at a time."""
    default = Config()
    return {
        "no-softening": replace(default, physics=replace(default.physics, strain_sd=1e3)),
        "no-levels": without_levels(),
        "no-hems": replace(default, associate=replace(default.associate, hem_reach=0.0)),
        "no-holding": replace(default, predict=replace(default.predict, worn_memory=0.0)),
    }


def without_levels() -> Config:
    """The default with passes over all vertices only: neither rigid clusters nor coarser versions of the garment before."""
    default = Config()
    return replace(default, coarse=replace(default.coarse, iterations=0), pyramid=replace(default.pyramid, iterations=0))


def configuration(variant: str) -> Config:
    """The configuration of a variant: ``ddakf`` or ``default``, ``paper``, one of :func:`ablations` or :func:`refinements`, or
    ``NAME={...}``, JSON of :meth:`ddakf.Config.from_dict` with a name for the tables.

    Raises:
        InvalidArgument: none of these.
    """
    name, _, values = variant.partition("=")
    if values:
        try:
            return Config.from_dict(json.loads(values))
        except json.JSONDecodeError as error:
            raise InvalidArgument("variant", "NAME={JSON}", f"{values!r} ({error})") from error
    known = {"ddakf": Config(), "default": Config(), "paper": Config.paper()} | ablations() | refinements()
    if name not in known:
        raise InvalidArgument("variant", f"one of {', '.join([*known, *BASELINES])}, or NAME={{JSON}}", repr(variant))
    return known[name]


def _tracker(config: Config, garment: Mesh, start: np.ndarray, body: Mesh | None) -> Method:
    tracker = Tracker(garment, body=body, config=config)
    tracker.reset(vertices=start)

    def step(frame: Frame) -> Estimate:
        r = tracker.step(
            frame.points,
            timestamp=frame.timestamp,
            sensor_origin=frame.sensor_origin,
            body_vertices=frame.body_vertices,
        )
        return Estimate(r.vertices, r.covariance, r.observed, r.reliability, r.paper_score, r.coverage, r.state)

    return step


def _baseline(name: str, scored: Scored, garment: Mesh, start: np.ndarray, body: Mesh | None) -> Method:
    return started(baseline(name, scored), garment, start, body)


def started(method: Baseline, garment: Mesh, start: np.ndarray, body: Mesh | None) -> Method:
    """A baseline at work, started from garment, start (V, 3) in metres and body."""
    method.start(garment, start, body)

    def step(frame: Frame) -> Estimate:
        return Estimate(method.step(frame), effective_sample_size=getattr(method, "effective_sample_size", None))

    return step


def named(variant: str, scored: Scored = NOTHING_SAID) -> Maker:
    """What makes a method from garment, start (V, 3) in metres and body: a baseline, or a tracker of a :func:`configuration`.

    Args:
        variant: name of either.
        scored: what a baseline will be scored on.

    Raises:
        InvalidArgument: no such variant. What is made may raise NotApplicable.
    """
    return partial(_baseline, variant, scored) if variant in BASELINES else partial(_tracker, configuration(variant))
