"""Data types of a step: its result, the track, and what flows between the stages. V vertices, N points; metres, seconds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np

from ddakf.body import proximity
from ddakf.config import Config
from ddakf.kernels import uncertainty as kernels
from ddakf.kernels.associate import FAR_AWAY
from ddakf.kernels.preprocess import Grid
from ddakf.kernels.rigidity import LocalRigidity
from ddakf.mesh import Mesh
from ddakf.physics import Linearization
from ddakf.physics.bend import BendConstants, Hinges
from ddakf.physics.collision import CollisionConstants
from ddakf.physics.self_collision import LayerConstants, Layers
from ddakf.physics.shear import ShearConstants
from ddakf.physics.strain import StrainConstants
from ddakf.physics.stretch import StretchConstants

TrackerState = Literal["initializing", "tracking", "recovering", "lost"]


@dataclass(frozen=True, eq=False)
class FrameResult:
    """The garment after one frame.

    Attributes:
        vertices: (V, 3) positions, metres.
        velocities: (V, 3) metres per second.
        covariance: (V, 3, 3) position covariance, square metres.
        sigma: (V,) sqrt(trace(covariance) / 3), metres.
        vertex_reliability: (V,) in [0, 1].
        observed: (V,) bool, a measurement passed the gate in this frame.
        reliability: the frame's score in [0, 1]; high means low error.
        paper_score: s_k of the paper, section 2.6.
        coverage: share of the vertices that were observed.
        state: what the tracker is doing.
        timings: seconds per stage, by the stage's name, and "total".
    """

    vertices: np.ndarray
    velocities: np.ndarray
    covariance: np.ndarray
    sigma: np.ndarray
    vertex_reliability: np.ndarray
    observed: np.ndarray
    reliability: float
    paper_score: float
    coverage: float
    state: TrackerState
    timings: dict[str, float] = field(default_factory=dict)


class State(NamedTuple):
    """Posterior (or, after stage A, prior) of every vertex: mean and the blocks of the 6x6 covariance P_i, and R_i."""

    position: np.ndarray  # (V, 3) p, m
    velocity: np.ndarray  # (V, 3) u, m/s
    P_pp: np.ndarray  # (V, 3, 3) m^2
    P_pu: np.ndarray  # (V, 3, 3) m^2/s
    P_uu: np.ndarray  # (V, 3, 3) m^2/s^2
    R: np.ndarray  # (V, 3, 3) measurement covariance, m^2
    acceleration: np.ndarray  # (V, 3) m/s^2, smoothed; zero with constant velocity

    @classmethod
    def at(cls, position: np.ndarray, velocity: np.ndarray, sd: float, speed_sd: float, noise_sd: float) -> State:
        """A start, not accelerated: mean (V, 3) each, and the same standard deviations, in m, m/s and m, for every vertex."""
        eye = np.broadcast_to(np.eye(3), (len(position), 3, 3))
        P_pu, acceleration = np.zeros(eye.shape), np.zeros(position.shape)
        return cls(position, velocity, sd**2 * eye, P_pu, speed_sd**2 * eye, noise_sd**2 * eye, acceleration)


def variances(covariance: np.ndarray) -> np.ndarray:
    """(V,) mean variance of (V, 3, 3) blocks over the directions."""
    trace = np.empty(len(covariance))
    kernels.traces(covariance, trace)
    trace /= 3.0
    return trace


# The garment --------------------------------------------------------------------------------------------------------


class Clusters(NamedTuple):
    """K clusters of a garment's V vertices."""

    nearest: np.ndarray  # (V, N) int32 clusters whose motion a vertex blends
    share: np.ndarray  # (V, N) weights of the blend, rows sum to one
    seam: np.ndarray  # (C, 3) int32 edges between two clusters: vertices i and j, and the entry i to j of the one-rings
    ends: np.ndarray  # (G, 2) int32 neighbouring clusters, both ways
    weakening: float  # factor on the seams' stiffness: true over overstated energy of a uniform strain
    sample: np.ndarray  # (S,) int32 vertices that cluster alignment measures
    probe: np.ndarray  # (S / probe_stride,) int32 of these, measured first: they decide whether clusters are aligned


