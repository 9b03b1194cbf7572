"""Verification of a map by evidence that it was not fitted to: dense registration says little of a map that is wholly wrong.

*Permutation test*: windows are predicted better than those of a picture rolled by a third of the frame, which cannot match (as ASHLAR
does with correlations, [muhlich2022]_). *Free windows* of the picture that the reference predicts for a band are searched 12 px around, and
most that are found have to lie where the map puts them. *Shape*: the map neither folds nor stretches over what both pictures show.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.threads import each
from levkas.geometry.transforms import Affine, Transform
from levkas.registration.foreground import corners_of
from levkas.registration.predictors import measure_shifts
from levkas.registration.window_fusion import has_information
from levkas.registration.window_matching import SETTINGS as WINDOWS
from levkas.registration.window_matching import CheckWindows, search_windows

if TYPE_CHECKING:
    from levkas.registration.local_shifts import Predictor, WindowShifts

Box = tuple[float, float, float, float]


GRID = (24, 18)
"""Points over the object at which the shape of a map is measured."""
CELLS = (6, 5)
"""Cells of the object in which windows have to confirm a map."""
FINE, FINE_LEAST = (24, 20), 8
"""Points over the object, four along a side of a cell, at which the overlap is measured; of a cell so many have to be shown."""
MOST_UNCHECKED = 4
"""Rectangles of unchecked parts that are recorded."""
LEAST_OFF = 3
"""Windows of a cell that contradict the map alike, for the cell to be off."""
BLOCK, RIDGE = 80, 1e-3
"""Side, px, of the blocks in which a picture is predicted: their gains feign little in a window of 40 px; share of the mean variance."""
PARTLY = 0.8
"""Share of the windows; where fewer are predicted beyond chance, something covers the object."""


# --- permutation test


@dataclass(frozen=True)
class PermutationTest:
    """Share of one band's windows that are predicted beyond chance, on a grid about as fine as its picture."""

    shifts: WindowShifts
    """Through the map that is judged."""
    chance: float
    """0..1. Value of `shifts.r2` that 19 of 20 unrelated windows stay below."""
    share: float
    """Of the windows, predicted beyond chance."""

    @property
    def is_partly_covered(self) -> bool:
        """Whether windows that chance explains lie together: something covers the object."""
        used = has_information(self.shifts.information)
        predicted = self.is_predicted_around(self.shifts.centres)[used]
        return bool(predicted.sum() <= PARTLY * used.sum())

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
    rolled = [np.roll(image, [n // 3 for n in image.shape], (0, 1)) for image in images]
    shifts, by_chance = (
        _mean_shifts([measure_shifts(predictor, image) for image in some])
        for some in (images, rolled)
    )
    used = has_information(shifts.information)
    null = by_chance.r2[has_information(by_chance.information)]
    level = float(np.quantile(null, 0.95)) if len(null) >= 10 else 0.5
    share = float((shifts.r2[used] > level).mean()) if used.any() else 0.0
    return PermutationTest(shifts, level, share)


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
    """Return the fields of `verdict.Evidence` that check windows and the shape of a dense map give, and the windows.

    `predictors`, (k, h, w), are images of the reference on a grid of `step` reference px, `image`, (n, h, w), pictures with one map through
    `transform` on the same grid, all high-passed, NaN where invalid. The object lies in `mask`, reference px, and the band has values at
    `valid`, native px. Windows of the dense registration `predicted_at`, (n, 2), beyond chance are `cell` reference px apart.
    """
    planes = image if image.ndim == 3 else image[None]
    predicted = np.stack([predict(predictors, plane) for plane in planes])
    both = [(np.nan_to_num(a), np.isfinite(a).all(0)) for a in (predicted, planes)]
    search = search_windows(both[0], both[1], Affine.identity())
    far, outline = search.step * step, corners_of(mask)
    checks = CheckWindows(
        (search.centres + 0.5) * step - 0.5, search.shift * step, search.found, max(1.0, far), WINDOWS.window * far,
        predicted_at, cell, outline if len(outline) > 2 else None, search.against,
    )  # fmt: skip
    overlap = Overlap(transform, mask, valid, box_of(mask))
    # A cell is confirmed by the windows there, not by one key point that agrees.
    numbers = {
        **measure_shape(overlap, mask),
        **measure_windows(overlap, checks, np.empty((0, 2))),
        "second_peak_ratio": float(search.second_peak_ratio),
    }
    return numbers, checks


def box_of(mask: np.ndarray) -> Box | None:
    """Return the box (x, y, width, height) about the pixels of a mask; None without any."""
    rows, columns = (np.flatnonzero(mask.any(axis)) for axis in (1, 0))
    if not len(rows):
        return None
    return float(columns[0]), float(rows[0]), float(np.ptp(columns) + 1), float(np.ptp(rows) + 1)


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
        np.linspace(0, n, max(1, round(n / BLOCK)) + 1).astype(int) for n in (height, width)
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
        gram += RIDGE * np.trace(gram) / count * np.eye(count) + 1e-30 * np.eye(count)
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


def measure_shape(overlap: Overlap, mask: np.ndarray | None = None) -> dict[str, Any]:
    """Return the fields of `verdict.Evidence` on the shape of a map; the overlap is a share of the box, or of `mask` in it."""
    points, transform = grid_points(overlap.box, GRID), overlap.transform
    inside = overlap.shows(points)
    change = transform.jacobian(points)
    known = np.isfinite(change).all((1, 2))
    determinant = np.linalg.det(np.where(known[:, None, None], change, 0))
    mirrored = bool(np.median(determinant[inside]) < 0) if inside.any() else False
    # A map that folds has no value beyond the fold: such points count, wherever they lie.
    judged = inside | ~np.isfinite(transform(points)).all(1)
    good = inside & known & ((determinant < 0) if mirrored else (determinant > 0))
    x, y, width, height = (int(v) for v in overlap.box)
    part = None if mask is None else mask[y : y + height, x : x + width]
    filled = 1.0 if part is None or not part.size else max(float(part.mean()), 1e-9)
    numbers: dict[str, Any] = {
        "overlap": min(1.0, float(inside.mean()) / filled),
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


def measure_windows(
    overlap: Overlap, checks: CheckWindows, matched_at: np.ndarray
) -> dict[str, Any]:
    """Return the fields of `verdict.Evidence` on check windows.

    Windows of a cell that move alike confirm the map there where their median is within the tolerance, and contradict it beyond
    twice that; matches, `matched_at`, (m, 2) reference px, confirm the cell that they lie in.
    """
    box, count = overlap.box, CELLS[0] * CELLS[1]
    fine = grid_points(box, FINE)
    shown = overlap.shows(fine)
    in_view = np.bincount(_cell_of(fine, box), shown, minlength=count) >= FINE_LEAST
    matched = np.zeros(count, bool)
    matched[_cell_of(matched_at, box)] = True
    home = _cell_of(checks.centres, box)
    structured = np.bincount(home, minlength=count) > 0
    agreeing, off = np.zeros(count, bool), np.zeros(count, bool)
    telling = checks.confirmed | checks.contradicting
    for cell in np.unique(home[telling]):
        here = checks.shift[telling & (home == cell)]
        middle = np.median(here, 0)
        # Windows that are found in wrong places scatter; a map that is off moves them alike.
        alike = (np.hypot(*(here - middle).T) <= checks.tolerance).mean() >= 0.5
        agreeing[cell] = alike and np.hypot(*middle) <= checks.tolerance
        off[cell] = alike and len(here) >= LEAST_OFF and np.hypot(*middle) > 2 * checks.tolerance
    judged = in_view & (structured | matched)
    support = (matched | agreeing) & ~off
    centres, size = grid_points(box, CELLS), np.array(box[2:]) / CELLS

    def rectangles(mask: np.ndarray) -> list[list[float]]:
        corners = centres[mask] + 0.5 - size / 2
        return [[round(float(v), 1) for v in (*corner, *size)] for corner in corners]

    distance = np.hypot(*checks.shift[telling].T)
    return {
        "box": box,
        "tolerance": checks.tolerance,
        "windows": len(checks.found),
        "found": int(checks.found.sum()),
        "agreeing": int(checks.confirmed.sum()),
        "contradicting": int(checks.contradicting.sum()),
        "window_median": float(np.median(distance)) if len(distance) else np.inf,
        "coverage": float(support[judged].mean()) if judged.any() else 0.0,
        "off_share": float(off[judged].mean()) if judged.any() else 0.0,
        "unsupported": rectangles(judged & ~support & ~off),
        "off": rectangles(judged & off),
        **_measure_checked(box, shown, checks.beyond(fine) == 0),
    }


def _measure_checked(box: Box, shown: np.ndarray, near: np.ndarray) -> dict[str, Any]:
    """Return how much of what both pictures show is near to what confirms the map, and the rest's rectangles."""
    from scipy import ndimage

    total = max(int(shown.sum()), 1)
    corner, cell = np.array(box[:2]), np.array(box[2:]) / FINE

    def rectangle(part: tuple[slice, ...]) -> list[float]:
        first, last = ([getattr(part[k], end) for k in (1, 0)] for end in ("start", "stop"))
        low, high = first * cell + corner, last * cell + corner
        return [round(float(v), 1) for v in (*low, *(high - low))]

    good, rest = ((mask & shown).reshape(FINE[::-1]) for mask in (near, ~near))
    patches, count = ndimage.label(rest)
    sizes = np.bincount(patches.ravel(), minlength=count + 1)[1:]
    parts = ndimage.find_objects(patches)
    order = np.argsort(-sizes, kind="stable")[:MOST_UNCHECKED]
    return {
        "checked": float(good.sum() / total),
        "unchecked": [[*rectangle(parts[k]), round(float(sizes[k] / total), 4)] for k in order],
    }


def _cell_of(points: np.ndarray, box: Box) -> np.ndarray:
    places = (np.asarray(points).reshape(-1, 2) + 0.5 - box[:2]) / box[2:] * CELLS
    column, row = np.clip(np.floor(places).astype(int), 0, np.array(CELLS) - 1).T
    return np.asarray(row * CELLS[0] + column)
