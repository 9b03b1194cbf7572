"""Motion detection: pixels whose spread over shots, or over exposures, exceeds the noise (chi-squared test).

A pixel's sample variance over its expected one is summed over it and its eight neighbours of the same channel; in still places
nine times (shots − 1) of it follows chi-squared.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from levkas.calibration.noise_fit import NoiseModel
from levkas.calibration.templates import Template

BY_CHANCE, BESIDE = 1e-10, 1e-3
"""Of one pixel: a false one in a thousand frames of 10 megapixels; and beside others that moved, the edge of a movement."""
NONLINEAR = 0.01
"""Of the signal, from exposure to exposure: `linearity` allows as much."""
MISFIT = 1.5
"""Of the variance: what a fitted noise model may be off by; 1.2 or 2 move the least movement that is found by a tenth."""
Period = tuple[int, int]


def find_moved(
    stack: Template,
    noise: NoiseModel,
    dark: np.ndarray | float = 0.0,
    *,
    period: Period = (1, 1),
) -> np.ndarray:
    """Find pixels that did not stand still over the shots of a stack, bool like it; nowhere for a single shot.

    The whole neighbourhood of a movement is marked, of a mosaic of `period` (rows, columns) that of one phase. A lamp that
    flickers by f adds (f·signal)², which noise fitted to the same stack holds already; saturated pixels are passed over, for
    they stand still whatever happens. `dark` are counts without light.

    >>> rng = np.random.default_rng(1)
    >>> frames = [np.float32(rng.normal(1000, 10, (40, 40))) for _ in range(3)]
    >>> frames[1][20:25, 20:25] += 200
    >>> from levkas.calibration.templates import average
    >>> moved = find_moved(average(frames), NoiseModel(0.1, 0.1))
    >>> bool(moved[20:25, 20:25].all()), int(moved.sum()) <= 49
    (True, True)
    """
    if stack.variance is None or stack.count < 2:
        return np.zeros(stack.mean.shape, bool)
    light = np.maximum(stack.mean - np.asarray(dark, np.float32), 0)
    ratio = stack.variance / (np.float32(noise.read_variance) + np.float32(noise.gain) * light)
    ratio[stack.saturated | ~np.isfinite(ratio)] = 0
    return _around(_sum, ratio, period) > _limit(stack.count - 1)


def find_moved_between(
    shots: Sequence[Template],
    levels: Sequence[np.ndarray],
    rate: np.ndarray,
    noise: NoiseModel,
    *,
    reads: Sequence[float] | None = None,
    left_out: Sequence[np.ndarray] | None = None,
    period: Period = (1, 1),
) -> np.ndarray:
    """Find pixels that did not stand still from one exposure of a scene to the next, bool like a shot.

    One sensel may make up half of what a neighbourhood deviates by: one that blinks or is hot marks itself alone.

    Parameters
    ----------
    shots : sequence of Template, (h, w) or (h, w, b)
        Of different exposures, whose `exposure_s` are known.
    levels : sequence of ndarray that broadcast to the shots
        Counts without light of each.
    rate : ndarray like a shot
        What they were merged to, counts a second.
    reads : sequence of float, optional
        Variance without light of each exposure, counts²; the noise model's by default.
    left_out : sequence of ndarray of bool, optional
        What takes no part in each shot, saturated and black values besides. Where fewer than two are left nothing is marked.

    Examples
    --------
    >>> from levkas.calibration.templates import average
    >>> rng = np.random.default_rng(1)
    >>> takes = [rng.normal(1000 * t, (100 * t + 4) ** 0.5, (40, 40)).astype("f4") for t in (1, 2)]
    >>> takes[1][20:25, 20:25] *= 0.5
    >>> shots = [average([f], exposure_s=t) for f, t in zip(takes, (1.0, 2.0))]
    >>> level, rate = np.zeros((1, 1), "f4"), np.full((40, 40), 1000, "f4")
    >>> moved = find_moved_between(shots, [level, level], rate, NoiseModel(0.1, 4.0))
    >>> bool(moved[20:25, 20:25].all()), int(moved.sum()) <= 49
    (True, True)
    """
    total, used = np.zeros(rate.shape, np.float32), np.zeros(rate.shape, np.uint8)
    for i, (shot, level) in enumerate(zip(shots, levels, strict=True)):
        lost = shot.saturated | shot.black
        if left_out is not None:
            lost = lost | left_out[i]
        expected = np.maximum(rate, 0) * np.float32(shot.exposure_s or 0.0)
        read = reads[i] if reads else noise.read_variance
        spread = (read + noise.gain * expected) / shot.count + (NONLINEAR * expected) ** 2
        total += np.where(lost, 0, (shot.mean - level - expected) ** 2 / spread)
        used += ~lost
    total[(used < 2) | ~np.isfinite(total)] = 0
    freedom = len(shots) - 1  # where fewer took part the limit is safe
    summed, most = (_around(work, total, period) for work in (_sum, _largest))
    limit = freedom * _limit(freedom)
    marked = (summed > limit) & (summed - most > limit / 2)
    marked |= total > freedom * _limit(freedom, 1)
    beside = _around(_largest, marked.astype(np.uint8), period) > 0
    return marked | (beside & (total > freedom * _limit(freedom, 1, BESIDE)))


def _around(
    work: Callable[[np.ndarray], np.ndarray], plane: np.ndarray, period: Period
) -> np.ndarray:
    """Return a statistic of 3x3 neighbours of the same phase and band of a plane, like it."""
    found = np.empty_like(plane)
    for y, x in np.ndindex(period):
        phase = np.s_[y :: period[0], x :: period[1]]
        part = np.ascontiguousarray(plane[phase])
        found[phase] = work(part).reshape(part.shape)
    return found


def _sum(part: np.ndarray) -> np.ndarray:
    return cv2.boxFilter(part, -1, (3, 3), normalize=False, borderType=cv2.BORDER_CONSTANT)


def _largest(part: np.ndarray) -> np.ndarray:
    return cv2.dilate(
        part, np.ones((3, 3), np.uint8), borderType=cv2.BORDER_CONSTANT, borderValue=0
    )


def _limit(freedom: int, pixels: int = 9, chance: float = BY_CHANCE) -> float:
    """Return the sum of the variance ratios of some pixels that is not exceeded by chance."""
    from scipy.special import gammainccinv

    return MISFIT * 2 * float(gammainccinv(pixels * freedom / 2, chance)) / freedom
