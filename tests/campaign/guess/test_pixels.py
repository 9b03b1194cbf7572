import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.campaign.guess.pixels import (
    bits_of,
    describe_pixels,
    find_mosaic,
    is_same_scene,
    name_mosaic,
)


def noisy(shape=(60, 80), level=2000.0, seed=0):
    rng = np.random.default_rng(seed)
    falloff = 1 - 0.3 * np.linspace(-1, 1, shape[1]) ** 2
    return rng.normal(level * falloff, np.sqrt(level), shape).round().astype(np.uint16)


def test_a_plain_sensor_has_no_mosaic_for_all_its_noise_and_vignetting():
    assert find_mosaic(describe_pixels(noisy()).phases) == 0


@pytest.mark.parametrize("side", [2, 3, 4, 5])
def test_the_side_of_a_tile_is_found(side):
    gains = np.random.default_rng(side).uniform(0.5, 1.0, (side, side))
    plane = noisy((60 * side, 20 * side)) * np.tile(gains, (60, 20))
    assert find_mosaic(describe_pixels(plane).phases) == side


@settings(max_examples=30, deadline=None)
@given(st.permutations([0, 1]), st.booleans(), st.floats(0.3, 0.9), st.floats(1.2, 3.0))
def test_red_is_found_by_the_colour_of_the_object_wherever_it_stands(order, mirrored, blue, warm):
    white = np.array([[0.7, 1.0], [1.0, 0.6]])
    share = np.array([[0.4, 0.3], [0.3, 0.4 / warm]])
    letters = np.array([["R", "G"], ["G", "B"]])
    for array in (white, share, letters):
        array[:] = array[::-1, ::-1] if order[0] else array
    tiles = [a[:, ::-1] if mirrored else a for a in (white, share, letters)]
    bright = 3000 * tiles[0] + 64
    shown = {"icon": 3000 * tiles[0] * tiles[1] + 64}
    named = name_mosaic(2, bright, dark=64, shown=shown, warmth={"icon": np.log(warm)})
    assert (named.letters, named.unknown) == ("".join(tiles[2].ravel()), "")


def test_narrow_bands_tell_the_whole_pattern():
    sees = {"G": {450: 0.2, 550: 1.0, 650: 0.1}, "B": {450: 1.0, 550: 0.1, 650: 0.02}}
    sees["R"] = {450: 0.05, 550: 0.1, 650: 1.0}
    phases = {
        nm: np.array([[sees["G"][nm], sees["B"][nm]], [sees["R"][nm], sees["G"][nm]]]) * 200
        for nm in (450, 550, 650)
    }
    named = name_mosaic(2, phases[550], narrow=phases)
    assert (named.letters, named.unknown) == ("GBRG", "")


def test_without_evidence_the_order_of_red_and_blue_is_unknown():
    assert "red or blue" in name_mosaic(2, np.array([[0.7, 1.0], [1.0, 0.6]])).unknown
    other = name_mosaic(3, np.arange(1.0, 10.0).reshape(3, 3))
    assert other.rows == (("B1", "B2", "B3"), ("B4", "B5", "B6"), ("B7", "B8", "B9"))
    assert other.unknown


def test_codes_tell_bits_and_where_they_stand():
    plain, high = noisy(), noisy() << 4
    assert (describe_pixels(plain).step, describe_pixels(high).step) == (1, 16)
    assert bits_of(4095, 1) == bits_of(65520, 16) == 12
    assert (bits_of(1000, 1), bits_of(4096, 1), bits_of(40000, 1)) == (10, 14, 16)


def test_shots_of_one_scene_are_alike_and_of_two_are_not():
    rng = np.random.default_rng(0)
    scene, other = (np.kron(rng.uniform(200, 3000, (6, 8)), np.ones((10, 10))) for _ in range(2))
    shots = [
        describe_pixels(s + rng.normal(0, 30, s.shape)).thumbnail for s in (scene, scene, other)
    ]
    assert is_same_scene(shots[0], shots[1])
    assert not is_same_scene(shots[0], shots[2])
    darks = [describe_pixels(rng.normal(64, 2, (60, 80))).thumbnail for _ in range(2)]
    assert is_same_scene(*darks)
