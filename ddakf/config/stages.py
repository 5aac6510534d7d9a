"""Configuration of the stages A to D, F and G, with preprocessing."""

from __future__ import annotations

from dataclasses import dataclass

from ddakf.config.checked import Checked, bounded

USUAL_RATE = 30.0  # frames per second up to which a frame makes its usual passes

# A. Prediction ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConstantVelocity(Checked):
    """The paper's motion model, section 2.2, with optional damping and with contact-aware prediction."""

    damping: float = bounded(4.0, 0, 1e3)  # 1/s: velocities decay as exp(-damping dt)
    acceleration: float = bounded(12.0, 1e-6, 1e4)  # m/s^2, sd of the acceleration behind Q_i
    acceleration_time: float = bounded(1.0 / 30.0, 1e-3, 10)  # s that an acceleration lasts, before another one follows
    carry_reach: float = bounded(0.10, 0, 1)  # m: a body surface within it carries the garment; 0: none does
    friction: float = bounded(8.0, 0, 1e3)  # 1/s: added to damping where the body carries a vertex, of its motion on the body
    longest_step: float = bounded(0.5, 1e-3, 10)  # s: a longer gap moves the garment no further


@dataclass(frozen=True)
class ConstantAcceleration(ConstantVelocity):
    """Constant velocity with an acceleration: the smoothed change of the velocities, which prediction continues."""

    share: float = bounded(0.5, 0, 1)  # share of the smoothed acceleration that prediction continues
    memory: float = bounded(0.1, 1e-3, 10)  # s, time constant of the smoothing and duration of the continued acceleration


@dataclass(frozen=True)
class Anchor(Checked):
    """The garment's place on the body as a pseudo-measurement of its unseen vertices."""

    memory: float = bounded(0.3, 0, 1e3)  # s, time constant of the learned deviation; 0: no anchor
    reach: float = bounded(0.3, 0.01, 10)  # m: a body surface within it anchors a vertex
    normal_sd: float = bounded(0.001, 1e-4, 10)  # m, first guess of the deviation of cloth on the body, along the normal
    clearance_slope: float = bounded(0.4, 0, 10)  # m more per m from the body
    hanging_slope: float = bounded(0.02, 0, 10)  # m more per m of cloth from the garment's top
    least_sd: float = bounded(0.001, 1e-4, 1)  # m, least learned deviation along the normal
    first_share: float = bounded(0.05, 1e-4, 10)  # share of a patch whose measurements weigh as much as the first guess
    slip_sd: float = bounded(0.001, 1e-4, 1)  # m, sd of the slip of cloth on the body at the garment's top, as of a waistband
    shoulder_slip_sd: float = bounded(0.005, 1e-4, 1)  # m, the same of a garment that lies on the shoulders
    slip_slope: float = bounded(0.15, 0, 10)  # m more per m of cloth from there
    slip_share: float = bounded(2.0, 0, 10)  # factor on the slip that such a garment is seen to have, which gives its sd
    seen_slip: float = bounded(2.0, 0, 100)  # factor on that sd at seen vertices


