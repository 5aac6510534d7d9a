"""Point-to-plane ICP: rigid, and non-rigid with a smooth displacement field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from ddakf.evaluation.baselines.body_support import BodySupport
from ddakf.evaluation.baselines.linear_algebra import conjugate_gradients, factorised, graph_laplacian
from ddakf.evaluation.baselines.matching import Matches, MatchSettings, Scan, rigid_motion
from ddakf.evaluation.baselines.optional_packages import package
from ddakf.evaluation.baselines.registration import Registration
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh

DAMPING = 0.01  # of a correspondence, per vertex: keeps vertices without points and neighbours in place
TYPICAL_WEIGHT = 0.4  # of a correspondence along any one axis, for the preconditioner
SOLVER_STEPS, SOLVER_TOLERANCE = 8, 0.1  # of conjugate gradients in one iteration: the next one corrects the rest


@dataclass(frozen=True)
class IcpSettings(MatchSettings):
    """Numbers of the non-rigid method, beside those of matching; the defaults are the best of ``benchmarks/results/tuning.json``.

    Attributes:
        stiffness: of an edge against a correspondence of full weight.
        iterations: per frame.
        hold: weight of a hidden vertex on the body, see :mod:`.body_support`.
    """

    stiffness: float = 1.0
    iterations: int = 12
    hold: float = 0.03
    gate: float = 0.1


TUNED = IcpSettings()


class NonRigidPointToPlane(Registration):
    """Non-rigid ICP (Amberg, Romdhani and Vetter 2007) with the point-to-plane distance (Chen and Medioni 1992).

    Energy: sum_i w_i (n_i . (x_i - c_i))^2 + stiffness sum_ij |d_i - d_j|^2 over the edges, with c_i the point nearest to x_i,
    n_i its normal, w_i its weight, and the displacement field d = x - T r from the start's shape r, which T lays rigidly onto the
    present estimate (Kabsch 1976). Every iteration finds new correspondences and T, and the linear system is solved by
    conjugate gradients, preconditioned by the factors of the system in which every correspondence weighs the same along all axes.
    With a body, vertices without a correspondence are held to their places on it with all three coordinates. Uses no time.
    """

    def __init__(self, settings: IcpSettings = TUNED):
        self.settings = settings

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        super().start(garment, vertices, body)
        self._rest = np.array(vertices, np.float64)
        self._smoothness = self.settings.stiffness * graph_laplacian(garment)
        self._factor = factorised(self._smoothness + (TYPICAL_WEIGHT + DAMPING) * sparse.eye_array(garment.n_vertices))

    @property
    def hold(self) -> float:
        """See :class:`Registration`."""
        return self.settings.hold

    def _registered(self, x: np.ndarray, frame: CapturedFrame) -> np.ndarray:
        scan = Scan(frame, self.settings)
        for _ in range(self.settings.iterations):
            x = self._support.outside(x + self._move(x, scan.match(x, self._normals(x))))
        return x

    def _move(self, x: np.ndarray, matches: Matches) -> np.ndarray:
        """(V, 3) from x (V, 3) to the least energy, for these correspondences."""
        points, normals, weight = matches.points, matches.normals, matches.weight[:, None]
        held = self._support.held(matches.weight)[:, None]
        turn, shift = rigid_motion(self._rest, x)
        displacement = x - (self._rest @ turn.T + shift)

        def across(vectors: np.ndarray) -> np.ndarray:
            return weight * normals * (normals * vectors).sum(axis=1, keepdims=True)

        def system(move: np.ndarray) -> np.ndarray:
            return across(move) + held * move + self._smoothness @ move + DAMPING * move

        descent = across(points - x) + held * (self._support.place - x) - self._smoothness @ displacement
        return conjugate_gradients(system, descent, self._factor.solve, SOLVER_STEPS, SOLVER_TOLERANCE)


@dataclass(frozen=True)
class RigidSettings:
    """Numbers of the rigid method; the defaults are the best of ``benchmarks/results/tuning.json``.

    Attributes:
        iterations: per frame, at most.
        gate: metres, beyond which a point has no correspondence.
        robust_scale: metres; Tukey's, of the residuals.
    """

    iterations: int = 30
    gate: float = 0.15
    robust_scale: float = 0.3


RIGID_TUNED = RigidSettings()


class RigidPointToPlane(Registration):
    """Open3D's rigid point-to-plane ICP (Chen and Medioni 1992), with Tukey's robust kernel: one motion for the whole garment,
    whose shape stays that of the start.

    The cloud is laid onto the vertices and their normals, and the garment moved by the inverse: so every point of a partial cloud
    has a counterpart, and unseen vertices need none. With a body the shape is the one that the body has brought along since the
    start. Uses no time.

    Raises:
        NotApplicable: Open3D cannot be imported.
    """

    def __init__(self, settings: RigidSettings = RIGID_TUNED):
        self.settings = settings
        self._open3d = package("open3d", "'ddakf[evaluation]'")

    @property
    def hold(self) -> float:
        """None is held by a weight: the shape is that of the body's motion as a whole."""
        return 0.0

    def _registered(self, x: np.ndarray, frame: CapturedFrame) -> np.ndarray:
        if isinstance(self._support, BodySupport) and frame.body_vertices is not None:
            turn, shift = rigid_motion(self._support.place, x)
            x = self._support.place @ turn.T + shift
        motion = self._motion(x, np.array(frame.points, np.float64))
        return x @ motion[:3, :3].T + motion[:3, 3]

    def _motion(self, x: np.ndarray, points: np.ndarray) -> np.ndarray:
        """(4, 4) that lays the vertices x (V, 3) onto the points (N, 3)."""
        o3d, settings = self._open3d, self.settings
        registration, vector = o3d.pipelines.registration, o3d.utility.Vector3dVector
        cloud, surface = (o3d.geometry.PointCloud(vector(array)) for array in (points, x))
        surface.normals = vector(self._normals(x))
        estimation = registration.TransformationEstimationPointToPlane(registration.TukeyLoss(settings.robust_scale))
        criteria = registration.ICPConvergenceCriteria(max_iteration=settings.iterations)
        found = registration.registration_icp(cloud, surface, settings.gate, np.eye(4), estimation, criteria)
        return np.linalg.inv(found.transformation)
