"""Lamp of a line scan: what the lines of its white show of how it changed up to the object's last line.

A push-broom camera captures line after line, so that lines are time: a lamp that changed by Δ along the n lines of the
white may go on so along the lines of the object.
"""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr, stdtrit

from levkas.calibration.drift import LONG, SIGMAS, LampChange, trend_of
from levkas.calibration.templates import ShotLevels

GROUPS = 8
"""Of neighbouring bands whose lamp is alike: lamps change smoothly over the spectrum. Of a lamp that sinks by 0.2 % within 40
lines, 580 bands of 0.1 to 2 % noise, the rms error of Δ is 0.11 %; 0.07 % with 4 groups, 0.12 % with 16. With every band by
itself noise passed for a change in 6 of 30 steady scans."""
FEWEST = 5
"""Lines of a white that show anything: the scatter of fewer is known too badly to separate a change from flicker."""


def lamp_along(white: ShotLevels, lines: int) -> LampChange:
    """Estimate how the lamp changed from the white of a push-broom camera to the last line of its object.

    Parameters
    ----------
    white : ShotLevels
        A line of the white is a shot, a band a channel.
    lines : int
        Of the object, captured after the white and each as long in time as one of the white.

    Returns
    -------
    change : LampChange
        `sigma` is that of the last line, of a scan of more than ten whites that of the first ten.

    Notes
    -----
    u = |Δ| (n/2 + lines)/n, up to 10 |Δ|: lamps settle. Δ is the change of a group of neighbouring bands, where it shows
    none that of all bands together, beyond what is as rare as four standard deviations (Student's t, by the scatter of the lines), with the error of that.
    Where neither shows any, u is what noise leaves open within the white, and `detection_limit` what could be beyond it.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> levels = np.linspace(1.001, 0.999, 64)[:, None] * rng.normal(1, 0.0001, (64, 3))
    >>> found = lamp_along(ShotLevels(levels, np.full(3, 0.0001)), 480)
    >>> found.reach, found.sigma.round(3).tolist()
    (8.0, [0.016, 0.016, 0.016])
    """
    count, bands = white.levels.shape
    none = np.full(bands, np.nan)
    if count < FEWEST:
        return LampChange(np.ones(bands), np.zeros(bands), none, none, none, timed=False)
    # As probable by chance as SIGMAS of the normal distribution.
    chance = -float(stdtrit(count - 2, ndtr(-SIGMAS)))
    of_band = np.arange(bands) * min(GROUPS, bands) // bands
    group, every = trend_of(_joined(white, of_band)), trend_of(_joined(white, 0 * of_band))
    known = np.abs(group.change) > chance * group.error
    together = np.where(np.abs(every.change) > chance * every.error, every.change, 0.0)
    change = np.where(known, group.change, together)[of_band]
    error = np.where(known, group.error, every.error)[of_band]
    reach = (count / 2 + lines) / count
    flicker = trend_of(white).flicker
    drift = np.hypot(change, error) * min(reach, LONG)
    drift = np.where(change != 0, drift, group.reach[of_band])
    return LampChange(
        np.ones(bands),
        np.nan_to_num(np.hypot(drift, np.nan_to_num(flicker) * np.sqrt(1 + 1 / count))),
        change,
        none,
        flicker,
        timed=False,
        reach=reach,
        detection_limit=float(np.nan_to_num(chance * every.error[0] * reach)),
    )


def _joined(stack: ShotLevels, of_band: np.ndarray) -> ShotLevels:
    """Return the weighted means of the levels of bands that belong together, (shots, groups)."""
    member = of_band[:, None] == np.arange(of_band.max() + 1)
    weights = member / np.maximum(stack.error, 1e-9)[:, None] ** 2
    total = weights.sum(0)
    some = np.maximum(total, 1e-300)
    levels = np.where(total > 0, stack.levels @ weights / some, 1.0)
    return ShotLevels(levels, np.where(total > 0, 1 / np.sqrt(some), np.inf))
