"""Photon transfer: gain, noise, PRNU and full well of a sensor from darks and lit stacks, after EMVA 1288.

Noise over time grows with the light, var = K·(mean − dark) + var of the dark, so that its slope K is
counts per electron and turns all else into electrons. What stays from shot to shot is fixed pattern:
DSNU in the dark, PRNU in the light. The interval of the gain is that of a bootstrap over blocks of pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from levkas.calibration.templates import CalibrationRefused
from levkas.core.problems import Problem
from levkas.quality.emva1288.blocks import Blocks
from levkas.quality.emva1288.darks import Dark, DarkModel, mean_of
from levkas.quality.emva1288.levels import Levels

DRAWS = 200
LEAST_QUANTISED = 0.24  # counts²: below it EMVA 1288 takes rounding for the noise
FEWEST_BLOCKS = 8
POINTS = 24
SLOPE_TO = 0.7  # of saturation: EMVA 1288's range for the gain
PRNU_RANGE = (0.15, 0.9)
LINE_RANGE = (0.05, 0.95)
ROUNDS = 3


@dataclass(frozen=True)
class Interval:
    """A number and the range in which it lies with 95 % confidence.

    >>> print(Interval(5.0, 4.9, 5.1))
    5 (4.9–5.1)
    """

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.value:.4g} ({self.low:.4g}–{self.high:.4g})"


@dataclass(frozen=True)
class PhotonTransfer:
    """A sensor, or one colour of it; None where these stacks do not suffice.

    Parameters
    ----------
    gain : Interval
        Counts per electron: EMVA's overall system gain K.
    black : float
        Counts of a dark, at no time where the darks have several.
    dark_noise : float, optional
        Temporal dark noise, electrons, rounding taken out; at no time where the darks have several.
    dark_current : float, optional
        Electrons a second.
    dsnu : float, optional
        Electrons: EMVA's DSNU₁₂₈₈, of the shortest dark.
    prnu : float, optional
        Share of the signal: PRNU₁₂₈₈. Texture of the white counts.
    full_well : float, optional
        Electrons at saturation: the saturation capacity.
    linearity_error : float, optional
        Deviation from EMVA's line, rms over 5–95 % of saturation, relative.
    dynamic_range : float, optional
        Full well over the signal whose SNR is one.
    snr : float, optional
        At saturation, shot noise alone: the root of the full well.
    levels : int
        Stacks of light that took part.
    points : tuple of (signal, variance)
        Of the photon transfer curve, counts above dark and counts², rounding taken out.
    """

    gain: Interval
    black: float
    dark_noise: float | None
    dark_current: float | None
    dsnu: float | None
    prnu: float | None
    full_well: float | None
    linearity_error: float | None
    dynamic_range: float | None
    snr: float | None
    levels: int
    notes: tuple[str, ...] = ()
    points: tuple[tuple[float, float], ...] = ()


def measure_sensor(
    darks: Sequence[Dark],
    whites: Sequence[Blocks],
    scenes: Sequence[Blocks] = (),
    *,
    saturation: float,
    rng: np.random.Generator,
    levels: Levels | None = None,
    reached: bool = True,
    draws: int = DRAWS,
) -> PhotonTransfer:
    """Fit one channel of a sensor to its stacks.

    Parameters
    ----------
    darks : sequence of Dark
        Of one exposure, or of several for the dark current.
    whites : sequence of Blocks
        An even, lit surface; at several exposures for linearity.
    scenes : sequence of Blocks
        Anything still: it adds levels to the gain.
    saturation : float
        Counts.
    rng : Generator
        Of the bootstrap.
    levels : Levels, optional
        Of the raw codes: rounding on a compression curve is taken out.
    reached : bool
        Whether any frame saturates; else the full well is a lower bound, with a note.

    Returns
    -------
    found : PhotonTransfer

    Raises
    ------
    CalibrationRefused
        E_TEMPLATE_MISSING without a dark, E_SIZE where sizes differ or frames are too small, E_SHOTS without two shots of anything lit,
        E_WHITE_SATURATED where nothing lit is below 70 % of saturation, E_WHITE_DARK where it is no
        brighter than the dark, E_NOISE where noise does not grow with the light.

    Notes
    -----
    Gain: line through the shortest dark's own point, weighted by 1/variance², over 0–70 % of saturation
    (EMVA 1288, 6.5). Noise, DSNU and PRNU within blocks, so that shading is no non-uniformity.
    """
    lit = [*whites, *scenes]
    _check(darks, lit, saturation)
    rounding, model = levels or Levels(0, 0, 0), DarkModel(darks)
    dark_level, dark_variance = mean_of(model.first.level), mean_of(model.first.temporal)
    room = saturation - model.black
    points = _transfer(lit, model, room, rounding)
    quiet = dark_variance - float(rounding.quantisation(dark_level))
    count = len(lit[0].mean)
    gain, quiet, known = _gain(points, quiet, np.ones(count))
    if not gain > 0:
        raise _refusal(
            "E_NOISE",
            "noise over time does not grow with the light",
            f"gain {gain:.3g} DN/e⁻",
            "more than 0",
            "Capture an evenly lit white twice at half of saturation, nothing moved, and two darks at its exposure.",
        )
    drawn = [
        _gain(points, quiet, rng.multinomial(count, np.full(count, 1 / count)).astype(float))[0]
        for _ in range(draws)
    ]
    half = 1.96 * float(np.nanstd(drawn))
    read = max(quiet - gain * (dark_level - model.black), 0.0)  # shot noise of the dark current
    dark_noise = np.sqrt(read) / gain if known else np.nan
    fixed, full_well = mean_of(model.first.fixed), room / gain
    found = {
        "dark_noise": dark_noise,
        "dark_current": model.current / gain,
        "dsnu": np.sqrt(max(fixed, 0.0)) / gain if np.isfinite(fixed) else np.nan,
        "prnu": _prnu(whites, model, room),
        "full_well": full_well,
        "linearity_error": _linearity(whites, model, room),
        "dynamic_range": full_well / (np.sqrt(dark_noise**2 + 0.25) + 0.5),
        "snr": np.sqrt(max(full_well, 0.0)),
    }
    return PhotonTransfer(
        Interval(gain, gain - half, gain + half),
        model.black,
        **{name: float(v) if np.isfinite(v) else None for name, v in found.items()},
        levels=len(lit),
        notes=_notes(dark_variance, model, lit, whites, reached),
        points=_points(model, lit, rounding),
    )


def _points(
    model: DarkModel, lit: Sequence[Blocks], rounding: Levels
) -> tuple[tuple[float, float], ...]:
    """Return means of groups of blocks of like signal, dark current included, over all lit stacks."""
    repeated = [b for b in lit if b.shots > 1]
    above = mean_of(model.first.level) - model.black
    signal = np.concatenate([model.signal(b) + model.dark_signal(b) + above for b in repeated])
    variance = np.concatenate([b.temporal - rounding.quantisation(b.mean) for b in repeated])
    order = np.argsort(signal)
    order = order[np.isfinite(signal + variance)[order]]
    parts = np.array_split(order, min(POINTS, max(1, len(order) // 4)))
    return tuple((float(signal[p].mean()), float(variance[p].mean())) for p in parts if len(p))


def _notes(
    dark_variance: float,
    model: DarkModel,
    lit: Sequence[Blocks],
    whites: Sequence[Blocks],
    reached: bool,
) -> tuple[str, ...]:
    notes = []
    if lacking := sorted({b.exposure_s or 0.0 for b in whites if model.lacks(b)}):
        had = sorted({d.exposure_s for d in model.darks if d.exposure_s})
        notes.append(
            f"no dark of {_seconds(lacking)}, the exposure of the white, and those of {_seconds(had)} give no dark "
            "current: PRNU, DSNU and linearity are doubtful where there is one. Capture darks at the exposure of "
            "the white"
        )
    if not reached:
        notes.append("no shot saturates: the full well is what the converter's top code would hold")
    if dark_variance < LEAST_QUANTISED:
        notes.append("rounding hides the noise in the dark: it is an upper bound (EMVA 1288, 6.6)")
    if whites and not any(np.isfinite(b.mean).any() for b in whites):
        notes.append("the white is saturated everywhere: capture it with its peak at 85 %")
    elif len({b.exposure_s for b in whites}) < 3:
        notes.append("linearity needs whites of three exposures or more")
    if (levels := sum(b.shots > 1 for b in lit)) < 5:
        notes.append(f"{levels} level{'s' * (levels > 1)} of light; EMVA 1288 requires more")
    return tuple(notes)


def _seconds(times: Sequence[float]) -> str:
    return ", ".join(f"{time:g} s" for time in times)


def _check(darks: Sequence[Dark], lit: Sequence[Blocks], saturation: float) -> None:
    """Refuse stacks from which no gain follows, with what to capture instead."""
    _check_stacks(darks, lit)
    _check_light(darks, [b for b in lit if b.shots > 1], saturation)


def _check_stacks(darks: Sequence[Dark], lit: Sequence[Blocks]) -> None:
    """Refuse where a dark or a repeated shot is missing, or sizes differ."""
    if not darks:
        raise _refusal(
            "E_TEMPLATE_MISSING",
            "there is no dark that can be used",
            0,
            "two shots or more, above zero",
            "Capture two darks with the lens covered, at the exposure of the white; of a camera that takes its black "
            "off and clips at zero, state `black = 0` in campaign.toml.",
        )
    sizes = {np.size(b.mean) for b in lit}
    sizes |= {np.size(d.level) for d in darks if isinstance(d.level, np.ndarray)}
    if len(sizes) > 1:
        raise _refusal(
            "E_SIZE",
            "darks, whites and scenes are of different sizes",
            f"{', '.join(map(str, sorted(sizes)))} blocks",
            "as many blocks in each",
            "Capture all in one mode; crops of other sessions do not fit.",
        )
    if not any(b.shots > 1 for b in lit):
        raise _refusal(
            "E_SHOTS",
            "temporal noise cannot be measured from one shot of each scene",
            f"{len(lit)} lit scenes, one shot each" if lit else "nothing lit",
            "two shots or more of one scene, nothing moved between them",
            "Capture the white twice or more at one exposure, and two darks.",
        )


def _check_light(darks: Sequence[Dark], repeated: Sequence[Blocks], saturation: float) -> None:
    """Refuse repeated stacks without enough blocks between dark and saturation."""
    dark = float(np.nanmean(darks[0].level)) if np.any(np.isfinite(darks[0].level)) else np.nan
    means = np.concatenate([b.mean for b in repeated])
    if means.size < FEWEST_BLOCKS:
        raise _refusal(
            "E_SIZE",
            "the frames are too small for statistics",
            f"{means.size} blocks of one channel",
            f"{FEWEST_BLOCKS} or more",
            "Capture dark and white over the whole sensor, or over more samples of the line.",
        )
    if np.isfinite(means).any() and np.nanmedian(means) <= dark:
        raise _refusal(
            "E_WHITE_DARK",
            "the white is not brighter than the dark",
            f"median {np.nanmedian(means):.1f} counts lit, {dark:.1f} dark",
            "more light than none",
            "Look whether dark and white are swapped, or the lamp was off.",
        )
    below = np.count_nonzero(means - dark < SLOPE_TO * (saturation - dark))
    if below < FEWEST_BLOCKS:
        raise _refusal(
            "E_WHITE_SATURATED",
            "too little of what is lit is below 70 % of saturation",
            f"{below} usable blocks",
            f"{FEWEST_BLOCKS} or more",
            "Capture the white at half the exposure too, or with its peak at 85 % of saturation.",
        )


def _refusal(code: str, message: str, found: object, expected: str, fix: str) -> CalibrationRefused:
    return CalibrationRefused(Problem(code, message, found=found, expected=expected, fix=fix))


class _Transfer(NamedTuple):
    """Blocks of repeated stacks below 70 % of saturation, (n,) each: number of the block, signal, variance, freedom, rounding."""

    block: np.ndarray
    signal: np.ndarray
    variance: np.ndarray
    freedom: np.ndarray
    rounded: np.ndarray


def _transfer(lit: Sequence[Blocks], model: DarkModel, room: float, rounding: Levels) -> _Transfer:
    """Return what the gain is fitted to. Dark current that a stack gathered beyond the first dark's has shot noise as light has."""
    rows = []
    for b in (b for b in lit if b.shots > 1):
        signal, rounded = model.signal(b) + model.dark_signal(b), rounding.quantisation(b.mean)
        variance = b.temporal - rounded
        used = np.flatnonzero(np.isfinite(signal + variance) & (signal < SLOPE_TO * room))
        freedom = np.full(used.size, b.shots - 1.0)
        rows.append((used, signal[used], variance[used], freedom, rounded[used]))
    return _Transfer(*(np.concatenate(part) for part in zip(*rows, strict=True)))


