"""Whether windows that were free to be found elsewhere bear out a dense map.

Dense refinement looks at most a pixel or two around where a map already is: it would say little of
a map that is wholly wrong. Here windows of the picture that the reference predicts for a band are
looked for 12 px around, against how well windows are found that cannot match.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import Affine
from levkas.registration.agreement import LONG_SIDE_PX, WINDOW_PX, Agreement, compare
from levkas.registration.checks import Checks
from levkas.registration.evidence import (
    Evidence,
    measure_shape,
    measure_support,
    measure_windows,
)
from levkas.registration.record import Matches

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform

BLOCK_PX = 80
RIDGE = 1e-3
LEAST_STRANGE = 6
#: Of the detail of a window of the middle: fainter ones are counted as if they had so much.
FAINT = 0.05


def corroborate(
    predictors: np.ndarray,
    image: np.ndarray,
    step: int,
    transform: Transform,
    within: np.ndarray,
    valid: np.ndarray,
    predicted_at: np.ndarray | None = None,
    cell: float = 0.0,
) -> tuple[dict[str, Any], Checks]:
    """Measure what the verdict on a dense map rests on.

    Parameters
    ----------
    predictors : ndarray, (k, h, w), float32
        Images of the reference on a grid of `step` reference px, slow parts taken out; NaN where
        invalid.
    image : ndarray, (h, w), float32
        The band on the same grid, seen through `transform`, its slow part taken out too.
    step : int, reference px
    transform : Transform
        Reference px → native px of the band.
    within : ndarray of bool, reference px
        Where the object lies.
    valid : ndarray of bool, native px
    predicted_at : ndarray, (n, 2), reference px, optional
        Windows of the dense refinement that are predicted beyond chance, `cell` px apart.
    cell : float, reference px

    Returns
    -------
    numbers : dict
        As `measure_shape`, `measure_windows` and `measure_support` of `evidence` name them,
        ``tolerance``, reference px, and ``strange``, of `measure_strange`.
    checks : Checks
        The windows themselves.
    """
    predicted = predict(predictors, image)
    both = [(np.nan_to_num(a), np.isfinite(a)) for a in (predicted, image)]
    compared = compare(both[0], both[1], Affine.identity())
    agreement = _enlarged(compared, step)
    rows, columns = (np.flatnonzero(within.any(axis)) for axis in (1, 0))
    box = (columns[0], rows[0], np.ptp(columns) + 1, np.ptp(rows) + 1) if len(rows) else None
    evidence = Evidence(
        transform=transform,
        # A cell is borne out by what is seen there, not by one key point that agrees.
        matches=Matches.of(np.empty((0, 2)), np.empty((0, 2))),
        # Only where the pictures are valid is asked of them.
        reference=(within, within),
        target=(valid, valid),
        region=None if box is None else tuple(float(v) for v in box),
    )
    tolerance = max(1.0, agreement.step)
    checks = Checks(
        agreement.centres, agreement.shift, agreement.found, tolerance,
        WINDOW_PX * agreement.step, predicted_at, cell, evidence.region,
    )  # fmt: skip
    numbers = {
        "tolerance": tolerance,
        **measure_shape(evidence),
        **measure_windows(checks),
        "rival": float(agreement.rival),
        **measure_support(evidence, checks),
        "strange": measure_strange(predicted, image, compared),
    }
    share = float(within[_rows(box), _columns(box)].mean()) if box else 1.0
    numbers["overlap"] = min(1.0, numbers["overlap"] / max(share, 1e-9))
    return numbers, checks


def predict(predictors: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Return the combination of the predictors that is nearest to `image`, block by block, (h, w).

    Gains of blocks of 80 px: what they could feign in a window of 40 px is little beside chance.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> images = rng.normal(size=(2, 90, 90)).astype(np.float32)
    >>> made = predict(images, 2 * images[0] - images[1])
    >>> bool(np.abs(made - (2 * images[0] - images[1])).max() < 0.02)
    True
    """
    count, height, width = predictors.shape
    out = np.full((height, width), np.nan, np.float32)
    rows = np.linspace(0, height, max(1, round(height / BLOCK_PX)) + 1).astype(int)
    columns = np.linspace(0, width, max(1, round(width / BLOCK_PX)) + 1).astype(int)
    for top, bottom in pairwise(rows):
        for left, right in pairwise(columns):
            part = predictors[:, top:bottom, left:right].reshape(count, -1).astype(np.float64)
            goal = image[top:bottom, left:right].reshape(-1).astype(np.float64)
            known = np.isfinite(part).all(0)
            used = known & np.isfinite(goal)
            if used.sum() < 8 * count:
                continue
            gram = part[:, used] @ part[:, used].T
            gram += RIDGE * np.trace(gram) / count * np.eye(count) + 1e-30 * np.eye(count)
            gains = np.linalg.solve(gram, part[:, used] @ goal[used])
            block = np.full(goal.shape, np.nan, np.float32)
            block[known] = gains @ part[:, known]
            out[top:bottom, left:right] = block.reshape(bottom - top, right - left)
    return out


