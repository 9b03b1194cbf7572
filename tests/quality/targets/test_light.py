import itertools

import numpy as np
import pytest

from levkas.quality.image_quality.light import LightRefused, light_field


def hill(size=(96, 128), at=(60, 40), width=90.0):
    y, x = np.mgrid[: size[0], : size[1]]
    return 1000 * np.exp(-((x - at[0]) ** 2 + (y - at[1]) ** 2) / (2 * width**2))


def largest_by_trying_all(levels, least):
    rows, columns = levels.shape
    best = 0
    for y0, y1 in itertools.combinations(range(rows + 1), 2):
        for x0, x1 in itertools.combinations(range(columns + 1), 2):
            part = levels[y0:y1, x0:x1]
            if part.size > best and part.min() >= least * part.max():
                best = part.size
    return best


def test_the_rectangle_is_the_largest_there_is():
    rng = np.random.default_rng(1)
    white = np.kron(rng.uniform(0.85, 1, (8, 9)), np.ones((1, 1)))
    field = light_field(white)
    x, y, width, height = field.rectangle
    inside = field.levels[y : y + height, x : x + width]
    assert inside.min() >= 0.9 * inside.max()
    assert width * height == largest_by_trying_all(field.levels, 0.9)


def test_the_rectangle_lies_about_the_brightest_place():
    field = light_field(hill())
    x, y, width, height = field.rectangle
    assert abs(x + width / 2 - 60) < 12 and abs(y + height / 2 - 40) < 12
    row, column = field.profiles
    assert row.argmax() * field.step == pytest.approx(60, abs=field.step)
    assert len(column) == field.levels.shape[0]


def test_a_saturated_white_and_one_without_light_are_refused():
    full = np.zeros((50, 60), bool)
    full[:10] = True
    for white, marks, code in (
        (np.full((50, 60), 4095.0), full, "E_WHITE_SATURATED"),
        (np.zeros((50, 60)), None, "E_WHITE_DARK"),
    ):
        with pytest.raises(LightRefused) as refused:
            light_field(white, saturated=marks)
        assert refused.value.problems[0].code == code