# Preprocessing ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GridFilter(Checked):
    """k-NN statistical outlier removal that computes neighbours only where the 27 cells around a point are nearly empty."""

    points_per_cell: float = bounded(5.0, 0.5, 100)  # sets the cell size from the garment's area and the number of points
    widest_cell: float = bounded(0.04, 1e-3, 10)  # m, of a sparse cloud, whose cells hold fewer points instead
    least_per_cell: float = bounded(2.0, 0.5, 100)  # least points of a cell in a sparse cloud; points_per_cell if that is less
    flat_share: float = bounded(0.75, 0, 1)  # share of flat neighbourhoods, below which cells are as narrow as the noise and grow
    crowded: float = bounded(8.0, 1, 1e3)  # points in the cell of a point, from which cells grow no more
    doublings: int = bounded(2, 0, 8)  # most times that points_per_cell is doubled
    neighbours: int = bounded(16, 2, 64)  # nearest neighbours whose mean distance is taken, as in the paper
    ratio: float = bounded(2.0, 0.1, 10)  # standard deviations above the mean distance: farther is an outlier, as in the paper
    clean_factor: float = bounded(2.0, 0, 100)  # mean distances: a point whose neighbours are nearer is no outlier
    suspect_rings: int = bounded(4, 1, 100)  # cells around a point: with fewer neighbours in them it is an outlier
    suspect_share: float = bounded(0.4, 0, 1)  # share of the median number of neighbours, below which a point is a suspect
    sample: int = bounded(300, 1, 100_000)  # other points that enter the statistics
    plane_radius: float = bounded(1.0, 0.2, 1.0)  # in cells: neighbourhood of a plane fit
    planes_per_vertex: float = bounded(8.0, 0.1, 100)  # plane fits, about; a denser cloud is subsampled to as many


@dataclass(frozen=True)
class KnnFilter(Checked):
    """The paper's statistical outlier removal: mean distance to k neighbours against mean + ratio sd."""

    neighbours: int = bounded(16, 2, 64)
    ratio: float = bounded(2.0, 0.1, 10)
    points_per_cell: float = bounded(5.0, 0.5, 100)  # sets the cell size, as above
    plane_radius: float = bounded(1.0, 0.2, 1.0)  # in cells, as above


@dataclass(frozen=True)
class SkinRemoval(Checked):
    """Removal of points that lie on the body and not on the garment."""

    skin_distance: float = bounded(0.010, 0, 0.1)  # m: a point so near to the body may be skin; three sd of a sensor's noise
    cloth_distance: float = bounded(0.008, 0, 1)  # m, beside edge_share: a point farther from all vertices is off the garment
    hem_distance: float = bounded(0.10, 0, 1)  # m, beside edge_share: nearer skin stays and shows that a hem does not end there
    edge_share: float = bounded(0.75, 0, 10)  # of the mean edge length, added to both distances


