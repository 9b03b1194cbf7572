"""Templates: many shots of one scene averaged into one, a shot at a time.

mean = Σx / n,  variance of one shot = (Σx² − (Σx)²/n) / (n − 1). For 8- and 16-bit codes both
sums are whole numbers, so the result does not depend on the order of the shots or on threads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from levkas.calibration.findings import CalibrationRefused, refusal
from levkas.core.compiled import njit
from levkas.core.threads import in_threads

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

ARRAYS = ("mean", "variance", "saturated", "black", "lost", "absent")
MANY_PIXELS = 200_000  # of a frame whose median is asked for
MOST_SHOTS = 65536  # beyond this n² · 65535² no longer fits 64 bits


class DarkFit(NamedTuple):
    """How a clipped dark was fitted.

    `variance` is that of its mean about each sensel's own level, counts²; `blacks` are those of each phase of a mosaic, or band of a
    cube, one of all where bands are many; `noise` is that of one shot, counts, rounding not included; `zeros` the share of pixels at 0.
    """

    variance: np.ndarray
    blacks: tuple[float, ...]
    noise: float
    zeros: float


@dataclass(frozen=True, eq=False)
class ShotLevels:
    """How bright each shot of a stack is, channel by channel: a channel is a phase of the mosaic, and a band of it.

    `levels`, (shots, channels), are the light of each shot over the mean of all, of darks the counts by which each lies above the mean;
    `error`, (channels,), what noise alone gives to a level, infinite where the stack has no light; `times_s` when each was captured, s
    from any origin. Of a white `differing` are shots that show something else than most, `apart` is the largest relative deviation of a
    part of a shot; of an object `unlike` are shots that differ from the first, as (index, *`sight.difference_between`).
    """

    levels: np.ndarray
    error: np.ndarray
    times_s: tuple[float, ...] | None = None
    differing: tuple[int, ...] = ()
    apart: float = 0.0
    unlike: tuple[tuple[int, str, float], ...] = ()


@dataclass(frozen=True)
class Template:
    """The average of `count` shots, counts, (h, w) or (h, w, b), float32, with what each of them did.

    `variance` is that of *one* shot over time, counts²; None where there is only one. `saturated` and `black` are where any single shot was
    saturated, or clipped at black; `lost` where one was no finite number and `close_gaps` put another value, `absent` where the file says
    that it holds nothing. `above_dark` is whether dark or black level were subtracted. Of a scan whose bands have an exposure each these
    are `band_times_s`, and `exposure_s` is None. `fit` is of a dark that was clipped at black, of which `clipped_darks.unclip` made `mean`.

    >>> t = average([np.full((1, 1), 10), np.full((1, 1), 14)])
    >>> float(t.mean[0, 0]), float(t.variance[0, 0]), t.count
    (12.0, 8.0, 2)
    """

    mean: np.ndarray
    variance: np.ndarray | None
    count: int
    saturated: np.ndarray
    black: np.ndarray
    exposure_s: float | None = None
    lost: np.ndarray | None = None
    above_dark: bool = False
    band_times_s: tuple[float, ...] | None = None
    fit: DarkFit | None = None
    shots: ShotLevels | None = None
    absent: np.ndarray | None = None

    def __post_init__(self) -> None:
        arrays = [self.mean, self.saturated, self.black]
        arrays += [] if self.variance is None else [self.variance]
        if len({a.shape for a in arrays}) != 1:
            raise ValueError(f"template has arrays of shapes {[a.shape for a in arrays]}")

    @cached_property
    def level(self) -> float:
        """`level_of` the mean, counts."""
        return level_of(self.mean)

    def taken(self, take: Callable[[np.ndarray], np.ndarray], **more: Any) -> Template:
        """Return the template with a part of each of its arrays."""
        arrays = {name: getattr(self, name) for name in ARRAYS}
        parts: dict[str, Any] = {
            name: take(array) for name, array in arrays.items() if array is not None
        }
        return replace(self, **parts, **more)


def level_of(frame: np.ndarray) -> float:
    """Return the median of a frame, of many pixels about `MANY_PIXELS`."""
    return float(np.median(frame.ravel()[:: max(1, frame.size // MANY_PIXELS)]))


def bands_alike(*templates: Template | None) -> list[np.ndarray] | None:
    """Return the bands, as indices, that have one exposure in each template; None where no bands differ."""
    listed = [t.band_times_s for t in templates if t is not None and t.band_times_s]
    if not listed:
        return None
    times = np.array(listed)
    _, which = np.unique(times, axis=1, return_inverse=True)
    return [np.flatnonzero(which == group) for group in range(int(which.max()) + 1)]


def pick_bands(template: Template, bands: np.ndarray) -> Template:
    """Return some bands of a template, all of one exposure, as a template of it."""
    times, fit, shots = template.band_times_s, template.fit, template.shots
    if shots is not None:
        shots = replace(shots, levels=shots.levels[:, bands], error=shots.error[bands])
    return template.taken(
        lambda array: array[..., bands],
        exposure_s=times[bands[0]] if times else template.exposure_s,
        band_times_s=None,
        fit=None if fit is None else fit._replace(variance=fit.variance[..., bands]),
        shots=shots,
    )


def average(
    frames: Iterable[np.ndarray],
    *,
    saturation: float | None = None,
    black_clip: float | None = 0.0,
    exposure_s: float | None = None,
) -> Template:
    """Average shots of one scene, all (h, w) or all (h, w, b), of one real dtype; only one of them is held at a time.

    Codes at or above `saturation`, and at or below `black_clip`, are marked shot by shot: the mean of five shots of which one is
    clipped lies below saturation and is wrong all the same. Raises CalibrationRefused, E_NO_FRAMES without a frame; E_SIZE, E_VALUE
    where shapes or dtypes differ (by index).
    """
    high = np.inf if saturation is None else float(saturation)
    low = -np.inf if black_clip is None else float(black_clip)
    sums: _Sums | None = None
    for index, frame in enumerate(frames):
        frame = np.asarray(frame)
        frame = frame.astype(frame.dtype.newbyteorder("="), copy=False)
        if sums is None:
            sums = _Sums(frame, high, low)
        else:
            sums.check(frame, index)
            sums.add(frame)
    if sums is None:
        raise refusal("no_frames")
    return sums.template(exposure_s)


class _Sums:
    """Running sums over shots, begun by the second, so that a single shot costs no more."""

    def __init__(self, first: np.ndarray, high: float, low: float) -> None:
        if first.dtype.kind not in "uif" or first.ndim not in (2, 3) or first.size == 0:
            raise refusal("no_real_array", f"{first.dtype} {first.shape}")
        # A copy: a reader may hand out the same buffer again for the next shot.
        self.first, self.high, self.low, self.count = first.copy(), high, low, 1
        self.saturated, self.black = self.first >= high, self.first <= low
        self.whole = first.dtype in (np.uint8, np.uint16)
        self.totals: tuple[np.ndarray, np.ndarray] | None = None

    def check(self, frame: np.ndarray, index: int) -> None:
        if frame.shape != self.first.shape or frame.dtype != self.first.dtype:
            code = "shot_size" if frame.shape != self.first.shape else "shot_type"
            found, expected = (f"{one.shape} {one.dtype}" for one in (frame, self.first))
            raise refusal(code, str(index), found=found, expected=expected)
        if self.whole and index >= MOST_SHOTS:
            raise refusal("many_shots", number=index + 1, limit=MOST_SHOTS)

    def add(self, frame: np.ndarray) -> None:
        if self.totals is None:
            shape = as_rows(self.first, None).shape
            kinds = (np.uint32, np.uint64) if self.whole else (np.float64, np.float64)
            self.totals = (np.zeros(shape, kinds[0]), np.zeros(shape, kinds[1]))
            self._sum(self.first, 0, self.totals)
        self._sum(frame, self.count, self.totals)
        self.count += 1

    def _sum(self, frame: np.ndarray, before: int, totals: tuple[np.ndarray, np.ndarray]) -> None:
        marks = (as_marks(self.saturated), as_marks(self.black))
        limits = (float(self.high), float(self.low))
        if self.whole:
            rows = read_only(as_rows(frame, None))
            in_threads(_add_codes, len(rows), rows, totals, marks, limits)
        else:
            reals = frame if frame.dtype in (np.float32, np.float64) else frame.astype(np.float64)
            rows = read_only(as_rows(reals, None))
            in_threads(_add_reals, len(rows), rows, before, totals, marks, limits)

    def template(self, exposure_s: float | None) -> Template:
        marks, shape = (self.saturated, self.black), self.first.shape
        if self.totals is None:
            return Template(self.first.astype(np.float32), None, 1, *marks, exposure_s)
        total, squares = self.totals
        mean, variance = (np.empty(total.shape, np.float32) for _ in range(2))
        if self.whole:
            in_threads(_finish, len(total), total, squares, self.count, mean, variance)
        else:
            mean[...] = total
            np.divide(squares, self.count - 1.0, out=variance, casting="same_kind")
        return Template(
            mean.reshape(shape), variance.reshape(shape), self.count, *marks, exposure_s
        )


# Rows are independent, so the bytes do not depend on the threads.


@njit(cache=True)
def _add_codes(start, stop, frame, totals, marks, limits):  # type: ignore[no-untyped-def]
    """Add whole codes to Σx (uint32) and Σx² (uint64), both exact; mark those beyond (high, low)."""
    (total, squares), (saturated, black), (high, low) = totals, marks, limits
    for y in range(start, stop):
        for x in range(frame.shape[1]):
            code = np.uint64(frame[y, x])
            total[y, x] += np.uint32(code)
            squares[y, x] += code * code
            saturated[y, x] |= np.float32(frame[y, x]) >= high
            black[y, x] |= np.float32(frame[y, x]) <= low


@njit(cache=True)
def _add_reals(start, stop, frame, before, totals, marks, limits):  # type: ignore[no-untyped-def]
    """Update mean and Σ(x − mean)² by Welford's step; mark values beyond (high, low)."""
    (mean, spread), (saturated, black), (high, low) = totals, marks, limits
    for y in range(start, stop):
        for x in range(frame.shape[1]):
            value = np.float64(frame[y, x])
            step = value - mean[y, x]
            mean[y, x] += step / (before + 1)
            spread[y, x] += step * (value - mean[y, x])
            saturated[y, x] |= value >= high
            black[y, x] |= value <= low


