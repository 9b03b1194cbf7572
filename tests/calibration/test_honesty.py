"""Reflectance against the truth of a simulated camera, before and after resampling."""

import numpy as np
import pytest

from levkas.calibration.flatfield import flat_field
from levkas.calibration.noise_fit import fit_noise
from levkas.calibration.templates import average

SHAPE = (240, 320)


@pytest.fixture(scope="module")
def calibrated():
    """(values, sigma, truth) of a scene behind PRNU, shading, shot and read noise."""
    rng = np.random.default_rng(1)
    response = 1 + 0.019 * rng.standard_normal(SHAPE)
    y, x = np.indices(SHAPE)
    shade = 1 - 0.4 * ((y / SHAPE[0] - 0.5) ** 2 + (x / SHAPE[1] - 0.5) ** 2)
    truth = 0.45 + 0.4 * np.sin(x / 40.0) * np.cos(y / 50.0)

    def shots(reflectance, count):
        electrons = 30_000 * reflectance * shade * response
        lit = (0.1 * rng.poisson(electrons, SHAPE) for _ in range(count))
        raw = (np.rint(light + rng.normal(64, 2, SHAPE)) for light in lit)
        return average([np.clip(frame, 0, 4095).astype(np.uint16) for frame in raw])

    dark, white, panel = shots(0.0, 8), shots(1.0, 6), shots(truth, 3)
    made = flat_field(panel, dark, white, noise=fit_noise([dark, white, panel], dark))
    return made.values, np.sqrt(made.variance), truth


def judge(miss):
    assert 0.95 < miss.std() < 1.05
    assert 0.94 < np.mean(np.abs(miss) < 1.96) < 0.96
    assert abs(miss.mean()) < 0.02


def test_sigma_says_how_far_the_truth_is(calibrated):
    values, sigma, truth = calibrated
    judge((values - truth) / sigma)


@pytest.mark.parametrize("shift", [(0.5, 0.5), (0.25, 0.7)])
def test_sigma_still_says_it_after_resampling(calibrated, shift):
    from levkas.geometry.resample import warp
    from levkas.geometry.transforms import Affine

    values, sigma, _ = calibrated
    move = Affine(np.array([[1.0, 0, shift[0]], [0, 1.0, shift[1]]]))
    variance = (sigma**2).astype(np.float32)
    made = warp(values.astype(np.float32), move, SHAPE, variance=variance)
    y, x = np.indices(SHAPE)
    exact = 0.45 + 0.4 * np.sin((x + shift[0]) / 40.0) * np.cos((y + shift[1]) / 50.0)
    inside = (slice(4, -4), slice(4, -4))
    judge(((made.values - exact) / np.sqrt(made.variance))[inside])
