"""A sensor that is not linear has a curve that its exposure series shows; a wrong time has none."""

import numpy as np
import pytest

from levkas.calibration.linearity import find_points
from levkas.calibration.response import ALIKE, fit_series
from levkas.calibration.templates import average

GAIN, READ, BLACK, FULL = 0.25, 2.0, 60.0, 4095.0
TIMES = (0.25, 0.5, 1.0, 2.0)
RATES = np.kron(np.random.default_rng(1).uniform(0.02, 1.0, (8, 10)), np.ones((16, 16))) * 3600


def bent(light, bend, cubic=0.0):
    share = light / (FULL - BLACK)
    return light * (1 - bend * share - cubic * share**2)


def points(bend=0.0, *, cubic=0.0, times=TIMES, really=None, seed=2, full=FULL, warm=0.0, toe=0.0):
    """Points of a series that states `times`, and really took others; its dark is `warm` counts above its black."""
    rng = np.random.default_rng(seed)
    shots = []
    for stated, time in zip(times, really or times, strict=True):
        light = GAIN * rng.poisson(RATES * time / GAIN)
        counts = bent(light, bend, cubic) - toe * (1 - np.exp(-light / 150))
        codes = np.rint(counts + rng.normal(BLACK, READ, light.shape))
        codes = codes.clip(0, FULL).astype(np.uint16)
        shots.append(average([codes], saturation=full, exposure_s=stated))
    return find_points(shots, saturation=full, black=BLACK + warm, contrast=ALIKE)


@pytest.mark.parametrize(
    ("bend", "cubic"), [(0.06, 0.0), (0.12, 0.0), (-0.05, 0.0), (0.03, 0.03), (0.02, 0.0)]
)
def test_a_planted_curve_comes_back(bend, cubic):
    found = fit_series(points(bend, cubic=cubic), FULL - BLACK).response
    light = np.linspace(50, 3500, 50)
    off = found.light(bent(light, bend, cubic)) / light - 1
    # The slope in the dark is the scale: what counts is how light goes from there on.
    assert np.abs(off).max() < max(0.002, 3 * found.error)
    assert found.error < 0.003 and found.rms < 0.002 < found.rms_line


def test_a_curve_of_twelve_bits_in_files_of_sixteen_comes_back():
    """Nobody declares the bits: 5 per cent of 65,535 are most of the codes that there are."""
    full, times = 65535.0, (0.25, 0.5, 0.9)
    found = fit_series(points(0.08, times=times, full=full), full - BLACK).response
    light = np.linspace(50, 3200, 50)
    assert np.abs(found.light(bent(light, 0.08)) / light - 1).max() < 0.004
    assert fit_series(points(0.0, times=times, full=full), full - BLACK).response is None


def test_a_linear_sensor_has_no_curve():
    assert fit_series(points(), FULL - BLACK).response is None


@pytest.mark.parametrize("odd", range(4))
@pytest.mark.parametrize("factor", [0.95, 1.02, 1.33])
def test_a_wrong_time_of_one_exposure_is_no_curve(odd, factor):
    really = [t * (factor if i == odd else 1.0) for i, t in enumerate(TIMES)]
    assert fit_series(points(really=really), FULL - BLACK).response is None


@pytest.mark.parametrize("flicker", [0.01, 0.03])
@pytest.mark.parametrize("times", [TIMES, (0.25, 0.5, 1.0), (0.25, 1.0)])
def test_a_lamp_that_flickers_is_no_curve(flicker, times):
    light = 1 + flicker * np.random.default_rng(4).standard_normal(len(times))
    found = fit_series(points(times=times, really=[*(light * times)]), FULL - BLACK)
    assert found.response is None and not found.unsure and not found.offset


def test_a_curve_comes_back_under_a_lamp_that_flickers():
    really = [time * light for time, light in zip(TIMES, (0.99, 1.02, 1.0, 0.98), strict=True)]
    found = fit_series(points(0.06, really=really), FULL - BLACK).response
    light = np.linspace(50, 3500, 50)
    off = found.light(bent(light, 0.06)) / light - 1
    # Its error holds what the scatter of the light leaves in doubt.
    assert np.abs(off).max() < 3 * found.error < 0.02


@pytest.mark.parametrize(
    ("bend", "times"), [(0.0, TIMES), (0.0, (0.25, 1.0)), (0.05, TIMES)], ids=str
)
def test_a_dark_of_another_temperature_is_an_offset(bend, times):
    found = fit_series(points(bend, times=times, warm=5.0), FULL - BLACK)
    assert found.offset == pytest.approx(-5.0, abs=0.5) and found.offset_error < 0.5
    assert (found.response is not None) == bool(bend)
    assert fit_series(points(bend, times=times), FULL - BLACK).offset == 0.0


def test_a_curve_that_two_exposures_leave_in_doubt_is_said_and_not_corrected():
    found = fit_series(points(0.05, times=(0.25, 1.0), warm=5.0), FULL - BLACK)
    assert found.response is None and found.unsure > 0.02


def test_a_response_that_bends_at_its_dark_end_has_an_offset():
    found = fit_series(points(toe=6.0), FULL - BLACK)
    assert -7 < found.offset < -2


def test_a_shutter_that_is_late_is_no_curve():
    assert fit_series(points(really=[t + 0.01 for t in TIMES]), FULL - BLACK).response is None


def test_two_exposures_of_many_levels_show_a_curve():
    found = fit_series(points(0.06, times=(0.5, 1.0)), FULL - BLACK).response
    light = np.linspace(300, 3300, 20)
    ratio = found.light(bent(light, 0.06)) / light
    assert np.ptp(ratio) < 0.006


def test_templates_are_straightened_with_their_variance():
    found = fit_series(points(0.06), FULL - BLACK).response
    frames = [np.full((2, 2), bent(3000.0, 0.06) + BLACK + more) for more in (-30.0, 30.0)]
    made = found.straighten(average(frames), BLACK)
    assert made.mean == pytest.approx(3000 + BLACK, rel=0.002)
    slope = (found.light(np.array(2901.0)) - found.light(np.array(2899.0))) / 2
    assert made.variance == pytest.approx(1800 * float(slope) ** 2, rel=0.05)
