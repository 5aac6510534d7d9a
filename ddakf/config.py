"""Configuration: frozen dataclasses, one per stage; every field has a default, a unit and a meaning.

Where the paper leaves a constant open, ``docs/algorithm.md`` lists the value and its source.
"""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import dataclass, field

from ddakf.errors import InvalidConfig
from ddakf.physics.fabric import Fabric


def bounded(default: float, low: float, high: float) -> typing.Any:
    """A numeric field that is checked to lie in [low, high]."""
    return field(default=default, metadata={"range": (low, high)})


class Checked:
    """Checks the fields that were declared with :func:`bounded` when the object is made."""

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            if isinstance(f.default, bool) and not isinstance(getattr(self, f.name), bool):
                raise InvalidConfig(f"{type(self).__name__}.{f.name}", "true or false", repr(getattr(self, f.name)))
            if "range" not in f.metadata:
                continue
            low, high = f.metadata["range"]
            value = getattr(self, f.name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
                raise InvalidConfig(f"{type(self).__name__}.{f.name}", f"a number in [{low:g}, {high:g}]", repr(value))
            if isinstance(f.default, int) and not isinstance(value, int):
                raise InvalidConfig(f"{type(self).__name__}.{f.name}", "an integer", repr(value))


# Start -------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Start(Checked):
    """What is known before the first frame."""

    sd: float = bounded(0.003, 1e-6, 10)  # m, of the start's position
    speed_sd: float = bounded(0.5, 1e-6, 100)  # m/s, of its velocity
    search: bool = True  # look for the garment when the first cloud, or the first after a loss, is somewhere else
    least_points: int = bounded(100, 1, 1_000_000)  # in a cloud that is searched


# A. Prediction ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ConstantVelocity(Checked):
    """The paper's motion model, section 2.2, with optional damping and with contact-aware prediction."""

    damping: float = bounded(4.0, 0, 1e3)  # 1/s: velocities decay as exp(-damping dt)
    acceleration: float = bounded(12.0, 1e-6, 1e4)  # m/s^2, sd of the white acceleration behind Q_i
    carry_reach: float = bounded(0.10, 0, 1)  # m: body surface within it carries the garment; 0 switches it off
    longest_step: float = bounded(0.5, 1e-3, 10)  # s: in a longer gap the garment is not moved any further
    worn_memory: float = bounded(0.3, 0, 1e3)  # s, in which it is learned how closely cloth goes with the body; 0: not held by it
    worn_sd: float = bounded(0.05, 1e-3, 10)  # m, how closely, before anything is learned


@dataclass(frozen=True)
class ConstantAcceleration(ConstantVelocity):
    """Constant velocity, and beside it an acceleration: the smoothed change of the velocities, which prediction goes on with."""

    share: float = bounded(0.5, 0, 1)  # of the smoothed acceleration, that prediction goes on with
    memory: float = bounded(0.1, 1e-3, 10)  # s: time constant of the smoothing, and how long an acceleration is gone on with


# Preprocessing ------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class GridFilter(Checked):
    """k-NN statistical outlier removal, its neighbours sought only where the 27 cells around a point are nearly empty."""

    points_per_cell: float = bounded(5.0, 0.5, 100)  # sets the cell size from the garment's area and the number of points
    neighbours: int = bounded(16, 2, 64)  # as in the paper's filter
    ratio: float = bounded(2.0, 0.1, 10)  # in standard deviations, as there
    suspect_share: float = bounded(0.4, 0, 1)  # of the median neighbourhood, below which a point's neighbours are sought
    sample: int = bounded(300, 1, 100_000)  # of the other points, for the statistics
    plane_radius: float = bounded(1.0, 0.2, 1.0)  # in cells: neighbourhood of a plane fit
    planes_per_vertex: float = bounded(8.0, 0.1, 100)  # a denser cloud is thinned to as many plane fits


@dataclass(frozen=True)
class KnnFilter(Checked):
    """The paper's statistical outlier removal: mean distance to k neighbours against mean + ratio sd."""

    neighbours: int = bounded(16, 2, 64)
    ratio: float = bounded(2.0, 0.1, 10)
    plane_radius: float = bounded(1.0, 0.2, 1.0)  # in cells, as above


# Coarse level -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Coarse(Checked):
    """Passes in which clusters of the garment move rigidly, before all vertices do."""

    iterations: int = bounded(2, 0, 50)  # most of them in a frame; 0: none
    tolerance: float = bounded(0.002, 0, 0.1)  # m, RMS step at which they stop
    least_innovation: float = bounded(0.008, 0, 10)  # m, RMS along the normals, below which the prediction is good enough
    prior_sd: float = bounded(0.03, 1e-4, 10)  # m, of the prediction of a vertex


# Pyramid ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Pyramid(Checked):
    """Passes on coarser versions of the garment, with its physics times these factors."""

    iterations: int = bounded(5, 0, 50)  # most of them on each version; 0: none
    tolerance: float = bounded(0.001, 0, 0.1)  # m, RMS correction at which they stop
    strain: float = bounded(0.5, 0, 1e3)  # of stretch and shear
    rest: float = bounded(1.5, 0, 1e3)  # of the rigidity to the rest shape
    motion: float = bounded(4.0, 0, 1e3)  # of the rigidity since the last frame


# B. Association -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PlaneAssociation(Checked):
    """Plane-aligned measurements with visibility, repeated inside the frame."""

    iterations: int = bounded(8, 1, 50)  # most re-associations in a frame, those of coarser versions among them
    least_iterations: int = bounded(2, 1, 50)
    tolerance: float = bounded(0.0007, 0, 0.1)  # m, RMS correction at which re-association stops
    wide_gate: float = bounded(0.10, 1e-3, 1)  # m, search radius of the first association
    narrow_gate: float = bounded(0.03, 1e-3, 1)  # m, of the last ones
    narrowing: float = bounded(0.6, 0.01, 1)  # factor from one pass to the next
    still: float = bounded(0.05, 0, 1)  # in cells: a vertex that moved less since its last search keeps its plane
    beside: float = bounded(1.4, 0.1, 1e3)  # distances of plane fits along the plane: past that the cloud has ended
    normal_cosine: float = bounded(0.5, -1, 1)  # least agreement of vertex and cloud normals
    turned: float = bounded(0.015, 0, 1)  # m: distance that a unit difference of the normals counts as
    facing_cosine: float = bounded(0.2, -1, 1)  # least turn of a vertex toward the sensor
    hidden_depth: float = bounded(0.02, 0, 100)  # m: a vertex with a surface nearer by more in front of it is hidden
    hem_reach: float = bounded(0.04, 0, 0.2)  # m from a boundary of the garment that the cloud's end is sought; 0: nowhere
    hem_sd: float = bounded(0.004, 1e-4, 10)  # m, of the cloud's end
    tangential_sd: float = bounded(0.03, 1e-3, 10)  # m: what the blended point says about the position in the plane


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
    """Every associated measurement counts fully."""


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
    """Smoothing of what the fit leaves over, along the normal, so that R converges to the sensor's noise.

    With e the residual at the estimate, E[e e'] = R - H P H' (Mohamed and Schwarz 1999), so that R = e e' + H P H'. The
    innovation's own expected part, the error of the prediction, never enters.
    """

    alpha: float = bounded(0.9, 0, 1)  # share of the old value, per frame
    epsilon: float = bounded(1e-6, 0, 1)  # m^2, added to e e'
    lowest_sd: float = bounded(0.0015, 1e-5, 1)  # m, sqrt of R_min
    highest_sd: float = bounded(0.05, 1e-5, 10)  # m, sqrt of R_max
    initial_sd: float = bounded(0.004, 1e-5, 1)  # m


# E. Physics ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Physics(Checked):
    """Stiffness of the pseudo-measurements: information is lambda k w, and lambda is 1 outside recovery."""

    stretch: float = bounded(1.0e6, 0, 1e12)  # 1/m^2 per unit strain^2
    shear: float = bounded(2.0e5, 0, 1e12)  # 1/m^2
    strain_scale: float = bounded(0.1, 1e-3, 1e3)  # of stretch: beyond it a strain counts as an error of the model
    strain_sd: float = bounded(0.03, 1e-4, 1e3)  # strain of a typical face, above which stretch and shear soften
    strain_memory: float = bounded(0.08, 1e-3, 1e3)  # s: time constant with which the garment's own strain is learned
    bend: float = bounded(0.002, 0, 1e12)  # 1/rad^2
    collision: float = bounded(3.0e9, 0, 1e15)  # 1/m^4
    thickness: float = bounded(0.003, 0, 0.1)  # m, kept from the body
    gap_time: float = bounded(0.5, 0, 1e3)  # s, in which it follows what is seen deeper in the body; 0: it is kept everywhere
    self_collision: float = bounded(0.0, 0, 1e15)  # 1/m^4 between layers of the garment
    motion_rigidity: float = bounded(3.0e4, 0, 1e12)  # 1/m^2 per edge: change since the last frame is locally rigid
    rest_rigidity: float = bounded(6.0e3, 0, 1e12)  # 1/m^2 per edge: shape is locally that of the rest template
    uneven_rigidity: float = bounded(2.0e5, 0, 1e12)  # 1/m^2 per edge: rest_rigidity once stretch has gone soft
    strain_followed: float = bounded(0.95, 0, 0.99)  # of a one-ring's strain that its rest shape follows then
    fabric: Fabric = field(default_factory=lambda: Fabric.NORMALISED)


# F. Fusion ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MapUpdate(Checked):
    """Gauss-Newton on the MAP problem over all vertices."""

    solver_iterations: int = bounded(20, 1, 1000)
    solver_tolerance: float = bounded(0.03, 0, 1)
    prior_sd: float = bounded(0.15, 1e-4, 10)  # m, the prior of a vertex on its own is never tighter than this


@dataclass(frozen=True)
class DecoupledUpdate(Checked):
    """The paper's update: a 6x6 Kalman filter per vertex, then the gradient pseudo-measurement on the mean."""

    longest_correction: float = bounded(0.02, 1e-6, 10)  # m: the physics moves a vertex no farther, or crumpled cloth explodes


# G. Reliability -----------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Reliability(Checked):
    """Score, recovery with hysteresis, and loss."""

    half_error: float = bounded(0.04, 1e-4, 10)  # m, predicted error at which the score is 1/2

    recovery_below: float = bounded(0.35, 0, 1)  # score at which recovery starts
    recovery_above: float = bounded(0.5, 0, 1)  # score at which it ends
    recovery_lambda: float = bounded(1.0, 1, 1e6)  # factor on the physics while it lasts
    doubt_below: float = bounded(0.12, 0, 1)  # score below which the garment is looked for elsewhere
    lost_coverage: float = bounded(0.05, 0, 1)  # coverage below it, with points, counts towards a loss
    lost_after: float = bounded(0.5, 0, 100)  # s of that, or of a rejected fit
    lost_after_empty: float = bounded(2.0, 0, 1000)  # s of empty clouds


@dataclass(frozen=True)
class PaperReliability(Checked):
    """Section 2.6 as printed: below a threshold on s_k lambda is raised, without hysteresis and without loss."""

    half_error: float = bounded(0.04, 1e-4, 10)  # m, as above
    threshold: float = bounded(0.3, 0, 1)  # tau; s_k tends to exp(-1) = 0.37 in the steady state
    recovery_lambda: float = bounded(5.0, 1, 1e6)


@dataclass(frozen=True)
class Uncertainty(Checked):
    """How far a garment may have drifted from the truth, the two calibrated factors, and the bounds."""

    observed_scale: float = bounded(0.621, 0.01, 100)  # on the standard deviations of measured vertices
    unseen_scale: float = bounded(0.884, 0.01, 100)  # of the others
    strain_reach: float = bounded(0.15, 0, 10)  # m: strain that is there adds up along the cloth over this length
    floor_sd: float = bounded(0.0005, 1e-9, 1)  # m
    ceiling_sd: float = bounded(1.0, 1e-3, 100)  # m: trace(P_pp) is at most 3 ceiling_sd^2
    ceiling_speed_sd: float = bounded(10.0, 1e-3, 1e4)  # m/s: trace(P_uu) is at most 3 ceiling_speed_sd^2


@dataclass(frozen=True)
class Config:
    """All numbers of a tracker. ``Config()`` is the product; ``Config.paper()`` the method as printed."""

    start: Start = Start()
    predict: ConstantVelocity | ConstantAcceleration = ConstantVelocity()
    preprocess: GridFilter | KnnFilter = GridFilter()
    coarse: Coarse = Coarse()
    pyramid: Pyramid = Pyramid()
    associate: PlaneAssociation | NearestPoint = PlaneAssociation()
    robust: Tukey | NoWeight = Tukey()
    adapt: ResidualNoise | InnovationNoise = ResidualNoise()
    physics: Physics = field(default_factory=Physics)
    fuse: MapUpdate | DecoupledUpdate = MapUpdate()
    reliability: Reliability | PaperReliability = Reliability()
    uncertainty: Uncertainty = Uncertainty()

    def __post_init__(self) -> None:
        points = isinstance(self.associate, NearestPoint)
        if points and isinstance(self.adapt, ResidualNoise):
            raise InvalidConfig("config.adapt", "InnovationNoise, as NearestPoint measures no normals", "ResidualNoise")
        if not points and isinstance(self.fuse, DecoupledUpdate):
            raise InvalidConfig("config.fuse", "MapUpdate, as the paper's update knows points only", "DecoupledUpdate")

    @classmethod
    def paper(cls) -> Config:
        """DD-AKF as printed: k-NN outlier removal, one association, isotropic point targets, gradient pseudo-measurement."""
        return cls(
            start=Start(search=False),
            predict=ConstantVelocity(damping=0.0, carry_reach=0.0),
            preprocess=KnnFilter(),
            coarse=Coarse(iterations=0),
            pyramid=Pyramid(iterations=0),
            associate=NearestPoint(),
            adapt=InnovationNoise(),
            physics=Physics(stretch=1e4, shear=2e3, bend=2e-4, strain_scale=1e3, strain_sd=1e3, gap_time=0.0),
            fuse=DecoupledUpdate(),
            reliability=PaperReliability(),
        )

    def with_fabric(self, fabric: Fabric) -> Config:
        """The same configuration for another fabric."""
        return dataclasses.replace(self, physics=dataclasses.replace(self.physics, fabric=fabric))

    def to_dict(self) -> dict:
        """Plain dictionaries and numbers; each stage with its variant under ``type``."""
        return _plain(self)

    @classmethod
    def from_dict(cls, values: dict) -> Config:
        """The inverse of :meth:`to_dict`; what is left out keeps its default, ``{"preset": "paper"}`` starts from it.

        Raises:
            InvalidConfig: an unknown stage, field or variant, or a value outside its range.
        """
        if not isinstance(values, dict):
            raise InvalidConfig("config", "a mapping", type(values).__name__)
        values = dict(values)
        preset = values.pop("preset", "default")
        if preset not in ("default", "paper"):
            raise InvalidConfig("config.preset", "default or paper", repr(preset))
        base = cls.paper() if preset == "paper" else cls()
        variants = typing.get_type_hints(cls)
        changes = {}
        for stage, fields in values.items():
            if stage not in variants:
                raise InvalidConfig(f"config.{stage}", f"one of {', '.join(variants)}", "an unknown stage")
            changes[stage] = _stage(f"config.{stage}", fields, getattr(base, stage), variants[stage])
        return dataclasses.replace(base, **changes)


def _plain(value):
    if isinstance(value, Fabric):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if dataclasses.is_dataclass(value):
        own = {} if isinstance(value, Config) else {"type": type(value).__name__}
        return own | {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return value


def _stage(name: str, fields, base, variants):
    if not isinstance(fields, dict):
        raise InvalidConfig(name, "a mapping", type(fields).__name__)
    fields = dict(fields)
    allowed = {t.__name__: t for t in (typing.get_args(variants) or (variants,))}
    kind = fields.pop("type", type(base).__name__)
    if not isinstance(kind, str) or kind not in allowed:
        raise InvalidConfig(f"{name}.type", f"one of {', '.join(allowed)}", repr(kind))
    known = {f.name for f in dataclasses.fields(allowed[kind])}
    for key in fields:
        if key not in known:
            raise InvalidConfig(f"{name}.{key}", f"one of {', '.join(sorted(known))}", "an unknown field")
    if "fabric" in fields and not isinstance(fields["fabric"], Fabric):
        fields["fabric"] = _fabric(f"{name}.fabric", fields["fabric"])
    if kind == type(base).__name__:
        return dataclasses.replace(base, **fields)
    return allowed[kind](**fields)


def _fabric(name: str, value) -> Fabric:
    if isinstance(value, str):
        return Fabric.named(value)
    if not isinstance(value, dict):
        raise InvalidConfig(name, "a fabric's name or a mapping", type(value).__name__)
    try:
        return Fabric(**value)
    except TypeError:
        raise InvalidConfig(name, f"fields {', '.join(f.name for f in dataclasses.fields(Fabric))}", repr(value)) from None
