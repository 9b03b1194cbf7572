"""Digits that are kept of values and of their sigma."""

import numpy as np
import pytest

from levkas.core.rounding import round_root, round_sigma, round_values


@pytest.mark.parametrize("sigma", np.geomspace(0.004, 0.008, 5))
def test_rounding_adds_a_seventh_of_a_percent_to_the_variance_at_most_and_nothing_to_means(sigma):
    rng = np.random.default_rng(5)
    exact = rng.normal(0.31415, sigma, (1000, 1000)).astype(np.float32)
    error = round_values(exact, np.full_like(exact, sigma)).astype(float) - exact
    assert error.var() < sigma**2 / 768 * 1.01
    assert abs(error.mean()) < 4 * error.std() / 1000
    blocks = error.reshape(100, 10, 100, 10).mean((1, 3))
    assert blocks.var() == pytest.approx(error.var() / 100, rel=0.1), "errors are independent"


@pytest.mark.parametrize("noise", [0.25, 0.5, 1.0])
def test_means_have_no_bias_where_the_noise_is_smaller_than_its_sigma_says(noise):
    rng, sigma = np.random.default_rng(6), np.float32(0.0079)
    for level in np.linspace(0.3, 0.301, 7):
        exact = rng.normal(level, noise * sigma, 200_000).astype(np.float32)
        error = round_values(exact, np.full_like(exact, sigma)).astype(float) - exact
        assert abs(error.mean()) < 4 * error.std() / np.sqrt(error.size)


def test_a_step_is_a_power_of_two_between_a_sixteenth_and_an_eighth_of_sigma():
    values = np.float32([0.1, -0.1, 12.3, 1e-5])
    rounded = round_values(values, np.full(4, 0.01, np.float32))
    assert rounded.tolist() == [102 / 1024, -102 / 1024, 12595 / 1024, 0.0]
    assert round_values(rounded, np.full(4, 0.01, np.float32)).tolist() == rounded.tolist()


@pytest.mark.parametrize("sigma", [0.0, np.inf, np.nan, 1e-40, 1e-9])
def test_a_value_without_a_usable_sigma_keeps_sixteen_significant_bits(sigma):
    values = np.float32([[0.1, 65535.0, np.nan, np.inf, -np.inf, 3e38, 0.0]])
    found = round_values(values, np.full_like(values, sigma))
    np.testing.assert_array_equal(found, round_values(values))


def test_any_sigma_leaves_what_is_not_finite_as_it_is():
    values = np.float32([np.nan, np.inf, -np.inf, 3e38, 0.0])
    for sigma in (1.0, 1e30, 3e38):
        found = round_values(values, np.full_like(values, sigma))
        np.testing.assert_array_equal(found[[0, 1, 2, 4]], values[[0, 1, 2, 4]])
        assert np.isfinite(found[3])


def test_views_are_rounded_as_arrays_are_and_sigma_is_not_changed():
    rng = np.random.default_rng(7)
    values = rng.normal(0.5, 0.01, (600, 40, 3)).astype(np.float32)
    sigma = rng.uniform(0.005, 0.02, values.shape).astype(np.float32)
    kept, whole = sigma.copy(), round_values(values, sigma)
    np.testing.assert_array_equal(
        round_values(values.transpose(2, 0, 1), sigma.transpose(2, 0, 1)), whole.transpose(2, 0, 1)
    )
    np.testing.assert_array_equal(round_values(values[::2], sigma[::2]), whole[::2])
    np.testing.assert_array_equal(sigma, kept)
    np.testing.assert_array_equal(round_values(values, sigma, out=values), whole)


def test_sigma_is_right_to_four_thousandths():
    sigma = np.geomspace(1e-4, 1e3, 5000).astype(np.float32)
    for found in (round_sigma(sigma), round_root(np.square(sigma))):
        assert np.max(np.abs(found / sigma - 1)) <= 1 / 2**8 + 1e-6
