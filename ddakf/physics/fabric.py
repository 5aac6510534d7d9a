"""Fabrics: relative stiffness of stretch, shear and bending (paper, section 2.4).

The presets are relative values, not material certificates. Column by column they are typical moduli divided by the
geometric mean of the five fabrics, rounded, so that ``NORMALISED`` is the middle of ordinary clothing:

======== =========== ========= ============ ========================================================================
fabric   stretch N/m shear N/m bend 1e-6 Nm source
======== =========== ========= ============ ========================================================================
cotton   800         50        8            plain-weave shirting, middle of the ranges usual in KES-F measurements
silk     700         15        3            light dress silk, the same
denim    1000        150       64           stretch, bend: 11 oz black denim, Wang et al.; shear: KES-F range
wool     300         35        12           suiting, middle of the KES-F ranges
jersey   35          20        23           stretch, bend: grey interlock (T-shirt), Wang et al.; shear: KES-F range
======== =========== ========= ============ ========================================================================

Wang, O'Brien, Ramamoorthi 2011, "Data-driven elastic models for cloth" (its published material files at small strain);
Kawabata 1980, "The standardization and analysis of hand evaluation" (KES-F; orders of magnitude, read off no one
sample). Two samples of one fabric differ by a factor of two and more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import ClassVar

from ddakf.errors import InvalidConfig


@dataclass(frozen=True)
class Fabric:
    """Multipliers of the tracker's stiffnesses, dimensionless, each at least 0.

    Args:
        stretch: resistance to lengthening along warp and weft.
        shear: resistance to a change of the angle between them.
        bend: resistance to a change of the dihedral angles.

    Raises:
        InvalidConfig: a multiplier negative or not finite.
    """

    stretch: float = 1.0
    shear: float = 1.0
    bend: float = 1.0

    COTTON: ClassVar[Fabric]
    SILK: ClassVar[Fabric]
    DENIM: ClassVar[Fabric]
    WOOL: ClassVar[Fabric]
    JERSEY: ClassVar[Fabric]
    NORMALISED: ClassVar[Fabric]

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if isinstance(value, bool) or not isinstance(value, int | float) or not 0.0 <= value < math.inf:
                raise InvalidConfig(f"fabric.{field.name}", "a finite number of at least 0", repr(value))

    @classmethod
    def named(cls, name: str) -> Fabric:
        """The preset of this name, in any case.

        Raises:
            InvalidConfig: there is none.
        """
        preset = PRESETS.get(name.lower()) if isinstance(name, str) else None
        if preset is None:
            raise InvalidConfig("fabric", "one of " + ", ".join(PRESETS), repr(name))
        return preset


PRESETS = {
    "cotton": Fabric(stretch=2.2, shear=1.3, bend=0.6),
    "silk": Fabric(stretch=2.0, shear=0.4, bend=0.22),
    "denim": Fabric(stretch=2.8, shear=3.9, bend=4.8),
    "wool": Fabric(stretch=0.84, shear=0.92, bend=0.9),
    "jersey": Fabric(stretch=0.1, shear=0.53, bend=1.7),
    "normalised": Fabric(),
}
for _name, _preset in PRESETS.items():
    setattr(Fabric, _name.upper(), _preset)
