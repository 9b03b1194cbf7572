"""Maps of many bands laid out: the same tables however many are held, and none held twice."""

import numpy as np
import pytest

from levkas.geometry.pixel_maps import lay, lay_bands
from levkas.geometry.resample import warp
from levkas.geometry.spline import SplineShift
from levkas.geometry.transforms import Affine, Composed, Lens

SHAPE = (90, 130)


def band_map(band):
    """A lens whose magnification hangs on the band."""
    lens = Lens(np.array([65.0, 45.0]), 90.0, (0.004 + 0.0002 * band, -0.002), (1e-4, 2e-4))
    return Composed(Affine.scaling(1 + 0.002 * band), lens)


MAPS = [band_map(band) for band in range(37)]


@pytest.mark.parametrize("threads", ["1", "3"])
def test_bands_lie_where_they_lie_by_themselves(monkeypatch, threads):
    monkeypatch.setenv("LEVKAS_THREADS", threads)
    lattices = [*lay_bands(MAPS, SHAPE)]
    assert len(lattices) == len(MAPS)
    for lattice, transform in zip(lattices, MAPS, strict=True):
        alone = lay(transform, SHAPE).lattices[0]
        assert alone.segment == lattice.segment
        assert np.array_equal(lattice.table, alone.table)


@pytest.mark.parametrize("bands", [1, 3, 37])
def test_a_band_with_a_map_of_its_own_is_as_by_itself(bands):
    rng = np.random.default_rng(bands)
    cube = rng.random((80, 120, bands), np.float32)
    cube[rng.random(cube.shape) < 0.001] = np.nan
    flags = (8 * (rng.random(cube.shape) < 0.01)).astype(np.uint8)
    variance = rng.random(cube.shape, np.float32)
    whole = warp(cube, MAPS[:bands], SHAPE, flags=flags, variance=variance)
    for band in range(bands):
        parts = (np.ascontiguousarray(a[..., band]) for a in (flags, variance))
        marks, noise = parts
        alone = warp(cube[..., band], MAPS[band], SHAPE, flags=marks, variance=noise)
        assert np.array_equal(whole.values[..., band], alone.values, equal_nan=True)
        assert np.array_equal(whole.flags[..., band], alone.flags)
        assert np.array_equal(whole.variance[..., band], alone.variance, equal_nan=True)


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
