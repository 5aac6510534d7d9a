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
    paths, others = list(paths), list(others)
    keys: tuple[Callable[[Path], object], ...] = (lambda p: p.stem, lambda p: tuple(by_number(p)), lambda p: by_number(p)[0])
    for key in keys:
        found = {key(other): other for other in others}
        if len(found) == len(others) and len({key(path) for path in paths}) == len(paths):
            matched = [found.get(key(path)) for path in paths]
            if None not in matched:
                return matched
    return _by_first(paths, others)


def _by_first(paths: list[Path], others: list[Path]) -> list[Path | None]:
    """For every image the other one that alone has the same first number in its name."""
    count = Counter(by_number(other)[0] for other in others)
    images = Counter(by_number(path)[0] for path in paths)
    found = {by_number(other)[0]: other for other in others}
    first = [by_number(path)[0] for path in paths]
    return [found.get(number) if count[number] == images[number] == 1 else None for number in first]
