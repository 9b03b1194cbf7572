"""Spatial frequency response of a slanted edge (the e-SFR of ISO 12233), and where its bands put the edge.

A straight edge that leans by a few degrees crosses the pixels at every phase. Sorted by their distance d from
the edge, the pixels of many rows give its edge spread function four times finer than they lie; the spectrum of
its derivative is the response [burns2000]_. It is divided by those of the central difference over 1/2 px and of
the mean over bins of 1/4 px, sinc(f/2)·sinc(f/4); ISO 12233 corrects the former alone. The window is Tukey's,
flat in its middle half: Hamming's would take 1 % off a response of σ = 1 px. The pixel's own aperture is part
of the response.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from levkas.core.problems import Problem, Refused

OVERSAMPLED = 4
"""Bins of the edge spread function a pixel."""
LEAST_ANGLE, MOST_ANGLE = 2.0, 30.0
"""Degrees between edge and rows or columns. ISO's charts lean by 5; nearer to 0 the phases are too few rows apart,
nearer to 45 whole rows fall on the same few phases, and neither axis is measured."""
LEAST_ROWS = 20
LEAST_SIDE, LEAST_WIDTHS = 6.0, 4.0
"""On either side of the edge: px, and standard deviations of its blur."""
LEAST_MODULATION = 0.2
"""(bright − dark)/(bright + dark); 1.5 to 1. ISO 12233 has 4 to 1."""
LEAST_STEP = 10.0
"""Bright − dark over the noise of a pixel."""
MOST_SATURATED = 0.001
MOST_ROUGH = 0.5
"""Px rms of single rows about the edge, beyond what their noise explains: no straight edge."""
PADDED = 4096
"""Samples of the spectrum: 1024 a cycle/px."""
HALF_SAMPLING = 0.5
"""Cycles/px."""


class EdgeRefused(Refused):
    """An edge whose response cannot be measured."""


@dataclass(frozen=True, eq=False)
class EdgeResponse:
    """Response of one band across one edge.

    Parameters
    ----------
    axis : {"x", "y"}
        Along which it is: that of a nearly upright edge is along x.
    angle_deg : float
        Between the edge and the columns (axis x) or the rows (axis y).
    position : float
        Mean of the edge along `axis` over the region, px in the region's own frame, times the cosine of its angle.
    response : ndarray, (1025,)
        Modulation at 0 … 1 cycles/px, normal to the edge; 1 at 0.
    """

    axis: str
    angle_deg: float
    position: float
    response: np.ndarray

    @property
    def frequencies(self) -> np.ndarray:
        """(1025,) cycles/px."""
        return np.arange(len(self.response)) * OVERSAMPLED / PADDED

    def frequency_at(self, modulation: float) -> float:
        """Return the lowest frequency, cycles/px, at which the response falls to a modulation; NaN above 1."""
        below = np.flatnonzero(self.response < modulation)
        if not below.size:
            return float("nan")
        i = int(below[0])
        high, low = self.response[i - 1], self.response[i]
        return float(self.frequencies[i] - (modulation - low) / (high - low) * self.frequencies[1])

    @property
    def sfr50(self) -> float:
        """Frequency of half modulation, cycles/px."""
        return self.frequency_at(0.5)

    @property
    def sfr10(self) -> float:
        """Frequency of a tenth of the modulation, cycles/px: the limiting resolution."""
        return self.frequency_at(0.1)

    @property
    def efficiency(self) -> float:
        """Sampling efficiency: `sfr10` over half the sampling frequency, 1 at most."""
        found = self.sfr10
        return 1.0 if np.isnan(found) else min(1.0, found / HALF_SAMPLING)

    @property
    def most(self) -> float:
        """Largest modulation up to half the sampling frequency: above 1 where the picture was sharpened."""
        return float(self.response[self.frequencies <= HALF_SAMPLING].max())


def measure_edge(
    plane: np.ndarray, saturated: np.ndarray | None = None, *, period: int = 1
) -> EdgeResponse:
    """Measure the response of one band across the one edge that a region shows.

    Parameters
    ----------
    plane : ndarray, (h, w)
        Linear values: reflectance, or counts above dark.
    saturated : ndarray of bool like `plane`, optional
    period : int
        Of the mosaic that the values were interpolated from: sensels of the band lie so many px apart.

    Examples
    --------
    An edge at 5 degrees behind a Gaussian of 0.8 px, whose response falls to half at 0.1874/0.8 cycles/px:

    >>> from scipy.special import ndtr
    >>> y, x = np.mgrid[:80, :60]
    >>> lean = np.deg2rad(5)
    >>> across = (x - 30) * np.cos(lean) - (y - 40) * np.sin(lean)
    >>> found = measure_edge(0.1 + 0.7 * ndtr(across / 0.8))
    >>> round(found.sfr50, 3), round(found.angle_deg, 2), found.axis
    (0.234, 5.0, 'x')
    """
    values = np.asarray(plane, np.float64)
    if not np.isfinite(values).all():
        raise _refused("E_EDGE_MISSING", "parts of the region were not measured", "NaN")
    if saturated is not None and (share := float(np.mean(saturated))) > MOST_SATURATED:
        found = f"{share:.1%} of the pixels"
        raise _refused("E_EDGE_SATURATED", "the edge's bright side saturates", found,
                       f"{MOST_SATURATED:.1%} at most", "Capture it with less exposure.")  # fmt: skip
    if min(values.shape) < 2 * LEAST_SIDE:
        raise _short(
            f"{values.shape[1]} x {values.shape[0]} px", f"{2 * LEAST_SIDE:g} px both ways"
        )
    steep = [abs(float(np.mean(np.diff(values, axis=i)))) for i in (1, 0)]
    # A slope of 1 gives as much along either axis of a square; of a rectangle it is by its sides.
    axis = "x" if steep[0] * values.shape[1] >= steep[1] * values.shape[0] else "y"
    values = values if axis == "x" else values.T
    left, right, noise = _sides(values)
    _check_contrast(left, right, noise)
    return _respond((values - left) / (right - left), axis, noise / abs(right - left), period)


def _sides(values: np.ndarray) -> tuple[float, float, float]:
    """Return the levels left and right, and the noise of a pixel there."""
    width = max(2, values.shape[1] // 8)
    left, right = values[:, :width], values[:, -width:]
    fine = np.concatenate([np.diff(side, axis=0).ravel() for side in (left, right)])
    noise = 1.4826 * float(np.median(np.abs(fine - np.median(fine)))) / np.sqrt(2)
    return float(np.median(left)), float(np.median(right)), noise


def _check_contrast(left: float, right: float, noise: float) -> None:
    step = abs(right - left)
    modulation = step / max(abs(right + left), 1e-12)
    if modulation < LEAST_MODULATION or step < LEAST_STEP * noise:
        found = f"modulation {modulation:.2f}, {step / max(noise, 1e-12):.0f} times the noise"
        raise _refused(
            "E_EDGE_CONTRAST", "the sides of the edge differ too little", found,
            f"modulation {LEAST_MODULATION:g}, {LEAST_STEP:g} times the noise",
            "Name an edge between white and dark grey or black.",
        )  # fmt: skip


def _respond(values: np.ndarray, axis: str, noise: float, period: int) -> EdgeResponse:
    """Return the response of a nearly upright edge that rises from 0 to 1."""
    rows, columns = values.shape
    y = np.arange(rows) - (rows - 1) / 2
    # The sum of a row gives where its edge lies.
    line = np.polyfit(y, columns - 0.5 - values.sum(1), 1)
    _check_angle(float(line[0]), least=0)  # shading is in it
    side = _room(line, y, columns)
    for reach, degree in ((side, 1), (side, 1), (side, 2)):
        line = np.polyfit(y, _centroids(values, np.polyval(line, y), reach), degree)
    width = _width(*_spread(values, line, y, side))
    near = float(np.clip(4 * width, 4, side))
    for _ in range(5):
        places = _centroids(values, np.polyval(line, y), near)
        line = np.polyfit(y, places, 2)
    slope = float(line[1])
    _check_angle(slope)
    side = _room(line, y, columns)
    rough = float(np.std(places - np.polyval(line, y)))
    if rough > MOST_ROUGH + 2 * noise * near**1.5:
        raise _refused("E_EDGE_MISSING", "no single straight edge runs through the region",
                       f"rows are off a smooth line by {rough:.1f} px rms", f"{MOST_ROUGH:g} px",
                       "Name a rectangle that one edge crosses from end to end.")  # fmt: skip
    if side < LEAST_WIDTHS * width:
        raise _short(
            f"{side:.0f} px beside an edge that is blurred by {width:.1f} px",
            f"{LEAST_WIDTHS * width:.0f} px on either side",
        )
    cycles = abs(slope) * rows / period
    if rows < LEAST_ROWS or cycles < 1:
        raise _short(f"{rows} px along it, in which it moves by {abs(slope) * rows:.1f} px",
                     f"{max(LEAST_ROWS, np.ceil(period / abs(slope))):.0f} px along it")  # fmt: skip
    kept = round(int(cycles) * period / abs(slope))  # whole phases, so that bins are filled alike
    reach = float(np.clip(8 * width, 10, side))
    places, spread = _spread(values[:kept], line, y[:kept], reach)
    position = float(np.polyval(line, y).mean()) / float(np.hypot(1, slope))
    angle = float(np.rad2deg(np.arctan(slope)))
    return EdgeResponse(axis, angle, position, _spectrum(spread, places))


def _room(line: np.ndarray, y: np.ndarray, columns: int) -> float:
    """Return the px on the narrower side of the edge."""
    at = np.polyval(line, y)
    side = float(min(at.min(), columns - 1 - at.max()))
    if side < LEAST_SIDE:
        raise _short(f"{max(side, 0):.0f} px beside the edge", f"{LEAST_SIDE:g} px on either side")
    return side


def _centroids(values: np.ndarray, near: np.ndarray, reach: float) -> np.ndarray:
    """Return where the slope of each row is centred, (rows,), within a Hann window of half-width `reach`."""
    slope = np.diff(values, axis=1)
    off = np.arange(slope.shape[1]) + 0.5 - near[:, None]
    weight = np.where(np.abs(off) < reach, 0.5 + 0.5 * np.cos(np.pi * off / reach), 0) * slope
    total = weight.sum(1)
    good = total > 0.2 * np.median(total)
    moved = np.divide((weight * off).sum(1), total, out=np.zeros(len(near)), where=good)
    return np.asarray(near + np.clip(moved, -reach, reach))


def _spread(
    values: np.ndarray, line: np.ndarray, y: np.ndarray, reach: float
) -> tuple[np.ndarray, np.ndarray]:
    """Return the edge spread function in bins of 1/4 px: their places, px normal to the edge, and values."""
    slope = np.polyval(np.polyder(line), 0.0)
    off = (np.arange(values.shape[1]) - np.polyval(line, y)[:, None]) / np.hypot(1, slope)
    half = int(reach * OVERSAMPLED / np.hypot(1, slope))
    bins = np.rint(off * OVERSAMPLED).astype(int) + half
    inside = (bins >= 0) & (bins <= 2 * half)
    count = np.bincount(bins[inside], minlength=2 * half + 1)
    if not count.all():
        raise _refused("E_EDGE_ANGLE", "rows of the edge repeat the same few phases",
                       f"{np.count_nonzero(count == 0)} of {len(count)} quarters of a pixel without a sample",
                       "every quarter of a pixel sampled", "Turn the edge to about 5 degrees, or name a longer one.")  # fmt: skip
    level, at = (
        np.bincount(bins[inside], part[inside], minlength=2 * half + 1) / count
        for part in (values, off)
    )
    places = (np.arange(2 * half + 1) - half) / OVERSAMPLED
    return places, np.interp(places, at, level)  # samples are not centred in every bin


def _width(places: np.ndarray, spread: np.ndarray) -> float:
    """Return the standard deviation, px, of a Gaussian with the spread's distance from 10 to 90 %."""
    if spread.max() <= 0.9:
        raise _refused(
            "E_EDGE_MISSING", "no edge runs through the region", "no step between its sides"
        )
    low, high = (places[np.argmax(spread > level)] for level in (0.1, 0.9))
    return max(float(high - low) / 2.563, 0.3)


