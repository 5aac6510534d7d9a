"""Rigidity: spatially correlated process noise, in which edges follow the rotation of their one-ring.

Two terms of the form 1/4 sum_i w_i sum_j |x_j - x_i - R_i s_ij|^2 (as-rigid-as-possible, Sorkine and Alexa 2007): between frames,
with s the edges of the last posterior, and to the rest shape, with s the edges of the template or of the start.

In a mesh with edges h a bend of curvature c costs each vertex c^2 h^4 w, a strain e costs it e^2 h^2 w: a fine mesh folds easily.
Where cloth is seen, measurements say which folds are there. Hidden cloth has none, see :func:`stiffen_hidden`.
"""

from __future__ import annotations

import numpy as np

from ddakf.body import gravity
from ddakf.config import Physics
from ddakf.kernels import rigidity as kernels
from ddakf.kernels.rigidity import LocalRigidity
from ddakf.kernels.strain import StrainConstants
from ddakf.physics import size as sizes
from ddakf.physics import strain
from ddakf.types import Model, Resting, Setup

NOTICED = 0.01  # strain from which on a garment of another size is at rest in another shape


def resting(position: np.ndarray, setup: Setup, size: np.ndarray | None = None, given: bool = True) -> Resting:
    """The rest shape with which :func:`to_rest` exerts no force at (V, 3) ``position``, metres, where that is a shape of cloth,
    and stretch and shear little.

    There s = x_j - x_i. Cloth folds and hardly stretches: a ring strained by ``start_strain`` has half of its shape from the
    template, and one that noise has strained farther nearly all. That strain is against the template at the size of the position;
    at another ``size`` (3, 3) cloth at rest differs as much from a template of that size.
    """
    model, strain_sd, kept = setup.model, setup.config.physics.start_strain, setup.config.physics.start_strain_kept
    first = sizes.at_start(position, model, setup.config.physics) if given else size
    size = first if size is None else size
    rest_edge, constants = _of_size(model, first)
    row, degree = np.repeat(np.arange(len(position)), np.diff(model.start)), np.maximum(np.diff(model.start), 1)
    edge, rotation = edges(position, model), rotations(position, model)
    length, rest_length = (np.linalg.norm(each, axis=1) for each in (edge, rest_edge))
    strain2 = np.bincount(row, np.square(length / np.maximum(rest_length, 1e-12) - 1.0), len(position)) / degree
    share = 1.0 / (1.0 + 0.5 * (strain2[row] + strain2[model.neighbour]) / strain_sd**2)
    along = 0.5 * (rotation[row] + rotation[model.neighbour])
    turned = (along @ rest_edge[:, :, None])[:, :, 0]
    shape = turned + share[:, None] * (edge - turned)
    metric = strain.metric_at_start(constants, position, kept, strain_sd)
    strained = strain.with_metric(constants, metric)
    upward = gravity.at_start(position, strained, setup)
    if not np.array_equal(size, first):
        now, constants = _of_size(model, size)
        shape += (along @ (now - rest_edge)[:, :, None])[:, :, 0]
        strained, rest_length = strain.with_metric(constants, metric), np.linalg.norm(now, axis=1)
    return Resting(position, shape.astype(np.float32), rotation, strained, upward, size, rest_length.astype(np.float32), given)


def _of_size(model: Model, size: np.ndarray) -> tuple[np.ndarray, StrainConstants]:
    """Edges of the one-rings (2E, 3), metres, and constants of the faces of the template at a size (3, 3)."""
    if not size.any():
        return model.rest_edge, model.strain
    return sizes.stretched(model.rest_edge, size), strain.of_shape(model.strain, sizes.stretched(model.mesh.vertices, size))


def resize(shape: Resting | None, size: np.ndarray, setup: Setup) -> Resting | None:
    """The rest shape at a size (3, 3) that differs noticeably from its own; None: the template."""
    if np.abs(size - (0.0 if shape is None else shape.size)).max() < NOTICED:
        return shape
    if shape is not None and shape.given:
        return resting(shape.position, setup, size)._replace(source=shape.source)
    return of_template(size, setup)


def of_template(size: np.ndarray, setup: Setup) -> Resting:
    """The template at a size (3, 3) as the shape at rest."""
    return resting(sizes.stretched(setup.model.mesh.vertices, size), setup, size, given=False)


