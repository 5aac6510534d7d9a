"""Simulation of scaling: sessions are conserved, placed evenly, and come back one after the other."""

import json
from dataclasses import replace

import fleet_tables
import numpy as np
import pytest
from fleet import Figures, back_after, disagreements, placed, plan, simulated
from scaling import RESULT, main

FIGURES = Figures(0.02, 0.002, 20_000, 50_000, 2e6, 5e6, 2e6, restore_first=0.3, restore_next=0.05)


@pytest.mark.parametrize(("sessions", "gateways", "workers"), [(0, 1, 1), (7, 3, 2), (1000, 13, 40)])
def test_every_session_is_placed_and_no_worker_has_two_more_than_another(sessions, gateways, workers):
    fleet = placed(sessions, gateways, workers, np.random.default_rng(2))
    assert [len(load) for load in fleet] == [workers] * gateways
    assert sum(sum(load.values()) for load in fleet) == sessions
    assert all(max(load.values()) - min(load.values()) <= 1 for load in fleet)


def test_the_sessions_of_a_worker_come_back_one_after_the_other():
    times = back_after([20], FIGURES)
    assert times == pytest.approx([0.3 + 0.05 * k for k in range(20)])
    assert sorted(back_after([3, 1], FIGURES)) == pytest.approx([0.3, 0.3, 0.35, 0.4])
    assert back_after([0], FIGURES) == []


def test_needs_are_in_proportion_to_sessions_and_to_their_rate():
    small, large = plan(FIGURES, 100, 10.0), plan(FIGURES, 1000, 20.0)
    assert large["worker_cores"] == pytest.approx(20 * small["worker_cores"], abs=20)
    assert large["sessions_per_core"] == pytest.approx(small["sessions_per_core"] / 2)
    assert large["worker_gigabytes"] == pytest.approx(10 * small["worker_gigabytes"], abs=10)
    assert large["database_rows_per_second"] == 10 * small["database_rows_per_second"]


def test_a_dearer_restore_makes_every_loss_longer():
    fleet = {"sessions": 500, "rate": 30.0, "reserve": 1.1, "node_cores": 16, "seed": 1}
    cheap, dear = (simulated(replace(FIGURES, restore_first=first), **fleet) for first in (0.3, 3.0))
    longer = {name for name in cheap if dear[name] > cheap[name]}
    assert longer == {name for name in cheap if "_seconds_" in name}
    assert all(dear[name] == cheap[name] for name in cheap.keys() - longer)
    assert simulated(FIGURES, **fleet) == cheap, "the same seed, the same fleet"


def test_a_simulation_that_disagrees_with_the_measurement_fails(tmp_path):
    report = json.loads(RESULT.read_text())
    assert disagreements(report) == []
    (row,) = [row for row in report["restores"] if row["sessions"] == 4]
    row["longest_s"] *= 1.5
    assert disagreements(report) == [row]
    (tmp_path / "scaling.json").write_text(json.dumps(report))
    assert main(["--out", str(tmp_path / "scaling.json")]) == 1


@pytest.mark.parametrize("document", fleet_tables.DOCUMENTS)
def test_the_tables_of_a_document_are_those_of_the_results(document):
    assert fleet_tables.fresh(document) == (fleet_tables.ROOT / document).read_text()
