"""Data types of a step: the track, and what flows between the stages. V vertices, N points; metres, seconds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from ddakf.body import proximity
from ddakf.config import Config
from ddakf.kernels import uncertainty as kernels
from ddakf.kernels.associate import FAR_AWAY
from ddakf.kernels.cluster_alignment import Elimination
from ddakf.kernels.colour import Slides
from ddakf.kernels.preprocess import Grid
from ddakf.kernels.rigidity import LocalRigidity
from ddakf.kernels.surface_points import FaceRings, FoundFaces, Sample
from ddakf.mesh import Mesh
from ddakf.physics import Linearization
from ddakf.physics.bend import BendConstants, Hinges
from ddakf.physics.collision import CollisionConstants
from ddakf.physics.self_collision import LayerConstants, Layers
from ddakf.physics.shear import ShearConstants
from ddakf.physics.strain import StrainConstants
from ddakf.physics.stretch import StretchConstants
from ddakf.planning.work import Costs, Effort, Work
from ddakf.results import TrackerState


class Sign(NamedTuple):
    """A sign of wrong input in one frame; one that lasts is a warning."""

    field: str  # name of the input that is probably wrong
    message: str  # one sentence, with the numbers that gave it away


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

    nearest: np.ndarray  # (V, N) int32, nearest clusters: a vertex moves by the blend of their motions
    share: np.ndarray  # (V, N) weights of the blend, rows sum to one
    seam: np.ndarray  # (C, 3) int32 edges between two clusters: vertices i and j, and the entry i to j of the one-rings
    ends: np.ndarray  # (G, 2) int32 neighbouring clusters, both ways
    elimination: Elimination  # order of the clusters in which their equations are solved
    weakening: float  # factor on the seams' stiffness: true over overstated energy of a uniform strain
    sample: np.ndarray  # (S,) int32 vertices that cluster alignment measures
    probe: np.ndarray  # (S / probe_stride,) int32, vertices of the sample that are measured first: they decide on alignment


class Model(NamedTuple):
    """Constants of a garment for all stages. V vertices, F faces, E edges."""

    mesh: Mesh
    faces: np.ndarray  # (F, 3) int32
    rings: FaceRings  # faces with their edges, and the faces around each vertex
    start: np.ndarray  # (V + 1,) uint32: row i of the one-rings is [start[i], start[i + 1])
    neighbour: np.ndarray  # (2E,) uint32, ascending in each row
    edge: np.ndarray  # (2E,) uint32 in [0, E): number of the mesh's edge of each entry of the one-rings
    cluster: np.ndarray  # (V,) int32 in [0, K): cluster of each vertex, a piece that moves rigidly in cluster alignment
    n_clusters: int
    aggregate: np.ndarray  # (V,) int32 in [0, A): aggregate of each vertex, a group of the solver's preconditioner
    n_aggregates: int
    patch: np.ndarray  # (V,) int32 in [0, L): patch of each vertex, a region whose error covariance frames carry on
    likeness: np.ndarray  # (L, L) float32 correlation of the patches' motion: exp(-1/2 (distance at rest / correlation_length)^2)
    clusters: Clusters  # blending weights, seams and samples of cluster alignment
    rest_edge: np.ndarray  # (2E, 3) float32 m, edges x_j - x_i of the one-rings at rest
    rest_length: np.ndarray  # (2E,) float32 m, lengths of these edges
    crossing: np.ndarray  # (C, 3) int32: entry of the one-rings whose edge joins two patches, and the two patches
    boundary: np.ndarray  # (H, 3) int32: vertex of an open boundary, the one before and the one after it
    inside: np.ndarray  # (V,) int32, nearest vertex away from all boundaries: points on that one are cloth, not skin
    hanging: np.ndarray  # (V,) float32 m, length of cloth between a vertex and the garment's top, at rest
    curve: np.ndarray  # (V,) int32, vertices in the order of a space-filling curve: every n-th of them is an even sample
    area: float  # m^2, of the surface
    vertex_share: np.ndarray  # (V,) float32, area of each vertex over the mean area
    edge_length: float  # m, mean length of the edges
    stretch: StretchConstants
    shear: ShearConstants
    strain: StrainConstants  # of stretch and shear, which one kernel adds
    bend: BendConstants
    collision: CollisionConstants
    layers: LayerConstants


# Input of a frame ---------------------------------------------------------------------------------------------------


class FrameInput(NamedTuple):
    """A checked frame of N points."""

    points: np.ndarray  # (N, 3) float32, m
    timestamp: float  # s
    sensor_origin: np.ndarray | None  # (3,) or (N, 3) float64, m
    body_vertices: np.ndarray | None  # (B, 3) float64, m
    colors: np.ndarray | None = None  # (N, 3) uint8, red, green, blue; None: not known

    def only(self, rows: np.ndarray | slice) -> FrameInput:
        """The frame with some of the points and their colours, and with their sensors where each has its own and any is left."""
        points, origin = self.points[rows], self.sensor_origin
        if origin is not None and origin.ndim == 2:
            origin = origin[rows] if len(points) else None
        colors = None if self.colors is None else self.colors[rows]
        return self._replace(points=points, sensor_origin=origin, colors=colors)


class Surfels(NamedTuple):
    """S surfels sorted by grid cell."""

    planes: np.ndarray  # (6, S) float32: point on its local plane, relative to the grid's origin, m; unit normal
    grid: Grid


class Cloud(NamedTuple):
    """A preprocessed cloud of M points, sorted by grid cell."""

    points: np.ndarray  # (3, M) float32, relative to origin, m
    index: np.ndarray  # (M,) int32, row of each point in the frame
    start: np.ndarray  # (cells + 2,) int32, first point of each cell
    surfels: np.ndarray  # (6, S) float32: point on its local plane, relative to origin, m; unit normal, 0 where no plane
    surfel_grid: Grid  # grid of the surfels; its cells are larger if there are fewer surfels than points
    origin: np.ndarray  # (3,) m, lower corner of the grid
    cell: float  # m, edge of a cell
    dims: np.ndarray  # (3,) int64, cells along each axis
    sensor: np.ndarray | None  # (S, 3) m, places of the distinct sensors; None: not known
    sparse: Surfels | None  # sample of the surfels in larger cells, for vertices far from all; None: the cells are large enough
    sample: Sample | None = None  # even sample of the points, which measure the faces beneath them; None without planes
    channels: np.ndarray | None = None  # (2, M) float32, log chromaticities of the points; None: their colours are not known

    @property
    def grid(self) -> Grid:
        """The grid of the points."""
        return Grid(self.start, self.origin, self.cell, self.dims)

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
    reach: float  # m, longest distance of a closest point that is searched
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
    hint: np.ndarray | None  # (V,) int32, faces that were closest in the last frame
    turn: int  # number of the frame that chooses which vertices are searched in the whole body, see Physics.faces_followed
    intruded: tuple[float, float]  # see BodyTrack

    @property
    def vertices(self) -> np.ndarray:
        return self.surface.vertices


class BodyTrack(NamedTuple):
    """The body after a frame."""

    vertices: np.ndarray  # (B, 3) m, in the last known pose
    present: bool  # whether that pose is of the last frame
    velocity: np.ndarray | None  # (V, 3) m/s with which the body carried each vertex; None where it did not
    contacts: Contacts | None  # of the last frame; None: not searched
    gap: np.ndarray | None  # (V,) m, as in BodyPose
    turn: int = 0  # number of the frame, see BodyPose
    motion: np.ndarray | None = None  # (B, 3) float32 m/s, velocity of the body between its last two poses
    unposed: float = 0.0  # s since the last pose: for so long the body has been moved on without one
    span: float = 0.0  # s over which the velocities are averaged, as two frames may be very close
    # running means over the vertices: m^2, squared depth of those seen inside the gap (0 for others); 1, share of these
    intruded: tuple[float, float] = (0.0, 0.0)


class Bound(NamedTuple):
    """The garment on the body in one pose."""

    pose: np.ndarray  # (B, 3) m, the body
    position: np.ndarray  # (V, 3) m, the garment
    contact: proximity.Contact  # the closest point of each vertex within the anchor's reach


class BodyAnchor(NamedTuple):
    """The place of the garment on the body, and how far the garment deviates from it. V vertices, L patches."""

    bound: Bound  # at the start, or where relocalization found the garment
    seen: np.ndarray  # (L,) running mean of the share of a patch's vertices that is measured
    squares: np.ndarray  # (L,) m^2, running mean of that share times their squared deviation along the normal
    measured: np.ndarray  # (V,) bool, vertices that were measured in the last frame
    guess: np.ndarray  # (L,) m^2, first guess of the squared deviation along the normal
    slip: np.ndarray  # (L,) m^2, first guess of the squared deviation along either tangent
    held: np.ndarray  # (V,) m^2, the same at a vertex of a waistband, which is held also where it is seen; 0 at other vertices
    across: np.ndarray | None  # (L,) m^2, like squares, along either tangent; None: the slip of this garment is not learned


# What changes from frame to frame -----------------------------------------------------------------------------------


class Drift(NamedTuple):
    """The error of the patches' places, carried from frame to frame. L patches."""

    covariance: np.ndarray  # (3L, 3L) float32 m^2
    speed2: float  # m^2/s^2, running mean of the squared innovation per second
    stored2: float  # m^2, mean variance of the stored blocks; without a body the error of an unseen garment grows as it does
    hem2: float = 0.0  # m^2, mean squared distance of hems from where the cloud ends, when hems were last seen
    unseen_turn: float = 0.0  # rad by which the garment may have turned about its axis without being seen to
    turning: float = 0.0  # rad/s, running mean of the estimate's turns about that axis; on a body of their size
    behind: float = 0.0  # rad by which a garment on a body may be behind them
    missed: np.ndarray = np.zeros((3, 3))  # m^2/s^2, running mean of d d' / dt^2, d the prediction's error with the body's part

    @classmethod
    def at(cls, model: Model, sd: float) -> Drift:
        """A start whose error has this standard deviation, metres in each direction."""
        return cls(np.kron(np.float32(sd**2) * model.likeness, np.eye(3, dtype=np.float32)), 0.0, sd**2)