def measure_strange(predicted: np.ndarray, image: np.ndarray, agreement: Agreement) -> float | None:
    """Return the share of a picture's detail that its prediction lacks, the median over recognised windows.

    Two views of one painting differ by noise, of which neighbouring pixels have little in common; of
    brush strokes, craquelure and pattern they have much. Of what is left when the prediction is taken away only
    what neighbours have in common is counted, as a share of what they have in common in the picture.
    A copy by the same pattern has the same outlines, so that windows are recognised, and strokes of its own.

    Parameters
    ----------
    predicted, image : ndarray, (h, w)
        NaN where invalid; slow parts taken out.
    agreement : Agreement
        Of the two, in their own px.

    Returns
    -------
    strange : float or None
        0 where all detail is predicted, 1 where none is; None where fewer than `LEAST_STRANGE` windows
        are recognised.
    """
    known = np.isfinite(predicted) & np.isfinite(image)
    detail, left = (np.where(known, part, np.nan) for part in (image, image - predicted))
    places = np.rint(agreement.centres[agreement.found] - (WINDOW_PX - 1) / 2).astype(int)
    if len(places) < LEAST_STRANGE:
        return None
    of, rest = (np.array([_common(part, *place) for place in places]) for part in (detail, left))
    return float(np.median(rest / np.maximum(of, FAINT * max(float(np.median(of)), 1e-30))))


def _common(image: np.ndarray, x: int, y: int) -> float:
    """Return the mean product of neighbours, along either axis, in the window at (x, y)."""
    window = image[y : y + WINDOW_PX, x : x + WINDOW_PX]
    window = window - np.nanmean(window)
    along, down = window[:, 1:] * window[:, :-1], window[1:] * window[:-1]
    return float((np.nanmean(along) + np.nanmean(down)) / 2)


def reduction(shape: tuple[int, int], step: int) -> int:
    """Return by how much more a frame that is compared at `step` can be reduced: 1, 2, 4 …"""
    more = 1
    while max(shape) / (step * more) > 1.25 * LONG_SIDE_PX:
        more *= 2
    return more


def _enlarged(agreement: Agreement, step: int) -> Agreement:
    """Turn px of a grid of `step` reference px into reference px."""
    return replace(
        agreement,
        centres=(agreement.centres + 0.5) * step - 0.5,
        shift=agreement.shift * step,
        reach=agreement.reach * step,
        step=agreement.step * step,
    )


def _rows(box: tuple[Any, ...]) -> slice:
    return slice(int(box[1]), int(box[1] + box[3]))


def _columns(box: tuple[Any, ...]) -> slice:
    return slice(int(box[0]), int(box[0] + box[2]))
