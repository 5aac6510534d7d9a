"""Configuration of a tracker: frozen dataclasses, one per stage.

Every field has a default, a unit, a meaning and a range. Clients may send configurations: the range of a count that sets the
cost of a search ends a few times above its default. Other numbers are constants beside their use: thresholds that decide which
rule applies, tolerances of algorithms, sizes of buffers, limits on input. ``docs/fields.csv`` lists every field with its reason.
"""

from __future__ import annotations

import dataclasses
import functools
import typing
from dataclasses import dataclass, field

from ddakf.config.checked import Checked, bounded, derived
from ddakf.config.colour import Colour, Segmentation
from ddakf.config.levels import Coarse, Discretisation, Omission
from ddakf.config.physics import Physics
from ddakf.config.plausibility import SensorPoses, Sidedness
from ddakf.config.search import Registration, Relocalization, Start
from ddakf.config.stages import (
    Anchor,
    ConstantAcceleration,
    ConstantVelocity,
    DecoupledUpdate,
    ErrorEvidence,
    Follow,
    FrameError,
    GridFilter,
    InnovationNoise,
    KnnFilter,
    MapUpdate,
    NearestPoint,
    NormalError,
    NoWeight,
    PaperReliability,
    PlaneAssociation,
    Reliability,
    ResidualNoise,
    SkinRemoval,
    TangentialError,
    Tukey,
    Uncertainty,
)
from ddakf.errors import InvalidConfig, nearest, shown, shown_name
from ddakf.physics.fabric import Fabric

__all__ = [
    "Anchor",
    "Checked",
    "Coarse",
    "Colour",
    "Config",
    "ConstantAcceleration",
    "ConstantVelocity",
    "DecoupledUpdate",
    "Discretisation",
    "ErrorEvidence",
    "Follow",
    "FrameError",
    "GridFilter",
    "InnovationNoise",
    "KnnFilter",
    "MapUpdate",
    "NearestPoint",
    "NoWeight",
    "NormalError",
    "Omission",
    "PaperReliability",
    "Physics",
    "PlaneAssociation",
    "Registration",
    "Reliability",
    "Relocalization",
    "ResidualNoise",
    "Segmentation",
    "SensorPoses",
    "Sidedness",
    "SkinRemoval",
    "Start",
    "TangentialError",
    "Tukey",
    "Uncertainty",
    "bounded",
    "derived",
]