def _gain(points: _Transfer, quiet: float, weights: np.ndarray) -> tuple[float, float, bool]:
    """Return the slope of variance over signal, its intercept, and whether dark or lit stacks determine it.

    The line goes through the first dark's own point, `quiet`, where that is known; `weights` are those of blocks, (blocks,).
    """
    here = points.freedom * weights[points.block]
    x, y, freedom, rounded = (
        part[here > 0] for part in (points.signal, points.variance, here, points.rounded)
    )
    if np.isfinite(quiet):
        return *_line(x, y, freedom, rounded, quiet), True
    free = _line(x, y, freedom, rounded, None)
    if free[1] >= 0:
        return *free, True
    return *_line(x, y, freedom, rounded, 0.0), False


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


def _prnu(whites: Sequence[Blocks], model: DarkModel, room: float) -> float:
    """Return the spread of the response, the temporal share and the dark's own pattern taken out."""
    above, below = 0.0, 0.0
    for b in (b for b in whites if b.shots > 1):
        signal = model.signal(b)
        fixed = b.spatial - b.temporal / b.shots - model.fixed(b)
        used = np.isfinite(signal + fixed)
        used &= (signal > PRNU_RANGE[0] * room) & (signal < PRNU_RANGE[1] * room)
        above += float(np.sum(fixed[used]))
        below += float(np.sum(signal[used] ** 2))
    return float(np.sqrt(max(above, 0.0) / below)) if below > 0 else float("nan")


def _linearity(whites: Sequence[Blocks], model: DarkModel, room: float) -> float:
    """Return the rms deviation of whites from the line Σ(Δy/y)² → least over 5–95 % of saturation."""
    timed = [b for b in whites if b.exposure_s]
    signals = [model.signal(b) for b in timed]
    inside = [np.isfinite(s) & (s < LINE_RANGE[1] * room) for s in signals]
    chosen = [i for i, ok in enumerate(inside) if ok.mean() > 0.5]
    if len(chosen) < 3 or not (common := np.all([inside[i] for i in chosen], axis=0)).any():
        return float("nan")
    y = np.array([signals[i][common].mean() for i in chosen])
    t = np.array([timed[i].exposure_s for i in chosen], float)
    used = y > LINE_RANGE[0] * room
    if len(set(t[used])) < 3:
        return float("nan")
    design = np.stack([t[used], np.ones(used.sum())], 1) / y[used, None]
    solved = np.linalg.lstsq(design, np.ones(used.sum()), rcond=None)[0]
    return float(np.sqrt(np.mean((design @ solved - 1) ** 2)))
