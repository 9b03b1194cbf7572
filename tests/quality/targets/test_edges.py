"""Slanted edges with a known response, shift and noise."""

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import ndtr

from levkas.core.cube import Band, Cube, Flag
from levkas.quality.image_quality.slanted_edge import EdgeRefused, largest_shift, measure_edge
from levkas.quality.targets.charts import CHARTS, reference_of
from levkas.quality.targets.edges import (
    EdgePlace,
    EdgeTargetMeasure,
    layer_rows,
    measure_named,
    parse_edges,
)
from levkas.quality.targets.indicators import LIMITS, indicator, lightness_slope
from levkas.quality.targets.locating import locate_chart
from levkas.quality.targets.measuring import Sighting, measure, noise_of_lightness

SUBPIXELS = (np.arange(8) + 0.5) / 8 - 0.5
CLASSIC = CHARTS["ColorChecker24"]


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


@pytest.mark.parametrize("degrees", [2.5, 5.0, 9.3, -7.0, 25.0])
@pytest.mark.parametrize("sigma", [0.3, 0.5, 0.8, 1.5, 3.0])
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


def test_sharpening_shows_as_modulation_above_one():
    plane = edge(0.4, 5)
    soft = np.mean([np.roll(plane, s, 1) for s in (-1, 0, 1)], 0)
    sharpened = (plane + 1.5 * (plane - soft))[:, 2:-2]
    # 1 + 1.5 (1 − (1 + 2 cos 2πf)/3) times the edge's own response
    f = measure_edge(plane).frequencies
    gain = 1 + 1.5 * (2 - 2 * np.cos(2 * np.pi * f * np.cos(np.deg2rad(5)))) / 3
    expected = (measure_edge(plane).response * gain)[f <= 0.5].max()
    found = measure_edge(sharpened)
    assert expected > 1.05
    assert found.most == pytest.approx(expected, rel=0.01)


def test_a_shift_between_bands_is_found_at_sub_pixel_accuracy_through_noise():
    rng = np.random.default_rng(3)
    off, halves = [], []
    for _ in range(12):
        pair = [
            measure_edge(edge(s, 5, shift=at) + 0.006 * rng.standard_normal((100, 64)))
            for s, at in ((0.8, 0.0), (1.1, 0.30))
        ]
        off.append(largest_shift(pair) - 0.30 * np.cos(np.deg2rad(5)))
        halves.append(pair[0].sfr50 / true_frequency(0.8, 5, 0.5) - 1)
    assert np.abs(off).max() < 0.02  # px, noise 1 % of the edge
    assert abs(np.mean(halves)) < 0.01 and np.std(halves) < 0.02


@pytest.mark.parametrize(
    ("plane", "code"),
    [
        (edge(0.8, 0), "E_EDGE_ANGLE"),
        (edge(0.8, 1.2), "E_EDGE_ANGLE"),
        (edge(0.8, 38), "E_EDGE_ANGLE"),
        (edge(0.8, 45, shape=(64, 64)), "E_EDGE_ANGLE"),
        (edge(0.8, np.rad2deg(np.arctan(0.5)), shape=(40, 64)), "E_EDGE_ANGLE"),
        (edge(0.8, 5, low=0.5, high=0.6), "E_EDGE_CONTRAST"),
        (edge(0.8, 5) + 0.2 * np.random.default_rng(1).standard_normal((100, 64)), "E_EDGE_CONTRAST"),
        (edge(0.8, 5, shape=(100, 10)), "E_EDGE_SHORT"),
        (edge(0.8, 5, shape=(15, 64)), "E_EDGE_SHORT"),
        (edge(0.8, 3, shape=(18, 64)), "E_EDGE_SHORT"),
        (edge(0.8, 5)[:, 25:], "E_EDGE_SHORT"),
        (edge(3.0, 5, shape=(100, 32)), "E_EDGE_SHORT"),
        (np.full((60, 60), 0.3), "E_EDGE_CONTRAST"),
        (np.where(np.arange(6400).reshape(100, 64) == 7, np.nan, edge(0.8, 5)), "E_EDGE_MISSING"),
    ],
)  # fmt: skip
def test_what_cannot_be_measured_is_refused_by_name(plane, code):
    with pytest.raises(EdgeRefused) as refused:
        measure_edge(plane)
    assert refused.value.problems[0].code == code


