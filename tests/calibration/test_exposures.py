import cv2
import numpy as np
import pytest

from levkas.calibration.exposures import (
    best_exposure,
    check_linearity,
    merge_exposures,
    require_scaling,
)
from levkas.calibration.noise_fit import NoiseModel
from levkas.calibration.templates import CalibrationRefused, average

TIMES = (0.1, 0.4, 1.6, 6.4)


def rates():
    return np.geomspace(20, 200_000, 200) * np.ones((300, 1))  # electrons a second


def series(sensor, rng, *, black=None, times=TIMES, stated=TIMES):
    return [
        average(
            sensor.shots(rates() * t, 1, rng, black=black),
            saturation=sensor.saturation,
            exposure_s=s,
        )
        for t, s in zip(times, stated, strict=True)
    ]


def darks(sensor, rng, *, black=None):
    return [average(sensor.shots(0 * rates(), 12, rng, black=black), exposure_s=t) for t in TIMES]


def test_the_longest_unsaturated_exposure_is_the_best():
    frames = [np.full((100, 100), 60 * n, np.uint8) for n in (1, 2, 4)]
    frames[2][0, 0] = 255
    shots = [
        average([f], saturation=255, exposure_s=t)
        for f, t in zip(frames, (1.0, 2.0, 4.0), strict=True)
    ]
    assert best_exposure(shots[::-1]).exposure_s == 4.0  # one of 10,000 is tolerated
    frames[2][0, 1] = 255
    shots[2] = average(frames[2:], saturation=255, exposure_s=4.0)
    assert best_exposure(shots).exposure_s == 2.0


def test_a_merge_is_unbiased_honest_and_near_the_bound(sensor):
    rng = np.random.default_rng(3)
    noise = NoiseModel(sensor.gain, sensor.read**2 + 1 / 12)
    dark = darks(sensor, rng)
    shots = series(sensor, rng)
    merged = merge_exposures(shots, dark, saturation=4095, noise=noise).template
    response = 1 + sensor.prnu * np.random.default_rng(99).standard_normal(rates().shape)
    truth = sensor.gain * rates() * response
    usable = ~merged.saturated.any(0)
    z = ((merged.mean - truth) / np.sqrt(merged.variance))[:, usable]
    assert 0.98 < z.std() < 1.02
    bright = usable & (truth[0] > 100)
    assert np.abs(merged.mean.mean(0) / truth.mean(0) - 1)[bright].max() < 0.003
    clear = [sensor.gain * rates()[0] * t + sensor.black < 0.9 * 4095 for t in TIMES]
    bound = 1 / sum(
        c * t**2 / (noise.variance(sensor.gain * rates()[0] * t))
        for c, t in zip(clear, TIMES, strict=True)
    )
    # Columns where an exposure is partly usable lie between two bounds: leave them out.
    apart = [sensor.gain * rates()[0] * t * 1.1 + sensor.black > 4095 for t in TIMES]
    sharp = usable & ~np.any([~c & ~a for c, a in zip(clear, apart, strict=True)], axis=0)
    assert ((merged.mean - truth).var(0) / bound)[sharp].mean() < 1.02


def test_where_every_exposure_is_saturated_the_shortest_stands_flagged(sensor):
    frame = np.full((4, 4), 4095, np.uint16)
    shots = [average([frame], saturation=4095, exposure_s=t) for t in (0.1, 0.2)]
    merged = merge_exposures(shots, saturation=4095).template
    assert merged.saturated.all()
    np.testing.assert_allclose(merged.mean, 40950)


def test_an_offset_that_clipped_darks_hide_is_found(sensor):
    rng = np.random.default_rng(5)
    shots = series(sensor, rng, black=-6.0)
    plain = check_linearity(shots, saturation=4095)
    fitted = check_linearity(shots, saturation=4095, fit_offset=True)
    assert fitted.offset == pytest.approx(-6.0, abs=0.5)
    assert fitted.rms < 0.002 < plain.rms
    hidden = darks(sensor, rng, black=-6.0)
    merged = merge_exposures(shots, hidden, saturation=4095)
    assert merged.linearity.offset == pytest.approx(-6.0, abs=0.5)


