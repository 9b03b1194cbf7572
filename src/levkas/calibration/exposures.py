"""Several exposures of one scene: the best of them, or all merged into counts a second.

Merging weighs each exposure by the inverse of its variance, wᵢ = tᵢ²/(gain·C·tᵢ + read²), with the
rate C of the round before; what saturates is left out pixel by pixel, and what lies next to it: a dim sensel
holds some of a bright neighbour's light (0.7 % in a Bayer sensor behind a 550 nm filter) until that one is full, and no more after.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import cv2
import numpy as np

from levkas.calibration.darks import MatchedDark, dark_under
from levkas.calibration.flatfield import require_dark
from levkas.calibration.linearity import PERIOD, RECIPROCAL, Linearity, check_linearity
from levkas.calibration.motion import find_moved_between
from levkas.calibration.noise_fit import NoiseModel
from levkas.calibration.templates import (
    CalibrationRefused,
    ShotLevels,
    Template,
    as_marks,
    as_rows,
    read_only,
    union_of,
)
from levkas.core.compiled import njit
from levkas.core.problems import Problem
from levkas.core.threads import in_threads

TOLERATED = 1e-4  # share of clipped pixels that the best exposure may have: hot pixels, a glint
USABLE = 0.98  # of saturation: beyond it the response bends
NEARLY, BEYOND = (
    0.9,
    1.1,
)  # of saturation: shown at most, and predicted, by a sensel that is full before others
NEXT_TO = np.ones((3, 3), np.uint8)
ROUNDS = 3
GROUPS = 24  # of pixels of like rate, whose noise two exposures show
FEWEST = 200  # pixels of a group: their variance is known to 10 %
MANY = 500_000  # pixels that are looked at
DIM = 4.0  # times the least variance of a group: brighter ones say little of noise without light


def best_exposure(shots: Sequence[Template]) -> Template:
    """Return the longest exposure that is not saturated.

    Raises CalibrationRefused, E_NO_FRAMES without a shot, E_EXPOSURES where an exposure is unknown.

    Parameters
    ----------
    shots : sequence of Template
        One scene, one band; each with its `exposure_s`.

    Returns
    -------
    shot : Template
        One of `shots`; a share of `TOLERATED` saturated pixels does not count. Where all are saturated, the one with the fewest saturated pixels; its
        flags show where.
    """
    timed = _in_order(shots)
    shares = [float(np.mean(shot.saturated)) for shot in timed]
    good = [shot for shot, share in zip(timed, shares, strict=True) if share <= TOLERATED]
    return good[-1] if good else timed[int(np.argmin(shares))]


@dataclass(frozen=True)
class Merged:
    """An exposure series in one.

    Parameters
    ----------
    template : Template
        Counts a second, `above_dark` (`exposure_s` 1.0), with the variance of the merge where the
        noise is known. Saturated: no exposure was usable there, and the shortest was taken.
        Black: the longest usable one was clipped at black.
    linearity : Linearity
        How well the exposures scaled; `template.shots` has the light of each over what its time states.
    moved : ndarray of bool, shape of the frames, or None
        Where the exposures disagree by more than their noise and non-linearity explain; None where
        the noise is not known.
    """

    template: Template
    linearity: Linearity
    moved: np.ndarray | None = None


def merge_exposures(
    shots: Sequence[Template],
    darks: Template | Sequence[Template] | None = None,
    *,
    saturation: float,
    black: float | np.ndarray | None = None,
    noise: NoiseModel | None = None,
    fit_offset: bool | None = None,
    period: tuple[int, int] = PERIOD,
) -> Merged:
    """Merge exposures of one still scene into counts a second.

    Raises CalibrationRefused, E_EXPOSURES with fewer than two exposures, unknown ones, or ones that do not scale.

    Parameters
    ----------
    shots : sequence of Template
        Of different `exposure_s`; two or more.
    darks, black
        As in `darks.match_dark`.
    saturation : float
        Counts; beyond 98 % of it a value does not count.
    noise : NoiseModel, optional
        Of one shot. None: weights are those of shot noise alone, and no variance comes out.
    fit_offset : bool, optional
        Fit and subtract an offset common to all exposures. None: only where the darks were
        clipped at black over more than half of their pixels, and so say little about it.
    period : (rows, columns)
        Of a mosaic's pattern.

    Notes
    -----
    Three rounds from rate 0, [mirhashemi2019]_'s noise model in counts: within 1 % of the
    Cramér–Rao bound over four decades. PRNU stays out: it is the same in every exposure. An exposure
    counts next to sensels that are full in it only where no other does.

    Examples
    --------
    >>> clear = np.zeros((1, 1), bool)
    >>> shots = [Template(np.full((1, 1), 100.0 * t, "f4"), None, 1, clear, clear, t) for t in (1, 4)]
    >>> merge_exposures(shots, saturation=4095).template.mean.tolist()
    [[100.0]]
    """
    timed = _in_order(shots)
    _check_series(timed)
    if fit_offset is None:
        offered = [darks] if isinstance(darks, Template) else list(darks or ())
        fit_offset = bool(offered) and all(np.mean(dark.black) > 0.5 for dark in offered)

    unders = [dark_under(shot, darks, black=black) for shot in timed]
    for shot, under in zip(timed, unders, strict=True):
        require_dark(shot, under, noise)
    scaling = check_linearity(
        timed, darks, saturation=saturation, black=black, fit_offset=fit_offset, period=period
    )
    if scaling.points and scaling.rms > RECIPROCAL:
        raise CalibrationRefused(_does_not_scale(scaling))
    levels = [under.mean + np.float32(scaling.offset) for under in unders]
    early = _full_early(timed, levels, saturation)
    full = [
        s.saturated | (s.mean > USABLE * saturation) | e for s, e in zip(timed, early, strict=True)
    ]
    apart = [cv2.dilate(marks.astype(np.uint8), NEXT_TO).reshape(marks.shape) > 0 for marks in full]
    allowed = noise
    if noise is not None:
        read, miss = read_variance_between(timed, levels, apart, noise.gain)
        more = max(read - noise.read_under(unders[0]), 0.0)
        noise = replace(noise, read_variance=noise.read_variance + more)
        allowed = replace(noise, read_variance=noise.read_variance + miss)
    template = _merge(timed, unders, apart, USABLE * saturation, scaling.offset, noise)
    template = replace(template, shots=_light_of_exposures(timed, scaling))
    moved = None
    if allowed is not None:
        moved = find_moved_between(
            *(timed, levels, template.mean, allowed),
            reads=[allowed.read_under(under) for under in unders],
            left_out=apart,
            period=period,
        )
    return Merged(template, scaling, moved)


def read_variance_between(
    timed: Sequence[Template],
    levels: Sequence[np.ndarray],
    left_out: Sequence[np.ndarray],
    gain: float,
) -> tuple[float, float]:
    """Estimate the noise without light from what the shortest and the longest exposure differ by.

    Parameters
    ----------
    timed : sequence of Template
        Two exposures or more of one scene, shortest first.
    levels : sequence of ndarray that broadcast to them
        Counts without light of each.
    left_out : sequence of ndarray of bool
        What takes no part in each.
    gain : float
        Counts per photo-electron.

    Returns
    -------
    read_variance, offset : float, counts²
        Of one shot; and the square of what the levels miss. Both 0 where too few pixels show both
        exposures.

    Notes
    -----
    With ρ = t_s/t_l, the difference S − ρL has variance read²(1 + ρ²) + gain·S(1 + ρ), and is not
    correlated with ρS + L where read noise rules: by that pixels are sorted into groups. A group's
    variance leaves out what chance does not explain, and of the dim groups the median counts, so that
    what moved does not.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> shots = [Template(rng.normal(100, 3, (99, 99)), None, 1, *2 * [np.zeros((99, 99), bool)], t)
    ...          for t in (1.0, 4.0)]
    >>> level, none = np.full((1, 1), 100.0), np.zeros((99, 99), bool)
    >>> [round(v) for v in read_variance_between(shots, [level] * 2, [none] * 2, 0.5)]
    [9, 0]
    """
    short, long = timed[0], timed[-1]
    ratio = (short.exposure_s or 0.0) / (long.exposure_s or 1.0)
    step = max(1, short.mean.size // MANY)
    good = ~(short.black | long.black | left_out[0] | left_out[-1]).ravel()[::step]
    lit = [
        (shot.mean - level).ravel()[::step][good].astype(float)
        for shot, level in ((short, levels[0]), (long, levels[-1]))
    ]
    order = np.argsort(ratio * lit[0] + lit[1], kind="stable")
    apart, dim = (lit[0] - ratio * lit[1])[order], (ratio * lit[1])[order]
    parts = np.array_split(np.arange(len(order)), min(GROUPS, len(order) // FEWEST) or 1)
    found = []
    for part in parts:
        if len(part) < FEWEST:
            return 0.0, 0.0
        miss, variance = _middle(apart[part])
        light = gain * max(float(dim[part].mean()), 0.0)
        shots = 1 / short.count + ratio**2 / long.count
        read = (variance - light * (1 / short.count + ratio / long.count)) / shots
        found.append((variance, read, miss**2))
    table = np.array(found)
    table = table[table[:, 0] <= DIM * table[:, 0].min()]
    return max(float(np.median(table[:, 1])), 0.0), float(np.median(table[:, 2]))


def _middle(values: np.ndarray) -> tuple[float, float]:
    """Return mean and variance without what lies more than five deviations off."""
    kept = values
    for _ in range(20):
        inside = values[np.abs(values - np.median(kept)) <= 5 * max(kept.std(), 0.5)]
        if len(inside) == len(kept):
            break
        kept = inside
    return float(kept.mean()), float(kept.var())


def _full_early(
    timed: Sequence[Template], levels: Sequence[np.ndarray], saturation: float
) -> list[np.ndarray]:
    """Return where a sensel is full below the others' saturation, as a shorter exposure foretells."""
    full = [np.zeros(timed[0].mean.shape, bool)]
    rate = (timed[0].mean - levels[0]) / np.float32(timed[0].exposure_s or 1.0)
    for shot, level in zip(timed[1:], levels[1:], strict=True):
        time = np.float32(shot.exposure_s or 1.0)
        bright = shot.mean > NEARLY * saturation
        full.append(bright & (rate * time > BEYOND * saturation))
        rate = np.where(bright, rate, (shot.mean - level) / time)
    return full


