"""Configuration: presets, plain dictionaries and back, and what is refused."""

import dataclasses
import json
import typing

import pytest

from ddakf import Config, Fabric, Tracker
from ddakf.config import Checked
from ddakf.errors import InvalidConfig
from tests.physics.shapes import sheet

PRESETS = {"default": Config(), "fast": Config.fast(), "paper": Config.paper()}
EACH = pytest.mark.parametrize("preset", list(PRESETS.values()), ids=list(PRESETS))


def variants():
    """Every dataclass that a stage may be configured with, by (stage, class)."""
    for stage, hint in typing.get_type_hints(Config).items():
        for kind in typing.get_args(hint) or (hint,):
            yield pytest.param(stage, kind, id=f"{stage}-{kind.__name__}")


def ranged():
    """(stage, class, field) of every number that has a range."""
    for parameter in variants():
        stage, kind = parameter.values
        for field in dataclasses.fields(kind):
            if "range" in field.metadata:
                yield pytest.param(stage, kind, field, id=f"{parameter.id}-{field.name}")


@EACH
def test_presets_survive_a_round_trip_through_json(preset):
    text = json.dumps(preset.to_dict())
    assert Config.from_dict(json.loads(text)) == preset


@pytest.mark.parametrize(("stage", "kind"), list(variants()))
def test_every_variant_survives_a_round_trip(stage, kind):
    base = Config.paper() if isinstance(getattr(Config.paper(), stage), kind) else Config()
    config = dataclasses.replace(base, **{stage: kind()})
    values = config.to_dict()
    assert values[stage]["type"] == kind.__name__
    assert Config.from_dict(values) == config


@pytest.mark.parametrize("fabric", [Fabric.COTTON, Fabric.DENIM, Fabric(stretch=0.3, shear=2.0, bend=0.0)])
def test_fabrics_survive_a_round_trip_and_go_by_name(fabric):
    config = Config().with_fabric(fabric)
    assert Config.from_dict(config.to_dict()) == config
    assert Config.from_dict({"physics": {"fabric": "denim"}}).physics.fabric == Fabric.DENIM


@pytest.mark.parametrize("stage", ["associate", "fuse"])
def test_variants_that_do_not_fit_together_are_refused(stage):
    """Residual noise needs planes, the decoupled update points."""
    with pytest.raises(InvalidConfig):
        dataclasses.replace(Config(), **{stage: getattr(Config.paper(), stage)})


def test_what_is_left_out_keeps_its_default():
    assert Config.from_dict({}) == Config()
    assert Config.from_dict({"preset": "paper"}) == Config.paper()
    assert Config.from_dict({"preset": "fast"}) == Config.fast()
    changed = Config.from_dict({"preset": "paper", "predict": {"acceleration": 3.0}})
    expected = dataclasses.replace(Config.paper().predict, acceleration=3.0)
    assert changed == dataclasses.replace(Config.paper(), predict=expected)


def test_the_papers_preset_differs_in_every_change_that_the_default_makes():
    default, paper = Config(), Config.paper()
    for stage in ("preprocess", "associate", "adapt", "fuse", "reliability"):
        assert type(getattr(default, stage)) is not type(getattr(paper, stage))


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"nonsense": {}}, "config.nonsense"),
        ({"predict": {"nonsense": 1}}, "config.predict.nonsense"),
        ({"predict": {"type": "Nonsense"}}, "config.predict.type"),
        ({"predict": 3}, "config.predict"),
        ({"predict": None}, "config.predict"),
        ({"preset": "nonsense"}, "config.preset"),
        ({"preset": ["paper"]}, "config.preset"),
        ({"physics": {"fabric": "nonsense"}}, "config.physics.fabric"),
        ({"physics": {"fabric": 3}}, "config.physics.fabric"),
        ({"physics": {"fabric": {"warp": 1.0}}}, "config.physics.fabric.warp"),
        ({"physics": {"fabric": {"stretch": -1.0}}}, "config.physics.fabric.stretch"),
        ({"physics": {"stretch": -1.0}}, "config.physics.stretch"),
        ({"preset": "paper", "predict": {"type": "ConstantAcceleration", "damping": "no"}}, "config.predict.damping"),
        (["predict"], "config"),
        (None, "config"),
        ("paper", "config"),
    ],
    ids=str,
)
def test_unknown_names_and_types_are_refused_by_name(values, field):
    with pytest.raises(InvalidConfig) as refusal:
        Config.from_dict(values)
    assert refusal.value.field == field
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("stage", list(Config().to_dict()))
def test_a_stage_of_another_type_is_refused_where_it_is_given(stage):
    """It would fail in the first frame otherwise, with an error that names no field."""
    for value in ({"up": "z"}, None, "paper", Fabric()):
        with pytest.raises(InvalidConfig) as refusal:
            Config(**{stage: value})
        assert (refusal.value.field, refusal.value.got) == (f"config.{stage}", type(value).__name__)


