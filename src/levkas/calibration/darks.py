"""Dark of an exposure: the matching one, or one interpolated or scaled to its time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from levkas.calibration.findings import refusal
from levkas.calibration.templates import Template, bands_alike, level_of, pick_bands

SAME_TIME = 0.01  # relative: EXIF rounds 1/60 s to 0.017 s now and then


@dataclass(frozen=True)
class MatchedDark:
    """What to subtract from a frame, counts, float32; it broadcasts to the frame.

    `variance` is that of one shot, counts², of `count` shots, or of `mean` where that is no average (`count` is 1 then); `share` is the
    variance of `mean` over it: 1/n for an average of n, 0 for a constant. `note` says what was done where nothing matched. `stretch` is
    of a dark of another time that could not be scaled: by how much of itself its dark current is wrong, t/tD − 1. `parts` are
    darks that `mean` is made of, with the standard deviation that each gives it over that of one shot.
    """

    mean: np.ndarray
    variance: np.ndarray | None
    share: float
    count: int
    saturated: np.ndarray
    note: str = ""
    stretch: float = 0.0
    parts: tuple[tuple[Template, float], ...] = ()

    @property
    def worked_out(self) -> bool:
        """Whether `variance` is that of `mean`, and was not sampled."""
        return self.count == 1 and self.variance is not None

    def share_of(self, read_variance: float) -> float:
        """Return the variance of `mean` over that of one shot without light, counts²."""
        if self.variance is None or not self.worked_out:
            return self.share
        return self.share * float(np.median(self.variance)) / max(read_variance, 1e-12)

    @cached_property
    def level(self) -> float:
        """`level_of` the mean, counts."""
        dark = self.parts[0][0] if self.parts else None
        return dark.level if dark is not None and dark.mean is self.mean else level_of(self.mean)


def dark_correlation(one: MatchedDark, other: MatchedDark) -> float:
    """Return the correlation of the errors of two darks, −1 … 1: of frames that both are made of.

    >>> dark = Template(np.full((1, 1), 70, "f4"), None, 4, *2 * [np.zeros((1, 1), bool)], 1.0)
    >>> dark_correlation(match_dark(dark, 1.0), match_dark(dark, 4.0, black=64.0))
    1.0
    """
    common = sum(a * b for first, a in one.parts for second, b in other.parts if first is second)
    sizes = [float(np.sqrt(sum(a * a for _, a in dark.parts))) for dark in (one, other)]
    return float(common / (sizes[0] * sizes[1])) if all(sizes) else 0.0


def dark_under(
    frame: Template,
    darks: Template | Sequence[Template] | None,
    *,
    black: float | np.ndarray | None = None,
) -> MatchedDark:
    """Return what is left to subtract from a frame: its dark as `match_dark` has it, or zero where that was subtracted.

    >>> none = np.zeros((1, 1), bool)
    >>> merged = Template(np.full((1, 1), 70, "f4"), None, 1, none, none, 1.0, above_dark=True)
    >>> float(dark_under(merged, None, black=64.0).mean[0, 0])
    0.0
    """
    if frame.above_dark:
        return match_dark(None, None)
    return match_dark(darks, frame.exposure_s, black=black)


def level_under(
    frame: Template,
    darks: Template | Sequence[Template] | None,
    *,
    black: float | np.ndarray | None = None,
) -> np.ndarray:
    """Return `dark_under`'s mean, also where exposures differ from band to band; broadcasts to the frame."""
    offered = [darks] if isinstance(darks, Template) else list(darks or ())
    groups = bands_alike(frame, *offered)
    if groups is None:
        return dark_under(frame, offered, black=black).mean
    level = np.empty((max([1, *(len(d.mean) for d in offered)]), *frame.mean.shape[1:]), np.float32)
    for bands in groups:
        under = [pick_bands(dark, bands) for dark in offered]
        level[..., bands] = dark_under(pick_bands(frame, bands), under, black=black).mean
    return level


