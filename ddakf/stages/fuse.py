"""Stage F, fusion update (paper, sections 2.3, 2.4 and 2.8 F): measurements, prior and physics in one update."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from ddakf.body import gravity
from ddakf.config import DecoupledUpdate, MapUpdate, NearestPoint, PlaneAssociation
from ddakf.garment.slippage import least_normal_share, some_faces
from ddakf.kernels import colour as colour_kernels
from ddakf.kernels import conjugate_gradients as solver
from ddakf.kernels import fuse as kernels
from ddakf.kernels import hem as hem_kernels
from ddakf.kernels import robust as robust_kernels
from ddakf.kernels import self_collision as self_collision_kernels
from ddakf.kernels import strain as strain_kernels
from ddakf.kernels import surface_points as point_kernels
from ddakf.kernels.conjugate_gradients import BlockMatrix, Preconditioner
from ddakf.kernels.predict import CovarianceBlocks
from ddakf.kernels.rigidity import LocalRigidity
from ddakf.kernels.surface_points import FoundFaces
from ddakf.physics import rigidity
from ddakf.physics.energies import total_blocks, total_gradient
from ddakf.stages import robust
from ddakf.types import Estimate, Measurement, Model, Planes, Problem, State, System, UpdateTerms

NOISY = 2.0  # variance of points on faces over that of planes, above which the points count less
OPPOSITE = -0.4  # cosine between the directions to two sensors, below which they see all sides of a garment
SLIPPERY = 0.1  # slippage (see garment.slippage), below which a garment slips along itself
LEAST_MOTION = 0.25  # least factor on the rigidity between frames at the seen vertices of such a garment


def begin(problem: Problem) -> Estimate:
    """The estimate before the first pass: the prediction, with its locally rigid terms."""
    prior, model, config = problem.prior, problem.model, problem.config
    n, share, (rest_weight, motion_weight) = len(prior.position), _softer(problem), _rigidities(problem)
    floor = config.fuse.prior_sd**2 if isinstance(config.fuse, MapUpdate) else 0.0
    rest = rigidity.to_rest(model, share * rest_weight, problem.rotation, config.physics.strain_followed, problem.resting)
    return Estimate(
        position=prior.position,
        rest=rest,
        motion=rigidity.since(problem.motion_start, model, share * motion_weight),
        information=inverse_blocks(prior.P_pp, floor),
        terms=UpdateTerms(Measurement.none(n), np.zeros(n), prior.R, None),
        gravity=gravity.force(problem, rest.rotation),
        bulge=_bulge(problem),
        yielding=_yielding(problem),
    )


def _bulge(problem: Problem) -> np.ndarray | None:
    """(V, 3) metres by which vertices stand out of the patch of cloud that their planes are fitted to; None where not known.

    With r the radius of the patch and e the edges of the mesh, a sphere's vertex stands out of its neighbours' mean in proportion
    to e^2, and of the mean of a patch around it to r^2 / 2. The plane of a patch beside it slopes toward it, so that less is
    missing. From one camera without a body nothing else holds the shape, and bulges would grow.
    """
    model, cloud, association = problem.model, problem.cloud, problem.config.associate
    if isinstance(association, NearestPoint) or cloud is None or cloud.empty:
        return None
    if association.bulge == 0.0 or not (problem.body is not None or _all_around(problem)):
        return None
    width = problem.config.preprocess.plane_radius * cloud.cell / model.edge_length
    share = association.bulge * min(1.0, width**2)
    bulge = np.empty(problem.motion_start.shape)
    kernels.stand_out(problem.motion_start, model.start, model.neighbour, model.boundary[:, 0], share, bulge)
    return bulge


def _rigidities(problem: Problem) -> tuple[float, float]:
    """Weights of the locally rigid terms, to the rest shape and between frames, 1/m^2."""
    physics = problem.config.physics
    motion = physics.motion_rigidity * min(1.0, physics.motion_time / problem.dt)
    return problem.health.physics_lambda * physics.rest_rigidity, motion


def fuse(problem: Problem, estimate: Estimate, terms: UpdateTerms, gate: float) -> Estimate:
    """One joint update with geometric and physical residuals.

    Args:
        problem: the frame.
        estimate: at which the terms were formed.
        terms: of stages B to E.
        gate: search radius of this pass, metres; no correction is longer, before it is extrapolated.
    """
    estimate = estimate._replace(terms=terms, contacts=terms.forces.contacts, passes=estimate.passes + 1)
    match problem.config.fuse:
        case MapUpdate():
            return _map_update(problem, estimate, gate)
        case DecoupledUpdate():
            return _decoupled_update(problem, estimate)


def _map_update(problem: Problem, estimate: Estimate, gate: float) -> Estimate:
    model, config, first = problem.model, problem.config, estimate.before is None
    steps = config.physics.first_rotation_steps if first else config.physics.rotation_steps
    planes = _planes(problem, estimate)
    rows, rigid = rigidity.padded(estimate.position), (estimate.rest, estimate.motion)
    _weigh(rigid, problem, estimate)
    for term in rigid:
        rigidity.fit(term, rows, model, steps)
    system = normal_equations(problem, estimate, rows, planes)
    # the coarse level of the first pass preconditions the later ones as well
    coarse = coarse_inverse(system, model) if estimate.coarse is None else estimate.coarse
    tolerance = config.fuse.solver_tolerance * (1.0 if first else config.fuse.later_tolerance)
    limits = SolverLimits(config.fuse.solver_iterations, tolerance)
    step, delta = solve(system, coarse, model, limits), np.empty_like(estimate.position)
    rms = float(np.sqrt(kernels.limit(step, gate, delta) / len(delta)))
    if not np.isfinite(rms):
        return estimate._replace(position=problem.prior.position, planes=planes, system=system, finished=True, rejected=True)
    rule, finished = config.associate, True
    if isinstance(rule, PlaneAssociation):
        finished = estimate.passes >= rule.least_iterations and rms < rule.settled_below(problem.dt)
    return estimate._replace(
        position=estimate.position + accelerated(estimate, delta, config.fuse),
        planes=planes,
        system=system,
        coarse=coarse,
        finished=finished,
        before=(estimate.position, delta),
    )


def _weigh(rigid: tuple[LocalRigidity, LocalRigidity], problem: Problem, estimate: Estimate) -> None:
    """Gives the locally rigid terms the weights of seen and of hidden vertices, in place."""
    (rest, motion), share, finer = _rigidities(problem), _softer(problem), 1.0
    seen, hidden = (share * rest, share * estimate.yielding * motion), (share * rest, share * motion)
    if _folds_unseen(problem):
        finer, hidden = max(1.0, problem.config.physics.hidden_edge / problem.model.edge_length), (rest, motion)
    rigidity.stiffen_hidden(rigid, seen, hidden, ~estimate.observed, finer)


def _yielding(problem: Problem) -> float:
    """Share of the rigidity between frames that seen vertices have: the less, the more the garment slips along itself.

    Only its folds show that a skirt turns. Held by the last frame it falls behind, until the folds match others. A body shows
    it too.
    """
    if not (_held(problem) and _all_around(problem)):
        return 1.0
    share = least_normal_share(problem.motion_start, some_faces(problem.model.faces))
    return min(1.0, max(LEAST_MOTION, (share / SLIPPERY) ** 2))


def _folds_unseen(problem: Problem) -> bool:
    """Hidden cloth may fold onto the cloud: no body tells where it is, and it is the other side of a garment, not of a sheet."""
    return problem.body is None and not _sheet(problem)


def _sheet(problem: Problem) -> bool:
    """The garment has one side, as a template of one depth frame has."""
    return problem.reference is not None and problem.reference.sides.sheet


def _all_around(problem: Problem) -> bool:
    """No body tells where the garment is, which is no sheet, and sensors may see all of it."""
    return problem.body is None and not _sheet(problem) and not _seen_from_one_side(problem)


def _seen_from_one_side(problem: Problem) -> bool:
    """The places of the sensors are known, and no two of them look at the garment from opposite sides."""
    if problem.cloud is None or problem.cloud.sensor is None:
        return False
    if len(problem.cloud.sensor) == 1:
        return True
    toward = problem.cloud.sensor - problem.prior.position.mean(axis=0)
    toward /= np.maximum(np.linalg.norm(toward, axis=1), 1e-12)[:, None]
    return bool((toward @ toward.T).min() > OPPOSITE)


def _softer(problem: Problem) -> float:
    """Share of both rigidities in a coarse mesh, whose bends cost as much per area as those of a finer one.

    All where one side is seen and no body holds the other, as a soft tube turns about itself unnoticed, and of a sheet, which
    folds. And all until the garment is tracked, or again.
    """
    physics = problem.config.physics
    if not _held(problem):
        return 1.0
    return min(1.0, max(physics.coarse_share, (physics.coarse_edge / problem.model.edge_length) ** 2))


def _held(problem: Problem) -> bool:
    """A body or what is seen holds all of the garment, and it is tracked."""
    health = problem.health
    held = problem.body is not None or _all_around(problem)
    return held and not health.settling and health.state == "tracking"


def _planes(problem: Problem, estimate: Estimate) -> Planes:
    """The measurements as planes; a point is one that is as well known across as along."""
    (measurement, weight, R, _), config = estimate.terms, problem.config
    n = len(weight)
    if measurement.normal is None:
        variance = np.maximum(np.einsum("vaa->v", R) / 3, config.adapt.lowest_sd**2)
        return Planes(measurement.target, np.tile([0.0, 1.0, 0.0], (n, 1)), weight, variance, variance)
    squared, variance = np.empty(n), np.empty(n)
    robust_kernels.along_normals(estimate.position, measurement.target, measurement.normal, R, squared, variance)
    variance = np.maximum(variance, config.adapt.lowest_sd**2)
    tangential, target = np.full(n, config.associate.tangential_sd**2), measurement.target
    points, found, information = measurement.points, None, None
    if points is not None and weight.any():
        found, information = points, _information(problem, points, robust_kernels.median_of(variance, weight > 0.0))
    if estimate.bulge is not None:
        target = np.empty_like(target)
        kernels.shift_along(measurement.target, measurement.normal, estimate.bulge, target)
    return Planes(
        target,
        measurement.normal,
        weight,
        variance,
        tangential,
        measurement.hem,
        config.associate.hem_sd**2,
        measurement.slide,
        found,
        information,
    )


def _information(problem: Problem, points: FoundFaces, variance: float) -> np.ndarray:
    """(P,) 1/m^2 of points on faces, beside planes of this variance, m^2.

    Few have in sum as much as all that are wanted. A point averages no others as a plane does: where heights scatter more than
    planes err, by NOISY in their variances, they count less.
    """
    model, association = problem.model, problem.config.associate
    share = association.wanted_points(model.area, model.edge_length) / len(points.face)
    weight, scale = robust.weigh_points(problem, points)
    return association.points_weight * share / max(variance, scale**2 / NOISY) * weight


def accelerated(estimate: Estimate, delta: np.ndarray, config: MapUpdate) -> np.ndarray:
    """The step (V, 3), extrapolated from two passes: Anderson acceleration of depth one.

    Rotations that are fitted and held make the passes converge slowly where the garment turns without measurements; the secant
    through the last two corrections sees that (Peng et al. 2018, "Anderson acceleration for geometry optimization and physics
    simulation").
    """
    if estimate.before is None:
        return delta
    step = np.empty_like(delta)
    kernels.secant(estimate.position, delta, *estimate.before, config.longest_secant, step)
    return step


def normal_equations(problem: Problem, estimate: Estimate, position: np.ndarray, planes: Planes) -> System:
    """Gauss-Newton equations of the MAP problem at ``position`` (V, 4), the estimate's, padded, metres.

    Args:
        problem: the frame: prior, pseudo-measurements of the body anchor, garment.
        estimate: its energies and locally rigid terms, their rotations fitted to ``position``.
        position: of the estimate, padded.
        planes: the measurements.
    """
    n, model, energies = len(position), problem.model, estimate.terms.forces
    D, force, bending = np.empty((n, 3, 3)), np.empty((n, 4)), energies.bending
    kernels.begin(position, problem.prior.position, estimate.information, bending.blocks, bending.force, D, force)
    for measured in (planes,) if problem.anchored is None else (planes, problem.anchored):
        kernels.add_planes(
            position, measured.target, measured.normal, measured.tangential, measured.weight, measured.variance, D, force
        )
        if measured.hem is not None:
            hem = measured.hem
            hem_kernels.add_ends_of_cloud(
                model.boundary[:, 0], hem.direction, hem.offset, hem.weight, measured.hem_variance, D, force
            )
    if planes.slide is not None:
        registered, information = planes.slide
        colour_kernels.add_slides(position, registered.target, registered.direction, information, D, force)
    stretch, shear, _, collision = energies.stiffness
    if energies.collision is not None:
        kernels.add_single(*energies.collision, collision, D, force)
    if _all_around(problem):
        gravity.add_to_seen(problem, estimate.observed, force)
    elif estimate.gravity is not None:
        force[:, :3] += estimate.gravity
    if energies.self_collision is not None:
        self_collision_kernels.add_pairs(*energies.self_collision, energies.self_stiffness, D, force)
    rigid = (estimate.rest, estimate.motion)
    rigidity.add_force(rigid, position, model, force)
    blocks = np.zeros((len(model.mesh.edges), 12), np.float32)
    strain = model.strain if problem.resting is None else problem.resting.strain
    strain_kernels.add_strain(position, strain, stretch, shear, energies.strain_scale**2, blocks, force)
    if planes.points is not None:
        point_kernels.add_points(model.rings, planes.points, planes.information, D, blocks, force)
    B, weight = np.empty((len(model.neighbour), 12), np.float32), sum(term.weight for term in rigid)
    kernels.add_coupling(model.start, model.neighbour, model.edge, blocks, weight, D, D, B)
    return System(D, B, force)


def coarse_inverse(system: System, model: Model) -> np.ndarray:
    """(3A, 3A) float32, inverse of P' A P on the aggregates: the coarse level of the preconditioner."""
    coarse = np.empty((3 * model.n_aggregates, 3 * model.n_aggregates))
    solver.coarsen(system.D, system.B, model.start, model.neighbour, model.aggregate, coarse)
    return invert(coarse)


class SolverLimits(NamedTuple):
    """Where conjugate gradients stop."""

    iterations: int
    tolerance: float  # factor by which the norm of the residual falls, in the preconditioner's norm


def solve(system: System, coarse_inverse: np.ndarray, model: Model, limits: SolverLimits) -> np.ndarray:
    """(V, 4) float32 delta in metres, padded, A delta = force, by conjugate gradients under a two-level preconditioner."""
    n = len(system.D)
    delta, D, inverse = (np.empty(shape, np.float32) for shape in ((n, 4), (n, 12), (n, 12)))
    solver.pack(system.D, D, inverse)
    matrix = BlockMatrix(D, system.B, model.start, model.neighbour)
    solver.conjugate_gradients(matrix, Preconditioner(inverse, model.aggregate, coarse_inverse), system.force, *limits, delta)
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
    while not solver.invert(tried, inverse):
        if share > 1.0 or not np.isfinite(matrix).all():
            return np.full(matrix.shape, np.nan, np.float32)
        tried = matrix + share * np.abs(matrix).max() * np.eye(len(matrix))
        share *= 10.0
    return inverse


def _decoupled_update(problem: Problem, estimate: Estimate) -> Estimate:
    """The paper's: a Kalman update of every vertex, then the gradient pseudo-measurement on the mean.

    Geometry, section 2.3: S = P_pp + R / w, K = [P_pp; P_up] S^-1, x += K y, P -= K S K'. Physics, section 2.4: z = 0,
    h = dE/dp, H_i = dh/dp_i; p -= K h, K = P H' (H P H' + R_phys)^-1, without a change of P. The paper leaves R_phys open; it is
    H_i here, the covariance of the gradient of a log density, and then K = (P^-1 + H)^-1. Any other makes K unsymmetric, and
    the step no descent.
    """
    prior, config = problem.prior, problem.config.fuse
    measurement, weight, R, energies = estimate.terms
    used = weight > 0
    y = measurement.innovation(prior.position)
    S_inverse = inverse_blocks(prior.P_pp + R / np.maximum(weight, 1e-9)[:, None, None]) * used[:, None, None]
    gain_p, gain_u = prior.P_pp @ S_inverse, prior.P_pu.transpose(0, 2, 1) @ S_inverse
    P_pp = prior.P_pp - gain_p @ prior.P_pp
    position = prior.position + np.einsum("vab,vb->va", gain_p, y)
    state = State(
        position=position,
        velocity=prior.velocity + np.einsum("vab,vb->va", gain_u, y),
        P_pp=0.5 * (P_pp + P_pp.transpose(0, 2, 1)),
        P_pu=prior.P_pu - gain_p @ prior.P_pu,
        P_uu=prior.P_uu - gain_u @ prior.P_pu,
        R=R,
        acceleration=prior.acceleration,
    )
    H, h = total_blocks(energies, problem.model), total_gradient(energies, problem.model)
    gain = inverse_blocks(inverse_blocks(state.P_pp) + H)
    correction = np.einsum("vab,vb->va", gain, h)
    length = np.sqrt(np.einsum("va,va->v", correction, correction))[:, None]
    correction *= np.minimum(1.0, config.longest_correction / np.maximum(length, 1e-12))
    state = state._replace(position=position - correction)
    if not np.isfinite(state.position).all():
        return estimate._replace(state=prior, position=prior.position, finished=True, rejected=True)
    return estimate._replace(state=state, position=state.position, finished=True)


def condition(prior: State, position: np.ndarray, P_pp: np.ndarray, R: np.ndarray) -> State:
    """The posterior of each 6-vector when its position is now known to be (position, P_pp).

    The velocity follows through the prior's cross covariance, as in a Rauch-Tung-Striebel step: with G = P_up P_pp^-1 of the
    prior, u += G (p - p_prior), P_pu = P_pp' G' and P_uu += G (P_pp' - P_pp) G'.
    """
    velocity, P_pu, P_uu = prior.velocity.copy(), np.empty_like(P_pp), np.empty_like(P_pp)
    before = CovarianceBlocks(prior.P_pp, prior.P_pu, prior.P_uu)
    kernels.condition(before, position - prior.position, velocity, CovarianceBlocks(P_pp, P_pu, P_uu))
    return State(position, velocity, P_pp, P_pu, P_uu, R, prior.acceleration)
