"""Methods that the tracker is compared with, behind one small interface."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ddakf.errors import InvalidArgument
from ddakf.evaluation.baselines.adapters import Open3dArap, ProbregCpd, TrimeshNricp
from ddakf.evaluation.baselines.embedded import EmbeddedDeformation
from ddakf.evaluation.baselines.icp import NonRigidPointToPlane, RigidPointToPlane
from ddakf.evaluation.baselines.kalman import KalmanFilter
from ddakf.evaluation.baselines.nicp import TWELVE_ITERATIONS, NonRigidIcp
from ddakf.evaluation.baselines.particle import ParticleFilter
from ddakf.evaluation.protocols import NOTHING_SAID, Scored
from ddakf.mesh import Mesh

if TYPE_CHECKING:
    from ddakf.evaluation.source import Frame


class Baseline(Protocol):
    """A method that follows a garment through point clouds; what it keeps between frames is its own affair."""

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """Starts anew.

        Args:
            garment: its vertices are the rest shape.
            vertices: (V, 3) where the garment is before the first frame, metres.
            body: in the pose of the start, or None; what knows no body ignores it.

        Raises:
            NotApplicable: it cannot be used here; the sentence says what it lacks.
        """

    def step(self, frame: Frame) -> np.ndarray:
        """One frame, of which the method sees the points, their sensor's place, the time and the body's vertices.

        Returns:
            (V, 3) the garment in this frame, metres.

        Raises:
            NotApplicable: this frame lacks what the method cannot do without.
        """


def _carried(scored: Scored) -> Baseline:
    from ddakf.evaluation.baselines.clothfit.method import ClothFit
    from ddakf.evaluation.baselines.clothfit.network import Committee, Network

    return ClothFit(lambda: Committee((Network.zero(),)))


def _clothfit(scored: Scored) -> Baseline:
    from ddakf.evaluation.baselines.clothfit.method import ClothFit
    from ddakf.evaluation.baselines.clothfit.weights import committee

    return ClothFit(lambda: committee(scored))


BASELINES: dict[str, Callable[[Scored], Baseline]] = {
    "clothfit": _clothfit,
    "carried": _carried,
    "kf": lambda scored: KalmanFilter(),
    "icp": lambda scored: NonRigidPointToPlane(),
    "icp-rigid": lambda scored: RigidPointToPlane(),
    "pf": lambda scored: ParticleFilter(),
    "opt-ed": lambda scored: EmbeddedDeformation(),
    "nicp": lambda scored: NonRigidIcp(),
    "nicp-12": lambda scored: NonRigidIcp(TWELVE_ITERATIONS),
    "open3d-arap": lambda scored: Open3dArap(),
    "trimesh-nricp": lambda scored: TrimeshNricp(),
    "probreg-cpd": lambda scored: ProbregCpd(),
}


def baseline(name: str, scored: Scored = NOTHING_SAID) -> Baseline:
    """A baseline by its name.

    Args:
        name: one of :data:`BASELINES`.
        scored: what it will be scored on.

    Raises:
        InvalidArgument: none of that name.
        NotApplicable: it cannot be used here, for want of a package for instance.
    """
    if name not in BASELINES:
        raise InvalidArgument("baseline", f"one of {', '.join(BASELINES)}", repr(name))
    return BASELINES[name](scored)
