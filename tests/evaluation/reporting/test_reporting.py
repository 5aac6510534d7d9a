"""The report shows the numbers of the results, and names what is missing."""

from __future__ import annotations

import re
from dataclasses import asdict, replace
from html.parser import HTMLParser

import numpy as np
import pytest
from rich.console import Console

from ddakf.commands import cli
from ddakf.errors import InvalidFile
from ddakf.evaluation import machine
from ddakf.evaluation.metrics.calibration import NOMINAL_PROBABILITIES
from ddakf.evaluation.paper_scope import CONDITIONS, ERROR_MAPS, REFERENCES
from ddakf.evaluation.reporting import content, headline, markdown, not_reproduced, paper_figures, paper_numbers, paper_tables
from ddakf.evaluation.reporting import page as html
from ddakf.evaluation.reporting import result_files as read
from ddakf.evaluation.splits import is_untouched
from ddakf.evaluation.studies import paper_studies
from ddakf.evaluation.studies.execution import run_study
from ddakf.evaluation.studies.frame_estimates import FrameEstimates
from ddakf.evaluation.studies.study_plan import StudyPlan
from ddakf.evaluation.trials import methods
from ddakf.evaluation.trials.trial import Trial
from ddakf.evaluation.trials.variants import ablations, refinements

pytestmark = pytest.mark.slow

SMALL = Trial("", points=800, surfaces=True)
QUIET = Console(quiet=True)


class Frozen:
    """Stays where it was."""

    def start(self, garment, vertices, body):
        self.vertices = vertices

    def step(self, frame):
        return self.vertices


