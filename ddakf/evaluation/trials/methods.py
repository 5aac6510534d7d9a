"""Methods of the trials: variants of the tracker's configuration and the baselines, behind one call per frame."""

from __future__ import annotations

import importlib
import json
import os
import sys
from collections.abc import Callable
from functools import partial

import numpy as np

from ddakf.config import Config
from ddakf.errors import InvalidArgument, nearest
from ddakf.evaluation.baselines.baseline import Baseline
from ddakf.evaluation.baselines.embedded_deformation import EmbeddedDeformation
from ddakf.evaluation.baselines.filters.as_printed import AsPrinted
from ddakf.evaluation.baselines.filters.kalman_filter import KalmanFilter
from ddakf.evaluation.baselines.filters.particle_filter import ParticleFilter
from ddakf.evaluation.baselines.icp import NonRigidPointToPlane, RigidPointToPlane
from ddakf.evaluation.baselines.nicp import TWELVE_ITERATIONS, NonRigidIcp
from ddakf.evaluation.baselines.references import Still
from ddakf.evaluation.baselines.third_party import Open3dArap, ProbregCpd, TrimeshNricp
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.evaluation.splits import NO_LABELS, RecordingLabels
from ddakf.evaluation.trials.estimates import FrameEstimate, Method, MethodFactory
from ddakf.evaluation.trials.variants import ablations, refinements
from ddakf.mesh import Mesh
from ddakf.tracker import Tracker


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
        names = [*known, *BASELINES]
        raise InvalidArgument("variant", f"{', '.join(names)} or NAME={{JSON}}", repr(variant) + nearest(variant, names))
    return known[name]


def _carried(labels: RecordingLabels) -> Baseline:
    from ddakf.evaluation.baselines.clothfit.method import ClothFit
    from ddakf.evaluation.baselines.clothfit.network import Committee, Network

    return ClothFit(lambda: Committee((Network.zero(),)))


def _clothfit(labels: RecordingLabels) -> Baseline:
    from ddakf.evaluation.baselines.clothfit.method import ClothFit
    from ddakf.evaluation.baselines.clothfit.weights import committee

    return ClothFit(lambda: committee(labels))


BASELINES: dict[str, Callable[[RecordingLabels], Baseline]] = {
    "clothfit": _clothfit,
    "still": lambda labels: Still(),
    "carried": _carried,
    "printed": lambda labels: AsPrinted(),
    "kf": lambda labels: KalmanFilter(),
    "icp": lambda labels: NonRigidPointToPlane(),
    "icp-rigid": lambda labels: RigidPointToPlane(),
    "pf": lambda labels: ParticleFilter(),
    "opt-ed": lambda labels: EmbeddedDeformation(),
    "nicp": lambda labels: NonRigidIcp(),
    "nicp-12": lambda labels: NonRigidIcp(TWELVE_ITERATIONS),
    "open3d-arap": lambda labels: Open3dArap(),
    "trimesh-nricp": lambda labels: TrimeshNricp(),
    "probreg-cpd": lambda labels: ProbregCpd(),
}


def make_baseline(name: str, labels: RecordingLabels = NO_LABELS) -> Baseline:
    """A baseline by its name.

    Args:
        name: one of :data:`BASELINES`.
        labels: of the recording that the method is scored on.

    Raises:
        InvalidArgument: no baseline of that name.
        NotApplicable: it cannot be used here, for example because a package is missing.
    """
    if ":" in name:
        return submitted(name)()
    if name not in BASELINES:
        raise InvalidArgument("baseline", f"one of {', '.join(BASELINES)}, or MODULE:CLASS", repr(name))
    return BASELINES[name](labels)


def submitted(name: str) -> type:
    """The class of a tracker from elsewhere, which has the methods of :class:`.baseline.Baseline`.

    Args:
        name: ``MODULE:CLASS``; modules of the working folder are found.

    Raises:
        InvalidArgument: no such module or class, or one without ``start`` and ``step``.
    """
    module, _, attribute = name.partition(":")
    if (here := os.getcwd()) not in sys.path:
        sys.path.append(here)
    try:
        found = getattr(importlib.import_module(module), attribute)
    except (ImportError, AttributeError, ValueError) as error:
        raise InvalidArgument("submit", "MODULE:CLASS that can be imported", f"{name!r} ({error})") from error
    if missing := [part for part in ("start", "step") if not callable(getattr(found, part, None))]:
        raise InvalidArgument("submit", "a class with start and step (docs/benchmark.md)", f"{name!r} without {missing[0]}")
    return found


def _tracker(config: Config, garment: Mesh, start: np.ndarray, body: Mesh | None) -> Method:
    tracker = Tracker(garment, body=body, config=config)
    tracker.reset(vertices=start)

    def step(frame: CapturedFrame) -> FrameEstimate:
        r = tracker.step(
            frame.points,
            timestamp=frame.timestamp,
            sensor_origin=frame.sensor_origin,
            body_vertices=frame.body_vertices,
        )
        return FrameEstimate(r.vertices, r.covariance, r.observed, r.reliability, r.paper_score, r.coverage, r.state)

    return step


def _baseline(name: str, labels: RecordingLabels, garment: Mesh, start: np.ndarray, body: Mesh | None) -> Method:
    return start_baseline(make_baseline(name, labels), garment, start, body)


def start_baseline(method: Baseline, garment: Mesh, start: np.ndarray, body: Mesh | None) -> Method:
    """Starts a baseline from garment, start (V, 3) in metres and body, and returns its step."""
    method.start(garment, start, body)

    def step(frame: CapturedFrame) -> FrameEstimate:
        return FrameEstimate(method.step(frame), effective_sample_size=getattr(method, "effective_sample_size", None))

    return step


def method_factory(variant: str, labels: RecordingLabels = NO_LABELS) -> MethodFactory:
    """The factory of a method, which takes garment, start (V, 3) in metres and body: a baseline, or a tracker of a
    :func:`configuration`.

    Args:
        variant: name of either, or ``MODULE:CLASS`` of a tracker from elsewhere, see :func:`submitted`.
        labels: of the recording that a baseline is scored on.

    Raises:
        InvalidArgument: no such variant. The factory may raise NotApplicable.
    """
    if ":" in variant and "=" not in variant:
        submitted(variant)  # refused before any work
        return partial(_baseline, variant, labels)
    return partial(_baseline, variant, labels) if variant in BASELINES else partial(_tracker, configuration(variant))
