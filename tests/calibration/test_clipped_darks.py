import numpy as np
import pytest

from levkas.calibration.clipped_darks import (
    fit_clipped_dark,
    is_clipped,
    unclip,
)
from levkas.calibration.templates import CalibrationRefused, average


def darks(black, noise, fixed, count=2, seed=1, hot=60):
    rng = np.random.default_rng(seed)
    offset = black + rng.normal(0, fixed, (400, 750))
    frames = [np.rint(offset + rng.normal(0, noise, offset.shape)).clip(0) for _ in range(count)]
    for frame in frames:
        frame.flat[:hot] = rng.integers(50, 1000, hot)
    return frames


@pytest.mark.parametrize(("black", "noise", "fixed"), [(0.0, 0.68, 0.06), (-2.0, 2.0, 0.5)])
def test_black_noise_and_pattern_come_back(black, noise, fixed):
    frames = darks(black, noise, fixed)
    assert is_clipped(frames[0])
    found = fit_clipped_dark(frames)
    # 300,000 pixels: 1 % of the noise, and what the fit itself says.
    assert found.black == pytest.approx(black, abs=max(0.01 * noise, 3 * found.black_error))
    assert found.noise == pytest.approx(noise, rel=0.01)
    assert found.fixed == pytest.approx(fixed, abs=0.05)


def test_nothing_but_zeros_and_hot_sensels_is_refused():
    with pytest.raises(CalibrationRefused) as refused:
        fit_clipped_dark(darks(-20.0, 1.0, 0.0))
    assert refused.value.problems[0].code == "E_DARK_CLIPPED"


def unclipped(offset, noise, count, seed=2):
    rng = np.random.default_rng(seed)
    shots = [np.rint(offset + rng.normal(0, noise, offset.shape)).clip(0) for _ in range(count)]
    shots = [shot.astype(np.uint16) for shot in shots]
    return unclip(average(shots), shots[:4])


@pytest.mark.parametrize("count", [2, 8, 100])
def test_levels_of_sensels_are_unbiased_and_miss_as_much_as_is_said(count):
    shape = (240, 320) if count < 100 else (1, 2000)
    offset = np.random.default_rng(1).normal(0.0, 0.5, shape)
    found = unclipped(offset, 2.5, count)
    miss = found.mean - offset
    assert abs(miss.mean()) < 0.04
    # From one pair the spread from sensel to sensel is known to a seventh.
    off = 0.3 if count == 2 else 0.1
    assert (miss / np.sqrt(found.fit.variance)).std() == pytest.approx(1.0, abs=off)
    if count == 100:  # a line of many shots tells sensels apart
        assert miss.std() < 0.6 * 0.5


@pytest.mark.parametrize("count", [1, 8])
def test_a_dark_that_glows_keeps_its_glow(count):
    glow = 6 * np.exp(-np.arange(240) / 100)[:, None] * np.ones((1, 320))
    offset = glow + np.random.default_rng(1).normal(0.0, 0.5, glow.shape)
    miss = unclipped(offset, 2.5, count).mean - offset
    assert abs(miss.reshape(8, 30, 320).mean((1, 2))).max() < 0.08
    assert miss.std() < 0.6
