"""Reference tables of the documents, written from the code: ``python benchmarks/reference.py``; ``--check`` only compares.

A table stands between ``<!-- NAME: begin -->`` and ``<!-- NAME: end -->``. Values, units and meanings come from the code
and its comments. The reason for a default is in the field's comment, after "; tuned", "; chosen" or "; fitted", or in REASONS.
``--constants`` prints the numbers of the core that are module constants, with their comments.
"""

from __future__ import annotations

import argparse
import ast
import csv
import dataclasses
import inspect
import io
import math
import re
import sys
import textwrap
import tokenize
import typing
from collections.abc import Callable, Iterator
from pathlib import Path

from ddakf_api.errors import ERRORS
from ddakf_service.observability.metrics import Metrics
from ddakf_service.settings import ENV_PREFIX, Settings
from prometheus_client.metrics import MetricWrapperBase

from ddakf import Config
from ddakf.physics.fabric import PRESETS, Fabric
from ddakf.stages.robust import gate_threshold

DOCS = Path(__file__).resolve().parents[1] / "docs"
CORE = DOCS.parent / "ddakf"

STAGE_OF = {
    "start": "start",
    "relocalization": "start",
    "registration": "start",
    "discretisation": "garment",
    "predict": "A",
    "preprocess": "preprocessing",
    "skin_removal": "preprocessing",
    "coarse": "cluster alignment",
    "pyramid": "pyramid",
    "associate": "B",
    "robust": "C",
    "adapt": "D",
    "physics": "E",
    "fuse": "F",
    "reliability": "G",
    "uncertainty": "F",
    "evidence": "G",
    "frame_error": "G",
    "vertex_error": "G",
}

