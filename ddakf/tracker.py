"""DD-AKF: one tracker, one garment. ``Tracker.step`` is the paper's algorithm, section 2.8, A to H."""

from __future__ import annotations

import copy
import dataclasses
import logging
from math import inf
from weakref import WeakValueDictionary

import numpy as np

from ddakf import first_frame
from ddakf import snapshot as snapshots
from ddakf.appearance import colour, segmentation
from ddakf.body import body_anchor, contact
from ddakf.config import Config
from ddakf.errors import InvalidArgument, InvalidConfig, InvalidMesh, is_number, shown
from ddakf.garment import model, working_mesh
from ddakf.mesh import Mesh
from ddakf.multiresolution import cluster_alignment, hidden_cloth
from ddakf.physics import adaptive_stiffness, energies, rigidity, size
from ddakf.planning import omission, plan
from ddakf.planning.clock import Clock
from ddakf.plausibility import admission, frame_gate, units, warnings
from ddakf.results import FrameResult, Usage
from ddakf.search import relocalize
from ddakf.stages import adapt, associate, frame_input, fuse, predict, preprocess, reliability, robust, uncertainty
from ddakf.transfer import Discretised, reconfigured, transferred
from ddakf.types import (
    BodyTrack,
    Drift,
    Estimate,
    FrameInput,
    Health,
    Posterior,
    Problem,
    Setup,
    State,
    Track,
    UpdateTerms,
    variances,
)

log = logging.getLogger(__name__)

# of all trackers in this process: they are large, take long to build, and never change
_CONSTANTS: WeakValueDictionary[tuple[bytes, bytes | None, Config], Discretised] = WeakValueDictionary()