class Health(NamedTuple):
    """What the tracker remembers about its own quality."""

    state: TrackerState = "initializing"
    physics_lambda: float = 1.0
    poor_for: float = 0.0  # s of sensor time, frames with points but without a fit
    empty_for: float = 0.0  # s of sensor time, empty clouds
    doubtful: bool = False  # measured, but the score is below doubt_below
    frames_unplaced: int = 0  # frames with points since there was a fit
    settling: int = 0  # frames in which a relocalized garment is registered further
    spacing: float = 0.0  # s between the last two frames; before there were two 0, or first_step after a start with velocities
    reliability: float = 0.0  # score of the last frame, without the turns that nothing shows
    # evidence about the error, running means
    offset: float = 0.0  # m^2, squared distance of the cloud from the surface, without sensor noise
    unexplained: float = 0.0  # share of the points that lie in clumps near no vertex
    least_unexplained: float = 1.0  # least such share of a frame so far
    postponed: bool = False  # a search is due for which the last frame's budget did not suffice
    rim_gap: float = 0.0  # gap between rim and cloud over that of the other seen vertices, running mean

    def relocalized(self) -> Health:
        """The health where a search found the garment: the memory of the old track says nothing about the new one."""
        return self._replace(offset=0.0, unexplained=0.0)

    @property
    def unplaced(self) -> bool:
        """The garment's place has not been seen lately: before the first fit, lost, out of sight or without a fit."""
        return self.state in ("initializing", "lost") or self.poor_for > 0.0 or self.empty_for > 0.0 or self.doubtful


