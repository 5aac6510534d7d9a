"""Fabrics of simulated garments: weight, stretch, bending and friction."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Fabric:
    """Material of the cloth.

    Attributes:
        density: kg/m^2.
        stretch: membrane stiffness, N/m.
        damping: of stretch, relative to its stiffness, seconds.
        bending: stiffness of a hinge, N m.
        friction: on body and itself, no unit.
        contact: stiffness of contacts, N/m.
    """

    density: float = 0.18
    stretch: float = 3000.0
    damping: float = 2e-5
    bending: float = 2e-5
    friction: float = 0.4
    contact: float = 30_000.0


FABRICS = {
    "cotton": Fabric(),
    "silk": Fabric(density=0.09, stretch=2500.0, bending=4e-6, friction=0.25),
    "jersey": Fabric(density=0.2, stretch=1500.0, bending=8e-6),
    "wool": Fabric(density=0.3, bending=8e-5, friction=0.5),
    "denim": Fabric(density=0.38, stretch=6000.0, bending=2e-4),
}
DEFAULT_FABRIC = FABRICS["cotton"]
