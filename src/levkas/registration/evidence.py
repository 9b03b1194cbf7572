"""The evidence for and against a registration, measured; `verdict` decides on it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import Polynomial
from levkas.registration.outliers import remove_outliers
from levkas.registration.record import RegistrationRefused

if TYPE_CHECKING:
    from collections.abc import Callable

    from levkas.geometry.transforms import Transform
    from levkas.registration.checks import Checks
    from levkas.registration.record import Matches

GRID = (24, 18)
CELLS = (6, 5)
#: Points, four by four a cell, that tell which part of the box both pictures show; half of a cell's make it shown.
FINE, FINE_LEAST = (4 * CELLS[0], 4 * CELLS[1]), 8
MOST_UNCHECKED = 4
FOLDS = 5
LEAST_FOUND = 3
CHANCE_REPEATS = 5
CHANCE_MATCHES = 1000


@dataclass(frozen=True)
class Evidence:
    """What a registration is judged on.

    Parameters
    ----------
    transform : Transform
        Reference px → px of the target's grey picture.
    matches : Matches
    reference, target : (values, valid), each (h, w), float32 and bool
        The grey pictures.
    region : (x, y, width, height), reference px, or None
        Where the object lies.
    scale : Transform or None
        Scale-only map target → reference, if matches were cut under it.
    reject, stop : float, reference px
    order : int
        Of the polynomial that was fitted target → reference.
    """

    transform: Transform
    matches: Matches
    reference: tuple[np.ndarray, np.ndarray]
    target: tuple[np.ndarray, np.ndarray]
    region: tuple[float, ...] | None = None
    scale: Transform | None = None
    reject: float = np.inf
    stop: float = 1.0
    order: int = 3

    @property
    def box(self) -> tuple[float, float, float, float]:
        """(x, y, width, height) of what is judged: the region within the reference's frame."""
        h, w = self.reference[0].shape
        x, y, wide, high = self.region or (0, 0, w, h)
        left, top = max(x, 0), max(y, 0)
        return left, top, max(min(x + wide, w) - left, 1), max(min(y + high, h) - top, 1)

    @property
    def terms(self) -> int:
        """Coefficients of the polynomial, for x′ and y′ each."""
        return (self.order + 1) * (self.order + 2) // 2


def measure_shape(evidence: Evidence) -> dict[str, Any]:
    """Measure what the map does to the box: overlap, scale, folds, stretch.

    Returns
    -------
    numbers : dict
        ``overlap`` 0..1, the share of the box that the target shows; within that share
        ``folded`` 0..1, the part where the map has no or a flipped Jacobian; ``scale_min`` and
        ``scale_max``, target px per reference px; ``area_ratio``, largest to smallest local area;
        ``anisotropy``, largest ratio of the two principal scales; ``mirrored``.
    """
    points = grid_points(evidence.box, GRID)
    inside = seen(evidence, points)
    return {"overlap": float(inside.mean()), **measure_map(evidence.transform, points, inside)}


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


def grid_points(box: tuple[float, float, float, float], shape: tuple[int, int]) -> np.ndarray:
    """Return the centres, (columns · rows, 2), of a grid of cells over a box."""
    x, y, w, h = box
    columns, rows = shape
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(rows) + 0.5) / rows)
    return np.stack([x - 0.5 + u.ravel() * w, y - 0.5 + v.ravel() * h], 1)


def seen(evidence: Evidence, points: np.ndarray) -> np.ndarray:
    """Tell which reference points, (n, 2), lie on valid px of the target's picture too."""
    mapped = evidence.transform(points)
    known = np.isfinite(mapped).all(1)
    good = known.copy()
    for places, (_, valid) in ((points, evidence.reference), (mapped, evidence.target)):
        x, y = np.rint(np.where(known[:, None], places, -9)).astype(int).T
        h, w = valid.shape
        inside = (x >= 0) & (x < w) & (y >= 0) & (y < h)
        good &= inside
        good[inside] &= valid[y[inside], x[inside]]
    return good


