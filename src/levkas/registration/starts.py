"""Starts that people or other programs give: pairs by hand, a declared alignment, and pairs that may be wrong.

Pairs given by hand start the search where key points find nothing, or something else. Pairs of another program are candidates of a
start: the largest sets of them that agree on a homography, one after another.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import Affine, Composed, Homography, Inverse, Transform
from levkas.registration.advice import LEAST_PAIRS
from levkas.registration.initial import SETTINGS as INITIAL
from levkas.registration.initial import (
    InitialTransform,
    is_plausible,
    magsac,
    refine,
    rematch,
    scale_at,
)
from levkas.registration.models import fit_plane
from levkas.registration.record import refusal

if TYPE_CHECKING:
    from levkas.registration.features import CameraFeatures
    from levkas.registration.manual_points import ManualPoints

CONTRADICTION = (8.0, 0.01)
"""Reference px, and share of the longer side, by which half of the pairs by hand contradict key points."""
CANDIDATES, LEAST_SET = 3, 6
"""Sets of pairs of another program that are tried; pairs of one: four determine a homography, two more agree with it."""
PAIR_SHARE = 0.005
"""Share of the longer side up to which they agree, as far as a search on coarse grids makes good; 3 px at least."""


def seed_with_points(
    found: InitialTransform | None,
    by_hand: ManualPoints,
    reference: CameraFeatures,
    target: CameraFeatures,
) -> InitialTransform | None:
    """Return the initial transform that pairs by hand and key points, `found` by themselves, give together.

    None where there are neither key points nor four pairs. Where most of the pairs contradict what key points found, the pairs are taken.
    """
    fixed = by_hand.fixed
    if found is None or _contradicts(found, fixed, reference.shape):
        if len(fixed) < LEAST_PAIRS:
            return found
        found = _rematch_all(fit_initial_transform(fixed), reference, target)
    marked = by_hand.mark(found.reference, found.target)
    if not (marked.reason != "").any():
        return found
    kept = np.zeros(len(marked.reason), bool)
    kept[: len(found.kept)] = found.kept
    kept = kept & ~marked.dropped | marked.fixed
    p, q = marked.reference, marked.target
    first = replace(found, reference=p, target=q, kept=kept)
    return replace(refine(first, p, q, marked.fixed, marked.dropped), reason=marked.reason)


def _contradicts(found: InitialTransform, fixed: np.ndarray, shape: tuple[int, ...]) -> bool:
    if not len(fixed):
        return False
    scale = np.maximum(_scales(found.transform, fixed), 1e-9)
    off = np.linalg.norm(found.transform(fixed[:, :2]) - fixed[:, 2:], axis=1) / scale
    least, share = CONTRADICTION
    return bool(np.median(np.nan_to_num(off, nan=np.inf)) > max(least, share * max(shape)))


def _scales(transform: Transform, pairs: np.ndarray) -> np.ndarray:
    return np.asarray(np.sqrt(np.abs(np.linalg.det(transform.jacobian(pairs[:, :2])))))


def fit_initial_transform(pairs: np.ndarray) -> InitialTransform:
    """Fit a transform to four or more pairs, (n, 4), alone: the stiffest of similarity, affine and homography that fits.

    Examples
    --------
    >>> corners = np.array([[0.0, 0], [9, 0], [9, 9], [0, 9]])
    >>> begun = fit_initial_transform(np.hstack([corners, 2 * corners + 1]))
    >>> begun.transform(np.array([[4.0, 5.0]])).round(6).tolist(), begun.mirrored
    ([[9.0, 11.0]], False)
    """
    p, q = pairs[:, :2], pairs[:, 2:]
    affine = Affine.fit(p, q)
    similarity = fit_plane("similarity", p, q)
    reach = INITIAL.reach * scale_at(similarity, p)
    fits = (one for one in (similarity, affine) if np.hypot(*(one(p) - q).T).max() <= reach)
    chosen: Transform | None = next(fits, None)
    if chosen is None:
        try:
            chosen = Homography.fit(p, q)
        except ValueError:
            chosen = affine
    mirrored = bool(np.linalg.det(affine.matrix[:, :2]) < 0)
    return InitialTransform(chosen, p, q, np.ones(len(p), bool), mirrored)


def begin_with(
    transform: Transform, reference: CameraFeatures, target: CameraFeatures
) -> InitialTransform:
    """Return a declared map as initial transform, refined by key points near where it puts them, if any agree."""
    centre = (np.array([reference.shape[::-1]]) - 1) / 2
    mirrored = bool(np.linalg.det(transform.jacobian(centre)[0]) < 0)
    none = np.empty((0, 2))
    first = InitialTransform(transform, none, none, np.zeros(0, bool), mirrored)
    return _rematch_all(first, reference, target)


def _rematch_all(
    first: InitialTransform, reference: CameraFeatures, target: CameraFeatures
) -> InitialTransform:
    """Refine by key points near where the pairs put them; the picture pair with most agreeing ones wins."""
    best = first
    for side in (INITIAL.long_side, 2 * INITIAL.long_side):
        for i, j in np.ndindex(len(reference.greys), len(target.greys)):
            ours, theirs = reference.key_points(side, i), target.key_points(side, j)
            tried = rematch(first, ours, theirs, reference.shape)
            if tried.count > max(best.count, 3 * len(first.kept)):
                best = tried
        if best is not first:
            break
    return best


# --- from pairs of another program


def agreeing_pairs(transform: Transform, pairs: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return which pairs, (n, 4), agree with a map within 0.5 % of the longer side of the reference, (height, width), at least 3 px, (n,) bool.

    >>> pairs = np.array([[10.0, 10, 12, 10], [50, 20, 90, 20]])
    >>> agreeing_pairs(Affine.identity(), pairs, (100, 100)).tolist()
    [True, False]
    """
    found = np.nan_to_num(transform(pairs[:, :2]), nan=np.inf)
    reach = max(INITIAL.reach, PAIR_SHARE * max(shape)) * _scales(transform, pairs)
    return np.asarray(np.linalg.norm(found - pairs[:, 2:], axis=1) <= reach)