@njit(cache=True)
def _finish(start, stop, total, squares, count, mean, variance):  # type: ignore[no-untyped-def]
    """Return mean and variance of one shot from exact sums of `count` shots."""
    freedom = count * (count - 1.0)
    for y in range(start, stop):
        for x in range(total.shape[1]):
            sums = np.uint64(total[y, x])
            mean[y, x] = np.float64(sums) / count
            variance[y, x] = np.float64(squares[y, x] * np.uint64(count) - sums * sums) / freedom


def as_rows(array: np.ndarray, kind: DTypeLike | None = np.float32) -> np.ndarray:
    """Return (h, w) or (h, w, b) as (h, w·b) of dtype `kind` (None: its own); a view if it can be."""
    return np.ascontiguousarray(array, kind).reshape(array.shape[0], -1)


def as_marks(mask: np.ndarray) -> np.ndarray:
    """Return a boolean mask as (h, w·b) bytes that share its memory."""
    return as_rows(mask, bool).view(np.uint8)


def read_only(array: np.ndarray) -> np.ndarray:
    """Return a view that cannot be written to, so that a kernel is compiled for one kind of arrays."""
    view = array.view()
    view.flags.writeable = False
    return view


def close_gaps(template: Template) -> Template:
    """Return a template without NaN and infinities, and with `lost` where they were.

    The median of the band is used there meanwhile, so that no statistic and no neighbour is poisoned; whoever uses the values has to
    flag `lost`. Raises CalibrationRefused, E_VALUE where a band has no finite value at all.

    >>> closed = close_gaps(average([np.array([[1.0, np.nan, 3.0]])]))
    >>> closed.mean.tolist(), closed.lost.tolist()
    ([[1.0, 2.0, 3.0]], [[False, True, False]])
    """
    arrays = [a for a in (template.mean, template.variance) if a is not None]
    if all(np.isfinite(np.sum(a)) for a in arrays):
        return template  # a sum takes no memory, and is finite only where all are
    lost = ~np.isfinite(template.mean)
    if template.variance is not None:
        lost |= ~np.isfinite(template.variance)
    mean = _filled(template.mean, lost)
    variance = None if template.variance is None else _filled(template.variance, lost)
    saturated, black = template.saturated & ~lost, template.black & ~lost
    return replace(
        template, mean=mean, variance=variance, saturated=saturated, black=black, lost=lost
    )