class View(NamedTuple):
    """The side that clouds without a sensor origin show."""

    looked: bool = False  # whether a cloud has been looked at
    hidden_share: float = 0.0  # least share of the points in a second layer along a direction, running mean
    side: tuple[float, float, float] = (0.0, 0.0, 0.0)  # unit vector toward the sensor; 0: all sides, or not known
    bulge: float = 0.0  # height, in cells, by which the cloud bulges toward that side, running mean
    wait: int = 0  # frames until the next look

    @property
    def one_sided(self) -> bool:
        return any(self.side)


class Sensors(NamedTuple):
    """C sensors of one stream, and how far each is misplaced."""

    origin: np.ndarray  # (C, 3) m, places as the caller gave them last
    shift: np.ndarray  # (C, 3) m, from the true places to those
    information: np.ndarray  # (3C, 3C) 1/m^2, of the shifts, from places where two sensors see the same surface
    vector: np.ndarray  # (3C,) 1/m, information times shifts: right side of their normal equations
    time: float | None = None  # s, time of the last look; None before the first
    wait: int = 0  # frames until the next look

    @property
    def common2(self) -> float:
        """m^2, variance in each direction of the shift that all sensors have in common, from how their shifts scatter."""
        n = len(self.shift)
        if n < 2:
            return 0.0
        return float(((self.shift - self.shift.mean(axis=0)) ** 2).sum()) / (3.0 * (n - 1) * n)


