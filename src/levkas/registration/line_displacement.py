"""Displacement of single lines: what is finer than a check window and moves whole lines of one picture.

A push-broom scanner exposes a line at once: where its stage wobbles, stands still for some lines or loses them, each line
as a whole lies elsewhere than its neighbours. The same holds for interlaced halves, a rolling shutter and the
columns of a scanner on its side. Windows of 40 px average over that. Here each line is registered by itself: its
displacement (dx, dy) against the picture that the other camera predicts is a least-squares step along the line
(Lucas-Kanade, [baker2004]_), with a gain of its own, so that lamp and contrast do not move it.

Each line is cut into four parts that are registered separately. What the line as a whole does, all parts do; what
noise, relief, a ledge or unlike pigments do, they do independently. The covariance of the parts along the scan is therefore
the variance of the common displacement, free of noise, and the same covariance of the *differences* of parts, shifted against one another along
the scan, is what chance makes of it: a permutation null as in `verification`. It holds where parts are independent. Of a
chart, whose edges run through all of them, no displacement across the lines is measured.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from levkas.core.threads import each, in_threads
from levkas.geometry.transforms import Affine, Composed, Inverse, Polynomial
from levkas.registration.line_course import LineShifts, find_displacement
from levkas.registration.line_displacement_kernel import register_rows
from levkas.registration.local_shifts import detail_on_grid, highpass_rows, smoothing_warp
from levkas.registration.verification import predict

if TYPE_CHECKING:
    from levkas.geometry.transforms import Transform

Lines = Literal["rows", "columns"]


@dataclass(frozen=True)
class LineSettings:
    """Constants of the measurement."""

    ends: tuple[float, ...] = (0, 1 / 8, 1 / 2, 7 / 8, 1)
    """Where the parts of a line begin and end, as shares of what it shows. The outer ones are as narrow as the border of an
    icon: a ledge within it displaces the others alone."""
    least_samples: int = 16
    most_samples: int = 200
    """`least_samples`, `most_samples`: in px: of a part: fewer determine nothing, and of more the middle is used, which
    gives 0.03 to 0.1 px."""
    rounds: int = 5
    """Gauss-Newton steps, each of 1 px at most; two or three suffice for 1 px, four for 3 px."""
    prior: float = 2.0
    most: float = 6.0
    """`prior`, `most`: in px: standard deviation of displacements before any measurement, which holds lines without detail;
    beyond `most` a line is lost."""
    scales: tuple[float, float] = (0.05, 20.0)
    """Native px per reference px of maps that are looked at."""
    nodes: int = 24
    """A side, by which a map is made a cubic."""
    most_drawn: int = 1000
    """Lines whose displacement a record lists."""


SETTINGS = LineSettings()


@dataclass(frozen=True)
class LineDisplacement:
    """Displacement of the lines of one picture against one another, beside what another picture predicts."""

    lines: Lines
    """What a line is in its native px."""
    count: int
    """Lines that could be registered."""
    deviations: float
    """Covariance of the parts of lines, in standard deviations by chance."""
    along: float
    across: float
    """`along`, `across`: in reference px: root mean square of the common displacement along the lines and across them."""
    largest: float
    """In reference px: of a single line, once noise is allowed for."""
    noise: float
    """In reference px: standard deviation with which one line is measured."""
    displaced: bool
    """Whether lines are displaced beyond chance."""
    displacement: np.ndarray
    """(n, 2), reference px. Of every line as measured, along and across; NaN where unknown."""
    common_edges: bool = False
    """Whether all parts show their detail in the same lines, so that nothing is known across them."""
    step: int = 1
    """In reference px: of the grid on which it was measured."""
    slope: bool = False
    """Whether lines turn (across) or stretch (along) about their middles; sizes and `displacement` are those of their ends."""
    parts: LineShifts | None = None
    """Of displaced lines of the target, beside the smooth map nearest to its map."""
    of_ends: tuple[bool, ...] = ()
    """Whether lines are displaced beyond chance as a whole (False), turn or stretch about their middles (True), or both."""

    @property
    def rms(self) -> float:
        """Root mean square of the common displacement, reference px."""
        return float(np.hypot(self.along, self.across))

    @property
    def sigma(self) -> float:
        """Standard deviation, of each axis, that it adds to where a place lies, reference px; 0 where lines are not displaced."""
        return self.rms / 2**0.5 if self.displaced else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, JSON-ready, without the displacement of every line."""
        return {
            "lines": self.lines,
            "count": self.count,
            "displaced": self.displaced,
            "deviations": round(self.deviations, 2),
            "rms_px": round(self.rms, 4),
            "along_px": round(self.along, 4),
            "across_px": round(self.across, 4),
            "largest_px": round(self.largest, 4),
            "noise_px": round(self.noise, 4),
            "sigma_px": round(self.sigma, 4),
            "slope": self.slope,
            "common_edges": self.common_edges,
            "step": self.step,
        }

    def drawn(self) -> dict[str, Any] | None:
        """Return the displacement of the middle lines for a figure, JSON-ready; None where lines are not displaced."""
        if not self.displaced:
            return None
        start = max(0, (len(self.displacement) - SETTINGS.most_drawn) // 2)
        shown = np.round(self.displacement[start : start + SETTINGS.most_drawn], 3)
        along, across = (
            [None if np.isnan(v) else v for v in column] for column in shown.T.tolist()
        )
        return {"lines": self.lines, "first": start, "along": along, "across": across}


def measure_line_displacement(
    predictors: np.ndarray, image: np.ndarray, transform: Transform, *, step: int = 1
) -> LineDisplacement | None:
    """Measure by how much single lines of a band are displaced against one another.

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
    found : LineDisplacement or None
        Of rows and columns those that are displaced most beyond chance; None where too few lines of either show enough.
    """
    size = (predictors.shape[1], predictors.shape[2])
    change = transform.jacobian((np.array([[size[1], size[0]]]) * step - 1) / 2)[0]
    if (
        not np.isfinite(change).all()
        or not SETTINGS.scales[0] < abs(np.linalg.det(change)) ** 0.5 < SETTINGS.scales[1]
    ):
        return None
    native = np.linalg.norm(np.linalg.inv(change), axis=0)
    predicted = predict(predictors, detail_on_grid(image, transform, size, step=step))
    to_grid = Composed(Inverse(transform), Affine.scaling(1 / step))
    scene = smoothing_warp(predicted, to_grid, (image.shape[0], image.shape[1]))

    def measured(lines: Lines) -> LineDisplacement | None:
        one, other, sizes = image, scene, native
        if lines == "columns":
            one, other, sizes = one.T, other.T, sizes[::-1]
        shifts = _register_lines(one, other)
        return None if shifts is None else replace(_describe(shifts, sizes), lines=lines, step=step)

    found = [one for one in each(measured, LINES) if one]
    if not found:
        return None
    best = max(found, key=_deviations)
    smooth = _cubic(transform, size, step) if best.displaced else None
    return replace(best, parts=None if smooth is None else _beside_smooth(best, transform, smooth))


LINES: tuple[Lines, ...] = ("rows", "columns")


def _deviations(found: LineDisplacement) -> tuple[bool, float]:
    return found.displaced, found.deviations


def _cubic(transform: Transform, shape: Sequence[int], step: int) -> Transform | None:
    """Return the cubic polynomial nearest to a map, which follows no line; None where the map has no value."""
    x, y = (np.linspace(0, n * step - 1, SETTINGS.nodes) for n in (shape[1], shape[0]))
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    mapped = transform(points)
    return Polynomial.fit(points, mapped, order=3) if np.isfinite(mapped).all() else None


def _beside_smooth(
    found: LineDisplacement, transform: Transform, smooth: Transform
) -> LineShifts | None:
    """Return the shifts of parts of lines beside a smooth map: those beside `transform`, and what that follows of the lines."""
    shifts = found.parts
    assert shifts is not None
    low, high = shifts.ends
    middles = (shifts.places * (high - low) + low + high) / 2
    along, number = np.meshgrid(middles, np.arange(len(shifts.shift), dtype=float))
    order = 1 if found.lines == "rows" else -1
    places = np.stack([along.ravel(), number.ravel()], 1)[:, ::order]
    with np.errstate(all="ignore"):
        apart = (smooth(transform.inverse(places)) - places)[:, ::order].reshape(shifts.shift.shape)
    known = np.isfinite(apart).all(-1, keepdims=True)
    total = np.where(known, shifts.shift + np.nan_to_num(apart), 0.0)
    information = np.where(known, shifts.information, 0.0)
    return LineShifts.of(total, information, middles, shifts.ends)


def describe_displacement(numbers: Mapping[str, Any]) -> str:
    """Return what `LineDisplacement.to_dict` says of displaced lines, in words.

    Examples
    --------
    >>> describe_displacement({"lines": "rows", "rms_px": 0.85, "largest_px": 0.94})
    'The lines are displaced against one another: 0.85 px (root mean square), 0.94 px at most.'
    """
    line = "line" if numbers["lines"] == "rows" else "column"
    return (
        f"The {line}s are displaced against one another: {numbers['rms_px']:.2f} px (root mean square), "
        f"{numbers['largest_px']:.2f} px at most."
    )


def describe_correction(numbers: Mapping[str, Any]) -> str:
    """Return what `LineCorrection.to_dict` says of lines that a map follows, in words."""
    text = f"{describe_displacement(numbers['before'])} The registration follows them, to {numbers['error_px']:.2f} px"
    if numbers["uneven_px"] > numbers["error_px"]:
        text += f"; a place between two of them shows both, {numbers['uneven_px']:.2f} px (root mean square) to either side"
    return f"{text}."


# --- every part of every line by itself


def _register_lines(lines: np.ndarray, scene: np.ndarray) -> LineShifts | None:
    """Register the parts of every row of `lines` against `scene`, both (h, w); None where too few show enough."""
    lines, scene = highpass_rows(lines), highpass_rows(scene)
    known = np.cumsum((np.isfinite(lines) & np.isfinite(scene)).sum(0))
    if not known[-1]:
        return None
    edges = np.searchsorted(known, known[-1] * np.array(SETTINGS.ends), side="right")
    shift = np.zeros((len(lines), len(SETTINGS.ends) - 1, 2))
    information = np.zeros_like(shift)
    limits = (SETTINGS.least_samples, SETTINGS.most_samples, SETTINGS.rounds)
    sizes = (SETTINGS.prior, SETTINGS.most)
    pictures, found = (lines, scene), (shift, information)
    in_threads(
        register_rows, len(lines), pictures, edges, limits, sizes, found, worth=3 * lines.size
    )
    middles = (edges[:-1] + edges[1:]) / 2
    return LineShifts.of(shift, information, middles, (float(edges[0]), float(edges[-1])))


def _describe(shifts: LineShifts, sizes: np.ndarray) -> LineDisplacement:
    """Describe what lines have in common; `sizes`, (2,), are reference px per px along and across the lines."""
    found = [_describe_one(one, sizes) for one in (shifts, shifts.slopes())]
    displaced = [one for one in found if one.displaced]
    if not displaced:
        return max(found, key=_deviations)
    along, across = (
        float(np.hypot.reduce([getattr(one, way) for one in displaced]))
        for way in ("along", "across")
    )
    most = max(one.deviations for one in displaced)
    largest = max(displaced, key=lambda one: one.rms)
    ends = tuple(one.slope for one in displaced)
    return replace(largest, along=along, across=across, deviations=most, parts=shifts, of_ends=ends)


def _describe_one(shifts: LineShifts, sizes: np.ndarray) -> LineDisplacement:
    """Describe the common displacement of parts of lines, or of their slopes, by itself."""
    displaced, deviations = find_displacement(shifts, sizes)
    variance, common = shifts.covariance(), shifts.common
    noise = np.sqrt(np.maximum(np.nanmean(common**2, 0) - variance, 0.0))
    shown = np.maximum(variance, 0.0)
    likely = common * sizes * shown / np.maximum(shown + noise**2, 1e-30)
    along, across = np.sqrt(shown) * sizes * shifts.spread
    return LineDisplacement(
        "rows",
        int(np.isfinite(common).all(1).sum()),
        deviations,
        float(along),
        float(across),
        float(np.nanmax(np.hypot(*likely.T))),
        float(np.hypot(*(noise * sizes))),
        displaced,
        common * sizes,
        shifts.common_edges,
        slope=shifts.spread < 1,
    )
