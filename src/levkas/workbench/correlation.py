"""Search for the corresponding point in the other picture by normalized cross-correlation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from levkas.geometry.transforms import Transform
from levkas.registration.window_matching import peak_offset
from levkas.workbench.pictures import ShownPicture

HALF_PX = 16
"""Half a side of the compared patch, px of the coarser picture."""
"""Half a side of the compared patch, px of the coarser picture."""
REACH_PX = 12
POLISHES = 3
CLEARLY = 0.15
SURE = 0.6
"""Score from which a place needs no look by the user."""


@dataclass(frozen=True)
class Correlated:
    """What was found around a place.

    Parameters
    ----------
    target : (x, y), target px
    shift : (x, y), reference px
        From where the map puts the place to where it was found.
    score : float, 0..1
        Absolute normalised correlation: an inverted contrast counts as much.
    """

    target: tuple[float, float]
    shift: tuple[float, float]
    score: float


def find_partner(
    reference: ShownPicture,
    target: ShownPicture,
    forward: Transform,
    point: np.ndarray,
    *,
    reach: float = REACH_PX,
) -> Correlated:
    """Return where `point` of the reference lies in the target: the map's answer, then refined.

    Parameters
    ----------
    reference, target : ShownPicture
    forward : Transform
        Reference px → target px, right to about `reach`.
    point : ndarray, (2,), reference px
    reach : float, reference px
        How far the map may be off.

    Returns
    -------
    found : Correlated
        With score 0, and the map's own answer, where nothing can be compared.

    Notes
    -----
    The target is brought into the reference's frame by the map first, so that turned and scaled
    pictures compare. Both intensities and their gradients are compared; what agrees better counts.
    """
    start = forward(point[None])[0]
    nothing = Correlated((float(start[0]), float(start[1])), (0.0, 0.0), 0.0)
    slope = forward.jacobian(point[None])[0]
    if not np.isfinite(start).all() or not np.isfinite(slope).all():
        return nothing
    scale = float(np.sqrt(abs(np.linalg.det(slope))))
    step = max(1.0, 1.0 / max(scale, 1e-3))
    patch, known = reference.sample(_grid(point, HALF_PX, step), step)
    if known.mean() < 0.9 or patch.std() < 1:
        return nothing
    # Pictures are shown by the root of their values; edges lie where they lie in the values themselves.
    patch = np.square(patch)
    total, score = np.zeros(2), 0.0
    # Peaks between px lean towards whole ones: compared again from where it was found, they do not.
    for extra in (int(np.ceil(reach / step)), *[2] * POLISHES):
        around = _grid(total, HALF_PX + extra, step)
        # Near one place the map is its slope: an exact one would cost an inversion a pixel.
        window, valid = target.sample(start + around @ slope.T, step * scale)
        if valid.mean() < 0.6 or window.std() < 1:
            return nothing
        peak, score = _compare(patch, np.square(window))
        total = total + (peak - extra) * step
    place = start + slope @ total
    return Correlated((float(place[0]), float(place[1])), (float(total[0]), float(total[1])), score)


def _compare(patch: np.ndarray, window: np.ndarray) -> tuple[np.ndarray, float]:
    """Return where in `window` the patch is found, (x, y), and how alike it is there, 0..1.

    By its intensities; by their slopes where these are clearly more alike.
    """
    import cv2

    best = np.zeros(2), 0.0
    for a, b in ((patch, window), (_steepness(patch), _steepness(window))):
        alike = np.abs(np.nan_to_num(cv2.matchTemplate(b, a, cv2.TM_CCOEFF_NORMED)))
        row, column = (int(v) for v in np.unravel_index(int(alike.argmax()), alike.shape))
        if alike[row, column] > best[1] + (CLEARLY if best[1] else 0):
            best = _peak(alike, row, column), float(np.clip(alike[row, column], 0, 1))
    return best


def _grid(point: np.ndarray, half: int, step: float) -> np.ndarray:
    along = np.arange(-half, half + 1) * step
    return np.stack(np.meshgrid(along, along), -1) + point


def _steepness(image: np.ndarray) -> np.ndarray:
    down, across = np.gradient(image)
    return np.asarray(np.hypot(down, across), np.float32)


def _peak(alike: np.ndarray, row: int, column: int) -> np.ndarray:
    """Place of the peak, (x, y), by parabolas through its neighbours."""
    place = np.array([column, row], float)
    for axis, (at, line) in enumerate(((column, alike[row]), (row, alike[:, column]))):
        place[axis] += peak_offset(line, at)
    return place