def as_absent(template: Template) -> Template:
    """Return a template whose lost values are nothing that was lost: the file says that it holds nothing there."""
    return replace(template, lost=None, absent=template.lost)


def gaps_of(*templates: Template | None) -> np.ndarray | None:
    """Return where any of some templates has no value, lost or absent; None where all have one.

    Shapes broadcast: a template one line high holds for every line.
    """
    there = [t for t in templates if t is not None]
    return union_of(*(mask for t in there for mask in (t.lost, t.absent)))


def union_of(*masks: np.ndarray | None) -> np.ndarray | None:
    """Return where any of some masks is true; None where there is none."""
    found: np.ndarray | None = None
    for mask in masks:
        if mask is not None:
            found = mask if found is None else found | mask
    return found


def _filled(values: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Return a copy with the median of each band where values are lost."""
    filled = values.copy()
    planes = filled[..., None] if filled.ndim == 2 else filled
    marks = lost[..., None] if lost.ndim == 2 else lost
    for band in range(planes.shape[2]):
        plane, defects = planes[..., band], marks[..., band]
        if defects.all():
            raise no_values(band, planes.shape)
        plane[defects] = np.median(plane[~defects])
    return filled


def no_values(band: int, shape: tuple[int, ...]) -> CalibrationRefused:
    """Return the refusal of a band, of frames (height, width, bands), without a finite value."""
    where = f" in band {band + 1} of the frames" if shape[2] > 1 else ""
    found = f"{shape[1]} x {shape[0]} values, each NaN or infinite in some frame"
    return refusal("no_values", where, found=found)
