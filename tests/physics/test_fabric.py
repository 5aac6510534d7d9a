import dataclasses

import numpy as np
import pytest

from ddakf.errors import InvalidConfig
from ddakf.physics import fabric
from ddakf.physics.fabric import PRESETS, Fabric


@pytest.mark.parametrize("name", ["cotton", "silk", "denim", "wool", "jersey", "normalised"])
def test_presets_by_attribute_and_by_name(name):
    assert Fabric.named(name) is getattr(Fabric, name.upper())
    assert Fabric.named(name.capitalize()) is PRESETS[name]


def test_a_preset_is_known_by_its_values():
    assert {name: Fabric(*dataclasses.astuple(preset)).name for name, preset in PRESETS.items()} == {
        name: "" if name == "normalised" else name for name in PRESETS
    }
    assert Fabric(bend=4.8).name == ""


def test_normalised_is_the_default_and_changes_nothing():
    assert Fabric.NORMALISED == Fabric() == Fabric(1.0, 1.0, 1.0)


def table():
    """Name: stretch, shear and bend, of the module's docstring."""
    rows = [line.split() for line in fabric.__doc__.splitlines()]
    return {row[0]: [float(x) for x in row[1:4]] for row in rows if row and row[0] in PRESETS}


def test_presets_are_the_values_of_the_table_over_their_geometric_means():
    values = table()
    assert set(values) == set(PRESETS) - {"normalised"}
    means = np.exp(np.mean(np.log(list(values.values())), axis=0))
    for name, moduli in values.items():
        preset = PRESETS[name]
        np.testing.assert_allclose([preset.stretch, preset.shear, preset.bend], moduli / means, rtol=0.06)


def test_order_of_the_fabrics():
    assert Fabric.SILK.bend < Fabric.COTTON.bend < Fabric.DENIM.bend
    assert Fabric.JERSEY.stretch < Fabric.COTTON.stretch < Fabric.DENIM.stretch


@pytest.mark.parametrize("value", [-0.1, float("nan"), float("inf"), "2", None, True])
@pytest.mark.parametrize("field", ["stretch", "shear", "bend"])
def test_impossible_multipliers_are_refused(field, value):
    with pytest.raises(InvalidConfig, match=f"fabric.{field}"):
        Fabric(**{field: value})


@pytest.mark.parametrize("name", ["tweed", "", None, 3])
def test_unknown_names_are_refused_with_the_known_ones(name):
    with pytest.raises(InvalidConfig, match="cotton, silk, denim, wool, jersey, normalised"):
        Fabric.named(name)
