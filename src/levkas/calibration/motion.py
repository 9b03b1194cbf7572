"""Motion detection: pixels whose spread over shots, or over exposures, exceeds the noise (chi-squared test).

A pixel's sample variance over its expected one is summed over it and its eight neighbours of the same
channel; in still places nine times (shots − 1) of it follows chi-squared.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from levkas.calibration.noise_fit import NoiseModel
from levkas.calibration.templates import Template, as_marks, as_rows, read_only
from levkas.core.compiled import njit
from levkas.core.threads import in_threads

BY_CHANCE = 1e-10  # of one pixel: a false one in a thousand frames of 10 megapixels
BESIDE = 1e-3  # of one pixel beside others that moved
NONLINEAR = 0.01  # of the signal, from exposure to exposure: `linearity` allows as much
MISFIT = 1.5  # of the variance: what a fitted noise model may be off by


def find_moved(
    stack: Template,
    noise: NoiseModel,
    dark: np.ndarray | float = 0.0,
    *,
    period: tuple[int, int] = (1, 1),
) -> np.ndarray:
    """Find pixels that did not stand still.

    Parameters
    ----------
    stack : Template, (h, w) or (h, w, b)
        Of two shots or more.
    noise : NoiseModel
        Of one shot.
    dark : ndarray that broadcasts to the stack, or float
        Counts without light.
    period : (rows, columns)
        Of a mosaic: neighbours are those of the same phase.

    Returns
    -------
    moved : ndarray of bool, shape of the stack
        Nowhere for a single shot. The whole neighbourhood of a movement is marked.

    Notes
    -----
    A lamp that flickers by f adds (f·signal)², which noise fitted to the same stack holds already;
    saturated pixels are passed over, for they stand still whatever happens.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> frames = [np.float32(rng.normal(1000, 10, (40, 40))) for _ in range(3)]
    >>> frames[1][20:25, 20:25] += 200
    >>> from levkas.calibration.templates import average
    >>> moved = find_moved(average(frames), NoiseModel(0.1, 0.1))
    >>> bool(moved[20:25, 20:25].all()), int(moved.sum()) <= 49
    (True, True)
    """
    shape = stack.mean.shape
    if stack.variance is None or stack.count < 2:
        return np.zeros(shape, bool)
    level = np.atleast_2d(np.asarray(dark, np.float32))
    if level.size > 1:
        level = np.broadcast_to(level, (level.shape[0], *shape[1:]))
    depth = shape[2] if len(shape) == 3 else 1
    rows, columns = period[0], period[1] * depth
    planes = as_rows(stack.mean), as_rows(stack.variance), as_marks(stack.saturated), as_rows(level)
    model = noise.gain, noise.read_variance, _limit(stack.count - 1)
    mean, spread, full, level = map(read_only, planes)
    numbers = tuple(map(np.float32, model))
    ratio, marked = np.empty(mean.shape, np.float32), np.empty(mean.shape, bool)
    in_threads(_compare, len(mean), mean, spread, full, level, numbers, ratio)
    in_threads(_mark, len(mean), ratio, (rows, columns), numbers[2], marked)
    return marked.reshape(shape)


def find_moved_between(
    shots: Sequence[Template],
    levels: Sequence[np.ndarray],
    rate: np.ndarray,
    noise: NoiseModel,
    *,
    reads: Sequence[float] | None = None,
    left_out: Sequence[np.ndarray] | None = None,
    period: tuple[int, int] = (1, 1),
) -> np.ndarray:
    """Find pixels that did not stand still from one exposure of a scene to the next.

    Parameters
    ----------
    shots : sequence of Template, (h, w) or (h, w, b)
        Of different exposures, whose `exposure_s` are known.
    levels : sequence of ndarray that broadcast to the shots
        Counts without light of each.
    rate : ndarray like a shot
        What they were merged to, counts a second.
    noise : NoiseModel
        Of one shot.
    reads : sequence of float, optional
        Variance without light of each exposure, counts²; the noise model's by default.
    left_out : sequence of ndarray of bool, optional
        What takes no part in each shot, saturated and black values besides.
    period : (rows, columns)
        Of a mosaic: neighbours are those of the same phase.

    Returns
    -------
    moved : ndarray of bool, shape of a shot
        Nowhere where fewer than two exposures are usable.

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
    shape = shots[0].mean.shape
    total, used = np.zeros(shape, np.float32), np.zeros(shape, np.uint8)
    bad = [s.saturated | s.black for s in shots]
    bad = bad if left_out is None else [b | m for b, m in zip(bad, left_out, strict=True)]
    reads = reads or [noise.read_variance] * len(shots)
    for shot, level, read, lost in zip(shots, levels, reads, bad, strict=True):
        expected = np.maximum(rate, 0) * np.float32(shot.exposure_s or 0.0)
        spread = (read + noise.gain * expected) / shot.count + (NONLINEAR * expected) ** 2
        total += np.where(lost, 0, (shot.mean - level - expected) ** 2 / spread)
        used += ~lost
    total[used < 2] = 0
    return _disagree(total, len(shots) - 1, period)  # where fewer took part the limit is safe


