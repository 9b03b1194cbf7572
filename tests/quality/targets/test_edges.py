"""Slanted edges with a known response, shift and noise."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ndtr

from levkas.core.cube import Band, Cube
from levkas.quality.image_quality.slanted_edge import EdgeRefused, measure_edge
from levkas.quality.targets.edges import measure_named, parse_edges

SUBPIXELS = (np.arange(8) + 0.5) / 8 - 0.5


def edge(sigma, degrees, *, shift=0.0, shape=(100, 64), low=0.1, high=0.7):
    """An edge behind a Gaussian of sigma px and the square aperture of a pixel, by 8 x 8 samples each."""
    y, x = np.mgrid[: shape[0], : shape[1]].astype(float)
    lean = np.deg2rad(degrees)
    observed = np.zeros(shape)
    for dy in SUBPIXELS:
        for dx in SUBPIXELS:
            across = (x + dx - shape[1] / 2 - shift) * np.cos(lean)
            observed += ndtr((across - (y + dy - shape[0] / 2) * np.sin(lean)) / sigma)
    return low + (high - low) * observed / len(SUBPIXELS) ** 2


def true_frequency(sigma, degrees, modulation):
    lean = np.deg2rad(degrees)

    def off(f):
        aperture = np.sinc(f * np.cos(lean)) * np.sinc(f * np.sin(lean))
        return np.exp(-2 * (np.pi * sigma * f) ** 2) * abs(aperture) - modulation

    return brentq(off, 1e-4, 0.99)


@pytest.mark.parametrize(
    ("sigma", "degrees"), [(0.3, 5.0), (0.5, -7.0), (0.8, 2.5), (0.8, 25.0), (1.5, 9.3), (3.0, 5.0)]
)
def test_the_response_is_that_of_the_blur_and_the_pixel(sigma, degrees):
    found = measure_edge(edge(sigma, degrees, shape=(100, 96)))
    assert found.sfr50 == pytest.approx(true_frequency(sigma, degrees, 0.5), rel=0.005)
    assert found.sfr10 == pytest.approx(true_frequency(sigma, degrees, 0.1), rel=0.01)
    assert found.angle_deg == pytest.approx(degrees, abs=0.02) and found.axis == "x"
    assert found.most == pytest.approx(1.0, abs=1e-3)
    assert found.efficiency == pytest.approx(min(1.0, found.sfr10 / 0.5))


def test_an_edge_near_the_rows_is_the_same_turned_and_may_fall():
    upright, level = edge(0.8, 5), edge(0.8, 5).T
    across, down = measure_edge(upright), measure_edge(level)
    assert (across.axis, down.axis) == ("x", "y")
    assert down.response == pytest.approx(across.response)
    falling = measure_edge(edge(0.8, 5, low=0.7, high=0.1))
    assert falling.response == pytest.approx(across.response, abs=1e-9)


def test_a_shift_between_bands_is_found_at_sub_pixel_accuracy_through_noise():
    rng = np.random.default_rng(3)
    off, halves = [], []
    for _ in range(12):
        pair = [
            measure_edge(edge(s, 5, shift=at) + 0.006 * rng.standard_normal((100, 64)))
            for s, at in ((0.8, 0.0), (1.1, 0.30))
        ]
        off.append(pair[1].position - pair[0].position - 0.30 * np.cos(np.deg2rad(5)))
        halves.append(pair[0].sfr50 / true_frequency(0.8, 5, 0.5) - 1)
    assert np.abs(off).max() < 0.02  # px, noise 1 % of the edge
    assert abs(np.mean(halves)) < 0.01 and np.std(halves) < 0.02


@pytest.mark.parametrize(
    ("plane", "code"),
    [
        (edge(0.8, 0), "E_EDGE_ANGLE"),
        (edge(0.8, 38), "E_EDGE_ANGLE"),
        (edge(0.8, 45, shape=(64, 64)), "E_EDGE_ANGLE"),
        (edge(0.8, 5, low=0.5, high=0.6), "E_EDGE_CONTRAST"),
        (edge(0.8, 5) + 0.2 * np.random.default_rng(1).standard_normal((100, 64)), "E_EDGE_CONTRAST"),
        (edge(0.8, 5, shape=(100, 10)), "E_EDGE_SHORT"),
        (edge(0.8, 5, shape=(15, 64)), "E_EDGE_SHORT"),
        (edge(0.8, 5)[:, 25:], "E_EDGE_SHORT"),
        (edge(3.0, 5, shape=(100, 32)), "E_EDGE_SHORT"),
        (np.where(np.arange(6400).reshape(100, 64) == 7, np.nan, edge(0.8, 5)), "E_EDGE_MISSING"),
        (np.array([np.roll(r, int(6 * np.sin(i / 7))) for i, r in enumerate(edge(0.8, 5))]), "E_EDGE_MISSING"),
    ],
)  # fmt: skip
def test_what_cannot_be_measured_is_refused_by_name(plane, code):
    with pytest.raises(EdgeRefused) as refused:
        measure_edge(plane)
    assert refused.value.problems[0].code == code


def test_saturation_and_an_edge_that_does_not_cross_a_mosaic_s_period_are_refused():
    plane = edge(0.8, 5)  # moves by 8.7 px
    assert measure_edge(plane, period=8).sfr50 == pytest.approx(measure_edge(plane).sfr50, rel=0.01)
    for more, code in (
        ({"saturated": plane > 0.69}, "E_EDGE_SATURATED"),
        ({"period": 9}, "E_EDGE_SHORT"),
    ):
        with pytest.raises(EdgeRefused) as refused:
            measure_edge(plane, **more)
        assert refused.value.problems[0].code == code


def cube_of(planes, labels=None):
    values = np.stack(planes, -1).astype(np.float32)
    bands = tuple(Band(label) for label in labels or "RGB")
    return Cube(values, np.zeros(values.shape, np.uint8), None, bands[: values.shape[2]])


def test_named_edges_are_tabulated_and_a_band_without_an_edge_is_noted():
    planes = [edge(0.7, 5), edge(0.8, 5, shift=0.3), np.full((100, 64), 0.4)]
    found = measure_named(cube_of(planes), parse_edges(["2,4,60,92"]))
    (table,) = found.tables
    assert table.largest_shift == pytest.approx(0.30 * np.cos(np.deg2rad(5)), abs=0.005)
    assert np.isnan(table.sfr50[2]) and list(table.refused) == ["B"]
    assert found.notes and (found.rows[-1].fadgi, found.rows[-1].iso) == ("4 stars", "–")
    record = table.to_dict()
    assert record["bands"][2]["sfr50"] is None and record["rectangle"] == [2, 4, 60, 92]
