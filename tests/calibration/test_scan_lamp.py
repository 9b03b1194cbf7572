"""The lamp of a scan: what its white shows goes on along the object, and noise of a steady lamp does not."""

import numpy as np
import pytest

from levkas.calibration.lamp import lamp_along
from levkas.calibration.templates import ShotLevels


def white(rng, lines=64, bands=3, noise=6e-4, drift=0.0, flicker=0.0):
    """Levels of the lines of a white under a lamp that sinks by a share from the first to the last."""
    lamp = 1 - drift * np.linspace(0, 1, lines) + flicker * rng.standard_normal(lines)
    levels = lamp[:, None] * rng.normal(1, noise, (lines, bands))
    return ShotLevels(levels / levels.mean(0), np.full(bands, noise))


@pytest.mark.parametrize("flicker", [0.0, 0.003])
@pytest.mark.parametrize(
    ("lines", "bands"), [(2, 3), (3, 3), (6, 3), (20, 3), (40, 3), (64, 60), (31, 580)]
)
def test_a_steady_lamp_has_not_changed_at_the_end_of_a_long_scan(lines, bands, flicker):
    rng = np.random.default_rng(lines)
    found = [lamp_along(white(rng, lines, bands, flicker=flicker), 1500) for _ in range(100)]
    assert not any(np.nan_to_num(one.white).any() for one in found)
    assert (
        max(one.sigma.max() for one in found) < 0.005 + 2.5 * flicker
    )  # of six lines flicker is known to a third


@pytest.mark.parametrize("object_lines", [160, 480, 1500])
def test_a_drift_that_the_white_shows_covers_the_object(object_lines):
    rng, whole = np.random.default_rng(1), 0.05
    per_line = whole / (64 + object_lines)
    found = [lamp_along(white(rng, drift=63 * per_line), object_lines) for _ in range(50)]
    mean, last = per_line * (32 + object_lines / 2), per_line * (32 + object_lines)
    assert np.mean([mean < 1.96 * one.sigma.min() for one in found]) > 0.95
    if object_lines < 600:  # within the reach
        assert np.mean([last < 1.96 * one.sigma.min() for one in found]) > 0.95
    assert max(one.sigma.max() for one in found) < 2 * last


def test_a_band_that_drifts_more_than_others_keeps_its_own_change():
    rng, lines = np.random.default_rng(3), np.linspace(0.5, -0.5, 64)[:, None]
    lean = np.array([0.002, 0.004, 0.008])
    levels = (1 + lean * lines) * rng.normal(1, 2e-4, (64, 3))
    found = lamp_along(ShotLevels(levels, np.full(3, 2e-4)), 480)
    np.testing.assert_allclose(found.white, -lean, atol=6e-4)
    np.testing.assert_allclose(found.sigma, 8 * lean, rtol=0.25)


def test_a_white_of_one_line_or_without_light_shows_nothing():
    one = lamp_along(ShotLevels(np.ones((1, 3)), np.full(3, 1e-3)), 480)
    dark = lamp_along(ShotLevels(np.ones((64, 3)), np.full(3, np.inf)), 480)
    assert not one.sigma.any() and not dark.sigma.any()
    assert np.isnan(one.white).all()
