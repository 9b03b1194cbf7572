"""A simulated camera whose every number is known, and what photon transfer gives back."""

import numpy as np
import pytest

from levkas.calibration.code_spacing import count_codes, find_levels
from levkas.calibration.drift import CellMeans, measure_drift
from levkas.calibration.noise_model import Sensor
from levkas.calibration.templates import CalibrationRefused, average
from levkas.quality.emva1288.blocks import Blocks, block_statistics
from levkas.quality.emva1288.darks import Dark
from levkas.quality.emva1288.photon_transfer import measure_sensor
from levkas.simulation.capture import expose, fixed_pattern, key

SIZE = (320, 448)
TIMES = (0.1, 0.2, 0.4, 0.6, 0.8)
X = np.arange(683)
D80 = np.rint(X + 0.01565 * np.maximum(X - 215, 0) ** 2)


def squeeze(frame):
    """Compress to the 683 codes of a Nikon D80, and expand again."""
    return D80[np.searchsorted((D80[1:] + D80[:-1]) / 2, frame)].astype(np.uint16)


class Camera:
    def __init__(self, sensor, *, curved=False, flicker=0.0):
        self.sensor, self.curved, self.flicker = sensor, curved, flicker
        self.pattern = fixed_pattern(SIZE, sensor, np.random.default_rng(5))
        y, x = np.indices(SIZE)
        self.shade = 1 - 0.3 * 2 * ((y / SIZE[0] - 0.5) ** 2 + (x / SIZE[1] - 0.5) ** 2)
        self.full = (sensor.saturation - sensor.black) / sensor.gain
        self.taken = 0

    def shots(self, share, count=4):
        for _ in range(count):
            self.taken += 1
            lamp = 1 + self.flicker * np.random.default_rng(self.taken).standard_normal()
            light = np.float32(share * self.full * lamp * self.shade)
            frame = expose(light, self.sensor, self.pattern, key(7, str(self.taken)))
            yield squeeze(frame) if self.curved else frame

    def stack(self, share, count=4):
        light, full = CellMeans(), self.sensor.saturation
        made = average(light.watch(self.shots(share, count)), saturation=full, exposure_s=share)
        drift = measure_drift(light.cells, self.sensor.black)
        return block_statistics(made, drift=drift, dark=self.sensor.black)[""]

    def darks(self):
        frames = list(self.shots(0.0))
        stack = average(frames, saturation=self.sensor.saturation)
        return [Dark.of_blocks(block_statistics(stack, clipped=True)[""])]

    def measure(self, **more):
        levels = find_levels(count_codes(f for t in (0.0, *TIMES) for f in self.shots(t, 2)))
        found = measure_sensor(
            self.darks(),
            [self.stack(t) for t in TIMES],
            saturation=self.sensor.saturation,
            rng=np.random.default_rng(1),
            levels=levels,
            **more,
        )
        return found, levels


def known(**numbers):
    """A sensor whose well is deeper than its converter reaches."""
    return Sensor(full_well=1e9, **numbers)


@pytest.fixture(scope="module")
def plain():
    return Camera(known(black=64.0)).measure()[0]


@pytest.mark.parametrize(
    ("sensor", "curved"),
    [
        (known(black=64.0), False),
        pytest.param(known(black=16.0), True, marks=pytest.mark.slow),
    ],
    ids=["plain", "curved"],
)
def test_a_known_sensor_comes_back(sensor, curved):
    found, levels = Camera(sensor, curved=curved).measure(draws=40)
    quiet = np.sqrt(sensor.dark * (1 + sensor.dsnu**2) + sensor.read**2)
    assert levels.curved == curved
    assert found.gain.value == pytest.approx(sensor.gain, rel=0.03)
    assert found.dark_noise.value == pytest.approx(quiet, rel=0.03)
    assert found.prnu.value == pytest.approx(sensor.prnu, rel=0.03)
    assert found.black.value == pytest.approx(sensor.black + sensor.gain * sensor.dark, abs=0.05)


@pytest.mark.slow
def test_intervals_hold_the_truth_and_are_narrow(plain):
    for name, truth in (("gain", 0.09), ("prnu", 0.019), ("full_well", 4031 / 0.09 - 32)):
        found = getattr(plain, name)
        assert found.low < truth < found.high or found.value == pytest.approx(truth, rel=0.003)
        assert (found.high - found.low) / found.value < 0.02


def test_dynamic_range_is_emvas(plain):
    least = np.sqrt(plain.dark_noise.value**2 + 0.25) + 0.5
    assert plain.dynamic_range.value == pytest.approx(plain.full_well.value / least)
    assert plain.snr.value == pytest.approx(np.sqrt(plain.full_well.value))


