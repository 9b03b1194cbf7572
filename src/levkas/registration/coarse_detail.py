"""Coarse detail: does it lie where the map, which follows fine detail, puts it?

Relief and gold shift with the light that falls on them: flanks are bright on one side under one lamp and on the
other under another. That is fine detail, and windows follow it; patches of colour, many px across, stay. Windows two octaves coarser
are measured through the final map, and the mean of their shifts, weighted by their information, is compared with what is known of it:

    χ² = dᵀ (C + σ² 1)⁻¹ d,

where C is the covariance of the mean by the scatter of blocks of windows, and σ the sigma of the map.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.uncertainty import with_lines
from levkas.registration.window_fusion import has_information

if TYPE_CHECKING:
    from levkas.registration.local_shifts import WindowShifts
    from levkas.registration.record import Sigma

#: Side of a px of the coarse grid over one of the fine grid: two octaves, so that high-passed pictures share hardly any detail.
COARSER = 4
#: Side of a block, windows, and the least number of blocks of which a scatter is known.
BLOCK, LEAST_BLOCKS = 3, 8
#: Variance of the mean of blocks whose windows reach a cell into the next ones, over that of independent blocks.
OVERLAP = 1.5
#: √χ² from which on detail lies apart: of 50 real and simulated pairs without relief it is 4.6 at most, of a relief that moves fine detail by 0.07 px it is 9.
DEVIATIONS = 6.5
#: Px of the fine grid from which on it is reported.
LEAST_PX = 0.02
#: Sigma of each axis over the shift of coarse detail, in which relief is also, only less: on simulated relief errors are 1.5 to 1.8 times
#: that shift, 1.1 to 1.25 times on each axis.
HELD = 1.2


@dataclass(frozen=True)
class CoarseShift:
    """Mean shift of one band's coarse detail against the map: `px`, its length, reference px; `deviations`, √χ²."""

    px: float
    deviations: float


def mean_shift(windows: WindowShifts, sigma: float) -> CoarseShift | None:
    """Return the mean shift of windows that were measured through a map known to `sigma`, reference px; None of too few.

    Examples
    --------
    >>> from levkas.registration.local_shifts import WindowShifts
    >>> places = np.stack(np.meshgrid(np.arange(12.0), np.arange(9.0)), -1).reshape(-1, 2)
    >>> shift, known = np.tile([0.03, 0.04], (108, 1)), np.tile(np.eye(2), (108, 1, 1))
    >>> found = mean_shift(WindowShifts(places, shift, known, np.ones(108), np.eye(1)), 0.01)
    >>> round(found.px, 3), round(found.deviations, 3)
    (0.05, 5.0)
    """
    used = has_information(windows.information)
    block = _blocks(windows.centres[used])
    count = int(block.max(initial=-1)) + 1
    if count < LEAST_BLOCKS:
        return None
    information = windows.information[used]
    totals, moments = np.zeros((count, 2, 2)), np.zeros((count, 2))
    np.add.at(totals, block, information)
    np.add.at(moments, block, np.einsum("nab,nb->na", information, windows.shift[used]))
    inverse = np.linalg.inv(totals.sum(0))
    mean = inverse @ moments.sum(0)
    strays = (moments - totals @ mean) @ inverse
    covariance = OVERLAP * count / (count - 1) * strays.T @ strays + sigma**2 * np.eye(2)
    return CoarseShift(
        float(np.hypot(*mean)), float(np.sqrt(mean @ np.linalg.solve(covariance, mean)))
    )


def _blocks(centres: np.ndarray) -> np.ndarray:
    """Return the number of the block in which each window lies, (n,)."""
    places = [
        np.unique(centres[:, axis], return_inverse=True)[1].ravel() // BLOCK for axis in (0, 1)
    ]
    return np.unique(np.stack(places, 1), axis=0, return_inverse=True)[1].ravel()


def describe_coarse_detail(
    found: Mapping[str, CoarseShift], labels: Sequence[str], step: int
) -> dict[str, Any] | None:
    """Return the bands whose coarse detail lies apart, and by how much, JSON-ready; None where no band's does.

    Parameters
    ----------
    found : mapping of label to CoarseShift
        Of measured bands.
    labels : sequence of str
        All bands: one that was not measured has the sigma of the next one that was.
    step : int
        Reference px per px of the fine grid.

    Examples
    --------
    >>> shifts = {"550 nm": CoarseShift(0.05, 8.0), "950 nm": CoarseShift(0.08, 2.0)}
    >>> describe_coarse_detail(shifts, ["550 nm", "560 nm", "950 nm"], 1)
    {'bands': ['550 nm'], 'px': 0.05, 'sigma_px': {'550 nm': 0.06, '560 nm': 0.06}}
    """
    off = {
        label: one.px
        for label, one in found.items()
        if one.deviations > DEVIATIONS and one.px > LEAST_PX * step
    }
    if not off:
        return None
    places = {labels.index(label): label for label in found}
    nearest = [places[min(places, key=lambda at: abs(at - i))] for i in range(len(labels))]
    held = {
        label: round(HELD * off[near], 4)
        for label, near in zip(labels, nearest, strict=True)
        if near in off
    }
    px = round(float(np.median(list(off.values()))), 4)
    return {"bands": list(off), "px": px, "sigma_px": held}


def hold_coarse_detail(
    known: Mapping[str, Sigma], described: Mapping[str, Any] | None
) -> dict[str, Sigma]:
    """Return sigmas that hold by how much coarse detail lies apart, as `describe_coarse_detail` has it."""
    added = described["sigma_px"] if described else {}
    return {
        label: with_lines({label: one}, added[label])[label] if label in added else one
        for label, one in known.items()
    }
