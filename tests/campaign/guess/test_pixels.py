import numpy as np
import pytest

from levkas.campaign.guess.pixels import (
    bits_of,
    describe_pixels,
    find_mosaic,
    name_mosaic,
)


def noisy(shape=(60, 80), level=2000.0, seed=0):
    rng = np.random.default_rng(seed)
    falloff = 1 - 0.3 * np.linspace(-1, 1, shape[1]) ** 2
    return rng.normal(level * falloff, np.sqrt(level), shape).round().astype(np.uint16)


@pytest.mark.parametrize("side", [2, 3, 4, 5])
def test_the_side_of_a_tile_is_found(side):
    gains = np.random.default_rng(side).uniform(0.5, 1.0, (side, side))
    plane = noisy((60 * side, 20 * side)) * np.tile(gains, (60, 20))
    assert find_mosaic(describe_pixels(plane).phases) == side


@pytest.mark.parametrize(
    ("turned", "mirrored"), [(False, False), (True, False), (False, True), (True, True)]
)
def test_red_is_where_the_painting_is_brighter_than_the_white_and_that_is_doubted(turned, mirrored):
    white = np.array([[0.7, 1.0], [1.0, 0.6]])
    share = np.array([[0.4, 0.3], [0.3, 0.2]])
    letters = np.array([["R", "G"], ["G", "B"]])
    tiles = [
        a[:: -1 if turned else 1, :: -1 if turned != mirrored else 1]
        for a in (white, share, letters)
    ]
    shown = {"icon": 3000 * tiles[0] * tiles[1] + 64}
    named = name_mosaic(2, 3000 * tiles[0] + 64, dark=64, shown=shown)
    assert named.letters == "".join(tiles[2].ravel()) and named.unknown


def test_without_evidence_the_order_of_red_and_blue_is_unknown():
    assert name_mosaic(2, np.array([[0.7, 1.0], [1.0, 0.6]])).unknown
    other = name_mosaic(3, np.arange(1.0, 10.0).reshape(3, 3))
    assert other.rows == (("B1", "B2", "B3"), ("B4", "B5", "B6"), ("B7", "B8", "B9"))
    assert other.unknown


def test_codes_tell_bits_and_where_they_stand():
    plain, high = noisy(), noisy() << 4
    assert (describe_pixels(plain).step, describe_pixels(high).step) == (1, 16)
    assert bits_of(4095, 1) == bits_of(65520, 16) == 12
    assert (bits_of(1000, 1), bits_of(4096, 1), bits_of(40000, 1)) == (10, 14, 16)
