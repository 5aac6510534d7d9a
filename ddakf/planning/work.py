"""Work of a frame with a budget: what it costs, what it may take, and what is left out of it."""

from __future__ import annotations

import math
from typing import NamedTuple


class Rate(NamedTuple):
    """Processor time of a unit of work: running mean and mean deviation, seconds."""

    mean: float
    deviation: float
    known: bool = False  # measured at least once


class Costs(NamedTuple):
    """Processor time of the parts of a frame, learned in frames with a budget."""

    search: Rate  # of a search, or of a registration after one
    points: Rate  # preprocessing, of a point
    probe: Rate  # whether clusters need to be aligned
    clusters: Rate  # of a pass of cluster alignment
    first: Rate  # of the first pass at full size
    later: Rate  # of a later one
    end: Rate  # from the last pass to the result
    overruns: float  # searches that may exceed the budget


class Effort(NamedTuple):
    """Work that a frame with a budget may take. The default leaves nothing out."""

    planned: bool = False  # there is a budget
    search: bool = True  # for the garment, where one is due
    due: bool = False  # a search, or a registration after one
    points: float = 1.0  # share of the cloud
    passes: float = math.inf  # at most: of cluster alignment, or at full size, whichever comes next


class Work(NamedTuple):
    """Work of a frame, and what its budget left out of it."""

    clusters: int = 0  # passes of cluster alignment
    unaligned: bool = False  # cluster alignment was left out, or ended too early
