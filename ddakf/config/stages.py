"""Configuration of the stages A to D, F and G, with preprocessing."""

from __future__ import annotations

from dataclasses import dataclass

from ddakf.config.checked import Checked, bounded

# A. Prediction ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConstantVelocity(Checked):
    """The paper's motion model, section 2.2, with optional damping and with contact-aware prediction."""

    damping: float = bounded(4.0, 0, 1e3)  # 1/s: velocities decay as exp(-damping dt)
    acceleration: float = bounded(12.0, 1e-6, 1e4)  # m/s^2, sd of the white acceleration behind Q_i
    carry_reach: float = bounded(0.10, 0, 1)  # m: a body surface within it carries the garment; 0: none does
    longest_step: float = bounded(0.5, 1e-3, 10)  # s: a longer gap moves the garment no further
    worn_memory: float = bounded(0.3, 0, 1e3)  # s, time constant of the deviation from the body anchor; 0: no anchor
    worn_sd: float = bounded(0.05, 1e-3, 10)  # m, deviation from the body anchor before any is measured


@dataclass(frozen=True)
class ConstantAcceleration(ConstantVelocity):
    """Constant velocity with an acceleration: the smoothed change of the velocities, which prediction continues."""

    share: float = bounded(0.5, 0, 1)  # of the smoothed acceleration that prediction continues
    memory: float = bounded(0.1, 1e-3, 10)  # s, time constant of the smoothing and duration of the continued acceleration


# Preprocessing ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GridFilter(Checked):
    """k-NN statistical outlier removal that computes neighbours only where the 27 cells around a point are nearly empty."""

    points_per_cell: float = bounded(5.0, 0.5, 100)  # sets the cell size from the garment's area and the number of points
    neighbours: int = bounded(16, 2, 64)  # as in the paper's filter
    ratio: float = bounded(2.0, 0.1, 10)  # in standard deviations, as there
    suspect_share: float = bounded(0.4, 0, 1)  # of the median neighbourhood; below it a point's neighbours are computed
    sample: int = bounded(300, 1, 100_000)  # other points that enter the statistics
    plane_radius: float = bounded(1.0, 0.2, 1.0)  # in cells: neighbourhood of a plane fit
    planes_per_vertex: float = bounded(8.0, 0.1, 100)  # plane fits at most; a denser cloud is subsampled to as many


@dataclass(frozen=True)
class KnnFilter(Checked):
    """The paper's statistical outlier removal: mean distance to k neighbours against mean + ratio sd."""

    neighbours: int = bounded(16, 2, 64)
    ratio: float = bounded(2.0, 0.1, 10)
    plane_radius: float = bounded(1.0, 0.2, 1.0)  # in cells, as above


# B. Association -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlaneAssociation(Checked):
    """Plane-aligned measurements with visibility, repeated inside the frame."""

    iterations: int = bounded(8, 1, 50)  # re-associations in a frame at most, those of decimated levels included
    least_iterations: int = bounded(2, 1, 50)
    tolerance: float = bounded(0.0007, 0, 0.1)  # m, RMS correction at which re-association stops
    wide_gate: float = bounded(0.10, 1e-3, 1)  # m, search radius of the first association
    narrow_gate: float = bounded(0.03, 1e-3, 1)  # m, of the last ones
    narrowing: float = bounded(0.6, 0.01, 1)  # factor from one pass to the next
    still: float = bounded(0.05, 0, 1)  # in cells: a vertex that moved less since its last search keeps its plane
    beside: float = bounded(1.4, 0.1, 1e3)  # mean distances of plane fits, along the plane, after which the cloud has ended
    normal_cosine: float = bounded(0.5, -1, 1)  # agreement of vertex and cloud normals, at least
    turned: float = bounded(0.015, 0, 1)  # m: distance that a unit difference of the normals counts as
    facing_cosine: float = bounded(0.2, -1, 1)  # cosine between a vertex normal and its sensor, at least
    hidden_depth: float = bounded(0.02, 0, 100)  # m: a surface in front of a vertex by more than this hides it
    hem_reach: float = bounded(0.04, 0, 0.2)  # m from an open boundary, within which the cloud's end is sought; 0: nowhere
    hem_sd: float = bounded(0.004, 1e-4, 10)  # m, of the cloud's end
    tangential_sd: float = bounded(0.03, 1e-3, 10)  # m, of the blended point within its plane


@dataclass(frozen=True)
class NearestPoint(Checked):
    """The paper's association, section 2.3: one nearest neighbour, measured in all three directions alike."""

    gate: float = bounded(0.10, 1e-3, 1)  # m, search radius


# C. Robustness ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Tukey(Checked):
    """Tukey bisquare weights and a Mahalanobis gate (section 2.5)."""

    cutoff: float = bounded(4.685, 0.1, 100)  # in robust standard deviations: 95 % efficiency under Gaussian noise
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

    With e the residual at the estimate, E[e e'] = R - H P H' (Mohamed and Schwarz 1999), so that R = e e' + H P H'. The
    error of the prediction, which is part of every innovation, never enters.
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
    prior_sd: float = bounded(0.15, 1e-4, 10)  # m, of the prior of a single vertex, at least


@dataclass(frozen=True)
class DecoupledUpdate(Checked):
    """The paper's update: a 6x6 Kalman filter per vertex, then the gradient pseudo-measurement on the mean."""

    longest_correction: float = bounded(0.02, 1e-6, 10)  # m by which the physics moves a vertex at most; crumpled cloth explodes


@dataclass(frozen=True)
class Uncertainty(Checked):
    """Drift of the estimate from the truth, the two calibrated factors, and the bounds."""

    observed_scale: float = bounded(0.621, 0.01, 100)  # on the standard deviations of measured vertices
    unseen_scale: float = bounded(0.884, 0.01, 100)  # of the others
    strain_reach: float = bounded(0.15, 0, 10)  # m, length of cloth along which present strain adds up
    floor_sd: float = bounded(0.0005, 1e-9, 1)  # m
    ceiling_sd: float = bounded(1.0, 1e-3, 100)  # m: trace(P_pp) is at most 3 ceiling_sd^2
    ceiling_speed_sd: float = bounded(10.0, 1e-3, 1e4)  # m/s: trace(P_uu) is at most 3 ceiling_speed_sd^2


# G. Reliability -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reliability(Checked):
    """Score, recovery with hysteresis, and loss."""

    half_error: float = bounded(0.04, 1e-4, 10)  # m, predicted error at which the score is 1/2

    recovery_below: float = bounded(0.35, 0, 1)  # score at which recovery starts
    recovery_above: float = bounded(0.5, 0, 1)  # score at which it ends
    recovery_lambda: float = bounded(1.0, 1, 1e6)  # factor on the physics during recovery
    doubt_below: float = bounded(0.12, 0, 1)  # score below which the garment is searched elsewhere
    lost_coverage: float = bounded(0.05, 0, 1)  # coverage; a frame with points and less coverage counts towards a loss
    lost_after: float = bounded(0.5, 0, 100)  # s of such frames, or of rejected fits
    lost_after_empty: float = bounded(2.0, 0, 1000)  # s of empty clouds


@dataclass(frozen=True)
class PaperReliability(Checked):
    """Section 2.6 as printed: a score s_k below a threshold raises lambda, without hysteresis and without loss."""

    half_error: float = bounded(0.04, 1e-4, 10)  # m, as above
    threshold: float = bounded(0.3, 0, 1)  # tau; s_k tends to exp(-1) = 0.37 in the steady state
    recovery_lambda: float = bounded(5.0, 1, 1e6)
