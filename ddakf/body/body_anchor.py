"""Body anchor: the garment's place on the body as a pseudo-measurement of its unseen vertices, and of its waistband.

Prediction rides on the body from frame to frame, and unseen cloth adds up the errors of all frames. Its place on the body since
the start does not. Along the normal it deviates the more, the wider the cloth hangs around the body and the farther below its
top. By how much more or less than that a garment does is learned where it is seen, as stage D learns R: a shirt that fits tightly
is held, a skirt that swings is not.

Across the normal cloth slips on the body. A garment hangs by its top. A waistband goes with the body; the farther below, the
more the cloth goes with itself: shorts turn as their waistband does, and not as the thighs inside. A cloud does not show how a
skirt is turned, so that a waistband is held along itself where it is seen too. What lies on the shoulders, such as a shirt, goes
with the body all over: by how much it slips is learned where it is seen, as along the normal, and it is held by that much.
"""

from __future__ import annotations

from math import exp

import numpy as np

from ddakf.body import contact
from ddakf.config import Anchor, Config
from ddakf.garment import geodesic
from ddakf.kernels.normals import vertex_normals
from ddakf.types import BodyAnchor, Bound, Model, Planes, Problem, Setup, Track

TOP = 0.05  # m below the highest vertex, or of cloth below it, that are a garment's top
UNKNOWN = 1e6  # m^2, variance of what is not measured
ROUND = 0.6  # of the squared boundary of a flat disc of the same area: a sheet has more, half a sphere half
LEVEL = 0.5  # mean vertical part of its normals there, in size: waistbands have a third at most, shoulders two thirds at least


def start(setup: Setup, pose: np.ndarray, position: np.ndarray) -> BodyAnchor:
    """The anchor of a garment at (V, 3) ``position`` on the body in a (B, 3) ``pose``, metres; nothing is learned yet."""
    model, config, n = setup.model, setup.config.anchor, len(setup.model.likeness)
    bound = contact.bind(setup.body, pose, position, config.reach)
    lying = _lies_on_shoulders(model, setup.config.start.to_y_up[1])
    slip = (config.shoulder_slip_sd if lying else config.slip_sd) + config.slip_slope * _patch_means(model, model.hanging)
    waistband = (model.hanging <= TOP) & (not lying and not _is_flap(model, setup.config.start.to_y_up[1]))
    held = np.square(config.slip_sd + config.slip_slope * model.hanging) * waistband
    measured = np.zeros(len(position), bool)
    across = np.zeros(n) if lying else None
    return BodyAnchor(bound, np.zeros(n), np.zeros(n), measured, _first_guess(setup, bound), np.square(slip), held, across)


def placed(setup: Setup, track: Track, pose: np.ndarray) -> Track:
    """The track before the first frame, in which the body has a (B, 3) ``pose``, metres; see :func:`contact.placed`."""
    position = track.state.position
    body = contact.placed(setup.body, track.body, position, pose, setup.config.physics)
    if body is track.body:
        return track
    return track._replace(body=body, anchor=track.anchor and start(setup, body.vertices, position))


def _lies_on_shoulders(model: Model, up: np.ndarray) -> bool:
    """Whether the template is level at its top, as on shoulders; a waistband is upright, and a cape, a flap, is fastened."""
    position, normal = model.mesh.vertices, np.empty_like(model.mesh.vertices)
    if _is_flap(model, up):
        return False
    vertex_normals(position, model.faces, normal)
    height = position @ up
    return bool(np.abs(normal @ up)[height > height.max() - TOP].mean() > LEVEL)


def _is_flap(model: Model, up: np.ndarray) -> bool:
    """Whether the topmost piece of the template is one sheet, as a cape.

    By Euler's number a sheet has 1, a tube 0, a shirt with sleeves -2. A bag, such as a sock or a cap, has 1 too, but a shorter
    boundary than a disc of its area.
    """
    mesh = model.mesh
    piece = geodesic.pieces(mesh.edges, mesh.n_vertices)
    top = piece == piece[(mesh.vertices @ up).argmax()]
    corner, boundary = mesh.vertices[mesh.faces[top[mesh.faces[:, 0]]]], model.boundary[top[model.boundary[:, 0]]]
    if np.count_nonzero(top) - np.count_nonzero(top[mesh.edges[:, 0]]) + len(corner) <= 0:
        return False
    area = 0.5 * np.linalg.norm(np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]), axis=1).sum()
    smooth = mesh.vertices.copy()
    smooth[boundary[:, 0]] = np.einsum("k,hka->ha", [0.5, 0.25, 0.25], mesh.vertices[boundary])  # without the teeth of triangles
    around = np.linalg.norm(smooth[boundary[:, 2]] - smooth[boundary[:, 0]], axis=1).sum()
    return bool(around**2 >= ROUND * 4.0 * np.pi * area)


