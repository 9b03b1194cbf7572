"""Digits that are kept of values and of their sigma."""

import numpy as np
import pytest

from levkas.core.rounding import round_root, round_sigma, round_values


def test_sigma_is_right_to_four_thousandths():
    sigma = np.geomspace(1e-4, 1e3, 5000).astype(np.float32)
    for found in (round_sigma(sigma), round_root(np.square(sigma))):
        assert np.max(np.abs(found / sigma - 1)) <= 1 / 2**8 + 1e-6


# A step of 1/1024 is all but a tenth of 0.0098: the worst case.
@pytest.mark.parametrize("sigma", [0.0011, 0.0039, 0.0098])
def test_rounding_adds_a_thousandth_to_the_variance_of_a_pixel_and_of_a_mean(sigma):
    # A ramp of reflectance with drawn noise; what rounding did is known pixel by pixel, in float64.
    rng = np.random.default_rng(45)
    truth = np.linspace(0.02, 0.9, 10_000)
    true = truth + rng.normal(0, sigma, (200, 10_000))
    noisy = true.astype(np.float32)
    found = round_values(noisy, np.full(noisy.shape, sigma, np.float32))
    added = found.astype(float) - true
    assert added.var() <= 0.001 * sigma**2
    # Of means over 10,000 px: the error of 200 of them, against that of their noise, sigma²/10,000.
    assert added.mean(1).var() <= 0.0015 * sigma**2 / 10_000  # 200 of them know a variance to 10 %
    assert abs(added.mean()) <= 4 * np.sqrt(0.001 * sigma**2 / added.size)
    assert (found - truth).var() == pytest.approx(sigma**2 * 1.0005, rel=0.004)


def test_a_flat_patch_is_not_moved_by_rounding():
    # The worst place of a step, half way: only the noise of the pixels dithers it.
    rng = np.random.default_rng(46)
    sigma, level = np.float32(0.0098), 0.5 + 0.5 / 1024
    noisy = (level + rng.normal(0, sigma, 1_000_000)).astype(np.float32)
    found = round_values(noisy, np.full(noisy.shape, sigma))
    assert abs(float((found.astype(float) - noisy).mean())) < 4 * 0.03 * sigma / 1000


def test_the_step_can_be_told_from_sigma_and_is_a_power_of_two():
    rng = np.random.default_rng(47)
    sigma = rng.uniform(1e-4, 0.05, 20_000).astype(np.float32)
    values = rng.uniform(-0.1, 1.2, 20_000).astype(np.float32)
    found = round_values(values, sigma)
    coarsest = 2.0 ** np.floor(np.log2(sigma.astype(float) / 10))
    digits = 2.0 ** (np.floor(np.log2(np.abs(values.astype(float)))) - 15)
    step = np.maximum(coarsest, digits)
    assert np.abs(found - values.astype(float)).max() > 0.4 * step.max()
    assert (np.abs(found - values.astype(float)) <= step / 2 * 1.0001).all()
    assert (np.mod(found.astype(float), np.minimum(coarsest, digits)) == 0).all()


@pytest.mark.parametrize("sigma", [0.0, np.nan, np.inf, 1e-40, 1e-7])
def test_values_without_a_useful_sigma_keep_sixteen_bits(sigma):
    values = np.float32([0.1, -0.7, 65535.0, np.nan, np.inf])
    found = round_values(values, np.full(5, sigma, np.float32))
    np.testing.assert_array_equal(found, round_values(values))


def test_ties_go_to_the_even_step():
    values = np.float32([0.5, 1.5, 2.5, -0.5, -1.5]) / 1024
    found = round_values(values, np.full(5, 0.01, np.float32)) * 1024
    assert found.tolist() == [0, 2, 2, 0, -2]