@pytest.mark.slow
def test_flicker_of_the_lamp_is_no_noise():
    # 1 % of 3,200 counts is 1,000 counts²: three times the shot noise, if it counted.
    found, _ = Camera(known(black=64.0), flicker=0.01).measure(draws=4)
    assert found.gain.value == pytest.approx(0.09, rel=0.02)


def test_dark_current_and_black_come_from_darks_of_several_times():
    rng = np.random.default_rng(2)
    darks = []
    for time in (1.0, 4.0, 16.0):
        frames = [np.rint(64 + 0.5 * rng.poisson(6 * time, SIZE)).astype(np.uint16) for _ in "ab"]
        darks.append(Dark.of_blocks(block_statistics(average(frames, exposure_s=time))[""]))
    lit = [np.rint(64 + 0.5 * rng.poisson(4000, SIZE)).astype(np.uint16) for _ in "abcd"]
    white = block_statistics(average(lit, saturation=4095, exposure_s=1.0))[""]
    found = measure_sensor(darks, [white], saturation=4095, rng=rng, draws=20)
    assert found.dark_current.value == pytest.approx(6.0, rel=0.02)
    assert found.black.value == pytest.approx(64.0, abs=0.05)


def test_linearity_finds_a_bend():
    camera = Camera(known(black=64.0))
    darks, straight = camera.darks(), [camera.stack(t) for t in TIMES]
    bent = [type(b)(b.mean - 1e-5 * (b.mean - 64) ** 2, *_rest(b)) for b in straight]
    found = [
        measure_sensor(darks, w, saturation=4095, rng=np.random.default_rng(1), draws=4)
        for w in (straight, bent)
    ]
    assert found[0].linearity_error.value < 1e-3 < 4e-3 < found[1].linearity_error.value


def _rest(blocks):
    return blocks.temporal, blocks.spatial, blocks.shots, blocks.exposure_s


def refusal(darks, whites, code):
    with pytest.raises(CalibrationRefused) as refused:
        measure_sensor(darks, whites, saturation=4095, rng=np.random.default_rng(1))
    assert refused.value.problems[0].code == code
    return refused.value.problems[0].fix


def test_what_tells_nothing_is_refused_with_what_to_capture():
    camera = Camera(known(black=64.0))
    darks, once, over = camera.darks(), camera.stack(0.4, count=1), camera.stack(1.5)
    assert "twice or more" in refusal(darks, [once], "E_SHOTS")
    assert "two darks" in refusal([], [camera.stack(0.4)], "E_TEMPLATE_MISSING")
    whole = camera.stack(0.4)
    cut = Blocks(*(a[:-4] for a in (whole.mean, whole.temporal, whole.spatial)), whole.shots)
    assert "one mode" in refusal(darks, [cut], "E_SIZE")
    assert "85 %" in refusal(darks, [over], "E_WHITE_SATURATED")
    camera.shade = np.ones(SIZE)
    assert "half the exposure" in refusal(darks, [camera.stack(0.95)], "E_WHITE_SATURATED")
    swapped = [Dark.of_blocks(camera.stack(0.4))]
    assert "swapped" in refusal(swapped, [camera.stack(0.0)], "E_WHITE_DARK")


def test_noise_that_falls_with_the_light_is_refused():
    rng = np.random.default_rng(9)
    dark, lit = (
        block_statistics(average(list(rng.normal(level, noise, (4, 160, 160)))))[""]
        for level, noise in ((64, 9), (600, 3))
    )
    with pytest.raises(CalibrationRefused, match="does not grow with the light") as refused:
        measure_sensor([Dark.of_blocks(dark)], [lit], saturation=1023, rng=rng)
    assert refused.value.problems[0].code == "E_NOISE"


def test_single_shots_beside_stacks_still_tell_prnu():
    camera = Camera(known(black=64.0))
    whites = [camera.stack(0.3), camera.stack(0.6, count=1)]
    found = measure_sensor(
        camera.darks(), whites, saturation=4095, rng=np.random.default_rng(1), draws=4
    )
    assert found.prnu.value == pytest.approx(0.019, rel=0.03)


@pytest.mark.slow
def test_hot_sensels_and_shading_do_not_change_prnu():
    # 30 % of vignetting would be 8 % of spread; two hot sensels in 10,000 are in every tenth block.
    sensor = known(black=64.0)
    camera = Camera(sensor)
    camera.pattern = fixed_pattern(SIZE, sensor, np.random.default_rng(6), hot=4e-4, dead=2e-4)
    assert camera.measure(draws=4)[0].prnu.value == pytest.approx(0.019, rel=0.03)
