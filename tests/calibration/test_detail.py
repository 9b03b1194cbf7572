"""Sigma of interpolated values knows that the scene was not sampled between the sensels."""

import cv2
import numpy as np
import pytest

from levkas.calibration.mosaic import demosaic
from levkas.calibration.patterns import channel_table
from levkas.geometry.resample import warp
from levkas.geometry.transforms import Affine
from levkas.stages.shared_noise import Mosaic, shared_noise

SHAPE = (300, 360)
BAYER, NINE = (["R", "G"], ["G", "B"]), (["a", "b", "c"], ["d", "e", "f"], ["g", "h", "i"])


def scene(kind, channels):
    """Waves, hard-edged discs of other colours, or detail as fine as the sensels."""
    rng, (y, x) = np.random.default_rng(3), np.indices(SHAPE)
    if kind == "smooth":
        waves = [np.sin(x / 40 + k) * np.cos(y / 50 - k) for k in range(channels)]
        return np.stack([0.4 + 0.3 * wave for wave in waves], -1)
    if kind == "fine":
        return np.repeat(0.4 + 0.1 * rng.standard_normal((*SHAPE, 1)), channels, 2)
    planes = []
    for _ in range(channels):
        plane = np.full(SHAPE, 0.4, np.float32)
        for _ in range(150):
            place, radius = rng.integers(0, SHAPE[::-1]).tolist(), int(rng.integers(3, 40))
            cv2.circle(plane, place, radius, float(rng.uniform(0.02, 0.9)), -1, cv2.LINE_AA)
        planes.append(cv2.GaussianBlur(plane, (0, 0), 0.6))
    return np.stack(planes, -1).astype(float)


def interpolated(kind, pattern, method):
    """Return values, truth, variance, and where each channel was measured."""
    table = channel_table(pattern)
    truth = scene(kind, int(table.max()) + 1)
    y, x = np.indices(SHAPE)
    which = table[y % len(table), x % len(table)][..., None]
    own = np.zeros(truth.shape, bool)
    np.put_along_axis(own, which, True, 2)
    mosaic = np.take_along_axis(truth, which, 2)[..., 0]
    spread = np.float32(0.002**2 + 0.0001 * mosaic)
    observed = mosaic + np.sqrt(spread) * np.random.default_rng(1).standard_normal(SHAPE)
    values, _, variance = demosaic(
        observed.astype(np.float32), np.zeros(SHAPE, np.uint8), spread, pattern, method=method
    )
    return values, truth, variance, own


@pytest.mark.parametrize(
    ("kind", "pattern", "method"),
    [
        ("discs", BAYER, "malvar"),
        ("fine", BAYER, "bilinear"),
        ("discs", NINE, None),
        ("smooth", BAYER, "malvar"),
    ],
)
def test_sigma_of_a_demosaiced_picture_holds(kind, pattern, method):
    values, truth, variance, own = interpolated(kind, pattern, method)
    miss = ((values - truth) / np.sqrt(variance))[8:-8, 8:-8]
    own = own[8:-8, 8:-8]
    assert miss[own].std() == pytest.approx(1, abs=0.02)
    assert 0.5 < miss[~own].std() < 1.05
    assert np.mean(np.abs(miss[~own]) < 1.96) > 0.94


def test_detail_that_channels_do_not_share_is_in_the_sigma_of_malvars_weights():
    rng = np.random.default_rng(4)
    planes = [cv2.GaussianBlur(rng.standard_normal(SHAPE), (0, 0), 0.6) for _ in range(3)]
    truth = 0.4 + 0.1 * np.stack([plane / plane.std() for plane in planes], -1)
    table = channel_table(BAYER)
    y, x = np.indices(SHAPE)
    which = table[y % 2, x % 2][..., None]
    observed = np.take_along_axis(truth, which, 2)[..., 0].astype(np.float32)
    variance = np.full(SHAPE, 1e-6, np.float32)
    values, _, spread = demosaic(
        observed, np.zeros(SHAPE, np.uint8), variance, BAYER, method="malvar"
    )
    miss = ((values - truth) / np.sqrt(spread))[8:-8, 8:-8][(which != np.arange(3))[8:-8, 8:-8]]
    assert 0.7 < miss.std() < 1.1


@pytest.mark.parametrize("scale, shift", [(1, 0.5), (0.6, 0.3)])
def test_neighbours_that_share_sensels_are_not_averaged_as_if_they_did_not(scale, shift):
    values, truth, variance, _ = interpolated("smooth", BAYER, "malvar")
    there = Affine(np.array([[scale, 0.01, shift], [-0.01, scale, shift + 4]]))
    shape = tuple(int((n - 12) / scale) for n in SHAPE)
    more = shared_noise(Mosaic(BAYER, None, "RGB"), [there] * 3, shape)
    made = warp(values, there, shape, variance=variance * more)
    exact = warp(truth.astype(np.float32), there, shape)
    miss = ((made.values - exact.values) / np.sqrt(made.variance))[8:-8, 8:-8]
    assert 0.9 < miss[np.isfinite(miss)].std() < 1.05
