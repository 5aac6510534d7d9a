"""Small garments, states and clouds for the tests of the stages and of the tracker."""

import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest

from ddakf import Config, Mesh
from ddakf.body import contact
from ddakf.config import InnovationNoise, NearestPoint, Physics
from ddakf.errors import MissingDependency
from ddakf.evaluation.sensors import sample_surface
from ddakf.files.open3d_bridge import import_open3d
from ddakf.stages import preprocess
from ddakf.stages.associate import associate
from ddakf.types import BodyPose, Estimate, FrameInput, Health, Measurement, Problem, State, UpdateTerms

FPS = 30.0


def tube(radius=0.15, around=24, along=14, spacing=0.03) -> Mesh:
    """An open tube about the vertical, wider below and not round, so that every heading looks different."""
    angle = np.arange(around) * 2 * np.pi / around
    rings = []
    for k in range(along):
        r = radius * (1.0 + 0.25 * np.cos(angle) + 0.12 * np.sin(2 * angle)) * (1.2 - 0.02 * k)
        rings.append(np.stack([r * np.cos(angle), np.full(around, spacing * k), r * np.sin(angle)], axis=1))
    faces = []
    for k in range(along - 1):
        for a in range(around):
            i, j = k * around + a, k * around + (a + 1) % around
            faces += [[i, i + around, j], [j, i + around, j + around]]
    return Mesh(np.concatenate(rings), np.array(faces))


def inner_body(mesh: Mesh, share=0.85) -> Mesh:
    """The tube shrunk about its axis: something to wear it."""
    return Mesh(mesh.vertices * [share, 1.0, share], mesh.faces)


def scan(vertices, mesh: Mesh, count=4000, noise=0.002, seed=0) -> np.ndarray:
    """(count, 3) float32 noisy points of the surface, metres."""
    rng = np.random.default_rng(seed)
    points = sample_surface(np.asarray(vertices), mesh.faces, count, rng)
    return (points + noise * rng.normal(size=points.shape)).astype(np.float32)


def turn(degrees: float) -> np.ndarray:
    """(3, 3) rotation about the vertical."""
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def about(axis, angle: float) -> np.ndarray:
    """(3, 3) rotation by ``angle`` radians about ``axis``: Rodrigues' formula."""
    x, y, z = np.asarray(axis, float) / np.linalg.norm(axis)
    K = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


def rms(difference) -> float:
    """Root mean square length of the rows of (V, 3)."""
    return float(np.sqrt((np.asarray(difference) ** 2).sum(axis=1).mean()))


def blocks(n: int, size: int, rng, low=0.1, high=3.0) -> np.ndarray:
    """(n, size, size) random symmetric positive definite matrices with eigenvalues in [low, high]."""
    q = np.linalg.qr(rng.normal(size=(n, size, size)))[0]
    return np.einsum("vab,vb,vcb->vac", q, rng.uniform(low, high, (n, size)), q)


def random_state(position, rng, sd=0.01, speed_sd=0.3) -> State:
    """A state with full, correlated 6x6 covariances."""
    n = len(position)
    scale = np.repeat([sd, speed_sd], 3)
    P = blocks(n, 6, rng) * scale[:, None] * scale
    R = blocks(n, 3, rng) * 0.004**2
    velocity, still = rng.normal(scale=0.2, size=(n, 3)), np.zeros((n, 3))
    return State(np.array(position), velocity, P[:, :3, :3], P[:, :3, 3:], P[:, 3:, 3:], R, still)


def full(state: State) -> np.ndarray:
    """(V, 6, 6) covariances from their blocks."""
    upper = np.concatenate([state.P_pp, state.P_pu], axis=2)
    lower = np.concatenate([state.P_pu.transpose(0, 2, 1), state.P_uu], axis=2)
    return np.concatenate([upper, lower], axis=1)


def assert_positive_definite(P: np.ndarray) -> None:
    """Symmetric, and every eigenvalue positive after the units have been taken out."""
    np.testing.assert_allclose(P, P.transpose(0, 2, 1), atol=1e-9 * np.abs(P).max())
    sd = np.sqrt(np.diagonal(P, axis1=1, axis2=2))
    assert (sd > 0).all()
    correlation = P / (sd[:, :, None] * sd[:, None, :])
    assert np.linalg.eigvalsh(correlation).min() > 1e-9


def measured(target, normal, found) -> Measurement:
    """Measurements as stage B would hand them on, all vertices visible."""
    n = len(target)
    nothing = Measurement.none(n)
    return nothing._replace(
        target=np.asarray(target, float), normal=normal, distance=np.where(found, 0.0, -1.0), visible=np.ones(n, bool)
    )


def frame_of(points=None, sensor=None, body_vertices=None) -> FrameInput:
    """A frame at time 0, by default without points."""
    return FrameInput(np.empty((0, 3), np.float32) if points is None else points, 0.0, sensor, body_vertices)


def cloud_of(points, sensor, position, area, config):
    """Preprocessing of points without skin."""
    return preprocess.cloud(frame_of(points, sensor), position, area, config)


def problem_of(model=None, prior: State | None = None, config: Config | None = None, **more) -> Problem:
    """A frame whose last posterior, where nothing else is said, is the prior, at rest, with unturned one-rings."""
    n = 0 if prior is None else len(prior.position)
    position = None if prior is None else prior.position
    unturned = np.tile(np.eye(3), (n, 1, 1))
    base = Problem(
        model, config or Config(), None, frame_of(), 1 / FPS, prior, None, None, prior, position, unturned, Health()
    )
    return base._replace(**more)


def estimate_at(position, terms: UpdateTerms | None = None) -> Estimate:
    """An estimate that no pass has refined."""
    none = UpdateTerms(Measurement.none(len(position)), np.zeros(len(position)), None, None)
    return Estimate(position, None, None, None, terms or none)


def posed(body: Mesh, vertices=None, reach=0.1) -> BodyPose:
    """A body in the pose of one frame, by default that of the start."""
    constants = contact.build(body, reach)
    start = contact.start(constants, body.vertices, Physics(gap_time=0.0))
    return contact.posed(constants, start, vertices)


def associated(position, cloud, garment, gate, config, last=None, body_vertices=None) -> Measurement:
    """Stage B in the first pass of a frame, or after the pass that gave ``last``."""
    points = isinstance(config, NearestPoint)
    whole = dataclasses.replace(Config(), associate=config, adapt=InnovationNoise() if points else Config().adapt)
    body = None if body_vertices is None else SimpleNamespace(vertices=body_vertices)
    problem = problem_of(garment, None, whole, cloud=cloud, body=body)
    estimate = estimate_at(position)
    if last is not None:
        estimate = estimate._replace(terms=estimate.terms._replace(measurement=last))
    return associate(problem, estimate, gate)


def kept_points(cloud) -> np.ndarray:
    """(M, 3) points of a preprocessed cloud, metres, in the world."""
    return cloud.points.T + cloud.origin


def planes_of(cloud) -> tuple[np.ndarray, np.ndarray]:
    """(S, 3) points of a preprocessed cloud's planes in the world, metres, and their normals, zero where there is none."""
    return cloud.surfels[:3].T + cloud.origin, cloud.surfels[3:].T.astype(float)


def open3d():
    """The package, or a skip with the sentence that says what is missing."""
    try:
        return import_open3d()
    except MissingDependency as missing:
        pytest.skip(str(missing))