# B. Association -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlaneAssociation(Checked):
    """Plane-aligned measurements with visibility, repeated inside the frame."""

    iterations: int = bounded(8, 1, 50)  # most re-associations in a frame
    slow_iterations: int = bounded(24, 1, 100)  # the same in frames that are farther apart than 1/30 s
    least_iterations: int = bounded(2, 1, 50)
    tolerance: float = bounded(0.0007, 0, 0.1)  # m, RMS correction at which re-association stops; less where passes may be more
    wide_gate: float = bounded(0.10, 1e-3, 1)  # m, search radius of the first association
    narrow_gate: float = bounded(0.03, 1e-3, 1)  # m, search radius of the last associations
    narrowing: float = bounded(0.6, 0.01, 1)  # factor from one pass to the next
    reassociation_motion: float = bounded(0.05, 0, 1)  # in cells: a vertex that moved less since its last search keeps its plane
    lateral_gate: float = bounded(1.4, 0.1, 1e3)  # mean surfel spacings, most from the vertex to its point along the plane
    normal_cosine: float = bounded(0.5, -1, 1)  # least cosine between the normals of vertex and cloud
    normal_distance: float = bounded(0.015, 0, 1)  # m: distance that a unit difference of the normals counts as
    facing_cosine: float = bounded(-0.3, -1, 1)  # least cosine between a vertex normal and the direction to its sensor
    hidden_depth: float = bounded(0.02, 0, 100)  # m: a surface in front of a vertex by more than this hides it
    visibility_motion: float = bounded(0.003, 0, 1)  # m, RMS motion within a frame after which visibility is judged again
    occluder_cell: float = bounded(1.5, 0.1, 10)  # edges: the vertices of an occluding surface leave no holes in such cells
    hem_reach: float = bounded(0.04, 0, 0.2)  # m from an open boundary, within which the cloud's end is sought; 0: nowhere
    hem_width: float = bounded(0.012, 1e-3, 0.1)  # m along the boundary to either side, where the end is sought; more if sparse
    hem_spacings: float = bounded(1.5, 0, 10)  # mean distances of the points to either side, if that is wider; up to hem_reach
    hem_depth: float = bounded(0.010, 1e-3, 0.1)  # m above and below, and a third of the way across; another layer is farther
    hem_sd: float = bounded(0.004, 1e-4, 10)  # m, sd of the place of the cloud's end
    tangential_sd: float = bounded(0.03, 1e-3, 10)  # m, sd of the blended point within its plane
    bulge: float = bounded(0.3, 0, 1)  # share of a vertex's height above its neighbours that a plane as wide flattens
    points: int = bounded(2200, 0, 1_000_000)  # points per m^2 of the garment that measure the faces beneath them; 0: none
    points_weight: float = bounded(0.5, 0, 1e3)  # weight of a point over that of a vertex's plane; more in sparse clouds
    points_edge: float = bounded(0.03, 1e-3, 1)  # m: in meshes with shorter edges there are fewer
    points_finest: float = bounded(0.018, 1e-3, 1)  # m: in meshes with edges as short as this there are none
    points_beside: float = bounded(0.006, 1e-4, 0.1)  # m along a face: a point farther beside its nearest place has none

    def wanted_points(self, area: float, edge: float) -> int:
        """Points that measure faces of a mesh with this area, square metres, and edges of this length, metres.

        The fewer, the shorter the edges: planes show the folds of a fine mesh, and the noise of points tilts its small faces,
        which then slide.
        """
        ramp = (edge - self.points_finest) / max(self.points_edge - self.points_finest, 1e-9)
        return round(self.points * area * min(max(ramp, 0.0), 1.0))

    def most_passes(self, dt: float) -> int:
        """Passes at most, ``dt`` seconds after the last frame: the more, the farther the garment has moved."""
        slow = max(self.slow_iterations, self.iterations)
        return min(slow, max(self.iterations, round(self.iterations * USUAL_RATE * dt)))

    def settled_below(self, dt: float) -> float:
        """RMS correction, metres, at which passes stop, ``dt`` seconds after the last frame.

        Each pass corrects a small part of what slid along the surface. After fast motion many small corrections remain.
        """
        return self.tolerance * self.iterations / self.most_passes(dt)


@dataclass(frozen=True)
class NearestPoint(Checked):
    """The paper's association, section 2.3: one nearest neighbour, measured in all three directions alike."""

    gate: float = bounded(0.10, 1e-3, 1)  # m, search radius


# C. Robustness ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tukey(Checked):
    """Tukey bisquare weights and a Mahalanobis gate (section 2.5)."""

    cutoff: float = bounded(7.0, 0.1, 100)  # in robust standard deviations; 4.685 has 95 % efficiency under Gaussian noise
    gate_probability: float = bounded(0.999, 0.5, 1)  # of the chi-square distribution of the innovation's dimension


@dataclass(frozen=True)
class NoWeight(Checked):
    """Weight 1 for every associated measurement."""


# D. Adaptation ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class InnovationNoise(Checked):
    """The paper's: exponential smoothing of y y' of the innovation (section 2.3), clamped (section 2.7)."""

    alpha: float = bounded(0.9, 0, 1)  # share of the old value, per frame
    epsilon: float = bounded(1e-6, 0, 1)  # m^2, added to y y'
    lowest_sd: float = bounded(0.001, 1e-5, 1)  # m, sqrt of R_min
    highest_sd: float = bounded(0.05, 1e-5, 10)  # m, sqrt of R_max
    initial_sd: float = bounded(0.004, 1e-5, 1)  # m


