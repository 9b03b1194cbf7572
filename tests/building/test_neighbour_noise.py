"""Noise that neighbours of the grid share: means of many pixels scatter as the correlation says."""

import numpy as np
import pytest

from levkas.geometry.resample import warp
from levkas.geometry.transforms import Affine
from levkas.stages.shared_noise import Mosaic, neighbour_correlation

SHAPE = (200, 220)


def affine(scale, shift=0.0, turn=0.0):
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    return Affine(np.array([[c, -s, 30 + shift], [s, c, 20 + shift]]))


def test_pixels_that_are_not_interpolated_share_nothing():
    found = neighbour_correlation([affine(1.0)], SHAPE)
    assert found[found.shape[0] // 2, found.shape[1] // 2] == 1 and found.sum() == pytest.approx(1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("scale", "shift", "turn"), [(1.0, 0.5, 0.0), (0.4, 0.2, 0.1), (1.7, 0.3, 0.2)]
)
def test_means_of_pixels_scatter_as_the_correlation_says(scale, shift, turn):
    one, side = affine(scale, shift, turn), 24
    found = neighbour_correlation([one], SHAPE)
    rng, means, spreads = np.random.default_rng(3), [], []
    for _ in range(300):
        noise = rng.standard_normal((420, 460)).astype(np.float32)
        made = warp(noise, one, SHAPE, variance=np.ones_like(noise))
        # Many places of one draw: at a fixed place only the phase of that place counts.
        part = made.values[40:160, 40:160]
        blocks = part[: 5 * side, : 5 * side].reshape(5, side, 5, side)
        means.append(blocks.mean((1, 3)).ravel())
        spreads.append(np.mean(made.variance[40:160, 40:160]))
    reach = len(found) // 2
    lags = np.abs(np.arange(-reach, reach + 1))
    pairs = np.maximum(side - lags, 0)
    share = (found * pairs[:, None] * pairs).sum() / side**2
    assert np.var(means) == pytest.approx(np.mean(spreads) * share / side**2, rel=0.06)


def test_channels_of_a_mosaic_share_more():
    plain = neighbour_correlation([affine(1.0)], SHAPE)
    mosaic = Mosaic((("R", "G"), ("G", "B")), "bilinear", ["R", "G", "B"])
    assert neighbour_correlation([affine(1.0)], SHAPE, mosaic).sum() > 1.5 * plain.sum()
