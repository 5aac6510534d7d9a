"""Fabrics: relative stiffness of stretch, shear and bending (paper, section 2.4).

The presets are relative values, not material certificates: each column is divided by its geometric mean over the five fabrics
and rounded, so that ``NORMALISED`` is the middle of ordinary clothing.

======== =========== ========= ============ ==========================================================================
fabric   stretch N/m shear N/m bend 1e-6 Nm source
======== =========== ========= ============ ==========================================================================
cotton   260         50        8            no source found
silk     700         15        3            no source found
denim    456         53        64           11 oz black denim (99 % cotton), Wang et al.
wool     97          35        12           no source found
jersey   24          37        23           gray interlock (T-shirt, 60 % cotton), Wang et al.
======== =========== ========= ============ ==========================================================================

Wang, O'Brien, Ramamoorthi 2011, "Data-driven elastic models for cloth: modeling and measurement", ACM Transactions on Graphics
30(4): the first sample of the material files ``11oz-black-denim.json`` and ``gray-interlock.json`` that come with ARCSim. Of its
four numbers the first and the third resist stretch along the two axes, the fourth shear, as ARCSim's ``stretching_force`` reads
them. Stretch is the geometric mean of the two (205 and 1014; 16.6 and 34.5 N/m), bending the first number of its table. Where no
source was found, the number is the order of magnitude that is usual for light plain weaves and suitings, and no measurement. Two
samples of one fabric differ by a factor of two and more.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import ClassVar

from ddakf.errors import InvalidConfig, shown


@dataclass(frozen=True)
class Fabric:
    """Multipliers of the tracker's stiffnesses, dimensionless, each at least 0.

    Stretch and shear act by their mean, since a template does not tell the directions of its threads.

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
                raise InvalidConfig(f"fabric.{field.name}", "a finite number of at least 0", shown(value))

    @classmethod
    def named(cls, name: str) -> Fabric:
        """The preset of this name, in any case.

        Raises:
            InvalidConfig: there is none.
        """
        preset = PRESETS.get(name.lower()) if isinstance(name, str) else None
        if preset is None:
            raise InvalidConfig("fabric", "one of " + ", ".join(PRESETS), shown(name))
        return preset

    @property
    def name(self) -> str:
        """The preset with these multipliers; empty for the default, and where there is none."""
        return "" if self == Fabric() else next((name for name, preset in PRESETS.items() if preset == self), "")


PRESETS = {
    "cotton": Fabric(stretch=1.4, shear=1.4, bend=0.6),
    "silk": Fabric(stretch=3.9, shear=0.43, bend=0.22),
    "denim": Fabric(stretch=2.5, shear=1.5, bend=4.8),
    "wool": Fabric(stretch=0.54, shear=1.0, bend=0.9),
    "jersey": Fabric(stretch=0.13, shear=1.06, bend=1.7),
    "normalised": Fabric(),
}
for _name, _preset in PRESETS.items():
    setattr(Fabric, _name.upper(), _preset)
