"""The closed forms against the numbers worked out in the paper and by sampling."""

import numpy as np
import pytest

from levkas.calibration.noise_model import (
    Sensor,
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


def test_the_dark_counts_as_signal_only_when_told():
    assert snr_db(0.0, PAPER, subtract_dark=False) == pytest.approx(6.26, abs=0.005)
    assert snr_db(0.0, PAPER) == -np.inf


@pytest.mark.parametrize("exposure", [0.0, 20_000.0])
def test_closed_form_agrees_with_sampling_of_equation_2(exposure):
    values = sample_values(exposure, PAPER, 400_000, np.random.default_rng(3))
    # A sample variance of n normal values scatters by sqrt(2/n) = 0.22 %; four of these.
    assert values.var() == pytest.approx(float(noise_variance(exposure, PAPER)), rel=0.009)


def test_a_negative_spread_is_refused():
    with pytest.raises(ValueError):
        Sensor(read=-1.0)
