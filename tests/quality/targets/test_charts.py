import cv2
import numpy as np
import pytest

from levkas.core.cube import Band, Cube
from levkas.quality.targets.charts import (
    CHARTS,
    ChartRefused,
    parse_reference,
    place_patches,
    reference_of,
)
from levkas.quality.targets.indicators import WhiteEvenness
from levkas.quality.targets.locating import locate_chart, locate_in_cube
from levkas.quality.targets.measuring import Sighting, compare_colours, measure, rate
from levkas.quality.targets.patches import measure_patches

CLASSIC = CHARTS["ColorChecker24"]
WAVELENGTHS = np.arange(420.0, 721, 30)
PITCH, AT = 40, (70, 60)


def scene(*, wavelengths=WAVELENGTHS, turn=0, noise=0.0, rng=None):
    """A flat chart on a grey table, patches with gaps, every band its published reflectance."""
    spectra = reference_of(CLASSIC).at(wavelengths)
    picture = np.full((300, 400, len(wavelengths)), 0.15, np.float32)
    picture[AT[1] - 8 : AT[1] + 4 * PITCH + 8, AT[0] - 8 : AT[0] + 6 * PITCH + 8] = 0.03
    for i, (c, r) in enumerate(CLASSIC.centres.astype(int)):
        y, x = AT[1] + r * PITCH, AT[0] + c * PITCH
        picture[y + 3 : y + PITCH - 3, x + 3 : x + PITCH - 3] = spectra[i]
    if noise:
        picture = picture + noise * rng.standard_normal(picture.shape).astype(np.float32)
    return np.rot90(picture, turn).copy()


def true_corners():
    return (CLASSIC.corners + 0.5) * PITCH + np.array(AT) - 0.5


def cube(values, wavelengths=WAVELENGTHS):
    bands = tuple(Band(f"{w:g} nm", float(w)) for w in wavelengths)
    return Cube(values, np.zeros(values.shape, np.uint8), None, bands)


needs_detector = pytest.mark.skipif(not hasattr(cv2, "mcc"), reason="this OpenCV has no mcc")


@needs_detector
@pytest.mark.parametrize("turn", [0, 2])
def test_a_chart_is_found_whichever_way_it_lies(turn):
    found = locate_chart(scene(turn=turn), WAVELENGTHS, CLASSIC, reference_of(CLASSIC))
    corners = true_corners()
    if turn:
        corners = np.array([399, 299]) - corners
    assert found.agreement > 0.98
    assert (
        np.linalg.norm(found.corners - corners, axis=1).max() < 3.0
    )  # black on black holds a corner loosely


@needs_detector
def test_a_picture_without_a_chart_is_refused_with_what_to_do():
    rng = np.random.default_rng(1)
    smooth = cv2.GaussianBlur(rng.random((300, 400)).astype(np.float32), (0, 0), 25)
    with pytest.raises(ChartRefused) as refused:
        locate_chart(np.dstack([smooth] * 3), np.full(3, np.nan), CLASSIC)
    assert refused.value.problems[0].code == "E_CHART_MISSING"


@pytest.mark.parametrize("mirrored", [False, True])
def test_corners_in_another_order_are_refused(mirrored):
    named = true_corners()[::-1] if mirrored else np.roll(true_corners(), 2, axis=0)
    with pytest.raises(ChartRefused) as refused:
        locate_chart(scene(), WAVELENGTHS, CLASSIC, reference_of(CLASSIC), corners=named)
    assert refused.value.problems[0].code == "E_CHART_ORDER"


def test_a_band_that_leaks_is_named_and_the_others_are_used():
    leaking = scene()
    leaking[..., 0] = 0.15 * leaking[..., 0] + 0.85 * leaking[..., -1]
    reference = reference_of(CLASSIC)
    found = locate_chart(leaking, WAVELENGTHS, CLASSIC, reference, corners=true_corners())
    assert found.unfit.tolist() == [True] + [False] * (len(WAVELENGTHS) - 1)
    assert found.bands[0] < 0.8 and found.agreement > 0.98
    sightings = [Sighting("", found, cube(leaking))]
    made = measure("leaking", CLASSIC, sightings, reference)
    assert any("420 nm" in note for note in made.notes)
    assert made.colours.difference.mean() < 1


