"""Particle filter in a reduced space: a rigid motion and smooth deformations.

A particle is a turn R, a shift t and amplitudes q of manifold harmonics phi_k (Vallet and Levy 2008, "Spectral geometry
processing with manifold harmonics"), the smoothest functions on the garment, one in each of the three directions:

    x_i = R (s_i + sum_k phi_k(i) q_k) + t

with s the vertices of the start around their centroid; with a body, those that it has carried on since the start. Every
particle moves on as the estimate did between the last two frames. The proposal then looks at the cloud (van der Merwe et al.
2000, "The unscented particle filter"): a few steps of non-rigid point-to-plane ICP in the same space move the mean, and all
particles with it. A step moves no vertex beyond its gate, and where hardly a vertex finds points the next frame has no such
motion. Its density is taken as flat where that of the motion is. Noise follows, and a weight is multiplied by exp(-E / (2
sd^2)). E is the mean over the visible vertices of the squared distance to the nearest point, cut off at a gate, over the hidden
ones of that to their places on the body, and elasticity sum_k lambda_k |q_k|^2, with the eigenvalues lambda: the squared
difference of the displacements of neighbouring vertices, per vertex.

The likelihood is tempered: sd is the smallest, from ``likelihood_sd`` on, with which the effective sample size 1 / sum w^2 is at
least ``least_size`` (Del Moral, Doucet and Jasra 2012, "An adaptive sequential Monte Carlo method for approximate Bayesian
computation"). Where that size is below half of the particles, they are drawn anew by systematic resampling (Kitagawa 1996).
Passes per frame, each with less noise than the one before, make it an annealed one (Deutscher, Blake and Reid 2000). The
estimate is the weighted mean of all particles, vertex by vertex.

Distances come from a table: the box around the garment is cut into voxels, and each stores the nearest voxel with points and
their mean.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse
from scipy.ndimage import distance_transform_edt
from scipy.sparse.linalg import eigsh
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from ddakf.evaluation.baselines.body_support import HOLD, NoSupport, support_of
from ddakf.evaluation.baselines.linear_algebra import graph_laplacian
from ddakf.evaluation.baselines.matching import LEAST_POINTS, TINY, MatchSettings, Scan, VertexNormals, facing
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh

CONSTANT = 1e-9  # smaller eigenvalues are those of constant functions
RIDGE = 1e-9  # of the proposal's normal equations
BISECTIONS = 12  # of the logarithm of the likelihood's sd
WIDEST = 1e3  # times likelihood_sd
SHIFT = -1e-3  # of the spectrum: the smallest eigenvalues of a matrix that has none below 0


@dataclass(frozen=True)
class ParticleSettings:
    """Numbers of the method; the defaults are the best of ``benchmarks/results/tuning.json``, particles aside.

    Attributes:
        particles: their number.
        harmonics: smooth functions, each with three amplitudes.
        shift_sd: of the noise in the first pass, per axis, metres.
        turn_sd: radians.
        amplitude_sd: metres, RMS over the garment, of the smoothest harmonic; less for others, as 1 / sqrt of the eigenvalue.
        likelihood_sd: sd of the last pass, metres.
        elasticity: see the module.
        passes: of annealing per frame.
        cooling: factor of noise and sd from pass to pass.
        momentum: share of the last frame's motion with which the next one begins.
        gate: metres.
        vertices: most vertices whose distances count.
        voxel: metres.
        seed: of the random numbers.
        proposal_steps: of ICP per frame.
        proposal_gate: metres, of its correspondences.
        least_size: least effective sample size.
        hold: weight of a hidden vertex on the body, see :mod:`~ddakf.evaluation.baselines.body_support`.
    """

    particles: int = 500
    harmonics: int = 6
    shift_sd: float = 0.005
    turn_sd: float = 0.015
    amplitude_sd: float = 0.001
    likelihood_sd: float = 0.00025
    elasticity: float = 1.1
    passes: int = 3
    cooling: float = 0.5
    momentum: float = 0.8
    gate: float = 0.08
    vertices: int = 400
    voxel: float = 0.015
    seed: int = 0
    proposal_steps: int = 12
    proposal_gate: float = 0.1
    least_size: float = 50.0
    hold: float = HOLD


TUNED = ParticleSettings()


class ParticleFilter:
    """See the module. Uses no time."""

    def __init__(self, settings: ParticleSettings = TUNED):
        self.settings = settings

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        settings, vertices = self.settings, np.array(vertices, np.float64)
        self._normals, self._rng = VertexNormals(garment), np.random.default_rng(settings.seed)
        self._harmonics, self._eigenvalues = harmonics(garment, settings.harmonics)
        self._amplitude_sd = settings.amplitude_sd * np.sqrt(self._eigenvalues[:1] / self._eigenvalues)[:, None]
        self._shape = vertices - vertices.mean(axis=0)
        count = min(settings.vertices, len(vertices))
        self._chosen = self._rng.choice(len(vertices), count, replace=False)
        n = settings.particles
        self._turn = Rotation.identity(n)
        self._shift = np.tile(vertices.mean(axis=0), (n, 1))
        self._amplitude = np.zeros((n, self._harmonics.shape[1], 3))
        self._weight = np.full(n, 1 / n)
        self._last = self._mean_state()
        self._drift = Rotation.identity(), np.zeros(3), np.zeros_like(self._amplitude[0])
        self._support, self._centre = support_of(body, vertices, settings.hold), vertices.mean(axis=0)

    def step(self, frame: CapturedFrame) -> np.ndarray:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        self._ride(frame)
        self._move(*self._drift)
        seen = False
        if len(frame.points) >= LEAST_POINTS:
            seen = self._propose(frame)
            self._look(np.asarray(frame.points, np.float64), frame.sensor_origin)
        turn, shift, amplitude = state = self._mean_state()
        last, self._last = self._last, state
        momentum = self.settings.momentum * seen
        by = Rotation.from_rotvec(momentum * (turn * last[0].inv()).as_rotvec())
        self._drift = by, momentum * (shift - last[1]), momentum * (amplitude - last[2])
        return self._support.outside(self._mean_vertices())

    @property
    def effective_sample_size(self) -> float:
        """1 / sum w^2 of the weights now (Kong, Liu and Wong 1994): those of the last pass of the last frame with points."""
        return float(1 / np.square(self._weight).sum())

    def _ride(self, frame: CapturedFrame) -> None:
        """Takes the shape that the body has brought along, and moves the particles by as much as its centroid."""
        if frame.body_vertices is None or isinstance(self._support, NoSupport):
            return
        self._support.begin(frame, self._mean_vertices())
        centre = self._support.place.mean(axis=0)
        self._shape = self._support.place - centre
        self._shift = self._shift + (centre - self._centre)
        self._last = self._last[0], self._last[1] + (centre - self._centre), self._last[2]
        self._centre = centre

    def _move(self, turn: Rotation, shift: np.ndarray, amplitude: np.ndarray) -> None:
        """Moves every particle."""
        self._turn, self._shift, self._amplitude = turn * self._turn, self._shift + shift, self._amplitude + amplitude

    def _propose(self, frame: CapturedFrame) -> bool:
        """Moves all particles as a few steps of ICP in the reduced space move their mean (Gauss-Newton, point to plane).

        A step moves no vertex farther than the gate within which its points were found. Returns whether as many vertices have
        points at the end as a cloud must have: otherwise the motion is not that of the garment, and must not go on.
        """
        settings, phi = self.settings, self._harmonics[self._chosen]
        scan = Scan(frame, MatchSettings(gate=settings.proposal_gate))
        first = turn, shift, amplitude = self._mean_state()
        for _ in range(settings.proposal_steps):
            x = turn.apply(self._shape + self._harmonics @ amplitude) + shift
            normals = self._normals(x)[self._chosen]
            x = x[self._chosen]
            found = scan.match(x, normals)
            held = np.where(found.weight > 0, 0.0, self._support.weight[self._chosen])
            planes = slopes(x - shift, turn.as_matrix(), phi)
            along = np.einsum("va,vau->vu", found.normals, planes)
            off = np.einsum("va,va->v", found.normals, found.points - x)
            weighted = found.weight[:, None] * along
            matrix, right = weighted.T @ along, weighted.T @ off
            if held.any():
                pulled = (held[:, None, None] * planes).reshape(-1, planes.shape[2])
                matrix += pulled.T @ planes.reshape(-1, planes.shape[2])
                right += pulled.T @ (self._support.place[self._chosen] - x).ravel()
            stiff = settings.elasticity * (found.weight.sum() + held.sum()) * np.repeat(self._eigenvalues, 3)
            matrix[np.arange(6, len(right)), np.arange(6, len(right))] += stiff
            right[6:] -= stiff * amplitude.ravel()
            change = np.linalg.solve(matrix + RIDGE * np.eye(len(right)), right)
            farthest = np.linalg.norm(planes @ change, axis=1).max()
            change *= min(1.0, settings.proposal_gate / max(farthest, TINY))
            turn = Rotation.from_rotvec(change[:3]) * turn
            shift, amplitude = shift + change[3:6], amplitude + change[6:].reshape(-1, 3)
        self._move(turn * first[0].inv(), shift - first[1], amplitude - first[2])
        return np.count_nonzero(found.weight) >= LEAST_POINTS

    def _look(self, points: np.ndarray, sensor_origin: np.ndarray | None) -> None:
        settings, expected = self.settings, self._mean_vertices()
        nearby = NearestPoints(points, expected.min(axis=0) - settings.gate, expected.max(axis=0) + settings.gate, settings.voxel)
        if nearby.empty:
            return
        visible = self._visible(expected, points, sensor_origin)
        for number in range(settings.passes):
            if self.effective_sample_size < 0.5 * len(self._weight):
                self._resample()
            self._diffuse(settings.cooling**number)
            self._weight = tempered(self._weight, self._energy(nearby, visible), settings.likelihood_sd, settings.least_size)

    def _energy(self, nearby: NearestPoints, visible: np.ndarray) -> np.ndarray:
        """(particles,) E, square metres."""
        elastic = self.settings.elasticity * np.einsum("k,nka->n", self._eigenvalues, np.square(self._amplitude))
        if len(visible) == 0:
            return elastic
        squared = np.minimum(nearby.squared_distances(self._vertices_of_all(visible)), self.settings.gate**2)
        hidden = np.setdiff1d(self._chosen, visible)
        held = self._support.weight[hidden]
        if held.any():
            off = np.square(self._vertices_of_all(hidden) - self._support.place[hidden]).sum(axis=2)
            squared = np.concatenate([squared, held * np.minimum(off, self.settings.gate**2)], axis=1)
        return elastic + squared.sum(axis=1) / (len(visible) + held.sum())

    def _visible(self, vertices: np.ndarray, points: np.ndarray, sensor_origin: np.ndarray | None) -> np.ndarray:
        """The chosen vertices that face the sensor; with several sensors, that of the nearest point."""
        nearest = np.zeros(len(self._chosen), int)
        if sensor_origin is not None and np.ndim(sensor_origin) == 2:
            nearest = cKDTree(points).query(vertices[self._chosen])[1]
        normals = self._normals(vertices)[self._chosen]
        return self._chosen[facing(vertices[self._chosen], normals, sensor_origin, nearest)]

    def _resample(self) -> None:
        drawn = systematic(self._weight, self._rng)
        self._turn, self._shift, self._amplitude = self._turn[drawn], self._shift[drawn], self._amplitude[drawn]
        self._weight = np.full(len(drawn), 1 / len(drawn))

    def _diffuse(self, share: float) -> None:
        settings, rng, n = self.settings, self._rng, len(self._weight)
        self._turn = Rotation.from_rotvec(share * settings.turn_sd * rng.normal(size=(n, 3))) * self._turn
        self._shift = self._shift + share * settings.shift_sd * rng.normal(size=(n, 3))
        self._amplitude = self._amplitude + share * self._amplitude_sd * rng.normal(size=self._amplitude.shape)

    def _vertices_of_all(self, chosen: np.ndarray) -> np.ndarray:
        """(particles, len(chosen), 3) these vertices of every particle."""
        shape = self._shape[chosen] + self._harmonics[chosen] @ self._amplitude
        return shape @ self._turn.as_matrix().transpose(0, 2, 1) + self._shift[:, None]

    def _mean_vertices(self) -> np.ndarray:
        """(V, 3) weighted mean."""
        turned = self._weight[:, None, None] * self._turn.as_matrix().transpose(0, 2, 1)
        deformation = self._harmonics @ (self._amplitude @ turned).sum(axis=0)
        return self._shape @ turned.sum(axis=0) + deformation + self._weight @ self._shift

    def _mean_state(self) -> tuple[Rotation, np.ndarray, np.ndarray]:
        amplitude = np.einsum("n,nka->ka", self._weight, self._amplitude)
        return self._turn.mean(self._weight), self._weight @ self._shift, amplitude


class NearestPoints:
    """Squared distances to a cloud, looked up in voxels; places outside the box use the voxels at its border.

    Attributes:
        empty: no point is in the box.

    Args:
        points: (N, 3) metres.
        low, high: (3,) corners of the box, metres.
        voxel: side of a voxel, metres.
    """

    def __init__(self, points: np.ndarray, low: np.ndarray, high: np.ndarray, voxel: float):
        self._low, self._voxel = low, voxel
        self._shape = np.maximum(np.ceil((high - low) / voxel).astype(int), 1)
        inside = points[((points >= low) & (points < low + voxel * self._shape)).all(axis=1)]
        cell, count = np.ravel_multi_index(self._cells(inside).T, self._shape), int(self._shape.prod())
        number = np.bincount(cell, minlength=count)
        total = np.stack([np.bincount(cell, inside[:, axis], count) for axis in range(3)], axis=1)
        self._means = total / np.maximum(number, 1)[:, None]
        self.empty = len(inside) == 0
        if not self.empty:
            vacant = (number == 0).reshape(self._shape)
            nearest = distance_transform_edt(vacant, return_distances=False, return_indices=True)
            self._nearest = np.ravel_multi_index(nearest.reshape(3, -1), self._shape)

    def squared_distances(self, x: np.ndarray) -> np.ndarray:
        """(...) of the places x (..., 3), square metres; there must be a point in the box."""
        flat = x.reshape(-1, 3)
        cell = np.ravel_multi_index(self._cells(flat).T, self._shape)
        return np.square(flat - self._means[self._nearest[cell]]).sum(axis=1).reshape(x.shape[:-1])

    def _cells(self, x: np.ndarray) -> np.ndarray:
        return np.clip(((x - self._low) / self._voxel).astype(int), 0, self._shape - 1)


def slopes(lever: np.ndarray, turn: np.ndarray, phi: np.ndarray) -> np.ndarray:
    """(n, 3, 6 + 3 k) derivatives of places R (s + sum_k phi_k q_k) + t by a turn of R from the left, t and the amplitudes q.

    Args:
        lever: (n, 3) of the places from t.
        turn: (3, 3) R.
        phi: (n, k).
    """
    n = len(lever)
    x, y, z = lever.T
    zero = np.zeros(n)
    by_turn = np.stack([np.stack(row, axis=1) for row in ((zero, z, -y), (-z, zero, x), (y, -x, zero))], axis=1)
    by_amplitude = (phi[:, None, :, None] * turn[None, :, None, :]).reshape(n, 3, -1)
    return np.concatenate([by_turn, np.broadcast_to(np.eye(3), (n, 3, 3)), by_amplitude], axis=2)


def tempered(weight: np.ndarray, energy: np.ndarray, sd: float, least: float) -> np.ndarray:
    """(n,) weights times exp(-energy / (2 sd'^2)), with sum 1, where sd' >= sd is the smallest standard deviation with which the
    effective sample size is at least ``least``, or nearly that of the weights (n,) before if it was less."""

    def updated(logarithm_sd: float) -> np.ndarray:
        logarithm = np.log(weight) - 0.5 * energy * np.exp(-2.0 * logarithm_sd)
        new = np.exp(logarithm - logarithm.max())
        return np.maximum(new / new.sum(), np.finfo(float).tiny)  # it has a logarithm

    low, high = np.log(sd), np.log(WIDEST * sd)
    if 1.0 / np.square(updated(low)).sum() >= least:
        return updated(low)
    for _ in range(BISECTIONS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if 1.0 / np.square(updated(middle)).sum() >= least else (middle, high)
    return updated(high)


def systematic(weight: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """(n,) numbers of particles, drawn in proportion to their weights (n,) with one random number: each is taken n w times,
    rounded up or down."""
    n = len(weight)
    return np.minimum(np.searchsorted(np.cumsum(weight), (rng.random() + np.arange(n)) / n, side="right"), n - 1)


def harmonics(garment: Mesh, count: int) -> tuple[np.ndarray, np.ndarray]:
    """The smoothest functions on a garment but the constant ones: eigenvectors of its graph Laplacian, and their eigenvalues.

    Args:
        garment: may have several parts; a part's own constant function counts as one of the smoothest of the others.
        count: of functions; fewer for a mesh of few vertices.

    Returns:
        (V, count) with a root mean square of 1, and (count,) positive.
    """
    laplacian = graph_laplacian(garment)
    count = min(count, garment.n_vertices - 2)
    value, vector = eigsh(sparse.csc_array(laplacian), count + 1, sigma=SHIFT, v0=np.ones(garment.n_vertices))
    order = np.argsort(value)[1:]
    value = value[order]
    return np.sqrt(garment.n_vertices) * vector[:, order], np.maximum(value, value[value > CONSTANT].min())