def measure_held_out(
    evidence: Evidence, fit: Callable[[np.ndarray, np.ndarray], Transform] | None = None
) -> dict[str, Any]:
    """Fit without one spatial block of matches at a time and predict those.

    Parameters
    ----------
    evidence : Evidence
    fit : callable, (target, reference) → Transform target → reference
        The polynomial of the evidence's order without it.

    Returns
    -------
    numbers : dict
        ``held_out_median``, ``held_out_p90``, reference px; infinite where a fit is not possible.

    Notes
    -----
    Blocks, not single matches: neighbours err alike and would vouch for one another.
    """
    kept = evidence.matches.kept
    reference, target = evidence.matches.reference[kept], evidence.matches.target[kept]
    order = evidence.order
    solve = fit or (lambda t, r: Polynomial.fit(t, r, order=order))
    errors = np.full(len(reference), np.inf)
    fold = _blocks(reference)
    for k in np.unique(fold):
        out = fold == k
        if (~out).sum() >= evidence.terms:
            model = solve(target[~out], reference[~out])
            errors[out] = np.linalg.norm(model(target[out]) - reference[out], axis=1)
    if not len(errors):
        return {"held_out_median": np.inf, "held_out_p90": np.inf}
    # Order statistics, not interpolation, which is undefined between two infinities.
    middle, high = np.percentile(errors, (50, 90), method="lower")
    return {"held_out_median": float(middle), "held_out_p90": float(high)}


def _blocks(points: np.ndarray) -> np.ndarray:
    """Deal the cells of a 5 x 5 grid to folds so that no two neighbours share one."""
    if not len(points):
        return np.empty(0, int)
    low, high = points.min(0), points.max(0)
    cell = np.clip(((points - low) / np.maximum(high - low, 1e-9) * FOLDS).astype(int), 0, 4)
    return (cell[:, 0] + 2 * cell[:, 1]) % FOLDS


def measure_chance(evidence: Evidence, rng: np.random.Generator) -> dict[str, Any]:
    """Count how many matches the same removal keeps where they are paired at random.

    Returns
    -------
    numbers : dict
        ``chance_kept``: the most that were kept in five trials with as many matches, each paired
        with a random place within `reject`; 0 where nothing was cut under scale.
    """
    if evidence.scale is None or not np.isfinite(evidence.reject):
        return {"chance_kept": 0}
    matches = evidence.matches
    near = matches.round != 0
    placed = evidence.scale(matches.target[near])
    used = placed if len(placed) <= CHANCE_MATCHES else rng.permutation(placed)[:CHANCE_MATCHES]
    most = 0
    for _ in range(CHANCE_REPEATS):
        angle = rng.uniform(0, 2 * np.pi, len(used))
        radius = evidence.reject * np.sqrt(rng.uniform(0, 1, len(used)))
        paired = used + radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], 1)
        most = max(most, _count_kept(used, paired, evidence))
    # Beyond what the coefficients absorb, the count grows with the number of matches.
    more = most - evidence.terms
    return {"chance_kept": round(evidence.terms + more * max(1.0, len(placed) / CHANCE_MATCHES))}


def _count_kept(target: np.ndarray, reference: np.ndarray, evidence: Evidence) -> int:
    from levkas.geometry.transforms import Affine

    count = len(target)
    try:
        for step in remove_outliers(
            target,
            reference,
            scale=Affine.identity(),
            reject=2 * evidence.reject,
            stop=evidence.stop,
            order=evidence.order,
        ):
            count -= step.removed
    except RegistrationRefused:
        return evidence.terms
    return count


def measure_windows(checks: Checks) -> dict[str, Any]:
    """Sum up what windows say of a map; distances in reference px.

    Returns
    -------
    numbers : dict
        ``windows`` with structure, ``found`` of these, ``agreeing`` of the found;
        ``window_median``, ``window_p90`` of how far the found ones are off (infinite without any).
    """
    found = checks.found
    distance = np.hypot(*checks.shift.T)[found]
    middle, high = np.percentile(distance, (50, 90)) if found.any() else (np.inf, np.inf)
    return {
        "windows": len(found),
        "found": int(found.sum()),
        "agreeing": int(checks.confirmed.sum()),
        "window_median": float(middle),
        "window_p90": float(high),
    }


def measure_support(evidence: Evidence, checks: Checks) -> dict[str, Any]:
    """Tell in which cells of the box the map is borne out by matches or by windows.

    Returns
    -------
    numbers : dict
        ``box``, (x, y, width, height), reference px, and as `measure_cells` names them.
    """
    box = evidence.box
    shown = seen(evidence, grid_points(box, FINE))
    kept = evidence.matches.reference[evidence.matches.kept]
    return {"box": list(box), **measure_cells(box, shown, checks, kept)}


