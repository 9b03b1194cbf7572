"""A simulated camera whose every number is known, and what photon transfer gives back."""

import numpy as np
import pytest

from levkas.calibration.codes import count_codes
from levkas.calibration.lamp import CellMeans
from levkas.calibration.noise_model import Sensor
from levkas.calibration.templates import CalibrationRefused, average
from levkas.quality.emva1288.blocks import Blocks, block_statistics
from levkas.quality.emva1288.darks import Dark
from levkas.quality.emva1288.drift import measure_drift
from levkas.quality.emva1288.levels import find_levels
from levkas.quality.emva1288.photon_transfer import measure_sensor
from levkas.simulation.capture import expose, fixed_pattern, key

SIZE = (320, 448)
TIMES = (0.1, 0.2, 0.4, 0.6, 0.8)
X = np.arange(683)
D80 = np.rint(X + 0.01565 * np.maximum(X - 215, 0) ** 2)
"""The 683 codes to which a Nikon D80 compresses."""
PLAIN = {"black": 64.0, "full_well": 1e9}
"""A well that is deeper than the converter reaches."""


class Camera:
    def __init__(self, sensor, *, curved=False, flicker=0.0, **spoilt):
        self.sensor, self.curved, self.flicker = sensor, curved, flicker
        self.pattern = fixed_pattern(SIZE, sensor, np.random.default_rng(5), **spoilt)
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
            nearest = np.searchsorted((D80[1:] + D80[:-1]) / 2, frame)
            yield D80[nearest].astype(np.uint16) if self.curved else frame

    def stack(self, share, count=4):
        light, full = CellMeans(), self.sensor.saturation
        made = average(light.watch(self.shots(share, count)), saturation=full, exposure_s=share)
        drift = measure_drift(light.channels.reshape(len(light.shots), -1), self.sensor.black)
        return block_statistics(made, drift=drift, dark=self.sensor.black)[""]

    def darks(self):
        stack = average(list(self.shots(0.0)), saturation=self.sensor.saturation)
        return [Dark.of_blocks(block_statistics(stack, clipped=True)[""])]

    def measure(self, **more):
        levels = find_levels(count_codes(f for t in (0.0, *TIMES) for f in self.shots(t, 2)))
        whites = [self.stack(t) for t in TIMES]
        return found_of(self.darks(), whites, levels=levels, **more), levels


def found_of(darks, whites, **more):
    rng = np.random.default_rng(1)
    return measure_sensor(darks, whites, saturation=4095, rng=rng, **{"draws": 4, **more})


@pytest.mark.parametrize(
    ("sensor", "camera"),
    [
        (Sensor(**PLAIN), {}),
        pytest.param(Sensor(black=16.0, full_well=1e9), {"curved": True}, marks=pytest.mark.slow),
        # 1 % of 3,200 counts is 1,000 counts²: three times the shot noise, if it counted.
        pytest.param(Sensor(**PLAIN), {"flicker": 0.01}, marks=pytest.mark.slow),
        # 30 % of vignetting would be 8 % of spread; hot sensels are in every tenth block.
        pytest.param(Sensor(**PLAIN), {"hot": 4e-4, "dead": 2e-4}, marks=pytest.mark.slow),
    ],
    ids=["plain", "curved", "flicker", "hot"],
)
def test_a_known_sensor_comes_back(sensor, camera):
    found, levels = Camera(sensor, **camera).measure(draws=40)
    quiet = np.sqrt(sensor.dark * (1 + sensor.dsnu**2) + sensor.read**2)
    assert levels.curved == camera.get("curved", False)
    assert found.gain.value == pytest.approx(sensor.gain, rel=0.03)
    assert found.dark_noise == pytest.approx(quiet, rel=0.03)
    assert found.prnu == pytest.approx(sensor.prnu, rel=0.03)
    assert found.black == pytest.approx(sensor.black + sensor.gain * sensor.dark, abs=0.05)
    assert found.full_well == pytest.approx((4095 - found.black) / sensor.gain, rel=0.03)
    least = np.sqrt(found.dark_noise**2 + 0.25) + 0.5
    assert found.dynamic_range == pytest.approx(found.full_well / least)
    assert found.snr == pytest.approx(np.sqrt(found.full_well))


def test_dark_current_and_black_come_from_darks_of_several_times():
    rng = np.random.default_rng(2)
    darks = []
    for time in (1.0, 4.0, 16.0):
        frames = [np.rint(64 + 0.5 * rng.poisson(6 * time, SIZE)).astype(np.uint16) for _ in "ab"]
        darks.append(Dark.of_blocks(block_statistics(average(frames, exposure_s=time))[""]))
    lit = [np.rint(64 + 0.5 * rng.poisson(4000, SIZE)).astype(np.uint16) for _ in "abcd"]
    white = block_statistics(average(lit, saturation=4095, exposure_s=1.0))[""]
    found = found_of(darks, [white])
    assert found.dark_current == pytest.approx(6.0, rel=0.02)
    assert found.black == pytest.approx(64.0, abs=0.05)


def test_linearity_finds_a_bend():
    camera = Camera(Sensor(**PLAIN))
    darks, straight = camera.darks(), [camera.stack(t) for t in TIMES]
    bent = [
        Blocks(b.mean - 1e-5 * (b.mean - 64) ** 2, b.temporal, b.spatial, b.shots, b.exposure_s)
        for b in straight
    ]
    errors = [found_of(darks, whites).linearity_error for whites in (straight, bent)]
    assert errors[0] < 1e-3 < 4e-3 < errors[1]


def test_what_tells_nothing_is_refused():
    camera = Camera(Sensor(**PLAIN))
    darks, lit, whole = camera.darks(), camera.stack(0.4), camera.stack(0.0)
    cut = Blocks(*(a[:-4] for a in (lit.mean, lit.temporal, lit.spatial)), lit.shots)
    falling = Blocks(lit.mean, 0 * lit.temporal, lit.spatial, lit.shots)
    once, over = camera.stack(0.4, count=1), camera.stack(1.5)
    camera.shade = np.ones(SIZE)
    for dark, white, code in (
        (darks, once, "E_SHOTS"),
        ([], lit, "E_TEMPLATE_MISSING"),
        (darks, cut, "E_SIZE"),
        (darks, over, "E_WHITE_SATURATED"),
        (darks, camera.stack(0.95), "E_WHITE_SATURATED"),
        ([Dark.of_blocks(lit)], whole, "E_WHITE_DARK"),
        (darks, falling, "E_NOISE"),
    ):
        with pytest.raises(CalibrationRefused) as refused:
            found_of(dark, [white])
        assert refused.value.problems[0].code == code
