"""Darks of a sensor over exposures: level, dark current, fixed pattern; also where the camera clipped them at 0.

With the true black at 0, the mean of a clipped dark is 0.399 σ and its spread 0.584 σ: subtracting it
biases every lit pixel.  A code k means (k − ½, k + ½), the code 0 for everything below ½; black,
noise in time and spread between sensels are those that make pairs of shots likeliest, a sensel's own
offset being integrated out.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.calibration.darks import SAME_TIME
from levkas.calibration.templates import CalibrationRefused
from levkas.core.problems import Problem
from levkas.quality.emva1288.blocks import Blocks

MANY_ZEROS = 0.02
NARROW = 0.3  # counts: a smaller spread is hidden by rounding
BINS = 160
NODES = 17  # of Gauss and Hermite
FEWEST = 30  # pixels at codes 2 to 4, without which spread and black cannot be separated


@dataclass(frozen=True)
class DarkLevel:
    """Black and noise of a dark, counts.

    Parameters
    ----------
    black : float
        Mean before clipping; may be negative.
    noise : float
        Standard deviation over time, rounding not included.
    fixed : float
        Standard deviation from sensel to sensel; NaN from a single shot, whose `noise` holds both.
    black_error, noise_error, fixed_error : float
        One standard error of each.
    zeros : float
        Share of pixels at 0.
    """

    black: float
    noise: float
    fixed: float
    black_error: float
    noise_error: float
    fixed_error: float
    zeros: float


def is_clipped(frame: np.ndarray) -> bool:
    """Whether a dark frame was clipped at zero, so that its mean is not black.

    Zeros in more than 2 % of the pixels, or a spread below 0.3 counts about 0.

    >>> is_clipped(np.array([[0, 0, 1, 2]])), is_clipped(np.full((2, 2), 64))
    (True, False)
    """
    if frame.min() > 0:
        return False
    return bool(np.mean(frame == 0) > MANY_ZEROS or frame.std() < NARROW)


def fit_clipped_dark(frames: Sequence[np.ndarray]) -> DarkLevel:
    """Fit black, noise and spread of darks that were clipped at zero.

    Parameters
    ----------
    frames : sequence of ndarray, one shape, whole codes
        Shots of one exposure and one channel. Two or more separate noise from fixed pattern; they are
        taken in pairs.

    Returns
    -------
    level : DarkLevel

    Raises
    ------
    CalibrationRefused
        E_DARK_CLIPPED where so few codes are above zero that black and noise cannot be separated.

    Notes
    -----
    Normal in time and from sensel to sensel; hot sensels are a share of outliers, spread evenly,
    that is fitted too. Errors are from the curvature of the likelihood. From 300,000 pixels black
    and noise come within 1 % of σ while a tenth of the pixels is above zero.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> shots = [np.rint(rng.normal(0.5, 2.0, (300, 300))).clip(0) for _ in range(2)]
    >>> level = fit_clipped_dark(shots)
    >>> abs(level.black - 0.5) < 0.05, abs(level.noise - 2.0) < 0.05
    (True, True)
    """
    from scipy.optimize import minimize

    first = frames[0]
    pairs = [(a, b) for a, b in zip(frames[::2], frames[1::2], strict=False)] or [(first, first)]
    edges, table = _table(pairs, alone=len(frames) == 1)
    zeros = float(np.mean([np.mean(frame == 0) for frame in frames]))
    _check_informative(frames, zeros)
    start = _first_guess(np.concatenate([np.ravel(frame) for frame in frames]))
    free = np.array([True, True, len(frames) > 1, True])

    def loss(part: np.ndarray) -> float:
        full = start.copy()
        full[free] = part
        if not free[2]:
            full[2] = -20.0
        return _loss(full, edges, table, alone=len(frames) == 1)

    options = {"xatol": 1e-4, "fatol": 5e-3, "maxiter": 4000, "maxfev": 4000}
    made = minimize(loss, start[free], method="Nelder-Mead", options=options)
    made = minimize(loss, made.x, method="Nelder-Mead", options=options)
    errors = _errors(loss, made.x)
    found, error = np.full(4, np.nan), np.full(4, np.nan)
    found[free], error[free] = made.x, errors
    noise, fixed = np.exp(found[1]), np.exp(found[2])
    numbers = found[0], noise, fixed, error[0], noise * error[1], fixed * error[2], zeros
    return DarkLevel(*(float(n) for n in numbers))


def _check_informative(frames: Sequence[np.ndarray], zeros: float) -> None:
    # Hot sensels stand anywhere: a few counts above zero there must be more than those.
    beyond = max(int(np.count_nonzero((f >= 2) & (f <= 4))) for f in frames)
    beyond = max(beyond, *(int(np.count_nonzero(f > 4)) if np.median(f) > 2 else 0 for f in frames))
    if beyond >= FEWEST:
        return
    raise CalibrationRefused(
        Problem(
            "E_DARK_CLIPPED",
            "the darks are clipped too strongly to measure the black level",
            found=f"{zeros:.1%} zeros, {beyond} pixels at 2 to 4 counts",
            expected=f"{FEWEST} or more",
            fix="Raise the camera's black level (offset) by some counts, or capture an exposure series "
            "of a lit scene: black is fitted from it.",
        )
    )


def _first_guess(codes: np.ndarray) -> np.ndarray:
    """Return parameters from how much lies above two codes."""
    from scipy.special import ndtri

    above = 1 - np.cumsum(np.bincount(codes.astype(np.int64))[:4000]) / len(codes)
    low = int(np.argmax(above < 0.7))
    high = max(low + 1, int(np.argmax(above <= above[low] / 8)))
    z = -ndtri(np.clip([above[low], above[min(high, len(above) - 1)]], 1e-6, 1 - 1e-6))
    noise = (high - low) / max(z[1] - z[0], 0.05)
    black = low + 0.5 - z[0] * noise
    return np.array([black, np.log(noise), np.log(noise / 4), -7.0])


def _table(
    pairs: list[tuple[np.ndarray, np.ndarray]], *, alone: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return the upper edges of bins of codes, and how often pairs of bins occur."""
    sample = np.concatenate([pair[0].ravel() for pair in pairs])
    # Twice the 99th percentile lies beyond 4 sigma of what is no hot sensel, even for half a normal.
    top = int(max(2 * np.quantile(sample, 0.99), 6))
    width = -(-(top + 1) // BINS)
    bins = top // width + 1
    table = np.zeros((bins, bins))
    for a, b in pairs:
        i, j = (np.asarray(p).ravel().astype(np.int64) // width for p in (a, b))
        inside = (i < bins) & (j < bins)
        table += np.bincount(i[inside] * bins + j[inside], minlength=bins * bins).reshape(bins, -1)
    return (np.arange(bins) + 1) * width - 0.5, table.diagonal().copy() if alone else table


def _loss(numbers: np.ndarray, edges: np.ndarray, table: np.ndarray, *, alone: bool) -> float:
    """Return minus the logarithm of the likelihood."""
    from scipy.special import ndtr

    black, noise, fixed, outliers = numbers
    nodes, weights = np.polynomial.hermite_e.hermegauss(NODES)
    centre = black + np.exp(fixed) * nodes[:, None]
    below = ndtr((edges - centre) / np.exp(noise))
    share = np.diff(below, axis=1, prepend=0.0)
    weights = weights / weights.sum()
    likely = weights @ share if alone else (share * weights[:, None]).T @ share
    odd = 1 / (1 + np.exp(-np.clip(outliers, -40, 40)))
    return -float(np.sum(table * np.log((1 - odd) * likely + odd / table.size + 1e-300)))


def _errors(loss: object, best: np.ndarray) -> np.ndarray:
    """Return standard errors from the curvature of the loss."""
    count, step = len(best), 2e-3
    curvature = np.empty((count, count))
    moves = np.eye(count) * step
    for i in range(count):
        for j in range(count):
            corners = [
                loss(best + a * moves[i] + b * moves[j])  # type: ignore[operator]
                for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1))
            ]
            curvature[i, j] = (corners[0] - corners[1] - corners[2] + corners[3]) / (4 * step**2)
    # A parameter on which nothing depends (no outliers, no fixed pattern) has no curvature.
    return np.sqrt(np.maximum(np.diag(np.linalg.pinv(curvature, rcond=1e-9)), 0.0))


