"""Range checks of configuration fields."""

from __future__ import annotations

import dataclasses
import typing
from dataclasses import field

from ddakf.errors import InvalidConfig, shown

C = typing.TypeVar("C")


def bounded(default: float, low: float, high: float) -> typing.Any:
    """A numeric field whose value must lie in [low, high]."""
    return field(default=default, metadata={"range": (low, high)})


class Checked:
    """Base of the configuration classes: checks every :func:`bounded` field when an object is made.

    A whole number where a float is meant becomes one: kernels are compiled for floats.
    """

    def __post_init__(self) -> None:
        for f in dataclasses.fields(self):
            if isinstance(f.default, bool) and not isinstance(getattr(self, f.name), bool):
                raise InvalidConfig(f"{type(self).__name__}.{f.name}", "true or false", shown(getattr(self, f.name)))
            if "range" not in f.metadata:
                continue
            low, high = f.metadata["range"]
            value = getattr(self, f.name)
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not low <= value <= high:
                raise InvalidConfig(f"{type(self).__name__}.{f.name}", f"a number in [{low:g}, {high:g}]", shown(value))
            if isinstance(f.default, int) and not isinstance(value, int):
                raise InvalidConfig(f"{type(self).__name__}.{f.name}", "an integer", shown(value))
            if isinstance(f.default, float):
                object.__setattr__(self, f.name, float(value))


def derived(config: C, **values: typing.Any) -> C:
    """A copy with other values, which are not checked: they were computed from checked ones, in each frame anew."""
    copy = object.__new__(type(config))
    vars(copy).update(vars(config), **values)
    return copy
