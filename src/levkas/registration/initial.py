"""Initial transform: scale 0.2 to 5, any rotation, mirrored or with inverted contrast.

Key points that are each other's most alike give most sensors a homography by MAGSAC++ ([barath2020]_). Where too
few of these agree, every key point is matched with the few most alike ones, edges are looked at too, and
what agrees in place, size and direction is sought among thousands of matches by pose clustering. Matches near
that transform refine it to a cubic polynomial. Pairs given by hand start the search where key points
find nothing, or something else. Pairs of another program, which may be wrong, are candidates of a start: the largest sets of them that
agree on a homography, one after another.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
from scipy.spatial import cKDTree

from levkas.core.problems import Problem
from levkas.core.threads import each
from levkas.geometry.transforms import Affine, Homography, Polynomial, Transform
from levkas.registration.advice import BETWEEN, BY_HAND, LEAST_PAIRS, percent
from levkas.registration.features import (
    KeyPoints,
    ScaledFeatures,
    invert_descriptors,
    mirror_descriptors,
)
from levkas.registration.matching import TentativeMatches, match_mutually, match_widely, unique_rows
from levkas.registration.models import fit_plane
from levkas.registration.orientation_correlation import match_by_directions, match_near
from levkas.registration.pose_clustering import REACH, find_pose_cluster

if TYPE_CHECKING:
    from levkas.registration.features import CameraFeatures
    from levkas.registration.manual_points import ManualPoints


@dataclass(frozen=True)
class InitialSettings:
    """Constants of the initial transform."""

    long_side: int = 1000
    """In px: of the pictures in which key points are found first; then twice that."""
    most_pairs: int = 8
    """Pairs of grey pictures beyond the first that are tried."""
    sure_share: float = 0.3
    """Share of matches that agree from which the mirror image is not tried."""
    least_likeness: float = 0.8
    """Dot product of the descriptors of matches near a transform."""
    reach: float = 3.0
    """In px: residual up to which matches agree."""
    least_inliers: int = 12
    few_inliers: int = 40
    """`least_inliers`, `few_inliers`: matches that have to agree; fewer than these are worth a wide search."""
    scales: tuple[float, float] = (0.14, 7.0)
    """Target px per reference px of a plausible map."""
    least_contradiction: float = 8.0
    contradiction_share: float = 0.01
    """`least_contradiction`, `contradiction_share`: reference px, and share of the longer side, by which pairs by hand
    contradict key points."""
    candidates: int = 3
    """Sets of pairs of another program that are tried."""
    least_pairs: int = 6
    """Pairs of such a set: four determine a homography, two more agree with it."""
    pair_share: float = 0.005
    """Share of the longer side up to which they agree, as far as a search on coarse grids makes good."""
    coarse_sampling: tuple[float, ...] = (2.0, 4.0)
    """Longer sides of the reference over that of maps of a scan, to which it is reduced before key points are found."""


SETTINGS = InitialSettings()


@dataclass(frozen=True)
class InitialTransform:
    """Initial map of one sensor and the matches on which it rests."""

    transform: Transform
    """Reference px → native px of the sensor."""
    reference: np.ndarray
    target: np.ndarray
    """`reference`, `target`: (n, 2). All matches that were tried, in px of either image; `kept` marks those that agree."""
    kept: np.ndarray
    """(n,)."""
    mirrored: bool
    reason: np.ndarray | None = None
    """(n,). `HandMark` of each match."""
    by_outlines: bool = False
    """Whether no key points agreed, and blocks were matched by the directions of their edges."""
    by_pairs: bool = False
    """Whether no key points agreed, and the matches are pairs of another program."""

    @property
    def count(self) -> int:
        """How many matches agree."""
        return int(self.kept.sum())

    @property
    def scale(self) -> float:
        """Target px per reference px at the first match; without any at the frame's corner."""
        return _scale(self.transform, np.concatenate([self.reference, np.zeros((1, 2))]))


def _scale(transform: Transform, points: np.ndarray) -> float:
    return float(np.sqrt(abs(np.linalg.det(transform.jacobian(points[:1])[0]))))


