"""SURF and one projective map: what the paper took from MATLAB."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.registration.bands import stretch
from levkas.registration.features import KeyPoints
from levkas_peers.opencv import fit_homography, ratio_matches
from levkas_peers.pair import Answer

if TYPE_CHECKING:
    from levkas_peers.pair import Pair

SURF_RATIO = 0.6
"""MATLAB's default `MaxRatio` of matchFeatures."""
SURF_DISTANCE = 1.5
"""MATLAB's default `MaxDistance` of estgeotform2d, px."""
SURF_POINTS = 8000


def surf_projective(pair: Pair) -> Answer:
    """SURF, nearest neighbours under a ratio, MSAC and a projective map.

    What MATLAB's Registration Estimator does for "SURF, projective", with mahotas' SURF: OpenCV's
    wheels leave it out for its patents. Ratio and distance are
    MATLAB's defaults, the threshold of strength is mahotas'.
    """
    import cv2
    from mahotas.features import surf

    sides = []
    for values, valid in ((pair.reference, pair.reference_valid), (pair.target, pair.target_valid)):
        picture = stretch(values, valid)
        found = surf.surf(picture, max_points=SURF_POINTS)
        found = found[valid[found[:, 0].astype(int), found[:, 1].astype(int)]]
        empty = np.zeros(len(found))
        sides.append(KeyPoints(found[:, 1::-1], found[:, 2], empty, empty, _unit(found[:, 6:])))
    params = cv2.UsacParams()
    params.confidence, params.maxIterations, params.threshold = 0.99, 10_000, SURF_DISTANCE
    params.score = cv2.SCORE_METHOD_MSAC
    params.sampler = cv2.SAMPLING_UNIFORM
    params.randomGeneratorState = 0
    return fit_homography(*ratio_matches(sides, SURF_RATIO), "MSAC", params=params)


def _unit(descriptors: np.ndarray) -> np.ndarray:
    lengths = np.linalg.norm(descriptors, axis=1, keepdims=True)
    return np.rint(512 * descriptors / np.maximum(lengths, 1e-12)).astype(np.float32)
