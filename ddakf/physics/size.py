"""Stage E, size: how large the worn garment is against its template (not in the paper).

A template may be of another size than what is worn: cut for somebody else, captured at another scale, of another fabric. Cloud
and forces then agree in the middle, and all seen cloth is strained alike. So the template is stretched by a symmetric matrix
until hardly any such strain is left; what may be left is that of cloth in its own weight. Motion strains cloth too, a jump by
6 % along the vertical, but in the mean of all directions little. So that mean tells whether the garment is of another size.
"""

from __future__ import annotations

import math

import numpy as np

from ddakf.config import Physics
from ddakf.kernels import size as kernels
from ddakf.types import Estimate, Model, Problem

LONGEST_LESSON = 0.04  # s that a frame counts for, at most
STRIDE = 3  # of the vertices whose edges are looked at in a frame
ALIKE = 0.01  # weight of the edges with which the matrix is a multiple of the identity: no edge shows it across a sheet
FEWEST_HEMS = 6  # vertices
SIZE_SD = 0.03  # of the strain that hems tell, before they are seen
HEM_FLIGHT = 0.05  # s: hems that move against each other, as when a skirt flies, are as far off as they move in that time
BELIEVED = 0.1  # root mean square strain of what is left, from which a start is believed by half


def at_start(position: np.ndarray, model: Model, config: Physics) -> np.ndarray:
    """(3, 3) logarithm of the stretch of a garment that starts at (V, 3) ``position``, metres.

    It is the template's up to a mean strain of ``size_start``. Noise of a start strains the edges unevenly, and makes them
    longer. So the more their strains differ, the less it counts.
    """
    if config.size_memory == 0:
        return np.zeros((3, 3))
    strain, _ = common_strain(position, np.ones(len(position), bool), model, model.rest_length, stride=1)
    if abs(np.trace(strain)) / 3.0 < config.size_start:
        return np.zeros((3, 3))
    row = np.repeat(np.arange(len(position)), np.diff(model.start))
    length = np.linalg.norm(position[model.neighbour] - position[row], axis=1)
    direction = model.rest_edge / np.maximum(model.rest_length, 1e-12)[:, None]
    left = length / np.maximum(model.rest_length, 1e-12) - 1.0 - np.einsum("ea,ab,eb->e", direction, strain, direction)
    return _bounded(_beyond(strain, config.size_slack) / (1.0 + float(np.square(left).mean()) / BELIEVED**2), config)


def learn(problem: Problem, estimate: Estimate, position: np.ndarray, reliability: float) -> np.ndarray:
    """(3, 3) logarithm of the stretch after a frame: it follows the strain that the measured edges have in common.

    Cloth that is too large folds instead of being strained, and its hems reach beyond the cloud: their strain is added.

    Where less than ``strain_coverage`` of the edges is measured, as from one side, only the mean of all directions is learned,
    and on a body alone: without one a right template shrinks too. Nothing is learned while the garment's place is not
    known, or less than ``size_coverage`` is measured. A frame counts for at most ``LONGEST_LESSON``.

    Args:
        problem: the frame.
        estimate: whose vertices that learn and hems count.
        position: (V, 3) the posterior, metres.
        reliability: of the frame, by which it counts.
    """
    size, config, model = problem.last.size, problem.config.physics, problem.model
    if config.size_memory == 0 or problem.last.health.unplaced:
        return size
    strain, share = common_strain(position, estimate.learnable, model, rest_length(problem))
    one_side = share < config.strain_coverage
    if share < config.size_coverage or (one_side and problem.body is None):
        return size
    new = reliability * (1.0 - math.exp(-min(problem.dt, LONGEST_LESSON) / config.size_memory))
    mean = np.trace(strain) / 3.0
    across = strain - mean * np.eye(3)
    mean += hem_strain(problem, estimate)
    if not size.any() and abs(mean) < config.size_doubt * config.size_slack:
        return size
    grown = _beyond(mean * np.eye(3), config.size_slack)
    if not one_side:
        grown += _beyond(across, config.size_slack_across)
    return _bounded(size + new * grown, config)


def hem_strain(problem: Problem, estimate: Estimate) -> float:
    """Strain of the whole template with which its hems would meet the ends of the cloud, up to a translation; at most 0.

    Noise lets a cloud end farther out, so that hems tell only of a garment that is too large. What they have not in common,
    and strain at which they move now, as in a jump, makes it count less.
    """
    hem, model = estimate.terms.measurement.hem, problem.model
    if hem is None:
        return 0.0
    matrix, vector = np.diag([1e-12, ALIKE, ALIKE, ALIKE]), np.zeros(4)
    at = model.boundary[:, 0], model.mesh.vertices, problem.rotation
    n, square = kernels.accumulate_hems(*at, *hem[:3], matrix, vector)
    if n < FEWEST_HEMS:
        return 0.0
    inverse = np.linalg.inv(matrix)
    strain, left = inverse[0] @ vector, square - vector @ inverse @ vector
    moved = estimate.position[at[0]] - problem.last.state.position[at[0]]
    speed, along = np.einsum("ha,ha->h", hem.direction, moved) / problem.dt, np.zeros(4)
    kernels.accumulate_hems(*at, hem.direction, speed, hem.weight, np.zeros((4, 4)), along)
    flown = HEM_FLIGHT * inverse[0] @ along
    told = hem.belief * SIZE_SD**2 / (SIZE_SD**2 + left * inverse[0, 0] + flown**2)
    return min(float(strain * told), 0.0)


def rest_length(problem: Problem) -> np.ndarray:
    """(2E,) float32 metres, of the edges at rest."""
    return problem.model.rest_length if problem.resting is None else problem.resting.length


def stretched(points: np.ndarray, size: np.ndarray) -> np.ndarray:
    """(N, 3) points or edges of the template, metres, at a size (3, 3)."""
    values, vectors = np.linalg.eigh(size)
    return points @ ((vectors * np.exp(values)) @ vectors.T).astype(points.dtype)


def common_strain(
    position: np.ndarray, measured: np.ndarray, model: Model, length: np.ndarray, stride: int = STRIDE
) -> tuple[np.ndarray, float]:
    """(3, 3) strain that measured edges have in common, against their ``length`` at rest, and the measured share of all."""
    matrix, vector = np.zeros((6, 6)), np.zeros(6)
    rings = model.start, model.neighbour
    n, looked = kernels.accumulate(position, measured, rings, stride, model.rest_edge, length, matrix, vector)
    if n == 0:
        return np.zeros((3, 3)), 0.0
    matrix += np.tril(matrix, -1).T
    matrix[:3, :3] += ALIKE * n * (np.eye(3) - 1.0 / 3.0)
    matrix[3:, 3:] += 2.0 * ALIKE * n * np.eye(3)
    xx, yy, zz, xy, xz, yz = np.linalg.solve(matrix + 1e-9 * n * np.eye(6), vector)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]), n / looked


def _beyond(strain: np.ndarray, slack: float) -> np.ndarray:
    """The strain, its principal values nearer to 0 by the slack."""
    values, vectors = np.linalg.eigh(strain)
    return (vectors * np.copysign(np.maximum(np.abs(values) - slack, 0.0), values)) @ vectors.T


def _bounded(size: np.ndarray, config: Physics) -> np.ndarray:
    values, vectors = np.linalg.eigh(size)
    most = math.log1p(config.size_most)
    bounded = (vectors * np.clip(values, -most, most)) @ vectors.T
    return 0.5 * (bounded + bounded.T)
