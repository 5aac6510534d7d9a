"""Collection of simulated recordings: garments, fits, fabrics, bodies and motions in balance, and seeds that no fit may use.

Any first part of the list is about as balanced as the whole, so that an unfinished collection is of use.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

from ddakf.evaluation.datasets.collection import HELD_OUT, TRAINING
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
SEEDS = {TRAINING: range(1_000, 10_000), HELD_OUT: range(900_000, 1_000_000)}  # of a split; others belong to none


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
        """On training recordings constants and weights may be chosen, on held-out ones they may not."""
        turn, garment = divmod(self.number, len(VERTICES))
        return HELD_OUT if (turn + 2 * garment) % 3 == 2 else TRAINING

    @property
    def seed(self) -> int:
        """Seed of the garment's measures, the body and the motion."""
        return SEEDS[self.split].start + 10 * self.number + self.attempt

    @property
    def order(self) -> Order:
        """Parameters of the simulation."""
        turn, place = divmod(self.number, len(VERTICES))
        garment, vertices = list(VERTICES.items())[place]
        motion = MOTIONS[5 * self.number % len(MOTIONS)]
        fit, fabric = FITS[(turn + place) % len(FITS)], list(FABRICS)[(2 * turn + place) % len(FABRICS)]
        return Order(garment, motion, FRAMES, vertices, 30.0, self.seed, fit, fabric, self.seed, SUBSTEPS)

    @property
    def name(self) -> str:
        """``trousers_sit_close_17``."""
        return f"{self.order.garment}_{self.order.motion}_{self.order.fit}_{self.number:02d}"

    def again(self) -> Entry:
        """The next attempt."""
        return replace(self, attempt=self.attempt + 1)


def entries() -> list[Entry]:
    """All recordings of the collection."""
    return [Entry(number) for number in range(ROUNDS * len(VERTICES))]
