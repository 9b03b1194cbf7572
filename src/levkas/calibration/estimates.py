"""Estimators of photon transfer: every number of a sensor from blocks drawn with weights."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.blocks import Blocks
from levkas.calibration.code_spacing import Levels
from levkas.calibration.darks import SAME_TIME

if TYPE_CHECKING:
    from levkas.quality.emva1288.photon_transfer import Dark

SLOPE_TO = 0.7  # of saturation: EMVA 1288's range for the gain
PRNU_RANGE = (0.15, 0.9)
LINE_RANGE = (0.05, 0.95)
ROUNDS = 3


def estimate(
    darks: Sequence[Dark],
    whites: Sequence[Blocks],
    scenes: Sequence[Blocks],
    saturation: float,
    rounding: Levels,
    weights: np.ndarray,
    shift: np.ndarray,
) -> dict[str, float]:
    """Return every number from blocks drawn `weights` times, fitted darks moved by their errors."""
    model = DarkModel([Moved(dark, weights, s) for dark, s in zip(darks, shift, strict=True)])
    first, room = model.first, saturation - model.black
    quiet = first.temporal - float(rounding.quantisation(first.level))
    gain, quiet, told = _gain([*whites, *scenes], model, room, quiet, rounding, weights)
    read = max(quiet - gain * (first.level - model.black), 0.0)  # shot noise of the dark current
    dark_noise = np.sqrt(read) / gain if told else np.nan
    full_well = room / gain
    prnu = _prnu(whites, model, room, (gain, quiet), rounding, weights)
    least = np.sqrt(dark_noise**2 + 0.25) + 0.5
    return {
        "gain": gain,
        "black": model.black,
        "dark_noise": dark_noise,
        "dark_current": model.current / gain,
        "dsnu": np.sqrt(max(first.fixed, 0.0)) / gain if np.isfinite(first.fixed) else np.nan,
        "prnu": prnu,
        "full_well": full_well,
        "linearity_error": _linearity(whites, model, room, weights),
        "dynamic_range": full_well / least,
        "snr": np.sqrt(max(full_well, 0.0)),
        "dark_variance": first.temporal,
    }


class Moved:
    """One dark as one draw sees it: weighted means, and its level block by block."""

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


def dark_line(darks: Sequence[Moved]) -> tuple[float, float]:
    """Return black at no time and counts a second; NaN a second where times do not differ by half."""
    times = np.array([d.exposure_s if d.exposure_s else np.nan for d in darks])
    level = np.array([d.level for d in darks])
    known = np.isfinite(times) & np.isfinite(level)
    if np.count_nonzero(known) < 2 or times[known].max() < 2 * times[known].min():
        return float(level[0]), float("nan")
    slope, start = np.polyfit(times[known], level[known], 1)
    return float(start), float(slope)


class DarkModel:
    """What lies under lit stacks: the dark of their own band and exposure, else lines over those that there are.

    Level = black + current·t, and the fixed pattern's variance = a + b·t², as current differs from sensel
    to sensel.

    Parameters
    ----------
    darks : sequence of Moved

    Attributes
    ----------
    first : Moved
        The shortest whose noise over time is known, else the shortest.
    black, current : float
        Counts at no time, counts a second; NaN a second where the exposures do not tell it.
    """

    def __init__(self, darks: Sequence[Moved]) -> None:
        self.darks = sorted(darks, key=lambda dark: dark.exposure_s or 0.0)
        noisy = (dark for dark in self.darks if np.isfinite(dark.temporal))
        self.first = next(noisy, self.darks[0])
        self.black, self.current = dark_line(self.darks)

    def own(self, band: str | None, exposure_s: float | None) -> Moved | None:
        """Return the dark of an exposure: of the band, else one that serves all, else of another band."""
        alike = [d for d in self.darks if same_time(d.exposure_s, exposure_s)]
        order = {band: 0, None: 1}
        return min(alike, key=lambda d: order.get(d.band, 2)) if alike else None

    def lacks(self, stack: Blocks) -> bool:
        """Tell whether a stack has no dark of its exposure, nor others that tell one."""
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
        """Return the variance from sensel to sensel without light; 0 where no dark tells it."""
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

    def _nearest(self, darks: Sequence[Moved], band: str | None, exposure_s: float | None) -> Moved:
        order = {band: 0, None: 1}

        def apart(dark: Moved) -> tuple[float, int]:
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


def _gain(
    lit: Sequence[Blocks],
    model: DarkModel,
    room: float,
    quiet: float,
    rounding: Levels,
    weights: np.ndarray,
) -> tuple[float, float, bool]:
    """Return the slope of variance over signal, its intercept, and whether that is told by dark or lit stacks.

    The line goes through the first dark's own point: its level and `quiet`. Dark current that a stack gathered
    beyond that has shot noise as light has, and counts as signal here.
    """
    rows = []
    for b in (b for b in lit if b.shots > 1):
        signal = model.signal(b) + model.dark_signal(b)
        variance = b.temporal - rounding.quantisation(b.mean)
        used = np.isfinite(signal + variance) & (signal < SLOPE_TO * room) & (weights > 0)
        freedom = np.full(used.sum(), b.shots - 1.0) * weights[used]
        rows.append((signal[used], variance[used], freedom, rounding.quantisation(b.mean)[used]))
    x, y, freedom, rounded = (np.concatenate(part) for part in zip(*rows, strict=True))
    known = np.isfinite(quiet)
    if not known:
        free = _line(x, y, freedom, rounded, None)
        # One shot of a dark spreads by its noise over time and its pattern: no less than the noise.
        quiet = float(np.clip(free[1], 0.0, np.fmin(model.first.spread, np.inf)))
        if quiet == free[1]:
            return *free, True
    return *_line(x, y, freedom, rounded, quiet), known


def _line(
    x: np.ndarray, y: np.ndarray, freedom: np.ndarray, rounded: np.ndarray, start: float | None
) -> tuple[float, float]:
    """Return slope and intercept of variances y on signals x, weighted by 1/variance²; `start` holds the intercept."""
    gain, intercept = 0.0, start or 0.0
    expected = np.maximum(y.mean() * np.ones_like(y), 1e-9)
    for _ in range(ROUNDS):
        w = freedom / expected**2
        if start is not None:
            gain = float(np.sum(w * x * (y - start)) / np.sum(w * x * x))
        else:
            root = np.sqrt(w)
            design = np.stack([x, np.ones_like(x)], 1) * root[:, None]
            gain, intercept = (float(v) for v in np.linalg.lstsq(design, y * root, rcond=None)[0])
        expected = np.maximum(gain * np.maximum(x, 0) + intercept + rounded, 1 / 12)
    return gain, intercept


def _prnu(
    whites: Sequence[Blocks],
    model: DarkModel,
    room: float,
    dark: tuple[float, float],
    rounding: Levels,
    weights: np.ndarray,
) -> float:
    """Return the spread of the response, the temporal share and the dark's own pattern taken out."""
    gain, quiet = dark
    above, below = 0.0, 0.0
    for b in whites:
        signal = model.signal(b)
        over_time = b.temporal
        if b.shots == 1:
            seen = signal + model.dark_signal(b)
            over_time = gain * seen + quiet + rounding.quantisation(b.mean)
        fixed = b.spatial - over_time / b.shots - model.fixed(b)
        used = np.isfinite(signal + fixed)
        used &= (signal > PRNU_RANGE[0] * room) & (signal < PRNU_RANGE[1] * room)
        above += float(np.sum(weights[used] * fixed[used]))
        below += float(np.sum(weights[used] * signal[used] ** 2))
    return float(np.sqrt(max(above, 0.0) / below)) if below > 0 else float("nan")


