"""Frames against the closed form of Eq. (2), and against themselves on more threads."""

import numpy as np
import pytest

from levkas.calibration.noise_model import Sensor, noise_variance
from levkas.core import threads
from levkas.simulation.capture import expose, fixed_pattern, key

SHAPE = (400, 500)
# Fine steps and no clipping, so that counts are electrons.
PAPER = Sensor(gain=1.0, black=200.0, bits=16, full_well=6e4)


def pattern(sensor=PAPER):
    return fixed_pattern(SHAPE, sensor, np.random.default_rng(5), hot=0, dead=0)


def shoot(electrons, sensor=PAPER, fixed=None, shot=0):
    exposure = np.full(SHAPE, electrons, np.float32)
    return expose(exposure, sensor, fixed or pattern(sensor), key(9, "test", str(shot)))


@pytest.mark.parametrize("electrons", [0.0, 20.0, 30.0, 20_000.0])
def test_mean_and_variance_are_those_of_equation_2(electrons):
    values = shoot(electrons).astype(float) - PAPER.black
    expected = float(noise_variance(electrons, PAPER)) + 1 / 12
    # Means scatter by σ/√n, variances by √(2/n) = 0.32 %: four of each.
    assert values.mean() == pytest.approx(
        electrons + PAPER.dark, abs=4 * np.sqrt(expected / values.size)
    )
    assert values.var() == pytest.approx(expected, rel=0.013)


def test_few_photons_are_poisson():
    from scipy.stats import poisson

    quiet = Sensor(dark=0.0, read=0.0, prnu=0.0, dsnu=0.0, gain=1.0, bits=16)
    counts = np.bincount(shoot(4.0, quiet).ravel(), minlength=20)[:20]
    expected = poisson.pmf(np.arange(20), 4.0) * np.prod(SHAPE)
    many = expected > 20
    chi2 = ((counts - expected)[many] ** 2 / expected[many]).sum()
    assert chi2 < 40  # 14 degrees of freedom

    # Many photons keep the skewness of Poisson.
    values = shoot(40.0, quiet).astype(float)
    skewness = ((values - values.mean()) ** 3).mean() / values.std() ** 3
    assert skewness == pytest.approx(1 / np.sqrt(40), abs=0.025)


def test_the_bytes_do_not_depend_on_the_number_of_threads(monkeypatch):
    fixed = pattern()
    monkeypatch.setattr(threads, "WORTH_THREADS", 0)
    monkeypatch.setenv("LEVKAS_THREADS", "1")
    one = shoot(500.0, fixed=fixed)
    monkeypatch.setenv("LEVKAS_THREADS", "3")
    np.testing.assert_array_equal(one, shoot(500.0, fixed=fixed))


def test_hot_and_dead_sensels_stand_out():
    fixed = fixed_pattern(SHAPE, PAPER, np.random.default_rng(1), hot=1e-3, dead=1e-3)
    dark, bright = shoot(0.0, fixed=fixed), shoot(20_000.0, fixed=fixed)
    assert (dark > PAPER.black + 400).sum() == pytest.approx(200, abs=15)
    assert (bright < PAPER.black + 4_000).sum() == pytest.approx(200, abs=5)
