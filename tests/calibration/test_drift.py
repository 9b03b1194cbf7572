import numpy as np
import pytest

from levkas.calibration.lamp import (
    CellMeans,
    average_steady,
    black_between,
    lamp_between,
)
from levkas.calibration.motion import find_moved
from levkas.calibration.noise_fit import NoiseModel
from levkas.calibration.templates import ShotLevels, average
from levkas.quality.emva1288.drift import measure_drift


def series(scales, seed=1):
    rng = np.random.default_rng(seed)
    scene = np.linspace(2000, 20_000, 320) * np.ones((256, 1))
    return [64 + 0.1 * rng.poisson(scene * s) for s in scales]


def drift_of(frames):
    light = CellMeans()
    average(light.watch(frames))
    return measure_drift(light.channels.reshape(len(frames), -1), 64.0)


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


def test_noise_is_found_pixel_by_pixel_under_a_lamp_that_drifts_in_each_colour():
    rng = np.random.default_rng(2)
    scene = rng.uniform(200, 3000, (96, 120))
    steady = [rng.normal(scene, np.sqrt(0.25 * scene + 4)) for _ in range(3)]
    drifting = []
    for k, frame in enumerate(steady):
        lamp = np.tile(1 + (k - 1) * np.array([[0.03, 0.02], [0.02, 0.005]]), (48, 60))
        drifting.append(60 + frame * lamp)  # the noise of a frame is scaled by 3 % with it
    made = average_steady(lambda: drifting, 60.0, period=(2, 2))
    plain = average([60 + frame for frame in steady])
    np.testing.assert_allclose(made.mean, plain.mean, rtol=5e-3)
    # what the shots' own scatter takes from the median over cells: 0.1 % of the light
    assert np.corrcoef(made.variance.ravel(), plain.variance.ravel())[0, 1] > 0.995
    np.testing.assert_allclose(made.shots.levels[0], [0.97, 0.98, 0.98, 0.995], atol=1.5e-3)


def test_what_moved_is_not_taken_for_the_lamp():
    rng = np.random.default_rng(3)
    frames = [np.float32(rng.normal(1000, 10, (128, 128)) * s) for s in (0.98, 1.0, 1.02)]
    frames[2][:50, :80] *= 1.7
    made = average_steady(lambda: frames, 0.0)
    np.testing.assert_allclose(made.shots.levels[:, 0], [0.98, 1.0, 1.02], atol=0.002)
    still = np.concatenate([made.variance[60:].ravel(), made.variance[:60, 90:].ravel()])
    assert np.mean(still) == pytest.approx(100, rel=0.03)


def coverage(lamp, white_at, shot_at, known, count=2000, error=2e-4):
    """Share of draws in which the light on the object lies within 1.96 sigma."""
    rng, held = np.random.default_rng(5), 0
    for _ in range(count):
        level = lamp(rng)
        at = [level(np.asarray(times, float)) for times in (white_at, shot_at)]
        observed = [a * rng.normal(1, error, len(a)) for a in at]
        stacks = [
            ShotLevels((s / s.mean())[:, None], np.array([error]), tuple(t) if known else None)
            for s, t in zip(observed, (white_at, shot_at), strict=True)
        ]
        found = lamp_between(*stacks)
        miss = at[1].mean() / at[0].mean() - 1
        held += abs(miss) < 1.96 * max(found.sigma[0], error)
    return held / count


def falling(rng):
    """A lamp that falls along a line."""
    slope = rng.normal(0, 0.001)
    return lambda t: 1 + slope * t


def warming(rng):
    """A lamp that settles."""
    size, time = rng.normal(0, 0.03), rng.uniform(5, 40)
    return lambda t: 1 - size * np.exp(-t / time)


def flickering(rng):
    """A lamp that is brighter or darker in every shot."""
    return lambda t: rng.normal(1, 0.01, len(t))


@pytest.mark.parametrize("lamp", [falling, warming, flickering])
@pytest.mark.parametrize(
    ("white_at", "shot_at", "known"),
    [
        ([0, 1, 2, 3, 4, 5], [8], False),
        ([0, 1, 2, 17, 18, 19], [10, 11], True),
    ],
)
def test_the_light_on_the_object_is_known_as_well_as_stated(lamp, white_at, shot_at, known):
    assert coverage(lamp, white_at, shot_at, known) > 0.87


def test_a_black_level_that_wanders_goes_on_until_the_object_is_captured():
    """A random walk of the level, one step a shot: four darks, and an object after 20 shots, or amid them."""
    rng, shots = np.random.default_rng(6), 24
    missed, stated = [], []
    for _ in range(2000):
        walk = 0.3 * np.cumsum(rng.standard_normal(shots))
        darks = walk[:4] - walk[:4].mean()
        levels = ShotLevels(darks[:, None], np.array([1e-3]), tuple(map(float, range(4))))
        object_shot = ShotLevels(np.ones((1, 1)), np.array([1e-3]), (shots - 1.0,))
        missed.append(walk[-1] - walk[:4].mean())
        stated.append(black_between(levels, object_shot).sigma[0])
        assert stated[-1] >= black_between(levels).sigma[0]
    rms_missed, rms_stated = (np.sqrt(np.mean(np.square(one))) for one in (missed, stated))
    assert 0.7 < rms_stated / rms_missed < 1.4