@dataclass(frozen=True)
class Dark:
    """Counts without light at one exposure.

    Parameters
    ----------
    level, temporal, fixed : ndarray, (blocks,), or float
        Mean, variance of one shot with rounding, variance from sensel to sensel; NaN if not known.
    exposure_s : float, optional
    errors : tuple of float
        Standard errors of the three where they are no blocks.
    spread : ndarray, (blocks,), or float
        Of a single shot: variance from sensel to sensel, noise over time included.
    band : str, optional
        Of a tunable filter; None: it serves all.
    """

    level: np.ndarray | float
    temporal: np.ndarray | float
    fixed: np.ndarray | float
    exposure_s: float | None = None
    errors: tuple[float, float, float] = (0.0, 0.0, 0.0)
    spread: np.ndarray | float = float("nan")
    band: str | None = None

    @classmethod
    def of_blocks(cls, blocks: Blocks) -> Dark:
        """Return a dark that was not clipped, without the blocks that hold hot sensels."""
        sound = np.where(np.isfinite(blocks.spatial), 0.0, np.nan)
        fixed = blocks.spatial - blocks.temporal / blocks.shots
        spread = blocks.spatial if blocks.shots == 1 else float("nan")
        level, temporal = blocks.mean + sound, blocks.temporal + sound
        return cls(level, temporal, fixed, blocks.exposure_s, spread=spread, band=blocks.band)

    @classmethod
    def of_clipped(cls, level: DarkLevel, exposure_s: float | None = None) -> Dark:
        """Return a dark that was clipped and fitted as censored; of a single shot the noise over time stays open."""
        if np.isnan(level.fixed):
            spread = level.noise**2 + 1 / 12
            return cls(level.black, np.nan, np.nan, exposure_s, (level.black_error, 0, 0), spread)
        errors = (
            level.black_error,
            2 * level.noise * level.noise_error,
            2 * level.fixed * level.fixed_error,
        )
        return cls(level.black, level.noise**2 + 1 / 12, level.fixed**2, exposure_s, errors)