def find_initial_transform(
    reference: CameraFeatures, target: CameraFeatures
) -> InitialTransform | None:
    """Return the map that key points agree on, or that outlines do, or None.

    The first picture of each is tried first, then all pairs of them, then the first ones widely, at last outlines.
    """
    return _by_key_points(reference, target) or _by_directions(reference, target)


def _by_key_points(reference: CameraFeatures, target: CameraFeatures) -> InitialTransform | None:
    for side in (SETTINGS.long_side, 2 * SETTINGS.long_side):
        ours, theirs = reference.at(side), target.at(side)
        for pairs in ([(0, 0)], _other_pairs(len(reference.greys), len(target.greys))):
            found = _attempt(ours, theirs, pairs)
            if found is not None:
                return found
        if max(max(pictures.greys[0].shape) for pictures in (reference, target)) <= side:
            break
    return _search_widely(reference.at(SETTINGS.long_side), target.at(SETTINGS.long_side))


def find_coarse_transform(
    reference: CameraFeatures, target: CameraFeatures
) -> InitialTransform | None:
    """Return the initial transform of a target that is sampled far more coarsely than the reference, as maps of a scan are.

    Key points agree as closely as the coarser picture shows them: the reference is reduced to about its sampling, then, since the
    target may show a part of the reference, half as much. A few key points of one part of the object say little of the others: large blocks refine
    the map by their outlines; where they do not agree with it, or there is none, outlines give it.
    """
    ratio = max(target.greys[0].shape) / max(reference.greys[0].shape)
    shares = [share for times in SETTINGS.coarse_sampling if (share := times * ratio) <= 0.5]
    if not shares:
        return find_initial_transform(reference, target)
    begun = None
    for reduced, back in map(reference.reduced, shares):
        found = _by_key_points(reduced, target)
        if found is not None:
            places = back(found.reference)
            stiff = Affine.fit(places[found.kept], found.target[found.kept])
            begun = replace(found, transform=stiff, reference=places)
            blocks = match_near(
                reference.greys[:],
                target.greys[:],
                stiff,
                reference.within,
                mirrored=found.mirrored,
            )
            if blocks is not None:
                return replace(begun, transform=blocks.transform)
            break
    return _by_directions(reference, target) or begun


def _by_directions(reference: CameraFeatures, target: CameraFeatures) -> InitialTransform | None:
    """Return the affine map on which blocks agree by the directions of their edges, or None."""
    matched = match_by_directions(reference.greys[:], target.greys[:], reference.within)
    if matched is None:
        return None
    return InitialTransform(
        matched.transform, matched.reference, matched.target, matched.kept, matched.mirrored,
        by_outlines=True,
    )  # fmt: skip


def _other_pairs(ours: int, theirs: int) -> list[tuple[int, int]]:
    """Return the pairs of pictures but the first, those of alike place in the spectrum before."""
    pairs = [(i, j) for i in range(ours) for j in range(theirs) if i or j]
    return sorted(pairs, key=lambda ij: abs(ij[0] / ours - ij[1] / theirs))[: SETTINGS.most_pairs]


def _attempt(
    ours: ScaledFeatures, theirs: ScaledFeatures, pairs: Sequence[tuple[int, int]]
) -> InitialTransform | None:
    best: InitialTransform | None = None
    best_pair = (0, 0)
    for mirror in (False, True) if pairs else ():
        found = _match_pictures(ours, theirs, pairs, mirror)
        every = TentativeMatches.joined(found)
        tried = fit_robustly(every, mirror, ours.shape) or _fit_cluster(every, mirror, ours.shape)
        if tried is None:
            continue
        if best is None or tried.count > 1.2 * best.count:
            best = tried
            best_pair = pairs[max(range(len(pairs)), key=lambda k: len(found[k]))]
        if tried.count > SETTINGS.sure_share * len(every):
            break
    if best is None:
        return None
    if best.count < SETTINGS.few_inliers:
        more = _search_widely(ours, theirs, best)
        if more is not best:
            return more
    return _rematch(best, ours[best_pair[0]], theirs[best_pair[1]], ours.shape)


