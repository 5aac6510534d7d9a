"""Stage F, fusion update (paper, sections 2.3, 2.4 and 2.8 F): measurements, prior and physics in one update."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from threadpoolctl import ThreadpoolController

from ddakf.config import Config, DecoupledUpdate, MapUpdate, NearestPoint
from ddakf.garment.model import Model
from ddakf.kernels import fuse as kernels
from ddakf.kernels import hem as hem_kernels
from ddakf.kernels import robust as robust_kernels
from ddakf.kernels import self_collision as self_collision_kernels
from ddakf.kernels import strain as strain_kernels
from ddakf.physics import rigidity
from ddakf.physics.energies import Energies, total_blocks, total_gradient
from ddakf.physics.rigidity import LocalRigidity
from ddakf.stages.associate import Hem, Measurement
from ddakf.types import State

BLAS = ThreadpoolController()  # a matrix of a few hundred rows is slower on many threads, and on busy cores very much so
LONGEST_SECANT = 3.0  # passes that the secant may leap over
LATER_TOLERANCE = 2.0  # times the solver's after the first pass: corrections are a few times smaller by then


class Planes(NamedTuple):
    """Plane-aligned measurements: one per vertex with a positive weight."""

    target: np.ndarray  # (V, 3) m
    normal: np.ndarray  # (V, 3)
    weight: np.ndarray  # (V,)
    variance: np.ndarray  # (V,) m^2 along the normal
    tangential: np.ndarray  # (V,) m^2 in the plane
    hem: Hem | None = None  # ends of the cloud beside open boundaries
    hem_variance: float = 1.0  # m^2, of each


class System(NamedTuple):
    """The normal equations A delta = force at an estimate."""

    D: np.ndarray  # (V, 3, 3) diagonal blocks of A, 1/m^2
    B: np.ndarray  # (2E, 12) float32, its other blocks, in rows of the adjacency, by columns padded to four
    force: np.ndarray  # (V, 4) 1/m, minus the gradient, padded


class Update(NamedTuple):
    """The estimate while a frame is worked on."""

    position: np.ndarray  # (V, 3) m
    held: Planes | None  # pseudo-measurements of what is not seen, by the body that it is worn on
    rest: LocalRigidity
    motion: LocalRigidity
    information: np.ndarray  # (V, 3, 3) 1/m^2, of the prior as it enters the MAP problem
    measurement: Measurement
    weight: np.ndarray  # (V,)
    R: np.ndarray  # (V, 3, 3) m^2
    energies: Energies | None = None
    planes: Planes | None = None
    system: System | None = None
    before: tuple[np.ndarray, np.ndarray] | None = None  # position and correction of the pass before, m
    coarse: np.ndarray | None = None  # (3A, 3A) float32 m^2, coarse level of the preconditioner
    state: State | None = None  # the posterior, where the update itself forms it
    passes: int = 0  # of this frame, those on coarser versions of the garment among them
    settled: bool = False
    rejected: bool = False


def begin(
    prior: State, last: np.ndarray, rotation: np.ndarray, physics_lambda: float, model: Model, config: Config,
    held: Planes | None = None,
) -> Update:  # fmt: skip
    """The estimate before the first pass: the prediction.

    Args:
        prior: the prediction.
        last: (V, 3) posterior of the last frame, from which the motion is locally rigid, metres.
        rotation: (V, 3, 3) of the one-rings against the rest shape, in the last frame.
        physics_lambda: factor on the physics; the rest shape is held by as much.
        model, config: of the tracker.
        held: see :class:`Update`.
    """
    n = len(prior.position)
    floor = config.fuse.prior_sd**2 if isinstance(config.fuse, MapUpdate) else 0.0
    return Update(
        position=prior.position,
        held=held,
        rest=rigidity.to_rest(
            model, physics_lambda * config.physics.rest_rigidity, rotation, config.physics.strain_followed
        ),
        motion=rigidity.since(last, model, config.physics.motion_rigidity),
        information=inverse_blocks(prior.P_pp, floor),
        measurement=Measurement.none(n),
        weight=np.zeros(n),
        R=prior.R,
    )


def fuse(
    update: Update, prior: State, measurement: Measurement, weight: np.ndarray, R: np.ndarray, energies: Energies,
    gate: float, model: Model, config: Config,
) -> Update:  # fmt: skip
    """One joint update with geometric and physical residuals.

    Args:
        update: the estimate so far, at which measurement, weight and energies were formed.
        prior: the prediction.
        measurement, weight, R: stages B, C, D.
        energies: stage E.
        gate: search radius of this pass; no vertex is moved farther, metres.
        model, config: of the tracker.
    """
    update = update._replace(measurement=measurement, weight=weight, R=R, energies=energies, passes=update.passes + 1)
    match config.fuse:
        case MapUpdate():
            return _map_update(update, prior, energies, gate, model, config)
        case DecoupledUpdate():
            return _decoupled_update(update, prior, energies, model, config.fuse)


def _map_update(update: Update, prior: State, energies: Energies, gate: float, model: Model, config: Config) -> Update:
    planes = _planes(update, config)
    rows = rigidity.padded(update.position)
    steps = rigidity.FIRST_STEPS if update.before is None else rigidity.ROTATION_STEPS
    for term in (update.rest, update.motion):
        rigidity.fit(term, rows, model, steps)
    measured = (planes,) if update.held is None else (planes, update.held)
    system = normal_equations(rows, prior.position, update.information, measured, energies, (update.rest, update.motion), model)
    # the coarse level of the first pass preconditions the later ones as well
    coarse = coarse_inverse(system, model) if update.coarse is None else update.coarse
    tolerance = config.fuse.solver_tolerance * (1.0 if update.before is None else LATER_TOLERANCE)
    step, delta = solve(system, coarse, tolerance, model, config.fuse), np.empty_like(update.position)
    rms = float(np.sqrt(kernels.limit(step, gate, delta) / len(delta)))
    if not np.isfinite(rms):
        return update._replace(position=prior.position, planes=planes, system=system, settled=True, rejected=True)
    planned = config.associate
    settled = isinstance(planned, NearestPoint) or (update.passes >= planned.least_iterations and rms < planned.tolerance)
    position = update.position + accelerated(update.position, delta, update.before)
    return update._replace(
        position=position, planes=planes, system=system, coarse=coarse, settled=settled, before=(update.position, delta)
    )


def _planes(update: Update, config: Config) -> Planes:
    """The measurements as planes; a point is one that is as well known across as along."""
    measurement, n = update.measurement, len(update.weight)
    if measurement.normal is None:
        variance = np.maximum(np.einsum("vaa->v", update.R) / 3, config.adapt.lowest_sd**2)
        return Planes(measurement.target, np.tile([0.0, 1.0, 0.0], (n, 1)), update.weight, variance, variance)
    squared, variance = np.empty(n), np.empty(n)
    robust_kernels.along_normals(
        update.position, measurement.target, measurement.normal, update.R, squared, variance
    )
    variance = np.maximum(variance, config.adapt.lowest_sd**2)
    tangential = np.full(n, config.associate.tangential_sd**2)
    return Planes(
        measurement.target, measurement.normal, update.weight, variance, tangential, measurement.hem, config.associate.hem_sd**2
    )


def accelerated(position: np.ndarray, delta: np.ndarray, before: tuple[np.ndarray, np.ndarray] | None) -> np.ndarray:
    """The step (V, 3), extrapolated from two passes: Anderson acceleration of depth one.

    Rotations that are fitted and held make the passes converge slowly where the garment turns without measurements; the secant
    through the last two corrections sees that (Peng et al. 2018, "Anderson acceleration for geometry optimization and physics
    simulation").
    """
    if before is None:
        return delta
    step = np.empty_like(delta)
    kernels.secant(position, delta, *before, LONGEST_SECANT, step)
    return step


def normal_equations(
    position: np.ndarray,
    prior: np.ndarray,
    information: np.ndarray,
    measured: tuple[Planes, ...],
    energies: Energies,
    rigid: tuple[LocalRigidity, ...],
    model: Model,
) -> System:
    """Gauss-Newton equations of the MAP problem at ``position`` (V, 4), padded.

    Args:
        position, prior: (V, 4) estimate and (V, 3) predicted mean, metres.
        information: (V, 3, 3) inverse of the prior covariance, 1/m^2.
        measured: the measurements.
        energies: the physics at ``position``.
        rigid: the locally rigid terms, their rotations fitted to ``position``.
        model: the garment.
    """
    n = len(position)
    unary, force = np.zeros((n, 3, 3)), energies.bending.force.copy()
    kernels.add_prior(position, prior, information, unary, force)
    for planes in measured:
        kernels.add_planes(
            position, planes.target, planes.normal, planes.tangential, planes.weight, planes.variance, unary, force
        )
        if planes.hem is not None:
            hem = planes.hem
            hem_kernels.add_ends_of_cloud(
                model.boundary[:, 0], hem.direction, hem.offset, hem.weight, planes.hem_variance, unary, force
            )
    stretch, shear, _, collision = energies.stiffness
    if energies.collision is not None:
        kernels.add_single(*energies.collision, collision, unary, force)
    if energies.self_collision is not None:
        self_collision_kernels.add_pairs(*energies.self_collision, energies.self_stiffness, unary, force)
    rigidity.add_force(rigid, position, model, force)
    blocks = np.zeros((len(model.mesh.edges), 9), np.float32)
    strain_kernels.add_strain(position, *model.strain, stretch, shear, energies.strain_scale**2, blocks, force)
    D, B = energies.bending.blocks.copy(), np.empty((len(model.neighbour), 12), np.float32)
    weight = sum(term.weight for term in rigid)
    kernels.add_coupling(model.start, model.neighbour, model.edge, blocks, weight, unary, D, B)
    return System(D, B, force)


def coarse_inverse(system: System, model: Model) -> np.ndarray:
    """(3A, 3A) float32, inverse of P' A P on the aggregates: the coarse level of the preconditioner."""
    coarse = np.empty((3 * model.n_aggregates, 3 * model.n_aggregates))
    kernels.coarsen(system.D, system.B, model.start, model.neighbour, model.aggregate, coarse)
    return invert(coarse)


def solve(system: System, coarse_inverse: np.ndarray, tolerance: float, model: Model, config: MapUpdate) -> np.ndarray:
    """(V, 4) float32 delta in metres, padded, A delta = force, by conjugate gradients under a two-level preconditioner.

    The residual's norm, as the preconditioner measures it, falls by ``tolerance``.
    """
    n, k = len(system.D), len(coarse_inverse)
    delta, work = np.empty((n, 4), np.float32), np.empty((4, n, 4), np.float32)
    D, inverse = np.empty((n, 12), np.float32), np.empty((n, 12), np.float32)
    kernels.pack(system.D, D, inverse)
    kernels.conjugate_gradients(
        D, system.B, model.start, model.neighbour, inverse, model.aggregate, coarse_inverse, system.force,
        config.solver_iterations, tolerance, work, np.empty(k, np.float32), np.empty(k, np.float32), delta,
    )  # fmt: skip
    return delta


def inverse_blocks(blocks: np.ndarray, added: float = 0.0) -> np.ndarray:
    """Inverses of symmetric positive definite (V, 3, 3), with ``added`` on their diagonals."""
    inverse = np.empty_like(blocks)
    kernels.invert_blocks(blocks, added, inverse)
    return inverse


def invert(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a symmetric positive definite matrix, in float32: a preconditioner and a variance need few digits.

    Rounding can leave a very stiff one indefinite; it is then inverted with a growing share of its largest entry added.
    """
    inverse, share, tried = np.empty(matrix.shape, np.float32), 1e-7, matrix
    while not kernels.invert(tried, inverse):
        if share > 1.0 or not np.isfinite(matrix).all():
            return np.full(matrix.shape, np.nan, np.float32)
        tried = matrix + share * np.abs(matrix).max() * np.eye(len(matrix))
        share *= 10.0
    return inverse


def _decoupled_update(
    update: Update, prior: State, energies: Energies, model: Model, config: DecoupledUpdate
) -> Update:
    """The paper's: a Kalman update of every vertex, then the gradient pseudo-measurement on the mean.

    Geometry, section 2.3: S = P_pp + R / w, K = [P_pp; P_up] S^-1, x += K y, P -= K S K'. Physics, section 2.4: z = 0,
    h = dE/dp, H_i = dh/dp_i; p -= K h, K = P H' (H P H' + R_phys)^-1, without a change of P. The paper leaves R_phys open; it is
    H_i here, the covariance of the gradient of a log density, and then K = (P^-1 + H)^-1. Any other makes K unsymmetric, and
    the step no descent.
    """
    used = update.weight > 0
    y = update.measurement.innovation(prior.position)
    S_inverse = inverse_blocks(prior.P_pp + update.R / np.maximum(update.weight, 1e-9)[:, None, None]) * used[:, None, None]
    gain_p, gain_u = prior.P_pp @ S_inverse, prior.P_pu.transpose(0, 2, 1) @ S_inverse
    P_pp = prior.P_pp - gain_p @ prior.P_pp
    position = prior.position + np.einsum("vab,vb->va", gain_p, y)
    state = State(
        position=position,
        velocity=prior.velocity + np.einsum("vab,vb->va", gain_u, y),
        P_pp=0.5 * (P_pp + P_pp.transpose(0, 2, 1)),
        P_pu=prior.P_pu - gain_p @ prior.P_pu,
        P_uu=prior.P_uu - gain_u @ prior.P_pu,
        R=update.R,
        acceleration=prior.acceleration,
    )
    H, h = total_blocks(energies, model), total_gradient(energies, model)
    gain = inverse_blocks(inverse_blocks(state.P_pp) + H)
    correction = np.einsum("vab,vb->va", gain, h)
    length = np.sqrt(np.einsum("va,va->v", correction, correction))[:, None]
    correction *= np.minimum(1.0, config.longest_correction / np.maximum(length, 1e-12))
    state = state._replace(position=position - correction)
    if not np.isfinite(state.position).all():
        return update._replace(state=prior, position=prior.position, settled=True, rejected=True)
    return update._replace(state=state, position=state.position, settled=True)


def condition(prior: State, position: np.ndarray, P_pp: np.ndarray, R: np.ndarray) -> State:
    """The posterior of each 6-vector when its position is now known to be (position, P_pp).

    The velocity follows through the prior's cross covariance, as in a Rauch-Tung-Striebel step: with G = P_up P_pp^-1 of the
    prior, u += G (p - p_prior), P_pu = P_pp' G' and P_uu += G (P_pp' - P_pp) G'.
    """
    velocity, P_pu, P_uu = prior.velocity.copy(), np.empty_like(P_pp), np.empty_like(P_pp)
    kernels.condition(
        prior.P_pp, prior.P_pu, prior.P_uu, position - prior.position, P_pp, velocity, P_pu, P_uu
    )
    return State(position, velocity, P_pp, P_pu, P_uu, R, prior.acceleration)