def _linearity(
    whites: Sequence[Blocks],
    model: DarkModel,
    room: float,
    weights: np.ndarray,
) -> float:
    """Return the rms deviation of whites from the line Σ(Δy/y)² → least over 5–95 % of saturation."""
    timed = [b for b in whites if b.exposure_s]
    if len({b.exposure_s for b in timed}) < 3:
        return float("nan")
    signals = [model.signal(b) for b in timed]
    inside = [np.isfinite(s) & (s < LINE_RANGE[1] * room) for s in signals]
    chosen = [i for i, ok in enumerate(inside) if ok.mean() > 0.5]
    if len(chosen) < 3:
        return float("nan")
    common = np.all([inside[i] for i in chosen], axis=0) & (weights > 0)
    if not common.any():
        return float("nan")
    y = np.array([np.average(signals[i][common], weights=weights[common]) for i in chosen])
    t = np.array([timed[i].exposure_s for i in chosen], float)
    used = y > LINE_RANGE[0] * room
    if len(set(t[used])) < 3:
        return float("nan")
    design = np.stack([t[used], np.ones(used.sum())], 1) / y[used, None]
    solved = np.linalg.lstsq(design, np.ones(used.sum()), rcond=None)[0]
    return float(np.sqrt(np.mean((design @ solved - 1) ** 2)))
