"""Grey pictures: averages over what is valid, in place."""

import numpy as np
import pytest

from levkas.registration.bands import BandImage, area_average, grey


def test_a_band_that_is_missing_at_a_pixel_leaves_no_step():
    one, two = np.full((10, 10), 0.2), np.full((10, 10), 0.8)
    two[4, 4] = np.nan
    values, valid = grey([BandImage.of("a", one), BandImage.of("b", two)])
    assert valid[4, 4]
    assert values[4, 4] == pytest.approx(0.5)


def test_area_average_keeps_a_ramp_in_place():
    ramp = np.tile(np.arange(90, dtype=np.float32), (60, 1))
    values, valid, back = area_average(ramp, np.ones(ramp.shape, bool), 1 / 3)
    assert values.shape == (20, 30) and valid.all()
    x = back(np.array([[7.0, 5.0]]))[0, 0]
    assert values[5, 7] == pytest.approx(x, abs=1e-4)


def test_area_average_ignores_what_is_invalid():
    values = np.ones((40, 40), np.float32)
    valid = np.ones((40, 40), bool)
    values[10:18, 10:18], valid[10:18, 10:18] = np.nan, False
    small, observed, _ = area_average(values, valid, 0.25)
    np.testing.assert_allclose(small[observed], 1, atol=1e-6)
    assert (~observed).sum() >= 1


@pytest.mark.parametrize("factor", [16, 257])
def test_eight_and_sixteen_bits_of_a_picture_are_one(factor):
    codes = np.random.default_rng(1).integers(0, 256, (40, 50)).astype(np.uint8)
    eight, sixteen = (
        BandImage.of("G", picture) for picture in (codes, (codes * np.uint16(factor)))
    )
    assert np.array_equal(eight.values, sixteen.values) and eight.values.max() == 1
