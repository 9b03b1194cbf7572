"""Shots of a white that show something else than the others."""

import numpy as np
import pytest

from levkas.calibration.differing_shots import find_differing_shots, require_agreement
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
def test_a_hand_in_one_of_some_whites_is_left_out(light):
    drifting = 1 + 0.01 * np.arange(6)
    found = averaged(whites(drifting, hands={3}, light=light), times_s=range(6))
    assert found.shots.left_out == (3,) and found.count == 5
    assert found.shots.times_s == (0, 1, 2, 4, 5)
    clean = averaged(whites(drifting[[0, 1, 2, 4, 5]], light=light))
    assert np.mean(found.mean - 60) / np.mean(clean.mean - 60) == pytest.approx(1, rel=2e-3)
    assert np.median(found.variance) == pytest.approx(np.median(clean.variance), rel=0.1)


def test_a_white_without_its_lamp_is_left_out_with_a_hand_in_another():
    found = averaged(whites([1, 0.02, 1, 1, 1, 1], hands={4}))
    assert found.shots.left_out == (1, 4)


@pytest.mark.parametrize("levels", [[1, 0.95] * 3, [1, 1.02, 1.04, 1.06], [1, 0.96]])
def test_a_lamp_that_drifts_or_flickers_leaves_no_shot_out(levels):
    assert averaged(whites(levels)).shots.left_out == ()
    assert averaged(whites(levels, light=8.0)).shots.apart == 0


@pytest.mark.parametrize("hands", [{1}, {0, 2}])
def test_whites_of_which_no_majority_agrees_are_refused(hands):
    made = averaged(whites([1.0] * (2 * len(hands)), hands))
    with pytest.raises(CalibrationRefused) as refused:
        require_agreement(made.shots)
    assert refused.value.problems[0].code == "E_WHITE_SHOTS"


def test_lines_of_many_weak_bands_are_left_in():
    rng = np.random.default_rng(4)
    light = np.geomspace(2, 2000, 40)[:, None] * np.linspace(0.1, 1, 8)
    noise = np.sqrt(0.25 * light + 9) / 3
    lines = light + noise * rng.standard_normal((400, 40, 8))
    assert find_differing_shots(lines).left_out == ()