def _match_pictures(
    ours: ScaledFeatures, theirs: ScaledFeatures, pairs: Sequence[tuple[int, int]], mirror: bool
) -> list[TentativeMatches]:
    """Match all pairs of pictures, several at a time."""
    wanted = [(ours, i) for i in sorted({i for i, _ in pairs})]
    wanted += [(theirs, j) for j in sorted({j for _, j in pairs})]
    each(lambda pictures: pictures[0][pictures[1]], wanted)
    return each(lambda ij: match_mutually(ours[ij[0]], theirs[ij[1]], mirror=mirror), pairs)


def _search_widely(
    ours: ScaledFeatures, theirs: ScaledFeatures, best: InitialTransform | None = None
) -> InitialTransform | None:
    """Find the similarity that most of very many matches agree on, edges among them.

    Returns `best`, which rests on few matches, where nothing has more.
    """
    begun, kinds = best, (0, ScaledFeatures.EDGES)
    for mirror in (False, True):
        every = TentativeMatches.joined(
            [match_widely(ours[i], theirs[i], mirror=mirror) for i in kinds]
        )
        tried = _fit_cluster(every, mirror, ours.shape, widely=True)
        if tried and (best is None or tried.count > 1.2 * best.count):
            best = tried
    if best is None or best is begun:
        return begun
    again = [_rematch(best, ours[i], theirs[i], ours.shape) for i in kinds]
    return max(again, key=lambda one: one.count)


def _fit_cluster(
    matches: TentativeMatches, mirror: bool, shape: tuple[int, ...], *, widely: bool = False
) -> InitialTransform | None:
    """Fit the map to the few matches of one pose cluster, where it drowns among all."""
    p = matches.reference * (1, -1) if mirror else matches.reference
    near = find_pose_cluster(
        p, matches.target, matches.growth, matches.turn, matches.likeness, max(shape)
    )
    if near is None:
        return None
    if not widely:
        return fit_robustly(matches, mirror, shape, near)
    # What was let in lies near already: of that, some agree more closely by chance.
    chance = near.sum() * (SETTINGS.reach / (1.5 * REACH * max(shape))) ** 2
    return fit_robustly(matches, mirror, shape, near, chance)


def fit_robustly(
    matches: TentativeMatches,
    mirror: bool,
    shape: tuple[int, ...],
    among: np.ndarray | None = None,
    chance: float | None = None,
) -> InitialTransform | None:
    """Fit a homography by MAGSAC++; None where no more matches agree than `chance` gives."""
    rows = np.arange(len(matches)) if among is None else np.flatnonzero(among)
    p, q = matches.reference[rows], matches.target[rows]
    if len(p) < SETTINGS.least_inliers:
        return None
    found, inside = _magsac(p, q, mirror)
    if found is None:
        return None
    # Matches that agree must be more than chance gives: the spread of random pairs over the frame.
    low, high = np.percentile(p[inside], (2, 98), axis=0) if inside.any() else (p[0], p[0])
    if chance is None:
        chance = len(matches) * np.pi * SETTINGS.reach**2 * 4 / (shape[0] * shape[1])
    least = max(SETTINGS.least_inliers, 8 + 6 * np.sqrt(chance) + chance)
    if not (inside.sum() >= least and is_plausible(found, (*low, *high), mirror)):
        return None
    kept = np.zeros(len(matches), bool)
    kept[rows[inside]] = True
    return InitialTransform(found, matches.reference, matches.target, kept, mirror)


def _magsac(
    p: np.ndarray, q: np.ndarray, mirror: bool, reach: float = SETTINGS.reach
) -> tuple[Homography | None, np.ndarray]:
    """Return the homography p → q and which matches agree within `reach` px of p, (n,) bool; None where there is none."""
    settings = cv2.UsacParams()
    settings.threshold, settings.confidence = reach, 0.9999
    settings.maxIterations, settings.randomGeneratorState = 20000, 0
    settings.score, settings.sampler = cv2.SCORE_METHOD_MAGSAC, cv2.SAMPLING_UNIFORM
    settings.loMethod = cv2.LOCAL_OPTIM_SIGMA
    try:
        # OpenCV's sampler turns down all samples that change orientation.
        flip = np.diag([-1.0 if mirror else 1.0, 1.0, 1.0])
        matrix, mask = cv2.findHomography(q * np.diag(flip)[:2], p, settings)
        forward = flip @ np.linalg.inv(matrix) if matrix is not None else None
    except (cv2.error, np.linalg.LinAlgError):
        forward = None
    if forward is None or not np.isfinite(forward).all():
        return None, np.zeros(len(p), bool)
    return Homography(forward / forward[2, 2]), mask.reshape(-1).astype(bool)


