"""Warnings: signs of wrong input that have lasted for some frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

from ddakf.config import Config
from ddakf.garment import seams
from ddakf.mesh import Mesh
from ddakf.plausibility import orientation, placement, sensor_poses, sidedness, units
from ddakf.results import InputWarning, WarningCode
from ddakf.stages.reliability import Verdict
from ddakf.types import Estimate, InputReference, Model, Problem, Sign

PERIOD = 0.2  # s between two looks for signs that last


class Check(NamedTuple):
    """A sign that is looked for."""

    find: Callable[[Problem, Estimate], Sign | None]
    frames: int  # number of frames in a row with the sign, from which on it is a warning
    spaced: bool = False  # whether it is looked for once in a PERIOD, and in every frame while it is there


def _sensor_origin_missing(problem: Problem, estimate: Estimate) -> Sign | None:
    view = problem.last.view
    if not view.one_sided:
        return None
    x, y, z = view.side
    seen = f"{view.hidden_share:.0%} of it lies in a second layer, of the garment {problem.reference.sides.hidden_share:.0%}"
    side = f"one side ({seen}), from about ({x:.2f}, {y:.2f}, {z:.2f})"
    return Sign("sensor_origin", f"no sensor origin came, and the cloud shows {side}")


CHECKS: Mapping[WarningCode, Check] = {
    "sensor_origin_missing": Check(_sensor_origin_missing, 1),
    "nothing_in_reach": Check(placement.nothing_in_reach, 5),
    "whole_person": Check(placement.whole_person, 10),
    "length_unit": Check(units.length_unit, 2, spaced=True),
    "garment_size": Check(units.garment_size, 10, spaced=True),
    "time_unit": Check(units.time_unit, 2),
    "stale_clock": Check(units.stale_clock, 3),
    "clock_jump": Check(units.clock_jump, 1),
    "upside_down": Check(orientation.upside_down, 1),
    "heading_uncertain": Check(orientation.heading_uncertain, 1),
    "wrong_up": Check(orientation.wrong_up, 5),
    "split_seams": Check(placement.split_seams, 1),
    "mirrored": Check(orientation.mirrored, 5, spaced=True),
    "points_behind_sensor": Check(placement.points_behind_sensor, 2, spaced=True),
    "narrow_mask": Check(placement.narrow_mask, 10),
    "body_apart": Check(placement.body_apart, 3),
    "body_off": Check(placement.body_off, 10),
    "sensors_off": Check(sensor_poses.misplaced, 10),
}


def reference(given: Mesh, garment: Model, body: Mesh | None, config: Config) -> InputReference:
    """What the frames of a garment are held against: the mesh as given, the garment that is tracked, and its body."""
    sides, outward = sidedness.sides(garment, config.sidedness, config.start.to_y_up[1]), orientation.outward(garment.mesh)
    reference = InputReference(sides, outward, 1.0, given.split_edges, seams.gap(garment.mesh))
    if body is None:
        return reference
    fallen = orientation.fallen(body, config.start.to_y_up)
    return reference._replace(body_outward=orientation.outward(body), fallen_body=fallen)


def add_warnings(problem: Problem, estimate: Estimate, verdict: Verdict) -> Verdict:
    """The verdict with the warnings of a frame, and for how many frames each of its signs has been there.

    A frame without points says nothing; what was found before it stays.

    Args:
        problem: the frame, with its cloud.
        estimate: finished.
        verdict: of stage G.
    """
    before, last, now = problem.last.signs, problem.last.time, problem.frame.timestamp
    if len(problem.frame.points) == 0:
        return verdict._replace(signs=before)
    due = last is None or last // PERIOD != now // PERIOD
    looked_for = ((code, check) for code, check in CHECKS.items() if due or not check.spaced or code in before)
    signs = {code: sign for code, check in looked_for if (sign := check.find(problem, estimate)) is not None}
    rows = {code: before.get(code, 0) + 1 for code in signs}
    lasting = (code for code in signs if rows[code] >= CHECKS[code].frames)
    return verdict._replace(warnings=tuple(InputWarning(code, *signs[code]) for code in lasting), signs=rows)