def to_rest(model: Model, weight: float, rotation: np.ndarray, share: float = 0.0, shape: Resting | None = None) -> LocalRigidity:
    """The term that holds the shape of the template, or another one at rest; its rotations start from ``rotation``, unchanged.

    ``rotation`` (V, 3, 3) is against the template. The term's own are against the shape at rest, see :func:`against_template`.

    ``share`` in [0, 1) is the part of its own strain that a one-ring follows. Where T_i = R_i the term resists strain. Where T_i
    is the ring's affine fit, it only resists differences between rings: bending, folds, and uneven strain.
    """
    n, edge = len(rotation), model.rest_edge if shape is None else shape.edge
    follow = np.empty((n if share > 0 else 0, 8), np.float32)
    if share > 0:
        kernels.followers(model.start, edge, share, follow)
    own = rotation.copy()
    if shape is not None:
        kernels.products_with_transposed(rotation, shape.rotation, own)
    return LocalRigidity(edge, np.full(n, float(weight)), own, np.empty((n, 12), np.float32), follow)


def against_template(term: LocalRigidity, shape: Resting | None) -> np.ndarray:
    """(V, 3, 3) rotations of :func:`to_rest` 's term against the template."""
    if shape is None:
        return term.rotation
    kernels.products(term.rotation, shape.rotation, rotation := np.empty_like(term.rotation))
    return rotation


def since(position: np.ndarray, model: Model, weight: float) -> LocalRigidity:
    """The term that makes the change since ``position`` (V, 3) locally rigid."""
    n = len(position)
    shared, follow = np.empty((n, 12), np.float32), np.empty((0, 8), np.float32)
    return LocalRigidity(edges(position, model), np.full(n, float(weight)), identity(n), shared, follow)


def stiffen_hidden(
    terms: tuple[LocalRigidity, LocalRigidity],
    seen: tuple[float, float],
    unseen: tuple[float, float],
    hidden: np.ndarray,
    finer: float,
) -> None:
    """Weighs the rings of seen and of hidden vertices, in place. Hidden cloth bends and strains as that of a coarser mesh.

    Args:
        terms: to the rest shape, which resists bends, and between frames, which resists strain.
        seen, unseen: weights of each at seen vertices, and at hidden ones of the coarser mesh, 1/m^2.
        hidden: (V,) bool.
        finer: edges of the coarser mesh over those of this one, at least 1.
    """
    for term, weight, other, power in zip(terms, seen, unseen, (4, 2), strict=True):
        np.copyto(term.weight, np.where(hidden, other * finer**power, weight))


def edges(position: np.ndarray, model: Model) -> np.ndarray:
    """(2E, 3) float32 x_j - x_i of each entry of the one-rings, metres."""
    edge = np.empty((len(model.neighbour), 3), np.float32)
    kernels.edge_vectors(position, model.start, model.neighbour, edge)
    return edge


def turn(term: LocalRigidity, position: np.ndarray, model: Model, steps: int = Physics.rotation_steps) -> None:
    """Fits the rotations to (V, 3) ``position``, in place, in a number of steps."""
    fit(term, padded(position), model, steps)


def fit(term: LocalRigidity, position: np.ndarray, model: Model, steps: int = Physics.rotation_steps) -> None:
    """Fits the rotations to (V, 4) :func:`padded` positions, in place."""
    kernels.fit_rotations(position, model.start, model.neighbour, term, steps)


def add_force(terms: tuple[LocalRigidity, ...], position: np.ndarray, model: Model, force: np.ndarray) -> None:
    """Adds to (V, 4) ``force`` minus the gradient of the terms at (V, 4) ``position``, their rotations fitted to it and held."""
    for term in terms:
        kernels.add_force(position, model.start, model.neighbour, term, force)


def padded(position: np.ndarray) -> np.ndarray:
    """(V, 4): a zero behind each row of (V, 3)."""
    rows = np.zeros((len(position), 4))
    rows[:, :3] = position
    return rows


def rotations(position: np.ndarray, model: Model) -> np.ndarray:
    """(V, 3, 3) rotations of the one-rings from rest to ``position``, exactly; of a straight ring, one of the best."""
    n = len(position)
    rotation, covariance, straight = np.empty((n, 3, 3)), np.empty((n, 3, 3)), np.empty(n, bool)
    kernels.best_rotations(position, model.start, model.neighbour, model.rest_edge, covariance, rotation, straight)
    if straight.any():
        U, _, Vt = np.linalg.svd(covariance[straight])
        U[:, :, 2] *= np.linalg.det(U @ Vt)[:, None]
        rotation[straight] = U @ Vt
    return rotation


def identity(n: int) -> np.ndarray:
    """(n, 3, 3) identity rotations."""
    return np.tile(np.eye(3), (n, 1, 1))
