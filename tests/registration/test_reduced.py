"""Targets too fine for the reference: pictures cut out of one continuous picture at two scales."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from levkas.registration import register


@pytest.mark.slow
def test_a_macro_of_twelve_px_to_one_is_registered():
    rng = np.random.default_rng(5)
    picture = gaussian_filter(rng.standard_normal((220, 260)), 1.4)
    scale, x, y = 12.0, 40.0, 30.0
    across, down = np.arange(1800) / scale + x, np.arange(1500) / scale + y
    macro = map_coordinates(picture, np.meshgrid(down, across, indexing="ij"), order=3)
    found = register(
        picture + 0.02 * picture.std() * rng.standard_normal(picture.shape),
        macro + 0.05 * picture.std() * rng.standard_normal(macro.shape),
    )
    assert found.verdict.decision == "accept", found.verdict
    points = np.stack(np.meshgrid(np.linspace(60, 180, 7), np.linspace(50, 140, 7)), -1)
    points = points.reshape(-1, 2)
    off = (found.transforms["1"](points) - (points - (x, y)) * scale) / scale
    assert np.abs(off).mean() < 0.02
    assert np.abs(off).max() < 0.1