def _merge(
    timed: list[Template],
    unders: list[MatchedDark],
    apart: list[np.ndarray],
    full: float,
    offset: float,
    noise: NoiseModel | None,
) -> Template:
    shape = as_rows(timed[0].mean).shape
    total, weights, clipped, rate = _sums(timed, unders, apart, full, offset, noise)
    if not weights.all():
        alone = weights == 0
        own = _sums(timed, unders, [s.saturated for s in timed], full, offset, noise)
        for kept, more in zip((total, weights, clipped, rate), own, strict=True):
            kept[alone] = more[alone]
    lost, first, shortest = weights == 0, timed[0], timed[0].exposure_s or 1.0
    level = np.broadcast_to(as_rows(unders[0].mean), shape)[lost]
    rate[lost] = (as_rows(first.mean)[lost] - level - offset) / shortest
    variance = None
    if noise is not None:
        variance = (1 / np.where(lost, 1, weights)).astype(np.float32)
        variance[lost] = noise.variance(rate[lost] * shortest) / shortest**2
        variance = variance.reshape(first.mean.shape)
    whole = first.mean.shape
    return Template(
        rate.reshape(whole),
        variance,
        1,
        lost.reshape(whole),
        clipped.reshape(whole) > 0,
        1.0,
        union_of(*(shot.lost for shot in timed)),
        above_dark=True,
        absent=union_of(*(shot.absent for shot in timed)),
    )


