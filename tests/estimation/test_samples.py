import numpy as np
import pytest

import levkas
from levkas.core.cube import Flag
from levkas.core.problems import Refused
from levkas.database.catalogue import read_catalogue, write_catalogue
from levkas.estimation.samples import SampleSource, require_layers

WAVES = np.arange(410.0, 711.0, 20.0)


def source_of(database, most=10_000):
    return SampleSource(levkas.open(database), "vis", most)


def test_flagged_pixels_are_on_neither_side(paintings):
    samples = source_of(paintings).read("icon1", ["rgb"])
    places = set(zip(samples.rows.tolist(), samples.columns.tolist(), strict=True))
    assert len(samples) == 40 * 48 - 6 - 1
    assert (10, 12) not in places and (0, 0) not in places and (10, 13) in places


def test_samples_are_the_values_of_the_layers_at_their_places(paintings):
    samples = source_of(paintings, most=400).read("icon2", ["rgb", "cam2"])
    vis = levkas.open(paintings)["icon2"]["vis"].values
    rgb = levkas.open(paintings)["icon2"]["rgb"].values
    np.testing.assert_array_equal(samples.spectra, vis[samples.rows, samples.columns])
    np.testing.assert_array_equal(samples.responses[:, :3], rgb[samples.rows, samples.columns])
    assert samples.responses.shape[1] == 6 and set(samples.rows % 3) == {0}


def test_gold_is_what_another_lighting_brightens_and_what_rises_to_red(own_paintings):
    from levkas.core.cube import Cube
    from levkas.database.layers import Layer, write_layer

    database = levkas.open(own_paintings)
    layer = database["icon1"]["rgb", "soft"]
    values = layer.values.copy()
    values[20:30, 20:40] *= 2
    bands = tuple(levkas.Band(str(b)) for b in layer.band.values)
    cube = Cube(values, layer.flags.values, layer.sigma.values, bands)
    write_layer(own_paintings, Layer("icon1", "rgb", "soft"), cube)
    samples = source_of(own_paintings).read("icon1", ["rgb"])
    inside = (
        (samples.rows >= 20)
        & (samples.rows < 30)
        & (samples.columns >= 20)
        & (samples.columns < 40)
    )
    vis = samples.spectra
    rises = vis[:, (WAVES >= 600) & (WAVES <= 680)].mean(1) > 1.5 * vis[
        :, (WAVES >= 430) & (WAVES <= 490)
    ].mean(1)
    np.testing.assert_array_equal(samples.gold, inside & rises)
    assert samples.gold.sum() > 20


@pytest.mark.parametrize(
    ("layer", "code", "words"),
    [("rbg", "E_VALUE", "Did you mean 'rgb'?"), ("raw", "E_QUANTITY", "reflectance")],
)
def test_a_layer_that_is_not_there_or_in_counts_is_refused(paintings, layer, code, words):
    with pytest.raises(Refused, match=words.replace("?", r"\?")) as refused:
        require_layers(levkas.open(paintings), [layer], "--from")
    assert refused.value.problems[0].code == code


def test_masks_without_overlap_are_refused(own_paintings):
    from levkas.core.cube import Cube
    from levkas.database.layers import Layer, write_layer

    layer = levkas.open(own_paintings)["icon1"]["rgb"]
    bands = tuple(levkas.Band(str(b)) for b in layer.band.values)
    flags = np.full(layer.shape, Flag.GLARE, np.uint8)
    write_layer(own_paintings, Layer("icon1", "rgb"), Cube(layer.values, flags, None, bands))
    with pytest.raises(Refused, match="icon1") as refused:
        source_of(own_paintings).read("icon1", ["rgb"])
    assert refused.value.problems[0].code == "E_NO_OVERLAP"


def test_a_catalogue_tells_kinds_only_where_a_layer_was_estimated(own_paintings):
    from dataclasses import replace

    before = (own_paintings / "catalogue.csv").read_bytes()
    entries = read_catalogue(own_paintings)
    write_catalogue(own_paintings, entries)
    assert (own_paintings / "catalogue.csv").read_bytes() == before and b"kind" not in before
    write_catalogue(own_paintings, [replace(entries[0], kind="estimated"), *entries[1:]])
    assert [e.kind for e in read_catalogue(own_paintings)].count("estimated") == 1