class Resting(NamedTuple):
    """Shape in which the cloth is at rest: where tracking started. There gravity and the body balance its folds and strain."""

    position: np.ndarray  # (V, 3) m
    edge: np.ndarray  # (2E, 3) float32 m, of the one-rings
    rotation: np.ndarray  # (V, 3, 3) of the one-rings against the template
    strain: StrainConstants  # of the faces: a share of their strain in that shape is at rest
    upward: np.ndarray  # (V,) 1/m, upward forces against the rest of that strain
    size: np.ndarray  # (3, 3) logarithm of the stretch of the template
    length: np.ndarray  # (2E,) float32 m, of the one-rings' edges in the template so stretched
    given: bool  # the caller gave that shape; if not, it is the template so stretched
    source: np.ndarray | None = None  # ``edge`` on the working mesh from which it was carried over; None: it was not


class Appearance(NamedTuple):
    """Colours of the garment around each vertex: patches of texels in its tangent plane."""

    axis: np.ndarray  # (V, 3) unit, first axis of each patch, at rest
    mean: np.ndarray  # (V, SIDE, SIDE, 2) float32, log chromaticities of the texels
    weight: np.ndarray  # (V, SIDE, SIDE) float32 1/m^2, sum of the inverse variances of the places where they were learned
    registered2: np.ndarray  # (V,) m^2, least variance of a vertex in its plane while its patch was learned
    noise2: np.ndarray  # (2,) variance of the chromaticities in a cloud


class Palette(NamedTuple):
    """Colours of the garment and of other things, in points that were seen lately."""

    counts: np.ndarray  # (2, *CELLS) float32, histograms of the points' colours: of the garment, of other things
    alike: np.ndarray  # (V,) float32, points on each vertex away from boundaries that have the colours of other things
    seen: np.ndarray  # (V,) float32, points on each of these vertices in any colour


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
    view: View = View()
    sensors: Sensors | None = None  # None: there never were several
    signs: Mapping[str, int] = {}  # of wrong input, by code: frames in a row that had them
    costs: Costs | None = None  # learned in frames with a budget; None: there was none
    resting: Resting | None = None  # None: the rest shape is the template's
    size: np.ndarray = np.zeros((3, 3))  # logarithm of the stretch of the template that makes it as large as the garment
    appearance: Appearance | None = None  # None: no frame had colours
    palette: Palette | None = None  # None: no frame had colours
    offset: np.ndarray | None = None  # (V, 3) m, by which hidden cloth is shown off its state; None: by nothing

    def shown(self, position: np.ndarray) -> np.ndarray:
        """(V, 3) metres, positions as results show them."""
        return position if self.offset is None else position + self.offset


# One frame ----------------------------------------------------------------------------------------------------------


class Sides(NamedTuple):
    """Sides of a garment: its layers along the directions that a sensor may look."""

    hidden_share: float  # least share of its surface in a second layer along a judged direction
    level: bool = False  # whether level directions alone are judged
    sheet: bool = False  # whether it has one side alone, as a template of one depth frame


