"""Writes the tables of the documents that repeat what the code says; ``--check`` only compares.

A table stands between ``<!-- NAME: begin -->`` and ``<!-- NAME: end -->``. Values, units and meanings come from the code
and its comments; the reason for a value is written here, and a field without one fails the check.
"""

from __future__ import annotations

import argparse
import dataclasses
import inspect
import math
import re
import sys
import typing
from collections.abc import Callable
from pathlib import Path

from ddakf_api.errors import ERRORS
from ddakf_service.observability.metrics import Metrics
from ddakf_service.settings import ENV_PREFIX, Settings
from prometheus_client.metrics import MetricWrapperBase

from ddakf import Config
from ddakf.physics.fabric import PRESETS, Fabric
from ddakf.stages.robust import gate_threshold

DOCS = Path(__file__).parent

STAGE_OF = {
    "start": "start",
    "predict": "A",
    "preprocess": "preprocessing",
    "coarse": "coarse level",
    "pyramid": "pyramid",
    "associate": "B",
    "robust": "C",
    "adapt": "D",
    "physics": "E",
    "fuse": "F",
    "reliability": "G",
    "uncertainty": "F",
}

# "tuned": by measurement on the bundled sample and the recordings; "chosen": by judgement, without a fit.
REASONS = {
    "Start.sd": "chosen: how exactly a caller places the template; not in the paper",
    "Start.speed_sd": "chosen; not in the paper",
    "Start.search": "a template that lies elsewhere is looked for; the paper starts at the truth",
    "Start.least_points": "chosen: fewer points fix no heading",
    "ConstantVelocity.damping": "0 is the paper's constant velocity; damping keeps unseen vertices from running on; tuned",
    "ConstantVelocity.acceleration": "the paper leaves Q open; tuned",
    "ConstantVelocity.carry_reach": "chosen: loose cloth near the body moves with it; 0 in the paper, which has no body",
    "ConstantVelocity.longest_step": "chosen: after a longer gap nothing is known about the motion",
    "ConstantVelocity.worn_memory": "tuned: ten frames; a third of it gives the same",
    "ConstantVelocity.worn_sd": "chosen: of the order of what loose cloth swings; a first guess that counts for little",
    "ConstantAcceleration.damping": "as in ConstantVelocity",
    "ConstantAcceleration.acceleration": "as in ConstantVelocity",
    "ConstantAcceleration.carry_reach": "as in ConstantVelocity",
    "ConstantAcceleration.longest_step": "as in ConstantVelocity",
    "ConstantAcceleration.worn_memory": "as in ConstantVelocity",
    "ConstantAcceleration.worn_sd": "as in ConstantVelocity",
    "ConstantAcceleration.share": "tuned: all of it overshoots, as every estimate of it comes late",
    "ConstantAcceleration.memory": "tuned: three frames",
    "GridFilter.points_per_cell": "tuned: large enough for a plane, small enough to be local",
    "GridFilter.neighbours": "as KnnFilter",
    "GridFilter.ratio": "as KnnFilter",
    "GridFilter.suspect_share": "tuned against k-NN statistics (16, 2): `make bench`, part outliers",
    "GridFilter.sample": "enough for the mean of the dense part; the spread comes from the suspects",
    "GridFilter.plane_radius": "all points that the 27 cells are sure to hold",
    "GridFilter.planes_per_vertex": "tuned on what ships: far from its middle a plane misses the curvature; bounds the time",
    "KnnFilter.neighbours": "the paper says k-NN and leaves k open",
    "KnnFilter.ratio": "the paper leaves it open; with 16 neighbours the pair (16, 2) that Open3D's users know",
    "KnnFilter.plane_radius": "as in GridFilter",
    "PlaneAssociation.iterations": "the limit for fast frames; calm ones stop earlier; tuned",
    "PlaneAssociation.least_iterations": "one pass alone cannot say whether the frame is calm",
    "PlaneAssociation.tolerance": "chosen: a quarter of 3 mm of sensor noise",
    "PlaneAssociation.wide_gate": "chosen: well above the motion between two frames",
    "PlaneAssociation.narrow_gate": "tuned: keeps a sleeve from taking the torso's points",
    "PlaneAssociation.narrowing": "tuned",
    "PlaneAssociation.still": "saves searches that would find the same plane",
    "PlaneAssociation.hidden_depth": "chosen: more than noise and the thickness of cloth on a body, less than an arm",
    "PlaneAssociation.normal_cosine": "chosen, 60 degrees: front and back never match",
    "PlaneAssociation.facing_cosine": "tuned, 78 degrees: planes of surface seen edge-on are poor, and pull it along itself",
    "Coarse.iterations": "tuned: the second still gains, a third does not",
    "Coarse.tolerance": "tuned",
    "Coarse.least_innovation": "tuned: above what noise and calm motion leave, about 3 mm",
    "Coarse.prior_sd": "tuned: how far predictions are off when motion is fast",
    "Pyramid.iterations": "tuned: more of them gain nothing",
    "Pyramid.tolerance": "chosen: what the passes that follow find anyway",
    "Pyramid.strain": "tuned: what edges of 3 to 6 cm span may shrink and stretch by its wrinkles",
    "Pyramid.rest": "tuned: holds the shape where strain holds it less",
    "Pyramid.motion": "tuned: chords change their length when the cloth between their ends bends, but little in a frame",
    "PlaneAssociation.turned": "tuned: of the order of an edge",
    "PlaneAssociation.beside": "tuned: planes go on for about the distance between them, and beyond no surface is known",
    "PlaneAssociation.hem_reach": "tuned: farther than cloth slips, nearer than the next hem",
    "PlaneAssociation.hem_sd": "tuned: half the distance between the points of a depth camera at 2 m",
    "PlaneAssociation.tangential_sd": "tuned: of the order of an edge, as a plane says next to nothing along itself",
    "NearestPoint.gate": "the paper has none; as wide as the default's first",
    "Tukey.cutoff": "95 % efficiency under Gaussian noise (Holland and Welsch 1977); the paper leaves it open",
    "Tukey.gate_probability": "the paper's tau as a quantile, so that it fits the innovation's dimension",
    "InnovationNoise.alpha": "the paper leaves it open; a memory of ten frames",
    "InnovationNoise.epsilon": "the paper leaves it open; 1 mm squared",
    "InnovationNoise.lowest_sd": "the paper names the bounds, not their values; chosen below a depth camera's noise",
    "InnovationNoise.highest_sd": "the paper names the bounds, not their values; chosen",
    "InnovationNoise.initial_sd": "chosen: near a depth camera's noise",
    "ResidualNoise.alpha": "as in the paper's preset",
    "ResidualNoise.epsilon": "as in the paper's preset",
    "ResidualNoise.lowest_sd": "chosen: neighbouring planes share their error, however many points they average",
    "ResidualNoise.highest_sd": "as in the paper's preset",
    "ResidualNoise.initial_sd": "as in the paper's preset",
    "Physics.stretch": "the paper leaves all weights open; tuned: soft enough for reconstructions that themselves stretch",
    "Physics.shear": "tuned: cloth shears more easily than it stretches",
    "Physics.strain_scale": "tuned: a template is a guess, and a quadratic energy would give all its force to where it is wrong",
    "Physics.strain_sd": "tuned: above what estimates of simulated garments show, below those of a dress that stretches",
    "Physics.strain_memory": "tuned: two or three frames; a median over thousands of faces needs little smoothing",
    "Physics.bend": "tuned: keeps folds",
    "Physics.collision": "tuned: penetration below 0.1 mm in the mean; ten times stiffer makes tight garments stick",
    "Physics.thickness": "chosen",
    "Physics.self_collision": "off: it helps where the estimate is good and holds on to crossings where it is not",
    "Physics.gap_time": "chosen: some fifteen frames, so that no single one decides",
    "Physics.motion_rigidity": "tuned",
    "Physics.rest_rigidity": "tuned: more of it holds a loose skirt together, but a hidden half off its body",
    "Physics.uneven_rigidity": "tuned: what keeps soft cloth from crumpling",
    "Physics.strain_followed": "tuned: nearly all; a little is left so that an even strain does not wander",
    "Physics.fabric": "the paper's single normalised setting (section 2.4)",
    "MapUpdate.solver_iterations": "what is left over is corrected by the next pass; tuned for time",
    "MapUpdate.solver_tolerance": "share of the force's norm, later twice that; the next pass corrects what is left over",
    "MapUpdate.prior_sd": "tuned: vertices share the error of their prediction, so that alone each is known no better",
    "DecoupledUpdate.longest_correction": "not in the paper, which says nothing of crumpled cloth; chosen",
    "Reliability.half_error": "chosen",
    "Reliability.recovery_below": "chosen",
    "Reliability.recovery_above": "chosen, above recovery_below: hysteresis",
    "Reliability.recovery_lambda": "the paper raises lambda; measured, it drives a garment that stretched off its template",
    "Reliability.doubt_below": "chosen: a predicted error of more than 10 cm",
    "Reliability.lost_coverage": "chosen: so few measured vertices hold nothing in place",
    "Reliability.lost_after": "chosen: 15 frames at 30 per second",
    "Reliability.lost_after_empty": "chosen: no points say nothing about the fit for a while",
    "PaperReliability.half_error": "as in Reliability",
    "PaperReliability.threshold": "below exp(-1), see stage G; the paper leaves tau open",
    "PaperReliability.recovery_lambda": "the paper leaves it open",
    "Uncertainty.observed_scale": "fitted on half of the recordings: python benchmarks/calibration.py --fit",
    "Uncertainty.unseen_scale": "the other fitted one",
    "Uncertainty.strain_reach": "chosen: slid cloth is strained by about its error over that length",
    "Uncertainty.floor_sd": "chosen",
    "Uncertainty.ceiling_sd": "chosen: the bound of section 2.7",
    "Uncertainty.ceiling_speed_sd": "chosen: the bound of section 2.7",
}


