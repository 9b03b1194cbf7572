"""Two methods of OpenCV: SIFT with MAGSAC, and ECC."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np

from levkas.geometry.transforms import Composed, Homography
from levkas.registration.bands import stretch
from levkas.registration.features import KeyPoints, find_key_points
from levkas.registration.matching import find_neighbours
from levkas_peers.pair import Answer, NoAnswer, Pair

SIFT_RATIO = 0.8
MAGSAC_DISTANCE = 3.0
"""Largest residual of an inlier, px."""
FEWEST = 8
LEVELS = 4
"""Of the pyramid of ECC."""
LEAST_SIDE = 32
"""Of a level of the pyramid, px."""


def opencv_sift_magsac(pair: Pair) -> Answer:
    """Match SIFT key points by Lowe's ratio test and fit a homography by MAGSAC."""
    pictures = (pair.reference, pair.reference_valid), (pair.target, pair.target_valid)
    sides = [find_key_points(stretch(values, valid), valid) for values, valid in pictures]
    source, goal = ratio_matches(sides, SIFT_RATIO)
    return fit_homography(
        source, goal, "MAGSAC", method=cv2.USAC_MAGSAC,
        ransacReprojThreshold=MAGSAC_DISTANCE, maxIters=10_000, confidence=0.9999,
    )  # fmt: skip


def opencv_ecc(pair: Pair) -> Answer:
    """Fit a homography by ECC [evangelidis2008]_, coarse to fine; images are blurred here, for ECC's own blur biases."""
    ecc: Any = cv2.findTransformECC
    moved, valid = pair.moved()
    warp = np.eye(3)
    cost = float("nan")
    for level in reversed(range(LEVELS)):
        scale = 0.5**level
        if min(moved.shape) * scale < LEAST_SIDE:
            continue
        a, b = (_reduced(p, scale) for p in (pair.reference, moved))
        mask = _reduced(valid.astype(np.float32), scale) > 0.99
        shrink = np.array([[scale, 0, scale / 2 - 0.5], [0, scale, scale / 2 - 0.5], [0, 0, 1]])
        guess = (shrink @ warp @ np.linalg.inv(shrink)).astype(np.float32)
        stop = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_COUNT, 60 if level else 30, 1e-6)
        try:
            cost, guess = ecc(a, b, guess, cv2.MOTION_HOMOGRAPHY, stop, mask.astype(np.uint8), 1)
        except cv2.error as error:
            raise NoAnswer(str(error).splitlines()[-1][-120:]) from error
        warp = np.linalg.inv(shrink) @ guess.astype(float) @ shrink
    return Answer(Composed(Homography(warp), pair.start), f"correlation {cost:.3f}")


def ratio_matches(sides: list[KeyPoints], ratio: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the points of matches in reference and target, (n, 2) px each, by Lowe's ratio test [lowe2004]_."""
    reference, target = sides
    if min(len(reference), len(target)) < 2:
        raise NoAnswer(f"{len(reference)} and {len(target)} key points")
    near = find_neighbours(reference.descriptors, target.descriptors)
    rows = np.flatnonzero(near.distance < ratio * near.second)
    columns = near.nearest[rows]
    _, first = np.unique(columns, return_index=True)
    return reference.points[rows[first]], target.points[columns[first]]


def fit_homography(source: np.ndarray, goal: np.ndarray, sampler: str, **options: Any) -> Answer:
    """Fit a homography to matches, (n, 2) px each, by `cv2.findHomography` under `options`.

    Raises NoAnswer with fewer than 8 matches, or where OpenCV finds none.
    """
    if len(source) < FEWEST:
        raise NoAnswer(f"{len(source)} matches, a homography by {sampler} wants {FEWEST}")
    cv2.setRNGSeed(0)
    matrix, inside = cv2.findHomography(source, goal, **options)
    if matrix is None:
        raise NoAnswer(f"{sampler} found no homography in {len(source)} matches")
    return Answer(Homography(matrix), f"{int(np.sum(inside))} of {len(source)} matches kept")


def _reduced(picture: np.ndarray, scale: float) -> np.ndarray:
    size = tuple(max(1, round(side * scale)) for side in picture.shape[::-1])
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA) if scale < 1 else picture
    return np.asarray(cv2.GaussianBlur(small, (0, 0), 1.0), np.float32)