# Reason for a default. "tuned": by measurement on the sample and the recordings; "chosen": by judgement, without a fit.
# A field of the same name in another variant of the stage shares its reason.
REASONS = {
    "Start.sd": "chosen: accuracy of a caller's placement; not in the paper",
    "Start.speed_sd": "chosen; not in the paper",
    "Start.search": "the paper starts at the truth",
    "Start.least_points": "chosen: fewer points fix no heading",
    "Start.first_step": "chosen: 30 frames per second",
    "Discretisation.clusters": "chosen: their equations, six unknowns each, are still solved exactly",
    "Discretisation.patches": "chosen: the covariance of their error costs the cube of their number",
    "Discretisation.aggregates": "chosen: a coarse matrix of 120 rows, inverted in every frame",
    "Discretisation.cluster_vertices": "chosen: a rigid motion of six unknowns needs several vertices",
    "Discretisation.aggregate_vertices": "chosen: smaller aggregates come near the fine level itself",
    "Discretisation.followed_clusters": "chosen: neighbouring clusters blend without jumps",
    "Discretisation.cluster_samples": "chosen: some fifteen for the six unknowns of a cluster",
    "Discretisation.probe_stride": "chosen: 300 vertices tell whether the prediction is good",
    "Discretisation.level_vertices": "chosen: clusters already move fewer vertices than that",
    "Discretisation.correlation_length": "chosen: near parts move alike",
    "ConstantVelocity.damping": "tuned: unseen vertices do not run on; the paper has 0",
    "ConstantVelocity.acceleration": "tuned; the paper leaves Q open",
    "ConstantVelocity.carry_reach": "chosen: loose cloth moves with the body; the paper has no body",
    "ConstantVelocity.longest_step": "chosen: after a longer gap the motion is unknown",
    "ConstantVelocity.worn_memory": "tuned: ten frames; a third of it gives the same",
    "ConstantVelocity.worn_sd": "chosen: amplitude of swinging cloth; a weak first guess",
    "ConstantVelocity.anchor_reach": "chosen",
    "ConstantVelocity.anchor_least_sd": "chosen: no garment follows its body more exactly",
    "ConstantVelocity.anchor_first_share": "chosen: a first guess counts for little",
    "ConstantVelocity.anchor_normal_samples": "chosen",
    "ConstantVelocity.anchor_tangential_samples": "chosen: cloth slips over lengths longer than a patch",
    "ConstantAcceleration.share": "tuned: 1 overshoots, because every estimate is late",
    "ConstantAcceleration.memory": "tuned: three frames",
    "GridFilter.points_per_cell": "tuned: enough for a plane, small enough to be local",
    "GridFilter.suspect_share": "tuned against k-NN statistics (16, 2): `make bench`, part outliers",
    "GridFilter.sample": "enough for the mean of the dense part; suspects give the spread",
    "GridFilter.plane_radius": "the 27 cells contain all these points",
    "GridFilter.planes_per_vertex": "tuned on the shipped recordings; bounds the time; a wide plane misses curvature",
    "GridFilter.clean_factor": "chosen: the sparser parts of a clean cloud are no outliers",
    "GridFilter.suspect_rings": "chosen: farther neighbours change nothing",
    "KnnFilter.neighbours": "the paper leaves k open",
    "KnnFilter.ratio": "the paper leaves it open; (16, 2) is Open3D's usual pair",
    "KnnFilter.points_per_cell": "as in GridFilter; only the time depends on it",
    "Coarse.iterations": "tuned: the second still gains, a third does not",
    "Coarse.tolerance": "tuned",
    "Coarse.least_innovation": "tuned: noise and calm motion leave about 3 mm",
    "Coarse.prior_sd": "tuned: prediction error of fast motion",
    "Coarse.contact_sd": "chosen: error of a body model's surface",
    "Pyramid.iterations": "tuned: more gain nothing",
    "Pyramid.tolerance": "chosen: later passes correct that much",
    "Pyramid.strain": "tuned: edges of 3 to 6 cm span wrinkles, and shrink and stretch by them",
    "Pyramid.rest": "tuned: replaces part of the strain's stiffness",
    "Pyramid.motion": "tuned: between two frames an edge's length changes little",
    "PlaneAssociation.iterations": "tuned: limit for fast frames; calm ones stop earlier",
    "PlaneAssociation.least_iterations": "one pass cannot tell whether the frame is calm",
    "PlaneAssociation.tolerance": "chosen: a quarter of 3 mm of sensor noise",
    "PlaneAssociation.wide_gate": "chosen: well above the motion between two frames",
    "PlaneAssociation.narrow_gate": "tuned: a sleeve does not take the torso's points",
    "PlaneAssociation.narrowing": "tuned",
    "PlaneAssociation.still": "a new search would find the same plane",
    "PlaneAssociation.beside": "tuned: a plane reaches about one spacing beyond its points",
    "PlaneAssociation.normal_cosine": "chosen, 60 degrees: front and back never match",
    "PlaneAssociation.turned": "tuned: about an edge",
    "PlaneAssociation.facing_cosine": "tuned, 78 degrees: planes seen edge-on are poor and pull the surface along itself",
    "PlaneAssociation.hidden_depth": "chosen: above noise and cloth thickness, below an arm",
    "PlaneAssociation.hem_reach": "tuned: farther than cloth slips, nearer than the next hem",
    "PlaneAssociation.hem_sd": "tuned: half the point spacing of a depth camera at 2 m",
    "PlaneAssociation.tangential_sd": "tuned: about an edge",
    "PlaneAssociation.occluder_cell": "chosen: wide enough for a closed surface",
    "PlaneAssociation.hem_width": "chosen: one distance of the points to either side",
    "PlaneAssociation.hem_depth": "chosen: less than the distance of two layers",
    "NearestPoint.gate": "the paper has none; equals wide_gate",
    "Tukey.cutoff": "95 % Gaussian efficiency (Holland and Welsch 1977); the paper leaves it open",
    "Tukey.gate_probability": "the paper's tau as a quantile, valid for any dimension",
    "InnovationNoise.alpha": "the paper leaves it open; a memory of ten frames",
    "InnovationNoise.epsilon": "the paper leaves it open; 1 mm²",
    "InnovationNoise.lowest_sd": "chosen: below a depth camera's noise; the paper gives no value",
    "InnovationNoise.highest_sd": "chosen; the paper gives no value",
    "InnovationNoise.initial_sd": "chosen: near a depth camera's noise",
    "ResidualNoise.lowest_sd": "chosen: neighbouring planes share their error",
    "Physics.stretch": "tuned: soft enough for reconstructions that stretch; the paper leaves all weights open",
    "Physics.shear": "tuned: cloth shears more easily than it stretches",
    "Physics.strain_scale": "tuned: bounds the force where the template is wrong",
    "Physics.strain_sd": "tuned: above simulated garments' strain, below that of a dress that stretches",
    "Physics.strain_memory": "tuned: two or three frames; a median over thousands of faces needs little smoothing",
    "Physics.bend": "tuned: keeps folds",
    "Physics.bend_height": "chosen: the gradient grows as 1 / height and would explode on collapsed faces",
    "Physics.collision": "tuned: mean penetration below 0.1 mm; ten times stiffer makes tight garments stick",
    "Physics.thickness": "chosen",
    "Physics.self_collision": "off: it preserves crossings where the estimate is wrong",
    "Physics.gap_time": "chosen: about fifteen frames, so that no single one decides",
    "Physics.motion_rigidity": "tuned",
    "Physics.rest_rigidity": "tuned: more supports a loose skirt, but lifts a hidden half off its body",
    "Physics.uneven_rigidity": "tuned: prevents crumpling of soft cloth",
    "Physics.strain_followed": "tuned: the rest stops an even strain from wandering",
    "Physics.fabric": "the paper's single normalised setting (section 2.4)",
    "Physics.softest": "chosen: some stiffness is always left",
    "Physics.strain_coverage": "chosen: a median over fewer faces says little about the garment",
    "Physics.longest_lesson": "chosen: three frames at 30 per second",
    "Physics.deepest_gap": "chosen: error of a body model",
    "Physics.collision_reach": "chosen: more than deepest_gap",
    "Physics.layer_reach": "chosen: layers touch within an edge",
    "Physics.layer_separation": "chosen: beyond the one-ring of a one-ring",
    "Physics.rotation_steps": "chosen: later passes correct the rest",
    "Physics.first_rotation_steps": "chosen: the prediction and other levels have moved the garment",
    "MapUpdate.solver_iterations": "tuned for time: the next pass corrects the remainder",
    "MapUpdate.solver_tolerance": "share of the force's norm, later twice that; the next pass corrects the remainder",
    "MapUpdate.prior_sd": "tuned: neighbours share the prediction's error",
    "MapUpdate.later_tolerance": "chosen: later corrections are a few times smaller",
    "MapUpdate.longest_secant": "chosen: a longer extrapolation overshoots",
    "DecoupledUpdate.longest_correction": "chosen: the paper does not treat crumpled cloth",
    "Reliability.half_error": "chosen",
    "Reliability.recovery_below": "chosen",
    "Reliability.recovery_above": "chosen, above recovery_below: hysteresis",
    "Reliability.recovery_lambda": "the paper raises lambda; measured, that drives a stretched garment off its template",
    "Reliability.doubt_below": "chosen: a predicted error above 10 cm",
    "Reliability.lost_coverage": "chosen: so few measurements fix nothing",
    "Reliability.lost_after": "chosen: 15 frames at 30 per second",
    "Reliability.lost_after_empty": "chosen: without points the fit is unknown, not bad",
    "Reliability.longest_frame": "chosen: nine frames at 30 per second",
    "PaperReliability.threshold": "below exp(-1), see stage G; the paper leaves tau open",
    "PaperReliability.recovery_lambda": "the paper leaves it open",
    "Uncertainty.observed_scale": "fitted on half of the recordings: python benchmarks/calibration.py --fit",
    "Uncertainty.unseen_scale": "fitted likewise",
    "Uncertainty.strain_reach": "chosen: slid cloth is strained by about its error over that length",
    "Uncertainty.floor_sd": "chosen",
    "Uncertainty.ceiling_sd": "chosen: the bound of section 2.7",
    "Uncertainty.ceiling_speed_sd": "chosen: the bound of section 2.7",
    "Uncertainty.missed_share": "chosen",
    "Uncertainty.unseen_motion": "chosen",
    "Uncertainty.plane_persistence": "chosen: plane fits of neighbouring frames share their error",
    "Uncertainty.vertex_share": "chosen",
    "Uncertainty.growth_sd": "chosen",
    "Uncertainty.least_information": "chosen: 10 cm for a free patch",
    "Uncertainty.innovation_memory": "chosen: about three frames",
    "Uncertainty.offset_ratio": "chosen: error over the cloud's offset",
    "Uncertainty.least_offset": "chosen: below any sensor's noise",
    "Uncertainty.offset_trust": "chosen: the mean of both is better than either",
    "Uncertainty.body_room": "chosen",
    "Uncertainty.most_body_room": "chosen: the reach of carry_reach",
    "Uncertainty.usual_slack": "chosen",
    "Uncertainty.cloth_room": "chosen: as far as patches move alike",
    "Uncertainty.most_cloth_room": "chosen",
    "Uncertainty.least_bend": "chosen: flatness of a patch",
    "Uncertainty.least_coverage": "chosen: fewer vertices say nothing about the garment",
    "Relocalization.search_interval": "chosen: a stream of nonsense must not stall",
    "Relocalization.shortest_gap": "chosen: nine frames at 30 per second",
    "Relocalization.gap_ratio": "chosen: a slow stream has no gap",
    "Relocalization.headings": "chosen: 45 degrees apart, within reach of the alignment",
    "Relocalization.rough_points": "chosen for time",
    "Relocalization.rough_vertices": "chosen for time",
    "Relocalization.rough_reach": "chosen: of the order of a garment",
    "Relocalization.rough_steps": "chosen for time",
    "Relocalization.finalists": "chosen: half of the headings",
    "Relocalization.fine_points": "chosen for time",
    "Relocalization.fine_vertices": "chosen for time",
    "Relocalization.fine_reach": "chosen: of the order of a sleeve",
    "Relocalization.fine_steps": "chosen for time",
    "Relocalization.last_reach": "chosen: registration continues from there",
    "Relocalization.tangential_weight": "chosen: the heading of nearly round cloth converges sooner along the normals",
    "Relocalization.longest_turn": "chosen: a linearised turn holds no further",
    "Relocalization.balancing": "chosen: a rigid garment needs fewer rounds than a bent one",
    "Relocalization.outlier_weight": "chosen: a tenth of a pair",
    "Relocalization.cost_samples": "chosen for time",
    "Relocalization.cost_vertices": "chosen for time",
    "Relocalization.cost_density": "chosen: distances are to the surface and not to its samples",
    "Relocalization.truncation": "chosen: a farther point tells no more",
    "Relocalization.in_place_cost": "chosen: above the cost of a garment in its place",
    "Relocalization.partial_view_cost": "chosen: above the cost of a start in its place",
    "Relocalization.highest_cost": "chosen: below the cost of something else",
    "Relocalization.cost_ratio": "chosen: a search must clearly gain",
    "Relocalization.heading_separation": "chosen: registration reaches nearer headings",
    "Relocalization.candidates": "chosen for time",
    "Relocalization.strain_cost": "chosen: only a distorted garment fits the wrong heading",
    "Relocalization.template_cost": "chosen: the last shape wins where both fit",
    "Relocalization.rigid_samples": "chosen: neighbouring distances share their error",
    "Relocalization.registered_samples": "chosen: registration leaves errors that are more independent",
    "Relocalization.heading_sd": "chosen: a turn of the wearer between two frames that are tracked",
    "Relocalization.heading_rate": "chosen: a wearer out of sight turns slowly",
    "Relocalization.found_sd": "chosen: error of a registered garment",
    "Relocalization.settling_frames": "chosen: registration and fit need a few frames",
    "Relocalization.settling_sd": "chosen",
    "Registration.steps": "chosen: slow enough for an annealing",
    "Registration.iterations": "chosen: later steps correct the rest",
    "Registration.first_reach": "chosen: of the order of a sleeve",
    "Registration.last_reach": "chosen: the association's gate continues from there",
    "Registration.settling_reach": "chosen: a bent limb may lie far from its place",
    "Registration.first_stiffness": "chosen: almost rigid",
    "Registration.last_stiffness": "chosen: the data decide",
    "Registration.one_sided_stiffness": "chosen: the unseen side follows the seen one",
    "Registration.balancing": "chosen: every part of the cloud finds its part of the garment",
    "Registration.outlier_weight": "chosen: a tenth of a pair",
    "Registration.points": "chosen for time",
    "Registration.vertices": "chosen for time",
    "Registration.decimation": "1: all of them",
    "Registration.trial_steps": "chosen for time: a trial only ranks the candidates",
    "Registration.trial_decimation": "chosen for time",
    "Registration.dense_points": "chosen for time",
    "Registration.spacing": "chosen: denser points share their error",
    "Registration.normal_radius": "chosen: some twenty points at the spacing",
    "Registration.input_points": "chosen for time",
    "Registration.sensors": "chosen for time",
    "Registration.occluder_cell": "as in stage B",
    "Registration.hidden_depth": "chosen: more than in stage B, as the garment is not in its place yet",
    "Registration.facing_cosine": "chosen: less than in stage B, as normals are less exact",
    "Registration.view_cell": "chosen: wider than the distance of the points",
    "Registration.view_depth": "chosen: thickness of a surface seen at a slant",
    "SkinRemoval.skin_distance": "chosen: three standard deviations of a sensor's noise",
    "SkinRemoval.cloth_distance": "chosen",
    "SkinRemoval.hem_distance": "chosen: well above hem_reach",
    "SkinRemoval.edge_share": "chosen: points within a face are up to 0.58 edges from its corners",
    "SkinRemoval.person_share": "chosen",
    "ErrorEvidence.points": "chosen for time",
    "ErrorEvidence.reach": "chosen: the first gate of stage B",
    "ErrorEvidence.foreign_share": "chosen: above the share of stray points",
    "ErrorEvidence.unexplained_distance": "chosen: above noise and the error of a good fit",
    "ErrorEvidence.unexplained_edges": "chosen: points within a face of long edges are explained",
    "ErrorEvidence.clump_points": "chosen: stray points are alone",
    "ErrorEvidence.clump_size": "chosen: of the order of a limb",
    "ErrorEvidence.memory": "chosen: 15 frames at 30 per second",
    "ErrorEvidence.free_clearance": "chosen: such cloth touches no body",
    "FrameError.base": "fitted: python benchmarks/reliability.py --fit",
    "FrameError.offset_scale": "chosen: less than that says nothing",
    "FrameError.offset_power": "fitted, as base",
    "FrameError.unmatched_scale": "chosen: less than that says nothing",
    "FrameError.unmatched_power": "fitted, as base",
    "FrameError.unexplained_scale": "chosen: less than that says nothing",
    "FrameError.unexplained_power": "fitted, as base",
    "FrameError.uncertainty_scale": "chosen: less than that says nothing",
    "FrameError.uncertainty_power": "fitted, as base",
    "FrameError.strain_scale": "chosen: less than that says nothing",
    "FrameError.strain_power": "fitted, as base",
    "FrameError.hem_scale": "chosen: less than that says nothing",
    "FrameError.hem_power": "fitted, as base",
    "VertexError.base": "1: relative to the frame",
    "VertexError.variance_scale": "chosen: less than that says nothing",
    "VertexError.variance_power": "fitted: python benchmarks/reliability.py --fit",
    "VertexError.unmeasured_scale": "chosen: less than that says nothing",
    "VertexError.unmeasured_power": "fitted: python benchmarks/reliability.py --fit",
    "VertexError.strain_scale": "chosen: less than that says nothing",
    "VertexError.strain_power": "fitted: python benchmarks/reliability.py --fit",
    "VertexError.clearance_scale": "chosen: less than that says nothing",
    "VertexError.clearance_power": "fitted: python benchmarks/reliability.py --fit",
}