def fields_table() -> str:
    """Every field of every stage's configuration."""
    lines = ["| field | default | unit, meaning | why this value |", "|---|---|---|---|"]
    for stage, variants in _variants().items():
        for variant in variants:
            lines.append(f"| **{variant.__name__}** ({_stage_name(stage)}) | | {_first_sentence(variant)} | |")
            comments = _comments(variant)
            for field in dataclasses.fields(variant):
                value = _shown(getattr(variant(), field.name))
                why = REASONS.get(f"{variant.__name__}.{field.name}", "")
                lines.append(f"| `{variant.__name__}.{field.name}` | {value} | {comments.get(field.name, '')} | {why} |")
    return "\n".join(lines)


def open_constants_table() -> str:
    """What the paper names without a value."""
    default, paper = Config(), Config.paper()
    rows = [
        ("alpha (2.3)", "smoothing of R, share of the old value", default.adapt.alpha, paper.adapt.alpha, "adapt.alpha"),
        ("epsilon (2.3)", "added to R's sample, m²", default.adapt.epsilon, paper.adapt.epsilon, "adapt.epsilon"),
        (
            "tau (2.5)",
            "Mahalanobis gate on d²",
            f"{gate_threshold(default.robust.gate_probability, 1):.2f} (1 dimension)",
            f"{gate_threshold(paper.robust.gate_probability, 3):.2f} (3 dimensions)",
            "robust.gate_probability, chi-square quantile",
        ),
        ("Tukey's constant (2.5)", "in standard deviations", default.robust.cutoff, paper.robust.cutoff, "robust.cutoff"),
        (
            "tau (2.6)",
            "score below which lambda is raised",
            f"{default.reliability.recovery_below:g} on the product's score, until {default.reliability.recovery_above:g}",
            f"{paper.reliability.threshold:g} on s_k",
            "reliability.recovery_below, reliability.threshold",
        ),
        (
            "lambda (2.6)",
            "factor on the physics in recovery, 1 otherwise",
            default.reliability.recovery_lambda,
            paper.reliability.recovery_lambda,
            "reliability.recovery_lambda",
        ),
        (
            "Q (2.2)",
            "white acceleration, m/s²",
            default.predict.acceleration,
            paper.predict.acceleration,
            "predict.acceleration",
        ),
        (
            "R_min, R_max (2.7)",
            "as standard deviations, mm",
            f"{1e3 * default.adapt.lowest_sd:g}, {1e3 * default.adapt.highest_sd:g}",
            f"{1e3 * paper.adapt.lowest_sd:g}, {1e3 * paper.adapt.highest_sd:g}",
            "adapt.lowest_sd, adapt.highest_sd",
        ),
        (
            "R_0 (2.3)",
            "as standard deviation, mm",
            f"{1e3 * default.adapt.initial_sd:g}",
            f"{1e3 * paper.adapt.initial_sd:g}",
            "adapt.initial_sd",
        ),
        (
            "R_phys (2.4)",
            "covariance of the pseudo-measurement",
            "none: each constraint has its own variance 1/(lambda k w)",
            "H_phys, so that the gain is (P_pp⁻¹ + H)⁻¹",
            "no field",
        ),
        (
            "longest step of the physics (2.4)",
            "mm",
            "none",
            f"{1e3 * paper.fuse.longest_correction:g}",
            "fuse.longest_correction",
        ),
        (
            "k of the outlier filter (2.1)",
            "neighbours, ratio",
            "16, 2, for suspects alone",
            f"{paper.preprocess.neighbours}, {paper.preprocess.ratio:g}",
            "preprocess.neighbours, preprocess.ratio",
        ),
    ]
    lines = ["| constant (section) | what it is | `Config()` | `Config.paper()` | field |", "|---|---|---|---|---|"]
    lines += [f"| {name} | {what} | {_shown(a)} | {_shown(b)} | {_code(field)} |" for name, what, a, b, field in rows]
    return "\n".join(lines)


