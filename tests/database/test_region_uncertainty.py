"""What is read from a region carries the errors of its pixels and those that they share."""

import numpy as np
import pytest
from scipy import ndimage

from levkas.calibration.error_sources import ErrorSource
from levkas.core.cube import Band
from levkas.database.described import Pixels
from levkas.database.layout import LayerId
from levkas.database.region_uncertainty import (
    LayerBudget,
    combine,
    mean_of_region,
    to_dataset,
    uncertain_region,
)
from levkas.database.regions import RegionRefused, make_region

LAYER = LayerId("icon1", "cam")
BANDS, NM = ["450 nm", "550 nm", "650 nm"], [450.0, 550.0, 650.0]


SEEN = [Band(label, nm) for label, nm in zip(BANDS, NM, strict=True)]


def blank(height=120, width=130):
    return np.zeros((height, width, 3))


@pytest.mark.parametrize(("side", "share"), [(1, 1.0), (10, None), (100, None)])
def test_the_mean_of_pixels_that_share_noise_scatters_as_is_said(side, share):
    """Noise that was interpolated by a kernel, drawn again and again: means scatter by its own sums, which are not the module's."""
    kernel = np.outer([0.25, 0.5, 0.25], [0.1, 0.8, 0.1])
    correlation = ndimage.correlate(np.pad(kernel, 2), kernel, mode="constant")
    correlation /= correlation[3, 3]
    sigma = 0.01 * np.sqrt((kernel**2).sum())
    rng, means = np.random.default_rng(4), []
    for _ in range(600):
        noise = ndimage.convolve(0.01 * rng.standard_normal((120, 130)), kernel, mode="wrap")
        means.append(noise[10 : 10 + side, 15 : 15 + side].mean())
    region = make_region(None, (15, 10, 14 + side, 9 + side), None)
    found = mean_of_region(
        Pixels(blank() + 0.3, blank().astype(np.uint8), blank() + sigma),
        SEEN, region, correlation,
    )  # fmt: skip
    assert found.random == pytest.approx([np.std(means)] * 3, rel=0.08)
    alone = sigma / side
    assert share is None or found.random[0] == pytest.approx(share * alone)
    if (
        side == 100
    ):  # many pixels: the noise of the sensor's own pixels, which the kernel only moves
        assert found.random[0] == pytest.approx(0.01 / side, rel=0.03)


def test_flagged_pixels_do_not_count_and_empty_regions_are_refused():
    values, flags = blank() + 0.5, blank().astype(np.uint8)
    values[20:25, 20:25], flags[20:25, 20:25] = 9.0, 4
    arrays = Pixels(values, flags, blank() + 0.01), SEEN
    found = mean_of_region(*arrays, make_region(None, (20, 20, 29, 29), None))
    assert found.values.tolist() == pytest.approx([0.5] * 3)
    assert found.random == pytest.approx([0.01 / np.sqrt(75)] * 3)
    assert np.allclose(found.gradient, 0)
    with pytest.raises(RegionRefused):
        mean_of_region(*arrays, make_region(None, (500, 20, 529, 29), None))


@pytest.mark.parametrize("region", [(40, 30, 40, 30), (40, 30, 49, 39), (0, 0, 0, 0)])
def test_a_slope_of_the_picture_is_known_up_to_the_rim_of_a_region(region):
    y, x = np.indices((120, 130))
    values = np.repeat((0.3 + 0.002 * x - 0.001 * y)[..., None], 3, 2)
    arrays = Pixels(values, blank().astype(np.uint8), blank() + 0.01), SEEN
    found = mean_of_region(*arrays, make_region(None, region, None))
    assert np.allclose(found.gradient, [[0.002] * 3, [-0.001] * 3])
    assert found.lines == region[3] - region[1] + 1
    x0, y0, x1, y1 = region
    assert found.values == pytest.approx(values[y0 : y1 + 1, x0 : x1 + 1].mean((0, 1)))
    assert found.random == pytest.approx([0.01 / (x1 - x0 + 1)] * 3)


def budget_of(**sizes):
    return LayerBudget(
        tuple(
            ErrorSource(name, "relative", dict.fromkeys(BANDS, size), "frame", all_bands=True)
            for name, size in sizes.items()
        )
    )


def test_what_two_regions_share_leaves_their_ratio_and_stays_in_their_difference():
    values = blank() + 0.4
    values[:, 65:] = 0.2
    arrays = Pixels(values, blank().astype(np.uint8), blank() + 0.002), SEEN
    first, second = (
        uncertain_region(mean_of_region(*arrays, region), budget_of(white=0.01), LAYER, str(k))
        for k, region in enumerate(make_region(None, (x, 10, x + 9, 19), None) for x in (10, 80))
    )
    ratio, names = combine("ratio", BANDS, np.array(NM), first, second)
    assert names == BANDS and ratio.values == pytest.approx([2.0] * 3)
    # By hand: noise of a mean of 100 is 0.0002, in each; u(ratio) = 2·√((0.0002/0.4)² + (0.0002/0.2)²).
    assert ratio.sigma == pytest.approx([2 * np.hypot(0.0005, 0.001)] * 3, rel=1e-4)
    apart, _ = combine("difference", BANDS, np.array(NM), first, second)
    assert apart.sigma == pytest.approx([np.hypot(0.0002 * 2**0.5, 0.01 * 0.2)] * 3, rel=1e-4)
    colour, names = combine("delta_e", BANDS, np.array(NM), first, second)
    assert names == ["ΔE2000"] and colour.values[0] > 10 and 0 < colour.sigma[0] < 0.5
    table = to_dataset(apart, BANDS, ["stray light"])
    assert np.allclose(table.U, 2 * table.u) and table.attrs["not_known"] == ["stray light"]
    assert np.allclose(np.hypot(table.u_random, table.u_common), table.u)


@pytest.mark.parametrize(
    ("of", "bands", "two"),
    [
        ("ratio", BANDS, False),
        ("delta_e", BANDS[:2], True),
        ("mean", BANDS, True),
        ("sum", BANDS, True),
    ],
)
def test_what_cannot_be_made_of_the_bands_is_refused(of, bands, two):
    arrays = Pixels(blank() + 0.4, blank().astype(np.uint8), None), SEEN
    region = make_region(None, (1, 1, 5, 5), None)
    one = uncertain_region(mean_of_region(*arrays, region), LayerBudget(), LAYER, "a")
    nm = np.array(NM[: len(bands)])
    with pytest.raises(RegionRefused) as refused:
        combine(of, bands, nm, one, one if two else None)
    assert refused.value.problems[0].expected