def is_plausible(
    transform: Transform,
    box: Sequence[float],
    mirrored: bool,
    scales: tuple[float, float] = SETTINGS.scales,
) -> bool:
    """Whether the Jacobian keeps its sign and scales stay in `scales`, 0.14 to 7, all over a box.

    `box` is (x0, y0, x1, y1) in reference px.
    """
    values, determinant = _local_shape(transform, box, mirrored)
    low, high = scales
    in_range = (values > low).all() and (values < high).all()
    return bool(in_range and _is_steady(values, determinant))


def implausible(
    transform: Transform,
    box: Sequence[float],
    mirrored: bool,
    sensor: str | None,
    share: float,
    scales: tuple[float, float] = SETTINGS.scales,
) -> Problem:
    """Return why the map of a sensor is not plausible: its scale alone, or its shape.

    `box` as of `is_plausible`; `share` is how much of the reference it takes.
    """
    values, determinant = _local_shape(transform, box, mirrored)
    low, high = scales
    scale = float(np.median(values))
    if not _is_steady(values, determinant) or ((values > low) & (values < high)).all():
        return Problem(
            "E_FOLD",
            "the map of this sensor folds, or stretches more than a camera can",
            field=sensor,
            found=f"windows that match over {percent(share)} of the reference",
            fix=BY_HAND,
        )
    return Problem(
        "E_SCALE",
        "this sensor samples the object too unlike the reference to be registered",
        field=sensor,
        found=f"{scale:.2g} of its px to one of the reference",
        expected=f"{low:.2g} to {high:.2g}",
        fix=f"{BETWEEN}.",
    )


def _is_steady(values: np.ndarray, determinant: np.ndarray) -> bool:
    """Whether a map neither folds nor stretches or grows more than a camera can."""
    even = determinant.min() > 0.2 * determinant.max() and (values[:, 0] < 3 * values[:, 1]).all()
    return bool(even and determinant.min() > 0)


def _local_shape(
    transform: Transform, box: Sequence[float], mirrored: bool
) -> tuple[np.ndarray, np.ndarray]:
    """Return both scales (n, 2), and the determinant (n,), of the Jacobian all over a box; of none, zeros."""
    at = np.linspace(0.05, 0.95, 7)
    x, y = np.meshgrid(box[0] + at * (box[2] - box[0]), box[1] + at * (box[3] - box[1]))
    jacobian = transform.jacobian(np.stack([x, y], -1).reshape(-1, 2))
    if not np.isfinite(jacobian).all():
        return np.zeros((1, 2)), np.zeros(1)
    values = np.linalg.svd(jacobian, compute_uv=False)
    return values, np.linalg.det(jacobian) * (-1 if mirrored else 1)


def _rematch(
    first: InitialTransform, ours: KeyPoints, theirs: KeyPoints, shape: tuple[int, ...]
) -> InitialTransform:
    """Match again, each point only against those where the first map expects its partner."""
    if not len(ours) or not len(theirs):
        return first
    reach = max(6.0, 0.015 * max(shape)) * first.scale
    expected = np.nan_to_num(first.transform(ours.points), nan=-1e9)
    count = min(12, len(theirs))
    near = cKDTree(theirs.points).query(expected, k=count, distance_upper_bound=reach)[1]
    near = near.reshape(len(expected), -1)
    candidates = np.minimum(near, len(theirs) - 1)
    upright = mirror_descriptors(theirs.descriptors) if first.mirrored else theirs.descriptors
    alike = np.maximum(
        np.einsum("nd,nkd->nk", ours.descriptors, upright[candidates]),
        np.einsum("nd,nkd->nk", ours.descriptors, invert_descriptors(upright)[candidates]),
    )
    alike[near >= len(theirs)] = -1
    rows, best = np.arange(len(alike)), alike.argmax(1)
    good = alike[rows, best] > SETTINGS.least_likeness
    p, q = ours.points[good], theirs.points[candidates[rows, best][good]]
    once = unique_rows(p, q)
    return _refine(first, p[once], q[once])