class Model(NamedTuple):
    """Constants of a garment for all stages. V vertices, F faces, E edges."""

    mesh: Mesh
    faces: np.ndarray  # (F, 3) int32
    start: np.ndarray  # (V + 1,) uint32: row i of the one-rings is [start[i], start[i + 1])
    neighbour: np.ndarray  # (2E,) uint32, ascending in each row
    edge: np.ndarray  # (2E,) uint32 in [0, E): the mesh's edge of each entry
    cluster: np.ndarray  # (V,) int32 in [0, K): cluster of each vertex, a piece that moves rigidly in cluster alignment
    n_clusters: int
    aggregate: np.ndarray  # (V,) int32 in [0, A): aggregate of each vertex, a group of the solver's preconditioner
    n_aggregates: int
    patch: np.ndarray  # (V,) int32 in [0, L): patch of each vertex, a region whose error covariance frames carry on
    likeness: np.ndarray  # (L, L) float32 correlation of the patches' motion: exp(-1/2 (distance at rest / correlation_length)^2)
    clusters: Clusters  # blending weights, seams and samples of cluster alignment
    rest_edge: np.ndarray  # (2E, 3) float32 m, x_j - x_i at rest
    rest_length: np.ndarray  # (2E,) float32 m, its length
    crossing: np.ndarray  # (C, 3) int32: entries of the one-rings from patch to patch, and the two patches
    boundary: np.ndarray  # (H, 3) int32: vertex of an open boundary, the one before and the one after it
    area: float  # m^2
    vertex_share: np.ndarray  # (V,) float32 area of each vertex over the mean
    edge_length: float  # m, mean
    stretch: StretchConstants
    shear: ShearConstants
    strain: StrainConstants  # stretch and shear at once
    bend: BendConstants
    collision: CollisionConstants
    layers: LayerConstants
    coarser: Coarser | None  # the next level of the pyramid, which has its own; None: the last level


class Coarser(NamedTuple):
    """The next level of the pyramid: a decimated garment of W of the V vertices."""

    model: Model
    vertex: np.ndarray  # (W,) in [0, V)
    corner: np.ndarray  # (V, 3) int32 in [0, W): the face on which each finer vertex lies at rest
    share: np.ndarray  # (V, 3) its barycentric coordinates there


# Input of a frame ---------------------------------------------------------------------------------------------------


class FrameInput(NamedTuple):
    """A checked frame of N points."""

    points: np.ndarray  # (N, 3) float32, m
    timestamp: float  # s
    sensor_origin: np.ndarray | None  # (3,) or (N, 3) float64, m
    body_vertices: np.ndarray | None  # (B, 3) float64, m

    def only(self, rows: np.ndarray | slice) -> FrameInput:
        """The frame with some of the points, and their sensors where each has its own."""
        origin = self.sensor_origin
        if origin is not None and origin.ndim == 2:
            origin = origin[rows]
        return self._replace(points=self.points[rows], sensor_origin=origin)


class Cloud(NamedTuple):
    """A preprocessed cloud of M points, sorted by grid cell."""

    points: np.ndarray  # (3, M) float32, relative to origin, m
    index: np.ndarray  # (M,) int32, of each in the input
    start: np.ndarray  # (cells + 2,) int32, of the points of each cell
    surfels: np.ndarray  # (6, S) float32: point on its local plane, relative to origin, m; unit normal, 0 where no plane
    surfel_start: np.ndarray  # (cells + 2,) int32, of the surfels of each cell
    origin: np.ndarray  # (3,) m
    cell: float  # m
    dims: np.ndarray  # (3,) int64
    sensor: np.ndarray | None  # (S, 3) m, distinct sensors; None where unknown

    @property
    def grid(self) -> Grid:
        """The grid of the points."""
        return Grid(self.start, self.origin, self.cell, self.dims)

    @property
    def surfel_grid(self) -> Grid:
        """The grid of the surfels."""
        return Grid(self.surfel_start, self.origin, self.cell, self.dims)

    @property
    def oriented(self) -> bool:
        """Normals point toward the sensors, which are known."""
        return self.sensor is not None

    @property
    def empty(self) -> bool:
        return self.points.shape[1] == 0


