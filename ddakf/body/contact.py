"""Contact with the body: it carries the garment's prediction (stage A) and keeps the garment outside (stage E)."""

from __future__ import annotations

import numpy as np

from ddakf.body import proximity
from ddakf.config import Physics
from ddakf.kernels import collision as kernels
from ddakf.mesh import Mesh
from ddakf.types import BodyModel, BodyPose, BodyTrack, Bound, Contacts, Estimate, Problem, State

MOTION_LASTS = 0.1  # s, time constant with which the motion of a body without a new pose ends
SHORTEST = 1.0 / 60.0  # s: over less, velocities are those of the scatter of poses and timestamps
LONGEST_UNPOSED = 0.3  # s after which the pose of such a body is unknown
FASTEST = 10.0  # m/s: a body that seems to have moved faster before the first frame was elsewhere at the start
ELSEWHERE = 0.25  # how badly a garment lies around a pose over another, below which it starts in that pose
FEW = 0.02  # of the vertices: as many that are seen inside say as much of the body's error as a first guess


def build(
    mesh: Mesh, reach: float, collision_reach: float = Physics.collision_reach, known: BodyModel | None = None
) -> BodyModel:
    """The constants of a body.

    Args:
        mesh: in the pose of the start.
        reach: body surface within it carries the garment, metres; 0: it carries nothing.
        collision_reach: depth from which a body that carries nothing pushes vertices out, metres.
        known: constants of the same body, whose search tree is used again.
    """
    tree = proximity.build(mesh) if known is None else known.tree
    return BodyModel(mesh, tree, reach if reach > 0.0 else collision_reach, reach > 0.0)


def start(body: BodyModel, position: np.ndarray, config: Physics, known: BodyTrack | None = None) -> BodyTrack:
    """The body in the pose of the start, under a garment at (V, 3) ``position``, metres.

    That is the pose in which it was created, or the ``known`` one if the garment lies better around that.

    Vertices that start closer than the thickness may stay as close. A body model is wrong by centimetres in places, and a
    garment reconstructed beside it lies inside it there, the same vertices all the time. Pushed out by the thickness, the unseen
    half of a shirt inflates. A wrong start costs nothing: contact only pushes, so the vertices come out as soon as anything
    pulls them.
    """
    track = BodyTrack(body.mesh.vertices.copy(), True, None, None, None)
    if known is not None:
        last = track._replace(vertices=known.vertices.copy())
        track = min(track, last, key=lambda pose: _off(posed(body, pose), position))
    return track._replace(gap=_first_gap(posed(body, track), position, config)) if config.gap_time > 0 else track


def placed(body: BodyModel, track: BodyTrack, position: np.ndarray, vertices: np.ndarray, config: Physics) -> BodyTrack:
    """The body before the first frame, in whose pose it has (B, 3) ``vertices``, under a garment at (V, 3) ``position``, metres.

    A garment that was laid where the wearer is now is not carried there once more.
    """
    now = track._replace(vertices=np.array(vertices, np.float64), contacts=None)
    if _off(posed(body, now), position) >= ELSEWHERE * _off(posed(body, track), position):
        return track
    return now if track.gap is None else now._replace(gap=_first_gap(posed(body, now), position, config))


def _off(pose: BodyPose, position: np.ndarray) -> float:
    """How badly a garment lies around a pose, m^2: by how deep it is within it, and to a hundredth by how far from it."""
    distance = np.minimum(nearest(pose, position).closest.distance, pose.model.reach)
    return float(np.square(np.where(distance < 0.0, distance, 0.1 * distance)).mean())


def configured(body: BodyModel, track: BodyTrack, position: np.ndarray, config: Physics) -> BodyTrack:
    """The body with the gaps of another configuration, under vertices at (V, 3) ``position``, metres."""
    if config.gap_time <= 0:
        return track._replace(gap=None)
    if track.gap is None:
        return track._replace(gap=_first_gap(posed(body, track), position, config), contacts=None)
    return track._replace(gap=np.minimum(track.gap, config.thickness))


def _first_gap(pose: BodyPose, position: np.ndarray, config: Physics) -> np.ndarray:
    return np.clip(nearest(pose, position).closest.distance, -config.deepest_gap, config.thickness)


def posed(body: BodyModel, track: BodyTrack, vertices: np.ndarray | None = None) -> BodyPose:
    """The body with its (B, 3) ``vertices``, metres; None: in the pose of the track."""
    surface = proximity.refresh(body.tree, track.vertices if vertices is None else vertices)
    hint = None if track.contacts is None else track.contacts.closest.face
    return BodyPose(body, surface, track.gap, hint, track.turn, track.intruded)