def _refine(
    first: InitialTransform,
    p: np.ndarray,
    q: np.ndarray,
    fixed: np.ndarray | None = None,
    dropped: np.ndarray | None = None,
) -> InitialTransform:
    """Refit from homography to cubic on new matches by iterative re-weighting, each from the one before.

    Matches of the mask `fixed` stay, whatever their error; those of `dropped` are never used.
    """
    fixed = np.zeros(len(p), bool) if fixed is None else fixed
    free = np.ones(len(p), bool) if dropped is None else ~dropped
    model, scale, reach = first.transform, first.scale, SETTINGS.reach
    kept = (np.linalg.norm(model(p) - q, axis=1) < reach * scale) & free | fixed
    for order in (2, 3):
        least = 4 * (order + 1) * (order + 2)
        if kept.sum() < least:
            break
        for _ in range(4):
            error = np.linalg.norm(model(p) - q, axis=1) / scale
            spread = max(float(np.median(error[kept])), 0.05)
            # Where most matches are chance, their median error grows with what is let in.
            kept = (error < np.clip(4 * spread, 0.5, reach)) & free | fixed
            if kept.sum() < least:
                break
            weights = 1 / (1 + (error[kept] / (2 * spread)) ** 2)
            weights[fixed[kept]] = 1.0
            model = Polynomial.fit(p[kept], q[kept], order=order, weights=weights)
    if kept.sum() < SETTINGS.least_inliers:
        return first
    return InitialTransform(model, p, q, kept, first.mirrored)


# --- from pairs given by hand


def seed_with_points(
    found: InitialTransform | None,
    by_hand: ManualPoints,
    reference: CameraFeatures,
    target: CameraFeatures,
) -> InitialTransform | None:
    """Return the initial transform that pairs by hand and key points together give.

    Parameters
    ----------
    found : InitialTransform or None
        By key points alone.
    by_hand : ManualPoints
        Of this sensor.

    Returns
    -------
    initial : InitialTransform or None
        None where there are neither key points nor four pairs by hand. Where most of the pairs
        contradict what key points found, the pairs are taken.
    """
    fixed = by_hand.fixed
    shape = reference.greys[0].shape
    if found is None or _contradicts(found, fixed, shape):
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
    return replace(_refine(first, p, q, marked.fixed, marked.dropped), reason=marked.reason)


def fit_initial_transform(pairs: np.ndarray) -> InitialTransform:
    """Fit a transform to pairs alone: the stiffest of similarity, affine and homography that fits.

    Parameters
    ----------
    pairs : ndarray, (n, 4), n >= 4
        Reference x, y and target x, y.

    Examples
    --------
    >>> corners = np.array([[0.0, 0], [9, 0], [9, 9], [0, 9]])
    >>> begun = fit_initial_transform(np.hstack([corners, 2 * corners + 1]))
    >>> begun.transform(np.array([[4.0, 5.0]])).round(6).tolist(), begun.mirrored
    ([[9.0, 11.0]], False)
    """
    p, q = pairs[:, :2], pairs[:, 2:]
    affine = Affine.fit(p, q)
    mirrored, kept = bool(np.linalg.det(affine.matrix[:, :2]) < 0), np.ones(len(p), bool)
    similarity = fit_plane("similarity", p, q)
    reach = SETTINGS.reach * _scale(similarity, p)
    for chosen in (similarity, affine):
        if np.linalg.norm(chosen(p) - q, axis=1).max() <= reach:
            return InitialTransform(chosen, p, q, kept, mirrored)
    try:
        return InitialTransform(Homography.fit(p, q), p, q, kept, mirrored)
    except ValueError:
        return InitialTransform(affine, p, q, kept, mirrored)


