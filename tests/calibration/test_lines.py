"""Lines of a push-broom camera: every number is what the formula says, however it lies in memory."""

import numpy as np
import pytest

from levkas.calibration.lines import LineField
from levkas.calibration.noise_fit import NoiseModel
from levkas.calibration.pushbroom import average_lines
from levkas.core.cube import Flag

ORDERS = {"bil": (0, 2, 1), "bip": (0, 1, 2), "bsq": (2, 0, 1)}
SHAPES = [(4, 1, 1), (5, 3, 2), (7, 70, 5), (3, 65, 16), (2, 128, 33), (9, 200, 17)]
SATURATION, BOARD = 4000.0, 0.98
NOISE = NoiseModel(0.1, 9.0)


def stored_as(raw: np.ndarray, order: tuple[int, ...]) -> np.ndarray:
    """Return the array as a view of memory in which its axes lie in that order."""
    return np.ascontiguousarray(raw.transpose(order)).transpose(np.argsort(order))


def make(shape):
    rng = np.random.default_rng(sum(shape))
    frames = [rng.normal(level, 3, (40, *shape[1:])).astype(np.uint16) for level in (100, 3000)]
    dark, white = (average_lines([f], saturation=SATURATION) for f in frames)
    field = LineField.of(
        [dark],
        white,
        shape=shape[1:],
        reflectance=BOARD,
        black=None,
        noise=NOISE,
        labels=[str(band) for band in range(shape[2])],
    )
    return dark, white, field, rng.integers(0, 4096, shape).astype(np.uint16)


@pytest.mark.parametrize("shape", SHAPES, ids=str)
@pytest.mark.parametrize("order", ORDERS)
def test_reflectance_and_flags_are_those_of_the_formula(shape, order):
    dark, white, field, raw = make(shape)
    raw[0, 0, 0], raw[-1, -1, -1] = 0, 4095
    values, flags, sigma = field.develop(
        stored_as(raw, ORDERS[order]), saturation=SATURATION, threads=2
    )
    lit = white.mean.astype(float) - dark.mean
    expected = BOARD * (raw - dark.mean.astype(float)) / lit
    np.testing.assert_allclose(values, expected, rtol=2**-16)
    marked = np.where(raw >= SATURATION, int(Flag.SATURATED), 0)
    assert np.array_equal(flags, marked | np.where(raw <= 0, int(Flag.BLACK), 0))
    signal = raw - dark.mean.astype(float)
    least = BOARD * np.sqrt(NOISE.read_variance + NOISE.gain * np.maximum(signal, 0)) / lit
    assert (sigma > 0.999 * least).all() and (sigma < 1.2 * least).all()


@pytest.mark.parametrize("shape", SHAPES, ids=str)
def test_bytes_do_not_depend_on_threads_memory_or_the_lines_taken_together(shape):
    _, _, field, raw = make(shape)
    whole = field.develop(raw, saturation=SATURATION, threads=1)
    for order in ORDERS.values():
        parts = [
            field.develop(stored_as(raw[y : y + 2], order), saturation=SATURATION, threads=3)
            for y in range(0, len(raw), 2)
        ]
        for made, of_parts in zip(whole, zip(*parts, strict=True), strict=True):
            assert np.array_equal(made, np.concatenate(of_parts))


def test_the_square_of_sigma_has_all_its_bits():
    _, _, field, raw = make((3, 65, 16))
    sigma = field.develop(raw, saturation=SATURATION, threads=1)[2]
    squared = field.develop(raw, saturation=SATURATION, threads=1, squared=True)[2]
    assert np.array_equal(squared, np.square(sigma)) and np.array_equal(np.sqrt(squared), sigma)
