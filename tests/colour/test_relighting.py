import numpy as np
import pytest

from levkas.colour.illuminants import light_on_grid
from levkas.colour.relighting import adaptation, relight
from levkas.colour.srgb import SRGB_TO_XYZ, find_rendering, observer_under
from levkas.core.cube import Band

WAVES = np.arange(400, 721, 10.0)


def white_of(light):
    return observer_under(light)[1].sum(0)


def test_a_white_stays_white_to_an_eye_that_is_used_to_the_light_and_reddens_to_another():
    white = np.ones((1, len(WAVES)))
    for light in ("A", "3200 K", (np.array([400.0, 700]), np.array([0.2, 1.0]))):
        assert relight(white, WAVES, light).min() >= 254, light
    red, _, blue = relight(0.4 * white, WAVES, "A", adapted=False)[0].astype(int)
    assert red > blue + 60


def test_under_d65_it_is_the_picture_of_the_build():
    rng = np.random.default_rng(2)
    values = rng.random((5, 7, len(WAVES)))
    built = find_rendering([Band(f"{w:g} nm", w) for w in WAVES])(values)
    assert np.abs(relight(values, WAVES, "D65").astype(int) - built).max() <= 1


def test_adaptation_takes_one_white_to_the_other_and_back():
    there = adaptation(white_of("A"), SRGB_TO_XYZ.sum(1))
    back = adaptation(SRGB_TO_XYZ.sum(1), white_of("A"))
    assert np.allclose(there @ white_of("A"), SRGB_TO_XYZ.sum(1))
    assert np.allclose(there @ back, np.eye(3))


@pytest.mark.parametrize(
    "light",
    ["F99", "20 K", (np.array([400.0, 700]), np.zeros(2)), (np.array([1.0, 2]), -np.ones(2))],
)
def test_what_is_no_light_is_refused(light):
    with pytest.raises(ValueError):
        light_on_grid(light)