class Tracker:
    """Tracks a garment through point clouds.

    The first tracker of a process loads the kernels: half a second, or minutes where the cache lacks them. Trackers of equal
    garments, bodies and configurations share what is constant, such as the working mesh, while one of them lives.

    Args:
        garment: its vertices are the rest shape, and where tracking starts unless :meth:`reset` says otherwise.
        body: the body underneath in the pose of the start, or None; only with it may frames carry ``body_vertices``.
        config: ``Config()`` (if None), ``Config.fast()`` or ``Config.paper()``, or a variation of them.

    Raises:
        InvalidMesh: not meshes, metres beyond 10 km, a garment or body beyond 10 m, or a garment ten times as large as its body.
        InvalidConfig: ``config`` is not a ``ddakf.Config``.
    """

    def __init__(self, garment: Mesh, *, body: Mesh | None = None, config: Config | None = None):
        if not isinstance(garment, Mesh):
            raise InvalidMesh("garment", "a ddakf.Mesh", type(garment).__name__)
        if body is not None and not isinstance(body, Mesh):
            raise InvalidMesh("body", "a ddakf.Mesh or None", type(body).__name__)
        if config is not None and not isinstance(config, Config):
            raise InvalidConfig("config", "a ddakf.Config or None", type(config).__name__)
        units.require_size(garment, body)
        self.config = Config() if config is None else config
        self.garment, self.body = garment, body
        self._discretised = _constants(garment, body, self.config)
        if self._working.doubt:
            log.warning("%s", self._working.doubt)
        self.reset()
        first_frame.load_kernels(Tracker, self.config, body is not None)

    @property
    def _working(self) -> working_mesh.WorkingMesh:
        return self._discretised.working

    @property
    def _setup(self) -> Setup:
        return self._discretised.setup

    @property
    def working_vertices(self) -> int:
        """Number of vertices that are tracked; the garment's others are carried along."""
        return self._working.mesh.n_vertices

    @property
    def timestamp(self) -> float | None:
        """Of the last frame, seconds of the sensor's clock; None before the first, and after a reset."""
        return self._track.time

    def reset(self, vertices=None, *, velocities=None) -> None:
        """Starts again from these vertices; the body is in its first pose, or in its last one if they fit that better.

        Args:
            vertices: (V, 3) metres, the template's if None. They become the rest shape: all of their folds, and a share of their
                strain.
            velocities: (V, 3) metres per second; zero if None.

        Raises:
            InvalidFrame: wrong shape, not finite, or of another unit; nothing is changed then.
        """
        n = self.garment.n_vertices
        position = self.garment.vertices.copy() if vertices is None else frame_input.positions("vertices", vertices, n)
        velocity = np.zeros((n, 3)) if velocities is None else frame_input.positions("velocities", velocities, n)
        units.require_start(self.garment, position, velocity)
        known = None if vertices is None else self._track.body
        track = _first_track(self._setup, self._working.sampled(position), self._working.sampled(velocity), known)
        if vertices is not None:
            resting = rigidity.resting(track.state.position, self._setup)
            track = track._replace(resting=resting, size=resting.size)
        self._track = track

    def step(
        self, points, *, timestamp: float, sensor_origin=None, body_vertices=None, colors=None, budget=None, limit=inf
    ) -> FrameResult:
        """Tracks one frame.

        Args:
            points: (N, 3) metres; none is a frame without measurements.
            timestamp: seconds of the sensor's clock, later than the last frame's.
            sensor_origin: (3,), or (N, 3) when up to 64 cameras are fused, metres; None if unknown.
            body_vertices, colors: (B, 3) metres, the body in this frame; (N, 3) uint8, RGB of the points; or None.
            budget, limit: processor seconds: to plan the work with, or None; and beyond which the frame is given up.

        Raises:
            InvalidFrame: input that cannot be used. FrameTooCostly: beyond the limit. The tracker is as it was.
        """
        clock, given = Clock(budget, limit), FrameInput(points, timestamp, sensor_origin, body_vertices, colors)
        with clock("input"):
            frame, last = admission.admit(self._setup, self._track, given)
        with clock("predict"):  # A. Prediction (2.2), riding on the body
            problem = relocalize.locate(plan.allow_search(clock, predict.begin(self._setup, last, frame)))
        with clock("preprocess"):  # Preprocessing (2.1)
            problem = colour.begin(body_anchor.measure(preprocess.preprocess(plan.limit_points(clock, problem))))
        with clock("coarse"):
            estimate = cluster_alignment.align(plan.limit_alignment(clock, problem))
        for gate in associate.gates(plan.limit_passes(clock, problem)):
            with clock("associate"):  # B. Association (2.3)
                measurement = colour.register(problem, estimate, associate.associate(problem, estimate, gate))
            with clock("robust"):  # C. Robustness (2.5)
                weight = robust.weigh(problem, estimate, measurement)
            with clock("adapt"):  # D. Adaptation (2.3, 2.7)
                R = adapt.adapt(problem, estimate, measurement, weight)
            with clock("physics"):  # E. Physics (2.4)
                forces = energies.linearize(problem, estimate)
            with clock("fuse"):  # F. Fusion update (2.4, 2.8)
                estimate = fuse.fuse(problem, estimate, UpdateTerms(measurement, weight, R, forces), gate)
            if estimate.finished:
                break
        with clock("uncertainty"):
            posterior = uncertainty.posterior(problem, estimate)
        with clock("reliability"):  # G. Reliability (2.6), and warnings of wrong input
            verdict = warnings.add_warnings(problem, estimate, reliability.judge(problem, estimate, posterior))
        with clock("output"):  # H. Output
            track, result = self._output(problem, estimate, posterior, verdict)
        self._track = plan.learn_costs(clock, track, problem, estimate)
        return clock.timed(result)

    def _output(
        self, problem: Problem, estimate: Estimate, posterior: Posterior, verdict: reliability.Verdict
    ) -> tuple[Track, FrameResult]:
        """The track after a frame, and its result at the template's vertices; of the prediction where the fit has collapsed."""
        if frame_gate.collapsed(problem, estimate, verdict):
            estimate, verdict = frame_gate.keep_prediction(problem, estimate, verdict)
            problem = problem._replace(last=problem.last._replace(view=self._track.view, sensors=self._track.sensors))
            posterior = uncertainty.posterior(problem, estimate)
        posterior = uncertainty.widen(problem, estimate, posterior, verdict.widening)
        posterior = posterior._replace(state=predict.with_given_velocity(problem, posterior.state))
        posterior, offset = hidden_cloth.follow_seen(problem, estimate, posterior)
        track = _next_track(self._setup, problem, estimate, posterior, verdict)._replace(offset=offset)
        result = _result(problem, estimate, posterior, verdict, track)
        return track, self._working.result(result, track.rotation)

    def predicted(self, result: FrameResult, seconds: float) -> FrameResult:
        """The last result as it will be ``seconds`` after its frame: stage A's prediction, the body moving on as it last did.

        For a display that shows the garment later than the sensor saw it. Vertices, velocities, covariance and sigma are those
        of that moment, all else is the frame's. The tracker stays as it is.

        Args:
            result: of the last step.
            seconds: at most ``predict.longest_step`` of the configuration moves the garment.

        Raises:
            InvalidArgument: a result that is not the last step's, a time that is no finite number of 0 or more.
        """
        track, working = self._track, self._working
        if not isinstance(result, FrameResult):
            raise InvalidArgument("result", "that of the last step", type(result).__name__)
        if not np.array_equal(result.vertices, working.carried(track.shown(track.state.position), track.rotation)):
            raise InvalidArgument("result", "that of the last step", "another one")
        if not (is_number(seconds) and 0 <= seconds < np.inf):
            raise InvalidArgument("seconds", "a finite time of 0 or more", shown(seconds))
        if seconds == 0.0:
            return result
        later = predict.ahead(track, seconds, self.config.predict)
        grown = result.covariance + (later.growth if later.growth.ndim == 2 else working.spread(later.growth))
        covariance = uncertainty.cap(grown, self.config.uncertainty)
        return dataclasses.replace(
            result,
            vertices=working.carried(track.shown(later.position), track.rotation),
            velocities=working.spread(later.velocity),
            covariance=covariance,
            sigma=np.sqrt(variances(covariance)),
        )

    def configured(self, config: Config) -> Tracker:
        """A tracker that goes on from here with another configuration; this one stays as it is, see :meth:`continue_from`.

        Raises:
            InvalidConfig: ``config`` is not a ``ddakf.Config``.
        """
        other = self.another(config)
        other.continue_from(self)
        return other

    def another(self, config: Config) -> Tracker:
        """A tracker of the same garment and body at the start, which shares with this one what is constant in both.

        Raises:
            InvalidConfig: ``config`` is not a ``ddakf.Config``.
        """
        if not isinstance(config, Config):
            raise InvalidConfig("config", "a ddakf.Config", type(config).__name__)
        other = copy.copy(self)
        other.config, other._discretised = config, _constants(self.garment, self.body, config, self._discretised)
        other.reset()
        return other

    def continue_from(self, other: Tracker) -> None:
        """Goes on from where another tracker is, of the same garment and body; that one stays as it is.

        What it has learned stays: covariances, drift, the garment's strain. With the same configuration the next step is the same
        to the bit. Between two working meshes all of it is interpolated.

        Raises:
            InvalidArgument: a tracker of another garment or body.
        """
        if not isinstance(other, Tracker):
            raise InvalidArgument("other", "a ddakf.Tracker", type(other).__name__)
        if _meshes(self.garment, self.body) != _meshes(other.garment, other.body):
            raise InvalidArgument("other", "a tracker of the same garment and body", "one of others")
        track, config = other._track, self.config
        if config.discretisation != other.config.discretisation:
            track = transferred(track, other._discretised, self._discretised, self._track.resting)
        elif _shaping(config) != _shaping(other.config):
            track = reconfigured(track, other._setup, self._setup)
        if track.body is not None:
            body = contact.configured(self._setup.body, track.body, track.state.position, config.physics)
            track = track._replace(body=body)
        self._track = track

    def snapshot(self, *, compressed: bool = True) -> bytes:
        """The whole tracker; the next step of :meth:`restore` 's tracker is exact to the bit.

        Args:
            compressed: False is ten times as fast and less than twice as large, as most digits cannot be compressed.
        """
        return snapshots.save(self, int(compressed))

    @staticmethod
    def restore(data: bytes) -> Tracker:
        """A tracker from the bytes of :meth:`snapshot`.

        Raises:
            InvalidSnapshot: not a snapshot, of another version, or damaged.
        """
        return snapshots.load(data, Tracker)


