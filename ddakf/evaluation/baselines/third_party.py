"""Registration methods of other packages, available where these are installed and never required.

Each gets the cloud and, if it can use them, the vertices that face the sensor, and starts from the last estimate. None is tuned
here: the parameters are the packages' own, converted to metres. A body carries the last estimate on and keeps the garment
outside, see :mod:`.registration`, and holds no hidden vertex. They use no time.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from ddakf.evaluation.baselines.embedded_deformation import spread
from ddakf.evaluation.baselines.matching import facing, rigid_motion
from ddakf.evaluation.baselines.optional_packages import package
from ddakf.evaluation.baselines.registration import Registration
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh

GATE = 0.10  # m: longest correspondence
SEED = 0  # of the choice of points


class Open3dArap(Registration):
    """Open3D's as-rigid-as-possible deformation (Sorkine and Alexa 2007) of the rest shape, laid rigidly onto the last estimate:
    handles spread over the garment are pinned where they were, moved along their normals as far as the nearest points are, and
    the rest follows. (Pinned to the points themselves they would wander along the surface.)

    Raises:
        NotApplicable: Open3D is not there.
    """

    HANDLES, NEIGHBOURS, ROUNDS, ITERATIONS = 300, 4, 2, 10

    def __init__(self) -> None:
        self._open3d = package("open3d", "'ddakf[evaluation]'")

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        super().start(garment, vertices, body)
        self._handles, distance = spread(garment, min(self.HANDLES, garment.n_vertices))
        self._part = np.unique(np.isfinite(distance), axis=0)  # (parts, V): vertices that hang together

    def _registered(self, x: np.ndarray, frame: CapturedFrame) -> np.ndarray:
        tree = cKDTree(np.array(frame.points, np.float64))
        for _ in range(self.ROUNDS):
            x = self._deformed(x, tree, frame.sensor_origin)
        return x

    def _deformed(self, x: np.ndarray, tree: cKDTree, sensor_origin: np.ndarray | None) -> np.ndarray:
        handles, normals = x[self._handles], self._normals(x)[self._handles]
        distance, nearest = tree.query(handles, k=self.NEIGHBOURS)
        seen = (distance[:, 0] < GATE) & facing(handles, normals, sensor_origin, nearest[:, 0])
        across = (normals * (tree.data[nearest].mean(axis=1) - handles)).sum(axis=1, keepdims=True)
        pinned, places = self._handles[seen], (handles + across * normals)[seen]
        if not self._part[:, pinned].any(axis=1).all():
            return x  # a part without a handle can be anywhere: the system is singular
        o3d, (turn, shift) = self._open3d, rigid_motion(self._garment.vertices, x)
        mesh = o3d.geometry.TriangleMesh(
            o3d.utility.Vector3dVector(self._garment.vertices @ turn.T + shift),
            o3d.utility.Vector3iVector(self._garment.faces.astype(np.int32)),
        )
        pins = o3d.utility.IntVector(pinned.astype(np.int32)), o3d.utility.Vector3dVector(places)
        return np.asarray(mesh.deform_as_rigid_as_possible(*pins, self.ITERATIONS).vertices).copy()


class TrimeshNricp(Registration):
    """trimesh's ``nricp_amberg`` (Amberg, Romdhani and Vetter 2007), from the last estimate, which is the only source shape that
    its interface can begin with.

    Raises:
        NotApplicable: trimesh is not there.
    """

    STEPS = ((0.02, 0.0, 0.5, 10), (0.01, 0.0, 0.5, 10))  # stiffness, landmarks, normals, iterations: its own, without landmarks

    def __init__(self) -> None:
        self._trimesh, self._registration = package("trimesh", "trimesh"), package("trimesh.registration", "trimesh")

    def _registered(self, x: np.ndarray, frame: CapturedFrame) -> np.ndarray:
        mesh = self._trimesh.Trimesh(x, self._garment.faces, process=False)
        cloud = self._trimesh.PointCloud(np.array(frame.points, np.float64))
        threshold = GATE / mesh.scale  # it scales the mesh to 1
        found = self._registration.nricp_amberg(mesh, cloud, steps=self.STEPS, distance_threshold=threshold, use_faces=False)
        return np.asarray(found, np.float64)


class ProbregCpd(Registration):
    """probreg's non-rigid coherent point drift (Myronenko and Song 2010) of control points on the last estimate, brought to
    unit variance; the vertices follow by its Gaussian kernel. More control points than this take seconds per frame.

    Raises:
        NotApplicable: probreg is not there.
    """

    CONTROL, POINTS, ITERATIONS = 400, 1500, 50
    BETA, STIFFNESS, OUTLIERS = 2.0, 2.0, 0.1  # beta, the square of the kernel's width, and lambda: its own; w

    def __init__(self) -> None:
        self._cpd = package("probreg.cpd", "probreg")

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        super().start(garment, vertices, body)
        self._control, _ = spread(garment, min(self.CONTROL, garment.n_vertices))
        self._rng = np.random.default_rng(SEED)

    def _registered(self, x: np.ndarray, frame: CapturedFrame) -> np.ndarray:
        points, middle, scale = np.array(frame.points, np.float64), x.mean(axis=0), x.std()
        x = (x - middle) / scale
        source, target = x[self._control], points[self._rng.permutation(len(points))[: self.POINTS]]
        drift = self._cpd.NonRigidCPD(source, beta=self.BETA, lmd=self.STIFFNESS)
        found = drift.registration((target - middle) / scale, w=self.OUTLIERS, maxiter=self.ITERATIONS)
        x = x + np.exp(-cdist(x, source, "sqeuclidean") / (2 * self.BETA)) @ found.transformation.w
        return scale * x + middle
