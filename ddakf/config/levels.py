"""Configuration of the garment's subdivision, of the passes on its clusters, and of what a budget leaves out."""

from __future__ import annotations

from dataclasses import dataclass

from ddakf.config.checked import Checked, bounded


@dataclass(frozen=True)
class Discretisation(Checked):
    """Subdivision of a garment mesh into clusters, patches and aggregates."""

    clusters: int = bounded(80, 1, 160)  # most pieces that move rigidly in cluster alignment
    patches: int = bounded(48, 1, 128)  # most regions whose error covariance is carried from frame to frame
    aggregates: int = bounded(40, 1, 160)  # most groups of vertices, the coarse level of the solver's preconditioner
    cluster_vertices: int = bounded(8, 1, 10_000)  # vertices per cluster, at least, on average
    aggregate_vertices: int = bounded(32, 1, 10_000)  # vertices per aggregate, at least, on average
    followed_clusters: int = bounded(4, 1, 16)  # clusters whose motion a vertex blends
    cluster_samples: int = bounded(1200, 1, 10_000)  # vertices that cluster alignment measures
    probe_stride: int = bounded(4, 1, 1000)  # every so-many-th of these decides whether clusters are aligned at all
    working_edge: float = bounded(0.018, 0, 1)  # m, edges of the working mesh; 0: the template's vertices are tracked
    working_vertices_least: int = bounded(2500, 3, 100_000)  # least vertices; a small garment has shorter edges
    working_vertices_most: int = bounded(4000, 3, 100_000)  # most vertices; a large garment has longer edges
    working_finest: float = bounded(0.95, 0, 100)  # edges over the working ones from which an even template is tracked itself
    working_coarsest: float = bounded(2.6, 1, 1000)  # mean edge over the working ones, beyond which long edges are split to it
    working_unevenness: float = bounded(0.65, 0, 100)  # standard deviation of log vertex areas up to which a template is even
    correlation_length: float = bounded(0.2, 1e-3, 10)  # m, distance at rest over which patches move alike


@dataclass(frozen=True)
class Coarse(Checked):
    """Cluster alignment: passes in which clusters move rigidly, before all vertices move on their own."""

    iterations: int = bounded(4, 0, 50)  # most passes in a frame; 0: none
    tolerance: float = bounded(0.002, 0, 0.1)  # m, RMS step at which the passes stop
    least_innovation: float = bounded(0.008, 0, 10)  # m, RMS along the normals; below it the prediction is good enough
    least_cluster_innovation: float = bounded(0.015, 0, 10)  # m, the same of a cluster, as if one more vertex had none
    prior_sd: float = bounded(0.03, 1e-4, 10)  # m, of the prediction of a vertex 1/30 s ahead; in proportion to the time
    longest_prior_sd: float = bounded(0.1, 1e-4, 10)  # m, at most
    contact_sd: float = bounded(0.004, 1e-4, 10)  # m, of the body's surface that pushes a cluster out
    points: int = bounded(1200, 0, 100_000)  # points of the cloud, about, that pull the vertices nearest to them; 0: none
    points_weight: float = bounded(2.0, 0, 100)  # weight of all these points together over that of all vertices
    points_far: float = bounded(0.03, 0, 10)  # m from the nearest vertex, beyond which a point pulls across its normal too
    points_tangential_sd: float = bounded(0.01, 1e-4, 10)  # m, of such a far point across its normal


@dataclass(frozen=True)
class Omission(Checked):
    """Growth of the error (of its logarithm) by the work that a budget leaves out of a frame."""

    sparsest: float = bounded(1.0, 0.01, 100)  # points per vertex that thinning leaves at least
    points_growth: float = bounded(0.147, 0, 10)  # growth by each halving of the cloud
    clusters_growth: float = bounded(0.226, 0, 10)  # growth without cluster alignment
    passes_growth: float = bounded(0.1, 0, 10)  # growth without the passes at full size after the last one
