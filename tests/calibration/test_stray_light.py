"""The model of stray light: what it spreads, and that the correction undoes it under uneven light."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from levkas.calibration.stray_light import correct_stray_light, spread_light


def scene():
    tones = np.random.default_rng(1).uniform(0.02, 0.9, (8, 10))
    return np.kron(tones, np.ones((20, 20)))


@pytest.mark.parametrize("width", [3.0, 8.0, 30.0, 100.0])
def test_the_spread_is_a_gaussian_of_what_is_known(width):
    x = scene()
    x[:40, :40] = np.nan
    known = np.isfinite(x)
    blurs = [
        gaussian_filter(a, width, mode="constant") for a in (np.where(known, x, 0), known * 1.0)
    ]
    light, weight = blurs
    there = weight > 1e-3
    assert np.allclose(
        spread_light(x, width)[there], (light / np.maximum(weight, 1e-9))[there], atol=0.012
    )


@pytest.mark.parametrize("width", [None, 8.0, 100.0])
def test_the_correction_undoes_the_model_where_the_light_falls_off(width):
    x, before = scene(), scene()
    y, across = np.mgrid[-1:1:160j, -1:1:200j]
    light = 1 - 0.4 * (y**2 + across**2) / 2
    recorded, white = (0.95 * p + 0.05 * spread_light(p, width) for p in (light * x, light))
    ratio = recorded / white
    kept = ratio.copy()
    assert abs(ratio - x).max() > 0.02
    assert np.allclose(correct_stray_light(ratio, 0.05, width, light=white), x, atol=1e-5)
    assert np.array_equal(ratio, kept) and np.array_equal(x, before)


def test_what_is_not_known_stays_so_and_spreads_nothing():
    x = scene()
    y = 0.95 * x + 0.05 * x.mean()
    y[5, 7] = np.nan
    found = correct_stray_light(y, 0.05)
    assert np.isnan(found[5, 7]) and np.isnan(found).sum() == 1
    assert np.nanmax(abs(found - x)) < 1e-4