def model_darks(darks: Sequence[Dark]) -> DarkModel:
    """Return the level and fixed pattern without light over exposures, of all blocks alike."""
    return DarkModel([DrawnDark(dark, np.ones(np.size(dark.level)), np.zeros(3)) for dark in darks])


class DrawnDark:
    """One dark in one draw of the bootstrap: weighted means, and its level block by block."""

    def __init__(self, dark: Dark, weights: np.ndarray, shift: np.ndarray) -> None:
        parts = (dark.level, dark.temporal, dark.fixed)
        self.spread = _mean(dark.spread, weights)
        self.level, self.temporal, self.fixed = (
            _mean(part, weights) + error * move
            for part, error, move in zip(parts, dark.errors, shift, strict=True)
        )
        self.under = dark.level if isinstance(dark.level, np.ndarray) else self.level
        self.exposure_s = dark.exposure_s
        self.band = dark.band


def _mean(values: np.ndarray | float, weights: np.ndarray) -> float:
    if not isinstance(values, np.ndarray):
        return float(values)
    known = np.isfinite(values) & (weights > 0)
    return float(np.average(values[known], weights=weights[known])) if known.any() else np.nan


def dark_line(darks: Sequence[DrawnDark]) -> tuple[float, float]:
    """Return black at no time and counts a second; NaN a second where times do not differ by half."""
    times = np.array([d.exposure_s if d.exposure_s else np.nan for d in darks])
    level = np.array([d.level for d in darks])
    known = np.isfinite(times) & np.isfinite(level)
    if np.count_nonzero(known) < 2 or times[known].max() < 2 * times[known].min():
        return float(level[0]), float("nan")
    slope, start = np.polyfit(times[known], level[known], 1)
    return float(start), float(slope)


