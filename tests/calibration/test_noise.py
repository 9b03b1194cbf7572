"""The closed forms against the numbers worked out in the paper and by sampling."""

import numpy as np
import pytest

from levkas.calibration.noise_model import (
    Sensor,
    dynamic_range_db,
    noise_variance,
    snr_db,
)

PAPER = Sensor()


def sample_values(exposure, sensor, count, rng):
    """Raw values of as many sensels, electrons, term by term of Eq. (2)."""
    shot = rng.poisson(exposure, count) * (1 + rng.normal(0, sensor.prnu, count))
    dark = rng.poisson(sensor.dark, count) * (1 + rng.normal(0, sensor.dsnu, count))
    return shot + dark + rng.normal(0, sensor.read, count)


def test_noise_in_the_dark_is_the_one_of_the_papers_parameters():
    assert noise_variance(0.0, PAPER) == pytest.approx(57.38, abs=0.005)
    assert np.sqrt(noise_variance(0.0, PAPER)) == pytest.approx(7.575, abs=5e-4)


def test_snr_without_light_counts_the_dark_only_when_told():
    assert snr_db(0.0, PAPER, subtract_dark=False) == pytest.approx(6.26, abs=0.005)
    assert snr_db(0.0, PAPER) == -np.inf


def test_dynamic_range_is_the_papers_or_emvas():
    assert dynamic_range_db(PAPER, floor=32) == pytest.approx(63.0, abs=0.05)
    assert dynamic_range_db(PAPER) == pytest.approx(74.9, abs=0.05)


@pytest.mark.parametrize("exposure", [0.0, 40.0, 900.0, 20_000.0])
def test_closed_form_agrees_with_sampling_of_equation_2(exposure):
    values = sample_values(exposure, PAPER, 400_000, np.random.default_rng(3))
    # A sample variance of n normal values scatters by sqrt(2/n) = 0.22 %; four of these.
    assert values.var() == pytest.approx(float(noise_variance(exposure, PAPER)), rel=0.009)


@pytest.mark.parametrize("subtracted", [False, True])
def test_sampled_snr_is_the_closed_forms_to_a_twentieth_of_a_decibel(subtracted):
    rng = np.random.default_rng(4)
    for exposure in np.geomspace(10, 45_000, 12):
        values = sample_values(exposure, PAPER, 640 * 480, rng)
        mean = values.mean() - (PAPER.dark if subtracted else 0)
        expected = snr_db(exposure, PAPER, subtract_dark=subtracted)
        assert 10 * np.log10(mean / values.std()) == pytest.approx(expected, abs=0.05)


def test_a_negative_spread_is_refused():
    with pytest.raises(ValueError, match="read must be >= 0"):
        Sensor(read=-1.0)