class Texts(HTMLParser):
    """Cells of the tables, names of the pictures and anchors of a page; every tag is closed."""

    def __init__(self):
        super().__init__()
        self.cells, self.pictures, self.ids, self.links, self.open = [], [], [], [], []

    def handle_starttag(self, tag, attributes):
        attributes = dict(attributes)
        if tag not in ("meta", "img", "br"):
            self.open.append(tag)
        if "id" in attributes:
            self.ids.append(attributes["id"])
        if tag == "img":
            self.pictures.append(attributes["src"])
        if tag == "a":
            self.links.append(attributes["href"])
        if tag == "td":
            self.cells.append("")

    def handle_data(self, data):
        if self.open and self.open[-1] == "td":
            self.cells[-1] += data

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Results of small studies of two systems that are there and of one that is not."""
    folder = tmp_path_factory.mktemp("results")

    def absent(scored):
        from ddakf.errors import NotApplicable

        raise NotApplicable("it is not <installed>")

    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(methods.BASELINES, "kf", lambda scored: Frozen())
        patch.setitem(methods.BASELINES, "clothfit", absent)
        whole = StudyPlan(("sample",), ("kf", "clothfit", "ddakf"), ("full+body",), 2, "0:6", SMALL)
        for name, plan in {
            "main": whole,
            "noise-0": replace(whole, runs=1, settings=replace(SMALL, noise=0.0)),
            "drop-40": replace(whole, runs=1, settings=replace(SMALL, drop=0.4)),
            "occlusion": replace(whole, runs=1, settings=replace(SMALL, occlude=(2, 4))),
            "ablation": replace(whole, runs=1, systems=("ddakf", "no-planes")),
        }.items():
            run_study(plan, folder / f"{name}.json", 1, QUIET)
        systems, eye = ["kf", "clothfit", "ddakf"], np.array([0.0, 1.2, 2.0])
        paper_studies.frame_estimates_of(replace(SMALL, sequence="sample"), systems, 3, eye).save(
            folder / "figure-1.npz"
        )
    return folder


@pytest.fixture(scope="module")
def page(folder):
    out = folder / "page"
    assert cli.main(["report", "--results", str(folder), "--out", str(out)]) == 0
    parser = Texts()
    parser.feed((out / "index.html").read_text())
    assert parser.open == []
    return out, parser


def test_every_link_leads_to_a_source_and_every_picture_is_there(page):
    out, parser = page
    for link in parser.links:
        assert link.removeprefix("#") in parser.ids if link.startswith("#") else (out / link).is_file()
    assert "../main.json" in parser.links
    assert set(parser.pictures) == {"figure-1.png", "figure-3.png", "ablation.png", "calibration.png"}
    for name in parser.pictures:
        assert (out / name).read_bytes().startswith(b"\x89PNG")


def test_a_number_of_the_page_is_the_mean_and_deviation_over_the_runs(folder, page):
    main = read.read(folder)["main"]
    runs = [run["rmse_mm"] for run in main.cells_of("ddakf")[0]["runs"]]
    assert f"{np.mean(runs):.1f} ± {np.std(runs, ddof=1):.1f}" in page[1].cells
    pool = main.pooled("ddakf", "rmse_mm")
    assert (pool.runs, pool.cells, pool.cells_in_all) == (2, 1, 1)


def test_the_papers_numbers_are_beside_ours(page):
    assert "7.25 ± 0.62" in page[1].cells
    assert "6.6 ± 0.25" in page[1].cells


def test_every_ablation_has_a_name_in_its_figure():
    assert set(paper_figures.WITHOUT) == {*ablations(), *refinements()}


def test_the_default_is_the_uppermost_of_the_ablation_in_every_view(folder, monkeypatch):
    drawn = []
    monkeypatch.setattr(paper_figures, "_save", lambda picture, path: drawn.append(picture))
    ablation = read.read(folder)["ablation"]
    ablation.cells.extend([cell | {"view": "front+body"} for cell in ablation.cells])
    paper_figures.ablation(folder / "none.png", ablation)
    assert len(drawn[0].axes) == 2
    assert ablation.methods[0] == "ddakf"
    assert all(axis.yaxis_inverted() for axis in drawn[0].axes)


def test_the_papers_decimals_are_kept():
    assert paper_numbers.FAUST["hausdorff_mm"]["kf"] == "26.0 ± 2.0"
    assert paper_numbers.CLOTH3D["iou"]["ddakf"] == "0.92 ± 0.02"


def test_every_p_of_the_paper_has_a_row(folder, page):
    """Table 4 of the paper tests stretch, bend and flicker too."""
    assert set(paper_numbers.CLOTH3D) == set(paper_numbers.CLOTH3D_P) <= set(content.TESTED) & set(content.CLOTH)
    table = paper_tables.significance("t", "t", read.read(folder)["main"], content.TESTED, paper_numbers.CLOTH3D_P)
    beside = {row[0].text: row[-1].text for row in table.rows if row[1].text == "Kalman filter"}
    assert beside["bend, deg"] == beside["stretch, %"] == "< 0.001"
    assert beside["bend against the truth, deg"] == "–"


def test_what_was_not_run_stands_among_what_is_not_reproduced(folder):
    rows = {row[0].text: row[1].text for row in not_reproduced.table(read.read(folder), ["figure-1"]).rows}
    assert "ddakf evaluate --paper --only faust" in rows["Tables 1 and 2"]
    assert {"Table 5, 5 mm", "Table 6, 0 %", "Figure 2", "Opt-ED, Table 5, 0 mm"} <= set(rows)
    assert not {"Table 5, 0 mm", "Figure 1", "Kalman filter, Table 5, 0 mm"} & set(rows)
    assert "main.json: 2 per cell" in rows["5 runs of each"]


@pytest.mark.parametrize(("clip", "said"), [("faust_s3_p7", True), ("MPI-FAUST#s8_p1", False)])
def test_whether_the_papers_test_subjects_were_scored_is_read_off_the_clips(clip, said):
    faust = result({"kf": [run(3.0)]})
    faust.cells[0]["sequence"] = clip
    faust.meta["seeds"] = [1]
    rows = [row[0].text for row in not_reproduced.table({"faust": faust}, []).rows]
    assert any("subjects 8 and 9" in row for row in rows) == said


def test_what_lost_the_garment_is_best_in_nothing():
    both = result({"kf": [run(300.0) | {"fps": 90.0}], "ddakf": [run(2.0) | {"fps": 20.0}]})
    table = paper_tables.comparison("t", "t", both, ["rmse_mm", "fps"], {})
    assert [[cell.kind for cell in row[1:]] for row in table.rows] == [["", ""], ["best", "best"]]
    assert "Lost the garment, sequences x views: Kalman filter 1 of 1." in table.notes


def test_a_mean_of_fewer_cells_is_marked_and_the_mark_explained():
    part = result({"kf": [run(3.0)], "ddakf": [run(2.0)]})
    part.cells.append(part.cells[0] | {"sequence": "b", "runs": [], "mean": None, "not_applicable": "no body"})
    table = paper_tables.comparison("t", "t", part, ["rmse_mm"], {})
    assert table.rows[0][1].text == "3.0*"
    assert paper_tables.PARTIAL in table.notes
    assert "Kalman filter: no body" in table.notes
    assert paper_tables.PARTIAL not in paper_tables.comparison("t", "t", result({"kf": [run(3.0)]}), ["rmse_mm"], {}).notes


def test_a_document_has_the_gains_of_the_page(folder):
    main = read.read(folder)["main"]
    page = paper_tables.significance("t", "t", main, content.TESTED, {}).rows
    short = paper_tables.effects("t", "t", main, content.TESTED)
    gains = {
        (row[0].text, head): cell.text.partition(",")[0]
        for row in short.rows
        for head, cell in zip(short.heads[1:], row[1:], strict=True)
        if cell.text != "–"
    }
    assert gains == {(row[0].text, row[1].text): row[2].text for row in page}


@pytest.mark.parametrize(
    ("conditions", "words"),
    [
        ({}, "10 points at most, noise 3 mm"),
        ({"drop": 0.4, "depth_step": 0.0029},
         "10 points at most, noise 3 mm, 40 % of the points dropped, depth steps 2.9 mm at 1 m"),
        ({"occlude": [3, 8], "every": 2},
         "10 points at most, noise 3 mm, 40 % of the garment hidden in frames 3 to 7, every 2. frame"),
    ],
)  # fmt: skip
def test_conditions_are_in_words_with_units(conditions, words):
    one = result({"kf": [run(3.0)]})
    one.meta["conditions"] = {"points": 10, "noise": 0.003, "occluded": 0.4, "segmented": True} | conditions
    assert html._conditions(one) == words
    one.cells[0]["runs"] = [{"rmse_mm": None}]
    assert html._conditions(one) == "a real sensor's frames"


def test_what_is_missing_is_said_and_escaped(page):
    text = (page[0] / "index.html").read_text()
    assert "ClothFit: it is not &lt;installed&gt;" in text
    assert "–" in page[1].cells


def test_the_same_results_give_the_same_page(folder, page):
    assert cli.main(["report", "--results", str(folder), "--out", str(folder / "again")]) == 0
    assert (folder / "again/index.html").read_bytes() == (page[0] / "index.html").read_bytes()


def test_a_document_keeps_its_own_text_around_the_tables(folder, tmp_path):
    document = tmp_path / "results.md"
    document.write_text(f"before\n{markdown.BEGIN}\nstale words\n{markdown.END}\nafter\n")
    arguments = ["report", "--results", str(folder), "--out", str(tmp_path), "--markdown", str(document)]
    assert cli.main(arguments) == cli.main(arguments) == 0
    text = document.read_text()
    assert text.startswith("before\n")
    assert text.endswith("\nafter\n")
    assert "stale words" not in text
    assert text.count("## Table 5") == 1
    assert "## What is not reproduced, and why\n\n| what | why |\n| --- | --- |\n" in text
    document.write_text(f"{markdown.BEGIN.replace('begin', 'begin by-sequence missing')}\n{markdown.END}\n")
    assert cli.main(arguments) == 0
    assert re.findall("^## (.*)$", document.read_text(), re.M) == ["RMSE in mm by sequence", not_reproduced.TITLE]
    document.write_text("no marks")
    with pytest.raises(InvalidFile, match="a document with"):
        markdown.rewritten(document, [], tmp_path)


def test_a_folder_without_results_is_refused_in_a_sentence(tmp_path):
    with pytest.raises(InvalidFile, match="ddakf evaluate --paper"):
        read.read(tmp_path)
    (tmp_path / "main.json").write_text('{"results": []}')
    with pytest.raises(InvalidFile, match=r"main\.json"):
        read.read(tmp_path)


def test_the_best_is_set_off_among_those_that_apply_everywhere(folder):
    main = read.read(folder)["main"]
    table = paper_tables.comparison("t", "t", main, ["rmse_mm", "iou"], {})
    by_system = {row[0].text: row for row in table.rows}
    assert by_system["DD-AKF"][1].kind == by_system["DD-AKF"][2].kind == "best"
    assert by_system["ClothFit"][1].text == "–"


def test_with_so_few_clips_no_difference_is_called_insignificant(folder):
    table = paper_tables.significance("t", "t", read.read(folder)["main"], ["rmse_mm"], {})
    assert [row[6].text for row in table.rows] == ["n too small"]


@pytest.mark.recordings
def test_the_studies_of_the_paper_have_its_levels(monkeypatch):
    monkeypatch.delenv("DDAKF_DATA", raising=False)
    whole, quick = paper_studies.studies(paper_studies.FULL), paper_studies.studies(paper_studies.QUICK)
    assert {name for name in whole if re.match("noise|drop", name)} == {
        *(f"noise-{level}" for level in (0, 1, 3, 5)), *(f"drop-{level}" for level in (0, 10, 20, 30, 40)),
    }  # fmt: skip
    assert {name for name in whole if re.match("every|rate", name)} == {"every-1", "every-2", "every-3", "rate-60"}
    assert whole["rate-60"].sequences == tuple(f"{name}@60" for name in whole["every-1"].sequences)
    assert whole["main"].runs == 5
    assert quick["main"].runs == 2
    assert {plan.views for name, plan in whole.items() if name in ("main", "untouched", "ablation")} == {tuple(CONDITIONS)}
    assert all(is_untouched(name) for name in whole["untouched"].sequences)
    assert len(whole["untouched"].sequences) >= 16
    assert not any(is_untouched(name) for name in whole["main"].sequences)
    assert set(REFERENCES) <= set(whole["untouched"].systems)
    assert {plan.frames for plan in quick.values()} == {"0:31"}


def result(runs: dict[str, list[dict]]) -> read.Result:
    """A study of one sequence and view whose methods have these runs."""
    cells = [
        {"sequence": "a", "view": "full", "method": method, "runs": own, "mean": {"rmse_mm": own[0]["rmse_mm"]}}
        for method, own in runs.items()
    ]
    return read.Result("main", {"commits": sorted({run["commit"] for own in runs.values() for run in own})}, cells, {})


def run(rmse: float, commit: str = "old", processes: int = 1, seed: int = 1) -> dict:
    return {"rmse_mm": rmse, "commit": commit, "processes": processes, "seed": seed}


def test_results_of_several_commits_say_so_and_those_of_one_do_not():
    assert result({"icp": [run(3.0)], "ddakf": [run(2.0)]}).mixed_runs is None
    mixed = result({"icp": [run(3.0)], "kf": [run(4.0)], "ddakf": [run(2.0, "new", 2)]}).mixed_runs
    assert mixed == "main.json has runs of several commits: new (ddakf), old (icp, kf); times with 1 and 2 processes at once."


def test_where_another_system_is_better_it_stands_in_the_table_of_what_is_not_won():
    assert paper_tables.behind("b", "b", result({"icp": [run(3.0)], "ddakf": [run(2.0)]}), ["rmse_mm"]).rows == []
    lost = paper_tables.behind("b", "b", result({"icp": [run(3.0)], "nicp": [run(1.5)], "ddakf": [run(2.0)]}), ["rmse_mm"])
    assert [cell.text for cell in lost.rows[0]] == ["a", "full", "tuned", "non-rigid ICP (ARAP): 1.5, 2.0"]
    assert lost.heads[3:] == ["RMSE, mm"]


def test_a_sequence_on_which_ddakf_failed_is_not_won():
    found = result({"icp": [run(3.0)], "ddakf": [run(2.0)]})
    next(cell for cell in found.cells if cell["method"] == "ddakf").update(runs=[], mean=None, failed="LinAlgError: singular")
    table = paper_tables.behind("b", "b", found, ["rmse_mm"])
    assert [cell.text for cell in table.rows[0]][3:] == ["ICP, non-rigid point-to-plane: 3.0, none"]
    assert table.notes[-1] == "DD-AKF has no result of a full: LinAlgError: singular."


def test_times_of_other_commits_and_machines_are_named():
    kept, other = run(2.0, "new") | {"times_commit": "old", "cpu": "A"}, run(3.0, "new") | {"cpu": "B"}
    mixed = result({"icp": [other], "ddakf": [kept]}).mixed_runs
    assert mixed == "main.json has times of earlier commits: old (ddakf); times of A and B."


def headline_of(errors: dict[str, list[float]], view: str = "front+body") -> read.Result:
    """A study whose methods have these errors, one per sequence."""
    cells = [
        {"sequence": f"s{k}", "view": view, "method": method, "runs": [run(value) | {"load_average": 1.0 + k}],
         "mean": {"rmse_mm": value, "rmse_normal_mm": value / 2, "cpu_ms_per_frame": 10.0 + len(method)}}
        for method, own in errors.items() for k, value in enumerate(own)
    ]  # fmt: skip
    return read.Result("untouched", {"commits": ["old"], "seeds": [1], "frames": "30:91"}, cells, {})


def test_the_headline_names_the_best_baseline_and_its_ratio():
    found = headline_of({"still": [5.0] * 4, "kf": [40.0] * 4, "nicp": [8.0, 8, 16, 16], "ddakf": [4.0, 4, 8, 8]})
    table = headline.table(found)
    assert [row[0].text for row in table.rows[:4]] == ["do nothing", "Kalman filter", "non-rigid ICP (ARAP)", "DD-AKF"]
    assert table.rows[-2][1].text == "2.00 [2.00, 2.00], non-rigid ICP (ARAP)", "doing nothing is no baseline"
    assert table.rows[3][1].kind == "best"
    assert table.rows[2][1].text == f"{np.sqrt(8 * 16):.1f}"
    assert any("1.0 to 4.0" in note for note in table.notes), "of the runs, not of their means"


def test_calibration_is_pooled_over_the_vertices_of_all_runs():
    found, levels = headline_of({"ddakf": [1.0, 1.0], "nicp": [1.0, 1.0]}), np.array(NOMINAL_PROBABILITIES)
    for cell, n, inside in zip(found.cells[:2], (100, 300), (levels, np.ones_like(levels)), strict=True):
        cell["runs"][0]["calibration"] = {"observed": {"n": n, "nees3": n / 100, "inside": inside.tolist()}, "hidden": None}
    table = headline.calibration([found])
    assert [[cell.text for cell in row] for row in table.rows] == [
        ["untouched, one camera, body given", "88%", "98%", "2.50", "–", "–", "–"]
    ]


def test_a_baseline_that_lacks_a_sequence_is_not_the_best():
    found = headline_of({"icp": [3.0, 3.0], "nicp": [8.0, 8, 8], "ddakf": [4.0, 4, 4]})
    assert headline.best_baseline(found, "front+body")[0] == "nicp"
    assert headline.best_of_each_ratio(found, "front+body") == pytest.approx((0.75 * 0.75 * 2.0) ** (1 / 3))


def test_a_mean_of_fewer_sequences_is_marked_and_not_the_best():
    found = headline_of({"icp": [3.0, 3.0], "nicp": [8.0, 8, 8], "ddakf": [4.0, 4, 4]})
    found.cells.append(found.cells[0] | {"sequence": "s2", "runs": [], "mean": None, "failed": "ValueError: no"})
    table = headline.table(found)
    assert [(row[1].text, row[1].kind) for row in table.rows[:3]] == [("3.0*", ""), ("8.0", ""), ("4.0", "best")]
    assert any(note.endswith("ValueError: no") for note in table.notes)
    assert headline.FEWER in table.notes


def test_a_condition_without_any_rival_has_no_better_one():
    found = headline_of({"ddakf": [4.0, 5.0], "nicp": [8.0]})
    assert headline.better_baselines(found, "front+body") == {}
    assert headline.table(headline_of({"ddakf": [4.0]})).rows[0][1].kind == "best"


def test_the_headline_names_the_sequences_on_which_a_baseline_is_better():
    found = headline_of({"still": [1.0] * 3, "icp": [3.0, 9, 9], "nicp": [8.0, 8, 5], "ddakf": [4.0, 4, 8]})
    assert headline.better_baselines(found, "front+body") == {"s0": (4.0, "icp", 3.0), "s2": (8.0, "nicp", 5.0)}
    assert any("less RMSE on 2 of 3 sequences" in note and "s2 (8.0;" in note for note in headline.table(found).notes)
    alone = headline_of({"icp": [9.0], "ddakf": [4.0]})
    assert not any("sequences:" in note for note in headline.table(alone).notes)


def test_runs_of_uncommitted_code_are_marked_in_red(folder, monkeypatch):
    monkeypatch.setattr(machine, "is_traceable", lambda revision: False)
    text = html.page("t", [], content.tables_of(read.read(folder), folder), [], "..")
    assert f"<li class=warning>main.json {read.UNTRACEABLE}" in text
    monkeypatch.setattr(machine, "is_traceable", lambda revision: True)
    assert "class=warning" not in html.page("t", [], content.tables_of(read.read(folder), folder), [], "..")


def test_the_figures_of_the_page_are_drawn(tmp_path):
    found = headline_of({"still": [50.0] * 3, "carried": [30.0] * 3, "nicp": [8.0] * 3, "ddakf": [4.0] * 3})
    paper_figures.speed(tmp_path / "speed.png", found)
    cells = [
        {"sequence": "a_depth.mat", "view": "front", "method": method, "mean": {},
         "runs": [{"per_frame": {"number": [1, 2, 3], "residual_mm": [3.0, 4.0, 5.0]}}]}
        for method in ("nicp", "ddakf")
    ]  # fmt: skip
    paper_figures.residuals(tmp_path / "depth.png", read.Result("depth", {}, cells, {}))
    for name in ("speed", "depth"):
        assert (tmp_path / f"{name}.png").read_bytes().startswith(b"\x89PNG")


def test_seeds_that_no_two_cells_share_still_have_a_mean():
    both = result({"icp": [run(3.0, seed=1)]})
    both.cells.append(both.cells[0] | {"sequence": "b", "runs": [run(5.0, seed=2)], "mean": {"rmse_mm": 5.0}})
    assert both.pooled("icp", "rmse_mm")[:3] == (4.0, None, 0)


def test_a_still_is_taken_once_per_frame_and_again_with_other_code(tmp_path, monkeypatch):
    taken = []

    def take(trial, systems, number, eye):
        taken.append(number)
        meta = asdict(trial) | {"frame": number, "commit": machine.commit()}
        return FrameEstimates(meta, np.zeros((3, 3)), np.zeros((1, 3), int), {}, eye)

    monkeypatch.setattr(paper_studies, "frame_estimates_of", take)
    monkeypatch.setattr(machine, "commit", lambda: "old")
    for size, more in ((paper_studies.QUICK, 2), (paper_studies.QUICK, 2), (paper_studies.FULL, 4), (paper_studies.FULL, 4)):
        paper_studies.save_error_maps(ERROR_MAPS, size, tmp_path, QUIET, again=True)
        assert len(taken) == more
    monkeypatch.setattr(machine, "commit", lambda: "new")
    for again, more in ((False, 4), (True, 6)):
        paper_studies.save_error_maps(ERROR_MAPS, paper_studies.FULL, tmp_path, QUIET, again=again)
        assert len(taken) == more
    monkeypatch.setattr(machine, "commit", lambda: "newer")
    assert cli.main(["evaluate", "--paper", "--only", "figure-2", "--again", "all", "--results", str(tmp_path)]) == 0
    assert taken[6:] == [ERROR_MAPS["figure-2"][-1]]


def test_reliability_on_real_depth_stands_beside_what_was_missed():
    frames = {"reliability": [0.9, 0.7, 0.2], "limb_mm": [20.0, 120.0, 300.0], "held_out_share": [0.9, None, 0.5]}
    run = {"seed": 1, "states": {"tracking": 2, "lost": 1}, "per_frame": frames}
    cell = {"sequence": "depth/a3_depth.mat", "view": "front", "method": "ddakf", "runs": [run], "mean": {}}
    table = paper_tables.depth_reliability("depth-reliability", "", read.Result("depth", {}, [cell], {}))
    assert [each.text for each in table.rows[0]] == ["a3_depth.mat", "0.60", "67%", "-1.00", "1.00", "67%", "50%"]
