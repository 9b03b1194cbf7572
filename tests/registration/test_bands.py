"""Grey pictures: averages over what is valid, in place."""

import numpy as np
import pytest

from levkas.registration.bands import BandImage, area_average, grey, stretch


def test_grey_is_the_mean_of_all_bands():
    rng = np.random.default_rng(0)
    bands = rng.uniform(0, 1, (5, 20, 30)).astype(np.float32)
    values, valid = grey([BandImage.of(str(k), band) for k, band in enumerate(bands)])
    np.testing.assert_allclose(values, bands.mean(0), atol=1e-6)
    assert valid.all()


def test_a_band_that_is_missing_at_a_pixel_leaves_no_step():
    one, two = np.full((10, 10), 0.2), np.full((10, 10), 0.8)
    two[4, 4] = np.nan
    values, valid = grey([BandImage.of("a", one), BandImage.of("b", two)])
    assert valid[4, 4]
    assert values[4, 4] == pytest.approx(0.5)


def test_a_pixel_that_most_bands_lack_is_invalid():
    bands = [BandImage.of(str(k), np.full((8, 8), np.nan if k else 1.0)) for k in range(3)]
    assert not grey(bands)[1].any()


def test_grey_refuses_bands_of_different_sizes():
    with pytest.raises(ValueError, match="one size"):
        grey([BandImage.of("a", np.ones((4, 4))), BandImage.of("b", np.ones((4, 5)))])


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


@pytest.mark.parametrize("scale", [0, -1, 1.5])
def test_area_average_never_enlarges(scale):
    with pytest.raises(ValueError, match="scale"):
        area_average(np.ones((8, 8), np.float32), np.ones((8, 8), bool), scale)


def test_stretch_of_a_blank_picture_is_blank():
    assert len(np.unique(stretch(np.full((9, 9), 3.0), np.ones((9, 9), bool)))) == 1
    assert len(np.unique(stretch(np.full((9, 9), np.nan), np.zeros((9, 9), bool)))) == 1


def test_a_band_image_needs_a_mask_of_its_size():
    with pytest.raises(ValueError, match="valid"):
        BandImage("a", 550.0, np.ones((4, 4), np.float32), np.ones((4, 5), bool))


@pytest.mark.parametrize("factor", [16, 257])
def test_eight_and_sixteen_bits_of_a_picture_are_one(factor):
    codes = np.random.default_rng(1).integers(0, 256, (40, 50)).astype(np.uint8)
    eight, sixteen = (
        BandImage.of("G", picture) for picture in (codes, (codes * np.uint16(factor)))
    )
    assert np.array_equal(eight.values, sixteen.values) and eight.values.max() == 1