def fields() -> str:
    """Every field of every stage's configuration as comma-separated values; of a variant that extends another, its own fields."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(("stage", "field", "default", "paper", "least", "most", "unit, meaning", "reason"))
    printed = _values(Config.paper())
    for stage, variants in _variants().items():
        for variant in variants:
            base = next((other for other in variants if other in variant.__mro__[1:]), None)
            inherited = {field.name for field in dataclasses.fields(base)} if base else set()
            comments = _comments(variant)
            for field in (field for field in dataclasses.fields(variant) if field.name not in inherited):
                name, value = f"{variant.__name__}.{field.name}", _shown(getattr(variant(), field.name))
                bounds = (_shown(bound) for bound in field.metadata.get("range", ("", "")))
                meaning, *given = re.split(r"; (?=(?:tuned|chosen|fitted)\b)", comments.get(field.name, ""), maxsplit=1)
                reason = given[0] if given else _reason(variant, field.name, variants)
                rows.writerow((_stage_name(stage), name, value, printed.get(name, ""), *bounds, meaning, reason))
    return out.getvalue()


def _values(config) -> dict[str, str]:
    """Values of a configuration and of its stages by ``Class.field``."""
    values = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        values[f"{type(config).__name__}.{field.name}"] = _shown(value)
        if dataclasses.is_dataclass(value) and not isinstance(value, Fabric):
            values |= _values(value)
    return values


def _reason(variant: type, name: str, variants: tuple[type, ...]) -> str:
    """Reason for a default, its own or that of the stage's other variant; empty where none is given."""
    sharing = [variant, *(other for other in variants if hasattr(other, name))]
    found = (other.__name__ for other in sharing if f"{other.__name__}.{name}" in REASONS)
    first = next(found, None)
    if first is None or first == variant.__name__:
        return REASONS.get(f"{first}.{name}", "")
    return f"as {first}"