def leaky(leak, seed=7):
    """Exposures of discs of all tones on a sensor that leaks, their truth in counts a second, and the bound of it."""
    rng, side = np.random.default_rng(seed), 300
    tones = np.full((4 * side, 4 * side), 0.3, np.float32)
    for _ in range(400):
        tone = float(np.exp(rng.uniform(np.log(0.01), 0)))
        place = rng.integers(0, 4 * side, 2).tolist()
        cv2.circle(tones, place, int(rng.integers(6, 120)), tone, -1, cv2.LINE_AA)
    tones = cv2.resize(tones, (side, side), interpolation=cv2.INTER_AREA).astype(float)
    kernel = leak * np.array([[0.3, 1, 0.3], [1, 0, 1], [0.3, 1, 0.3]])
    light, wells = 600_000 * tones, 40_310.0  # electrons a second, electrons
    shots = []
    for t in (0.05, 0.2, 0.8):
        lent = cv2.filter2D(np.minimum(light * t, wells), -1, kernel)
        codes = np.rint(0.1 * rng.poisson(light * t + lent) + rng.normal(64, 2, tones.shape))
        codes = codes.clip(0, 4095).astype(np.uint16)
        shots.append(average([codes], saturation=4095, exposure_s=t))
    truth = 0.1 * (light + cv2.filter2D(light, -1, kernel))
    noise = NoiseModel(0.1, 4 + 1 / 12)
    usable = [truth * t + 64 < 0.98 * 4095 for t in (0.05, 0.2, 0.8)]
    known = sum(
        u * t**2 / noise.variance(truth * t) for u, t in zip(usable, (0.05, 0.2, 0.8), strict=True)
    )
    near = np.any([abs(truth * t + 64 - 0.98 * 4095) < 200 for t in (0.05, 0.2, 0.8)], axis=0)
    return shots, noise, truth, 1 / known, near


def test_what_full_sensels_lend_to_their_neighbours_is_no_bias():
    """Of these discs of all tones half the sensels lie next to full ones: their variance is up to 2.2 times the bound."""
    shots, noise, truth, bound, near = leaky(0.0018)
    merged = merge_exposures(shots, saturation=4095, black=64.0, noise=noise)
    miss = merged.template.mean - truth
    for low, high in ((0.01, 0.03), (0.03, 0.1), (0.1, 0.3), (0.3, 1.0)):
        part = (truth > 60_000 * low) & (truth < 60_000 * high) & ~near
        part &= ~merged.template.saturated
        assert np.mean(miss[part] ** 2 / bound[part]) < 2.5
        assert abs(np.mean(miss[part] / truth[part])) < 0.0015
    z = (miss / np.sqrt(merged.template.variance))[~near & ~merged.template.saturated]
    assert 0.97 < z.std() < 1.03
    assert merged.moved.mean() < 1e-4


@pytest.mark.parametrize(
    ("bent", "flicker", "hot"),
    [(0.0, 0.0, 0.0), (0.02, 0.0, 0.0), (0.0, 0.008, 0.0), (0.01, 0.008, 1e-3)],
)
def test_what_linearity_lamp_and_hot_sensels_leave_is_no_movement(sensor, bent, flicker, hot):
    rng, noise = np.random.default_rng(4), NoiseModel(sensor.gain, sensor.read**2 + 1 / 12)
    current = np.where(rng.random(rates().shape) < hot, 3000.0, 0.0)  # electrons a second
    fly, shots = np.zeros(rates().shape, bool), []
    fly[140:160, 100:120] = True
    for t, lamp in zip(TIMES, 1 + flicker * np.array([0, -1, 1, 0]), strict=True):
        scene = np.where(fly & (t == 1.6), 0.85, 1.0) * rates() * lamp + current
        (raw,) = np.array(sensor.shots(scene * t, 1, rng), float)
        raw = np.rint(raw - bent * (raw - 64).clip(0) ** 2 / 4095).clip(0, 4095)
        shots.append(average([raw.astype(np.uint16)], saturation=4095, exposure_s=t))
    found = merge_exposures(shots, black=64.0, saturation=4095, noise=noise)
    away = np.ones(fly.shape, bool)
    away[130:170, 90:130] = False
    assert found.moved[away].mean() < 0.001
    assert found.moved[fly].mean() > 0.95
    assert merge_exposures(shots, black=64.0, saturation=4095).moved is None


def test_a_sensel_that_blinks_marks_itself_alone(sensor):
    rng, noise = np.random.default_rng(6), NoiseModel(sensor.gain, sensor.read**2 + 1 / 12)
    shots = []
    for t in (0.1, 0.4, 1.6):
        (raw,) = sensor.shots(np.full((60, 60), 5000.0) * t, 1, rng)
        raw[20, 20] += 900 if t == 0.4 else 0
        shots.append(average([raw], saturation=4095, exposure_s=t))
    moved = merge_exposures(shots, black=64.0, saturation=4095, noise=noise).moved
    assert np.argwhere(moved).tolist() == [[20, 20]]


def test_groups_are_not_chosen_by_their_own_noise(sensor):
    # One brightness and much noise: groups ranked by it would come back to the mean, 5 % off.
    rng = np.random.default_rng(7)
    shots = [
        average(sensor.shots(np.full((300, 300), 5000.0) * t, 1, rng), saturation=900, exposure_s=t)
        for t in (0.5, 1.0)
    ]
    assert check_linearity(shots, saturation=900, black=64.0).rms < 0.002


def test_scaling_to_another_exposure_is_refused_with_where_it_broke(sensor):
    rng = np.random.default_rng(8)
    bent = series(sensor, rng, stated=(0.1, 0.4, 1.6, 6.9))
    found = check_linearity(bent, saturation=4095, black=64.0)
    with pytest.raises(CalibrationRefused) as refused:
        require_scaling(found)
    assert refused.value.problems[0].code == "E_EXPOSURES"
    require_scaling(check_linearity(series(sensor, rng), saturation=4095, black=64.0))