def _sums(
    timed: list[Template],
    unders: list[MatchedDark],
    left_out: list[np.ndarray],
    full: float,
    offset: float,
    noise: NoiseModel | None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return Σ w·rate, Σ w, whether the last that counted was clipped at black, and their rate."""

    shape = as_rows(timed[0].mean).shape
    gain = -1.0 if noise is None else noise.gain
    reads = [0.0 if noise is None else noise.read_under(under) for under in unders]
    rate = np.zeros(shape, np.float32)
    for _ in range(ROUNDS if noise is not None else 1):
        total, weights = np.zeros(shape), np.zeros(shape)
        clipped = np.zeros(shape, np.uint8)
        sums = _Sums(rate, total, weights, clipped)
        for shot, under, read, marks in zip(timed, unders, reads, left_out, strict=True):
            planes = as_rows(shot.mean), as_rows(under.mean), as_marks(marks), as_marks(shot.black)
            scalars = shot.exposure_s or 0.0, read, 1.0 / shot.count, under.share_of(read)
            parts: list[Any] = [*map(read_only, planes), *map(float, scalars)]
            numbers = float(full), float(offset), float(gain)
            in_threads(_add_exposure, shape[0], _Frame(*parts), sums, numbers, worth=total.size)
        rate = (total / np.where(weights > 0, weights, 1)).astype(np.float32)
    return total, weights, clipped, rate


def _light_of_exposures(timed: Sequence[Template], scaling: Linearity) -> ShotLevels | None:
    """Return how bright each exposure is over what its time states: a lamp that flickers is that of a merge, too."""
    first = timed[0].shots
    if len(timed) != len(scaling.levels) or first is None:
        return first
    channels = first.levels.shape[1]
    return ShotLevels(np.tile(np.array(scaling.levels)[:, None], channels), np.zeros(channels))


def _check_series(timed: list[Template]) -> None:
    shapes, times = {shot.mean.shape for shot in timed}, {shot.exposure_s for shot in timed}
    if len(shapes) == 1 and len(times) == len(timed) >= 2:
        return
    raise CalibrationRefused(
        Problem(
            "E_EXPOSURES",
            "these exposures cannot be merged",
            field="exposures",
            found=", ".join(f"{shot.exposure_s:g} s {shot.mean.shape}" for shot in timed),
            expected="two or more different exposures of one size",
            fix='Average shots of equal exposure first, or set exposures = "one".',
        )
    )


def _does_not_scale(scaling: Linearity) -> Problem:
    return Problem(
        "E_EXPOSURES",
        "the counts are not proportional to the exposure",
        field="exposures",
        found=f"rms deviation {scaling.rms:.1%}, worst {scaling.worst:+.1%} "
        f"at {scaling.worst_at_s:g} s and {scaling.worst_level:.0f} counts",
        expected=f"at most {RECIPROCAL:.1%} rms",
        fix="Check exposure times and black level, and leave out the frames of a wrong time. Of a sensor that is not linear "
        'set exposures = "best", and capture the white at the exposures of the object.',
    )


def _in_order(shots: Sequence[Template]) -> list[Template]:
    if not shots:
        raise CalibrationRefused(Problem("E_NO_FRAMES", "there is no frame to choose"))
    if any(not shot.exposure_s for shot in shots):
        raise CalibrationRefused(
            Problem(
                "E_EXPOSURES",
                "an exposure is unknown",
                field="exposure",
                found=", ".join(f"{shot.exposure_s}" for shot in shots),
                expected="seconds, > 0, of every frame",
                fix="Put {exposure} into the file pattern.",
            )
        )
    return sorted(shots, key=lambda shot: shot.exposure_s or 0.0)


class _Frame(NamedTuple):
    """One exposure as `_add_exposure` reads it; arrays are (h, w) views, `dark` may be one line or one number.

    `time` in seconds, `read` the variance without light, counts²; `share` and `dark_share` are the
    variances of the means over those of one shot.
    """

    mean: np.ndarray
    dark: np.ndarray
    saturated: np.ndarray
    black: np.ndarray
    time: float
    read: float
    share: float
    dark_share: float


class _Sums(NamedTuple):
    """Running sums of a merge, (h, w) each; `rate` is that of the round before."""

    rate: np.ndarray
    total: np.ndarray
    weights: np.ndarray
    clipped: np.ndarray


@njit(cache=True)
def _add_exposure(start, stop, frame, sums, numbers):  # type: ignore[no-untyped-def]
    """Add w·(mean − dark − offset)/time to `total` and w to `weights`, where not saturated.

    w = time²/(share·(gain·rate·time + read) + dark_share·read), or `time` where `gain` < 0.
    `clipped` keeps whether the last exposure that counted was clipped at black.
    """
    mean, dark, saturated, black, time, read, share, dark_share = frame
    rate, total, weights, clipped = sums
    limit, offset, gain = numbers
    for y in range(start, stop):
        dy, dx = y % dark.shape[0], dark.shape[1] > 1
        for x in range(mean.shape[1]):
            if saturated[y, x] or mean[y, x] > limit:
                continue
            signal = np.float64(mean[y, x]) - np.float64(dark[dy, x * dx]) - offset
            weight = time
            if gain >= 0.0:
                light = gain * max(np.float64(rate[y, x]), 0.0) * time
                weight = time * time / (share * (light + read) + dark_share * read)
            total[y, x] += weight * signal / time
            weights[y, x] += weight
            clipped[y, x] = black[y, x]
