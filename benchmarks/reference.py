"""Reference tables of the documents, written from the code: ``python benchmarks/reference.py``; ``--check`` only compares.

A table stands between ``<!-- NAME: begin -->`` and ``<!-- NAME: end -->``. Values, units and meanings come from the code
and its comments. The reason for a default is in the field's comment, after "; tuned", "; chosen" or "; fitted", or in
default_reasons.py.
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
from ddakf_service.transports.websocket.routes import ERROR_CODES
from default_reasons import REASONS
from prometheus_client.metrics import MetricWrapperBase

from ddakf import Config
from ddakf.physics.fabric import PRESETS, Fabric
from ddakf.stages.robust import gate_threshold

DOCS = Path(__file__).resolve().parents[1] / "docs"
CORE = DOCS.parent / "ddakf"

STAGE_OF = {
    "sidedness": "input",
    "start": "start",
    "relocalization": "start",
    "registration": "start",
    "discretisation": "garment",
    "predict": "A",
    "anchor": "A",
    "preprocess": "preprocessing",
    "skin_removal": "preprocessing",
    "segmentation": "preprocessing",
    "coarse": "cluster alignment",
    "associate": "B",
    "robust": "C",
    "adapt": "D",
    "physics": "E",
    "fuse": "F",
    "reliability": "G",
    "uncertainty": "F",
    "evidence": "G",
    "frame_error": "G",
    "normal_error": "F",
    "tangential_error": "F",
    "omission": "budget",
}



def fields() -> str:
    """Every field of every stage's configuration as comma-separated values; of a variant that extends another, its own fields."""
    out = io.StringIO()
    rows = csv.writer(out, lineterminator="\n")
    rows.writerow(("stage", "key", "field", "default", "paper", "least", "most", "unit, meaning", "reason"))
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
                rows.writerow((_stage_name(stage), stage, name, value, printed.get(name, ""), *bounds, meaning, reason))
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
    lines = ["| name | gRPC | HTTP | WebSocket | try again | meaning |", "|---|---|---|---|---|---|"]
    for name, error in ERRORS.items():
        again = "yes" if error.retryable else "no"
        meaning = " ".join(inspect.getdoc(error).split())
        codes = f"{error.status.name} | {error.http_status} | {ERROR_CODES + error.http_status}"
        lines.append(f"| `{name}` | {codes} | {again} | {meaning} |")
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
    found = [f"{name} in benchmarks/default_reasons.py is no field of the configuration" for name in sorted(set(REASONS) - known)]
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
