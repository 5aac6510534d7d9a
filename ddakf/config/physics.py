"""Configuration of stage E: stiffness of the cloth, body contact, rigidity."""

from __future__ import annotations

from dataclasses import dataclass, field

from ddakf.config.checked import Checked, bounded
from ddakf.errors import InvalidConfig, shown
from ddakf.physics.fabric import Fabric


@dataclass(frozen=True)
class Physics(Checked):
    """Stiffness of the pseudo-measurements: information is lambda k w, and lambda is 1 outside recovery."""

    stretch: float = bounded(6.0e5, 0, 1e12)  # 1/m^2 per unit strain^2
    shear: float = bounded(6.0e5, 0, 1e12)  # 1/m^2
    strain_scale: float = bounded(0.1, 1e-3, 1e3)  # of stretch: a larger strain counts as an error of the model
    strain_sd: float = bounded(0.03, 1e-4, 1e3)  # strain of a typical face, above which stretch and shear soften
    strain_memory: float = bounded(0.08, 1e-3, 1e3)  # s, time constant with which the garment's own strain is learned
    softest: float = bounded(0.02, 1e-3, 1)  # share of the stiffness that softening leaves, at least
    strain_coverage: float = bounded(0.5, 0, 1)  # share of the faces that must be measured before strain is learned
    longest_lesson: float = bounded(0.1, 0, 10)  # s that one frame counts for, at most, when strain is learned
    size_memory: float = bounded(0.08, 0, 1e3)  # s, time constant of the garment's size; 0: the template's size is right
    size_slack: float = bounded(0.005, 0, 1)  # mean strain that cloth may show at its size
    size_slack_across: float = bounded(0.008, 0, 1)  # the same of the difference between directions
    size_coverage: float = bounded(0.15, 0, 1)  # share of the edges that must be measured before the size is learned
    size_doubt: float = bounded(2.0, 1, 100)  # times as much mean strain is no size while the garment has its template's
    size_start: float = bounded(0.02, 0, 1)  # mean strain from which on a start is of another size than the template
    size_most: float = bounded(0.2, 0, 10)  # largest growth of lengths; and the same in shrinking, of its inverse
    bend: float = bounded(0.002, 0, 1e12)  # 1/rad^2
    bend_height: float = bounded(0.1, 1e-3, 1)  # share of a face's rest height below which bending forces stop growing
    collision: float = bounded(3.0e9, 0, 1e15)  # 1/m^4
    thickness: float = bounded(0.003, 0, 0.1)  # m, distance from the body that collision enforces
    deepest_gap: float = bounded(0.03, 0, 1)  # m: a vertex less deep inside the body shows an error of the body model
    collision_reach: float = bounded(0.05, 1e-3, 1)  # m, depth from which a body that does not carry pushes vertices out
    body_sd: float = bounded(0.006, 0, 1)  # m, first guess of the error of the body's surface, by which contact yields
    gap_time: float = bounded(0.5, 0, 1e3)  # s, time constant of the distance where cloth is seen deeper; 0: constant distance
    floor_below: float = bounded(0.1, 0, 10)  # m under the garment, where the body ends at the start, if it stands on a floor
    floor_sd: float = bounded(0.02, 0, 10)  # m, of the floor's height, by which it yields
    faces_followed: int = bounded(16, 1, 1000)  # frames in which each vertex's nearest face is sought in the whole body once
    weight: float = bounded(9.0e3, 0, 1e12)  # 1/m^3: weight of cloth that the body holds, force per area
    inertia: float = bounded(0.5, 0, 1)  # share of the body's acceleration that leaves its cloth behind
    strongest_inertia: float = bounded(3.0, 0, 100)  # times gravity: the body's acceleration counts up to here
    pressed_within: float = bounded(0.03, 1e-4, 1)  # m from the body at which cloth is pressed on it by half of its weight
    carrying_share: float = bounded(0.1, 1e-4, 1)  # of the garment that lies on upward surface of the body: it carries it all
    self_collision: float = bounded(0.0, 0, 1e15)  # 1/m^4 between layers of the garment
    layer_reach: float = bounded(1.0, 0.01, 10)  # mean edge lengths within which a vertex of another layer is sought
    layer_separation: float = bounded(3.0, 0.01, 100)  # mean edge lengths: vertices closer at rest are of one layer
    motion_rigidity: float = bounded(1.5e4, 0, 1e12)  # 1/m^2 per edge: change since the last frame is locally rigid
    motion_time: float = bounded(1.0 / 30.0, 1e-3, 10)  # s: change over a longer time is less rigid in proportion
    rest_rigidity: float = bounded(3.0e3, 0, 1e12)  # 1/m^2 per edge: shape is locally that of the start, or of the template
    coarse_edge: float = bounded(0.02, 1e-4, 10)  # m: a mesh with longer edges bends as easily as one with such edges
    coarse_share: float = bounded(0.5, 0.01, 1)  # of both rigidities, that such a mesh has at least
    hidden_edge: float = bounded(0.029, 0, 1)  # m: hidden cloth of a finer mesh is as rigid as in one with such edges; 0: no more
    uneven_rigidity: float = bounded(2.0e5, 0, 1e12)  # 1/m^2 per edge: rest_rigidity of a garment whose stretch has softened
    start_strain: float = bounded(0.1, 1e-3, 1e3)  # of a one-ring at the start, whose rest shape is then half the template's
    start_strain_kept: float = bounded(0.4, 0, 1)  # share of a face's strain at the start that is at rest
    strain_followed: float = bounded(0.95, 0, 0.99)  # share of a one-ring's strain that its rest shape then follows
    rotation_steps: int = bounded(2, 1, 50)  # steps of a rotation fit, which starts from the last pass's rotations
    first_rotation_steps: int = bounded(4, 1, 50)  # the same in the first pass, to which other passes moved the garment
    fabric: Fabric = field(default_factory=lambda: Fabric.NORMALISED)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not isinstance(self.fabric, Fabric):
            raise InvalidConfig("Physics.fabric", "a ddakf.Fabric (Fabric.named finds one by name)", shown(self.fabric))

    @property
    def in_plane(self) -> float:
        """Stiffness of both stretch and shear, 1/m^2, of the fabric: their mean.

        They differ by the direction of the threads, of which a template says nothing. With one stiffness for both no choice of
        direction, such as each face's first edge, changes the energy.
        """
        return 0.5 * (self.stretch * self.fabric.stretch + self.shear * self.fabric.shear)
