"""Shots of one white that differ from the others: a hand before the board, a lamp that was off, a board that ended.

A lamp that changes does so for all pixels alike. What only a part of one shot has, or none of its light, is no lamp:
the shot is left out where most of the others agree, and where they do not the white is contradicted by itself.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from levkas.calibration.templates import CalibrationRefused, ShotLevels
from levkas.core.problems import Problem

DIM = 0.02  # of the brightest cells: darker ones hold noise alone
LOCAL = 0.03  # of the light of a cell: a lamp that moves or flickers in bands does less
SIGMAS = 8.0  # of the noise of cells: of 200 shots, 64 cells, 200 bands one in 10^9 is beyond it
STEADY = (0.7, 1.4)  # least and greatest light of a shot that is a lamp's
CONTRADICTED = 0.1  # of the light of a cell: the mean of two whites is then wrong by as much


class DifferingShots(NamedTuple):
    """Shots of a stack that are left out, and how much the rest differ.

    Parameters
    ----------
    left_out : tuple of int
        Indices of shots, ascending.
    apart : float
        Largest deviation of a cell of a shot that is kept from the median of all, relative; 0 where it does not stand
        out of noise.
    """

    left_out: tuple[int, ...] = ()
    apart: float = 0.0


def find_differing_shots(light: np.ndarray) -> DifferingShots:
    """Find the shots of one scene that show something else than most of them.

    Parameters
    ----------
    light : ndarray, (shots, channels, cells)
        Mean counts of the cells above dark, as of `drift.cell_means`.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> light = rng.normal(1000, 1, (5, 1, 64)) * np.array([1, 1.01, 1.02, 1.01, 1])[:, None, None]
    >>> light[3, 0, :9] *= 0.4
    >>> find_differing_shots(light)
    DifferingShots(left_out=(3,), apart=0.0)
    >>> round(find_differing_shots(light[2:4]).apart, 2)
    0.43
    """
    count = len(light)
    if count < 2:
        return DifferingShots()
    away = np.array([_away(light[:, k]) for k in range(light.shape[1])])
    off, local = away[..., 0].any(0), away[..., 1].max(0)
    differing = off | (local > 0)
    if not differing.any():
        return DifferingShots()
    if 2 * np.count_nonzero(differing) < count:
        return DifferingShots(tuple(np.flatnonzero(differing).tolist()))
    if off.any() and 2 * np.count_nonzero(off) < count:  # the rest is judged without them
        kept = np.flatnonzero(~off)
        rest = find_differing_shots(light[kept])
        out = {*np.flatnonzero(off).tolist(), *kept[list(rest.left_out)].tolist()}
        return DifferingShots(tuple(sorted(out)), rest.apart)
    return DifferingShots((), float(local.max()))


def require_agreement(shots: ShotLevels | None) -> None:
    """Refuse the shots of a white that contradict each other; raises CalibrationRefused, ``E_WHITE_SHOTS``."""
    if shots is None or shots.apart <= CONTRADICTED:
        return
    raise CalibrationRefused(
        Problem(
            "E_WHITE_SHOTS",
            "the shots of the white contradict each other",
            found=f"parts of {len(shots.levels)} shots that differ by up to {100 * shots.apart:.0f} % from the middle of "
            "them, and no majority that agrees",
            expected="the same board in every shot",
            fix="Remove the shots in which something stood before the board, or it had moved; capture three whites or more.",
        )
    )


def _away(cells: np.ndarray) -> np.ndarray:
    """Return whether a shot has another light than the others, and by how much a part of it differs, (shots, 2)."""
    found = np.zeros((len(cells), 2))
    cells = cells[:, np.isfinite(cells).all(0)]
    middle = np.median(cells, axis=0)
    bright = middle > DIM * np.quantile(middle, 0.98) if middle.size else np.zeros(0, bool)
    if not bright.any() or np.quantile(middle, 0.98) <= 0:
        return found
    middle = middle[bright]
    ratio = cells[:, bright] / middle
    level = np.median(ratio, axis=1)
    level /= np.median(level)
    ratio /= np.maximum(level, STEADY[0])[:, None]
    apart = np.abs(ratio - np.median(ratio, axis=0))
    noise = 1.4826 * float(np.median(apart)) * np.maximum(np.median(middle) / middle, 1)
    off = (level < STEADY[0]) | (level > STEADY[1])
    found[:, 0] = off & (np.abs(level - 1) > SIGMAS * np.median(noise))
    found[:, 1] = np.where(apart > np.maximum(LOCAL, SIGMAS * noise), apart, 0).max(1)
    return found