class DarkModel:
    """Dark level and fixed pattern under lit stacks: of their own band and exposure, else lines over exposures.

    Level = black + current·t, and the fixed pattern's variance = a + b·t², as current differs from sensel
    to sensel.

    Parameters
    ----------
    darks : sequence of DrawnDark

    Attributes
    ----------
    first : DrawnDark
        The shortest whose noise over time is known, else the shortest.
    black, current : float
        Counts at no time, counts a second; NaN a second where the exposures are too alike.
    """

    def __init__(self, darks: Sequence[DrawnDark]) -> None:
        self.darks = sorted(darks, key=lambda dark: dark.exposure_s or 0.0)
        noisy = (dark for dark in self.darks if np.isfinite(dark.temporal))
        self.first = next(noisy, self.darks[0])
        self.black, self.current = dark_line(self.darks)

    def own(self, band: str | None, exposure_s: float | None) -> DrawnDark | None:
        """Return the dark of an exposure: of the band, else one that serves all, else of another band."""
        alike = [d for d in self.darks if same_time(d.exposure_s, exposure_s)]
        order = {band: 0, None: 1}
        return min(alike, key=lambda d: order.get(d.band, 2)) if alike else None

    def lacks(self, stack: Blocks) -> bool:
        """Return whether a stack has no dark of its exposure, and none can be interpolated."""
        timed = stack.exposure_s and any(d.exposure_s for d in self.darks)
        known = self.own(stack.band, stack.exposure_s) is not None or np.isfinite(self.current)
        return bool(timed) and not known

    def under(self, band: str | None, exposure_s: float | None) -> np.ndarray | float:
        """Return the counts without light, block by block or as one."""
        own = self.own(band, exposure_s)
        if own is not None:
            return own.under
        near = self._nearest(self.darks, band, exposure_s)
        rest = ((exposure_s or 0.0) - (near.exposure_s or 0.0)) * self.current
        timed = exposure_s and near.exposure_s and np.isfinite(rest)
        return near.under + (rest if timed else 0.0)

    def signal(self, stack: Blocks) -> np.ndarray:
        """Return the counts above dark of a stack, block by block."""
        if stack.level is not None:
            return np.asarray(stack.mean - stack.level)
        return np.asarray(stack.mean - self.under(stack.band, stack.exposure_s))

    def dark_signal(self, stack: Blocks) -> np.ndarray | float:
        """Return the counts of dark current in a stack beyond those in `first`: they have shot noise as light has."""
        if stack.level is not None:
            return np.asarray(stack.level - self.first.level) if np.isfinite(self.current) else 0.0
        times = (stack.exposure_s, self.first.exposure_s)
        if not all(times) or same_time(*times):
            return 0.0
        return _mean_of(self.under(stack.band, stack.exposure_s)) - self.first.level

    def fixed(self, stack: Blocks) -> float:
        """Return the variance from sensel to sensel without light; 0 where no dark shows it."""
        known = [d for d in self.darks if np.isfinite(d.fixed)]
        if not known:
            return 0.0
        near = self._nearest(known, stack.band, stack.exposure_s)
        squares = [d.exposure_s**2 for d in known if d.exposure_s]
        alone = len(squares) < len(known) or max(squares) < 4 * min(squares)
        if alone or not stack.exposure_s or same_time(near.exposure_s, stack.exposure_s):
            return near.fixed
        slope, start = np.polyfit(squares, [d.fixed for d in known], 1)
        return max(float(start + slope * stack.exposure_s**2), 0.0)

    def _nearest(
        self, darks: Sequence[DrawnDark], band: str | None, exposure_s: float | None
    ) -> DrawnDark:
        order = {band: 0, None: 1}

        def apart(dark: DrawnDark) -> tuple[float, int]:
            if not dark.exposure_s or not exposure_s:
                return 0.0, order.get(dark.band, 2)
            return abs(float(np.log(dark.exposure_s / exposure_s))), order.get(dark.band, 2)

        return min(darks, key=apart)


def same_time(one: float | None, other: float | None) -> bool:
    """Tell whether two exposures are known, and one.

    >>> same_time(0.1, 0.1005), same_time(None, None)
    (True, False)
    """
    return bool(one and other) and abs(float(one) / float(other) - 1) <= SAME_TIME  # type: ignore[arg-type]


def _mean_of(values: np.ndarray | float) -> float:
    return float(np.nanmean(values))