@dataclass(frozen=True)
class ResidualNoise(Checked):
    """Smoothing of the fit's residual along the normal, so that R converges to the sensor's noise.

    With e the residual at the estimate, E[e e'] = R - H P H' (Mohamed and Schwarz 1999), so that R = e e' + H P H', P the
    posterior: that of the last frame, and at most R, since a measurement leaves no more. The error of the prediction, which is
    part of every innovation, never enters.
    """

    alpha: float = bounded(0.9, 0, 1)  # share of the old value, per frame
    epsilon: float = bounded(1e-6, 0, 1)  # m^2, added to e e'
    lowest_sd: float = bounded(0.0015, 1e-5, 1)  # m, sqrt of R_min
    highest_sd: float = bounded(0.05, 1e-5, 10)  # m, sqrt of R_max
    initial_sd: float = bounded(0.004, 1e-5, 1)  # m


# F. Fusion ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MapUpdate(Checked):
    """Gauss-Newton on the MAP problem over all vertices."""

    solver_iterations: int = bounded(20, 1, 1000)
    solver_tolerance: float = bounded(0.03, 0, 1)
    later_tolerance: float = bounded(2.0, 0.01, 100)  # factor on solver_tolerance after the first pass
    longest_secant: float = bounded(3.0, 1, 100)  # passes that an extrapolated step may replace
    prior_sd: float = bounded(0.15, 1e-4, 10)  # m, of the prior of a single vertex, at least


@dataclass(frozen=True)
class DecoupledUpdate(Checked):
    """The paper's update: a 6x6 Kalman filter per vertex, then the gradient pseudo-measurement on the mean."""

    longest_correction: float = bounded(0.02, 1e-6, 10)  # m by which the physics moves a vertex at most; crumpled cloth explodes


@dataclass(frozen=True)
class Uncertainty(Checked):
    """Drift of the estimate from the truth, and the bounds."""

    strain_reach: float = bounded(0.15, 0, 10)  # m, length of cloth along which present strain adds up
    missed_share: float = bounded(0.2, 0, 10)  # share of an innovation that stays as an error of the patch's place
    unseen_motion: float = bounded(2.0, 0, 100)  # factor on the motion of an unseen patch, as which it may have moved otherwise
    return_time: float = bounded(1.0, 1e-3, 1e9)  # s in which errors fade to 1/e where all is seen and reliable
    plane_persistence: float = bounded(4.0, 0.1, 1000)  # frames over which plane fits repeat their error
    vertex_share: float = bounded(0.3, 0, 10)  # variance of a vertex about its patch, over the variance of the patch
    growth_sd: float = bounded(0.0005, 0, 1)  # m per frame, growth that no measurement shows
    least_information: float = bounded(100.0, 1e-3, 1e9)  # 1/m^2 of every patch, so that a free patch has a finite variance
    innovation_memory: float = bounded(0.7, 0, 0.999)  # share of earlier frames in the running mean of the innovations
    least_bend: float = bounded(0.02, 1e-6, 1)  # 1 - |mean normal|^2 of a patch, as no patch is flatter
    least_coverage: float = bounded(0.02, 0, 1)  # share of the vertices whose innovations tell how far predictions miss
    turn_rate: float = bounded(30.0, 0, 1e4)  # degrees/s by which a wearer may turn in a garment that does not show it
    turn_share: float = bounded(0.08, 1e-6, 1)  # share of a turn's motion along the normals, from which on it is seen
    smooth_folds: float = bounded(0.001, 1e-6, 1)  # m, height of folds from which on they show a turn
    turn_lag: float = bounded(0.15, 1e-3, 10)  # s by which a skirt that is seen all around may be behind its wearer's turn
    turn_lag_on_body: float = bounded(0.05, 0, 10)  # s, the same of a skirt on a body, on which the waistband stays
    turn_spread: float = bounded(0.25, 0, 10)  # share of such a turn by which vertices are off in every direction as well
    floor_sd: float = bounded(0.0005, 1e-9, 1)  # m
    ceiling_sd: float = bounded(1.0, 1e-3, 100)  # m: trace(P_pp) is at most 3 ceiling_sd^2
    ceiling_speed_sd: float = bounded(10.0, 1e-3, 1e4)  # m/s: trace(P_uu) is at most 3 ceiling_speed_sd^2