def _meshes(garment: Mesh, body: Mesh | None) -> tuple[bytes, bytes | None]:
    """What tells a garment and its body from others."""
    return garment.digest, None if body is None else body.digest


def _constants(garment: Mesh, body: Mesh | None, config: Config, known: Discretised | None = None) -> Discretised:
    """What is constant for a tracker: of another tracker with the same meshes and configuration, or built.

    ``known`` is that of the same meshes with another configuration. Its search tree of the body is used again, and its working
    mesh if both configurations want the same.
    """
    key = (*_meshes(garment, body), config)
    found = _CONSTANTS.get(key)
    if found is None:
        found = _CONSTANTS[key] = _discretised(garment, body, config, known)
    return found


def _discretised(garment: Mesh, body: Mesh | None, config: Config, known: Discretised | None) -> Discretised:
    if known is not None and known.setup.config.discretisation == config.discretisation:
        working = known.working
    else:
        working = working_mesh.build(garment, config.discretisation)
    cloth, under = model.build(working.mesh, config), None
    if body is not None:
        same = None if known is None else known.setup.body
        under = contact.build(body, config.predict.carry_reach, config.physics.collision_reach, same)
    return Discretised(working, Setup(cloth, under, config, warnings.reference(garment, cloth, body, config)))


def _shaping(config: Config) -> tuple:
    """What a configuration decides of the start's forces, of the hold on the body and of the texels."""
    return config.physics, config.anchor, config.start.up, config.colour.texel


