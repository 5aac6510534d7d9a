"""The MAP problem of one frame written out: residuals from the equations, derivatives by differences, dense matrices."""

from typing import NamedTuple

import numpy as np

from ddakf import Config, Mesh
from ddakf.garment.model import Model
from ddakf.types import Measurement, State

STEP = 1e-6  # m, of the central differences


class Problem(NamedTuple):
    """What one pass of the fusion update is given."""

    mesh: Mesh
    model: Model
    config: Config
    prior: State
    measurement: Measurement
    weight: np.ndarray  # (V,)
    R: np.ndarray  # (V, 3, 3)
    touching: tuple[np.ndarray, np.ndarray] | None = None  # closest points and normals of the body (V, 3) each
    physics_lambda: float = 1.0


def triangles(x: np.ndarray, mesh: Mesh):
    """Images of the orthonormal rest directions u (the first edge) and v of each face, and the rest areas."""
    i, j, k = mesh.faces.T
    e1, e2 = mesh.vertices[j] - mesh.vertices[i], mesh.vertices[k] - mesh.vertices[i]
    normal = np.cross(e1, e2)
    u = e1 / np.linalg.norm(e1, axis=1, keepdims=True)
    v = np.cross(normal / np.linalg.norm(normal, axis=1, keepdims=True), u)
    rest = np.einsum("fra,fca->frc", np.stack([u, v], axis=1), np.stack([e1, e2], axis=1))
    F = np.stack([x[j] - x[i], x[k] - x[i]], axis=2) @ np.linalg.inv(rest)
    return F[:, :, 0], F[:, :, 1], 0.5 * np.linalg.norm(normal, axis=1)


def hinges(mesh: Mesh) -> np.ndarray:
    """(H, 4) i, j, k, l: an edge i -> j of a face with corner k, and the corner l across it."""
    across = {}
    for face in mesh.faces.tolist():
        for a in range(3):
            across[face[a], face[(a + 1) % 3]] = face[(a + 2) % 3]
    return np.array([(i, j, k, across[j, i]) for (i, j), k in across.items() if i < j and (j, i) in across])


def dihedrals(x: np.ndarray, hinge: np.ndarray) -> np.ndarray:
    """(H,) signed angles between the normals of the two faces, rad."""
    i, j, k, m = hinge.T
    edge = x[j] - x[i]
    n1, n2 = np.cross(edge, x[k] - x[i]), np.cross(x[m] - x[i], edge)
    sine = np.einsum("ha,ha->h", np.cross(n1, n2), edge) / np.linalg.norm(edge, axis=1)
    return np.arctan2(sine, np.einsum("ha,ha->h", n1, n2))


def strains(x: np.ndarray, mesh: Mesh) -> np.ndarray:
    """(2F,) relative lengthening along u, then along v."""
    w_u, w_v, _ = triangles(x, mesh)
    return np.concatenate([np.linalg.norm(w_u, axis=1), np.linalg.norm(w_v, axis=1)]) - 1


def in_plane(numbers) -> float:
    """Stiffness of stretch and of shear alike, as no direction of the threads is known."""
    return (numbers.stretch * numbers.fabric.stretch + numbers.shear * numbers.fabric.shear) / 2


def cloth(x: np.ndarray, held: np.ndarray, problem: Problem) -> dict[str, np.ndarray]:
    """Residuals of the energies of section 2.4, each times the root of its stiffness and weight.

    Stretch is softened: weight 1 / (1 + q) of the energy s^2 / 2 log(1 + q), q = (r / s)^2, taken at ``held`` (V, 3).
    """
    mesh, numbers = problem.mesh, problem.config.physics
    both, bend = (problem.physics_lambda * stiffness for stiffness in (in_plane(numbers), numbers.bend * numbers.fabric.bend))
    w_u, w_v, area = triangles(x, mesh)
    soft = 1 / (1 + (strains(held, mesh) / numbers.strain_scale) ** 2)
    hinge = hinges(mesh)
    i, j, a, b = (mesh.vertices[column] for column in hinge.T)
    double_areas = np.linalg.norm(np.cross(j - i, a - i), axis=1) + np.linalg.norm(np.cross(j - i, b - i), axis=1)
    shape = 3 * np.sum((j - i) ** 2, axis=1) / (0.5 * double_areas)
    parts = {
        "stretch": np.sqrt(both * np.tile(area, 2) * soft) * strains(x, mesh),
        "shear": np.sqrt(both * area / 2) * np.einsum("fa,fa->f", w_u, w_v),
        "bend": np.sqrt(bend * shape) * (dihedrals(x, hinge) - dihedrals(mesh.vertices, hinge)),
    }
    if problem.touching is not None:
        share = np.zeros(len(x))
        np.add.at(share, mesh.faces.ravel(), np.repeat(area / 3, 3))
        point, normal = problem.touching
        depth = np.minimum(np.einsum("va,va->v", normal, x - point) - numbers.thickness, 0.0)
        firm = numbers.collision * share
        parts["collision"] = np.sqrt(firm / (1.0 + firm * numbers.body_sd**2)) * depth
    return parts


