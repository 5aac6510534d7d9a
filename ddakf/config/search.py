"""Configuration of the start and of the search for a garment without a track."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ddakf.config.checked import Checked, bounded
from ddakf.errors import InvalidConfig

# by the axis that points upward: rotation of the world to one in which y does
_TO_Y_UP = {
    "x": ((0, -1, 0), (1, 0, 0), (0, 0, 1)),
    "y": ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    "z": ((1, 0, 0), (0, 0, 1), (0, -1, 0)),
    "-x": ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    "-y": ((1, 0, 0), (0, -1, 0), (0, 0, -1)),
    "-z": ((1, 0, 0), (0, 0, -1), (0, 1, 0)),
}


@dataclass(frozen=True)
class Start(Checked):
    """Knowledge before the first frame."""

    sd: float = bounded(0.003, 1e-6, 10)  # m, of the start's position
    speed_sd: float = bounded(0.5, 1e-6, 100)  # m/s, of its velocity
    first_step: float = bounded(1.0 / 30.0, 1e-3, 10)  # s, assumed between the start and the first frame
    search: bool = True  # search for the garment when the first cloud, or the first after a loss, lies elsewhere
    least_points: int = bounded(100, 1, 1_000_000)  # points of a cloud that is searched
    up: str = "y"  # axis of the world that points upward: x, y, z, -x, -y (as in a camera's own axes) or -z

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.up not in list(_TO_Y_UP):  # a list: what is not hashable is not in it either
            raise InvalidConfig("Start.up", f"one of {', '.join(_TO_Y_UP)}", repr(self.up))

    @property
    def to_y_up(self) -> np.ndarray:
        """(3, 3) rotation of the world to one in which y points upward; its second row is the direction upward."""
        return np.array(_TO_Y_UP[self.up], float)


@dataclass(frozen=True)
class Relocalization(Checked):
    """Search for a garment without a track: rigid candidate poses, of which a non-rigid registration selects one."""

    search_interval: int = bounded(5, 1, 1000)  # frames between the first fruitless searches; then twice as many, up to 32 times
    shortest_gap: float = bounded(0.3, 0, 100)  # s: a longer pause, longer than the stream's usual one, starts a search
    gap_ratio: float = bounded(3.0, 1, 1000)  # such a pause over the last spacing of the frames, at least
    headings: int = bounded(8, 1, 32)  # initial headings, evenly spaced about the vertical
    rough_points: int = bounded(100, 10, 400)  # of the cloud, while all headings are aligned
    rough_vertices: int = bounded(300, 10, 1200)  # of the garment, likewise
    rough_reach: float = bounded(0.40, 0.01, 10)  # m, length of the longest soft correspondence, in the first step
    rough_steps: int = bounded(5, 1, 20)  # alignment steps of every heading; the reach shrinks in equal ratios to fine_reach
    finalists: int = bounded(4, 1, 16)  # headings that are aligned further
    fine_points: int = bounded(200, 10, 800)  # of the cloud, for the finalists
    fine_vertices: int = bounded(500, 10, 2000)  # of the garment, likewise
    fine_reach: float = bounded(0.15, 0.01, 10)  # m, reach of the finalists' first step
    fine_steps: int = bounded(4, 1, 16)  # alignment steps of a finalist
    last_reach: float = bounded(0.06, 0.01, 10)  # m, reach of the finalists' last step
    tangential_weight: float = bounded(0.05, 0, 1)  # of a finalist's goal across the normal; the rest counts along it
    longest_turn: float = bounded(0.5, 1e-3, 3.2)  # rad, in a step of a finalist
    balancing: int = bounded(1, 0, 8)  # rounds that scale soft correspondences towards one to one
    outlier_weight: float = bounded(0.1, 1e-3, 100)  # weight of a point's belonging to no vertex, in pairs
    cost_samples: int = bounded(250, 10, 600)  # points, and vertices, whose distance enters the cost after registration
    cost_vertices: int = bounded(2500, 10, 10_000)  # vertices to which the distance of a point is measured
    cost_density: int = bounded(20, 1, 80)  # points to which the distance of a vertex is measured, per cost_samples
    truncation: float = bounded(0.10, 0.01, 10)  # m: a longer distance counts as this one
    in_place_cost: float = bounded(0.015, 0, 1)  # m: a garment whose cost in place is lower is in its place
    partial_view_cost: float = bounded(0.015, 0, 1)  # m, of the first cloud alone, below which a start seen in part is right
    highest_cost: float = bounded(0.04, 0, 1)  # m: a cloud whose best cost is higher is of something else
    overturned_ratio: float = bounded(0.6, 0, 1)  # cost upside down over the cost upright, below which a cloud is upside down
    cost_ratio: float = bounded(0.8, 0, 1)  # best cost over the cost in place, at most
    off_body: float = bounded(0.05, 0, 10)  # m, mean distance from the body over that of the prediction, of a worn garment
    heading_separation: float = bounded(30.0, 0, 180)  # degrees between candidate poses, at least
    candidates: int = bounded(3, 1, 12)  # poses of each shape that are registered
    strain_cost: float = bounded(0.03, 0, 10)  # m per RMS strain of a registered candidate
    template_cost: float = bounded(0.05, 0, 10)  # share by which the template costs more than the last shape
    rigid_samples: float = bounded(60.0, 1e-3, 1e4)  # independent distances that the cost of a rigid pose is worth
    registered_samples: float = bounded(80.0, 1e-3, 1e4)  # the same after registration
    heading_sd: float = bounded(30.0, 0.1, 1e4)  # degrees, sd of the wearer's turn since the last frame
    heading_doubt: float = bounded(0.1, 0, 1)  # probability that the heading of a template that nobody has placed says nothing
    heading_rate: float = bounded(20.0, 0, 1e4)  # degrees/s by which heading_sd grows while the garment is out of sight
    rival_excess: float = bounded(0.07, 1e-6, 10)  # excess cost, over the best, at which another heading is e times less likely
    narrow_distance: float = bounded(0.08, 0, 1)  # m: in a larger cloud the part nearer to the garment is searched again; 0: none
    narrowed_cost: float = bounded(0.025, 0, 1)  # m: such a part whose cost is higher is of something else
    found_sd: float = bounded(0.03, 1e-4, 10)  # m, of the vertices of a relocalized garment
    settling_frames: int = bounded(4, 0, 30)  # frames after a search in which the garment is registered further
    settling_sd: float = bounded(0.01, 1e-4, 10)  # m, of a vertex after such a registration
    register_beyond: float = bounded(0.055, 0, 100)  # s between frames: beyond, predictions without a body may be registered


@dataclass(frozen=True)
class Registration(Checked):
    """Non-rigid registration: annealed soft correspondences move an as-rigid-as-possible graph of clusters."""

    steps: int = bounded(24, 1, 96)  # of the annealing
    iterations: int = bounded(4, 1, 16)  # local and global steps within a step
    first_reach: float = bounded(0.20, 0.01, 10)  # m, length of the longest soft correspondence, in the first step
    last_reach: float = bounded(0.04, 0.01, 10)  # m, in the last step
    settling_reach: float = bounded(0.30, 0.01, 10)  # m, in the first step of a garment that settles after a search
    first_stiffness: float = bounded(5.0, 1e-3, 1e3)  # weight of an edge of the graph against a cluster's data, first step
    last_stiffness: float = bounded(0.2, 1e-3, 1e3)  # last step, of a cloud from all sides
    one_sided_stiffness: float = bounded(3.0, 1e-3, 1e3)  # last step, of a cloud whose sensors are known
    balancing: int = bounded(2, 0, 8)  # rounds towards one to one, of a cloud from all sides; 0 where sensors are known
    outlier_weight: float = bounded(0.1, 1e-3, 100)  # weight of a point's belonging to no vertex, in pairs
    points: int = bounded(300, 10, 600)  # of the cloud that are paired, at least
    vertices: int = bounded(700, 10, 1400)  # of the garment that are paired, about
    decimation: int = bounded(1, 1, 10)  # factor by which fewer points and vertices are paired
    trial_steps: int = bounded(10, 1, 40)  # steps of the annealing that compares candidate poses
    trial_decimation: int = bounded(2, 1, 10)  # its decimation
    dense_points: int = bounded(3000, 100, 12_000)  # points that distances are measured to and normals fitted to, at most
    spacing: float = bounded(0.012, 1e-3, 1)  # m: a cloud is subsampled to one point in a cell of this size
    normal_radius: float = bounded(0.03, 1e-3, 1)  # m, neighbourhood of a point's normal
    input_points: int = bounded(30_000, 100, 120_000)  # points of a cloud that are used, at most
    sensors: int = bounded(8, 1, 32)  # sensors that are used, at most
    occluder_cell: float = bounded(1.5, 0.1, 10)  # edges between the paired vertices, as in stage B
    hidden_depth: float = bounded(0.03, 0, 100)  # m, as in stage B
    facing_cosine: float = bounded(0.1, -1, 1)  # as in stage B
    view_cell: float = bounded(0.03, 1e-3, 1)  # m, cell of the grids that find the outside of a cloud without sensors
    view_depth: float = bounded(0.02, 0, 1)  # m: a point farther behind the foremost of its cell is not seen

    def trial(self) -> Registration:
        """The shorter annealing of fewer vertices that compares candidate poses."""
        return replace(self, steps=self.trial_steps, decimation=self.trial_decimation)

    def settling(self) -> Registration:
        """The registration of a relocalized garment in the frames that follow."""
        return replace(self, first_reach=self.settling_reach)

    def catching_up(self) -> Registration:
        """The registration of a prediction that misses the cloud: as of a candidate pose, and as far as of a settling garment."""
        return replace(self.trial(), first_reach=self.settling_reach)
