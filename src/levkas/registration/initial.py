"""Initial transform: scale 0.2 to 5, any rotation, mirrored or with inverted contrast.

Key points that are each other's most alike give most sensors a homography by MAGSAC++ ([barath2020]_). Where too few of these agree, every
key point is matched with the few most alike ones, edges are looked at too, and what agrees in place, size and direction is sought among
thousands of matches by pose clustering. Matches near that transform refine it to a cubic polynomial. Where no key points agree, outlines do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np
from scipy.spatial import cKDTree

from levkas.core.problems import Problem
from levkas.core.threads import each
from levkas.geometry.transforms import Affine, Homography, Polynomial, Transform
from levkas.registration.advice import BETWEEN, BY_HAND, percent
from levkas.registration.features import (
    EDGES,
    CameraFeatures,
    KeyPoints,
    invert_descriptors,
    mirror_descriptors,
)
from levkas.registration.matching import TentativeMatches, match_mutually, match_widely, unique_rows
from levkas.registration.orientation_correlation import match_by_directions, match_near
from levkas.registration.pose_clustering import REACH, find_pose_cluster


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
    """Matches that have to agree; fewer than these are worth a wide search."""
    scales: tuple[float, float] = (0.14, 7.0)
    """Target px per reference px of a plausible map."""
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
        return scale_at(self.transform, np.concatenate([self.reference, np.zeros((1, 2))]))


def scale_at(transform: Transform, points: np.ndarray) -> float:
    """Return target px per reference px at the first of `points`, (n, 2)."""
    return float(np.sqrt(abs(np.linalg.det(transform.jacobian(points[:1])[0]))))


def find_initial_transform(
    reference: CameraFeatures, target: CameraFeatures
) -> InitialTransform | None:
    """Return the map that key points agree on, or that outlines do, or None.

    The first picture of each is tried first, then all pairs of them, both at twice the size, then the first ones widely, at last outlines.
    """
    return _by_key_points(reference, target) or _by_directions(reference, target)


def _by_key_points(reference: CameraFeatures, target: CameraFeatures) -> InitialTransform | None:
    pairs = [(i, j) for i in range(len(reference.greys)) for j in range(len(target.greys))][1:]
    # those of alike place in the spectrum before
    pairs.sort(key=lambda ij: abs(ij[0] / len(reference.greys) - ij[1] / len(target.greys)))
    for side in (SETTINGS.long_side, 2 * SETTINGS.long_side):
        for some in ([(0, 0)], pairs[: SETTINGS.most_pairs]):
            found = _attempt(reference, target, side, some)
            if found is not None:
                return found
        if max(*reference.shape, *target.shape) <= side:
            break
    return _search_widely(reference, target, SETTINGS.long_side)


def find_coarse_transform(
    reference: CameraFeatures, target: CameraFeatures
) -> InitialTransform | None:
    """Return the initial transform of a target that is sampled far more coarsely than the reference, as maps of a scan are.

    Key points agree as closely as the coarser picture shows them: the reference is reduced to about its sampling, then, since the
    target may show a part of the reference, half as much. A few key points of one part of the object say little of the others: large blocks refine
    the map by their outlines; where they do not agree with it, or there is none, outlines give it.
    """
    ratio = max(target.shape) / max(reference.shape)
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
                reference.greys, target.greys, stiff, reference.within, mirrored=found.mirrored
            )  # fmt: skip
            if blocks is not None:
                return replace(begun, transform=blocks.transform)
            break
    return _by_directions(reference, target) or begun


def _by_directions(reference: CameraFeatures, target: CameraFeatures) -> InitialTransform | None:
    """Return the affine map on which blocks agree by the directions of their edges, or None."""
    found = match_by_directions(reference.greys, target.greys, reference.within)
    return found and InitialTransform(*found, by_outlines=True)


def _attempt(
    ours: CameraFeatures, theirs: CameraFeatures, side: int, pairs: Sequence[tuple[int, int]]
) -> InitialTransform | None:
    """Return the map on which mutual matches of some pairs of pictures agree, as they are or mirrored, or None."""
    wanted = {(ours, i) for i, _ in pairs} | {(theirs, j) for _, j in pairs}
    each(lambda one: one[0].key_points(side, one[1]), list(wanted))  # several at a time
    points = [(ours.key_points(side, i), theirs.key_points(side, j)) for i, j in pairs]
    best, matched = None, 0
    for mirror in (False, True) if pairs else ():
        found = each(partial(match_mutually, mirror=mirror), *zip(*points, strict=True))
        every = TentativeMatches.joined(found)
        tried = fit_robustly(every, mirror, ours.shape) or _fit_cluster(every, mirror, ours.shape)
        if tried is None:
            continue
        if best is None or tried.count > 1.2 * best.count:
            best, matched = tried, max(range(len(pairs)), key=lambda k: len(found[k]))
        if tried.count > SETTINGS.sure_share * len(every):
            break
    if best is None:
        return None
    if best.count < SETTINGS.few_inliers:
        more = _search_widely(ours, theirs, side, best)
        if more is not best:
            return more
    return rematch(best, *points[matched], ours.shape)


def _search_widely(
    ours: CameraFeatures, theirs: CameraFeatures, side: int, begun: InitialTransform | None = None
) -> InitialTransform | None:
    """Find the similarity that most of very many matches agree on, edges among them; `begun`, of few, where nothing has more."""
    best = begun
    points = [(ours.key_points(side, i), theirs.key_points(side, i)) for i in (0, EDGES)]
    for mirror in (False, True):
        every = TentativeMatches.joined([match_widely(*both, mirror=mirror) for both in points])
        tried = _fit_cluster(every, mirror, ours.shape, widely=True)
        if tried and (best is None or tried.count > 1.2 * best.count):
            best = tried
    if best is None or best is begun:
        return begun
    again = [rematch(best, *both, ours.shape) for both in points]
    return max(again, key=lambda one: one.count)


def _fit_cluster(
    matches: TentativeMatches, mirror: bool, shape: tuple[int, ...], *, widely: bool = False
) -> InitialTransform | None:
    """Fit the map to the few matches of one pose cluster, where it drowns among all."""
    m, side = matches, max(shape)
    p = m.reference * (1, -1) if mirror else m.reference
    near = find_pose_cluster(p, m.target, m.growth, m.turn, m.likeness, side)
    if near is None:
        return None
    # What was let in widely lies near already: of that, some agree more closely by chance.
    chance = near.sum() * (SETTINGS.reach / (1.5 * REACH * side)) ** 2 if widely else None
    return fit_robustly(matches, mirror, shape, near, chance)


def fit_robustly(
    matches: TentativeMatches,
    mirror: bool,
    shape: tuple[int, ...],
    among: np.ndarray | None = None,
    chance: float | None = None,
) -> InitialTransform | None:
    """Fit a homography by MAGSAC++; None where no more matches agree than `chance` gives, by default of random pairs over the frame."""
    rows = np.arange(len(matches)) if among is None else np.flatnonzero(among)
    p, q = matches.reference[rows], matches.target[rows]
    if len(p) < SETTINGS.least_inliers:
        return None
    found, inside = magsac(p, q, mirror)
    if found is None:
        return None
    low, high = np.percentile(p[inside], (2, 98), axis=0) if inside.any() else (p[0], p[0])
    if chance is None:
        chance = len(matches) * np.pi * SETTINGS.reach**2 * 4 / (shape[0] * shape[1])
    least = max(SETTINGS.least_inliers, 8 + 6 * np.sqrt(chance) + chance)
    if not (inside.sum() >= least and is_plausible(found, (*low, *high), mirror)):
        return None
    kept = np.zeros(len(matches), bool)
    kept[rows[inside]] = True
    return InitialTransform(found, matches.reference, matches.target, kept, mirror)


def magsac(
    p: np.ndarray, q: np.ndarray, mirror: bool, reach: float = SETTINGS.reach
) -> tuple[Homography | None, np.ndarray]:
    """Return the homography p → q and which matches agree within `reach` px of p, (n,) bool; None where there is none."""
    settings = cv2.UsacParams()
    settings.threshold, settings.confidence = reach, 0.9999
    settings.maxIterations, settings.randomGeneratorState = 20000, 0
    settings.score, settings.sampler = cv2.SCORE_METHOD_MAGSAC, cv2.SAMPLING_UNIFORM
    settings.loMethod = cv2.LOCAL_OPTIM_SIGMA
    # OpenCV's sampler turns down all samples that change orientation.
    flip = np.diag([-1.0 if mirror else 1.0, 1.0, 1.0])
    try:
        matrix, mask = cv2.findHomography(q * np.diag(flip)[:2], p, settings)
        forward = flip @ np.linalg.inv(matrix) if matrix is not None else None
    except (cv2.error, np.linalg.LinAlgError):
        forward = None
    if forward is None or not np.isfinite(forward).all():
        return None, np.zeros(len(p), bool)
    return Homography(forward / forward[2, 2]), mask.reshape(-1).astype(bool)


def rematch(
    first: InitialTransform, ours: KeyPoints, theirs: KeyPoints, shape: tuple[int, ...]
) -> InitialTransform:
    """Match again, each point only against those where the first map expects its partner, and refit."""
    if not len(ours) or not len(theirs):
        return first
    reach = max(6.0, 0.015 * max(shape)) * first.scale
    expected = np.nan_to_num(first.transform(ours.points), nan=-1e9)
    nearest = np.arange(1, min(12, len(theirs)) + 1)
    near = cKDTree(theirs.points).query(expected, k=nearest, distance_upper_bound=reach)[1]
    candidates = np.minimum(near, len(theirs) - 1)
    upright = mirror_descriptors(theirs.descriptors) if first.mirrored else theirs.descriptors
    alike = np.maximum(
        *(
            np.einsum("nd,nkd->nk", ours.descriptors, of[candidates])
            for of in (upright, invert_descriptors(upright))
        )
    )
    alike[near >= len(theirs)] = -1
    rows, best = np.arange(len(alike)), alike.argmax(1)
    good = alike[rows, best] > SETTINGS.least_likeness
    p, q = ours.points[good], theirs.points[candidates[rows, best][good]]
    once = unique_rows(p, q)
    return refine(first, p[once], q[once])


def refine(
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
    for order in (2, 2, 2, 2, 3, 3, 3, 3):
        if kept.sum() < 4 * (order + 1) * (order + 2):
            continue
        error = np.linalg.norm(model(p) - q, axis=1) / scale
        spread = max(float(np.median(error[kept])), 0.05)
        # Where most matches are chance, their median error grows with what is let in.
        kept = (error < np.clip(4 * spread, 0.5, reach)) & free | fixed
        if kept.sum() >= 4 * (order + 1) * (order + 2):
            weights = 1 / (1 + (error[kept] / (2 * spread)) ** 2)
            weights[fixed[kept]] = 1.0
            model = Polynomial.fit(p[kept], q[kept], order=order, weights=weights)
    if kept.sum() < SETTINGS.least_inliers:
        return first
    return InitialTransform(model, p, q, kept, first.mirrored)


# --- which maps are plausible


def is_plausible(
    transform: Transform,
    box: Sequence[float],
    mirrored: bool,
    scales: tuple[float, float] = SETTINGS.scales,
) -> bool:
    """Whether the Jacobian keeps its sign and scales stay in `scales`, 0.14 to 7, all over a box (x0, y0, x1, y1), reference px."""
    values, steady = _local_shape(transform, box, mirrored)
    return steady and bool(((values > scales[0]) & (values < scales[1])).all())


def implausible(
    transform: Transform,
    box: Sequence[float],
    mirrored: bool,
    sensor: str | None,
    share: float,
    scales: tuple[float, float] = SETTINGS.scales,
) -> Problem:
    """Return why the map of a sensor is not plausible: its scale alone, or its shape; `share` is how much of the reference it takes."""
    values, steady = _local_shape(transform, box, mirrored)
    low, high = scales
    if not steady or ((values > low) & (values < high)).all():
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
        found=f"{float(np.median(values)):.2g} of its px to one of the reference",
        expected=f"{low:.2g} to {high:.2g}",
        fix=f"{BETWEEN}.",
    )


def _local_shape(
    transform: Transform, box: Sequence[float], mirrored: bool
) -> tuple[np.ndarray, bool]:
    """Return both scales of the Jacobian all over a box, (n, 2), and whether it neither folds nor stretches or grows more than a camera can."""
    at = np.linspace(0.05, 0.95, 7)
    x, y = np.meshgrid(box[0] + at * (box[2] - box[0]), box[1] + at * (box[3] - box[1]))
    jacobian = transform.jacobian(np.stack([x, y], -1).reshape(-1, 2))
    if not np.isfinite(jacobian).all():
        return np.zeros((1, 2)), False
    values = np.linalg.svd(jacobian, compute_uv=False)
    determinant = np.linalg.det(jacobian) * (-1 if mirrored else 1)
    even = determinant.min() > 0.2 * determinant.max() and (values[:, 0] < 3 * values[:, 1]).all()
    return values, bool(even and determinant.min() > 0)
