"""Units of length and time: sizes of cloud, garment and body, and time steps, that other units would explain."""

from __future__ import annotations

import numpy as np

from ddakf.errors import InvalidFrame, InvalidMesh
from ddakf.mesh import Mesh
from ddakf.stages.grid import spread_rows
from ddakf.types import Estimate, FrameInput, Problem, Setup, Sign, Track

SCALE = 10.0  # ratio of the sizes of cloud and garment, either way, that no cloud of the garment has
FASTEST = 100.0  # m/s, speed that no garment has
SMALLEST = 20.0  # size of the garment over that of the cloud, while tracking: more may be hidden than at the start
SEEN = 0.05  # share of observed vertices, above which the unit is right
ENOUGH = 100  # least number of points of a cloud whose size counts
SAMPLE = 256  # number of points of which the size is measured
CENTRAL = 0.8  # share of the points between the two that are measured: stray points lie outside
NEAR = 0.01  # share of the points around the garment, above which a large cloud is a scene with the garment in it
LONG_STEP, SHORT_STEP = 5.0, 2e-4  # s, longest and shortest time between two frames of a sensor
LONG_GAP = 86_400.0  # s, longest pause of a recording: after a longer one the clock was set, or is another one
LARGEST, LEAST = 10.0, 0.15  # m, size of the largest garment that is accepted, and of the smallest without a warning
AT_BOUND = 1e-6  # logarithm of a size, by which it is below its bound
OTHER_SIZE = 0.05  # growth along an axis of the template, from which on the garment is of another size
LIKE = 3.0  # ratio of two time steps, up to which they are alike
POSE = 1.6  # ratio of two sizes, up to which a pose or a view explains it
UNITS = {1000.0: "millimetres", 100.0: "centimetres", 39.37: "inches"}  # in a metre
STEPS = {1e3: "milliseconds", 1e6: "microseconds", 1e9: "nanoseconds"}  # in a second
USUAL_STEP = 1.0 / 30.0  # s


def require_scale(setup: Setup, last: Track, frame: FrameInput) -> None:
    """Refuses a cloud before the first fit whose unit cannot be the garment's.

    Raises:
        InvalidFrame: ten times as large as the garment with nothing near it, or ten times as small.
    """
    if last.health.state != "initializing" or len(frame.points) < ENOUGH:
        return
    size, garment = extent(frame.points), setup.model.mesh.size
    if garment / SCALE < size < garment * SCALE or (size > garment and _surrounds(frame.points, last.state.position, garment)):
        return
    expected = f"a cloud of the garment, which is {garment:.2g} m in size"
    raise InvalidFrame("points", expected, f"{size:.3g} m{_as_if(size / garment)}")


def require_start(garment: Mesh, position: np.ndarray, velocity: np.ndarray) -> None:
    """Refuses (V, 3) vertices and velocities of a start whose unit cannot be metres.

    Raises:
        InvalidFrame: edges ten times as long as the garment's, or half of the vertices faster than 100 m/s.
    """
    length, rest = (float(np.median(edge_lengths(vertices, garment.faces))) for vertices in (position, garment.vertices))
    if length > SCALE * rest:
        expected = f"vertices of the garment, whose edges are {rest:.2g} m long"
        raise InvalidFrame("vertices", expected, f"{length:.3g} m{_as_if(length / rest)}")
    speed = float(np.median(np.linalg.norm(velocity, axis=1)))
    if speed > FASTEST:
        raise InvalidFrame("velocities", f"metres per second, at most {FASTEST:g} for half of the vertices", f"{speed:.3g}")


