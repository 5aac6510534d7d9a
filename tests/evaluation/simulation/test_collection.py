"""The collection of simulated recordings: a balanced plan, a manifest that its files obey, and a run that goes on."""

import json
from collections import Counter

import numpy as np
import pytest
import recordings
from rich.console import Console

from ddakf.data.body import load_body
from ddakf.data.body_shape import random_shape, shaped
from ddakf.errors import InvalidArgument, InvalidFile, PoorQuality
from ddakf.evaluation.datasets import collection
from ddakf.evaluation.simulation import garments, motions, simulated_recording, solver
from ddakf.evaluation.simulation.collection_plan import ATTEMPTS, BALANCED, LATER, SEEDS, Entry, entries
from ddakf.evaluation.trials.recordings import find_recording
from ddakf.files.sequence import Sequence, load_sequence

COMMITTED = collection.listed(where=collection.CHECKOUT)


def simulated(order, rise=0.5):
    """A triangle before the posed body, as a simulation's result."""
    body = shaped(load_body(), random_shape(order.body))
    pose = motions.make(order.motion, body, 4)
    pose = type(pose)(pose.rotations.astype(np.float32), pose.shift.astype(np.float32))
    vertices = body.skinned(pose)
    cloth = vertices[:, body.faces[0]] + np.float32([0, 0, rise])
    sequence = Sequence("t", cloth, np.array([[0, 1, 2]]), 30.0, cloth[0], vertices, body.faces, order.garment, order.motion)
    return sequence, pose


@pytest.fixture
def simulator(monkeypatch):
    """Orders that were simulated; ``refused`` seeds are of poor quality."""
    made, refused = [], set()

    def record(order, progress=None):
        made.append(order)
        if order.seed in refused:
            raise PoorQuality("torn")
        return simulated(order)

    monkeypatch.setattr(simulated_recording, "record", record)
    monkeypatch.setattr(solver, "version", lambda: "1.8")
    return made, refused


def run(folder, *words):
    assert recordings.main(["--folder", str(folder), *words]) == 0


def test_the_plan_has_every_garment_in_two_fits_every_motion_and_every_fabric_in_balance():
    plan = entries()[:BALANCED]
    orders = [entry.order for entry in plan]
    assert len(plan) >= 60
    assert {order.n_frames for order in orders} == {120}
    pairs = Counter((order.garment, order.fit) for order in orders)
    assert set(pairs) == {(garment, fit) for garment in garments.GARMENTS for fit in ("close", "loose")}
    assert len(set(pairs.values())) == 1
    for part, most in (("motion", 1), ("fabric", 1)):
        counts = Counter(getattr(order, part) for order in orders)
        assert max(counts.values()) - min(counts.values()) <= most
    assert {order.motion for order in orders} == set(motions.MOTIONS)
    assert len({order.seed for order in orders}) == len({entry.name for entry in plan}) == len(plan)


@pytest.mark.parametrize("done", [11, 22, 33, 44, 55, 66])
def test_a_part_of_the_plan_is_in_balance_too(done):
    part = entries()[:done]
    for count in (Counter(entry.order.garment for entry in part), Counter(entry.order.fit for entry in part)):
        assert max(count.values()) - min(count.values()) <= 1
    assert max(Counter(entry.order.motion for entry in part).values()) <= done // 13 + 1
    assert sum(entry.split == collection.HELD_OUT for entry in part) / done == pytest.approx(1 / 3, abs=0.04)


def test_recordings_added_to_the_plan_are_for_training():
    added = entries()[BALANCED:LATER]
    assert added
    assert {entry.split for entry in added} == {collection.TRAINING}


def test_fresh_recordings_are_each_garment_once():
    fresh = entries()[LATER:]
    assert {entry.split for entry in fresh} == {collection.FRESH}
    assert sorted(entry.order.garment for entry in fresh) == sorted(garments.GARMENTS)
    assert len({entry.order.motion for entry in fresh}) == len(fresh)
    assert len({entry.seed for entry in entries()}) == len({entry.name for entry in entries()}) == len(entries())


def test_the_recordings_of_each_split_have_seeds_of_their_own():
    for entry in entries():
        attempts = [Entry(entry.number, attempt) for attempt in range(ATTEMPTS)]
        assert {attempt.split for attempt in attempts} == {entry.split}
        assert all(attempt.seed in SEEDS[entry.split] for attempt in attempts)
        assert len({attempt.seed for attempt in attempts}) == ATTEMPTS
    assert len(set().union(*SEEDS.values())) == sum(map(len, SEEDS.values()))


def test_a_stopped_run_goes_on_where_it_was(tmp_path, simulator):
    made, _ = simulator
    run(tmp_path, "--most", "2")
    first = (tmp_path / f"{entries()[0].name}.npz").read_bytes()
    run(tmp_path, "--most", "3")
    assert [order.seed for order in made] == [entry.seed for entry in entries()[:3]]
    assert (tmp_path / f"{entries()[0].name}.npz").read_bytes() == first
    assert [each.name for each in collection.listed(where=tmp_path)] == [entry.name for entry in entries()[:3]]
    (tmp_path / f"{entries()[1].name}.npz").unlink()
    run(tmp_path, "--most", "3")
    assert made[-1].seed == entries()[1].seed
    assert len(collection.listed(where=tmp_path)) == 3


def test_a_refused_seed_is_noted_and_not_tried_again(tmp_path, simulator):
    made, refused = simulator
    entry = entries()[0]
    refused |= {Entry(entry.number, attempt).seed for attempt in range(2)}
    run(tmp_path, "--only", entry.name)
    assert [each.seed for each in collection.listed(where=tmp_path)] == [Entry(entry.number, 2).seed]
    noted = json.loads((tmp_path / collection.MANIFEST).read_text())["refused"]
    assert [(row["seed"], row["reason"]) for row in noted] == [(entry.seed, "torn"), (entry.again().seed, "torn")]
    (tmp_path / f"{entry.name}.npz").unlink()
    run(tmp_path, "--only", entry.name)
    assert len(made) == 4


