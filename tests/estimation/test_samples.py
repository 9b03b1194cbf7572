import numpy as np
import pytest

import levkas
from levkas.core.cube import Cube
from levkas.core.problems import Refused
from levkas.database.layers import Layer, write_layer
from levkas.estimation.samples import SampleSource, require_layers
from levkas.estimation.splits import split_paintings

WAVES = np.arange(410.0, 711.0, 20.0)


def source_of(database, most=10_000):
    return SampleSource(levkas.open(database), "vis", most)


def test_flagged_pixels_are_on_neither_side(paintings):
    samples = source_of(paintings).read("icon1", ["rgb"])
    places = set(zip(samples.rows.tolist(), samples.columns.tolist(), strict=True))
    assert len(samples) == 40 * 48 - 6 - 1
    assert (10, 12) not in places and (0, 0) not in places and (10, 13) in places


def changed(database, name, camera, setup="", *, values=None, flags=None):
    """Write a layer again with other values or flags."""
    layer = levkas.open(database)[name][camera, setup]
    bands = tuple(levkas.Band(str(b)) for b in layer.band.values)
    values = layer.values if values is None else values
    flags = layer.levkas.flags.values if flags is None else flags
    cube = Cube(values, flags, layer.levkas.sigma.values, bands)
    write_layer(database, Layer(name, camera, setup), cube)


def test_gold_is_what_another_lighting_brightens_and_what_rises_to_red(own_paintings):
    before = source_of(own_paintings).read("icon1", ["rgb"])
    values = levkas.open(own_paintings)["icon1"]["rgb", "soft"].values.copy()
    values[20:30, 20:40] *= 2
    changed(own_paintings, "icon1", "rgb", "soft", values=values)
    samples = source_of(own_paintings).read("icon1", ["rgb"])
    vis, (rows, columns) = before.spectra, (before.rows, before.columns)
    inside = (rows >= 20) & (rows < 30) & (columns >= 20) & (columns < 40)
    red, blue = ((low <= WAVES) & (high >= WAVES) for low, high in ((600, 680), (430, 490)))
    gold = inside & (vis[:, red].mean(1) > 1.5 * vis[:, blue].mean(1))
    np.testing.assert_array_equal(samples.rows, rows[~gold])
    assert gold.sum() > 20


@pytest.mark.parametrize(("layer", "code"), [("rbg", "E_VALUE"), ("raw", "E_QUANTITY")])
def test_a_layer_that_is_not_there_or_in_counts_is_refused(paintings, layer, code):
    with pytest.raises(Refused) as refused:
        require_layers(levkas.open(paintings), [layer], "--from")
    assert refused.value.problems[0].code == code


@pytest.mark.parametrize(
    ("names", "options", "code"),
    [
        ("abc", {"train": ["a", "b"], "test": ["b"]}, "E_SPLIT_LEAK"),
        ("abc", {"test": ["d"]}, "E_VALUE"),
        ("abc", {"train": ["a", "b", "c"]}, "E_SPLIT"),
        ("a", {}, "E_SPLIT"),
    ],
)
def test_a_split_that_leaks_or_has_one_side_is_refused(names, options, code):
    with pytest.raises(Refused) as refused:
        split_paintings(list(names), **options)
    assert refused.value.problems[0].code == code
