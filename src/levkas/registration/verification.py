"""Verification of a map by evidence that it was not fitted to.

Dense registration compares windows at most a pixel or two around where a map already is: it says little of
a map that is wholly wrong. Three things are measured of it. A *permutation test*: windows are predicted
better than those of a picture rolled by a third of the frame, which cannot match (as ASHLAR does with
correlations, [muhlich2022]_). *Free windows*: windows of the picture that the reference predicts for a band
are searched 12 px around, and most of those that are found have to lie where the map puts them. *Shape*:
the map neither folds nor stretches over what both pictures show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from levkas.core.threads import each
from levkas.geometry.transforms import Affine, Transform
from levkas.registration.foreground import corners_of
from levkas.registration.predictors import measure_shifts
from levkas.registration.window_fusion import has_information
from levkas.registration.window_matching import SETTINGS as WINDOWS
from levkas.registration.window_matching import CheckWindows, WindowSearch, search_windows

if TYPE_CHECKING:
    from levkas.registration.local_shifts import Predictor, WindowShifts

Box = tuple[float, float, float, float]


@dataclass(frozen=True)
class VerificationSettings:
    """Constants of the verification."""

    grid: tuple[int, int] = (24, 18)
    """Points over the object at which the shape of a map is measured."""
    cells: tuple[int, int] = (6, 5)
    """Cells of the object in which windows have to confirm a map."""
    fine_per_cell: int = 4
    fine_least: int = 8
    """`fine_per_cell`, `fine_least`: points along either side of a cell, and how many of them both pictures have to show for
    the cell to count as shown."""
    most_unchecked: int = 4
    """Rectangles of unchecked parts that are recorded."""
    least_found: int = 3
    """Windows of a cell that have to be found for the cell to be off."""
    block: int = 80
    """In px: side of the blocks in which a picture is predicted: what their gains could feign in a window of 40 px is little
    beside chance."""
    ridge: float = 1e-3
    """Of that prediction, as a share of the mean variance."""
    null_quantile: float = 0.95
    """Of unrelated windows."""

    @property
    def fine(self) -> tuple[int, int]:
        """Points over the object at which the overlap is measured."""
        return self.fine_per_cell * self.cells[0], self.fine_per_cell * self.cells[1]


SETTINGS = VerificationSettings()


# --- permutation test


@dataclass(frozen=True)
class PermutationTest:
    """Share of one band's windows that are predicted beyond chance, on a grid about as fine as its picture."""

    #: Share of the windows; where fewer are predicted beyond chance, something covers the object.
    PARTLY: ClassVar[float] = 0.8

    shifts: WindowShifts
    """Through the map that is judged."""
    chance: float
    """0..1. Value of `shifts.r2` that 19 of 20 unrelated windows stay below."""
    evidence: dict[str, float]
    """``share_above_chance`` of the windows, ``cover`` of the reference."""

    @property
    def is_partly_covered(self) -> bool:
        """Whether windows that chance explains lie together: something covers the object."""
        used = has_information(self.shifts.information)
        predicted = self.is_predicted_around(self.shifts.centres)[used]
        return bool(predicted.sum() <= self.PARTLY * used.sum())

    @property
    def predicted(self) -> np.ndarray:
        """Centres, (n, 2) reference px, of windows that are predicted beyond chance, as most near are."""
        used = has_information(self.shifts.information)
        return np.asarray(self.shifts.centres[used & self.is_predicted_around(self.shifts.centres)])

    def is_predicted_around(self, centres: np.ndarray) -> np.ndarray:
        """Return at which places, (n, 2) reference px, most windows near are predicted beyond chance."""
        from scipy.spatial import cKDTree

        used = has_information(self.shifts.information)
        if not used.any():
            return np.zeros(len(centres), bool)
        above = (self.shifts.r2[used] > self.chance).astype(float)
        near = cKDTree(self.shifts.centres[used]).query(centres, k=min(9, int(used.sum())))[1]
        return np.asarray(above[near].reshape(len(centres), -1).mean(1) > 0.5)


