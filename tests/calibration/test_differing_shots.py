"""Shots of a white that show something else than the others, and shots of an object that are no shots."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

from levkas.calibration.sight import (
    Sight,
    difference_between,
)

Y, X = np.mgrid[:240, :320] / 240


def panel(seed, shape=(240, 320)):
    """Reflectance of a painted panel before a dark cloth: 0.03 to 0.9, with detail of every size."""
    rng = np.random.default_rng(seed)
    layers = [gaussian_filter(rng.standard_normal(shape), s) * s for s in (1, 2, 4, 8, 16, 32)]
    paint = 0.06 + 0.8 / (1 + np.exp(-3 * sum(layers)))
    inside = (abs(Y - 0.5) < 0.45) & (abs(X - 0.65) < 0.6)
    return np.where(inside, paint, 0.03)


def recorded(scene, seed=9, light=2500.0):
    rng = np.random.default_rng(seed)
    counts = 60 + rng.normal(light * scene, np.sqrt(4 + 0.3 * light * np.clip(scene, 0, None)))
    return np.clip(np.rint(counts), 0, 4095).astype(np.uint16)


def difference(scene, light=2500.0, first=None):
    one = panel(1) if first is None else first
    sights = [Sight.of(recorded(s, k, light), (1, 1)) for k, s in enumerate((one, scene))]
    return difference_between(*sights, 60.0, 4095.0)


def with_insects(scene):
    scene = scene.copy()
    for k in range(8):
        scene[20 + 25 * k : 26 + 25 * k, 30 * k : 30 * k + 8] = 0.02
    return scene


def jpeg(scene):
    return np.clip(scene, 0, 1) ** (1 / 2.2)


LAMPS = [(0.6 + 0.8 * X / X.max()), (1.3 - 0.6 * Y), 1 / (0.5 + (X - 0.2) ** 2 + (Y - 0.1) ** 2)]


@pytest.mark.parametrize("light", [2500.0, 250.0])
def test_another_scene_is_one(light):
    assert difference(panel(2), light)[0] == "scene"


@pytest.mark.parametrize("pixels", [(1.2, 0), (30, -11)])
def test_another_place_is_told_in_pixels(pixels):
    moved = shift(panel(1), pixels, mode="nearest")
    what, by = difference(moved)
    assert what == "place" and by == pytest.approx(np.hypot(*pixels), abs=0.3)


@pytest.mark.parametrize("lamp", LAMPS)
def test_other_light_is_no_exposure(lamp):
    assert difference(panel(1) * lamp / np.median(lamp))[0] == "light"
    assert difference(2 * panel(1) * lamp / np.median(lamp))[0] == "light"


@pytest.mark.parametrize("times", [0.25, 2 ** (1 / 3)])
def test_another_exposure_is_told_as_a_ratio(times):
    what, by = difference(times * panel(1), 900.0)
    assert what == "exposure" and by == pytest.approx(times, rel=0.02)
    assert difference(jpeg(times * panel(1)), first=jpeg(panel(1)))[0] == "exposure"


@pytest.mark.parametrize("light", [2500.0, 25.0, 0.0])
@pytest.mark.parametrize(
    "change", [lambda s: s, lambda s: 1.06 * s, lambda s: 0.94 * s, with_insects],
    ids=["noise", "more", "less", "insects"],
)  # fmt: skip
def test_noise_lamp_and_insects_are_no_difference(change, light):
    assert difference(change(panel(1)), light) is None


def test_a_tremble_of_half_a_pixel_and_a_lamp_that_leans_are_no_difference():
    assert difference(shift(panel(1), (0.3, 0.4), mode="nearest")) is None
    assert difference(panel(1) * (0.96 + 0.08 * X / X.max())) is None