class InputReference(NamedTuple):
    """What the frames of a garment are held against."""

    sides: Sides
    outward: float  # mean cosine between the garment's normals and the directions outward
    body_outward: float  # the same of the body's normals; 1 without a body
    split_edges: int = 0  # open edges of the garment that lie at the place of another open edge
    seam_gap: float = 0.0  # m between a part and another one whose opening runs beside it; 0 where none does
    fallen_body: str = ""  # sentence about a body that does not stand upright at the start; empty: it does


class Setup(NamedTuple):
    """What is constant for the life of a tracker."""

    model: Model
    body: BodyModel | None
    config: Config
    reference: InputReference | None = None


class Hem(NamedTuple):
    """Where the cloud ends beside the H vertices of the garment's open boundaries: hems, cuffs, neck.

    A plane says nothing about the position along the surface; where the cloth ends does.
    """

    direction: np.ndarray  # (H, 3) unit, in the surface, across the boundary and outward
    offset: np.ndarray  # (H,) m, from the vertex along it to the end of the cloud
    weight: np.ndarray  # (H,) bisquare of the offset times the belief, 0 where the cloud does not end
    belief: float = 1.0  # factor on the weights in [0, 1]: less where a mask is too narrow
    rim_gap: float = 0.0  # see Health; 0 where it is not computed


class Slide(NamedTuple):
    """Where the colours of each vertex are, along two directions of its tangent plane."""

    registered: Slides
    information: np.ndarray  # (2, V) 1/m^2, weights of the slides in the update; 0 where colours say nothing


class Planes(NamedTuple):
    """Plane-aligned measurements: one per vertex with a positive weight."""

    target: np.ndarray  # (V, 3) m
    normal: np.ndarray  # (V, 3)
    weight: np.ndarray  # (V,)
    variance: np.ndarray  # (V,) m^2 along the normal
    tangential: np.ndarray  # (V,) m^2 in the plane
    hem: Hem | None = None  # ends of the cloud beside open boundaries
    hem_variance: float = 1.0  # m^2, variance of each end
    slide: Slide | None = None  # places along the surface, by colours
    points: FoundFaces | None = None  # faces beneath points of the cloud
    information: np.ndarray | None = None  # (P,) 1/m^2 of those points along the faces' normals


class Measurement(NamedTuple):
    """One measurement per vertex; rows where ``found`` is false hold nothing."""

    target: np.ndarray  # (V, 3) z, m
    normal: np.ndarray | None  # (V, 3) unit normal of the cloud's surface at z; None: measured in all directions alike
    distance: np.ndarray  # (V,) m to the nearest point; negative where nothing was found
    searched_at: np.ndarray  # (V, 3) m, where the vertex was when its plane was searched
    visible: np.ndarray | None  # (V,) bool, vertices that a sensor may see; None: not asked yet
    hem: Hem | None = None  # None: no boundary, or no cloud
    judged_at: np.ndarray | None = None  # (V, 3) m, where the vertices were when it was judged which are visible
    slide: Slide | None = None  # None: nothing is known of the colours
    points: FoundFaces | None = None  # faces beneath points of the cloud; None: no points measure any

    @classmethod
    def none(cls, n: int) -> Measurement:
        """Before the first pass: nothing searched, nothing found."""
        return cls(np.zeros((n, 3)), np.zeros((n, 3)), np.full(n, -1.0), np.full((n, 3), FAR_AWAY), None)

    @property
    def found(self) -> np.ndarray:
        """(V,) bool."""
        return self.distance >= 0.0

    @property
    def squared_hem(self) -> float | None:
        """Mean squared distance of hems from where the cloud ends, m^2; None where no end was found."""
        if self.hem is None or not self.hem.weight.any():
            return None
        return float(self.hem.weight @ np.square(self.hem.offset) / max(self.hem.weight.sum(), 1.0))

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
    self_collision: Linearization | None = None  # its stiffness is self_stiffness
    self_stiffness: float = 0.0
    contacts: Contacts | None = None  # on the body, at this position