def _spectrum(spread: np.ndarray, places: np.ndarray) -> np.ndarray:
    from scipy.signal.windows import tukey

    slope = np.gradient(spread)[1:-1]
    found = np.abs(np.fft.rfft(slope * tukey(len(slope), 0.5), PADDED))
    frequencies = np.arange(len(found)) * OVERSAMPLED / PADDED
    resolved = frequencies <= 1
    f = frequencies[resolved]
    return np.asarray(found[resolved] / found[0] / (np.sinc(f / 2) * np.sinc(f / 4)))


def _check_angle(slope: float, least: float = LEAST_ANGLE) -> None:
    angle = abs(float(np.rad2deg(np.arctan(slope))))
    if least <= angle <= MOST_ANGLE:
        return
    what = "hardly leans" if angle < LEAST_ANGLE else "leans too much, towards 45 degrees"
    raise _refused("E_EDGE_ANGLE", f"the edge {what}", f"{angle:.1f} degrees from the pixels' rows or columns",
                   f"{LEAST_ANGLE:g} to {MOST_ANGLE:g} degrees", "Turn the target by about 5 degrees.")  # fmt: skip


def _short(found: str, expected: str) -> EdgeRefused:
    return _refused("E_EDGE_SHORT", "the region is too small for its edge", found, expected,
                    "Name a larger rectangle, or capture the target from nearer.")  # fmt: skip


def _refused(code: str, message: str, found: str, expected: str = "", fix: str = "") -> EdgeRefused:
    return EdgeRefused(
        Problem(code, message, found=found, expected=expected or None, fix=fix or None)
    )