def _first_guess(setup: Setup, bound: Bound) -> np.ndarray:
    """(L,) m^2 of the deviations in a patch along the normal, which grow with its clearance and with the cloth above it."""
    model, config, (face, distance) = setup.model, setup.config.anchor, (bound.contact.face, bound.contact.distance)
    clearance = np.where(face < 0, config.reach, np.clip(distance, 0.0, config.reach))
    wide, below = _patch_means(model, clearance), _patch_means(model, model.hanging)
    return np.square(config.normal_sd + config.clearance_slope * wide + config.hanging_slope * below)


def _patch_means(model: Model, values: np.ndarray) -> np.ndarray:
    """(L,) means of (V,) values."""
    return np.bincount(model.patch, values) / np.bincount(model.patch)


def enabled(config: Config) -> bool:
    """Whether the body holds unseen vertices."""
    return config.predict.carry_reach > 0 and config.anchor.memory > 0


def measure(problem: Problem) -> Problem:
    """The problem with the pseudo-measurements of the vertices that were not measured in the last frame, and of held ones.

    What was measured is held along the surface alone: a waistband, and all of what lies on the shoulders. The error of the body
    adds to the slip. There are none where the pose of the body is not known, and while a relocalized garment settles. The
    deviations of a patch count as one. A patch of which nothing was seen deviates as the patches around it do, each over its
    first guess.
    """
    anchor, body, model, config = problem.last.anchor, problem.body, problem.model, problem.config.anchor
    if anchor is None or body is None or problem.health.settling:
        return problem
    target = contact.follow(anchor.bound, body, config.reach)
    normal = np.empty_like(target)
    vertex_normals(target, model.faces, normal)
    size, seen, slip = len(target) / len(model.likeness), anchor.measured, _slip(anchor, model, config)[model.patch]
    held = anchor.held if anchor.across is None else config.seen_slip**2 * slip
    planes = Planes(
        target=target,
        normal=normal,
        weight=np.where((seen & (held == 0.0)) | (anchor.bound.contact.face < 0), 0.0, 1.0),
        variance=np.where(seen, UNKNOWN, size * _along(anchor, model, config)[model.patch]),
        tangential=size * (np.where(seen, held, slip) + contact.error2(body)),
    )
    return problem._replace(anchored=planes)


def slack(problem: Problem) -> np.ndarray | None:
    """(L,) metres: standard deviation of a patch's place on the body; None without pseudo-measurements."""
    if problem.anchored is None:
        return None
    anchor = problem.last.anchor
    model, config = problem.model, problem.config.anchor
    return np.sqrt(_along(anchor, model, config) + 2.0 * (_slip(anchor, model, config) + contact.error2(problem.body)))


def _along(anchor: BodyAnchor, model: Model, config: Anchor) -> np.ndarray:
    """(L,) m^2 of the deviations in a patch along the normal."""
    return _deviations(anchor, anchor.guess, anchor.squares, model, config)


def _slip(anchor: BodyAnchor, model: Model, config: Anchor) -> np.ndarray:
    """(L,) m^2 of the deviations in a patch along either tangent: learned of what lies on the shoulders."""
    if anchor.across is None:
        return anchor.slip
    return _deviations(anchor, anchor.slip, config.slip_share**2 * anchor.across, model, config)


def _deviations(anchor: BodyAnchor, guess: np.ndarray, squares: np.ndarray, model: Model, config: Anchor) -> np.ndarray:
    """(L,) m^2 by patch: the first ``guess``, times what the ``squares`` of the patches around it are of theirs."""
    relative, seen = (model.likeness @ np.column_stack([squares / guess, anchor.seen])).T
    first = config.first_share
    return np.maximum(guess * (relative + first) / (seen + first), config.least_sd**2)


def learn(problem: Problem, position: np.ndarray, measured: np.ndarray) -> BodyAnchor | None:
    """The anchor after a frame. A relocalized garment gets a new one once it has settled.

    Args:
        problem: the frame.
        position: (V, 3) the posterior, metres.
        measured: (V,) bool.
    """
    anchor, model, config, planes = problem.last.anchor, problem.model, problem.config.anchor, problem.anchored
    if problem.last.body is None or problem.health.settling > 0 or not enabled(problem.config):
        return None
    if anchor is None:
        body = problem.body
        return None if body is None else start(Setup(model, body.model, problem.config), body.vertices, position)
    if planes is None:
        return anchor
    n, used = len(anchor.seen), measured & (anchor.bound.contact.face >= 0)
    off = (position - planes.target)[used]
    along = np.einsum("va,va->v", off, planes.normal[used])
    patch, size, old = model.patch[used], np.bincount(model.patch, minlength=n), exp(-problem.dt / config.memory)
    seen = old * anchor.seen + (1.0 - old) * np.bincount(patch, minlength=n) / size
    squares = old * anchor.squares + (1.0 - old) * np.bincount(patch, np.square(along), n) / size
    anchor = anchor._replace(seen=seen, squares=squares, measured=measured)
    if anchor.across is None:
        return anchor
    across = 0.5 * (np.einsum("va,va->v", off, off) - np.square(along))
    return anchor._replace(across=old * anchor.across + (1.0 - old) * np.bincount(patch, across, n) / size)
