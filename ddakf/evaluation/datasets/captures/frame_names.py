"""Names of frames: their order, and which masks and colours belong to which images."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable
from decimal import Decimal
from pathlib import Path

MOST_COUNTED = 6, 2  # digits before and behind a point, of names that count; with more, digits.digits are seconds


def by_number(path: Path) -> list[int]:
    """Sort key of a frame: the numbers in its file name."""
    return [int(digits) for digits in re.findall(r"\d+", path.name)] or [0]


def in_order(paths: Iterable[Path]) -> tuple[Path, ...]:
    """Frames by the numbers in their names, then by name; by their times where all names are times with decimals."""
    paths = sorted(paths, key=lambda path: path.name)
    stamps = [re.fullmatch(r"(\d+)\.(\d+)", path.stem) for path in paths]
    if all(stamps) and any(len(stamp[1]) > MOST_COUNTED[0] or len(stamp[2]) > MOST_COUNTED[1] for stamp in stamps):
        return tuple(sorted(paths, key=lambda path: Decimal(path.stem)))
    return tuple(sorted(paths, key=by_number))


def beside(paths: Iterable[Path], others: Iterable[Path]) -> list[Path | None]:
    """For every image the other one of the same name, or else of the same numbers in it, or else of the same first number.

    Of these the first holds that gives each image one of its own. None without one.
    """
    paths, others, matched = list(paths), list(others), []
    keys: tuple[Callable[[Path], object], ...] = (lambda p: p.stem, lambda p: tuple(by_number(p)), lambda p: by_number(p)[0])
    for key in keys:
        of_paths, of_others, found = Counter(map(key, paths)), Counter(map(key, others)), {key(other): other for other in others}
        matched = [found[key(p)] if of_paths[key(p)] == of_others[key(p)] == 1 else None for p in paths]
        if None not in matched:
            break
    return matched