def moved_on(body: BodyModel, track: BodyTrack, dt: float) -> np.ndarray | None:
    """(B, 3) metres: the body in a frame without its pose, moved on as it last moved; None where its motion is not known.

    Body estimators leave out single frames, and cloth that nothing carries or holds for one frame takes long to come back.
    """
    if track.motion is None or not body.carries or track.unposed + dt > LONGEST_UNPOSED:
        return None
    return track.vertices + (_travelled(track.unposed + dt) - _travelled(track.unposed)) * track.motion


def _travelled(seconds: float) -> float:
    """Seconds of undamped motion that a body has moved on by, so long after its last pose."""
    return MOTION_LASTS * (1.0 - float(np.exp(-seconds / MOTION_LASTS)))


def carry(
    body: BodyModel, track: BodyTrack, state: State, pose: BodyPose | None, dt: float = 1.0, friction: float = 0.0
) -> tuple[State, np.ndarray | None]:
    """What the body's motion does to a garment.

    Args:
        body: its constants.
        track: the body after the last frame.
        state: posterior of the last frame; its velocities are relative to the body if that frame had one.
        pose: the body now; None: its pose is not known.
        dt: seconds since.
        friction: 1/s, decay of the velocities relative to the body, of vertices that are fully carried.

    Returns:
        The state with velocities relative to the body, and the displacement (V, 3) in metres; None where nothing is carried.
        A garment whose body is no longer seen takes the body's last velocity over into its own.
    """
    if pose is None or not track.present or not body.carries:
        if track.velocity is not None:
            state = state._replace(velocity=state.velocity + track.velocity)
        return state, None
    # the closest points of the last frame's prediction: the correction moved the garment along the body by millimetres
    contacts = track.contacts or nearest(posed(body, track), state.position)
    motion = proximity.surface_motion(
        body.tree, track.vertices, pose.vertices, state.position, contacts.closest, body.reach
    )
    carried, velocity = motion.position - state.position, state.velocity
    if track.velocity is None and velocity.any():  # of the world until now; one of zero is not known
        velocity = velocity - carried / max(dt, SHORTEST)
    return state._replace(velocity=np.exp(-friction * dt * motion.weight)[:, None] * velocity), carried


def bind(body: BodyModel, pose: np.ndarray, position: np.ndarray, reach: float) -> Bound:
    """A garment at (V, 3) ``position`` bound to the body in a (B, 3) ``pose`` within a ``reach``, metres."""
    surface = proximity.refresh(body.tree, pose)
    return Bound(pose.copy(), position.copy(), proximity.closest_points(body.tree, surface, position, reach))


def follow(bound: Bound, pose: BodyPose, reach: float) -> np.ndarray:
    """(V, 3) metres: where the body has brought a garment that has gone with it ever since it was bound."""
    return proximity.surface_motion(
        pose.model.tree, bound.pose, pose.vertices, bound.position, bound.contact, 2.0 * reach, reach
    ).position


def nearest(pose: BodyPose, position: np.ndarray) -> Contacts:
    """Closest points on the body for (V, 3) ``position``, metres."""
    found = proximity.closest_points(pose.model.tree, pose.surface, position, pose.model.reach, pose.hint)
    return Contacts(found, position.copy())


def nearest_from_last(problem: Problem, position: np.ndarray) -> Contacts:
    """Closest points of all vertices at (V, 3) ``position``, metres, where the surface around the former ones has them.

    In each frame one vertex in ``faces_followed`` is searched in the whole body, another one each time. All are while the garment
    is not tracked, and before they had closest points.
    """
    pose, health, every = problem.body, problem.health, problem.config.physics.faces_followed
    if pose.hint is None or health.unplaced or health.settling:
        return nearest(pose, position)
    due = slice(pose.turn % every, None, every)
    found = proximity.followed_points(pose.model.tree, pose.surface, position, pose.model.reach, pose.hint, due)
    return Contacts(found, position.copy())


def closest(pose: BodyPose, position: np.ndarray, contacts: Contacts, thickness: float) -> Contacts:
    """Former ``contacts`` with the closest points of the vertices that may be closer than ``thickness`` metres.

    The others keep their closest points: a signed distance changes by no more than the vertex has moved since its search.
    """
    n = len(position)
    near, points, face = np.empty(n, np.uint32), np.empty((n, 3)), np.empty(n, np.int32)
    count = kernels.near_body(position, contacts.asked_at, contacts.closest, thickness, near, points, face)
    if count == 0:
        return contacts
    near, points, face = near[:count], points[:count], face[:count]
    found = proximity.closest_points(pose.model.tree, pose.surface, points, pose.model.reach, face)
    updated = Contacts(proximity.Contact(*(array.copy() for array in contacts.closest)), contacts.asked_at.copy())
    kernels.replace_contacts(near, points, found, *updated)
    return updated


