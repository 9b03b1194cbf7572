from dataclasses import replace

import numpy as np
import pytest

from levkas.calibration.defects import find_defects, replace_defects
from levkas.calibration.templates import CalibrationRefused, average
from levkas.core.cube import Flag


def planted(shape, places, values, level, rng):
    frame = rng.normal(level, 2, shape)
    for place, value in zip(places, values, strict=True):
        frame[place] = value
    return np.rint(frame).clip(0).astype(np.uint16)


PLACES = [(0, 0), (10, 11), (30, 39), (17, 20)]


def test_hot_sensels_are_found_and_no_others():
    dark = planted((40, 40), PLACES, [300, 140, 900, 3000], 64, np.random.default_rng(0))
    found = find_defects(average([dark]), None, "RGGB")
    assert sorted(map(tuple, np.argwhere(found).tolist())) == sorted(PLACES)


def test_the_dark_of_a_white_that_is_above_dark_is_not_subtracted_again():
    dark = average([np.full((40, 40), 64, np.uint16)])
    white = average([np.full((40, 40), 100.0, np.float32)])
    white.mean[20, 20] = 75  # a quarter below its neighbours: PRNU
    merged = replace(white, above_dark=True)
    assert find_defects(dark, white)[20, 20] and not find_defects(dark, merged).any()


def test_dead_and_stuck_sensels_are_found_in_a_shaded_coloured_white():
    y, x = np.mgrid[:60, :60]
    shade = (1 - 0.3 * (x / 60) ** 2) * np.array([[2000, 3500], [3400, 900]])[y % 2, x % 2]
    for place, value in zip(PLACES, [0, 100, 4095, 4095], strict=True):
        shade[place] = value
    found = find_defects(None, average([shade.astype(np.float32)]), "RGGB")
    marked = set(map(tuple, np.argwhere(found).tolist()))
    # 4095 on a green of 3400 is within the half: what a flat field can mend is no defect.
    assert {(0, 0), (10, 11)} <= marked <= set(PLACES)


def test_a_frame_full_of_defects_is_refused():
    rng = np.random.default_rng(2)
    frame = rng.choice([64.0, 500.0], (50, 50), p=[0.9, 0.1]) + rng.normal(0, 1, (50, 50))
    with pytest.raises(CalibrationRefused):
        find_defects(average([frame]))


def test_replacement_is_the_median_of_the_same_phase():
    frame = np.tile(np.array([[10, 20], [20, 40]], np.float32), (5, 5))
    flags = np.zeros(frame.shape, np.uint8)
    frame[4, 4], flags[4, 4] = 999, Flag.DEFECT
    flags[4, 6] = Flag.SATURATED
    values, noted, variance = replace_defects(frame, flags, frame, "RGGB")
    assert values[4, 4] == 10
    assert noted[4, 4] == Flag.DEFECT | Flag.NEAR
    assert variance[4, 4] == 0
    assert np.array_equal(np.delete(values, 44), np.delete(frame, 44))


def test_defects_do_not_mend_each_other():
    frame, flags = np.ones((12, 12), np.float32), np.zeros((12, 12), np.uint8)
    frame[4:7, 4:7], flags[4:7, 4:7] = np.nan, Flag.DEFECT
    values, _, _ = replace_defects(frame, flags, None)
    np.testing.assert_array_equal(values, 1)


def test_the_stated_variance_covers_the_error_of_replacement():
    rng = np.random.default_rng(3)
    truth = rng.normal(100, 3, (300, 300)).astype(np.float32)
    flags = np.zeros(truth.shape, np.uint8)
    flags[5::10, 5::10] = Flag.DEFECT
    values, _, variance = replace_defects(np.where(flags, 0, truth), flags, truth * 0)
    z = ((values - truth) / np.sqrt(np.where(flags, variance, 1)))[flags > 0]
    # Student's t of 7 degrees of freedom: a spread of 1.18.
    assert 1.0 < z.std() < 1.35
