import numpy as np
import pytest

from levkas.calibration.drift import CellMeans, measure_drift
from levkas.calibration.motion import find_moved
from levkas.calibration.noise_fit import NoiseModel, fit_noise
from levkas.calibration.templates import average


def series(scales, seed=1):
    rng = np.random.default_rng(seed)
    scene = np.linspace(2000, 20_000, 320) * np.ones((256, 1))
    return [64 + 0.1 * rng.poisson(scene * s) for s in scales]


def drift_of(frames):
    light = CellMeans()
    average(light.watch(frames))
    return measure_drift(light.cells, 64.0)


def test_a_lamp_that_warms_up_is_noticed():
    found = drift_of(series(np.linspace(1.0, 1.01, 5)))
    assert found.noticed
    assert found.drift == pytest.approx(0.01, abs=2e-4)
    assert found.flicker < 3e-4
    assert "+1.00 %" in found.note


def test_a_lamp_that_flickers_is_noticed():
    scales = [1.0, 1.01, 0.99, 1.01, 0.99, 1.0]
    found = drift_of(series(scales))
    assert found.noticed
    assert found.flicker == pytest.approx(0.01, rel=0.2)


def test_a_steady_lamp_is_not():
    assert not any(drift_of(series([1.0] * 4, seed)).noticed for seed in range(10))


def test_something_that_moved_in_a_corner_is_no_drift():
    frames = series([1.0] * 3)
    frames[2][:128, :160] *= 1.5
    assert not drift_of(frames).noticed


def test_a_single_shot_and_the_dark_tell_nothing():
    assert measure_drift(np.ones((1, 4))) is None
    assert measure_drift(np.full((3, 4), 64.0), 64.0) is None


def stack(count, *, moved=0.0, period=(1, 1)):
    rng = np.random.default_rng(count)
    frames = [0.1 * rng.poisson(5000.0, (300, 300)) for _ in range(count)]
    frames[-1][100 : 100 + 12 * period[0] : period[0], 50 : 50 + 12 * period[1] : period[1]] += (
        moved
    )
    return average(frames)


@pytest.mark.parametrize("count", [2, 5, 11])
def test_what_moved_is_found_and_nothing_else(count):
    noise = NoiseModel(0.1, 0.01)
    # 100 counts of 500, noise 7: seen by every pixel's neighbourhood, one pixel beyond at most.
    marked = find_moved(stack(count, moved=100.0), noise)
    assert marked[100:112, 50:62].all()
    assert marked.sum() <= 14 * 14
    assert not find_moved(stack(count), noise).any()


def test_neighbours_are_those_of_the_same_phase():
    marked = find_moved(stack(4, moved=100.0, period=(2, 2)), NoiseModel(0.1, 0.01), period=(2, 2))
    assert marked[100:124:2, 50:74:2].all()
    assert not marked[101::2].any()
    assert not marked[:, 51::2].any()


def test_one_shot_cannot_move():
    assert not find_moved(stack(1), NoiseModel(0.1, 0.01)).any()


def test_a_real_burst_has_leaves_that_sway_under_a_falling_light(real_data):
    import cv2

    paths = sorted((real_data / "silios-kinect" / "burst").glob("*_multi*.png"), key=_number)
    light = CellMeans()
    frames = (cv2.imread(str(p), cv2.IMREAD_UNCHANGED) for p in paths)
    made = average(light.watch(frames), saturation=255)
    found = measure_drift(light.cells)
    # Eleven outdoor frames: the light falls by 2.2 %.
    assert found.drift == pytest.approx(-0.022, abs=0.003)
    marked = find_moved(made, fit_noise([made]), period=(3, 3))
    assert 0.0002 < marked.mean() < 0.002


def _number(path):
    return int(path.name.split("_")[0])