def edge_lengths(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Metres: the first edge of some of the triangles."""
    chosen = faces[:: -(-len(faces) // SAMPLE)]
    return np.linalg.norm(vertices[chosen[:, 1]] - vertices[chosen[:, 0]], axis=1)


def require_size(garment: Mesh, body: Mesh | None) -> None:
    """Refuses a garment or a body whose unit cannot be metres.

    Raises:
        InvalidMesh: larger than 10 m, or a garment ten times as large as its body.
    """
    for name, mesh in (("garment", garment), ("body", body)):
        if mesh is not None and mesh.size > LARGEST:
            unit = "millimetres" if mesh.size > 20.0 * LARGEST else "centimetres or inches"
            raise InvalidMesh(name, f"metres, at most {LARGEST:g} in size", f"{mesh.size:.3g}, which looks like {unit}")
    if body is not None and garment.size > SCALE * body.size:
        expected = f"a garment for the body, which is {body.size:.2g} m in size"
        raise InvalidMesh("garment", expected, f"{garment.size:.3g} m{_as_if(garment.size / body.size)}")


def length_unit(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a garment that is too small, or of a cloud in another unit, in a frame that was tracked all the same."""
    points, garment = problem.frame.points, problem.model.mesh.size
    if garment < LEAST:
        return Sign("garment", f"the garment is {garment:.2g} m in size, smaller than any: is it in another unit?")
    if len(points) < ENOUGH or estimate.observed.mean() > SEEN:
        return None
    size = extent(points)
    if garment / SMALLEST < size < SCALE * garment or (size > garment and not problem.cloud.empty):
        return None
    return Sign("points", f"the cloud is {size:.3g} m in size and the garment {garment:.2g} m{_as_if(size / garment)}")


def garment_size(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a template of another size than the garment."""
    growth = np.expm1(np.diag(problem.last.size))
    if np.abs(growth).max() < OTHER_SIZE:
        return None
    most = problem.config.physics.size_most
    if np.abs(np.linalg.eigvalsh(problem.last.size)).max() > np.log1p(most) - AT_BOUND:
        beyond = f"the garment is {100.0 * most:.0f} % larger or smaller than its template, or more than that"
        return Sign("garment", f"{beyond}, which is not followed: is the template in another unit?")
    along = ", ".join(f"{100.0 * share:+.0f} % along {axis}" for share, axis in zip(growth, "xyz", strict=True))
    return Sign("garment", f"the garment is larger or smaller than its template, by {along}, and is tracked in that size")


def time_unit(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of even time steps that are as long as if a smaller unit were taken for seconds."""
    dt, before = problem.dt, problem.health.spacing
    if problem.last.time is None or min(dt, before) < LONG_STEP or not 1.0 / LIKE < dt / before < LIKE:
        return None
    unit = STEPS[min(STEPS, key=lambda per_second: abs(np.log(dt / per_second / USUAL_STEP)))]
    return Sign("timestamp", f"frames are {dt:.4g} s apart, which looks like {unit}")


def stale_clock(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a clock that hardly advances between frames."""
    if problem.last.time is None or problem.dt >= SHORT_STEP:
        return None
    return Sign("timestamp", f"frames are {1e6 * problem.dt:.3g} us apart, less than any sensor's: the clock stands nearly still")


def clock_jump(problem: Problem, estimate: Estimate) -> Sign | None:
    """The sign of a clock that was set, or of time stamps from two clocks."""
    if problem.last.time is None or problem.dt <= LONG_GAP:
        return None
    return Sign("timestamp", f"it is {problem.dt / 86_400.0:.3g} days after the last frame's: two clocks, or one that was set")


def extent(points: np.ndarray) -> float:
    """Metres: size of (N, 3) points along their longest axis, whatever stray points there are."""
    return float(extents(points).max())


def extents(points: np.ndarray) -> np.ndarray:
    """(3,) metres: size of (N, 3) points along each axis, whatever stray points there are."""
    chosen = np.sort(points[spread_rows(len(points), SAMPLE)], axis=0)
    out = round(0.5 * (1.0 - CENTRAL) * (len(chosen) - 1))
    return (chosen[-1 - out] - chosen[out]) / CENTRAL


def _surrounds(points: np.ndarray, position: np.ndarray, margin: float) -> bool:
    """Whether some of (N, 3) points are about the garment at (V, 3) ``position``; metres."""
    chosen = points[spread_rows(len(points), SAMPLE)]
    inside = (chosen > position.min(axis=0) - margin) & (chosen < position.max(axis=0) + margin)
    return bool(inside.all(axis=1).mean() > NEAR)


def _as_if(ratio: float) -> str:
    """The units that a ratio of sizes looks like, as the end of a sentence."""
    for per_metre, unit in UNITS.items():
        if 1.0 / POSE < ratio / per_metre < POSE:
            return f", which looks like {unit} for metres"
        if 1.0 / POSE < ratio * per_metre < POSE:
            return f", as if the other were in {unit}"
    return f", {ratio:.3g} times as much" if ratio > 0.0 else ""
