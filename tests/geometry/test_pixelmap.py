"""A map along lines laid out."""

import numpy as np
import pytest

from levkas.geometry.resample import warp
from levkas.geometry.spline import SplineShift


@pytest.mark.parametrize("period", [2, 8, 16])
def test_lines_that_wobble_in_step_with_the_nodes_lie_where_the_map_has_them(period):
    course = np.cos(2 * np.pi * np.arange(262) / period)
    lattice = np.stack([course, 0 * course], 1)[:, None].repeat(4, 1)
    wobble = SplineShift(np.array([0.0, -1.0]), 1.0, lattice)
    ramp = np.tile(np.arange(80, dtype=np.float32), (257, 1))
    found = warp(ramp, wobble, (257, 80)).values[:, 10:-10]
    y, x = np.mgrid[:257, 10:70].astype(float)
    expected = wobble(np.stack([x.ravel(), y.ravel()], 1))[:, 0].reshape(x.shape)
    assert np.abs(found - expected).max() < 1e-3
