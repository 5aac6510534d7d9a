"""DD-AKF: one tracker, one garment. ``Tracker.step`` is the paper's algorithm, section 2.8, A to H."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from ddakf import snapshot as snapshots
from ddakf.body import body_anchor, contact
from ddakf.config import Config
from ddakf.errors import InvalidArgument, InvalidConfig, InvalidMesh
from ddakf.garment import model
from ddakf.mesh import Mesh
from ddakf.multiresolution import cluster_alignment, pyramid
from ddakf.physics import adaptive_stiffness, energies, rigidity
from ddakf.search import relocalize
from ddakf.stages import adapt, associate, frame_input, fuse, predict, preprocess, reliability, robust, uncertainty
from ddakf.types import (
    Drift,
    Estimate,
    Evidence,
    FrameInput,
    FrameResult,
    Health,
    Posterior,
    Problem,
    Setup,
    State,
    Track,
    variances,
)


class Tracker:
    """Tracks a garment through point clouds.

    Args:
        garment: its vertices are the rest shape, and where tracking starts unless :meth:`reset` says otherwise.
        body: the body underneath in the pose of the start, or None; only with it may frames carry ``body_vertices``.
        config: ``Config()`` or ``Config.paper()``, or a variation of them.

    Raises:
        InvalidMesh: not meshes, or metres beyond 10 km.
        InvalidConfig: no configuration.
    """

    def __init__(self, garment: Mesh, *, body: Mesh | None = None, config: Config | None = None):
        if not isinstance(garment, Mesh):
            raise InvalidMesh("garment", "a ddakf.Mesh", type(garment).__name__)
        if body is not None and not isinstance(body, Mesh):
            raise InvalidMesh("body", "a ddakf.Mesh or None", type(body).__name__)
        if config is not None and not isinstance(config, Config):
            raise InvalidConfig("config", "a ddakf.Config or None", type(config).__name__)
        self.config = Config() if config is None else config
        self.garment, self.body = garment, body
        reaches = self.config.predict.carry_reach, self.config.physics.collision_reach
        under = None if body is None else contact.build(body, *reaches)
        self._setup = Setup(model.build(garment, self.config), under, self.config)
        self.reset()

    def reset(self, vertices=None, *, velocities=None) -> None:
        """Starts again from these vertices; rest lengths and angles stay the garment's, the body is in its first pose.

        Args:
            vertices: (V, 3) metres; the rest shape if None.
            velocities: (V, 3) metres per second; zero if None.

        Raises:
            InvalidFrame: wrong shape or not finite; nothing is changed then.
        """
        n = self.garment.n_vertices
        position = self.garment.vertices.copy() if vertices is None else frame_input.positions("vertices", vertices, n)
        velocity = np.zeros((n, 3)) if velocities is None else frame_input.positions("velocities", velocities, n)
        self._track = _start(self._setup, position, velocity)

    def step(self, points, *, timestamp: float, sensor_origin=None, body_vertices=None) -> FrameResult:
        """Tracks one frame.

        Args:
            points: (N, 3) metres; none is a frame without measurements.
            timestamp: seconds of the sensor's clock, later than the last frame's.
            sensor_origin: (3,), or (N, 3) when several cameras are fused, metres; None if unknown.
            body_vertices: (B, 3) metres, the body in this frame, or None.

        Raises:
            InvalidFrame: input that cannot be used; the tracker is as it was.
        """
        clock, given = Clock(), FrameInput(points, timestamp, sensor_origin, body_vertices)
        frame = frame_input.checked(given, self._track.time, self.body)
        with clock("predict"):  # A. Prediction (2.2), riding on the body
            problem = relocalize.locate(predict.begin(self._setup, self._track, frame))
        with clock("preprocess"):  # Preprocessing (2.1)
            problem = body_anchor.measure(preprocess.preprocess(problem))
        with clock("coarse"):
            estimate = cluster_alignment.align(problem)
        with clock("pyramid"):
            estimate = pyramid.descend(problem, estimate)
        for gate in associate.gates(problem, estimate.passes):
            with clock("associate"):  # B. Association (2.3)
                measurement = associate.associate(problem, estimate, gate)
            with clock("robust"):  # C. Robustness (2.5)
                weight = robust.weigh(problem, estimate, measurement)
            with clock("adapt"):  # D. Adaptation (2.3, 2.7)
                R = adapt.adapt(problem, estimate, measurement, weight)
            with clock("physics"):  # E. Physics (2.4)
                forces = energies.linearize(problem, estimate)
            with clock("fuse"):  # F. Fusion update (2.4, 2.8)
                estimate = fuse.fuse(problem, estimate, Evidence(measurement, weight, R, forces), gate)
            if estimate.settled:
                break
        with clock("uncertainty"):
            posterior = uncertainty.posterior(problem, estimate)
        with clock("reliability"):  # G. Reliability (2.6)
            verdict = reliability.judge(problem, estimate, posterior)
        # H. Output
        result = _result(problem, estimate, posterior, verdict)
        self._track = _learned(problem, estimate, posterior, verdict.health)
        return clock.timed(result)

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
        if not np.array_equal(result.vertices, self._track.state.position):
            raise InvalidArgument("result", "that of the last step", "another one")
        if not 0 <= seconds < np.inf:
            raise InvalidArgument("seconds", "a finite time of 0 or more", repr(seconds))
        return predict.ahead(result, self._track, seconds, self.config.predict)

    def configured(self, config: Config) -> Tracker:
        """A tracker that goes on from here with another configuration; this one stays as it is.

        What was learned stays: covariances, drift, the garment's strain. With the same configuration the next step is the same
        to the bit.

        Raises:
            InvalidConfig: no configuration, or one with another discretisation.
        """
        if not isinstance(config, Config):
            raise InvalidConfig("config", "a ddakf.Config", type(config).__name__)
        if config.discretisation != self.config.discretisation:
            raise InvalidConfig("config.discretisation", "the tracker's own, which its covariance depends on", "another one")
        other = Tracker(self.garment, body=self.body, config=config)
        body = self._track.body
        if body is not None:
            body = contact.configured(other._setup.body, body, self._track.state.position, config.physics)
        other._track = self._track._replace(body=body)
        return other

    def snapshot(self, *, compressed: bool = True) -> bytes:
        """The whole tracker; the next step of :meth:`restore` 's tracker is exact to the bit.

        Args:
            compressed: False is ten times as fast and, as most of it are random digits, not twice as large.
        """
        return snapshots.save(self, int(compressed))

    @staticmethod
    def restore(data: bytes) -> Tracker:
        """A tracker from the bytes of :meth:`snapshot`.

        Raises:
            InvalidSnapshot: not a snapshot, of another version, or damaged.
        """
        return snapshots.load(data, Tracker)


class Clock:
    """Adds up the seconds of each stage: ``with clock("fuse"): ...``."""

    def __init__(self) -> None:
        self._start = time.perf_counter()
        self._seconds: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        begun = time.perf_counter()
        yield
        self._seconds[stage] = self._seconds.get(stage, 0.0) + time.perf_counter() - begun

    def timed(self, result: FrameResult) -> FrameResult:
        """The result with the seconds of its stages, and of the whole."""
        result.timings.update(self._seconds, total=time.perf_counter() - self._start)
        return result


def _start(setup: Setup, position: np.ndarray, velocity: np.ndarray) -> Track:
    """The track before the first frame, of vertices at (V, 3) ``position``, metres."""
    garment, body, config = setup
    start, under, anchor = config.start, None, None
    if body is not None:
        under = contact.start(body, position, config.physics)
        if body_anchor.enabled(config.predict):
            anchor = body_anchor.start(setup, under.vertices, position)
    return Track(
        state=State.at(position, velocity, start.sd, start.speed_sd, config.adapt.initial_sd),
        rotation=rigidity.rotations(position, garment),
        drift=Drift.at(garment, start.sd),
        strain2=adaptive_stiffness.initial(config.physics),
        health=Health(),
        time=None,
        body=under,
        anchor=anchor,
    )


def _learned(problem: Problem, estimate: Estimate, posterior: Posterior, health: Health) -> Track:
    """The track after a frame."""
    state, position, measured = posterior.state, posterior.state.position, estimate.learnable
    return Track(
        state=state,
        rotation=problem.rotation if estimate.rejected else estimate.rest.rotation,
        drift=posterior.drift,
        strain2=adaptive_stiffness.learned(problem, position, measured),
        health=health,
        time=problem.frame.timestamp,
        body=contact.learned(problem, estimate.contacts, position, measured),
        anchor=body_anchor.learned(problem, position, measured),
    )


def _result(problem: Problem, estimate: Estimate, posterior: Posterior, verdict: reliability.Verdict) -> FrameResult:
    state, carried = posterior.state, problem.carried
    return FrameResult(
        vertices=state.position.copy(),
        velocities=state.velocity.copy() if carried is None else state.velocity + carried / problem.dt,
        covariance=posterior.covariance.copy(),
        sigma=np.sqrt(variances(posterior.covariance)),
        vertex_reliability=verdict.vertex_reliability,
        observed=estimate.observed,
        reliability=verdict.reliability,
        paper_score=verdict.paper_score,
        coverage=verdict.coverage,
        state=verdict.health.state,
    )
