"""DD-AKF: one tracker, one garment. ``Tracker.step`` is the paper's algorithm, section 2.8, A to H."""

from __future__ import annotations

import functools
import time

import numpy as np

from ddakf import snapshot as snapshots
from ddakf.body import body_anchor
from ddakf.body.contact import BodyContact
from ddakf.config import Config
from ddakf.errors import InvalidArgument, InvalidConfig, InvalidMesh
from ddakf.garment import model
from ddakf.mesh import Mesh
from ddakf.multiresolution import cluster_alignment, pyramid
from ddakf.physics import adaptive_stiffness, energies, rigidity
from ddakf.search import relocalize
from ddakf.stages import adapt, associate, frame_input, fuse, predict, preprocess, reliability, robust, skin_removal, uncertainty
from ddakf.types import FrameResult, State

FIRST_STEP = 1.0 / 30.0  # s assumed between the start and the first frame


def whole(step):
    """A step that raises has not happened: the body, which moves before the garment does, goes back to where it was. All else
    changes at once, when nothing can fail any more."""

    @functools.wraps(step)
    def guarded(self, *args, **kwargs):
        mark = None if self._contact is None else self._contact.mark()
        try:
            return step(self, *args, **kwargs)
        except BaseException:
            if mark is not None:
                self._contact.back_to(mark)
            raise

    return guarded


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
        self._model = model.build(garment, self.config)
        self._contact = None if body is None else BodyContact(body, self.config.predict.carry_reach)
        self.reset()

    def reset(self, vertices=None, *, velocities=None) -> None:
        """Starts again from these vertices; rest lengths and angles stay the garment's, the body is in its first pose.

        Args:
            vertices: (V, 3) metres; the rest shape if None.
            velocities: (V, 3) metres per second; zero if None.

        Raises:
            InvalidFrame: wrong shape or not finite; nothing is changed then.
        """
        n, start = self.garment.n_vertices, self.config.start
        position = self.garment.vertices.copy() if vertices is None else frame_input.positions("vertices", vertices, n)
        velocity = np.zeros((n, 3)) if velocities is None else frame_input.positions("velocities", velocities, n)
        self._state = State.at(position, velocity, start.sd, start.speed_sd, self.config.adapt.initial_sd)
        self._rotation = rigidity.rotations(position, self._model)
        self._drift = uncertainty.Drift.at(self._model, start.sd)
        self._elasticity = adaptive_stiffness.Elasticity.at(self.config.physics)
        self._health = reliability.Health()
        self._time: float | None = None
        self._worn: body_anchor.Worn | None = None  # where it is not known yet
        if self._contact is not None:
            self._contact.reset()
            if self.config.physics.gap_time > 0:
                self._contact.start(position, self.config.physics.thickness)
            if body_anchor.holds(self.config.predict):
                self._worn = body_anchor.Worn.at(position, self._contact, self._model)

    @whole
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
        now = frame_input.checked(points, timestamp, sensor_origin, body_vertices, self._time, self.body)
        dt = FIRST_STEP if self._time is None else now.timestamp - self._time
        garment, health, clock = self._model, self._health, Clock()
        config = self._elasticity.adapted(self.config)

        # A. Prediction (2.2), riding on the body
        last, carried = self._ride(now.body_vertices, dt)
        prior = predict.predict(last, dt, carried, config.predict)
        prior, anchor, rotation, placed, settling = relocalize.locate(
            prior, last.position, self._rotation, now, self._contact, dt, health, garment, config.start
        )
        health = (health.placed() if placed else health)._replace(settling=settling)
        clock.lap("predict")

        # Preprocessing (2.1)
        mine = skin_removal.cloth(now, prior.position, self._contact, garment, skin_removal.BESIDE)
        cloud = preprocess.preprocess(mine.points, mine.sensor_origin, prior.position, garment.area, config)
        clock.lap("preprocess")

        held = None if settling or self._worn is None else self._worn.held(self._contact, garment, config.predict)
        update = fuse.begin(prior, anchor, rotation, health.physics_lambda, garment, config, held)
        update = cluster_alignment.align(
            update, prior, cloud, now.body_vertices, self._contact, health.physics_lambda, garment, config
        )
        clock.lap("coarse")
        if not skin_removal.of_person(now, mine):  # edges of decimated levels cannot tell cloth from skin
            update = pyramid.descend(
                update, prior, anchor, cloud, now.body_vertices, self._contact, health.physics_lambda, garment, config
            )
        clock.lap("pyramid")
        for gate in associate.gates(cloud, config.associate, update.passes):
            # B. Association (2.3)
            measurement = associate.associate(
                update.position, update.measurement, cloud, now.body_vertices, garment, gate, config.associate
            )
            clock.lap("associate")

            # C. Robustness (2.5)
            weight = robust.weigh(measurement, update.position, prior.P_pp, last.R, config.robust)
            clock.lap("robust")

            # D. Adaptation (2.3, 2.7)
            R = adapt.adapt(last, measurement, weight, prior, update.position, config.adapt)
            clock.lap("adapt")

            # E. Physics (2.4)
            forces = energies.linearize(
                update.position, update.energies, garment, self._contact, health.physics_lambda, config.physics, anchor
            )
            clock.lap("physics")

            # F. Fusion update (2.4, 2.8)
            update = fuse.fuse(update, prior, measurement, weight, R, forces, gate, garment, config)
            clock.lap("fuse")
            if update.settled:
                break
        posterior = uncertainty.posterior(update, prior, config)
        measured = np.logical_and(update.weight > 0, not update.rejected)  # what a fit that is thrown away says is not learned
        posterior = predict.learn(posterior, prior, measured, dt, config.predict)
        drift = uncertainty.Drift.at(garment, relocalize.FOUND_SD) if placed else self._drift
        still = anchor if carried is None else posterior.position  # a body explains how what is unseen moves
        slack = None if held is None else self._worn.slack(garment, config.predict)
        covariance, drift = uncertainty.marginals(
            update, posterior, prior, still, self._clearance(), slack, health.offset, drift, dt, garment, config
        )
        clock.lap("uncertainty")

        # G. Reliability (2.6)
        sample = skin_removal.cloth(reliability.sample(mine), posterior.position, self._contact, garment, skin_removal.ON_CLOTH)
        verdict = reliability.judge(
            health, update, posterior, covariance, prior, sample.points, self._clearance(), dt, garment, config.reliability
        )
        clock.lap("reliability")

        if self._contact is not None:
            self._contact.learn(posterior.position, measured, dt, config.physics)

        # H. Output
        learned = self._elasticity.learned(posterior.position, measured, dt, garment, config.physics)
        hanging = self._hanging(posterior.position, measured, held, settling > 0, dt)
        result = _result(posterior, covariance, update, verdict, carried, dt, clock.done())
        self._state, self._drift, self._elasticity = posterior, drift, learned
        self._rotation = rotation if update.rejected else update.rest.rotation
        self._health, self._time, self._worn = verdict.health, now.timestamp, hanging
        return result

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
        if not np.array_equal(result.vertices, self._state.position):
            raise InvalidArgument("result", "that of the last step", "another one")
        if not 0 <= seconds < np.inf:
            raise InvalidArgument("seconds", "a finite time of 0 or more", repr(seconds))
        carrying = None if self._contact is None else self._contact.velocity
        drift, dt = self._drift.speed2, self._health.spacing
        return predict.ahead(result, self._state, carrying, drift, dt, seconds, self.config.predict)

    def configured(self, config: Config) -> Tracker:
        """A tracker that goes on from here with another configuration; this one stays as it is.

        What was learned stays: covariances, drift, the garment's strain. With the same configuration the next step is the same
        to the bit.

        Raises:
            InvalidConfig: no configuration.
        """
        if not isinstance(config, Config):
            raise InvalidConfig("config", "a ddakf.Config", type(config).__name__)
        numbers, arrays = snapshots.parts(self)
        arrays = {name: array.copy() for name, array in arrays.items()}
        other = snapshots.build(numbers | {"config": config.to_dict()}, arrays, Tracker)
        if other._contact is not None:
            other._contact.configured(other._state.position, config.physics)
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

    def _clearance(self) -> np.ndarray | None:
        """(V,) m, signed distance of each vertex from the body when last asked for."""
        return None if self._contact is None or self._contact.held is None else self._contact.held.distance

    def _hanging(
        self, position: np.ndarray, measured: np.ndarray, held: fuse.Planes | None, settling: bool, dt: float
    ) -> body_anchor.Worn | None:
        """How the garment hangs on the body after a frame; one that was found elsewhere does so anew once it has settled."""
        config = self.config.predict
        if self._contact is None or settling or not body_anchor.holds(config):
            return None
        if self._worn is not None:
            return self._worn.learned(held, position, measured, dt, self._model, config)
        return body_anchor.Worn.at(position, self._contact, self._model) if self._contact.present else None

    def _ride(self, body_vertices: np.ndarray | None, dt: float) -> tuple[State, np.ndarray | None]:
        """The last state, relative to the body, and the body's displacement of each vertex (V, 3), or None."""
        if self._contact is None:
            return self._state, None
        last, carried = self._contact.carry(self._state, body_vertices, dt)
        self._contact.move(body_vertices)
        return last, carried


class Clock:
    """Adds up the seconds of each stage."""

    def __init__(self) -> None:
        self._start = self._last = time.perf_counter()
        self._laps: dict[str, float] = {}

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self._laps[stage] = self._laps.get(stage, 0.0) + now - self._last
        self._last = now

    def done(self) -> dict[str, float]:
        return self._laps | {"total": time.perf_counter() - self._start}


def _result(posterior, covariance, update, verdict, carried, dt, timings) -> FrameResult:
    return FrameResult(
        vertices=posterior.position.copy(),
        velocities=posterior.velocity.copy() if carried is None else posterior.velocity + carried / dt,
        covariance=covariance.copy(),
        sigma=np.sqrt(uncertainty.variances(covariance)),
        vertex_reliability=verdict.vertex_reliability,
        observed=update.weight > 0,
        reliability=verdict.reliability,
        paper_score=verdict.paper_score,
        coverage=verdict.coverage,
        state=verdict.health.state,
        timings=timings,
    )