def begin_with(
    transform: Transform, reference: CameraFeatures, target: CameraFeatures
) -> InitialTransform:
    """Return a declared map as initial transform, refined by key points near where it puts them, if any agree."""
    centre = (np.array([reference.greys[0].shape[::-1]]) - 1) / 2
    none = np.empty((0, 2))
    mirrored = bool(np.linalg.det(transform.jacobian(centre)[0]) < 0)
    first = InitialTransform(transform, none, none, np.zeros(0, bool), mirrored)
    return _rematch_all(first, reference, target)


# --- from pairs of another program


def _pair_reach(shape: tuple[int, ...]) -> float:
    return max(SETTINGS.reach, SETTINGS.pair_share * max(shape))


def agreeing_pairs(transform: Transform, pairs: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return which pairs, (n, 4), agree with a map as closely as those of one candidate do, (n,) bool.

    `shape` is the (height, width) of the reference.

    Examples
    --------
    >>> pairs = np.array([[10.0, 10, 12, 10], [50, 20, 90, 20]])
    >>> agreeing_pairs(Affine.identity(), pairs, (100, 100)).tolist()
    [True, False]
    """
    found = np.nan_to_num(transform(pairs[:, :2]), nan=np.inf)
    scale = np.sqrt(np.abs(np.linalg.det(transform.jacobian(pairs[:, :2]))))
    return np.asarray(np.linalg.norm(found - pairs[:, 2:], axis=1) <= _pair_reach(shape) * scale)


def start_candidates(pairs: np.ndarray, shape: tuple[int, ...]) -> Iterator[InitialTransform]:
    """Yield the transforms on which pairs agree, wrong ones among them: that of the largest set, then of those that are left.

    Parameters
    ----------
    pairs : ndarray, (n, 4)
        Reference x, y and target x, y; any share of them may be wrong.
    shape : (height, width) of the reference

    Examples
    --------
    >>> rng = np.random.default_rng(1)
    >>> right = rng.uniform(0, 200, (12, 2))
    >>> wrong = rng.uniform(0, 200, (8, 4))
    >>> begun = next(start_candidates(np.vstack([np.hstack([right, right + 5]), wrong]), (200, 200)))
    >>> int(begun.count), begun.transform(np.array([[50.0, 60.0]])).round(3).tolist()
    (12, [[55.0, 65.0]])
    """
    reach = _pair_reach(shape)
    left = np.isfinite(pairs).all(1)
    for _ in range(SETTINGS.candidates):
        rows = np.flatnonzero(left)
        if len(rows) < SETTINGS.least_pairs:
            return
        p, q = pairs[rows, :2], pairs[rows, 2:]
        _, inside = max(
            (_magsac(p, q, mirror, reach) for mirror in (False, True)),
            key=lambda one: int(one[1].sum()),
        )
        if inside.sum() < SETTINGS.least_pairs:
            return
        begun = fit_initial_transform(pairs[rows[inside]])
        kept = np.zeros(len(pairs), bool)
        kept[rows[inside]] = True
        left[rows[inside]] = False
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


def _rematch_all(
    first: InitialTransform, reference: CameraFeatures, target: CameraFeatures
) -> InitialTransform:
    """Refine by key points near where the pairs put them; the picture pair with most agreeing ones wins."""
    best = first
    for side in (SETTINGS.long_side, 2 * SETTINGS.long_side):
        ours, theirs = reference.at(side), target.at(side)
        for i in range(len(reference.greys)):
            for j in range(len(target.greys)):
                tried = _rematch(first, ours[i], theirs[j], ours.shape)
                if tried.count > max(best.count, 3 * len(first.kept)):
                    best = tried
        if best is not first:
            break
    return best


def _contradicts(found: InitialTransform, fixed: np.ndarray, shape: tuple[int, ...]) -> bool:
    if not len(fixed):
        return False
    miss = np.linalg.norm(found.transform(fixed[:, :2]) - fixed[:, 2:], axis=1)
    scale = np.sqrt(np.abs(np.linalg.det(found.transform.jacobian(fixed[:, :2]))))
    off = np.nan_to_num(miss / np.maximum(scale, 1e-9), nan=np.inf)
    most = max(SETTINGS.least_contradiction, SETTINGS.contradiction_share * max(shape))
    return bool(np.median(off) > most)
