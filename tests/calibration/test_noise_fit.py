import numpy as np
import pytest

from levkas.calibration.noise_fit import fit_noise, fit_noise_single
from levkas.calibration.templates import average


def ramp():
    return np.linspace(500, 30_000, 300) * np.ones((200, 1))


@pytest.mark.parametrize("count", [2, 5])
def test_gain_and_read_noise_come_back_from_stacks(sensor, count):
    rng = np.random.default_rng(1)
    dark, white, icon = (average(sensor.shots(ramp() * scale, count, rng)) for scale in (0, 1, 0.3))
    noise = fit_noise([dark, white, icon], [dark])
    # 60,000 pixels: the slope is known to about 0.5 %; read² holds the 1/12 of rounding.
    assert noise.gain == pytest.approx(sensor.gain, rel=0.02)
    assert noise.read_variance == pytest.approx(sensor.read**2 + 1 / 12, rel=0.03)


def test_few_pixels_of_very_unlike_signal_show_their_noise():
    """The white of a narrow scan: 120 samples of 6 bands, of which the last has a fiftieth of the light."""
    rng, gain, read = np.random.default_rng(6), 0.5, 4.0
    light = 28_500 * np.sin(np.linspace(0.6, 2.5, 120))[:, None] * np.linspace(1, 0.02, 6)
    lines = light + rng.normal(0, np.sqrt(gain * light + read**2), (100, 1, *light.shape))
    dark = rng.normal(0, read, (100, 1, *light.shape))
    white, under = (average([*np.rint(150 + n).astype(np.uint16)]) for n in (lines, dark))
    noise = fit_noise([white, under], [under])
    # 71,000 degrees of freedom: the slope is known to about 0.6 %, read² to 0.5 %.
    assert noise.gain == pytest.approx(gain, rel=0.03)
    assert noise.read_variance == pytest.approx(read**2 + 1 / 12, rel=0.03)


def test_something_that_moved_does_not_count(sensor):
    frames = sensor.shots(ramp(), 4, np.random.default_rng(3))
    frames[2] = frames[2].copy()
    frames[2][:4] += 500
    noise = fit_noise([average(frames)], black=sensor.black)
    assert noise.gain == pytest.approx(sensor.gain, rel=0.05)


def test_single_shots_give_an_estimate_free_of_prnu(sensor):
    # PRNU of 1.9 % alone would be 57² counts² at the white; shot noise is 300.
    rng = np.random.default_rng(5)
    white, icon = (average(sensor.shots(ramp() * s + 3000 * (1 - s), 1, rng)) for s in (1, 0.5))
    assert fit_noise([icon], black=sensor.black) is None  # they tell nothing of time
    noise = fit_noise_single([icon], [white], black=sensor.black)
    assert noise.source == "spatial"
    assert noise.gain == pytest.approx(sensor.gain, rel=0.15)


@pytest.mark.parametrize("electrons", [1_000.0, 12_000.0])
@pytest.mark.parametrize("times", [1, 3])
@pytest.mark.parametrize("shots_of_dark", [1, 4])
def test_single_shots_of_small_frames_of_unlike_paint_tell_their_noise(
    electrons, times, shots_of_dark
):
    """Of 80 x 120 px and three times as much a side: groups of like signal hold dark and bright paint together."""
    rng, read = np.random.default_rng(8), 6.0
    paint = np.geomspace(0.01, 0.9, 30 * times**2)
    panel = np.kron(rng.permutation(paint).reshape(5 * times, 6 * times), np.ones((16, 20)))

    def shot(light):
        return np.rint(rng.poisson(light) + rng.normal(100, read, panel.shape)).astype(np.uint16)

    icons, whites = (
        [average([shot(light)]) for _ in range(3)]
        for light in (electrons * panel, electrons + 0 * panel)
    )
    dark = average([shot(0 * panel) for _ in range(shots_of_dark)])
    noise = fit_noise_single(icons, whites, [dark])
    signal = electrons * paint
    over = noise.variance(signal) / (signal + read**2 + 1 / 12)
    # An upper estimate: edges of patches lie in most blocks.
    if shots_of_dark > 1:
        assert np.all((over > 0.9) & (over < 1.35)), over
    else:  # bright light alone does not tell what dark paint has
        assert np.all((over[signal > 500] > 0.85) & (over[signal > 500] < 1.45)), over
