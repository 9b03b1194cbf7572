"""A sensor that is not linear bends in its exposure series; a wrong time is no bend."""

import numpy as np
import pytest

from levkas.calibration.exposures import ALIKE, find_bend, find_points
from levkas.calibration.templates import average

GAIN, READ, BLACK, FULL = 0.25, 2.0, 60.0, 4095.0
TIMES = (0.25, 0.5, 1.0, 2.0)
RATES = np.kron(np.random.default_rng(1).uniform(0.02, 1.0, (8, 10)), np.ones((16, 16))) * 3600


def bent(light, bend, cubic=0.0):
    share = light / (FULL - BLACK)
    return light * (1 - bend * share - cubic * share**2)


def points(bend=0.0, *, cubic=0.0, times=TIMES, really=None, seed=2, full=FULL, warm=0.0, toe=0.0):
    """Points of a series that states `times`, and really took others; its dark is `warm` counts above its black."""
    rng = np.random.default_rng(seed)
    shots = []
    for stated, time in zip(times, really or times, strict=True):
        light = GAIN * rng.poisson(RATES * time / GAIN)
        counts = bent(light, bend, cubic) - toe * (1 - np.exp(-light / 150))
        codes = np.rint(counts + rng.normal(BLACK, READ, light.shape))
        codes = codes.clip(0, FULL).astype(np.uint16)
        shots.append(average([codes], saturation=full, exposure_s=stated))
    return find_points(shots, saturation=full, black=BLACK + warm, contrast=ALIKE)


@pytest.mark.parametrize(
    ("bend", "cubic"), [(0.06, 0.0), (0.12, 0.0), (-0.05, 0.0), (0.03, 0.03), (0.03, 0.0)]
)
@pytest.mark.parametrize("times", [TIMES, (0.5, 1.0)])
def test_a_planted_bend_is_found(bend, cubic, times):
    found = find_bend(points(bend, cubic=cubic, times=times), FULL - BLACK)
    light = np.array([100.0, 3500.0])
    low, high = light / bent(light, bend, cubic)
    assert found.is_sure and 0.8 < found.size / (high / low - 1) < (2 if cubic else 1.4)


@pytest.mark.parametrize("seed", range(2))
def test_a_linear_sensor_has_no_bend(seed):
    found = find_bend(points(seed=seed), FULL - BLACK)
    assert not found.is_sure and np.hypot(found.size, found.error) < 0.002 and found.offset == 0


@pytest.mark.parametrize(("odd", "factor"), [(0, 0.95), (3, 1.02), (1, 1.33)])
def test_a_wrong_time_of_one_exposure_is_no_bend(odd, factor):
    really = [t * (factor if i == odd else 1.0) for i, t in enumerate(TIMES)]
    assert not find_bend(points(really=really), FULL - BLACK).is_sure


@pytest.mark.parametrize(
    ("flicker", "times"), [(0.01, TIMES), (0.03, (0.25, 0.5, 1.0)), (0.03, (0.25, 1.0))]
)
def test_a_lamp_that_flickers_is_neither_bend_nor_offset(flicker, times):
    light = 1 + flicker * np.random.default_rng(4).standard_normal(len(times))
    found = find_bend(points(times=times, really=[*(light * times)]), FULL - BLACK)
    assert not found.is_sure and not found.offset


@pytest.mark.parametrize(
    ("bend", "times"), [(0.0, TIMES), (0.0, (0.25, 1.0)), (0.05, TIMES)], ids=str
)
def test_a_dark_of_another_temperature_is_an_offset(bend, times):
    found = find_bend(points(bend, times=times, warm=5.0), FULL - BLACK)
    assert found.offset == pytest.approx(-5.0, abs=1.0) and found.offset_error < 1.0
    assert found.is_sure == bool(bend)
    assert abs(find_bend(points(bend, times=times), FULL - BLACK).offset) < 0.5


def test_a_response_that_bends_at_its_dark_end_has_an_offset():
    assert -7 < find_bend(points(toe=6.0), FULL - BLACK).offset < -2
