"""Key points and one homography: what the paper took from MATLAB, and what OpenCV's users take."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import Homography
from levkas.quality.comparison.answer import Answer, NoAnswer
from levkas.registration.bands import stretch
from levkas.registration.features import KeyPoints, find_key_points
from levkas.registration.matching import find_neighbours

if TYPE_CHECKING:
    from levkas.quality.comparison.pairs import Pair

SURF_RATIO = 0.6
"""MATLAB's default `MaxRatio` of matchFeatures."""
SURF_DISTANCE = 1.5
"""MATLAB's default `MaxDistance` of estgeotform2d, px."""
SURF_POINTS = 8000
SIFT_RATIO = 0.8
MAGSAC_DISTANCE = 3.0
FEWEST = 8


def surf_projective(pair: Pair) -> Answer:
    """SURF, nearest neighbours under a ratio, MSAC and a projective map.

    What MATLAB's Registration Estimator does for "SURF, projective", with mahotas' SURF: OpenCV's
    wheels leave it out for its patents. Ratio and distance are
    MATLAB's defaults, the threshold of strength is mahotas'.
    """
    from mahotas.features import surf

    sides = []
    for values, valid in ((pair.reference, pair.reference_valid), (pair.target, pair.target_valid)):
        picture = stretch(values, valid)
        found = surf.surf(picture, max_points=SURF_POINTS)
        found = found[valid[found[:, 0].astype(int), found[:, 1].astype(int)]]
        empty = np.zeros(len(found))
        sides.append(KeyPoints(found[:, 1::-1], found[:, 2], empty, empty, _unit(found[:, 6:])))
    rows, columns = _ratio_matches(sides, SURF_RATIO)
    return _homography(pair, sides, rows, columns, SURF_DISTANCE, "MSAC")


def opencv_sift_magsac(pair: Pair) -> Answer:
    """SIFT, Lowe's ratio test and a homography by MAGSAC: a dozen lines of OpenCV."""
    sides = [
        find_key_points(stretch(values, valid), valid, contrast=0.02, root=False)
        for values, valid in (
            (pair.reference, pair.reference_valid),
            (pair.target, pair.target_valid),
        )
    ]
    rows, columns = _ratio_matches(sides, SIFT_RATIO)
    return _homography(pair, sides, rows, columns, MAGSAC_DISTANCE, "MAGSAC")


def _unit(descriptors: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return np.rint(512 * descriptors / np.maximum(lengths, 1e-12)).astype(np.float32)


def _ratio_matches(sides: list[KeyPoints], ratio: float) -> tuple[np.ndarray, np.ndarray]:
    reference, target = sides
    if min(len(reference), len(target)) < 2:
        raise NoAnswer(f"{len(reference)} and {len(target)} key points")
    near = find_neighbours(reference.descriptors, target.descriptors)
    rows = np.flatnonzero(near.distance < ratio * near.second)
    columns = near.nearest[rows]
    _, first = np.unique(columns, return_index=True)
    return rows[first], columns[first]


def _homography(
    pair: Pair,
    sides: list[KeyPoints],
    rows: np.ndarray,
    columns: np.ndarray,
    distance: float,
    sampler: str,
) -> Answer:
    import cv2

    if len(rows) < FEWEST:
        raise NoAnswer(f"{len(rows)} matches, a homography by {sampler} wants {FEWEST}")
    source, goal = sides[0].points[rows], sides[1].points[columns]
    cv2.setRNGSeed(0)
    if sampler == "MAGSAC":
        matrix, inside = cv2.findHomography(
            source, goal, cv2.USAC_MAGSAC, distance, maxIters=10_000, confidence=0.9999
        )
    else:
        matrix, inside = cv2.findHomography(source, goal, _msac(cv2, distance))
    if matrix is None:
        raise NoAnswer(f"{sampler} found no homography in {len(rows)} matches")
    return Answer(Homography(matrix), f"{int(np.sum(inside))} of {len(rows)} matches kept")


def _msac(cv2: Any, distance: float) -> Any:
    params = cv2.UsacParams()
    params.confidence, params.maxIterations, params.threshold = 0.99, 10_000, distance
    params.score = cv2.SCORE_METHOD_MSAC
    params.sampler = cv2.SAMPLING_UNIFORM
    params.randomGeneratorState = 0
    return params