def derived_table() -> str:
    """Numbers that follow from the configuration."""
    config, paper = Config(), Config.paper()
    limits = config.uncertainty
    rows = [
        ("trace(P_pp), at most", f"{3 * limits.ceiling_sd**2:g} m²", "3 ceiling_sd²"),
        ("trace(P_uu), at most", f"{3 * limits.ceiling_speed_sd**2:g} m²/s²", "3 ceiling_speed_sd²"),
        ("trace of the reported covariance, at most", f"{3 * limits.ceiling_sd**2:g} m²", "3 ceiling_sd²"),
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
        ("s_k in the steady state", f"{math.exp(-1):.3f}", "exp(-1)"),
        (
            "s_k, at least, where all measurements pass the gate and R is not clamped",
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


def presets_table() -> str:
    """Where the presets differ."""
    default, paper = Config(), Config.paper()
    lines = ["| stage | `Config()` | `Config.paper()` |", "|---|---|---|"]
    for field in dataclasses.fields(Config):
        a, b = getattr(default, field.name), getattr(paper, field.name)
        if a == b:
            continue
        if type(a) is type(b):
            differing = [f.name for f in dataclasses.fields(a) if getattr(a, f.name) != getattr(b, f.name)]
            shown = (", ".join(f"`{name}={_shown(getattr(v, name))}`" for name in differing) for v in (a, b))
        else:
            shown = (f"`{type(v).__name__}`" for v in (a, b))
        lines.append(f"| {field.name} ({_stage_name(field.name)}) | {' | '.join(shown)} |")
    return "\n".join(lines)


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
    "fields": ("algorithm.md", fields_table),
    "open constants": ("algorithm.md", open_constants_table),
    "derived": ("algorithm.md", derived_table),
    "presets": ("algorithm.md", presets_table),
    "fabrics": ("algorithm.md", fabrics_table),
    "settings": ("operations.md", settings_table),
    "metrics": ("operations.md", metrics_table),
    "errors": ("operations.md", errors_table),
}


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
    """What a document says otherwise than the code, one sentence each."""
    known = {f"{variant.__name__}.{f.name}" for variants in _variants().values() for v in variants for variant, f in _fields(v)}
    found = [f"{name} has no reason: add it to REASONS in docs/constants.py" for name in sorted(known - set(REASONS))]
    found += [f"{name} in docs/constants.py is no field any more" for name in sorted(set(REASONS) - known)]
    for document in sorted({where for where, _ in TABLES.values()}):
        if fresh(document) != (DOCS / document).read_text():
            found.append(f"docs/{document} is not what the code says: run python docs/constants.py")
    return found


def _fields(variant: type) -> list[tuple[type, dataclasses.Field]]:
    return [(variant, field) for field in dataclasses.fields(variant)]


def _variants() -> dict[str, tuple[type, ...]]:
    """The configuration classes of each stage, the default first."""
    hints = typing.get_type_hints(Config)
    return {name: typing.get_args(hint) or (hint,) for name, hint in hints.items()}


def _comments(variant: type) -> dict[str, str]:
    inherited = "".join(inspect.getsource(base) for base in variant.__mro__[::-1] if dataclasses.is_dataclass(base))
    found = re.findall(r"^    (\w+): .*?\)\s+# (.*)$|^    (\w+): \w+ = \S+\s+# (.*)$", inherited, re.M)
    return {a or b: x or y for a, x, b, y in found}


def _stage_name(stage: str) -> str:
    name = STAGE_OF[stage]
    return f"stage {name}" if len(name) == 1 else name


def _first_sentence(cls: type) -> str:
    return " ".join(inspect.getdoc(cls).split("\n\n")[0].split())


def _shown(value) -> str:
    if isinstance(value, Fabric):
        return next(name for name, preset in PRESETS.items() if preset == value)
    return f"{value:g}" if isinstance(value, float) else str(value)


def _code(names: str) -> str:
    return ", ".join(f"`{part}`" if re.fullmatch(r"[a-z_.]+", part) else part for part in names.split(", "))


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--check", action="store_true", help="change nothing; fail where a document is out of date")
    if parser.parse_args().check:
        found = problems()
        print("\n".join(found) or "the documents' tables are what the code says")
        return bool(found)
    for document in sorted({where for where, _ in TABLES.values()}):
        (DOCS / document).write_text(fresh(document))
    found = problems()
    print("\n".join(found))
    return bool(found)


if __name__ == "__main__":
    sys.exit(main())