def derived_table() -> str:
    """Numbers that follow from the configuration."""
    config, paper = Config(), Config.paper()
    limits = config.uncertainty
    rows = [
        ("trace(P_pp) and trace(covariance), at most", f"{3 * limits.ceiling_sd**2:g} m²", "3 ceiling_sd²"),
        ("trace(P_uu), at most", f"{3 * limits.ceiling_speed_sd**2:g} m²/s²", "3 ceiling_speed_sd²"),
        ("sigma, at most", f"{limits.ceiling_sd:g} m", "ceiling_sd"),
        (
            "R along the normal, default",
            f"{1e6 * config.adapt.lowest_sd**2:g} to {1e6 * config.adapt.highest_sd**2:g} mm²",
            "lowest_sd², highest_sd²",
        ),
        (
            "eigenvalues of R, paper",
            f"{1e6 * paper.adapt.lowest_sd**2:g} to {1e6 * paper.adapt.highest_sd**2:g} mm²",
            "lowest_sd², highest_sd²",
        ),
        (
            "tau (2.5), gate on d²: default, paper",
            f"{gate_threshold(config.robust.gate_probability, 1):.2f}, {gate_threshold(paper.robust.gate_probability, 3):.2f}",
            "gate_probability, chi-square with 1, 3 degrees of freedom",
        ),
        ("s_k in the steady state", f"{math.exp(-1):.3f}", "exp(-1)"),
        (
            "s_k, at least, without gating and clamping of R",
            f"{math.exp(-1 / (1 - paper.adapt.alpha)):.2g}",
            "exp(-1 / (1 - alpha))",
        ),
        (
            "frames until half of R is new",
            f"{math.log(0.5) / math.log(config.adapt.alpha):.1f}",
            "log(1/2) / log(alpha)",
        ),
    ]
    lines = ["| quantity | value | from |", "|---|---|---|"]
    return "\n".join([*lines, *(f"| {name} | {value} | {source} |" for name, value, source in rows)])