def _disagree(total: np.ndarray, freedom: int, period: tuple[int, int]) -> np.ndarray:
    """Return where sums of squared deviations over noise do not come by chance, bool like `total`.

    One sensel may make up half of what a neighbourhood deviates by: one that blinks or is hot marks itself alone.
    Beside what is marked, less marks a pixel: the edge of a movement.
    """
    rows, columns = period

    def around(values: np.ndarray) -> Iterator[np.ndarray]:
        padded = np.pad(values, [(rows, rows), (columns, columns), (0, 0)][: values.ndim])
        height, width = values.shape[:2]
        for y in (0, rows, 2 * rows):
            for x in (0, columns, 2 * columns):
                yield padded[y : y + height, x : x + width]

    summed, most = np.zeros_like(total), np.zeros_like(total)
    for part in around(total):
        summed += part
        np.maximum(most, part, out=most)
    limit = freedom * _limit(freedom)
    marked = (summed > limit) & (summed - most > limit / 2)
    marked |= total > freedom * _limit(freedom, 1)
    beside = np.zeros_like(marked)
    for part in around(marked):
        beside |= part
    return marked | (beside & (total > freedom * _limit(freedom, 1, BESIDE)))


def _limit(freedom: int, pixels: int = 9, chance: float = BY_CHANCE) -> float:
    """Return the sum of the variance ratios of some pixels that is not exceeded by chance."""
    from scipy.special import gammainccinv

    return MISFIT * 2 * float(gammainccinv(pixels * freedom / 2, chance)) / freedom


@njit(cache=True)
def _compare(start, stop, mean, variance, saturated, dark, model, ratio):  # type: ignore[no-untyped-def]
    """Fill the variance over what noise explains, 0 where saturated.

    `model` is (gain, variance without light, limit), float32.
    """
    gain, read, _ = model
    for y in range(start, stop):
        dy, dx = y % dark.shape[0], dark.shape[1] > 1
        for x in range(mean.shape[1]):
            light = max(mean[y, x] - dark[dy, x * dx], np.float32(0.0))
            still = np.float32(1 - saturated[y, x])
            ratio[y, x] = still * variance[y, x] / (read + gain * light)


@njit(cache=True)
def _mark(start, stop, ratio, period, limit, marked):  # type: ignore[no-untyped-def]
    """Fill where a pixel and its neighbours, those beyond the border left out, pass the limit."""
    rows, columns = period
    height, width = ratio.shape
    column = np.empty(width + 2 * columns, np.float32)
    for y in range(start, stop):
        column[:] = np.float32(0.0)
        for v in range(max(y - rows, y % rows), min(y + rows + 1, height), rows):
            for x in range(width):
                column[x + columns] += ratio[v, x]
        for x in range(width):
            total = column[x] + column[x + columns] + column[x + 2 * columns]
            marked[y, x] = total > limit
