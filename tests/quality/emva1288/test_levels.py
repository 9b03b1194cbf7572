import numpy as np
import pytest

from levkas.calibration.codes import count_codes
from levkas.quality.emva1288.levels import Levels, find_levels

X = np.arange(683)
D80 = np.rint(X + 0.01565 * np.maximum(X - 215, 0) ** 2).astype(np.uint16)


def test_the_683_codes_of_a_d80_betray_their_curve():
    found = find_levels(count_codes([np.repeat(D80, 9)]))
    assert found.count == 683
    assert found.knee == pytest.approx(215, abs=10)
    assert found.bend == pytest.approx(0.01565, rel=0.01)
    assert found.between(0, 4095) == pytest.approx(683, rel=0.01)


def test_frames_that_leave_ranges_empty_betray_it_too():
    codes = D80[(X < 20) | ((X > 300) & (X < 400)) | (X > 500)]
    found = find_levels(count_codes([np.repeat(codes, 5)]))
    assert found.bend == pytest.approx(0.01565, rel=0.03)


def test_rounding_on_the_curve_is_step_squared_over_twelve():
    levels = Levels(683, 0, 4095, 1.0, 215.0, 0.01565)
    values = np.random.default_rng(1).uniform(3000, 4000, 200_000)
    rounded = D80[np.searchsorted((D80[1:].astype(float) + D80[:-1]) / 2, values)]
    expected = float(np.mean(levels.quantisation(values)))
    assert np.mean((rounded - values) ** 2) == pytest.approx(expected, rel=0.02)


@pytest.mark.parametrize("spacing", [1, 4, 16])
def test_even_codes_have_no_curve(spacing):
    rng = np.random.default_rng(2)
    codes = (spacing * rng.integers(60, 60_000 // spacing, 300_000)).astype(np.uint16)
    found = find_levels(count_codes([codes]))
    assert not found.curved
    assert found.spacing == (spacing if spacing > 1 else 1)


def test_a_dark_frame_says_nothing_of_a_curve():
    dark = np.random.default_rng(3).normal(64, 2, 100_000).round().astype(np.uint16)
    assert not find_levels(count_codes([dark])).curved
