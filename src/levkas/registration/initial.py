"""The wide-baseline start: scale 0.2 to 5, any rotation, mirrored or with inverted contrast.

Key points that are each other's most alike start most sensors. Where too few of these agree, every key
point is paired with the few most alike ones, edges are looked at too, and what agrees in place, size and
direction is sought among thousands of pairs: one in two hundred may be right.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.machine import count_threads
from levkas.geometry.transforms import Homography, Polynomial, Transform
from levkas.registration.key_points import Detector, inverted, mirrored
from levkas.registration.pairing import Pairs, pair, pair_widely, unique
from levkas.registration.pose_clustering import REACH, vote

if TYPE_CHECKING:
    from levkas.registration.key_points import KeyPictures, KeyPoints

LONG_SIDE_PX = 1000
MOST_PAIRS = 8
MOST_THREADS = 2
SURE_SHARE = 0.3
LEAST_LIKENESS = 0.8
REACH_PX = 3.0
LEAST_INLIERS = 12
FEW_INLIERS = 40
SCALES = (0.14, 7.0)


@dataclass(frozen=True)
class Start:
    """A first map of one sensor and what it rests on.

    Parameters
    ----------
    transform : Transform
        Reference px → native px of the sensor.
    reference, target : ndarray, (n, 2)
        All pairs that were tried, in px of either image; `kept` marks those that agree.
    mirrored : bool
    reason : ndarray of str, (n,), optional
        What a person said of a pair, as `given.Marked` has it.
    """

    transform: Transform
    reference: np.ndarray
    target: np.ndarray
    kept: np.ndarray
    mirrored: bool
    reason: np.ndarray | None = None


def start(reference: KeyPictures, target: KeyPictures) -> Start | None:
    """Return the map that key points agree on, or None where they do not.

    The first picture of each is tried first, then all pairs of them, at last the first ones widely.
    """
    for side in (LONG_SIDE_PX, 2 * LONG_SIDE_PX):
        ours, theirs = reference.at(side), target.at(side)
        for pairs in ([(0, 0)], _other_pairs(len(reference.greys), len(target.greys))):
            found = _attempt(ours, theirs, pairs)
            if found is not None:
                return found
        if max(max(pictures.greys[0].shape) for pictures in (reference, target)) <= side:
            break
    return _search(reference.at(LONG_SIDE_PX), target.at(LONG_SIDE_PX))


def _other_pairs(ours: int, theirs: int) -> list[tuple[int, int]]:
    """All pairs but the first, those of alike place in the spectrum before, at most nine."""
    pairs = [(i, j) for i in range(ours) for j in range(theirs) if i or j]
    return sorted(pairs, key=lambda ij: abs(ij[0] / ours - ij[1] / theirs))[:MOST_PAIRS]


def _attempt(ours: Detector, theirs: Detector, pairs: Sequence[tuple[int, int]]) -> Start | None:
    best: tuple[int, Start, tuple[int, int]] | None = None
    for mirror in (False, True) if pairs else ():
        found = _pairs(ours, theirs, pairs, mirror)
        every = Pairs.joined(found)
        fitted = _consensus(every, mirror, ours.shape) or _voted(every, mirror, ours.shape)
        if fitted is None:
            continue
        count = int(fitted[1].sum())
        if best is None or count > 1.2 * best[0]:
            most = max(range(len(pairs)), key=lambda k: len(found[k]))
            start = Start(fitted[0], every.p, every.q, fitted[1], mirror)
            best = count, start, pairs[most]
        if count > SURE_SHARE * len(every):
            break
    if best is None:
        return None
    if best[0] < FEW_INLIERS:
        more = _search(ours, theirs, best[1])
        if more is not best[1]:
            return more
    return rematch(best[1], ours[best[2][0]], theirs[best[2][1]], ours.shape)


def _pairs(
    ours: Detector, theirs: Detector, pairs: Sequence[tuple[int, int]], mirror: bool
) -> list[Pairs]:
    """Match all pairs of pictures, two at a time where there are several."""
    with ThreadPoolExecutor(count_threads(MOST_THREADS)) as pool:
        wanted = [(ours, i) for i in sorted({i for i, _ in pairs})]
        wanted += [(theirs, j) for j in sorted({j for _, j in pairs})]
        list(pool.map(lambda one: one[0][one[1]], wanted))
        return list(pool.map(lambda ij: pair(ours[ij[0]], theirs[ij[1]], mirror=mirror), pairs))


def _search(ours: Detector, theirs: Detector, best: Start | None = None) -> Start | None:
    """Look for the similarity that most of very many pairs agree on, edges among them.

    Returns `best`, a start on few pairs, where nothing has more.
    """
    begun = best
    for mirror in (False, True):
        every = Pairs.joined(
            [pair_widely(ours[i], theirs[i], mirror=mirror) for i in (0, Detector.EDGES)]
        )
        fitted = _voted(every, mirror, ours.shape, widely=True)
        if fitted and (best is None or fitted[1].sum() > 1.2 * best.kept.sum()):
            best = Start(fitted[0], every.p, every.q, fitted[1], mirror)
    if best is None or best is begun:
        return begun
    again = [rematch(best, ours[i], theirs[i], ours.shape) for i in (0, Detector.EDGES)]
    return max(again, key=lambda start: int(start.kept.sum()))


def _voted(
    pairs: Pairs, mirror: bool, ours: tuple[int, ...], *, widely: bool = False
) -> tuple[Homography, np.ndarray] | None:
    """Find the map among the few pairs that agree on a similarity, where it drowns among all."""
    p = pairs.p * (1, -1) if mirror else pairs.p
    near = vote(p, pairs.q, pairs.growth, pairs.turn, pairs.likeness, max(ours))
    if near is None:
        return None
    if not widely:
        return _consensus(pairs, mirror, ours, near)
    # What was let in lies near already: of that, some agree more closely by chance.
    chance = near.sum() * (REACH_PX / (1.5 * REACH * max(ours))) ** 2
    return _consensus(pairs, mirror, ours, near, chance)


def _consensus(
    pairs: Pairs,
    mirror: bool,
    ours: tuple[int, ...],
    among: np.ndarray | None = None,
    chance: float | None = None,
) -> tuple[Homography, np.ndarray] | None:
    import cv2

    rows = np.arange(len(pairs)) if among is None else np.flatnonzero(among)
    p, q = pairs.p[rows], pairs.q[rows]
    if len(p) < LEAST_INLIERS:
        return None
    settings = cv2.UsacParams()
    settings.threshold, settings.confidence, settings.maxIterations = REACH_PX, 0.9999, 20000
    settings.score, settings.sampler = cv2.SCORE_METHOD_MAGSAC, cv2.SAMPLING_UNIFORM
    settings.loMethod, settings.randomGeneratorState = cv2.LOCAL_OPTIM_SIGMA, 0
    try:
        # OpenCV's sampler turns down all samples that change orientation.
        flip = np.diag([-1.0 if mirror else 1.0, 1.0, 1.0])
        matrix, mask = cv2.findHomography(q * np.diag(flip)[:2], p, settings)
        forward = flip @ np.linalg.inv(matrix) if matrix is not None else None
    except (cv2.error, np.linalg.LinAlgError):
        return None
    if forward is None or not np.isfinite(forward).all():
        return None
    found = Homography(forward / forward[2, 2])
    inside = mask.reshape(-1).astype(bool)
    # Matches that agree must be more than chance gives: the spread of random pairs over the frame.
    low, high = np.percentile(p[inside], (2, 98), axis=0) if inside.any() else (p[0], p[0])
    box = (*low, *high)
    if chance is None:
        chance = len(pairs) * np.pi * REACH_PX**2 * 4 / (ours[0] * ours[1])
    enough = inside.sum() >= max(LEAST_INLIERS, 8 + 6 * np.sqrt(chance) + chance)
    if not (enough and plausible(found, box, mirror)):
        return None
    kept = np.zeros(len(pairs), bool)
    kept[rows[inside]] = True
    return found, kept


def plausible(transform: Transform, box: Sequence[float], mirrored: bool) -> bool:
    """Whether the Jacobian keeps its sign and scales stay in 0.14 to 7 all over a box.

    `box` is (x0, y0, x1, y1) in reference px.
    """
    at = np.linspace(0.05, 0.95, 7)
    x, y = np.meshgrid(box[0] + at * (box[2] - box[0]), box[1] + at * (box[3] - box[1]))
    jacobian = transform.jacobian(np.stack([x, y], -1).reshape(-1, 2))
    if not np.isfinite(jacobian).all():
        return False
    values = np.linalg.svd(jacobian, compute_uv=False)
    determinant = np.linalg.det(jacobian) * (-1 if mirrored else 1)
    in_range = (values > SCALES[0]).all() and (values < SCALES[1]).all()
    steady = determinant.min() > 0.2 * determinant.max() and (values[:, 0] < 3 * values[:, 1]).all()
    return bool(in_range and steady and determinant.min() > 0)


def rematch(first: Start, ours: KeyPoints, theirs: KeyPoints, shape: tuple[int, ...]) -> Start:
    """Match again, each point only against those where the first map expects its partner."""
    if not len(ours.positions) or not len(theirs.positions):
        return first
    from scipy.spatial import cKDTree

    scale = float(np.sqrt(abs(np.linalg.det(first.transform.jacobian(first.reference[:1])[0]))))
    reach = max(6.0, 0.015 * max(shape)) * scale
    expected = np.nan_to_num(first.transform(ours.positions), nan=-1e9)
    count = min(12, len(theirs.positions))
    near = cKDTree(theirs.positions).query(expected, k=count, distance_upper_bound=reach)[1]
    near = near.reshape(len(expected), -1)
    candidates = np.minimum(near, len(theirs.positions) - 1)
    flipped = mirrored(theirs.descriptors) if first.mirrored else theirs.descriptors
    alike = np.maximum(
        np.einsum("nd,nkd->nk", ours.descriptors, flipped[candidates]),
        np.einsum("nd,nkd->nk", ours.descriptors, inverted(flipped)[candidates]),
    )
    alike[near >= len(theirs.positions)] = -1
    rows, best = np.arange(len(alike)), alike.argmax(1)
    good = alike[rows, best] > LEAST_LIKENESS
    p, q = ours.positions[good], theirs.positions[candidates[rows, best][good]]
    once = unique(p, q)
    return polish(first, p[once], q[once])


def polish(
    first: Start,
    p: np.ndarray,
    q: np.ndarray,
    sure: np.ndarray | None = None,
    dropped: np.ndarray | None = None,
) -> Start:
    """Robust refit from homography to cubic on the new pairs, each from the one before.

    Pairs of the mask `sure` stay, whatever their error; those of `dropped` are never used.
    """
    sure = np.zeros(len(p), bool) if sure is None else sure
    free = np.ones(len(p), bool) if dropped is None else ~dropped
    model: Transform = first.transform
    scale = float(np.sqrt(abs(np.linalg.det(model.jacobian(first.reference[:1])[0]))))
    kept = (np.linalg.norm(model(p) - q, axis=1) < REACH_PX * scale) & free | sure
    for order in (2, 3):
        if kept.sum() < 4 * (order + 1) * (order + 2):
            break
        for _ in range(4):
            error = np.linalg.norm(model(p) - q, axis=1) / scale
            spread = max(float(np.median(error[kept])), 0.05)
            # Where most pairs are chance, their median error grows with what is let in.
            kept = (error < np.clip(4 * spread, 0.5, REACH_PX)) & free | sure
            if kept.sum() < 4 * (order + 1) * (order + 2):
                break
            weights = 1 / (1 + (error[kept] / (2 * spread)) ** 2)
            weights[sure[kept]] = 1.0
            model = Polynomial.fit(p[kept], q[kept], order=order, weights=weights)
    if kept.sum() < LEAST_INLIERS:
        return first
    return Start(model, p, q, kept, first.mirrored)
