"""Configuration of the garment's subdivision, and of the passes on clusters and on decimated meshes."""

from __future__ import annotations

from dataclasses import dataclass

from ddakf.config.checked import Checked, bounded


@dataclass(frozen=True)
class Discretisation(Checked):
    """Subdivision of a garment mesh into clusters, patches, aggregates and levels."""

    clusters: int = bounded(80, 1, 160)  # at most: pieces that move rigidly in cluster alignment
    patches: int = bounded(48, 1, 128)  # at most: regions whose error covariance is carried from frame to frame
    aggregates: int = bounded(40, 1, 160)  # at most: groups of vertices, the coarse level of the solver's preconditioner
    cluster_vertices: int = bounded(8, 1, 10_000)  # vertices per cluster, at least, on average
    aggregate_vertices: int = bounded(32, 1, 10_000)  # vertices per aggregate, at least, on average
    followed_clusters: int = bounded(4, 1, 16)  # clusters whose motion a vertex blends
    cluster_samples: int = bounded(1200, 1, 10_000)  # vertices that cluster alignment measures
    probe_stride: int = bounded(4, 1, 1000)  # every so-many-th of these decides whether clusters are aligned at all
    level_vertices: int = bounded(250, 3, 1_000_000)  # vertices of the smallest level of the pyramid, at least
    correlation_length: float = bounded(0.2, 1e-3, 10)  # m, distance at rest over which patches move alike


@dataclass(frozen=True)
class Coarse(Checked):
    """Cluster alignment: passes in which clusters move rigidly, before all vertices move on their own."""

    iterations: int = bounded(2, 0, 50)  # at most in a frame; 0: none
    tolerance: float = bounded(0.002, 0, 0.1)  # m, RMS step at which the passes stop
    least_innovation: float = bounded(0.008, 0, 10)  # m, RMS along the normals; below it the prediction is good enough
    prior_sd: float = bounded(0.03, 1e-4, 10)  # m, of the prediction of a vertex
    contact_sd: float = bounded(0.004, 1e-4, 10)  # m, of the body's surface that pushes a cluster out


@dataclass(frozen=True)
class Pyramid(Checked):
    """Passes on decimated versions of the garment, whose physics is multiplied by these factors."""

    iterations: int = bounded(5, 0, 50)  # at most on each level; 0: none
    tolerance: float = bounded(0.001, 0, 0.1)  # m, RMS correction at which the passes of a level stop
    strain: float = bounded(0.5, 0, 1e3)  # on stretch and shear
    rest: float = bounded(1.5, 0, 1e3)  # on the rigidity to the rest shape
    motion: float = bounded(4.0, 0, 1e3)  # on the rigidity since the last frame