def fabrics_table() -> str:
    """The fabric presets."""
    names = [field.name for field in dataclasses.fields(Fabric)]
    lines = [f"| fabric | {' | '.join(names)} |", "|---|" + "---|" * len(names)]
    for name, fabric in PRESETS.items():
        lines.append(f"| `{name}` | {' | '.join(f'{getattr(fabric, n):g}' for n in names)} |")
    return "\n".join(lines)


# Settings whose default depends on the machine.
_MADE_DEFAULTS = {
    "workers": "cores, at most 4",
    "data_dir": "`$XDG_STATE_HOME/ddakf` or `~/.local/state/ddakf`",
    "server_id": "host name",
}


def settings_table() -> str:
    """Settings of the service."""
    lines = ["| environment | default | meaning |", "|---|---|---|"]
    for name, field in Settings.model_fields.items():
        default = _MADE_DEFAULTS[name] if field.default_factory else "none" if field.default == () else field.default
        lines.append(f"| `{ENV_PREFIX}{name.upper()}` | {default} | {field.description} |")
    return "\n".join(lines)


def metrics_table() -> str:
    """What /metrics exports."""
    lines = ["| metric | type | labels | meaning |", "|---|---|---|---|"]
    metrics = [value for value in vars(Metrics()).values() if isinstance(value, MetricWrapperBase)]
    for metric in (metric for metric in metrics if not metric._labelvalues):  # the others are a metric with a label of its own
        family = next(iter(metric.describe()))
        name = f"{family.name}_total" if family.type == "counter" else family.name
        lines.append(f"| `{name}` | {family.type} | {', '.join(metric._labelnames)} | {family.documentation} |")
    return "\n".join(lines)