def _first_track(setup: Setup, position: np.ndarray, velocity: np.ndarray, known: BodyTrack | None = None) -> Track:
    """The track before the first frame, of vertices at (V, 3) ``position``, metres, on a body that may be in a known pose."""
    garment, body, config = setup.model, setup.body, setup.config
    start, under, anchor = config.start, None, None
    if body is not None:
        under = contact.start(body, position, config.physics, known)
        if body_anchor.enabled(config):
            anchor = body_anchor.start(setup, under.vertices, position)
    return Track(
        state=State.at(position, velocity, start.sd, start.speed_sd, config.adapt.initial_sd),
        rotation=rigidity.rotations(position, garment),
        drift=Drift.at(garment, start.sd),
        strain2=adaptive_stiffness.initial(config.physics),
        health=Health(spacing=start.first_step if velocity.any() else 0.0),
        time=None,
        body=under,
        anchor=anchor,
    )


def _next_track(
    setup: Setup, problem: Problem, estimate: Estimate, posterior: Posterior, verdict: reliability.Verdict
) -> Track:
    """The track after a frame."""
    state, position, measured = posterior.state, posterior.state.position, estimate.learnable
    larger = size.learn(problem, estimate, position, verdict.health.reliability)
    return Track(
        state=state,
        rotation=problem.rotation if estimate.rejected else rigidity.against_template(estimate.rest, problem.resting),
        drift=posterior.drift,
        strain2=adaptive_stiffness.learn(problem, position, measured),
        health=verdict.health,
        time=problem.frame.timestamp,
        body=contact.learn(problem, estimate, position),
        anchor=body_anchor.learn(problem, position, measured),
        view=problem.last.view,
        sensors=problem.last.sensors,
        signs=verdict.signs,
        costs=problem.last.costs,
        resting=rigidity.resize(problem.last.resting, larger, setup),
        size=larger,
        appearance=colour.learn(problem, estimate, posterior, verdict.health.reliability),
        palette=segmentation.learn(problem, position, verdict.health.reliability),
    )


def _result(
    problem: Problem, estimate: Estimate, posterior: Posterior, verdict: reliability.Verdict, track: Track
) -> FrameResult:
    state, carrying = posterior.state, None if track.body is None else track.body.velocity
    return FrameResult(
        vertices=track.shown(state.position).copy(),
        velocities=state.velocity.copy() if carrying is None else state.velocity + carrying,
        covariance=posterior.covariance.copy(),
        sigma=np.sqrt(variances(posterior.covariance)),
        vertex_reliability=verdict.vertex_reliability,
        observed=estimate.learnable,
        reliability=verdict.reliability,
        paper_score=verdict.paper_score,
        coverage=float(estimate.learnable.mean()),
        state=verdict.health.state,
        warnings=verdict.warnings,
        usage=Usage(widening=omission.widening(problem, estimate), working_vertices=len(state.position)),
    )