def measure_cells(
    box: tuple[float, float, float, float],
    shown: np.ndarray,
    checks: Checks,
    matched_at: np.ndarray,
) -> dict[str, Any]:
    """Tell in which cells of a box windows or matches bear a map out, and how much of it is checked.

    Parameters
    ----------
    box : (x, y, width, height), reference px
    shown : ndarray of bool, (n,)
        Which points of the grid `FINE` over the box both pictures show.
    checks : Checks
        Windows of a cell that move alike bear the map out where their median is within the tolerance.
    matched_at : ndarray, (m, 2), reference px
        Matches, which bear out the cell that they lie in.

    Returns
    -------
    numbers : dict
        ``coverage`` 0..1: of the cells that both pictures show and that have structure, the share
        that is borne out; ``unsupported``, ``off``, ``outside``: lists of (x, y, width, height),
        reference px, of the cells where nothing bears it out, where windows say that it is off,
        and that the target does not show. ``checked`` 0..1: of all that both pictures show, with structure or
        without, the share that is no farther than a window's side from windows that confirm the map;
        ``checked_box``: the rectangle about that, ``unchecked``: the rectangles about connected parts
        of the rest, the largest first, each with its share of all at the end.
    """
    count = CELLS[0] * CELLS[1]
    centres = grid_points(box, CELLS)
    fine = grid_points(box, FINE)
    in_view = np.bincount(_cell_of(fine, box), shown, minlength=count) >= FINE_LEAST
    matched = np.zeros(count, bool)
    matched[_cell_of(matched_at, box)] = True
    home = _cell_of(checks.centres, box)
    structured = np.bincount(home, minlength=count) > 0
    agreeing, off = np.zeros(count, bool), np.zeros(count, bool)
    for cell in np.unique(home[checks.found]):
        here = checks.shift[checks.found & (home == cell)]
        middle = np.median(here, 0)
        # Windows that are found in wrong places scatter; a map that is off moves them alike.
        alike = (np.hypot(*(here - middle).T) <= checks.tolerance).mean() >= 0.5
        agreeing[cell] = alike and np.hypot(*middle) <= checks.tolerance
        off[cell] = alike and len(here) >= LEAST_FOUND and not agreeing[cell]
    asked = in_view & (structured | matched)
    support = (matched | agreeing) & ~off
    size = box[2] / CELLS[0], box[3] / CELLS[1]

    def cells(mask: np.ndarray) -> list[list[float]]:
        corners = centres[mask] + 0.5 - np.array(size) / 2
        return [[round(float(v), 1) for v in (*corner, *size)] for corner in corners]

    return {
        "coverage": float(support[asked].mean()) if asked.any() else 0.0,
        "off_share": float(off[asked].mean()) if asked.any() else 0.0,
        "unsupported": cells(asked & ~support & ~off),
        "off": cells(asked & off),
        "outside": cells(~in_view),
        **_checked(box, shown, checks.beyond(fine) == 0),
    }


def _checked(
    box: tuple[float, float, float, float], shown: np.ndarray, near: np.ndarray
) -> dict[str, Any]:
    """Return how much of what both pictures show is near to what confirms the map, and the rest's rectangles."""
    from scipy import ndimage

    columns, rows = FINE
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
    order = np.argsort(-sizes, kind="stable")[:MOST_UNCHECKED]
    whole = ndimage.find_objects(good.astype(int))
    return {
        "checked": float(good.sum() / total),
        "checked_box": rectangle(whole[0]) if whole else None,
        "unchecked": [[*rectangle(parts[k]), round(float(sizes[k] / total), 4)] for k in order],
    }


def _cell_of(points: np.ndarray, box: tuple[float, float, float, float]) -> np.ndarray:
    if not len(points):
        return np.empty(0, int)
    x, y, w, h = box
    column = np.floor((points[:, 0] + 0.5 - x) / w * CELLS[0]).astype(int)
    row = np.floor((points[:, 1] + 0.5 - y) / h * CELLS[1]).astype(int)
    column, row = np.clip(column, 0, CELLS[0] - 1), np.clip(row, 0, CELLS[1] - 1)
    return np.asarray(row * CELLS[0] + column)