def errors_table() -> str:
    """Every error with its codes."""
    lines = ["| name | gRPC | HTTP | try again | meaning |", "|---|---|---|---|---|"]
    for name, error in ERRORS.items():
        again = "yes" if error.retryable else "no"
        meaning = " ".join(inspect.getdoc(error).split())
        lines.append(f"| `{name}` | {error.status.name} | {error.http_status} | {again} | {meaning} |")
    return "\n".join(lines)


TABLES: dict[str, tuple[str, Callable[[], str]]] = {
    "derived": ("configuration.md", derived_table),
    "fabrics": ("configuration.md", fabrics_table),
    "settings": ("operations.md", settings_table),
    "metrics": ("operations.md", metrics_table),
    "errors": ("operations.md", errors_table),
}


def documents() -> dict[str, str]:
    """Text of every document with tables, and of the list of fields, as the code has them now."""
    return {document: fresh(document) for document in sorted({where for where, _ in TABLES.values()})} | {"fields.csv": fields()}


def fresh(document: str) -> str:
    """A document with its tables as the code has them now."""
    text = (DOCS / document).read_text()
    for name, (where, table) in TABLES.items():
        if where != document:
            continue
        begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
        head, found, rest = text.partition(begin)
        if not found or end not in rest:
            raise SystemExit(f"{document}: the table between '{begin}' and '{end}' is missing")
        text = f"{head}{begin}\n{table()}\n{end}{rest.partition(end)[2]}"
    return text


