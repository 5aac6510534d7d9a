"""Configuration of a tracker: frozen dataclasses, one per stage.

Every field has a default, a unit, a meaning and a range. Clients may send configurations: the range of a count that sets the
cost of a search ends a few times above its default. Constants that do not shape the result stay beside their use: tolerances of
algorithms, sizes of buffers, limits on input. ``docs/configuration.md`` lists the reason for every value.
"""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import dataclass, field

from ddakf.config.checked import Checked, bounded
from ddakf.config.levels import Coarse, Discretisation, Pyramid
from ddakf.config.physics import Physics
from ddakf.config.search import Registration, Relocalization, Start
from ddakf.config.stages import (
    ConstantAcceleration,
    ConstantVelocity,
    DecoupledUpdate,
    ErrorEvidence,
    FrameError,
    GridFilter,
    InnovationNoise,
    KnnFilter,
    MapUpdate,
    NearestPoint,
    NoWeight,
    PaperReliability,
    PlaneAssociation,
    Reliability,
    ResidualNoise,
    SkinRemoval,
    Tukey,
    Uncertainty,
    VertexError,
)
from ddakf.errors import InvalidConfig
from ddakf.physics.fabric import Fabric

__all__ = [
    "Checked",
    "Coarse",
    "Config",
    "ConstantAcceleration",
    "ConstantVelocity",
    "DecoupledUpdate",
    "Discretisation",
    "ErrorEvidence",
    "FrameError",
    "GridFilter",
    "InnovationNoise",
    "KnnFilter",
    "MapUpdate",
    "NearestPoint",
    "NoWeight",
    "PaperReliability",
    "Physics",
    "PlaneAssociation",
    "Pyramid",
    "Registration",
    "Reliability",
    "Relocalization",
    "ResidualNoise",
    "SkinRemoval",
    "Start",
    "Tukey",
    "Uncertainty",
    "VertexError",
    "bounded",
]


@dataclass(frozen=True)
class Config:
    """Every number that shapes a tracker's result.

    ``Config()`` is the product, ``Config.paper()`` the method as printed.
    """

    start: Start = field(default_factory=Start)
    relocalization: Relocalization = field(default_factory=Relocalization)
    registration: Registration = field(default_factory=Registration)
    discretisation: Discretisation = field(default_factory=Discretisation)
    predict: ConstantVelocity | ConstantAcceleration = field(default_factory=ConstantVelocity)
    preprocess: GridFilter | KnnFilter = field(default_factory=GridFilter)
    skin_removal: SkinRemoval = field(default_factory=SkinRemoval)
    coarse: Coarse = field(default_factory=Coarse)
    pyramid: Pyramid = field(default_factory=Pyramid)
    associate: PlaneAssociation | NearestPoint = field(default_factory=PlaneAssociation)
    robust: Tukey | NoWeight = field(default_factory=Tukey)
    adapt: ResidualNoise | InnovationNoise = field(default_factory=ResidualNoise)
    physics: Physics = field(default_factory=Physics)
    fuse: MapUpdate | DecoupledUpdate = field(default_factory=MapUpdate)
    reliability: Reliability | PaperReliability = field(default_factory=Reliability)
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    evidence: ErrorEvidence = field(default_factory=ErrorEvidence)
    frame_error: FrameError = field(default_factory=FrameError)
    vertex_error: VertexError = field(default_factory=VertexError)

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
        """The inverse of :meth:`to_dict`. Missing stages and fields keep their defaults, or those of ``{"preset": "paper"}``.

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
