"""Displacement finer than a check window, in frames as well as scanners: a patch that moved, a ripple, a surface that heaved.

Check windows of 40 px average over it, or are not found where they hold two displacements. Here windows of 18 px are shifted against
the picture that the reference predicts (`local_shifts`). A shift is no evidence by itself: unlike pigments feign one.
A displacement is there where the shift leaves a small residual, so that it is large beside its own standard deviation, which rests
on that residual. A window that is badly explained is begun 2 px aside, too, and lies there where this
halves the residual.

Two statistics are formed. The mean square of all shifts, less the variance of each, is that of a displacement everywhere. The scan statistic
([kulldorff1997]_) is the largest mean shift of 3 x 3 windows that move alike and that explains them: relief in raking light looks
displaced, and is explained neither where it is nor where it seems to come from.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.registration.local_shifts import Predictor, WindowShifts, detail_on_grid
from levkas.registration.verification import Box, predict

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform


@dataclass(frozen=True)
class FineSettings:
    """Constants of the measurement; px are those of the compared grid.

    Parameters
    ----------
    cell : int, px
        A window has three a side: 18 px. Of 12 px few windows show enough, of 24 px a patch of 44 px holds few.
    sigma : float, px
        Standard deviation of either axis up to which a window counts.
    floor : float, px
        What is added to it in weights: sharp windows alone do not stand for a picture.
    aside, poor, gain : float
        Where windows that are badly explained are begun, px; how much larger than the median their residual is; by how much
        it falls where they lie there.
    least_windows, least_share : int, float
        That have to count, in number and as a share of those both pictures show, for a mean square.
    above_noise : float
        Mean square over the mean variance of windows from which it is none of theirs.
    least_rms : float, px
        From which on its root is part of sigma: 180 pairs that agree have 0.07 at most.
    around, least_around : int
        Windows of a mean, a side; how many have to count.
    smooth : int
        Windows, a side, of the mean that check windows show, which is taken out: 90 px.
    alike : float
        Share of the shifts, squared in their deviations, that the mean of windows explains where they move alike.
    deviations : float
        Of that mean: chance, over some thousand places, has 5 at most.
    explained, better : float
        How much larger than the usual one the residual of windows that are moved back may be; or by how much it has to fall. Patches
        that moved have 3.4 at most, or 1.4 at least; relief in gold by another light 5 and 1.0.
    longest, wave : float
        Period up to which a wave is finer than what check windows of 40 px show, px.
        Power of a wave over the mean of all, for its period to be named: the largest of a thousand by chance has seven.
    """

    cell: int = 6
    sigma: float = 0.25
    floor: float = 0.05
    aside: int = 2
    poor: float = 1.5
    gain: float = 1.5
    least_windows: int = 40
    least_rms: float = 0.1
    above_noise: float = 0.5
    least_share: float = 0.2
    around: int = 3
    least_around: int = 6
    smooth: int = 15
    alike: float = 0.7
    deviations: float = 6.0
    explained: float = 3.5
    better: float = 1.2
    wave: float = 20.0
    longest: float = 60.0


SETTINGS = FineSettings()


@dataclass(frozen=True)
class FineDisplacement:
    """Displacement that is finer than a check window.

    Parameters
    ----------
    rms : float or None, reference px
        Root mean square over the picture without these windows, noise allowed for; None where too few show enough.
    shown : float, 0..1
        Share of the windows that show enough.
    size : float, reference px
        Largest displacement of some windows that move alike, beside all around; 0 where none do.
    box : (x, y, width, height), reference px, or None
        About these.
    least : float or None, reference px
        Smallest displacement of some windows that would be found, the median over the picture.
    period : (float, float) or None, reference px
        In x and in y, of a wave that stands out; infinite where it does not change that way.
    step : int, reference px
        Of the grid on which it was measured.
    """

    rms: float | None
    shown: float
    size: float
    box: Box | None
    least: float | None
    period: tuple[float, float] | None
    step: int = 1

    @property
    def sigma(self) -> float:
        """Standard deviation, of each axis, that it adds to where a place lies, reference px; 0 where it is not above chance."""
        rms = self.rms or 0.0
        return rms / 2**0.5 if rms > SETTINGS.least_rms * self.step else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, JSON-ready."""

        def rounded(value: float | None) -> float | None:
            return None if value is None or not np.isfinite(value) else round(float(value), 3)

        return {
            "rms_px": rounded(self.rms),
            "shown": round(self.shown, 4),
            "size_px": round(self.size, 3),
            "box": self.box and [round(v, 1) for v in self.box],
            "least_px": rounded(self.least),
            "period_px": self.period and [rounded(v) for v in self.period],
            "sigma_px": round(self.sigma, 4),
            "step": self.step,
        }