def problems() -> list[str]:
    """Differences between documents and code, one sentence each."""
    classes = [variant for variants in _variants().values() for variant in variants]
    known = {f"{variant.__name__}.{field.name}" for variant in classes for field in dataclasses.fields(variant)}
    found = [f"{name} in benchmarks/reference.py is no field of the configuration" for name in sorted(set(REASONS) - known)]
    rows = csv.DictReader(io.StringIO(fields()))
    found += [f"{row['field']} has no reason: end its comment with one, '; chosen: ...'" for row in rows if not row["reason"]]
    for document, text in documents().items():
        if not (DOCS / document).is_file() or text != (DOCS / document).read_text():
            found.append(f"docs/{document} differs from the code: run python benchmarks/reference.py")
    return found


def constants() -> list[tuple[str, str, str, str]]:
    """Module constants of the core that hold numbers: module, name, value, comment."""
    found = []
    for path in sorted(CORE.rglob("*.py")):
        module = str(path.relative_to(CORE.parent))
        if module.startswith(("ddakf/evaluation", "ddakf/data", "ddakf/commands")):
            continue
        source = path.read_text()
        beside, above = _line_comments(source)
        for name, value, first, last in _assignments(ast.parse(source)):
            if name.isupper() and any(isinstance(n, ast.Constant) and type(n.value) in (int, float) for n in ast.walk(value)):
                found.append((module, name, ast.unparse(value), beside.get(last) or above.get(first, "")))
    return found


