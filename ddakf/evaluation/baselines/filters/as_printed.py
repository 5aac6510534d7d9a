"""DD-AKF as printed, with velocity rows in the gain of the physics step, and what the paper leaves open chosen like a baseline's.

The paper's state is [p, u] and its physics step a pseudo-measurement of p (section 2.4), so that the gain of an extended Kalman
filter has rows for u as well: with K_p those of the position, K_u = P_up P_pp^-1 K_p. ``Config.paper()`` applies the position's
rows alone: the physics pulls a vertex back while its velocity goes on. Everything else is the preset's: prediction (2.2), nearest
points and R from the innovation (2.3), Tukey's weights and the gate (2.5), s_k (2.6), bounds (2.7). No damping, no
re-association, no planes, no body in the prediction.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ddakf.config import Config
from ddakf.evaluation.sensors.captured_frame import CapturedFrame
from ddakf.mesh import Mesh
from ddakf.stages.fuse import inverse_blocks
from ddakf.tracker import Tracker


@dataclass(frozen=True)
class PrintedSettings:
    """What the paper leaves open; the defaults are the best of ``benchmarks/results/tuning.json``.

    Attributes:
        acceleration: sd of the acceleration behind Q_i, m/s^2.
        speed_sd: of the velocities of the start, m/s.
        lowest_sd: square root of R_min, metres.
        highest_sd: square root of R_max, metres.
        alpha: share of the old R, per frame.
        gate: search radius of the nearest point, metres.
        stiffness: factor on those of stretch, shear and bending of ``Config.paper()``.
        longest_correction: by the physics, of a vertex, metres.
        velocity_rows: the gain of the physics step has rows for the velocity.
    """

    acceleration: float = 3.0
    speed_sd: float = 0.058
    lowest_sd: float = 0.05
    highest_sd: float = 0.05
    alpha: float = 0.9
    gate: float = 0.025
    stiffness: float = 0.3
    longest_correction: float = 0.02
    velocity_rows: bool = True

    def config(self) -> Config:
        """The tracker's configuration."""
        paper = Config.paper()
        physics = {name: self.stiffness * getattr(paper.physics, name) for name in ("stretch", "shear", "bend")}
        adapt = replace(paper.adapt, lowest_sd=self.lowest_sd, highest_sd=self.highest_sd, alpha=self.alpha)
        return replace(
            paper,
            start=replace(paper.start, speed_sd=self.speed_sd),
            predict=replace(paper.predict, acceleration=self.acceleration),
            associate=replace(paper.associate, gate=self.gate),
            adapt=replace(adapt, initial_sd=min(max(adapt.initial_sd, self.lowest_sd), self.highest_sd)),
            physics=replace(paper.physics, **physics),
            fuse=replace(paper.fuse, longest_correction=self.longest_correction),
        )


TUNED = PrintedSettings()


class AsPrinted:
    """See the module. A body only keeps the garment outside, as in the paper."""

    def __init__(self, settings: PrintedSettings = TUNED):
        self.settings = settings

    def start(self, garment: Mesh, vertices: np.ndarray, body: Mesh | None) -> None:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        make = _WithVelocityRows if self.settings.velocity_rows else Tracker
        self._tracker = make(garment, body=body, config=self.settings.config())
        self._tracker.reset(vertices=vertices)

    def step(self, frame: CapturedFrame) -> np.ndarray:
        """See :class:`ddakf.evaluation.baselines.baseline.Baseline`."""
        return self._tracker.step(
            frame.points, timestamp=frame.timestamp, sensor_origin=frame.sensor_origin, body_vertices=frame.body_vertices
        ).vertices


class _WithVelocityRows(Tracker):
    """The printed tracker, whose velocities follow the physics step."""

    def _output(self, problem, estimate, posterior, verdict):
        state, updated = posterior.state, estimate.state
        if updated is not None and not estimate.rejected:
            correction = updated.position - self._geometric(problem, estimate)
            slope = updated.P_pu.transpose(0, 2, 1) @ inverse_blocks(updated.P_pp)  # P_up P_pp^-1
            velocity = state.velocity + np.einsum("vab,vb->va", slope, correction)
            posterior = posterior._replace(state=state._replace(velocity=velocity))
        return super()._output(problem, estimate, posterior, verdict)

    @staticmethod
    def _geometric(problem, estimate) -> np.ndarray:
        """(V, 3) positions after the geometric update, before the physics step: p + P_pp (P_pp + R / w)^-1 y."""
        prior, (measurement, weight, R, _) = problem.prior, estimate.terms
        S = prior.P_pp + R / np.maximum(weight, 1e-9)[:, None, None]
        gain = prior.P_pp @ inverse_blocks(S) * (weight > 0)[:, None, None]
        return prior.position + np.einsum("vab,vb->va", gain, measurement.innovation(prior.position))