def planes(pose: BodyPose, contacts: Contacts, config: Physics) -> tuple[np.ndarray, np.ndarray]:
    """Point and outward normal, (V, 3) each, of the plane that each vertex is kept outside of.

    A vertex with no body within reach has a plane that it is outside of wherever it is: both are 0.
    """
    found = contacts.closest
    gap = np.full(len(found.face), config.thickness) if pose.gap is None else pose.gap
    return found.point + gap[:, None] * found.normal, found.normal


def error2(pose: BodyPose, first_sd: float = 0.0) -> float:
    """m^2, variance of the place of the body's surface along its normal, of which ``first_sd`` in metres is the first guess."""
    squares, share = pose.intruded
    return (squares + FEW * first_sd**2) / (share + FEW)


def variances(problem: Problem) -> np.ndarray:
    """(V,) m^2, of the body's surface along its normal beside each vertex. What nobody saw in the last frame has no first guess.

    There the body is all that keeps cloth in its place. What is seen is kept there by its measurement.
    """
    pose, anchor = problem.body, problem.last.anchor
    learned, guessed = error2(pose), error2(pose, problem.config.physics.body_sd)
    if anchor is None or problem.last.time is None:
        return np.full(len(problem.prior.position), guessed)
    return np.where(anchor.measured, guessed, learned)


def within(pose: BodyPose, points: np.ndarray, radius: float) -> np.ndarray:
    """(N,) bool: (N, 3) points that lie within ``radius`` metres of the body's surface, on either side."""
    return proximity.closest_points(pose.model.tree, pose.surface, points, radius).face >= 0


def learn(problem: Problem, estimate: Estimate, position: np.ndarray) -> BodyTrack | None:
    """The body after a frame: where a sensor sees them, vertices may be as close as they turn out to be.

    A body is a model that was fitted to something, and wrong by millimetres or centimetres. What lasts, each vertex's gap takes
    up. What changes from frame to frame shows as cloth that is seen inside, and contact yields by as much.

    Args:
        problem: the frame.
        estimate: the last one, with its measurement, and its contacts if they were searched.
        position: (V, 3) the posterior, metres.
    """
    track, pose, config = problem.last.body, problem.body, problem.config.physics
    if track is None:
        return None
    vertices = track.vertices if pose is None else pose.vertices
    gap, intruded, observed = track.gap, track.intruded, estimate.learnable
    if gap is not None and estimate.contacts is not None and observed.any():
        found, old, measurement = estimate.contacts.closest, np.exp(-problem.dt / config.gap_time), estimate.terms.measurement
        across = found.normal if measurement.normal is None else measurement.normal
        inside = kernels.intruded(position, observed, measurement.target, across, found, gap)
        pairs = zip(intruded, inside, strict=True)
        intruded = tuple(old * before + (1.0 - old) * now / len(position) for before, now in pairs)
        distance = np.einsum("va,va->v", found.normal, position - found.point)
        change = np.clip(distance, -config.deepest_gap, config.thickness) - gap
        gap = np.where(observed & (found.face >= 0), gap + (1.0 - old) * change, gap)
    motion, unposed = _motion(problem)
    velocity = None if problem.carried is None else _mean_velocity(track.velocity, problem.carried, track.span, problem.dt)
    present, turn, span = pose is not None, track.turn + 1, _remembered(problem.dt) * track.span + problem.dt
    if velocity is not None and problem.last.time is None and np.square(velocity).sum(axis=1).mean() > FASTEST**2:
        velocity, motion, span = np.zeros_like(velocity), None, 0.0
    return BodyTrack(vertices, present, velocity, estimate.contacts, gap, turn, motion, unposed, span, intruded)


def _motion(problem: Problem) -> tuple[np.ndarray | None, float]:
    """(B, 3) m/s from the body's last pose but one to the last, and the seconds since that."""
    track, given, dt = problem.last.body, problem.frame.body_vertices, problem.dt
    if problem.body is None or not problem.body.model.carries:
        return None, 0.0
    if given is None:
        return track.motion, track.unposed + dt
    if not track.present:
        return None, 0.0
    last = track.vertices if track.unposed == 0.0 else track.vertices - _travelled(track.unposed) * track.motion
    return _mean_velocity(track.motion, given - last, track.span, track.unposed + dt).astype(np.float32), 0.0


def _mean_velocity(before: np.ndarray | None, moved: np.ndarray, span: float, dt: float) -> np.ndarray:
    """(N, 3) m/s, the mean of one ``before`` over ``span`` seconds, None: at rest, and of what ``moved`` (N, 3) metres in dt."""
    old = _remembered(dt) * (SHORTEST if before is None else span)
    return moved / (old + dt) if before is None or old == 0.0 else (old * before + moved) / (old + dt)


def _remembered(dt: float) -> float:
    """Share of the last velocity that a new one is the mean with: none of one over ``SHORTEST`` seconds."""
    return max(1.0 - dt / SHORTEST, 0.0)