def start_candidates(pairs: np.ndarray, shape: tuple[int, ...]) -> Iterator[InitialTransform]:
    """Yield the transforms on which pairs, (n, 4), agree, wrong ones among them: that of the largest set, then of those that are left.

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> right = rng.uniform(0, 200, (12, 2))
    >>> wrong = rng.uniform(0, 200, (8, 4))
    >>> begun = next(start_candidates(np.vstack([np.hstack([right, right + 5]), wrong]), (200, 200)))
    >>> int(begun.count), begun.transform(np.array([[50.0, 60.0]])).round(3).tolist()
    (12, [[55.0, 65.0]])
    """
    reach = max(INITIAL.reach, PAIR_SHARE * max(shape))
    left = np.isfinite(pairs).all(1)
    for _ in range(CANDIDATES):
        rows = np.flatnonzero(left)
        if len(rows) < LEAST_SET:
            return
        p, q = pairs[rows, :2], pairs[rows, 2:]
        tried = [magsac(p, q, mirror, reach)[1] for mirror in (False, True)]
        inside = max(tried, key=lambda one: int(one.sum()))
        if inside.sum() < LEAST_SET:
            return
        begun = fit_initial_transform(pairs[rows[inside]])
        kept = np.zeros(len(pairs), bool)
        kept[rows[inside]], left[rows[inside]] = True, False
        low, high = np.percentile(p[inside], (2, 98), axis=0)
        # The sampling is judged with the map: maps of a scan are far coarser than a camera's frames.
        if is_plausible(begun.transform, (*low, *high), begun.mirrored, (0.0, np.inf)):
            yield replace(
                begun, reference=pairs[:, :2], target=pairs[:, 2:], kept=kept, by_pairs=True
            )


def begin_with_pairs(
    candidate: InitialTransform, reference: CameraFeatures, target: CameraFeatures
) -> InitialTransform:
    """Return a candidate of a start, refined by key points near where it puts them; as it is, where none agree."""
    found = begin_with(candidate.transform, reference, target)
    return found if found.count else candidate


# --- alignments of the sensors of one camera that are declared


def read_alignments(given: Mapping[str, Any]) -> dict[str, Transform]:
    """Return declared alignments, first sensor's px → each sensor's px, as maps; raises RegistrationRefused where a matrix is not (2, 3)."""
    return {name: _transform(name, matrix) for name, matrix in given.items()}


def declared_map(
    name: str, align: Mapping[str, Transform], known: Mapping[str, Transform]
) -> Transform | None:
    """Return reference px → px of a sensor by its declared alignment to one whose map is known; None without any.

    `align` are maps from the first sensor's px, `known` from reference px.

    Examples
    --------
    >>> align = {"ccd1": Affine.identity(), "ccd2": Affine(np.array([[1.0, 0, 5], [0, 1, 0]]))}
    >>> found = declared_map("ccd2", align, {"ccd1": Affine.scaling(2.0)})
    >>> found(np.array([[10.0, 20.0]])).tolist()
    [[25.5, 40.5]]
    """
    for other, transform in known.items():
        if other != name and other in align and name in align:
            return Composed(transform, Inverse(align[other]), align[name])
    return None


def distance_between(one: Transform, other: Transform, shape: Sequence[int]) -> float:
    """Return how far two maps lie apart, px of their target, the median over a frame (height, width)."""
    x, y = np.meshgrid(*(np.linspace(0, n - 1, 9) for n in shape[::-1]))
    points = np.stack([x, y], -1).reshape(-1, 2)
    miss = np.linalg.norm(one(points) - other(points), axis=1)
    return float(np.median(np.nan_to_num(miss, nan=np.inf)))


def _transform(name: str, given: Any) -> Transform:
    if isinstance(given, Transform):
        return given
    matrix = np.asarray(given, float)
    if matrix.shape != (2, 3) or not np.isfinite(matrix).all():
        raise refusal(
            "E_VALUE",
            f"the alignment of sensor {name!r} is not a matrix of numbers",
            field="align",
            found=str(matrix.shape),
            expected="2 rows of 3 numbers: px of the first sensor → px of this one",
        )
    return Affine(matrix)
