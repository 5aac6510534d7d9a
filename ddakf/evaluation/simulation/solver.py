"""Cloth on a moving body, by Newton's vertex block descent on the CPU (Chen et al. 2024); extra ``simulation``.

The body is a collision mesh that moves linearly between its frames; the cloth is elastic triangles with bending at the
edges, friction on the body, and contact with itself.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from ddakf.errors import MissingDependency
from ddakf.evaluation.simulation.fabrics import DEFAULT_FABRIC, Fabric
from ddakf.evaluation.simulation.garments import Garment

GRAVITY = (0.0, -9.81, 0.0)  # m/s^2
SKIN_THICKNESS = 0.005  # m: contact distance of body and cloth, as faces are flat where the body is round
SKIN_REACH = 0.03  # m: depth inside the body up to which a vertex is found and pushed out
SELF_THICKNESS = 0.003  # m between layers
TOP_SPEED = 4.0  # m/s that cloth may have: Newton lets no vertex move beyond half of the distance searched for contacts
RELAXATION = 0.85  # of that half
LEAST_GAP = 0.002  # m of the search beyond the thickness
CONTACT_BUFFER = 128  # contacts of one vertex or edge with the cloth itself; further ones are ignored
REACH = 10.0  # m: half side of a box that holds the body in all frames


@dataclass(frozen=True)
class Steps:
    """Time steps of the solver. Ten substeps of six iterations cost the same, and the cloth stretches more.

    Attributes:
        substeps: of a frame.
        iterations: of vertex block descent in a substep.
    """

    substeps: int = 24
    iterations: int = 3


DEFAULT_STEPS = Steps()


class Start(NamedTuple):
    """State of a garment of V vertices."""

    position: np.ndarray  # (V, 3) m
    velocity: np.ndarray  # (V, 3) m/s


def simulate(
    garment: Garment,
    body_vertices: np.ndarray,
    body_faces: np.ndarray,
    pins: np.ndarray,
    fps: float,
    fabric: Fabric = DEFAULT_FABRIC,
    steps: Steps = DEFAULT_STEPS,
    start: Start | None = None,
) -> Iterator[np.ndarray]:
    """Simulates a garment from its rest shape on, or from a start.

    Args:
        garment: on the body's first frame.
        body_vertices: (T, B, 3) metres.
        body_faces: (G, 3) closed, normals outward.
        pins: (T, V, 3) metres: places of the garment's pinned vertices; the other rows are not read.
        fps: frames per second.
        fabric: material.
        steps: time steps.
        start: of the garment on the body's first frame; at rest as cut if None.

    Yields:
        (V, 3) float32, metres, for every frame after the first.

    Raises:
        MissingDependency: Newton is not installed.
    """
    scene = _Scene(garment, body_vertices[0], body_faces, fabric, steps.iterations, _reach(fps * steps.substeps))
    if start is not None:
        scene.begin(start)
    for frame in range(1, len(body_vertices)):
        yield scene.advance(body_vertices[frame], pins[frame], 1.0 / fps, steps.substeps)


def _reach(steps_per_second: float) -> float:
    """Distance (m) within which contacts of the cloth with itself are searched, once per substep: at the top speed a vertex then
    still moves as far as it should."""
    return max(SELF_THICKNESS + LEAST_GAP, TOP_SPEED / steps_per_second / (RELAXATION / 2))


class _Scene:
    """Newton's model, state and solver for one garment and one body."""

    def __init__(self, garment: Garment, body: np.ndarray, body_faces: np.ndarray, fabric: Fabric, iterations: int, reach: float):
        newton, self._wp = _newton()
        solvers = newton.solvers.SolverBase
        vertices = garment.mesh.vertices.astype(np.float32)
        shape = newton.Mesh(body.astype(np.float32), body_faces.ravel().astype(np.int32), compute_inertia=False)
        builder = newton.ModelBuilder(up_axis=newton.Axis.Y, gravity=GRAVITY)
        contact = newton.ModelBuilder.ShapeConfig(ke=fabric.contact, kd=0.0, mu=fabric.friction)
        builder.add_shape_mesh(-1, mesh=shape, cfg=contact)
        builder.add_cloth_mesh(
            pos=(0.0, 0.0, 0.0),
            rot=self._wp.quat_identity(),
            scale=1.0,
            vel=(0.0, 0.0, 0.0),
            vertices=vertices,
            indices=garment.mesh.faces.ravel().astype(np.int32),
            density=fabric.density,
            tri_ke=fabric.stretch,
            tri_ka=fabric.stretch,
            tri_kd=fabric.damping,
            edge_ke=fabric.bending,
            edge_kd=0.0,
            particle_radius=SKIN_THICKNESS,
        )
        builder.add_ground_plane(cfg=contact)
        builder.color(include_bending=False)  # hinges are soft: their ends may move together, and fewer colours cost less
        model = builder.finalize(device="cpu")
        model.soft_contact_ke, model.soft_contact_kd, model.soft_contact_mu = fabric.contact, 0.0, fabric.friction
        model.shape_collision_aabb_lower.fill_(self._wp.vec3(-REACH))
        model.shape_collision_aabb_upper.fill_(self._wp.vec3(REACH))
        self._pinned = np.flatnonzero(garment.pinned)
        if len(self._pinned):
            flags = model.particle_flags.numpy()
            flags[self._pinned] &= ~int(newton.ParticleFlags.ACTIVE)
            model.particle_flags.assign(flags)
        self._pipeline = newton.CollisionPipeline(model, soft_contact_gap=SKIN_REACH)
        self._contacts = self._pipeline.contacts()
        self._solver = newton.solvers.SolverVBD(
            model,
            iterations=iterations,
            particle_enable_self_contact=True,
            particle_self_contact_margin=SELF_THICKNESS,
            particle_self_contact_gap=reach - SELF_THICKNESS,
            dat_conservative_bound_relaxation=RELAXATION,
            particle_vertex_contact_buffer_size=CONTACT_BUFFER,
            particle_edge_contact_buffer_size=CONTACT_BUFFER,
            collision_frequency_type={solvers.CollisionSlot.SOFT_SELF_CONTACT: solvers.CollisionFrequencyType.PRE_INIT},
        )
        self._states, self._control, self._surface = [model.state(), model.state()], model.control(), shape.mesh
        self._body, self._pins = body.astype(np.float32), vertices[self._pinned]

    def begin(self, start: Start) -> None:
        """Places the garment, with its velocities."""
        for state in self._states:
            state.particle_q.assign(start.position.astype(np.float32))
            state.particle_qd.assign(start.velocity.astype(np.float32))
        self._pins = start.position[self._pinned].astype(np.float32)

    def advance(self, body: np.ndarray, pins: np.ndarray, seconds: float, substeps: int) -> np.ndarray:
        """One frame: the body moves to its next vertices (B, 3) in substeps."""
        dt = seconds / substeps
        body, pins = body.astype(np.float32), pins[self._pinned].astype(np.float32)
        self._surface.velocities.assign((body - self._body) / np.float32(seconds))
        for substep in range(1, substeps + 1):
            share = np.float32(substep / substeps)
            self._surface.points.assign(self._body + share * (body - self._body))
            self._surface.refit()
            now, after = self._states
            if len(self._pinned):
                self._place(now, self._pins + share * (pins - self._pins))
            now.clear_forces()
            self._pipeline.collide(now, self._contacts)
            self._solver.step(now, after, self._control, self._contacts, dt)
            self._states = [after, now]
        self._body, self._pins = body, pins
        return self._states[0].particle_q.numpy().copy()

    def _place(self, state, pins: np.ndarray) -> None:
        for where in (state, self._states[1]):
            vertices = where.particle_q.numpy()
            vertices[self._pinned] = pins
            where.particle_q.assign(vertices)


def version() -> str:
    """Newton's version.

    Raises:
        MissingDependency: it is not installed.
    """
    return _newton()[0].__version__


def _newton():
    try:
        import warp

        warp.config.log_level = warp.LOG_ERROR  # before Newton starts it: a line for every compiled kernel otherwise
        import newton
    except ImportError as error:
        sentence = f"simulating needs {error.name}, which is not installed: pip install 'ddakf[simulation]'"
        raise MissingDependency(sentence) from error
    return newton, warp