def test_saturation_and_two_edges_are_refused():
    plane = edge(0.8, 5)
    full = plane > 0.69
    with pytest.raises(EdgeRefused) as refused:
        measure_edge(plane, full)
    assert refused.value.problems[0].code == "E_EDGE_SATURATED"
    wavy = np.array([np.roll(row, int(6 * np.sin(i / 7))) for i, row in enumerate(plane)])
    with pytest.raises(EdgeRefused) as refused:
        measure_edge(wavy)
    assert refused.value.problems[0].code == "E_EDGE_MISSING"


def test_an_edge_of_a_mosaic_must_cross_its_period():
    plane = edge(0.8, 5)  # moves by 8.7 px
    assert measure_edge(plane, period=8).sfr50 == pytest.approx(measure_edge(plane).sfr50, rel=0.01)
    with pytest.raises(EdgeRefused) as refused:
        measure_edge(plane, period=9)
    assert refused.value.problems[0].code == "E_EDGE_SHORT"


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
    assert "no response of B" in found.notes[0]
    assert next(row.name.split(",")[0] for row in found.rows) == "sampling efficiency"
    shift = found.rows[-1]
    assert shift.fadgi == "4 stars" and shift.iso == "–" and "R to G" in shift.name
    record = table.to_dict()
    assert record["bands"][2]["sfr50"] is None and record["rectangles"] == [[2, 4, 60, 92]]


@pytest.mark.parametrize(("text", "code"), [("2,4,60", "E_VALUE"), ("a,b,c,d", "E_VALUE")])
def test_an_edge_that_cannot_be_read_is_refused(text, code):
    with pytest.raises(EdgeRefused) as refused:
        parse_edges([text])
    assert refused.value.problems[0].code == code


def test_a_rectangle_beyond_the_frame_and_a_flat_one_are_problems():
    found = measure_named(
        cube_of([edge(0.8, 5)]), [EdgePlace("a", (40, 0, 60, 60)), EdgePlace("b", (0, 0, 20, 60))]
    )
    assert [p.code for p in found.problems] == ["E_REGION", "E_EDGE_CONTRAST"]
    assert found.problems[1].message.startswith("b: ") and not found.tables


def test_the_same_edge_in_two_layers_shows_how_they_are_off():
    places = parse_edges(["0,0,64,100"])
    measures = [
        EdgeTargetMeasure(f"panel/{name}", {"": cube}, measure_named(cube, places))
        for name, cube in (
            ("vis", cube_of([edge(0.7, 5), edge(0.8, 5)])),
            ("nir", cube_of([edge(1.2, 5, shift=-0.6, low=0.2, high=0.9)])),
            ("other", cube_of([edge(0.8, 5).T[:, :64].repeat(2, 0)[:100]])),
        )
    ]
    (row,) = layer_rows(measures)
    assert row.value == pytest.approx(0.6 * np.cos(np.deg2rad(5)), abs=0.01)
    assert "nir to vis" in row.name and row.fadgi == "2 stars"


NM = np.array([450.0, 500, 550, 600, 650, 700, 420, 480, 620])
PITCH = 70


def leaning_chart(degrees, *, sigma=0.7, noise=0.0, shift=0.0):
    """A chart of patches and black gaps that leans, rendered at 4 x 4 samples a pixel; the last band is shifted."""
    from scipy.ndimage import gaussian_filter

    spectra = reference_of(CLASSIC).at(NM)
    corners = (CLASSIC.corners + 0.5) * PITCH
    lean = np.deg2rad(degrees)
    turn = np.array([[np.cos(lean), -np.sin(lean)], [np.sin(lean), np.cos(lean)]])
    at = np.array([60.0, 40.0])
    y, x = np.mgrid[: 4 * 400, : 4 * 520] / 4 - 0.375
    planes = []
    for band in range(len(NM)):
        moved = np.stack([x - at[0] - shift * (band == 8), y - at[1]], -1) @ turn
        column, row = (np.floor(moved[..., i] / PITCH).astype(int) for i in (0, 1))
        within = moved / PITCH - np.stack([column, row], -1)
        patch = np.all(np.abs(within - 0.5) < 0.41, -1)
        patch &= (column >= 0) & (column < 6) & (row >= 0) & (row < 4)
        index = np.clip(row, 0, 3) * 6 + np.clip(column, 0, 5)
        fine = np.where(patch, spectra[index, band], 0.03)
        fine = gaussian_filter(fine, 4 * sigma)
        planes.append(fine.reshape(400, 4, 520, 4).mean((1, 3)))
    values = np.stack(planes, -1)
    values += noise * np.random.default_rng(2).standard_normal(values.shape)
    bands = tuple(Band(f"{w:g} nm", float(w)) for w in NM)
    cube = Cube(values.astype(np.float32), np.zeros(values.shape, np.uint8), None, bands)
    return cube, corners @ turn.T + at