def transforms(term) -> np.ndarray:
    """(V, 3, 3) T_i of a locally rigid term as last fitted: its rotations, or stretched with the rings."""
    if len(term.follow) == 0 or not term.weight.all():
        return term.rotation
    return term.shared.reshape(-1, 3, 4)[:, :, :3].transpose(0, 2, 1).astype(float) * 2 / term.weight[:, None, None]


def residuals(x: np.ndarray, held: np.ndarray, problem: Problem, rigid) -> dict[str, np.ndarray]:
    """All terms of the MAP problem, linearised at ``held``; without softening the energy is half their sum of squares.

    Args:
        x, held: (V, 3) estimates, metres.
        problem: the frame.
        rigid: (source positions, weights (V,), transforms T) of each locally rigid term, as :func:`transforms` reads them.
    """
    config, mesh = problem.config, problem.mesh
    covariance = problem.prior.P_pp + config.fuse.prior_sd**2 * np.eye(3)
    root = np.linalg.cholesky(np.linalg.inv(covariance)).transpose(0, 2, 1)
    parts = cloth(x, held, problem)
    parts["prior"] = np.einsum("vab,vb->va", root, x - problem.prior.position).ravel()
    n, off = problem.measurement.normal, x - problem.measurement.target
    along = np.einsum("va,va->v", n, off)
    variance = np.maximum(np.einsum("va,vab,vb->v", n, problem.R, n), config.adapt.lowest_sd**2)
    parts["along"] = np.sqrt(problem.weight / variance) * along
    across = np.sqrt(problem.weight) / config.associate.tangential_sd
    parts["across"] = (across[:, None] * (off - along[:, None] * n)).ravel()
    for number, (source, weight, rotation) in enumerate(rigid):
        i, j = mesh.edges.T
        for of, ring in (("first", i), ("second", j)):  # each edge is of the rings of both ends
            goal = np.einsum("eab,eb->ea", rotation[ring], source[j] - source[i])
            parts[f"rigid {number} {of}"] = (np.sqrt(0.5 * weight[ring])[:, None] * (x[j] - x[i] - goal)).ravel()
    return parts


def linearised(function, x: np.ndarray):
    """Residuals function(x, x) by name, and their Jacobians (C, 3V) by central differences in the first argument."""
    here = function(x, x)
    jacobian = {name: np.zeros((len(part), x.size)) for name, part in here.items()}
    for column in range(x.size):
        ahead, behind = x.copy().ravel(), x.copy().ravel()
        ahead[column] += STEP
        behind[column] -= STEP
        ahead, behind = function(ahead.reshape(x.shape), x), function(behind.reshape(x.shape), x)
        for name in here:
            jacobian[name][:, column] = (ahead[name] - behind[name]) / (2 * STEP)
    return here, jacobian


def energy(x: np.ndarray, problem: Problem, rigid) -> float:
    """Of the MAP problem, the softened stretch by its own formula."""
    parts = residuals(x, x, problem, rigid)
    numbers = problem.config.physics
    stiffness = problem.physics_lambda * in_plane(numbers)
    q = (strains(x, problem.mesh) / numbers.strain_scale) ** 2
    area = np.tile(triangles(x, problem.mesh)[2], 2)
    stretch = 0.5 * stiffness * numbers.strain_scale**2 * (area @ np.log1p(q))
    return stretch + 0.5 * sum(float(part @ part) for name, part in parts.items() if name != "stretch")


def gradient(here, jacobian) -> np.ndarray:
    """(3V,) of half the sum of squares."""
    return sum(jacobian[name].T @ part for name, part in here.items())


def gauss_newton(jacobian, majorised: bool = True) -> np.ndarray:
    """(3V, 3V) J' J; bending by its bound 4 blockdiag(J_s' J_s) over the four vertices of a hinge, as the solver has it."""
    total = np.zeros((next(iter(jacobian.values())).shape[1],) * 2)
    for name, J in jacobian.items():
        block = J.T @ J
        if name == "bend" and majorised:
            vertex = np.arange(len(block)) // 3
            block = 4 * np.where(vertex[:, None] == vertex, block, 0.0)
        total += block
    return total


def blockdiag(numbers: np.ndarray) -> np.ndarray:
    """(3V, 3V) from the xx yy zz xy xz yz of each vertex."""
    n = len(numbers)
    total = np.zeros((n, 3, n, 3))
    for k, (a, b) in enumerate([(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]):
        total[np.arange(n), a, np.arange(n), b] = total[np.arange(n), b, np.arange(n), a] = numbers[:, k]
    return total.reshape(3 * n, 3 * n)