@dataclass(frozen=True)
class EvidenceScales(Checked):
    """Evidence about the size of an error, at which it begins to count."""

    unmatched_scale: float = bounded(0.01, 1e-12, 1e6)  # share of the vertices
    hem_scale: float = bounded(1e-05, 1e-12, 1e6)  # m^2
    clearance_scale: float = bounded(0.02, 1e-12, 1e6)  # m
    slack_scale: float = bounded(0.01, 1e-12, 1e6)  # m
    strain_scale: float = bounded(0.0001, 1e-12, 1e6)  # squared strain
    slip_scale: float = bounded(5.0, 1e-12, 1e6)  # inverse share
    offset_scale: float = bounded(0.0005, 1e-12, 1e6)  # m
    distance_scale: float = bounded(0.1, 1e-12, 1e6)  # m
    free_scale: float = bounded(0.001, 1e-12, 1e6)  # m^2
    turned_scale: float = bounded(0.01, 1e-12, 1e6)  # squared sine
    moved_scale: float = bounded(0.003, 1e-12, 1e6)  # m
    soft_scale: float = bounded(0.0004, 1e-12, 1e6)  # squared strain
    blind_scale: float = bounded(0.1, 1e-12, 1e6)  # share of the vertices


@dataclass(frozen=True)
class NormalError(EvidenceScales):
    """Size of a vertex's error along its normal: a base times the product of (1 + evidence / scale)^power."""

    seen: float = bounded(0.0007, 1e-6, 1)  # m, of measured vertices whose claimed error is 5 mm
    on_body: float = bounded(0.00092, 1e-6, 1)  # m, of others beside a body
    hidden: float = bounded(0.00091, 1e-6, 1)  # m, of others without one
    claimed_power: float = bounded(0.458, 0, 2)  # of the claimed error over 5 mm
    unmatched_power: float = bounded(0.073, 0, 10)
    hem_power: float = bounded(0.205, 0, 10)
    clearance_power: float = bounded(0.27, 0, 10)
    slack_power: float = bounded(0.145, 0, 10)
    strain_power: float = bounded(0.09, 0, 10)
    slip_power: float = bounded(0.064, 0, 10)
    offset_power: float = bounded(0.132, 0, 10)
    distance_power: float = bounded(1.237, 0, 10)
    free_power: float = bounded(0.489, 0, 10)
    turned_power: float = bounded(0.259, 0, 10)
    moved_power: float = bounded(0.32, 0, 10)
    soft_power: float = bounded(0.108, 0, 10)
    blind_power: float = bounded(0.033, 0, 10)


@dataclass(frozen=True)
class TangentialError(EvidenceScales):
    """The same across its normal."""

    seen: float = bounded(0.00096, 1e-6, 1)  # m, of measured vertices whose claimed error is 5 mm
    on_body: float = bounded(0.00089, 1e-6, 1)  # m, of others beside a body
    hidden: float = bounded(0.00058, 1e-6, 1)  # m, of others without one
    claimed_power: float = bounded(0.634, 0, 2)  # of the claimed error over 5 mm
    unmatched_power: float = bounded(0.078, 0, 10)
    hem_power: float = bounded(0.334, 0, 10)
    clearance_power: float = bounded(0.083, 0, 10)
    slack_power: float = bounded(0.171, 0, 10)
    strain_power: float = bounded(0.088, 0, 10)
    slip_power: float = bounded(0.194, 0, 10)
    offset_power: float = bounded(0.276, 0, 10)
    distance_power: float = bounded(0.799, 0, 10)
    free_power: float = bounded(0.329, 0, 10)
    turned_power: float = bounded(0.159, 0, 10)
    moved_power: float = bounded(0.276, 0, 10)
    soft_power: float = bounded(0.315, 0, 10)
    blind_power: float = bounded(0.0, 0, 10)


