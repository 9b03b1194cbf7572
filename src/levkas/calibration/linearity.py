"""Do exposures scale? The same scene at several times must give counts in their ratio.

y(g, t) = C(g)·t + offset for groups g of pixels of like brightness, fitted so that Σ(Δy/y)² is
least over 5–95 % of saturation; what is left, relative, is the deviation from linearity.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.calibration.darks import match_dark
from levkas.calibration.templates import Template

USED = (0.05, 0.95)  # of saturation, as EMVA 1288 has it
GROUPS = 20
FEWEST = 50  # pixels of a group
MANY_PIXELS = 200_000


@dataclass(frozen=True)
class Linearity:
    """How well exposures scale.

    Parameters
    ----------
    rms, worst : float
        Deviation from the line, relative; `worst` keeps its sign.
    worst_at_s : float
        Exposure of the worst, s.
    offset : float
        Counts at exposure 0 above what was subtracted; 0 where it was not fitted.
    points : int
        Groups times exposures behind the numbers; 0: nothing could be compared.
    """

    rms: float
    worst: float
    worst_at_s: float
    offset: float
    points: int


def check_linearity(
    shots: Sequence[Template],
    darks: Template | Sequence[Template] | None = None,
    *,
    saturation: float,
    black: float | None = None,
    fit_offset: bool = False,
) -> Linearity:
    """Compare exposures of one still scene.

    Parameters
    ----------
    shots : sequence of Template
        Of different `exposure_s`, all known; of one shape.
    darks, black
        Subtracted as in `darks.match_dark`.
    saturation : float
        Counts; 5 to 95 % of it is compared.
    fit_offset : bool
        Fit an offset common to all: cameras that clip their darks at 0 hide one.

    Returns
    -------
    linearity : Linearity

    Notes
    -----
    A pixel takes part at an exposure where it is neither flagged nor out of range. Groups are
    made by rate, from the longest usable exposure, so that noise near the limits of the range,
    which chooses pixels by their noise, is shared by many.
    """
    timed = sorted(shots, key=lambda shot: shot.exposure_s or 0.0)
    times = np.array([shot.exposure_s for shot in timed], float)
    step = max(1, timed[0].mean.size // MANY_PIXELS)
    signal, usable = [], []
    for shot in timed:
        under = np.broadcast_to(
            match_dark(darks, shot.exposure_s, black=black).mean, shot.mean.shape
        )
        signal.append((shot.mean - under).ravel()[::step].astype(float))
        usable.append(~(shot.saturated | shot.black).ravel()[::step])
    rows = _points(np.array(signal), np.array(usable), times, saturation)
    return _fit(rows, fit_offset)


def _points(
    signal: np.ndarray, usable: np.ndarray, times: np.ndarray, saturation: float
) -> list[tuple[int, float, float]]:
    """Return (group, exposure, mean signal) where a whole group is in range at an exposure."""
    low, high = USED[0] * saturation, USED[1] * saturation
    fits = usable & (signal < high)
    longest = np.where(fits.any(0), len(times) - 1 - np.argmax(fits[::-1], 0), -1)
    pixel = np.arange(signal.shape[1])
    rate = np.where(longest >= 0, signal[longest, pixel] / times[longest], 0.0)
    order = np.argsort(rate, kind="stable")
    order = order[rate[order] > 0]
    rows = []
    for g, members in enumerate(np.array_split(order, GROUPS)):
        if len(members) < FEWEST:
            continue
        for i, t in enumerate(times):
            clean = usable[i, members]
            mean = signal[i, members].mean()
            if clean.mean() > 0.999 and low <= mean <= high:
                rows.append((g, float(t), float(signal[i, members[clean]].mean())))
    return rows


def _fit(rows: list[tuple[int, float, float]], fit_offset: bool) -> Linearity:
    groups = [g for g, _, _ in rows]
    rows = [row for row in rows if groups.count(row[0]) >= 2]
    if not rows:
        return Linearity(np.nan, np.nan, np.nan, 0.0, 0)
    found, which = np.unique([g for g, _, _ in rows], return_inverse=True)
    times, signal = (np.array([row[i] for row in rows]) for i in (1, 2))
    design = np.zeros((len(rows), len(found) + int(fit_offset)))
    design[np.arange(len(rows)), which] = times
    design[:, len(found) :] = 1
    solved = np.linalg.lstsq(design / signal[:, None], np.ones(len(rows)), rcond=None)[0]
    miss = signal / (design @ solved) - 1
    worst = int(np.abs(miss).argmax())
    offset = float(solved[-1]) if fit_offset else 0.0
    rms = float(np.sqrt(np.mean(miss**2)))
    return Linearity(rms, float(miss[worst]), float(times[worst]), offset, len(rows))
