"""Templates: many shots of one scene averaged into one, a shot at a time.

mean = Σx / n,  variance of one shot = (Σx² − (Σx)²/n) / (n − 1). For 8- and 16-bit codes both
sums are whole numbers, so the result does not depend on the order of the shots or on threads.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import DTypeLike

from levkas.calibration.findings import CalibrationRefused
from levkas.core.problems import Problem
from levkas.core.threads import in_threads

if TYPE_CHECKING:
    from collections.abc import Iterable

MANY_PIXELS = 200_000  # of a frame whose median is asked for
MOST_SHOTS = 65536  # beyond this n² · 65535² no longer fits 64 bits


class DarkFit(NamedTuple):
    """How a clipped dark was fitted.

    Parameters
    ----------
    variance : ndarray like the dark's mean, float32
        Of the mean about each sensel's own level, counts².
    blacks : tuple of float, counts
        Of each phase of a mosaic, or band of a cube; one of all where bands are many.
    noise : float, counts
        Standard deviation of one shot, rounding not included; of a single shot also from sensel to sensel.
    zeros : float
        Share of pixels at 0.
    """

    variance: np.ndarray
    blacks: tuple[float, ...]
    noise: float
    zeros: float


@dataclass(frozen=True, eq=False)
class ShotLevels:
    """How bright each shot of a stack is, channel by channel: a channel is a phase of the mosaic, and a band of it.

    Parameters
    ----------
    levels : ndarray, (shots, channels)
        Light of each shot over the mean of all; of darks the counts by which each lies above the mean.
    error : ndarray, (channels,)
        Standard deviation that noise alone gives to a level; infinite where the stack has no light.
    times_s : tuple of float, optional
        When each shot was captured, s from any origin; None where its file does not state it.
    differing : tuple of int
        Of a white: shots that show something else than most of the stack.
    apart : float
        Of a white: largest relative deviation of a part of a shot from the others, 0 where none stands out of noise.
    unlike : tuple of (index, what, by how much)
        Of an object: shots that differ from the first by more than noise and lamp, as `sight.difference_between` has it.
    """

    levels: np.ndarray
    error: np.ndarray
    times_s: tuple[float, ...] | None = None
    differing: tuple[int, ...] = ()
    apart: float = 0.0
    unlike: tuple[tuple[int, str, float], ...] = ()


@dataclass(frozen=True)
class Template:
    """The average of some shots, with what each of them did.

    Parameters
    ----------
    mean : ndarray, (h, w) or (h, w, b), float32
        Counts.
    variance : ndarray like `mean`, float32, or None
        Variance of *one* shot over time, counts²; None where there is only one.
    count : int
        Number of shots.
    saturated, black : ndarray like `mean`, bool
        Whether any single shot was saturated, or clipped at black, there.
    lost : ndarray like `mean`, bool, optional
        Where a shot was no finite number and `close_gaps` put another value. None: nowhere.
    absent : ndarray like `mean`, bool, optional
        The same where the file says that it holds nothing there. None: nowhere.
    above_dark : bool
        Whether `mean` is above dark: dark or black level were subtracted, and `darks.dark_under` gives
        zero for it.
    band_times_s : tuple of float, optional
        Exposure of every band, where a scan has one of its own each; `exposure_s` is None then.
    fit : DarkFit, optional
        Of a dark that was clipped at black: `mean` is what `clipped_darks.unclip` makes of it.
    shots : ShotLevels, optional
        How bright each shot is; None where nobody measured it.

    Examples
    --------
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
    """Return some bands of a template, all of one exposure, as a template of that exposure."""
    times, variance, lost = template.band_times_s, template.variance, template.lost
    fit = template.fit
    shots = template.shots
    if shots is not None:
        shots = replace(shots, levels=shots.levels[:, bands], error=shots.error[bands])
    lost, absent = template.lost, template.absent
    return replace(
        template,
        mean=template.mean[..., bands],
        variance=None if variance is None else variance[..., bands],
        saturated=template.saturated[..., bands],
        black=template.black[..., bands],
        lost=None if lost is None else lost[..., bands],
        absent=None if absent is None else absent[..., bands],
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
    """Average shots of one scene; only one of them is held at a time.

    Parameters
    ----------
    frames : iterable of ndarray, all (h, w) or all (h, w, b), of one real dtype
        Raw codes. Read once, in order; never changed.
    saturation : float, optional
        A code at or above it is saturated. None: nothing is.
    black_clip : float, optional
        A code at or below it is clipped at black. None: nothing is.
    exposure_s : float, optional
        Of every shot; kept with the template.

    Returns
    -------
    template : Template
        Saturation is judged shot by shot in raw codes: the mean of five shots of which one is
        clipped lies below saturation and is wrong all the same.

    Raises
    ------
    CalibrationRefused
        E_NO_FRAMES without a frame; E_SIZE, E_VALUE where shapes or dtypes differ (by index).
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
        raise CalibrationRefused(
            Problem("E_NO_FRAMES", "there are no frames to average", found=0, expected="1 or more")
        )
    return sums.template(exposure_s)


def single_shot(
    codes: np.ndarray, *, saturation: float | None = None, black_clip: float | None = 0.0
) -> Template:
    """Return what `average` gives of one shot, whose memory is not held on to.

    >>> single_shot(np.array([[0, 7, 9]], np.uint16), saturation=9.0).saturated.tolist()
    [[False, False, True]]
    """
    saturated = codes >= (np.inf if saturation is None else saturation)
    clipped = codes <= (-np.inf if black_clip is None else black_clip)
    return Template(codes.astype(np.float32), None, 1, saturated, clipped)


class _Sums:
    """Running sums over shots, begun by the second, so that a single shot costs no more."""

    def __init__(self, first: np.ndarray, high: float, low: float) -> None:
        if first.dtype.kind not in "uif" or first.ndim not in (2, 3) or first.size == 0:
            raise CalibrationRefused(
                Problem(
                    "E_VALUE",
                    "a frame is not a real array (h, w) or (h, w, b)",
                    found=f"{first.dtype} {first.shape}",
                )
            )
        # A copy: a reader may hand out the same buffer again for the next shot.
        self.first, self.high, self.low, self.count = first.copy(), high, low, 1
        self.saturated, self.black = self.first >= high, self.first <= low
        self.whole = first.dtype in (np.uint8, np.uint16)
        self.totals: tuple[np.ndarray, np.ndarray] | None = None

    def check(self, frame: np.ndarray, index: int) -> None:
        if frame.shape != self.first.shape or frame.dtype != self.first.dtype:
            raise CalibrationRefused(
                Problem(
                    "E_SIZE" if frame.shape != self.first.shape else "E_VALUE",
                    f"shot {index} differs from shot 0 in size or type",
                    found=f"{frame.shape} {frame.dtype}",
                    expected=f"{self.first.shape} {self.first.dtype}",
                    fix="Average shots of one sensor and one mode only.",
                )
            )
        if self.whole and index >= MOST_SHOTS:
            raise CalibrationRefused(
                Problem("E_VALUE", "too many shots", found=index + 1, expected=f"≤ {MOST_SHOTS}")
            )

    def add(self, frame: np.ndarray) -> None:
        if self.totals is None:
            shape = as_rows(self.first, None).shape
            kinds = (np.uint32, np.uint64) if self.whole else (np.float64, np.float64)
            self.totals = (np.zeros(shape, kinds[0]), np.zeros(shape, kinds[1]))
            self._sum(self.first, 0, self.totals)
        self._sum(frame, self.count, self.totals)
        self.count += 1

    def _sum(self, frame: np.ndarray, before: int, totals: tuple[np.ndarray, np.ndarray]) -> None:
        from levkas.calibration import templates_kernel

        marks = (as_marks(self.saturated), as_marks(self.black))
        limits = (float(self.high), float(self.low))
        if self.whole:
            rows = read_only(as_rows(frame, None))
            in_threads(templates_kernel.add_codes, len(rows), rows, totals, marks, limits)
        else:
            reals = frame if frame.dtype in (np.float32, np.float64) else frame.astype(np.float64)
            rows = read_only(as_rows(reals, None))
            in_threads(templates_kernel.add_reals, len(rows), rows, before, totals, marks, limits)

    def template(self, exposure_s: float | None) -> Template:
        from levkas.calibration import templates_kernel

        if self.totals is None:
            mean = self.first.astype(np.float32)
            return Template(mean, None, 1, self.saturated, self.black, exposure_s)
        finish = templates_kernel.finish_codes if self.whole else templates_kernel.finish_reals
        mean, variance = (a.reshape(self.first.shape) for a in finish(*self.totals, self.count))
        return Template(mean, variance, self.count, self.saturated, self.black, exposure_s)


def as_rows(array: np.ndarray, kind: DTypeLike | None = np.float32) -> np.ndarray:
    """Return (h, w) or (h, w, b) as (h, w·b) of dtype `kind` (None: its own); a view if it can be.

    >>> as_rows(np.zeros((2, 3, 4))).shape
    (2, 12)
    """
    return np.ascontiguousarray(array, kind).reshape(array.shape[0], -1)


def as_marks(mask: np.ndarray) -> np.ndarray:
    """Return a boolean mask as (h, w·b) bytes that share its memory.

    >>> as_marks(np.array([[True, False]])).tolist()
    [[1, 0]]
    """
    return as_rows(mask, bool).view(np.uint8)


def read_only(array: np.ndarray) -> np.ndarray:
    """Return a view that cannot be written to, so that a kernel is compiled for one kind of arrays."""
    view = array.view()
    view.flags.writeable = False
    return view


def close_gaps(template: Template) -> Template:
    """Return a template without NaN and infinities, and with `lost` where they were.

    The median of the band is used there meanwhile, so that no statistic and no neighbour is poisoned;
    whoever uses the values has to flag `lost`.

    Parameters
    ----------
    template : Template, (h, w) or (h, w, b)
        A value that is not finite in any of its shots is not finite in its mean.

    Raises
    ------
    CalibrationRefused
        E_VALUE where a band has no finite value at all.

    Examples
    --------
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
    return replace(
        template,
        mean=mean,
        variance=variance,
        saturated=template.saturated & ~lost,
        black=template.black & ~lost,
        lost=lost,
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
    several = shape[2] > 1
    return CalibrationRefused(
        Problem(
            "E_VALUE",
            f"band {band + 1} of the frames has no finite value"
            if several
            else "no value is finite",
            field="pixels",
            found=f"{shape[1]} x {shape[0]} values, each NaN or infinite in some frame",
            expected="finite numbers",
            fix="Export the frame again, or remove it from `files`.",
        )
    )
