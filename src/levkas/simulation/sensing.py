"""Sensor model: light on each sensel to counts in a file, Eq. (2) of [mirhashemi2019]_.

Every random number is a hash of (key of the frame, index of the sensel): the same bytes come out
whatever the number of threads, and any frame can be made without those before it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING
from zlib import crc32

import numpy as np

from levkas.core.compiled import njit, prange

if TYPE_CHECKING:
    from levkas.calibration.noise_model import Sensor

FEW = 24.0


@dataclass(frozen=True, eq=False)
class FixedPattern:
    """What stays the same from frame to frame; arrays (rows, columns), float32.

    Parameters
    ----------
    response : ndarray
        1 + u of Eq. (2); near 0 where a sensel is dead.
    dark : ndarray
        Mean dark current over the sensor's: 1, or tens to hundreds where a sensel is hot.
    dark_response : ndarray
        1 + v of Eq. (2).
    """

    response: np.ndarray
    dark: np.ndarray
    dark_response: np.ndarray


def key(root: int, *names: str) -> np.ndarray:
    """Return the key, uint64 (1,), of a thing that is told apart by `names`."""
    parts = [crc32(name.encode()) for name in names]
    return np.random.SeedSequence([root, *parts]).generate_state(1, np.uint64)


def fixed_pattern(
    shape: tuple[int, int],
    sensor: Sensor,
    rng: np.random.Generator,
    *,
    hot: float = 2e-4,
    dead: float = 4e-5,
) -> FixedPattern:
    """Draw a sensor's fixed pattern.

    Parameters
    ----------
    shape : (rows, columns)
    sensor : Sensor
    rng : Generator
    hot, dead : float
        Shares of sensels.
    """
    response = 1 + sensor.prnu * rng.standard_normal(shape, np.float32)
    dark_response = 1 + sensor.dsnu * rng.standard_normal(shape, np.float32)
    dark = np.ones(shape, np.float32)
    count = round(hot * response.size)
    dark.flat[rng.integers(0, dark.size, count)] = rng.uniform(20, 400, count)
    count = round(dead * response.size)
    response.flat[rng.integers(0, dark.size, count)] = rng.uniform(0, 0.15, count)
    return FixedPattern(response, dark, dark_response)


def expose(
    exposure: np.ndarray, sensor: Sensor, pattern: FixedPattern, seed: np.ndarray
) -> np.ndarray:
    """Return one frame.

    Parameters
    ----------
    exposure : ndarray, (rows, columns), float32
        Mean photo-electrons e of each sensel.
    sensor : Sensor
    pattern : FixedPattern
    seed : ndarray, (1,), uint64
        What `key` returns; one a frame.

    Returns
    -------
    counts : ndarray, (rows, columns), uint16

    Notes
    -----
    Poisson counts of mean 24 and more are drawn as rounded normal deviates with the skewness
    restored (Cornish–Fisher), wrong by less than 1e-3 in probability; smaller ones exactly.
    """
    counts = np.empty(exposure.shape, np.uint16)
    numbers = np.array(
        [
            sensor.dark,
            sensor.read,
            sensor.gain,
            sensor.black,
            float(sensor.saturation),
            sensor.full_well,
        ]
    )
    _expose(
        np.ascontiguousarray(exposure, np.float32),
        pattern.response,
        pattern.dark,
        pattern.dark_response,
        numbers,
        _poisson_table(sensor.dark),
        seed[0],
        counts,
    )
    return counts


def _poisson_table(mean: float) -> np.ndarray:
    """Return the distribution function of a Poisson variate, for looking the common dark up."""
    from scipy.special import pdtr

    return pdtr(np.arange(int(mean + 12 * np.sqrt(mean) + 24)), mean)


@njit(cache=True)
def _uniform(state: np.uint64) -> float:
    """Return a number in (0, 1) from a counter: splitmix64's finaliser."""
    z = state
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return (float(z >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@njit(cache=True)
def _poisson(mean: float, normal: float, uniform: float) -> float:
    if mean >= FEW:
        root = np.sqrt(mean)
        return max(np.floor(mean + root * normal + (normal * normal - 1.0) / 6.0 + 0.5), 0.0)
    # Inversion by sequential search.
    share = np.exp(-mean)
    total, k = share, 0.0
    while uniform > total and k < 200.0:
        k += 1.0
        share *= mean / k
        total += share
    return k


@njit(cache=True, parallel=True)
def _expose(
    exposure: np.ndarray,
    response: np.ndarray,
    dark: np.ndarray,
    dark_response: np.ndarray,
    c: np.ndarray,
    table: np.ndarray,
    seed: np.uint64,
    counts: np.ndarray,
) -> None:
    rows, columns = exposure.shape
    golden = np.uint64(0x9E3779B97F4A7C15)
    start = int(c[0])
    for i in prange(rows):
        for j in range(columns):
            at = seed + np.uint64(4) * np.uint64(i * columns + j) * golden
            u0, u1 = _uniform(at), _uniform(at + golden)
            u2 = _uniform(at + np.uint64(2) * golden)
            # Box and Muller: one pair serves the shot noise and the read-out.
            radius, angle = np.sqrt(-2.0 * np.log(u0)), 2.0 * np.pi * u1
            shot = _poisson(exposure[i, j], radius * np.cos(angle), u2)
            u3 = _uniform(at + np.uint64(3) * golden)
            if dark[i, j] == 1.0:
                k = start
                while k > 0 and u3 <= table[k - 1]:
                    k -= 1
                while k < len(table) - 1 and u3 > table[k]:
                    k += 1
                thermal = float(k)
            else:
                mean = c[0] * dark[i, j]
                # A logistic deviate of spread 1 stands in for a normal one: hot sensels are few.
                thermal = _poisson(mean, np.sqrt(3.0) / np.pi * np.log(u3 / (1.0 - u3)), u3)
            value = shot * response[i, j] + thermal * dark_response[i, j]
            value = min(value, c[5]) + c[1] * radius * np.sin(angle)
            count = np.floor(value * c[2] + c[3] + 0.5)
            counts[i, j] = np.uint16(min(max(count, 0.0), c[4]))