# G. Reliability -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reliability(Checked):
    """Score, recovery with hysteresis, and loss."""

    half_error: float = bounded(0.04, 1e-4, 10)  # m, predicted error at which the score is 1/2
    recovery_below: float = bounded(0.35, 0, 1)  # score at which recovery starts
    recovery_above: float = bounded(0.5, 0, 1)  # score at which it ends
    recovery_lambda: float = bounded(1.0, 1, 1e6)  # factor on the physics during recovery
    doubt_below: float = bounded(0.06, 0, 1)  # score below which the garment is searched elsewhere
    lost_coverage: float = bounded(0.05, 0, 1)  # coverage; a frame with points and less coverage counts towards a loss
    lost_after: float = bounded(0.5, 0, 100)  # s of such frames, or of rejected fits
    longest_frame: float = bounded(0.3, 1e-3, 100)  # s that one frame counts for, at most, towards a loss
    gate_above: float = bounded(0.6, 0, 1)  # least score of a frame to which the next one is compared; 1: none is
    gate_ratio: float = bounded(0.4, 0, 1)  # of that score: with a lower one, the prediction is kept
    lost_after_empty: float = bounded(2.0, 0, 1000)  # s of empty clouds


@dataclass(frozen=True)
class PaperReliability(Checked):
    """Section 2.6 as printed: a score s_k below a threshold raises lambda, without hysteresis and without loss."""

    half_error: float = bounded(0.04, 1e-4, 10)  # m, as above
    threshold: float = bounded(0.3, 0, 1)  # tau; s_k tends to exp(-1) = 0.37 in the steady state
    recovery_lambda: float = bounded(5.0, 1, 1e6)


@dataclass(frozen=True)
class ErrorEvidence(Checked):
    """Comparison of the cloud with the surface, as evidence of the error."""

    points: int = bounded(800, 1, 10_000)  # least points of a cloud that are compared, and less than twice as many
    reach: float = bounded(0.10, 0.01, 1)  # m: a point farther from all vertices says nothing about the surface
    foreign_share: float = bounded(0.15, 0, 1)  # share of unexplained and removed points, above which a cloud has more than cloth
    foreign_rest: float = bounded(0.02, 0, 1)  # share of unexplained points that are left, above which it is so
    unexplained_distance: float = bounded(0.04, 0, 1)  # m: no vertex explains a point farther from all of them
    unexplained_edges: float = bounded(1.5, 0, 100)  # the same in mean edge lengths; the longer of the two counts
    clump_points: int = bounded(3, 1, 1000)  # unexplained points in a cell, from which on they are no stray points
    clump_size: float = bounded(0.10, 1e-3, 10)  # m, edge of such a cell
    memory: float = bounded(0.5, 1e-3, 1e3)  # s, time constant of the evidence

    def explained_within(self, edge_length: float) -> float:
        """Metres from its nearest vertex, beyond which a point is unexplained by a garment with edges of that mean length."""
        return max(self.unexplained_distance, self.unexplained_edges * edge_length)


@dataclass(frozen=True)
class FrameError(Checked):
    """Predicted error of a frame: a share of the RMS error that sigma claims.

    All sigmas are wider by (1 + unexplained / scale)^power where the surface misses the cloud.
    """

    sigma_share: float = bounded(0.79, 0, 10)  # six of seven frames have less error
    unexplained_scale: float = bounded(5e-3, 1e-12, 1e6)  # share of the points
    unexplained_power: float = bounded(0.337, 0, 10)


# H. Output -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Follow(Checked):
    """Hidden cloth of a garment without a body, drawn to where the seen cloth near it carries it."""

    reach: float = bounded(0.15, 0, 10)  # m, sd of the weight of seen cloth around a place; 0: hidden cloth does not follow
    onset: float = bounded(0.1, 1e-3, 10)  # m along the cloth from what is seen, over which following sets in
    time: float = bounded(1.5, 1e-3, 1e6)  # s, time constant with which the state follows
    share: float = bounded(0.3, 0, 1)  # share of the way that is left, by which the result follows
