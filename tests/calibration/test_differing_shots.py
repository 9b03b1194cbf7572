"""Shots of a white that show something else than the others, and shots of an object that are no shots."""

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter, shift

import levkas
from levkas.calibration.differing_shots import (
    Sight,
    difference_between,
    require_agreement,
)
from levkas.calibration.drift import average_steady
from levkas.calibration.templates import CalibrationRefused

SHAPE = (120, 160)


def whites(levels, hands=(), seed=1, light=3000.0):
    """Shots of a vignetted board; `hands` are the shots with a hand before a part of it."""
    rng, (y, x) = np.random.default_rng(seed), np.indices(SHAPE)
    even = 1 - ((y / SHAPE[0] - 0.5) ** 2 + (x / SHAPE[1] - 0.5) ** 2)
    made = []
    for k, level in enumerate(levels):
        scene = light * level * even
        if k in hands:
            scene[40:90, 30:100] *= 0.4
        made.append(np.rint(60 + rng.normal(scene, np.sqrt(0.25 * scene + 6))).astype(np.uint16))
    return made


def averaged(frames, **more):
    return average_steady(lambda: frames, 60.0, white=True, **more)


@pytest.mark.parametrize("light", [3000.0, 60.0])
def test_a_hand_in_one_of_some_whites_is_named(light):
    found = averaged(whites(1 + 0.01 * np.arange(6), hands={3}, light=light))
    assert found.shots.differing == (3,)
    with pytest.raises(CalibrationRefused) as refused:
        require_agreement(found.shots, [f"white_{k}.tif" for k in range(6)])
    assert refused.value.problems[0].file == "white_3.tif"


@pytest.mark.parametrize("levels", [[1, 0.95] * 3, [1, 1.02, 1.04, 1.06], [1, 0.96]])
def test_a_lamp_that_drifts_or_flickers_leaves_no_shot_out(levels):
    for light in (3000.0, 8.0):
        assert averaged(whites(levels, light=light)).shots.apart == 0


def test_a_bracket_of_two_whites_is_refused():
    with pytest.raises(CalibrationRefused) as refused:
        require_agreement(averaged(whites([1, 0.25])).shots)
    assert refused.value.problems[0].code == "E_UNLIKE_SHOTS"


@pytest.mark.parametrize("hands", [{1}, {0, 2}])
def test_whites_of_which_no_majority_agrees_are_refused(hands):
    made = averaged(whites([1.0] * (2 * len(hands)), hands))
    with pytest.raises(CalibrationRefused) as refused:
        require_agreement(made.shots)
    assert refused.value.problems[0].code == "E_UNLIKE_SHOTS"


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


def test_arrays_of_two_scenes_are_refused_as_in_a_build():
    frames = [recorded(panel(1), 1), recorded(panel(2), 2)]
    with pytest.raises(CalibrationRefused) as refused:
        levkas.calibrate(frames, recorded(0 * Y, 3), recorded(1 + 0 * Y, 4))
    assert [p.code for p in refused.value.problems] == ["E_UNLIKE_SHOTS"]