def match_dark(
    darks: Template | Sequence[Template] | None,
    exposure_s: float | None,
    *,
    black: float | np.ndarray | None = None,
) -> MatchedDark:
    """Return the dark for an exposure of `exposure_s`; without darks the black level alone, counts: the dark at exposure 0.

    It is the dark within 1 % of the time as it is; else, of two or more, the line through the two nearest times, pixel by pixel. A single
    one is scaled about `black` where that is known, black + (D − black)·t/tD, and used as it is where not, with its `stretch`:
    `flatfield.require_dark` refuses it where the dark current may matter. Raises CalibrationRefused, E_EXPOSURES where darks of several
    times are offered and the frame's time is not known.

    >>> dark = Template(np.full((1, 1), 70, "f4"), None, 1, *2 * [np.zeros((1, 1), bool)], 1.0)
    >>> float(match_dark(dark, 2.0, black=64.0).mean[0, 0])
    76.0
    """
    offered = [darks] if isinstance(darks, Template) else list(darks or ())
    if not offered:
        level = np.atleast_2d(np.float32(0.0 if black is None else black))
        return MatchedDark(level, None, 0.0, 0, np.zeros((1, 1), bool))
    timed = sorted((d for d in offered if d.exposure_s is not None), key=_time)
    if exposure_s is None or not timed:
        return _only(offered)
    nearest = min(timed, key=lambda d: abs(np.log(max(_time(d), 1e-9) / max(exposure_s, 1e-9))))
    if abs(_time(nearest) - exposure_s) <= SAME_TIME * exposure_s:
        return _as_it_is(nearest)
    if len({_time(d) for d in timed}) > 1:
        return _on_line(timed, exposure_s)
    return _scaled(nearest, exposure_s, black)


def _time(dark: Template) -> float:
    return float(dark.exposure_s or 0.0)


def _as_it_is(dark: Template, note: str = "") -> MatchedDark:
    parts = ((dark, float(dark.count**-0.5)),)
    return MatchedDark(dark.mean, *_spread_of(dark), dark.saturated, note, parts=parts)


def _spread_of(dark: Template) -> tuple[np.ndarray | None, float, int]:
    """Return variance, share and count as of `MatchedDark`."""
    if dark.fit is not None:
        return dark.fit.variance, 1.0, 1
    return dark.variance, 1.0 / dark.count, dark.count


def _only(darks: list[Template]) -> MatchedDark:
    if len(darks) > 1:
        raise refusal("darks_unknown", ", ".join(f"{d.exposure_s} s" for d in darks))
    return _as_it_is(darks[0])


def _on_line(timed: list[Template], exposure_s: float) -> MatchedDark:
    """Interpolate between the darks around `exposure_s`, or extrapolate from the last two."""
    times = np.unique([_time(d) for d in timed])
    after = int(np.clip(np.searchsorted(times, exposure_s), 1, len(times) - 1))
    first, second = (
        next(d for d in timed if _time(d) == t) for t in (times[after - 1], times[after])
    )
    part = (exposure_s - _time(first)) / (_time(second) - _time(first))
    mean = (1 - part) * first.mean + part * second.mean
    ends = f"{_time(first):g} s and {_time(second):g} s"
    note = f"dark for {exposure_s:g} s taken on the line through {ends}"
    parts = ((first, (1 - part) * first.count**-0.5), (second, part * second.count**-0.5))
    spread, full = _spread_on_line(first, second, part), first.saturated | second.saturated
    return MatchedDark(mean.astype(np.float32), *spread, full, note, parts=parts)


def _spread_on_line(
    first: Template, second: Template, part: float
) -> tuple[np.ndarray | None, float, int]:
    """Return variance, share and count of (1 − part)·first + part·second."""
    (one, share, count), (other, more, fewer) = _spread_of(first), _spread_of(second)
    if first.fit is not None or second.fit is not None:
        # Of a sensel's own level that clipping hides both miss the same.
        sides = ((abs(1 - part), one, share), (abs(part), other, more))
        missed = sum(w * np.sqrt(v * s) for w, v, s in sides if v is not None)
        return np.asarray(missed**2, np.float32), 1.0, 1
    variance = None
    if one is not None and other is not None:
        variance = ((one + other) / 2).astype(np.float32)
    return variance, float((1 - part) ** 2 * share + part**2 * more), min(count, fewer)


def _scaled(dark: Template, exposure_s: float, black: float | np.ndarray | None) -> MatchedDark:
    scale = exposure_s / max(_time(dark), 1e-9)
    if black is None:
        note = f"the dark of {_time(dark):g} s is used for {exposure_s:g} s as it is: the black level is unknown, and "
        note += "what dark current there may be lies below the noise"
        return replace(_as_it_is(dark, note), stretch=scale - 1)
    mean = (black + (dark.mean - np.float32(black)) * np.float32(scale)).astype(np.float32)
    note = f"dark of {_time(dark):g} s scaled to {exposure_s:g} s about black {np.mean(black):g}"
    variance, share, count = _spread_of(dark)
    parts = ((dark, scale * dark.count**-0.5),)
    return MatchedDark(mean, variance, scale**2 * share, count, dark.saturated, note, parts=parts)