# The body -----------------------------------------------------------------------------------------------------------


class BodyModel(NamedTuple):
    """Constant for the life of a tracker: the body's topology and search tree."""

    mesh: Mesh  # in the pose of the start
    tree: proximity.Body
    reach: float  # m, of the closest-point search
    carries: bool  # the garment's prediction follows the body


class Contacts(NamedTuple):
    """Closest points of the garment on the body."""

    closest: proximity.Contact  # of the V vertices
    asked_at: np.ndarray  # (V, 3) m, where each vertex was when its closest point was searched


class BodyPose(NamedTuple):
    """The body in the pose of one frame."""

    model: BodyModel
    surface: proximity.BodySurface
    gap: np.ndarray | None  # (V,) m, signed distance that each vertex keeps at least; None: the thickness
    hint: np.ndarray | None  # (V,) int32, faces that are probably closest; they change the time of a search, not its result

    @property
    def vertices(self) -> np.ndarray:
        return self.surface.vertices


class BodyTrack(NamedTuple):
    """The body after a frame."""

    vertices: np.ndarray  # (B, 3) m, in the last known pose
    present: bool  # that pose is the last frame's
    velocity: np.ndarray | None  # (V, 3) m/s with which the body carried each vertex; None where it did not
    contacts: Contacts | None  # of the last frame; None: not searched
    gap: np.ndarray | None  # (V,) m, as in BodyPose


class Bound(NamedTuple):
    """The garment on the body in one pose."""

    pose: np.ndarray  # (B, 3) m, the body
    position: np.ndarray  # (V, 3) m, the garment
    contact: proximity.Contact  # the closest point of each vertex within the anchor's reach


class BodyAnchor(NamedTuple):
    """The place of the garment on the body, and how far the garment deviates from it. V vertices, L patches."""

    bound: Bound  # at the start, or where relocalization found the garment
    seen: np.ndarray  # (L,) share of a patch's vertices that was measured lately
    squares: np.ndarray  # (L, 2) m^2, squared deviation of these along the normal, and along either tangent, times that share
    measured: np.ndarray  # (V,) bool, in the last frame


# What changes from frame to frame -----------------------------------------------------------------------------------


class Drift(NamedTuple):
    """The error of the patches' places, carried from frame to frame. L patches."""

    covariance: np.ndarray  # (3L, 3L) float32 m^2
    speed2: float  # m^2/s^2, running mean of the squared innovation per second
    stored2: float  # m^2, mean variance of the stored blocks: its growth is how fast an unseen garment is lost
    level: float  # factor on the variances that the last cloud called for

    @classmethod
    def at(cls, model: Model, sd: float) -> Drift:
        """A start whose error has this standard deviation, metres in each direction."""
        return cls(np.kron(np.float32(sd**2) * model.likeness, np.eye(3, dtype=np.float32)), 0.0, sd**2, 1.0)