def run_permutation_test(predictor: Predictor, images: Sequence[np.ndarray]) -> PermutationTest:
    """Compare how well windows of `images`, (h, w) each, are predicted with those of the images rolled by a third.

    Of several images, pictures with one map, shares of variance are averaged.
    """
    shifts = _mean_shifts([measure_shifts(predictor, image) for image in images])
    used, able = has_information(shifts.information), predictor.counts.reshape(-1) > 0
    by_chance = _mean_shifts(
        [
            measure_shifts(predictor, np.roll(image, [n // 3 for n in image.shape], (0, 1)))
            for image in images
        ]
    )
    null = by_chance.r2[has_information(by_chance.information)]
    level = float(np.quantile(null, SETTINGS.null_quantile)) if len(null) >= 10 else 0.5
    evidence = {
        "share_above_chance": float((shifts.r2[used] > level).mean()) if used.any() else 0.0,
        "cover": float(used.sum() / max(able.sum(), 1)),
    }
    return PermutationTest(shifts, level, evidence)


def _mean_shifts(shifts: Sequence[WindowShifts]) -> WindowShifts:
    """Return the first of several with the mean of their `r2`, and the information of all."""
    if len(shifts) == 1:
        return shifts[0]
    total = np.sum([one.information for one in shifts], axis=0)
    return replace(shifts[0], r2=np.mean([one.r2 for one in shifts], axis=0), information=total)


# --- free windows


def verify(
    predictors: np.ndarray,
    image: np.ndarray,
    step: int,
    transform: Transform,
    mask: np.ndarray,
    valid: np.ndarray,
    predicted_at: np.ndarray | None = None,
    cell: float = 0.0,
) -> tuple[dict[str, Any], CheckWindows]:
    """Measure what the verdict on a dense map rests on.

    Parameters
    ----------
    predictors : ndarray, (k, h, w), float32
        Images of the reference on a grid of `step` reference px, high-passed; NaN where invalid.
    image : ndarray, (h, w) or (n, h, w), float32
        The band on the same grid, resampled through `transform`, high-passed too; or several pictures with one map.
    step : int, reference px
    transform : Transform
        Reference px → native px of the band.
    mask : ndarray of bool, reference px
        Where the object lies.
    valid : ndarray of bool, native px
    predicted_at : ndarray, (n, 2), reference px, optional
        Windows of the dense registration that are predicted beyond chance, `cell` px apart.
    cell : float, reference px

    Returns
    -------
    numbers : dict
        Of `measure_shape`, `measure_windows` and `measure_cells`, ``tolerance``, reference px, and ``second_peak_ratio``.
    checks : CheckWindows
        The windows themselves.
    """
    planes = image if image.ndim == 3 else image[None]
    predicted = np.stack([predict(predictors, plane) for plane in planes])
    both = [(np.nan_to_num(a), np.isfinite(a).all(0)) for a in (predicted, planes)]
    found = search_windows(both[0], both[1], Affine.identity())
    search = _enlarged(found, step)
    overlap = Overlap(transform, mask, valid, box_of(mask))
    tolerance, outline = max(1.0, search.step), corners_of(mask)
    checks = CheckWindows(
        search.centres, search.shift, search.found, tolerance, WINDOWS.window * search.step,
        predicted_at, cell, outline if len(outline) > 2 else None,
    )  # fmt: skip
    numbers = {
        "tolerance": tolerance,
        **measure_shape(overlap),
        **measure_windows(checks),
        "second_peak_ratio": float(search.second_peak_ratio),
        # A cell is confirmed by the windows there, not by one key point that agrees.
        **measure_support(overlap, checks, np.empty((0, 2))),
    }
    numbers["overlap"] = of_object(numbers["overlap"], mask, overlap.box)
    return numbers, checks


def box_of(mask: np.ndarray) -> Box | None:
    """Return the box (x, y, width, height) about the pixels of a mask, (h, w) bool; None without any."""
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    if not len(rows):
        return None
    return float(columns[0]), float(rows[0]), float(np.ptp(columns) + 1), float(np.ptp(rows) + 1)


def of_object(share: float, mask: np.ndarray, box: Box) -> float:
    """Return a share of a box as one of the mask in it, at most 1.

    >>> of_object(0.25, np.array([[True, False], [True, False]]), (0, 0, 2, 2))
    0.5
    """
    x, y, width, height = (int(v) for v in box)
    part = mask[y : y + height, x : x + width]
    return min(1.0, share / max(float(part.mean()) if part.size else 1.0, 1e-9))


def predict(predictors: np.ndarray, image: np.ndarray) -> np.ndarray:
    """Return the combination of the predictors that is nearest to `image`, block by block, (h, w).

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> images = rng.normal(size=(2, 90, 90)).astype(np.float32)
    >>> made = predict(images, 2 * images[0] - images[1])
    >>> bool(np.abs(made - (2 * images[0] - images[1])).max() < 0.02)
    True
    """
    count, height, width = predictors.shape
    out = np.full((height, width), np.nan, np.float32)
    rows, columns = (
        np.linspace(0, n, max(1, round(n / SETTINGS.block)) + 1).astype(int)
        for n in (height, width)
    )

    def fill(top: int, bottom: int, left: int, right: int) -> None:
        part = predictors[:, top:bottom, left:right].reshape(count, -1).astype(np.float64)
        goal = image[top:bottom, left:right].reshape(-1).astype(np.float64)
        known = np.isfinite(part).all(0)
        used = known & np.isfinite(goal)
        if used.sum() < 8 * count:
            return
        shown = part if used.all() else part[:, used]
        gram = shown @ shown.T
        gram += SETTINGS.ridge * np.trace(gram) / count * np.eye(count) + 1e-30 * np.eye(count)
        gains = np.linalg.solve(gram, shown @ goal[used])
        block = np.where(known, gains @ part, np.nan)
        out[top:bottom, left:right] = block.reshape(bottom - top, right - left)

    blocks = [(*row, *column) for row in pairwise(rows) for column in pairwise(columns)]
    each(fill, *zip(*blocks, strict=True))
    return out


def coarsening(shape: tuple[int, int], step: int) -> int:
    """Return by how much more a frame that is compared at `step` is reduced: 1, 2, 4 …

    >>> coarsening((3000, 4000), 1)
    4
    """
    more = 1
    while max(shape) / (step * more) > 1.25 * WINDOWS.long_side:
        more *= 2
    return more


def _enlarged(search: WindowSearch, step: int) -> WindowSearch:
    """Turn px of a grid of `step` reference px into reference px."""
    return replace(
        search,
        centres=(search.centres + 0.5) * step - 0.5,
        shift=search.shift * step,
        step=search.step * step,
    )


# --- shape and coverage


@dataclass(frozen=True)
class Overlap:
    """Two pictures and the map between them: which part of the object both show."""

    transform: Transform
    """Reference px → target px."""
    reference: np.ndarray
    target: np.ndarray
    """`reference`, `target`: (h, w). Where each picture is valid."""
    region: tuple[float, ...] | None = None
    """In reference px, or None: where the object lies."""

    @property
    def box(self) -> Box:
        """(x, y, width, height) of what is judged: the region within the reference's frame."""
        h, w = self.reference.shape
        x, y, wide, high = self.region or (0, 0, w, h)
        left, top = max(x, 0), max(y, 0)
        return left, top, max(min(x + wide, w) - left, 1), max(min(y + high, h) - top, 1)

    def shows(self, points: np.ndarray) -> np.ndarray:
        """Return which reference points, (n, 2), lie on valid px of both pictures."""
        mapped = self.transform(points)
        known = np.isfinite(mapped).all(1)
        good = known.copy()
        for places, valid in ((points, self.reference), (mapped, self.target)):
            x, y = np.rint(np.where(known[:, None], places, -9)).astype(int).T
            h, w = valid.shape
            inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
            good &= inside
            good[inside] &= valid[y[inside], x[inside]]
        return good


def measure_shape(overlap: Overlap) -> dict[str, Any]:
    """Measure the shape of a map over its overlap: scale, folds, stretch.

    Returns
    -------
    numbers : dict
        ``overlap`` 0..1, the share of the box that the target shows; within that share
        ``folded`` 0..1, the part where the map has no or a flipped Jacobian; ``scale_min`` and
        ``scale_max``, target px per reference px; ``area_ratio``, largest to smallest local area;
        ``anisotropy``, largest ratio of the two principal scales; ``mirrored``.
    """
    points = grid_points(overlap.box, SETTINGS.grid)
    inside = overlap.shows(points)
    return {"overlap": float(inside.mean()), **measure_map(overlap.transform, points, inside)}


def measure_map(transform: Transform, points: np.ndarray, inside: np.ndarray) -> dict[str, Any]:
    """Measure folds and stretches of a map at `points`, (n, 2), of which the target shows `inside`, (n,) bool.

    Returns
    -------
    numbers : dict
        As of `measure_shape`, without the overlap.
    """
    change = transform.jacobian(points)
    known = np.isfinite(change).all((1, 2))
    determinant = np.linalg.det(np.where(known[:, None, None], change, 0))
    mirrored = bool(np.median(determinant[inside]) < 0) if inside.any() else False
    upright = (determinant < 0) if mirrored else (determinant > 0)
    # A map that folds has no value beyond the fold: such points count, wherever they lie.
    lost = ~np.isfinite(transform(points)).all(1)
    judged = inside | lost
    good = inside & upright & known
    numbers: dict[str, Any] = {
        "folded": float(1 - good[judged].mean()) if judged.any() else 1.0,
        "mirrored": mirrored,
    }
    if good.any():
        singular = np.linalg.svd(change[good], compute_uv=False)
        area = singular.prod(1)
        numbers |= {
            "scale_min": float(singular.min()),
            "scale_max": float(singular.max()),
            "area_ratio": float(area.max() / area.min()),
            "anisotropy": float((singular[:, 0] / singular[:, 1]).max()),
        }
    return numbers


def grid_points(box: Box, shape: tuple[int, int]) -> np.ndarray:
    """Return the centres, (columns · rows, 2), of a grid of cells over a box."""
    x, y, w, h = box
    columns, rows = shape
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    return np.stack([x - 0.5 + u.ravel() * w, y - 0.5 + v.ravel() * h], 1)


def measure_windows(checks: CheckWindows) -> dict[str, Any]:
    """Count windows that confirm a map; distances in reference px.

    Returns
    -------
    numbers : dict
        ``windows`` with structure, ``found`` of these, ``agreeing`` of the found;
        ``window_median`` of how far the found ones are off (infinite without any).
    """
    found = checks.found
    distance = np.hypot(*checks.shift.T)[found]
    middle = np.median(distance) if found.any() else np.inf
    return {
        "windows": len(found),
        "found": int(found.sum()),
        "agreeing": int(checks.confirmed.sum()),
        "window_median": float(middle),
    }


def measure_support(
    overlap: Overlap, checks: CheckWindows, matched_at: np.ndarray
) -> dict[str, Any]:
    """Return ``box``, (x, y, width, height) reference px, and the numbers of `measure_cells` in it."""
    box = overlap.box
    shown = overlap.shows(grid_points(box, SETTINGS.fine))
    return {"box": list(box), **measure_cells(box, shown, checks, matched_at)}


def measure_cells(
    box: Box, shown: np.ndarray, checks: CheckWindows, matched_at: np.ndarray
) -> dict[str, Any]:
    """Find the cells of a box in which windows or matches confirm a map, and how much of it is checked.

    Parameters
    ----------
    box : (x, y, width, height), reference px
    shown : ndarray of bool, (n,)
        Which points of the fine grid over the box both pictures show.
    checks : CheckWindows
        Windows of a cell that move alike confirm the map where their median is within the tolerance.
    matched_at : ndarray, (m, 2), reference px
        Matches, which confirm the cell that they lie in.

    Returns
    -------
    numbers : dict
        ``coverage`` 0..1: of the cells that both pictures show and that have structure, the share
        that is confirmed; ``unsupported``, ``off``: lists of (x, y, width, height),
        reference px, of the cells where nothing confirms it, and where windows lie off it; ``off_shift``: by how much windows lie off, (dx, dy) px, in each cell of ``off``. ``checked`` 0..1: of all that both pictures show, with structure or
        without, the share that is no farther than a window's side from windows that confirm the map;
        ``unchecked``: the rectangles about connected parts
        of the rest, the largest first, each with its share of all at the end.
    """
    columns, rows = SETTINGS.cells
    count = columns * rows
    fine = grid_points(box, SETTINGS.fine)
    shown_points = np.bincount(_cell_of(fine, box), shown, minlength=count)
    in_view = shown_points >= SETTINGS.fine_least
    matched = np.zeros(count, bool)
    matched[_cell_of(matched_at, box)] = True
    home = _cell_of(checks.centres, box)
    structured = np.bincount(home, minlength=count) > 0
    agreeing, off = np.zeros(count, bool), np.zeros(count, bool)
    moved = np.zeros((count, 2))
    for cell in np.unique(home[checks.found]):
        here = checks.shift[checks.found & (home == cell)]
        middle = np.median(here, 0)
        # Windows that are found in wrong places scatter; a map that is off moves them alike.
        alike = (np.hypot(*(here - middle).T) <= checks.tolerance).mean() >= 0.5
        agreeing[cell] = alike and np.hypot(*middle) <= checks.tolerance
        off[cell] = alike and len(here) >= SETTINGS.least_found and not agreeing[cell]
        moved[cell] = middle
    judged = in_view & (structured | matched)
    support = (matched | agreeing) & ~off
    centres, size = grid_points(box, SETTINGS.cells), (box[2] / columns, box[3] / rows)

    def rectangles(mask: np.ndarray) -> list[list[float]]:
        corners = centres[mask] + 0.5 - np.array(size) / 2
        return [[round(float(v), 1) for v in (*corner, *size)] for corner in corners]

    return {
        "coverage": float(support[judged].mean()) if judged.any() else 0.0,
        "off_share": float(off[judged].mean()) if judged.any() else 0.0,
        "unsupported": rectangles(judged & ~support & ~off),
        "off": rectangles(judged & off),
        "off_shift": np.round(moved[judged & off], 2).tolist(),
        **_measure_checked(box, shown, checks.beyond(fine) == 0),
    }


def _measure_checked(box: Box, shown: np.ndarray, near: np.ndarray) -> dict[str, Any]:
    """Return how much of what both pictures show is near to what confirms the map, and the rest's rectangles."""
    from scipy import ndimage

    columns, rows = SETTINGS.fine
    total = max(int(shown.sum()), 1)
    cell = np.array([box[2] / columns, box[3] / rows])

    def rectangle(part: tuple[slice, ...]) -> list[float]:
        low = np.array([part[1].start, part[0].start]) * cell + np.array(box[:2])
        high = np.array([part[1].stop, part[0].stop]) * cell + np.array(box[:2])
        return [round(float(v), 1) for v in (*low, *(high - low))]

    good, rest = ((mask & shown).reshape(rows, columns) for mask in (near, ~near))
    patches, count = ndimage.label(rest)
    sizes = np.bincount(patches.ravel(), minlength=count + 1)[1:]
    parts = ndimage.find_objects(patches)
    order = np.argsort(-sizes, kind="stable")[: SETTINGS.most_unchecked]
    return {
        "checked": float(good.sum() / total),
        "unchecked": [[*rectangle(parts[k]), round(float(sizes[k] / total), 4)] for k in order],
    }


def _cell_of(points: np.ndarray, box: Box) -> np.ndarray:
    if not len(points):
        return np.empty(0, int)
    x, y, w, h = box
    columns, rows = SETTINGS.cells
    column = np.floor((points[:, 0] + 0.5 - x) / w * columns).astype(int)
    row = np.floor((points[:, 1] + 0.5 - y) / h * rows).astype(int)
    column, row = np.clip(column, 0, columns - 1), np.clip(row, 0, rows - 1)
    return np.asarray(row * columns + column)