def test_a_fabrics_name_is_not_taken_for_a_fabric():
    with pytest.raises(InvalidConfig) as refusal:
        Config().with_fabric("denim")
    assert str(refusal.value) == "Physics.fabric: expected a ddakf.Fabric (Fabric.named finds one by name), got 'denim'"


@pytest.mark.parametrize("text", ["k" * 5000, "two\nlines", "\ud800", "'" * 5000, "\n" * 5000], ids=range(5))
@pytest.mark.parametrize(
    "values",
    [
        lambda text: {text: {}},
        lambda text: {"preset": text},
        lambda text: {"predict": {text: 1}},
        lambda text: {"predict": {"type": text}},
        lambda text: {"predict": {"damping": text}},
        lambda text: {"start": {"search": text}},
        lambda text: {"physics": {"fabric": text}},
        lambda text: {"physics": {"fabric": {text: 1.0}}},
        lambda text: {"physics": {"fabric": {"stretch": text}}},
    ],
)
def test_a_refusal_is_one_short_line_whatever_came(values, text):
    with pytest.raises(InvalidConfig) as refusal:
        Config.from_dict(values(text))
    for part in (str(refusal.value), refusal.value.field):
        assert len(part.encode()) < 1000
        assert part.isprintable()


@pytest.mark.parametrize("value", [[], {}, None, b"GridFilter", 3.0])
def test_a_variants_name_that_is_no_text_is_refused(value):
    with pytest.raises(InvalidConfig):
        Config.from_dict({"predict": {"type": value}})


@pytest.mark.parametrize(("stage", "kind", "field"), list(ranged()))
def test_numbers_are_checked_against_their_range(stage, kind, field):
    low, high = field.metadata["range"]
    whole = isinstance(field.default, int)
    assert low <= field.default <= high
    for inside in (low, high):
        inside = int(inside) if whole else inside
        assert getattr(kind(**{field.name: inside}), field.name) == inside
    step = 1 if whole else max(abs(low), abs(high)) * 1e-6
    for bad in (low - step, high + step, float("nan"), float("inf"), "1", None, True, [1.0]):
        with pytest.raises(InvalidConfig) as refusal:
            kind(**{field.name: bad})
        assert field.name in refusal.value.field
    with pytest.raises(InvalidConfig):
        Config.from_dict({stage: {"type": kind.__name__, field.name: high + step}})


@pytest.mark.parametrize(("stage", "kind", "field"), [p for p in ranged() if isinstance(p.values[2].default, int)])
def test_counts_are_whole_numbers(stage, kind, field):
    with pytest.raises(InvalidConfig):
        kind(**{field.name: field.default + 0.5})


def test_switches_are_true_or_false():
    with pytest.raises(InvalidConfig):
        Config.from_dict({"start": {"search": "no"}})


@pytest.mark.parametrize(("stage", "kind"), list(variants()))
def test_every_number_has_a_range(stage, kind):
    """A number that is not checked would pass infinity into the estimator."""
    assert issubclass(kind, Checked)
    for field in dataclasses.fields(kind):
        if isinstance(field.default, (int, float)) and not isinstance(field.default, bool):
            assert "range" in field.metadata, field.name


@EACH
def test_configurations_cannot_be_changed_in_place_and_can_be_hashed(preset):
    with pytest.raises(dataclasses.FrozenInstanceError):
        preset.predict.damping = 1.0
    assert hash(preset) == hash(Config.from_dict(preset.to_dict()))


def test_a_tracker_takes_the_configuration_it_is_given():
    assert Tracker(sheet()).config == Config()
    config = Config.paper()
    assert Tracker(sheet(), config=config).config is config


def test_a_whole_number_where_a_float_is_meant_is_one():
    given = Config.from_dict({"physics": {"strain_sd": 1}, "uncertainty": {"ceiling_sd": 1}})
    assert given == Config.from_dict({"physics": {"strain_sd": 1.0}, "uncertainty": {"ceiling_sd": 1.0}})
    assert type(given.physics.strain_sd) is float
    assert type(given.associate.iterations) is int