def test_after_the_last_attempt_the_next_recording_comes(tmp_path, simulator):
    made, refused = simulator
    refused |= {Entry(0, attempt).seed for attempt in range(ATTEMPTS)}
    run(tmp_path, "--most", "2")
    run(tmp_path, "--most", "2")
    assert len(made) == ATTEMPTS + 1
    assert [each.name for each in collection.listed(where=tmp_path)] == [entries()[1].name]


def test_a_recording_is_found_by_its_name_and_only_if_it_is_the_one_listed(tmp_path, simulator, monkeypatch):
    run(tmp_path, "--most", "3")
    monkeypatch.setenv(collection.VARIABLE, str(tmp_path))
    entry = entries()[1]
    expected, _ = simulated(entry.order)
    found = find_recording(entry.name)
    assert np.abs(found.garment_vertices - expected.garment_vertices).max() <= recordings.QUANTUM / 2 + 1e-7
    assert np.abs(found.body_vertices - expected.body_vertices).max() < 1e-6
    path = tmp_path / f"{entry.name}.npz"
    path.write_bytes((tmp_path / f"{entries()[0].name}.npz").read_bytes())
    with pytest.raises(InvalidFile, match="SHA-256"):
        collection.load(entry.name)
    path.unlink()
    with pytest.raises(InvalidFile, match="nothing there"):
        collection.load(entry.name)
    with pytest.raises(InvalidArgument, match="one of the 3"):
        collection.load("toga_walk")


def test_splits_are_listed_apart(tmp_path, simulator):
    run(tmp_path, "--most", "4")
    for split in (collection.TRAINING, collection.HELD_OUT):
        names = [entry.name for entry in entries()[:4] if entry.split == split]
        assert [each.name for each in collection.listed(split, tmp_path)] == names != []
    with pytest.raises(InvalidArgument, match="split"):
        collection.listed("test", tmp_path)
    assert collection.listed(where=tmp_path / "none") == []


def test_a_damaged_manifest_is_refused_in_a_sentence(tmp_path):
    (tmp_path / collection.MANIFEST).write_text('{"recordings": [{"name": "a"}]}')
    with pytest.raises(InvalidFile, match="a manifest of recordings"):
        collection.listed(where=tmp_path)


def test_an_exported_recording_is_an_ordinary_sequence_file(tmp_path, simulator):
    run(tmp_path, "--most", "1")
    name = entries()[0].name
    run(tmp_path, "--export", name, str(tmp_path / "plain.npz"))
    with np.load(tmp_path / "plain.npz") as archive:
        assert {"garment_V", "garment_F", "garment_rest", "body_V", "body_F", "fps"} <= set(archive.files)
    plain, packed = load_sequence(tmp_path / "plain.npz"), collection.load(name, tmp_path)
    assert np.array_equal(plain.garment_vertices, packed.garment_vertices)
    assert np.array_equal(plain.body_vertices, packed.body_vertices)


def test_the_check_finds_what_does_not_agree_with_the_manifest(tmp_path, simulator, capsys):
    run(tmp_path, "--most", "2")
    run(tmp_path, "--check")
    path = tmp_path / collection.MANIFEST
    content = json.loads(path.read_text())
    content["recordings"][0]["displacement_mean_mm"] += 3.0
    content["recordings"][1]["split"] = collection.TRAINING
    path.write_text(json.dumps(content))
    assert recordings.main(["--folder", str(tmp_path), "--check"]) == 1
    said = capsys.readouterr().out
    assert f"{entries()[0].name}: displacement_mean_mm differ from the manifest" in said
    assert f"{entries()[1].name}: split is not as planned" in said


def test_committed_recordings_are_there_unchanged_and_small():
    assert COMMITTED
    for each in COMMITTED:
        assert collection.checksum(collection.CHECKOUT / f"{each.name}.npz") == each.sha256
    assert {path.stem for path in collection.CHECKOUT.glob("*.npz")} == {each.name for each in COMMITTED}
    sizes = [(collection.CHECKOUT / f"{each.name}.npz").stat().st_size for each in COMMITTED]
    assert sum(sizes) * len(entries()) / len(sizes) < recordings.MOST_BYTES


@pytest.mark.parametrize("each", COMMITTED[:3], ids=lambda each: each.name)
def test_a_committed_recording_is_as_its_row_says(each):
    sequence = collection.load(each.name, collection.CHECKOUT)
    assert (sequence.garment, sequence.motion, sequence.fps, len(sequence)) == (each.garment, each.motion, 30.0, 120)
    assert sequence.garment_rest is not None
    assert sequence.has_body


@pytest.mark.slow
def test_all_committed_recordings_agree_with_the_manifest():
    assert recordings.problems(recordings.Manifest(collection.CHECKOUT), every=9) == []


@pytest.mark.slow
@pytest.mark.timeout(900)
def test_a_short_recording_of_the_plan_is_simulated_and_kept(tmp_path, monkeypatch):
    pytest.importorskip("newton", reason="Newton (extra simulation) is not installed")
    short = simulated_recording.Order("shorts", "turn", 6, 250, 30.0, 1_000, "close", "wool", 1_000, 12)
    monkeypatch.setattr(Entry, "order", property(lambda self: short))
    recordings.generate(recordings.Manifest(tmp_path), entries()[:1], Console(quiet=True))
    assert [each.name for each in collection.listed(where=tmp_path)] == [entries()[0].name]
    assert len(collection.load(entries()[0].name, tmp_path)) == 6