class Health(NamedTuple):
    """What the tracker remembers about its own quality."""

    state: TrackerState = "initializing"
    physics_lambda: float = 1.0
    poor_for: float = 0.0  # s of sensor time with points, but without a fit
    empty_for: float = 0.0  # s of empty clouds
    doubtful: bool = False  # there is a fit, but hardly of this garment
    frames_unplaced: int = 0  # frames with points that have been searched since there was a fit
    settling: int = 0  # frames in which a relocalized garment is registered further
    spacing: float = 0.0  # s between the last two frames
    # of the predicted error
    least_strain: float = 10.0  # RMS, so far
    offset: float = 0.0  # m^2
    unexplained: float = 0.0  # share of the points
    least_unexplained: float = 1.0  # so far

    def relocalized(self) -> Health:
        """The health where a search found the garment: the memory of the old track says nothing about the new one."""
        return self._replace(offset=0.0, unexplained=0.0)

    @property
    def unplaced(self) -> bool:
        """The garment's place has not been seen lately: before the first fit, lost, out of sight or without a fit."""
        return self.state in ("initializing", "lost") or self.poor_for > 0.0 or self.empty_for > 0.0 or self.doubtful


class Track(NamedTuple):
    """Everything that changes from frame to frame. A step ends with a new one; a snapshot is its bytes."""

    state: State
    rotation: np.ndarray  # (V, 3, 3) of the one-rings against the rest shape
    drift: Drift
    strain2: float  # squared strain of a typical face, dimensionless: the garment's stiffness adapts to it
    health: Health
    time: float | None  # s, of the last frame; None before the first
    body: BodyTrack | None  # None: no body was declared
    anchor: BodyAnchor | None  # None: not known yet


# One frame ----------------------------------------------------------------------------------------------------------


class Setup(NamedTuple):
    """What is constant for the life of a tracker."""

    model: Model
    body: BodyModel | None
    config: Config


class Hem(NamedTuple):
    """Where the cloud ends beside the H vertices of the garment's open boundaries: hems, cuffs, neck.

    A plane says nothing about the position along the surface; where the cloth ends does.
    """

    direction: np.ndarray  # (H, 3) unit, in the surface, across the boundary and outward
    offset: np.ndarray  # (H,) m, from the vertex along it to the end of the cloud
    weight: np.ndarray  # (H,) bisquare of the offset, 0 where the cloud does not end


class Planes(NamedTuple):
    """Plane-aligned measurements: one per vertex with a positive weight."""

    target: np.ndarray  # (V, 3) m
    normal: np.ndarray  # (V, 3)
    weight: np.ndarray  # (V,)
    variance: np.ndarray  # (V,) m^2 along the normal
    tangential: np.ndarray  # (V,) m^2 in the plane
    hem: Hem | None = None  # ends of the cloud beside open boundaries
    hem_variance: float = 1.0  # m^2, of each


class Measurement(NamedTuple):
    """One measurement per vertex; rows where ``found`` is false hold nothing."""

    target: np.ndarray  # (V, 3) z, m
    normal: np.ndarray | None  # (V, 3) unit normal of the cloud's surface at z; None: measured in all directions alike
    distance: np.ndarray  # (V,) m to the nearest point; negative where nothing was found
    searched_at: np.ndarray  # (V, 3) m, where the vertex was when its plane was searched
    visible: np.ndarray | None  # (V,) bool, vertices that a sensor may see; None: not asked yet
    hem: Hem | None = None  # None: no boundary, or no cloud

    @classmethod
    def none(cls, n: int) -> Measurement:
        """Before the first pass: nothing searched, nothing found."""
        return cls(np.zeros((n, 3)), np.zeros((n, 3)), np.full(n, -1.0), np.full((n, 3), FAR_AWAY), None)

    @property
    def found(self) -> np.ndarray:
        """(V,) bool."""
        return self.distance >= 0.0

    def innovation(self, position: np.ndarray) -> np.ndarray:
        """(V, 3) y = z - p, of a plane only its part along the normal; zero where nothing was found."""
        y = np.where(self.found[:, None], self.target - position, 0.0)
        if self.normal is None:
            return y
        return np.einsum("va,va->v", self.normal, y)[:, None] * self.normal