class UpdateTerms(NamedTuple):
    """What stages B to E add to the update at an estimate: its measurement, and the forces of the cloth."""

    measurement: Measurement
    weight: np.ndarray  # (V,)
    R: np.ndarray  # (V, 3, 3) m^2
    forces: Energies | None


class Rival(NamedTuple):
    """Another heading that suits a garment, which was found at one that suits it best."""

    degrees: float  # turn from the heading that was found
    expected: float  # rad: the chord of that turn times the probability that it is the right one


class Problem(NamedTuple):
    """A frame with its prediction: stage A makes it, stages B to G read it and change nothing in it.

    Before stage B the search, preprocessing, the colours and the body anchor replace parts of it. The plan of a budget replaces
    ``effort`` before each stage.
    """

    model: Model
    config: Config  # its stiffness is that to which the garment's strain has adapted it
    last: Track  # after the last frame, but with the view and the sensors of this one; drift of a start where a search found it
    frame: FrameInput
    dt: float  # s since the last frame
    state: State  # posterior of the last frame; with a body its velocities are relative to it
    carried: np.ndarray | None  # (V, 3) m, the body's displacement of each vertex; None where it carries nothing
    body: BodyPose | None  # None: its pose is not known in this frame
    prior: State  # the prediction
    motion_start: np.ndarray  # (V, 3) m, position from which the motion is locally rigid
    rotation: np.ndarray  # (V, 3, 3) of the one-rings there against the rest shape
    health: Health  # at the beginning of the frame
    garment: FrameInput | None = None  # the frame without the body's skin
    cloud: Cloud | None = None
    anchored: Planes | None = None  # pseudo-measurements of unseen vertices and waistbands by the body anchor
    reference: InputReference | None = None
    overturned: tuple[float, float] | None = None  # m, costs of the garment upright and upside down, where a search prefers that
    rival: Rival | None = None  # another heading that suits a garment that was just found
    effort: Effort = Effort()  # work that the next stage may take
    resting: Resting | None = None  # that of the last track

    @property
    def coloured(self) -> bool:
        """The colours of the cloud are known."""
        return self.cloud is not None and self.cloud.channels is not None

    @property
    def blind(self) -> bool:
        """The cloud shows one side, and no sensor origin, given or estimated, tells the vertices of the other."""
        return self.last.view.one_sided and self.frame.sensor_origin is None and len(self.frame.points) > 0

    def lacks_place(self, observed: np.ndarray) -> bool:
        """Nothing tells where the garment is: it is :attr:`blind`, or has not been found yet. (V,) bool, vertices measured."""
        return self.blind or (self.health.state == "initializing" and len(self.frame.points) > 0 and not observed.any())


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
    terms: UpdateTerms  # of the last pass
    gravity: np.ndarray | None = None  # (V, 3) 1/m, force of the cloth's weight; None: nothing tells what carries it
    bulge: np.ndarray | None = None  # (V, 3) m by which vertices stand out of their planes' patches; None: not known
    yielding: float = 1.0  # factor on the rigidity between frames at seen vertices, less where a garment slips along itself
    contacts: Contacts | None = None  # on the body; None: not searched
    planes: Planes | None = None
    system: System | None = None
    before: tuple[np.ndarray, np.ndarray] | None = None  # position and correction of the pass before, m
    coarse: np.ndarray | None = None  # (3A, 3A) float32 m^2, coarse level of the preconditioner
    state: State | None = None  # the posterior, where the update itself forms it
    passes: int = 0  # passes at full size in this frame
    finished: bool = False  # whether the passes have ended
    rejected: bool = False  # whether the fit is thrown away, and the prediction kept
    work: Work = Work()

    @property
    def observed(self) -> np.ndarray:
        """(V,) bool: a measurement passed the gate."""
        return self.terms.weight > 0

    @property
    def unmatched(self) -> float:
        """Share of the vertices that a sensor may see and that no measurement was found for."""
        return float((self.terms.measurement.visible & ~self.observed).mean())

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
    tangential2: np.ndarray | None = None  # (V,) m^2, variance in the tangent plane without the colours; None: there are none
    turned2: float = 0.0  # m^2, mean squared displacement by a turn that nothing shows; the covariance contains it
