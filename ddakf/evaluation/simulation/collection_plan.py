"""Collection of simulated recordings: garments, fits, fabrics, bodies and motions in balance, and seeds that no fit may use.

Any first part of the balanced list is about as balanced as the whole, so that an unfinished collection is of use. Training
recordings of what the balanced list has for scores alone, such as lower garments that twist, are added at its end, and then
fresh ones: each garment once, simulated after everything that could be chosen had been.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ddakf.evaluation.datasets.collection import FRESH, HELD_OUT, TRAINING
from ddakf.evaluation.simulation.fabrics import FABRICS
from ddakf.evaluation.simulation.simulated_recording import Order

FRAMES, SUBSTEPS = 120, 12
ROUNDS = 6  # through all garments
ATTEMPTS = 4  # seeds of a recording; the next one where the quality does not suffice
FITS = ("close", "loose")
MOTIONS = ("turn", "walk", "sit", "dance", "run", "squat", "overhead", "twist", "lie", "jump", "random", "swing", "crossed-arms")
VERTICES = {
    "trousers": 1200, "long-shirt": 1100, "straight-skirt": 1000, "hoodie": 1200, "shorts": 900, "jacket": 1200, "cape": 850,
    "dress": 1100, "tshirt": 950, "skirt": 1050, "tank": 800,
}  # fmt: skip ; edges of about 30 mm
BALANCED = ROUNDS * len(VERTICES)  # recordings
ADDED = (
    ("shorts", "twist", "loose", "cotton"), ("straight-skirt", "twist", "close", "wool"), ("trousers", "twist", "loose", "denim"),
    ("skirt", "twist", "close", "cotton"), ("shorts", "dance", "close", "denim"), ("straight-skirt", "walk", "loose", "cotton"),
    ("trousers", "walk", "close", "jersey"), ("cape", "walk", "close", "cotton"), ("cape", "squat", "loose", "wool"),
    ("shorts", "squat", "close", "wool"),
)  # fmt: skip ; garment, motion, fit, fabric
LATER = BALANCED + len(ADDED)  # number of the first fresh recording
FRESH_ONES = (
    ("trousers", "dance", "close", "cotton"), ("long-shirt", "lie", "loose", "wool"), ("straight-skirt", "turn", "close", "silk"),
    ("hoodie", "squat", "loose", "denim"), ("shorts", "random", "close", "jersey"), ("jacket", "sit", "loose", "cotton"),
    ("cape", "twist", "close", "wool"), ("dress", "swing", "loose", "cotton"), ("tshirt", "run", "close", "denim"),
    ("skirt", "jump", "loose", "jersey"), ("tank", "walk", "close", "cotton"),
)  # fmt: skip
SEEDS = {  # of a split; others belong to none
    TRAINING: range(1_000, 10_000), HELD_OUT: range(900_000, 1_000_000), FRESH: range(700_000, 800_000),
}  # fmt: skip


@dataclass(frozen=True)
class Entry:
    """A recording of the collection.

    Attributes:
        number: its place in the list.
        attempt: from 0; each has another seed.
    """

    number: int
    attempt: int = 0

    @property
    def split(self) -> str:
        """On training recordings constants and weights may be chosen, on others they may not."""
        if self.number >= LATER:
            return FRESH
        turn, garment = divmod(self.number, len(VERTICES))
        return HELD_OUT if self.number < BALANCED and (turn + 2 * garment) % 3 == 2 else TRAINING

    @property
    def seed(self) -> int:
        """Seed of the garment's measures, the body and the motion."""
        return SEEDS[self.split].start + 10 * self.number + self.attempt

    @property
    def order(self) -> Order:
        """Parameters of the simulation."""
        chosen = ADDED + FRESH_ONES
        garment, motion, fit, fabric = chosen[self.number - BALANCED] if self.number >= BALANCED else self._balanced()
        return Order(garment, motion, FRAMES, VERTICES[garment], 30.0, self.seed, fit, fabric, self.seed, SUBSTEPS)

    def _balanced(self) -> tuple[str, str, str, str]:
        turn, place = divmod(self.number, len(VERTICES))
        fit, fabric = FITS[(turn + place) % len(FITS)], list(FABRICS)[(2 * turn + place) % len(FABRICS)]
        return list(VERTICES)[place], MOTIONS[5 * self.number % len(MOTIONS)], fit, fabric

    @property
    def name(self) -> str:
        """``trousers_sit_close_17``."""
        return f"{self.order.garment}_{self.order.motion}_{self.order.fit}_{self.number:02d}"

    def again(self) -> Entry:
        """The next attempt."""
        return replace(self, attempt=self.attempt + 1)


def entries() -> list[Entry]:
    """All recordings of the collection."""
    return [Entry(number) for number in range(LATER + len(FRESH_ONES))]
