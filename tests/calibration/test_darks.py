import numpy as np
import pytest

from levkas.calibration.darks import match_dark
from levkas.calibration.templates import CalibrationRefused, average


def dark(value, exposure_s=None, count=1):
    return average([np.full((1, 1), value, np.float32)] * count, exposure_s=exposure_s)


def level(*arguments, **options):
    return float(match_dark(*arguments, **options).mean[0, 0])


def test_the_dark_of_the_same_time_is_taken_as_it_is():
    found = match_dark([dark(70, 1.0), dark(90, 2.0, count=4)], 2.004)
    assert float(found.mean[0, 0]) == 90
    assert found.share == 0.25
    assert found.note == ""


def test_between_two_times_the_dark_lies_on_their_line():
    # 0.25 of the way: 70 + 0.25 · 20; variance 0.75² + 0.25² of one shot.
    found = match_dark([dark(90, 2.0), dark(70, 1.0), dark(500, 9.0)], 1.25)
    assert float(found.mean[0, 0]) == 75
    assert found.share == pytest.approx(0.625)
    assert "1 s and 2 s" in found.note


def test_a_single_dark_is_scaled_about_a_known_black_only():
    assert level(dark(70, 1.0), 3.0, black=64.0) == 82
    assert level(dark(70, 1.0), 3.0) == 70
    assert "unknown" in match_dark(dark(70, 1.0), 3.0).note


def test_several_darks_and_no_time_are_refused():
    with pytest.raises(CalibrationRefused) as refused:
        match_dark([dark(70, 1.0), dark(90, 2.0)], None)
    assert refused.value.problems[0].code == "E_EXPOSURES"


def test_no_dark_is_the_black_level():
    assert level(None, 1.0, black=64.0) == 64
    assert level(None, 1.0) == 0


def test_a_dark_is_scaled_about_the_black_of_every_pixel():
    black = np.array([[60.0, 70.0], [80.0, 90.0]], np.float32)
    dark = average([black + 4], exposure_s=1.0)
    found = match_dark(dark, 3.0, black=black)
    assert np.allclose(found.mean, black + 12)
    assert np.allclose(match_dark(None, 3.0, black=black).mean, black)
