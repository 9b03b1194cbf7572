"""Shot noise against the level: of a linear sensor the variance is read² + gain·signal, of one that flattens it is less.

Where counts y rise by a slope f' with the light x, the variance is read² + f'²·gain·x [janesick2007]_: a knee of half
the slope has a quarter of the noise, a full sensel none. Averaged frames have less noise, too, and are linear.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

DIM = 0.5  # of the brightest group: the noise of those below is that of a linear sensor
SURE = 0.05  # relative error of their gain, at most
QUIET = 0.85  # of the variance of a linear sensor: a tenth more or less is an unsteady object
SIGMAS = 5.0  # of a lack, to be one


class Groups(NamedTuple):
    """Pixels of like level: mean counts above dark, variance of one shot, counts², and its degrees of freedom."""

    signal: np.ndarray
    variance: np.ndarray
    freedom: np.ndarray


class Flattening(NamedTuple):
    """A response whose noise lacks at its bright end.

    Parameters
    ----------
    signal : float
        Counts above dark of the brightest groups.
    share : float
        Of the shot noise (variance) of a linear sensor that they have.
    linear : float
        Counts up to which the noise is that of a linear sensor.
    """

    signal: float
    share: float
    linear: float


def find_flattening(groups: Groups) -> Flattening | None:
    """Return where the bright groups of a sensor have less noise than dim ones foretell; None where they have as much, or none can.

    Parameters
    ----------
    groups : Groups
        Of stacks of one sensor, its darks among them.

    Examples
    --------
    A knee at 2500 counts, from which on they rise by half:

    >>> light = np.linspace(0, 3500, 50)
    >>> knee = np.minimum(light, 2500 + (light - 2500) / 2)
    >>> noise = 4 + 0.25 * light * np.where(light < 2500, 1, 0.25)
    >>> found = find_flattening(Groups(knee, noise, np.full(50, 5000.0)))
    >>> round(found.signal), round(found.share, 2)
    (2857, 0.28)
    >>> find_flattening(Groups(light, 4 + 0.25 * light, np.full(50, 5000.0))) is None
    True
    """
    line = _dim_line(groups)
    if line is None:
        return None
    gain, read, error = line
    order = np.argsort(groups.signal, kind="stable")
    signal, variance, freedom = (values[order] for values in groups)
    shot, expected = variance - read, gain * np.maximum(signal, 1e-9)
    bright = signal >= 0.9 * signal[-1]
    weight = freedom * bright / (read + expected) ** 2
    share = float(np.sum(weight * shot * expected) / np.sum(weight * expected**2))
    spread = np.sqrt(2 / np.sum(weight * expected**2)) + error
    if share > QUIET or 1 - share < SIGMAS * spread:
        return None
    return Flattening(float(signal[bright].mean()), max(share, 0.0), DIM * float(signal[-1]))


def _dim_line(groups: Groups) -> tuple[float, float, float] | None:
    """Return gain, variance without light, and the gain's relative error, by groups below half of the brightest; None of too few."""
    top = float(groups.signal.max(initial=0.0))
    dim = groups.signal <= DIM * top
    if top <= 0 or np.count_nonzero(dim) < 2:
        return None
    (gain, read), covariance = _line(*(values[dim] for values in groups))
    error = float(np.sqrt(covariance[0, 0]) / gain) if gain > 0 else np.inf
    return (float(gain), float(read), error) if error <= SURE else None


def _line(
    signal: np.ndarray, variance: np.ndarray, freedom: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return gain and variance without light of a weighted line, and their covariance."""
    design = np.stack([signal, np.ones_like(signal)], 1)
    expected = np.maximum(variance, 1e-12)
    for _ in range(3):
        weight = np.sqrt(freedom / 2) / expected
        covariance = np.linalg.pinv((design * weight[:, None]).T @ (design * weight[:, None]))
        found = covariance @ ((design * weight[:, None]).T @ (variance * weight))
        expected = np.maximum(design @ found, 1e-12)
    return found, covariance
