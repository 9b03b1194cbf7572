"""Estimators of photon transfer: every number of a sensor from blocks drawn with weights."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np

from levkas.calibration.blocks import Blocks
from levkas.calibration.curves import Levels

if TYPE_CHECKING:
    from levkas.calibration.photon_transfer import Dark

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
    dim = [Moved(dark, weights, s) for dark, s in zip(darks, shift, strict=True)]
    order = sorted(range(len(dim)), key=lambda i: darks[i].exposure_s or 0.0)
    first = dim[order[0]]
    black, current = dark_line([dim[i] for i in order])
    under = matching(dim, current)
    room = saturation - first.level
    quiet = first.temporal - float(rounding.quantisation(first.level))
    gain, intercept = _gain([*whites, *scenes], under, room, quiet, rounding, weights)
    quiet = max(intercept if np.isnan(quiet) else quiet, 0.0)
    dark_noise = np.sqrt(quiet) / gain
    full_well = room / gain
    prnu = _prnu(whites, under, room, (gain, quiet, first.fixed), rounding, weights)
    least = np.sqrt(dark_noise**2 + 0.25) + 0.5
    return {
        "gain": gain,
        "black": black,
        "dark_noise": dark_noise,
        "dark_current": current / gain,
        "dsnu": np.sqrt(max(first.fixed, 0.0)) / gain if np.isfinite(first.fixed) else np.nan,
        "prnu": prnu,
        "full_well": full_well,
        "linearity_error": _linearity(whites, under, room, weights),
        "dynamic_range": full_well / least,
        "snr": np.sqrt(max(full_well, 0.0)),
        "dark_variance": first.temporal,
    }


class Moved:
    """One dark as one draw sees it: weighted means, and its level block by block."""

    def __init__(self, dark: Dark, weights: np.ndarray, shift: np.ndarray) -> None:
        parts = (dark.level, dark.temporal, dark.fixed)
        self.level, self.temporal, self.fixed = (
            _mean(part, weights) + error * move
            for part, error, move in zip(parts, dark.errors, shift, strict=True)
        )
        self.under = dark.level if isinstance(dark.level, np.ndarray) else self.level
        self.exposure_s = dark.exposure_s


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


def matching(
    darks: Sequence[Moved], current: float
) -> Callable[[float | None], np.ndarray | float]:
    """Return what gives the counts without light at an exposure: the nearest dark, brought to it."""
    timed = [(float(d.exposure_s), d) for d in darks if d.exposure_s]

    def under(exposure_s: float | None) -> np.ndarray | float:
        if not exposure_s or not timed:
            return darks[0].under
        time, near = min(timed, key=lambda item: abs(np.log(item[0] / exposure_s)))
        rest = (exposure_s - time) * current
        return near.under + (rest if np.isfinite(rest) else 0.0)

    return under


def _gain(
    lit: Sequence[Blocks],
    under: Callable[[float | None], np.ndarray | float],
    room: float,
    quiet: float,
    rounding: Levels,
    weights: np.ndarray,
) -> tuple[float, float]:
    """Return the slope of variance over signal, and its intercept where the dark's is not known."""
    rows = []
    for b in (b for b in lit if b.shots > 1):
        signal = b.mean - under(b.exposure_s)
        variance = b.temporal - rounding.quantisation(b.mean)
        used = np.isfinite(signal + variance) & (signal < SLOPE_TO * room) & (weights > 0)
        freedom = np.full(used.sum(), b.shots - 1.0) * weights[used]
        rows.append((signal[used], variance[used], freedom, rounding.quantisation(b.mean)[used]))
    x, y, freedom, rounded = (np.concatenate(part) for part in zip(*rows, strict=True))
    known = np.isfinite(quiet)
    gain, intercept = 0.0, quiet if known else 0.0
    expected = np.maximum(y.mean() * np.ones_like(y), 1e-9)
    for _ in range(ROUNDS):
        w = freedom / expected**2
        if known:
            gain = float(np.sum(w * x * (y - quiet)) / np.sum(w * x * x))
        else:
            root = np.sqrt(w)
            design = np.stack([x, np.ones_like(x)], 1) * root[:, None]
            gain, intercept = (float(v) for v in np.linalg.lstsq(design, y * root, rcond=None)[0])
        expected = np.maximum(gain * np.maximum(x, 0) + intercept + rounded, 1 / 12)
    return gain, intercept


def _prnu(
    whites: Sequence[Blocks],
    under: Callable[[float | None], np.ndarray | float],
    room: float,
    dark: tuple[float, float, float],
    rounding: Levels,
    weights: np.ndarray,
) -> float:
    """Return the spread of the response, the temporal share and the dark's own pattern taken out."""
    gain, quiet, pattern = dark
    above, below = 0.0, 0.0
    for b in whites:
        signal = b.mean - under(b.exposure_s)
        over_time = b.temporal
        if b.shots == 1:
            over_time = gain * signal + quiet + rounding.quantisation(b.mean)
        fixed = b.spatial - over_time / b.shots - (pattern if np.isfinite(pattern) else 0.0)
        used = np.isfinite(signal + fixed)
        used &= (signal > PRNU_RANGE[0] * room) & (signal < PRNU_RANGE[1] * room)
        above += float(np.sum(weights[used] * fixed[used]))
        below += float(np.sum(weights[used] * signal[used] ** 2))
    return float(np.sqrt(max(above, 0.0) / below)) if below > 0 else float("nan")


def _linearity(
    whites: Sequence[Blocks],
    under: Callable[[float | None], np.ndarray | float],
    room: float,
    weights: np.ndarray,
) -> float:
    """Return the rms deviation of whites from the line Σ(Δy/y)² → least over 5–95 % of saturation."""
    timed = [b for b in whites if b.exposure_s]
    if len({b.exposure_s for b in timed}) < 3:
        return float("nan")
    signals = [b.mean - under(b.exposure_s) for b in timed]
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
