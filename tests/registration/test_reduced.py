"""Targets too fine for the reference: pictures cut out of one continuous picture at two scales."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, map_coordinates

from levkas.geometry.transforms import Affine
from levkas.registration import BandImage, register
from levkas.registration.reduced import reduce_target
from levkas.registration.request import Request


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


def test_what_is_stated_in_px_of_the_target_is_reduced_with_it():
    bands = [BandImage.of("1", np.ones((40, 80))), BandImage.of("2", np.ones((40, 80)))]
    shift = np.array([[1.0, 0, 8], [0, 1, -4]])
    request = Request(bands, bands[:], "1", align={"b": shift}, target_region=(8, 4, 40, 20))
    reduced = reduce_target(request, 4)
    assert [one.size for one in reduced.target] == [(20, 10), (20, 10)]
    assert reduced.target_region == [2, 1, 10, 5]
    for given in (shift, Affine(shift)):
        align = reduce_target(Request(bands, bands[:], "1", align={"b": given}), 4).align["b"]
        assert align(np.array([[3.0, 3.0]])) == pytest.approx(np.array([[5.0, 2.0]]))
