"""Statistics of regions against those of NumPy on pixels that are chosen one by one."""

import numpy as np
import pytest

import levkas
from levkas.core.cube import Band, Cube, Flag
from levkas.database import regions
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer

SHAPE = (60, 80, 3)


@pytest.fixture(scope="module")
def planted(tmp_path_factory):
    """A layer with flags of all kinds, opened; and its values."""
    rng = np.random.default_rng(3)
    values = (0.4 + 0.1 * rng.standard_normal(SHAPE)).astype(np.float32)
    flags = np.zeros(SHAPE, np.uint8)
    flags[20:25, 30:40] = Flag.SATURATED
    flags[30:33, 30:33] = Flag.DEFECT  # replaced: sound
    flags[40, 40, 1] = Flag.GLARE
    values[20:25, 30:40] = 7.0
    folder = tmp_path_factory.mktemp("regions")
    bands = tuple(Band(f"{nm} nm", float(nm)) for nm in (450, 550, 650))
    cube = Cube(values, flags, None, bands, "reflectance")
    entry = write_layer(folder, Layer("icon1", "vis"), cube)[0]
    write_catalogue(folder, [entry])
    layer = levkas.open(folder)["icon1"]["vis"]
    return layer, np.asarray(layer.values, np.float64), flags


def expected(values, flags, mask):
    sound = mask[..., None] & ((flags == 0) | (flags == Flag.DEFECT))
    columns = [values[..., b][sound[..., b]] for b in range(values.shape[2])]
    return [c.mean() for c in columns], [c.std(ddof=1) for c in columns], [len(c) for c in columns]


@pytest.mark.parametrize("samples", [16_000_000, 500])
def test_regions_are_summed_as_numpy_sums_their_pixels(planted, monkeypatch, samples):
    monkeypatch.setattr(regions, "BLOCK_SAMPLES", samples)
    layer, values, flags = planted
    y, x = np.mgrid[: SHAPE[0], : SHAPE[1]]
    polygon = [(10.2, 5.1), (60.7, 12.3), (44.4, 50.6), (30.3, 22.4)]  # not convex
    inside = np.array(
        [[_in_polygon(polygon, px, py) for px in range(SHAPE[1])] for py in range(SHAPE[0])]
    )
    cases = [
        ({"rectangle": (25, 18, 45, 42)}, (x >= 25) & (x <= 45) & (y >= 18) & (y <= 42)),
        ({"circle": (35.5, 30.25, 9)}, (x - 35.5) ** 2 + (y - 30.25) ** 2 <= 81),
        ({"polygon": polygon}, inside),
        ({"rectangle": (-50, 55, 500, 90)}, y >= 55),  # reaches over the edge
    ]
    for region, mask in cases:
        found = layer.levkas.region(**region)
        mean, std, n = expected(values, flags, mask)
        np.testing.assert_allclose(found["mean"], mean, rtol=1e-12)
        np.testing.assert_allclose(found["std"], std, rtol=1e-10)
        assert found["n"].values.tolist() == n and int(found["pixels"]) == mask.sum()
        assert found["mean"].sel(band="550 nm") == found["mean"][1]


def _in_polygon(polygon, x, y):
    """By the winding number, another rule than the one that is tested; the polygon does not cross itself."""
    total = 0.0
    for (ax, ay), (bx, by) in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        a, b = complex(ax - x, ay - y), complex(bx - x, by - y)
        total += np.angle(b / a)
    return abs(total) > np.pi


def test_a_region_without_a_sound_pixel_has_no_mean(planted):
    found = planted[0].levkas.region(rectangle=(31, 21, 38, 23))
    assert found["n"].values.tolist() == [0, 0, 0] and int(found["pixels"]) == 24
    assert np.isnan(found["mean"]).all() and np.isnan(found["std"]).all()


@pytest.mark.parametrize(
    "region",
    [
        {},
        {"circle": (1, 1, 1), "rectangle": (0, 0, 1, 1)},
        {"circle": (1, 1, 0)},
        {"circle": (np.nan, 1, 2)},
        {"rectangle": (5, 0, 1, 1)},
        {"polygon": [(0, 0), (1, 1)]},
        {"rectangle": (200, 200, 300, 300)},
    ],
)
def test_what_is_no_region_is_refused(planted, region):
    with pytest.raises(regions.RegionRefused):
        planted[0].levkas.region(**region)
