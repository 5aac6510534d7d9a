"""Rows of the runs that a result file has, so that a study resumes where nothing but its result is at hand."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

from ddakf.errors import InvalidFile
from ddakf.evaluation.studies.study_plan import tracked_span
from ddakf.evaluation.studies.study_summary import KEPT


def kept_rows(path: Path) -> list[dict]:
    """Rows of a result, with the fields of their trials: of its runs, and of systems that did not apply; none without a file.

    Raises:
        InvalidFile: no result of a study.
    """
    if not path.is_file():
        return []
    try:
        return list(_rows(json.loads(path.read_text())))
    except (ValueError, TypeError, KeyError, AttributeError) as error:
        raise InvalidFile(str(path), "the result of a study", f"another file ({error!r})") from error


def _rows(result: dict) -> Iterator[dict]:
    meta = result["meta"]
    if "surfaces" not in meta:  # of a version that did not say what was measured
        return
    settings = {name: value for name, value in meta["conditions"].items() if value is not None}
    first, frames = tracked_span(meta["frames"], settings["every"])
    common = settings | {"first": first, "frames": frames, "surfaces": meta["surfaces"]}
    for cell in result["results"]:
        view, _, body = cell["view"].partition("+")
        own = common | {"sequence": cell["sequence"], "view": view, "body": bool(body), "variant": cell["method"]}
        for run in cell["runs"]:
            inputs = {"inputs": run["inputs"]} if "inputs" in run else {}
            yield own | inputs | {name: run.get(name) for name in ("seed", "commit", "processes", "seconds")} | {KEPT: run}
        if "not_applicable" in cell and not cell["runs"]:
            reason = {"commit": next(reversed(meta["commits"]), None), "not_applicable": cell["not_applicable"]}
            yield from (own | {"seed": seed} | reason for seed in meta["seeds"])