class Energies(NamedTuple):
    """The cloth energies at one position, and the stiffness of each (lambda and fabric included).

    Stretch, shear and bending are not linearised here: the fused update takes their blocks straight from the position.
    """

    position: np.ndarray  # (V, 3) m
    bending: Hinges  # of the frame's first pass
    collision: Linearization | None
    stiffness: tuple[float, float, float, float]  # of stretch, shear, bend and collision
    strain_scale: float  # of stretch, see :func:`ddakf.physics.energies.softened`
    layers: Layers | None = None
    self_collision: Linearization | None = None  # as stiff as self_stiffness
    self_stiffness: float = 0.0
    contacts: Contacts | None = None  # on the body, at this position


class Evidence(NamedTuple):
    """What stages B to E say about an estimate."""

    measurement: Measurement
    weight: np.ndarray  # (V,)
    R: np.ndarray  # (V, 3, 3) m^2
    forces: Energies | None


class Problem(NamedTuple):
    """What is constant within a frame: stages B to G read it."""

    model: Model
    config: Config  # as stiff as the garment has proved to be
    last: Track  # after the last frame; where a search found the garment, with the drift of a start
    frame: FrameInput
    dt: float  # s since the last frame
    state: State  # posterior of the last frame; with a body its velocities are relative to it
    carried: np.ndarray | None  # (V, 3) m, the body's displacement of each vertex; None where it carries nothing
    body: BodyPose | None  # None: its pose is not known in this frame
    prior: State  # the prediction
    motion_start: np.ndarray  # (V, 3) m, position from which the motion is locally rigid
    rotation: np.ndarray  # (V, 3, 3) of the one-rings there against the rest shape
    health: Health  # as the frame begins
    garment: FrameInput | None = None  # the frame without the body's skin
    cloud: Cloud | None = None
    anchored: Planes | None = None  # pseudo-measurements of unseen vertices by the body anchor
    visible: np.ndarray | None = None  # (V,) bool, vertices that a sensor may see, where that is known beforehand


class System(NamedTuple):
    """The normal equations A delta = force at an estimate."""

    D: np.ndarray  # (V, 3, 3) diagonal blocks of A, 1/m^2
    B: np.ndarray  # (2E, 12) float32, its other blocks, in rows of the adjacency, by columns padded to four
    force: np.ndarray  # (V, 4) 1/m, minus the gradient, padded


class Estimate(NamedTuple):
    """What the passes of a frame refine."""

    position: np.ndarray  # (V, 3) m
    rest: LocalRigidity
    motion: LocalRigidity
    information: np.ndarray  # (V, 3, 3) 1/m^2, of the prior as it enters the MAP problem
    evidence: Evidence  # of the last pass
    contacts: Contacts | None = None  # on the body; None: not searched
    planes: Planes | None = None
    system: System | None = None
    before: tuple[np.ndarray, np.ndarray] | None = None  # position and correction of the pass before, m
    coarse: np.ndarray | None = None  # (3A, 3A) float32 m^2, coarse level of the preconditioner
    state: State | None = None  # the posterior, where the update itself forms it
    passes: int = 0  # of this frame, those on decimated levels among them
    settled: bool = False
    rejected: bool = False

    @property
    def observed(self) -> np.ndarray:
        """(V,) bool: a measurement passed the gate."""
        return self.evidence.weight > 0

    @property
    def learnable(self) -> np.ndarray:
        """(V,) bool: the observed vertices, none where the fit is rejected: what it says is not learned."""
        return np.logical_and(self.observed, not self.rejected)

    @property
    def clearance(self) -> np.ndarray | None:
        """(V,) m, signed distance of each vertex from the body when last searched; None without a body."""
        return None if self.contacts is None else self.contacts.closest.distance


class Posterior(NamedTuple):
    """The garment after the fusion update."""

    state: State
    covariance: np.ndarray  # (V, 3, 3) m^2, calibrated
    drift: Drift