@pytest.mark.parametrize(
    ("corners", "code"),
    [
        ([[-20, 50], [300, 50], [300, 250], [-20, 250]], "E_CHART_FRAME"),
        ([[50, 50], [80, 50], [80, 70], [50, 70]], "E_CHART_SIZE"),
        ([[50, 50], [300, 250], [300, 50], [50, 250]], "E_VALUE"),
    ],
)
def test_a_chart_that_cannot_be_sampled_is_refused(corners, code):
    with pytest.raises(ChartRefused) as refused:
        place_patches(np.array(corners, float), CLASSIC, (400, 300))
    assert refused.value.problems[0].code == code


def test_signal_to_noise_of_patches_is_what_was_planted():
    rng = np.random.default_rng(2)
    shots = [scene(noise=0.02, rng=rng) for _ in range(2)]
    shade = np.linspace(1, 1.2, 400, dtype=np.float32)[None, :, None]
    mean, flags = (shots[0] + shots[1]) / 2 * shade, np.zeros(shots[0].shape, np.uint8)
    areas = place_patches(true_corners(), CLASSIC, (400, 300))
    by_shots = measure_patches(mean, flags, areas, shots=(shots[0] * shade, shots[1] * shade))
    by_plane = measure_patches(mean, flags, areas)
    level = 0.02 / np.sqrt(2) * shade[0, areas[:, 0, 0].astype(int) + 10]
    # 24 patches of 441 pixels: half a per cent; shading would add as much as the noise itself.
    assert np.mean(by_shots.noise / level) == pytest.approx(1, abs=0.02)
    assert np.mean(by_plane.noise / level) == pytest.approx(1, abs=0.02)
    assert by_shots.snr_db[18, 0] == pytest.approx(10 * np.log10(by_shots.snr[18, 0]))


def test_noise_of_a_mosaic_is_that_of_its_measured_sensels():
    rng = np.random.default_rng(4)
    measured = 0.5 + 0.02 * rng.standard_normal((120, 120))
    pattern = np.array([[0, 1], [1, 2]])
    values = np.empty((120, 120, 3))
    for band in range(3):
        own = pattern[np.arange(120)[:, None] % 2, np.arange(120) % 2] == band
        known = np.where(own, measured, 0)
        weight = cv2.blur(own.astype(float), (3, 3))
        values[..., band] = np.where(own, measured, cv2.blur(known, (3, 3)) / weight)
    area = np.array([[[10, 10], [109, 10], [109, 109], [10, 109.0]]])
    flags = np.zeros(values.shape, np.uint8)
    every = measure_patches(values, flags, area)
    sensels = measure_patches(values, flags, area, pattern=pattern)
    assert sensels.noise[0] == pytest.approx([0.02] * 3, rel=0.05)
    assert (every.noise[0] < 0.8 * sensels.noise[0]).all()  # what lies between has less


def test_patches_of_coarse_codes_are_said_to_be_limited_by_quantisation():
    rng = np.random.default_rng(5)
    signal = np.array([2.0, 120.0]) + np.array([0.05, 4.0]) * rng.standard_normal((60, 60, 2))
    codes = np.rint(signal)
    area = np.array([[[5, 5], [54, 5], [54, 54], [5, 54.0]]])
    table = measure_patches(codes, np.zeros(codes.shape, np.uint8), area, steps=[1.0, 1.0])
    assert table.quantised.tolist() == [[True, False]]
    assert table.snr[0] == pytest.approx([2 / np.sqrt(1 / 12), 30], rel=0.1)


