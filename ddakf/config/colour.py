"""Configuration of colours, with stage B."""

from __future__ import annotations

from dataclasses import dataclass

from ddakf.config.checked import Checked, bounded


@dataclass(frozen=True)
class Colour(Checked):
    """Colours of the cloud as measurements along the surface, after Park, Zhou and Koltun 2017."""

    texel: float = bounded(0.016, 1e-3, 0.1)  # m, edge of the texels of a vertex's patch
    reach: float = bounded(0.020, 1e-4, 0.1)  # m, sd of a slide before the colours are compared, which explains residuals
    depth: float = bounded(0.012, 1e-3, 0.1)  # m from the cloud's plane, within which points belong to the same layer
    noise: float = bounded(0.1, 1e-3, 10)  # first guess of a chromaticity's sd, natural logarithm
    noise_memory: float = bounded(0.7, 0, 0.999)  # share of earlier frames in that variance
    least_gradient: float = bounded(1.6, 0, 1e3)  # information over that which noise alone would give, at least
    fused_sd: float = bounded(0.001, 1e-5, 1)  # m, of a registration, at least
    shared: float = bounded(0.5, 0, 100)  # of the vertices on a patch's area: as many times its variance is that of a slide
    start_sd: float = bounded(0.005, 0, 1)  # m: a start that is surer is where colours are learned, not the first frame's fit
    claimed_sd: float = bounded(0.003, 1e-5, 1)  # m, the same in the reported covariance
    memory: float = bounded(100.0, 1, 1e6)  # points of a texel, over which its colour is the mean
    learned_above: float = bounded(0.5, 0, 1)  # reliability of a frame whose colours are learned


@dataclass(frozen=True)
class Segmentation(Checked):
    """Colours that tell the garment's points from those of other things, such as skin and other clothes."""

    points: int = bounded(800, 0, 1_000_000)  # of a frame that teach colours, of as many others as well; 0: none is left out
    ratio: float = bounded(5.0, 1, 1e6)  # likelihoods, of other things to the garment, from which a point is left out
    least_points: float = bounded(200.0, 1, 1e6)  # learned of either, before any point is left out
    floor: float = bounded(1e-4, 1e-9, 1)  # likelihood of a colour that was not seen
    boundary_distance: float = bounded(0.02, 0, 10)  # m along the cloth: nearer to a boundary skin may be taken for cloth
    cloth_distance: float = bounded(0.015, 0, 1)  # m, beside half an edge: a point so near to another vertex is cloth
    other_distance: float = bounded(0.06, 0, 1)  # m: a point farther from all vertices is something else
    memory: float = bounded(2.0, 1e-3, 1e6)  # s, time constant of what is learned
    learned_above: float = bounded(0.3, 0, 1)  # reliability of a frame whose colours are learned