def measured(cube, corners):
    reference = reference_of(CLASSIC)
    located = locate_chart(cube.values, NM, CLASSIC, reference, corners=corners)
    return measure("chart", CLASSIC, [Sighting("", located, cube)], reference)


@pytest.mark.slow
def test_borders_of_a_leaning_chart_give_response_shift_and_noise_in_one_table():
    cube, corners = leaning_chart(5, noise=0.004, shift=0.4)
    found = measured(cube, corners)
    assert {table.axis for table in found.edges.tables} == {"x", "y"}
    for table in found.edges.tables:
        truth = true_frequency(0.7, 5, 0.5)
        assert table.sfr50 == pytest.approx(truth, rel=0.03)
        expected = 0.4 * np.cos(np.deg2rad(5)) if table.axis == "x" else 0.4 * np.sin(np.deg2rad(5))
        others = np.delete(table.shift, 8).mean()
        assert abs(table.shift[8] - others) == pytest.approx(expected, abs=0.02)
    rows = {row.name.split(" (")[0]: row for row in found.rows}
    assert rows["colour misregistration, largest"].fadgi == "3 stars"
    assert rows["sampling efficiency, least"].aim == "100"
    assert rows["noise of L*, worst grey"].iso == "level A"
    assert next(t["edge"] for t in found.to_dict()["edges"]).endswith("borders of grey patches")


@pytest.mark.slow
def test_a_chart_that_lies_straight_says_how_to_turn_it():
    found = measured(*leaning_chart(0.4))
    assert not found.edges.tables
    assert any("turn the chart by about 5" in note for note in found.notes)


@pytest.mark.slow
def test_noise_of_lightness_is_what_was_planted():
    rng = np.random.default_rng(5)
    spectra = reference_of(CLASSIC).at(NM)
    cube, corners = leaning_chart(5)
    sigma = 0.01
    values = cube.values + (sigma * rng.standard_normal(cube.values.shape)).astype(np.float32)
    noisy = Cube(values, cube.flags, None, cube.bands)
    located = locate_chart(values, NM, CLASSIC, reference_of(CLASSIC), corners=corners)
    weights = np.linspace(0.05, 0.2, len(NM))
    greys = list(CLASSIC.greys)
    luminances = (spectra @ weights)[greys]
    found = noise_of_lightness([Sighting("", located, noisy)], weights, luminances, greys)
    expected = sigma * np.linalg.norm(weights) * lightness_slope(luminances)
    assert found == pytest.approx(expected, rel=0.06)  # 1,225 px a patch
    noisy.flags[...] = Flag.SATURATED
    full = noise_of_lightness([Sighting("", located, noisy)], weights, luminances, greys)
    assert np.isnan(full).all()


def test_levels_stand_at_their_limits_and_unknown_ones_stay_blank():
    assert indicator("noise", "", 1.6, "").iso == "level A"
    assert indicator("noise", "", 2.3, "").iso == "none"
    assert indicator("noise", "", 4.0, "").fadgi == "none"
    assert indicator("efficiency", "", 85.0, "")[4:] == ("3 stars", "level A")
    assert indicator("sharpening", "", 1.04, "")[4:] == ("below 4 stars", "–")
    assert indicator("half", "", 70.0, "").fadgi == "below 4 stars"
    assert all(len(limits.fadgi) <= 4 and len(limits.iso) in (0, 3) for limits in LIMITS.values())