def test_colours_of_the_reference_itself_differ_by_nothing_and_a_gain_shows():
    nm = np.arange(400.0, 721, 10)
    reference = reference_of(CLASSIC)
    means = reference.at(nm)
    same = compare_colours(means, nm, reference)
    assert same.difference.max() < 0.6  # bands end at 720 nm, the eye a little later
    darker = compare_colours(0.8 * means, nm, reference)
    rows = rate(darker, CLASSIC, evenness=WhiteEvenness(0.9, 0.012))
    mean, _, _, tone, bright, _, cast, _, light = rows
    assert mean.value > 3 and cast.value < 1
    assert (tone.value > 5, tone.iso) == (True, "none")
    assert bright.value == pytest.approx(0.8 ** (1 / 3), rel=0.01)  # L* is a cube root
    assert (bright.fadgi, bright.iso) == ("4 stars", "level A")
    assert (light.value, light.fadgi) == (pytest.approx(1.2), "below 4 stars")


def test_published_spectra_and_luminances_are_those_of_colour_science():
    from colour import CCS_COLOURCHECKERS, SDS_COLOURCHECKERS

    published = [sd.values for sd in SDS_COLOURCHECKERS["BabelColor Average"].values()]
    np.testing.assert_array_equal(reference_of(CLASSIC).spectra, published)
    for kind, chart in CHARTS.items():
        patches = CCS_COLOURCHECKERS[f"{kind} - After November 2014"].data.values()
        np.testing.assert_allclose(chart.luminances, [xyy[2] for xyy in patches], rtol=1e-14)


@pytest.mark.parametrize("text", ["", "a,b\n1,2", "Wavelength,A1\n400,x\n500,1"])
def test_a_reference_that_is_none_is_refused(text):
    with pytest.raises(ChartRefused) as refused:
        parse_reference(text, CLASSIC)
    assert refused.value.problems[0].code == "E_CHART_REFERENCE"


def test_a_measure_says_all_and_changes_no_input():
    rng = np.random.default_rng(5)
    values = scene(noise=0.005, rng=rng)
    before = values.copy()
    reference = reference_of(CLASSIC)
    found = locate_in_cube(cube(values), CLASSIC, reference, corners=true_corners())
    sighting = Sighting("", found, cube(values))
    made = measure("chart", CLASSIC, [sighting], reference)
    np.testing.assert_array_equal(values, before)
    record = made.to_dict()
    assert len(record["patches"]) == 24 and record["preblurred"] == []
    assert record["indicators"][0]["value"] < 1.5
    blurred = np.stack([cv2.blur(values[..., i], (3, 3)) for i in range(values.shape[2])], -1)
    found = locate_in_cube(cube(blurred), CLASSIC, reference, corners=true_corners())
    sighting = Sighting("", found, cube(blurred))
    reported = measure("chart", CLASSIC, [sighting], reference)
    assert all(p.found for p in reported.preblurs)
    lost = np.nanmedian(reported.table.snr_db - reported.snr_db)
    assert lost == pytest.approx(10 * np.log10(3), abs=0.5)


@pytest.mark.slow
@needs_detector
def test_a_chart_of_140_patches_is_found():
    chart, rng = CHARTS["ColorCheckerSG"], np.random.default_rng(6)
    picture = np.full((660, 900, 3), 0.15, np.float32)
    picture[60:600, 80:820] = 0.02
    for i, (c, r) in enumerate(chart.centres.astype(int)):
        y, x = 80 + 50 * r, 100 + 50 * c
        picture[y + 4 : y + 46, x + 4 : x + 46] = chart.luminances[i] * np.array([1, 0.9, 0.8])
    picture += 0.003 * rng.standard_normal(picture.shape).astype(np.float32)
    found = locate_chart(picture, np.full(3, np.nan), chart)
    # The detector alone is 11 px off.
    assert np.abs(found.corners - (chart.corners * 50 + [124.5, 104.5])).max() < 2.5