def _variants() -> dict[str, tuple[type, ...]]:
    """The configuration classes of each stage, the default first, each followed by the classes of its fields."""
    hints = typing.get_type_hints(Config)
    variants = {name: typing.get_args(hint) or (hint,) for name, hint in hints.items()}
    return {name: tuple(c for variant in classes for c in (variant, *_nested(variant))) for name, classes in variants.items()}


def _nested(variant: type) -> list[type]:
    values = (getattr(variant(), field.name) for field in dataclasses.fields(variant))
    return [type(value) for value in values if dataclasses.is_dataclass(value) and not isinstance(value, Fabric)]


def _comments(variant: type) -> dict[str, str]:
    """Comments of the fields, beside or above them."""
    found = {}
    for base in (base for base in variant.__mro__[::-1] if dataclasses.is_dataclass(base)):
        source = textwrap.dedent(inspect.getsource(base))
        beside, above = _line_comments(source)
        for name, _, first, last in _assignments(ast.parse(source).body[0]):
            found[name] = beside.get(last) or above.get(first, "")
    return found


def _assignments(scope: ast.Module | ast.ClassDef) -> Iterator[tuple[str, ast.expr, int, int]]:
    """Names assigned in a scope: name, value, first and last line."""
    for node in scope.body:
        targets = node.targets if isinstance(node, ast.Assign) else [node.target] if isinstance(node, ast.AnnAssign) else []
        for target in (target for target in targets if isinstance(target, ast.Name) and node.value is not None):
            yield target.id, node.value, node.lineno, node.end_lineno


def _line_comments(source: str) -> tuple[dict[int, str], dict[int, str]]:
    """Comments beside code by their line, and comments of their own lines by the line below."""
    beside, above = {}, {}
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type == tokenize.COMMENT:
            line, text = token.start[0], token.string.lstrip("# ")
            if token.line[: token.start[1]].strip():
                beside[line] = text
            else:
                above[line + 1] = f"{above.pop(line, '')} {text}".strip()
    return beside, above


def _stage_name(stage: str) -> str:
    name = STAGE_OF.get(stage, stage)
    return f"stage {name}" if len(name) == 1 else name


def _shown(value) -> str:
    if isinstance(value, Fabric):
        return next(name for name, preset in PRESETS.items() if preset == value)
    if dataclasses.is_dataclass(value):
        return type(value).__name__
    return f"{value:g}" if isinstance(value, float) else str(value)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="change nothing, fail where a document is out of date")
    parser.add_argument("--constants", action="store_true", help="print the module constants of the core and change nothing")
    arguments = parser.parse_args()
    if arguments.constants:
        print("\n".join(" | ".join(row) for row in constants()))
        return 0
    if arguments.check:
        found = problems()
        print("\n".join(found) or "the documents' tables agree with the code")
        return bool(found)
    for document, text in documents().items():
        (DOCS / document).write_text(text)
    found = problems()
    print("\n".join(found))
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