def measure_fine_displacement(
    predictors: np.ndarray, image: np.ndarray, transform: Transform, *, step: int = 1
) -> FineDisplacement | None:
    """Measure by how much small windows of a band lie beside the map.

    Parameters
    ----------
    predictors : ndarray, (k, h, w), float32
        Images of the reference on a grid of `step` reference px, high-passed; NaN where invalid.
    image : ndarray, (H, W), float32
        The band in native px; NaN where invalid.
    transform : Transform
        Reference px → native px.
    step : int, reference px

    Returns
    -------
    found : FineDisplacement or None
        None where the pictures are too small or show nothing in common.
    """
    shape = (predictors.shape[1], predictors.shape[2])
    if min(shape) < SETTINGS.cell * SETTINGS.around:
        return None
    image = detail_on_grid(image, transform, shape, step=step)
    predictor = Predictor(predict(predictors, image)[None], cell=SETTINGS.cell)
    shifts = _shift_windows(predictor, image)
    lattice = tuple(n // SETTINGS.cell for n in shape)
    shift = shifts.shift.reshape(*lattice, 2)
    information = shifts.information.reshape(*lattice, 2, 2)
    known = np.trace(information, axis1=2, axis2=3) > 0
    if not known.any():
        return None
    variance = _variance(information)
    counts = variance < 2 * SETTINGS.sigma**2
    weight = np.where(counts, 1 / (variance + SETTINGS.floor**2), 0.0)
    shift = shift - _smooth(shift, weight)
    found = _scan(shift, np.where(counts[..., None, None], information, 0.0))
    size, part = _largest_explained(found, 1 - shifts.r2.reshape(lattice), predictor, image)
    rms, period = None, None
    shown = float(counts.sum() / known.sum())
    if counts.sum() >= SETTINGS.least_windows and shown >= SETTINGS.least_share:
        others = counts & ~part
        rms = _rms(shift[others], variance[others], weight[others]) * step
        period = _period(shift, others, step)
    box, least = _box_about(part, SETTINGS.cell * step), found.least and found.least * step
    return FineDisplacement(rms, shown, size * step, box, least, period, step)


def _box_about(part: np.ndarray, side: int) -> Box | None:
    """Return the rectangle about windows, (rows, columns) bool, each `side` reference px from the next; None without any."""
    if not part.any():
        return None
    rows, columns = (np.flatnonzero(part.any(axis)) for axis in (1, 0))
    x, y = float(columns[0]) * side, float(rows[0]) * side
    return x, y, float(np.ptp(columns) + 1) * side, float(np.ptp(rows) + 1) * side


def _shift_windows(predictor: Predictor, image: np.ndarray) -> WindowShifts:
    """Return the shifts of windows, of those that are badly explained from where they are explained best."""
    found = predictor.compare(image)
    known = np.trace(found.information, axis1=1, axis2=2) > 0
    if not known.any():
        return found
    rest = 1 - found.r2
    poor = known & (rest > SETTINGS.poor * np.median(rest[known]))
    poor &= _around(poor, image.shape) >= SETTINGS.least_around
    among = np.where(_grown(poor, image.shape), image, np.float32(np.nan))
    shift, information, best = found.shift.copy(), found.information.copy(), rest / SETTINGS.gain
    reach = (-SETTINGS.aside, 0, SETTINGS.aside)
    for dx, dy in product(reach, reach):
        if (dx, dy) == (0, 0) or not poor.any():
            continue
        other = predictor.compare(_moved(among, dx, dy))
        better = poor & (1 - other.r2 < best) & (np.abs(other.shift).max(1) < SETTINGS.aside)
        better &= np.trace(other.information, axis1=1, axis2=2) > 0
        shift[better] = other.shift[better] + (-dx, -dy)
        information[better], best[better] = other.information[better], 1 - other.r2[better]
    return replace(found, shift=shift, information=information)


def _around(windows: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return how many windows, (n,) bool in the order of the lattice, there are about each, (n,)."""
    from scipy import ndimage

    lattice = windows.reshape([n // SETTINGS.cell for n in shape]).astype(int)
    box = np.ones((SETTINGS.around, SETTINGS.around), int)
    return np.asarray(ndimage.convolve(lattice, box, mode="constant").ravel())


def _grown(poor: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the px, `shape`, of windows, (n,) bool in the order of the lattice, and some around them."""
    from scipy import ndimage

    rows, columns = (n // SETTINGS.cell for n in shape)
    return _in_px(ndimage.binary_dilation(poor.reshape(rows, columns), np.ones((5, 5))), shape)


def _in_px(windows: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return the value of its window, (rows, columns), for every px of `shape`."""
    px = windows.repeat(SETTINGS.cell, 0).repeat(SETTINGS.cell, 1)
    return np.pad(px, [(0, n - m) for n, m in zip(shape, px.shape, strict=True)], mode="edge")


def _moved(image: np.ndarray, dx: int, dy: int) -> np.ndarray:
    """Return `image` shifted by (dx, dy) px; NaN beyond it."""
    height, width = image.shape
    out = np.full_like(image, np.nan)
    here, there = (
        tuple(slice(max(0, sign * d), n + min(0, sign * d)) for d, n in ((dy, height), (dx, width)))
        for sign in (-1, 1)
    )
    out[here] = image[there]
    return out


def _smooth(shift: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Return the course of shifts that check windows show, (rows, columns, 2): the mean about each, of what does not stray from it."""
    from scipy import ndimage

    course, weight = np.zeros_like(shift), weight[..., None]
    for _ in range(3):
        apart = np.square(shift - course).sum(-1, keepdims=True)
        w = weight / (1 + apart / SETTINGS.sigma**2)
        sums = (
            ndimage.uniform_filter(v, (SETTINGS.smooth, SETTINGS.smooth, 1)) for v in (w * shift, w)
        )
        total, known = sums
        course = total / np.maximum(known, 1e-9)
    return course


def _variance(information: np.ndarray) -> np.ndarray:
    """Return the variance of a shift, of both axes together; infinite where nothing is known."""
    determinant = np.linalg.det(information)
    trace = np.trace(information, axis1=-2, axis2=-1)
    return np.where((determinant > 0) & (trace > 0), trace / np.maximum(determinant, 1e-30), np.inf)


def _rms(shift: np.ndarray, variance: np.ndarray, weight: np.ndarray) -> float:
    """Return the root mean square of a displacement everywhere, of both axes, px; 0 where noise, which is known by some tenths, may be the cause."""
    found = float(np.average(np.square(shift).sum(-1) - variance, weights=weight))
    noise = float(np.average(variance, weights=weight))
    return float(np.sqrt(found)) if found > SETTINGS.above_noise * noise else 0.0


def _period(shift: np.ndarray, counts: np.ndarray, step: int) -> tuple[float, float] | None:
    """Return the period in x and in y, reference px, of the wave that stands out of all others; None where none does."""
    waves = np.fft.fft2(np.where(counts[..., None], shift, 0.0), axes=(0, 1))
    power = np.square(np.abs(waves)).sum(-1)
    y, x = (np.abs(np.fft.fftfreq(n)) / (SETTINGS.cell * step) for n in power.shape)
    power[np.hypot(y[:, None], x) * SETTINGS.longest * step < 1] = 0.0
    row, column = np.unravel_index(int(power.argmax()), power.shape)
    if power[row, column] < SETTINGS.wave * power.mean():
        return None
    # A wave that the picture shows once or less is none.
    least = [1.5 / (SETTINGS.cell * step * n) for n in power.shape]
    in_x, in_y = (
        float(1 / v) if v > a else np.inf for v, a in ((x[column], least[1]), (y[row], least[0]))
    )
    return in_x, in_y


@dataclass(frozen=True, eq=False)
class _Means:
    """Mean shifts of 3 x 3 windows.

    Parameters
    ----------
    mean : ndarray, (rows, columns, 2), px
    known, sure : ndarray, (rows, columns), bool
        Where enough of the windows count, and where they move alike, farther than by chance.
    least : float or None, px
        Smallest that would be sure, the median.
    """

    mean: np.ndarray
    known: np.ndarray
    sure: np.ndarray
    least: float | None


def _scan(shift: np.ndarray, information: np.ndarray) -> _Means:
    """Return the mean shift of the windows about each, (rows, columns, 2), weighted by their information."""
    weighted = np.einsum("...ij,...j", information, shift)
    squares = _sum(np.einsum("...i,...i", shift, weighted))
    total, moment = _sum(information), _sum(weighted)
    count = _sum((np.trace(information, axis1=2, axis2=3) > 0).astype(float))
    # Windows overlap, three cells wide: so many of them are independent.
    n = SETTINGS.around
    variance = _variance(total) * n * n / ((n + 2) / 3) ** 2
    known = (count > SETTINGS.least_around - 0.5) & np.isfinite(variance)
    if not known.any():
        return _Means(np.zeros_like(shift), known, known, None)
    inverse = np.linalg.inv(np.where(known[..., None, None], total, np.eye(2)))
    mean = np.where(known[..., None], np.einsum("...ij,...j", inverse, moment), 0.0)
    explained = np.einsum("...i,...i", mean, moment)
    sure = known & (explained > SETTINGS.alike * squares)
    sure &= np.hypot(*np.moveaxis(mean, -1, 0)) > SETTINGS.deviations * np.sqrt(variance / 2)
    least = SETTINGS.deviations * float(np.sqrt(np.median(variance[known]) / 2))
    return _Means(mean, known, sure, least)


def _sum(values: np.ndarray) -> np.ndarray:
    """Return the sum over 3 x 3 windows, (rows, columns, ...)."""
    from scipy import ndimage

    n = SETTINGS.around
    size = (n, n) + (1,) * (values.ndim - 2)
    return np.asarray(ndimage.uniform_filter(values, size, mode="constant")) * n * n


def _largest_explained(
    found: _Means, here: np.ndarray, predictor: Predictor, image: np.ndarray
) -> tuple[float, np.ndarray]:
    """Return the largest displacement of windows that move alike, px, and these windows, (rows, columns) bool.

    `here` is what is not explained of each window as it lies. Moved back, the picture must be explained there about as well as elsewhere, or better than before. Relief in gold moves in raking
    light without being displaced: it is explained neither here nor there.
    """
    none = np.zeros_like(found.sure)
    if not found.sure.any():
        return 0.0, none
    length = np.where(found.sure, np.hypot(*np.moveaxis(found.mean, -1, 0)), 0.0)
    there = (1 - predictor.compare(_moved_back(image, found)).r2).reshape(none.shape)
    usual = np.median(here[found.known])
    while size := float(length.max()):
        part = _part_of(found, np.unravel_index(int(length.argmax()), length.shape))
        before, after = here[part].mean(), there[part].mean()
        if after < SETTINGS.explained * usual or after < before / SETTINGS.better:
            return size, part
        length[part] = 0.0
    return 0.0, none


def _moved_back(image: np.ndarray, found: _Means) -> np.ndarray:
    """Return `image` with the windows that are sure to be displaced where the map has them; NaN beyond it."""
    import cv2

    at = (np.arange(n, dtype=float) for n in image.shape)
    y, x = np.meshgrid(*at, indexing="ij")
    shift = np.where(found.sure[..., None], found.mean, 0.0)
    x, y = ((v - _in_px(shift[..., k], image.shape)).astype("f4") for k, v in enumerate((x, y)))
    nothing = float("nan")
    back = cv2.remap(image, x, y, cv2.INTER_CUBIC, None, cv2.BORDER_CONSTANT, nothing)
    return np.asarray(back)


def _part_of(found: _Means, place: tuple[np.intp, ...]) -> np.ndarray:
    """Return the windows about one that go the same way, sure or not, (rows, columns) bool."""
    from scipy import ndimage

    way = found.mean[place]
    parts, _ = ndimage.label(found.known & (found.mean @ way > way @ way / 2))
    return np.asarray(parts == parts[place])