@dataclass(frozen=True)
class Config:
    """The numbers of a tracker that can be chosen, one field per stage.

    ``Config()`` is the product, ``Config.fast()`` a cheaper one, ``Config.paper()`` the method as printed.
    """

    sidedness: Sidedness = field(default_factory=Sidedness)
    sensor_poses: SensorPoses = field(default_factory=SensorPoses)
    start: Start = field(default_factory=Start)
    relocalization: Relocalization = field(default_factory=Relocalization)
    registration: Registration = field(default_factory=Registration)
    discretisation: Discretisation = field(default_factory=Discretisation)
    predict: ConstantVelocity | ConstantAcceleration = field(default_factory=ConstantVelocity)
    anchor: Anchor = field(default_factory=Anchor)
    preprocess: GridFilter | KnnFilter = field(default_factory=GridFilter)
    skin_removal: SkinRemoval = field(default_factory=SkinRemoval)
    segmentation: Segmentation = field(default_factory=Segmentation)
    coarse: Coarse = field(default_factory=Coarse)
    associate: PlaneAssociation | NearestPoint = field(default_factory=PlaneAssociation)
    colour: Colour = field(default_factory=Colour)
    robust: Tukey | NoWeight = field(default_factory=Tukey)
    adapt: ResidualNoise | InnovationNoise = field(default_factory=ResidualNoise)
    physics: Physics = field(default_factory=Physics)
    fuse: MapUpdate | DecoupledUpdate = field(default_factory=MapUpdate)
    reliability: Reliability | PaperReliability = field(default_factory=Reliability)
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    follow: Follow = field(default_factory=Follow)
    normal_error: NormalError = field(default_factory=NormalError)
    tangential_error: TangentialError = field(default_factory=TangentialError)
    evidence: ErrorEvidence = field(default_factory=ErrorEvidence)
    frame_error: FrameError = field(default_factory=FrameError)
    omission: Omission = field(default_factory=Omission)

    def __post_init__(self) -> None:
        for stage, variants in _variants().items():
            if not isinstance(value := getattr(self, stage), variants):
                names = " or ".join(kind.__name__ for kind in variants)
                raise InvalidConfig(f"config.{stage}", f"{names} (Config.from_dict takes mappings)", type(value).__name__)
        points = isinstance(self.associate, NearestPoint)
        if points and isinstance(self.adapt, ResidualNoise):
            raise InvalidConfig("config.adapt", "InnovationNoise, as NearestPoint measures no normals", "ResidualNoise")
        if not points and isinstance(self.fuse, DecoupledUpdate):
            raise InvalidConfig("config.fuse", "MapUpdate, as the paper's update knows points only", "DecoupledUpdate")

    @classmethod
    def paper(cls) -> Config:
        """DD-AKF as printed: k-NN outlier removal, one association, isotropic point targets, gradient pseudo-measurement."""
        return cls(
            discretisation=Discretisation(working_edge=0.0),
            start=Start(search=False),
            sensor_poses=SensorPoses(sd=0.0),
            predict=ConstantVelocity(damping=0.0, carry_reach=0.0, acceleration_time=10.0),
            preprocess=KnnFilter(),
            segmentation=Segmentation(points=0),
            coarse=Coarse(iterations=0),
            associate=NearestPoint(),
            robust=Tukey(cutoff=4.685),
            adapt=InnovationNoise(),
            physics=Physics(
                stretch=1e4,
                shear=2e3,
                bend=2e-4,
                strain_scale=1e3,
                strain_sd=1e3,
                gap_time=0.0,
                body_sd=0.0,
                floor_below=10.0,
                size_memory=0.0,
            ),
            fuse=DecoupledUpdate(),
            follow=Follow(reach=0.0),
            reliability=PaperReliability(),
        )

    @classmethod
    def fast(cls) -> Config:
        """0.5 to 0.7 times the default's time for a larger error: a coarser working mesh, fewer passes."""
        return cls(
            discretisation=Discretisation(
                working_edge=0.025,
                working_vertices_least=900,
                working_vertices_most=3000,
                working_finest=1.0,
                clusters=32,
                cluster_samples=500,
                patches=24,
                aggregates=20,
            ),
            preprocess=GridFilter(points_per_cell=8.0, neighbours=8, suspect_rings=2, sample=100),
            associate=PlaneAssociation(iterations=4, slow_iterations=12, least_iterations=1, tolerance=0.002),
            evidence=ErrorEvidence(points=300),
        )

    def lighter(self) -> Config:
        """The same configuration with the working mesh of :meth:`fast`, and its other stages where it has the default's.

        Frames that are far apart get no more passes than others, and half the passes of cluster alignment. A tracker that has
        too little time goes on with it, see :meth:`ddakf.Tracker.continue_from`. A configuration with another discretisation
        than the default's has no lighter one, and is returned as it is.
        """
        default, fast = Config(), Config.fast()
        if self.discretisation != default.discretisation:
            return self
        # where frames are dropped the others are far apart: if these cost more, still more would be dropped
        quick = dataclasses.replace(fast.associate, slow_iterations=fast.associate.iterations)
        fast = dataclasses.replace(fast, associate=quick, coarse=Coarse(iterations=2))
        stages = [stage.name for stage in dataclasses.fields(self)]
        usual = [name for name in stages if getattr(self, name) == getattr(default, name)]
        return dataclasses.replace(self, **{name: getattr(fast, name) for name in usual})

    def with_fabric(self, fabric: Fabric) -> Config:
        """The same configuration for another fabric."""
        return dataclasses.replace(self, physics=dataclasses.replace(self.physics, fabric=fabric))

    def to_dict(self) -> dict:
        """Plain dictionaries and numbers; each stage with its variant under ``type``."""
        return _plain(self)

    @classmethod
    def from_dict(cls, values: dict) -> Config:
        """The inverse of :meth:`to_dict`. Missing stages and fields have the values of the preset.

        ``{"preset": "fast"}`` is :meth:`fast`, "paper" :meth:`paper`; the default otherwise.

        Raises:
            InvalidConfig: an unknown stage, field or variant, or a value outside its range.
        """
        if not isinstance(values, dict):
            raise InvalidConfig("config", "a mapping", type(values).__name__)
        values = dict(values)
        preset = values.pop("preset", "default")
        presets = {"default": cls, "fast": cls.fast, "paper": cls.paper}
        if not isinstance(preset, str) or preset not in presets:
            raise InvalidConfig("config.preset", "default, fast or paper", shown(preset))
        base = presets[preset]()
        variants, changes = _variants(), {}
        for stage, fields in values.items():
            if stage not in variants:
                hint = nearest(stage, variants)
                raise InvalidConfig(f"config.{shown_name(stage)}", f"one of {', '.join(variants)}", f"an unknown stage{hint}")
            changes[stage] = _stage(f"config.{stage}", fields, getattr(base, stage), variants[stage])
        return dataclasses.replace(base, **changes)


def _plain(value):
    if isinstance(value, Fabric):
        return {f.name: getattr(value, f.name) for f in dataclasses.fields(value)}
    if dataclasses.is_dataclass(value):
        own = {} if isinstance(value, Config) else {"type": type(value).__name__}
        return own | {f.name: _plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
    return value


@functools.cache
def _variants() -> dict[str, tuple[type, ...]]:
    """The classes that each stage may be configured with."""
    return {stage: typing.get_args(hint) or (hint,) for stage, hint in typing.get_type_hints(Config).items()}


def _stage(name: str, fields, base, variants: tuple[type, ...]):
    if not isinstance(fields, dict):
        raise InvalidConfig(name, "a mapping", type(fields).__name__)
    fields = dict(fields)
    allowed = {t.__name__: t for t in variants}
    kind = fields.pop("type", type(base).__name__)
    if not isinstance(kind, str) or kind not in allowed:
        raise InvalidConfig(f"{name}.type", f"one of {', '.join(allowed)}", shown(kind))
    known = {f.name for f in dataclasses.fields(allowed[kind])}
    for key in fields:
        if key not in known:
            hint = nearest(key, known)
            raise InvalidConfig(f"{name}.{shown_name(key)}", f"one of {', '.join(sorted(known))}", f"an unknown field{hint}")
    try:
        if "fabric" in fields and not isinstance(fields["fabric"], Fabric):
            fields["fabric"] = _fabric(fields["fabric"])
        return dataclasses.replace(base, **fields) if kind == type(base).__name__ else allowed[kind](**fields)
    except InvalidConfig as error:  # names the class, which the dictionary does not
        field = error.field.removeprefix(f"{kind}.")
        raise InvalidConfig(f"{name}.{field}", error.expected, error.got) from None


def _fabric(value) -> Fabric:
    if isinstance(value, str):
        return Fabric.named(value)
    if not isinstance(value, dict):
        raise InvalidConfig("fabric", "a fabric's name or a mapping", type(value).__name__)
    known = [f.name for f in dataclasses.fields(Fabric)]
    if unknown := [key for key in value if key not in known]:
        hint = nearest(unknown[0], known)
        raise InvalidConfig(f"fabric.{shown_name(unknown[0])}", f"one of {', '.join(known)}", f"an unknown field{hint}")
    return Fabric(**value)
