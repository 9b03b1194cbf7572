"""Key points with descriptors; a row in `DETECTORS` is all that a new kind needs."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.registration.record import RegistrationRefused

if TYPE_CHECKING:
    from collections.abc import Callable

CONTRAST = 0.01
LIMIT = 10_000
BALANCE_CELLS = 8
ROOT_SIFT_LEVELS = 512
ORB_POINTS = 4 * LIMIT
"""Looked for before the strongest of each cell are kept; OpenCV's 500 lie where contrast is highest."""


@dataclass(frozen=True)
class KeyPoints:
    """Key points of one picture, in a total order that does not depend on how they were found.

    Parameters
    ----------
    points : ndarray, (n, 2), px
    sizes : ndarray, (n,), px
        Diameter of the neighbourhood that was described.
    angles : ndarray, (n,), degrees
    responses : ndarray, (n,)
    descriptors : ndarray, (n, d)
        float32 of whole numbers (Euclidean distance) or uint8 (Hamming distance).
    """

    points: np.ndarray
    sizes: np.ndarray
    angles: np.ndarray
    responses: np.ndarray
    descriptors: np.ndarray

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: np.ndarray) -> KeyPoints:
        return KeyPoints(
            self.points[rows],
            self.sizes[rows],
            self.angles[rows],
            self.responses[rows],
            self.descriptors[rows],
        )


def find_key_points(
    picture: np.ndarray,
    valid: np.ndarray,
    *,
    detector: str = "sift",
    limit: int = LIMIT,
    **options: Any,
) -> KeyPoints:
    """Find key points whose neighbourhood is valid.

    Parameters
    ----------
    picture : ndarray, (h, w), uint8
    valid : ndarray, (h, w), bool
    detector : str
        A key of `DETECTORS`.
    limit : int
        At most so many, the strongest of each cell of an 8 x 8 grid.
    **options
        Of the detector, e.g. ``contrast=0.01`` of SIFT.

    Returns
    -------
    key_points : KeyPoints
        Sorted by x, then y, then size, then angle.

    Raises
    ------
    RegistrationRefused
        Where there is no such detector, or the OpenCV that is installed lacks it.
    """
    if detector not in DETECTORS:
        raise RegistrationRefused(no_detector(detector))
    found = DETECTORS[detector](picture, **options)
    found = found[_supported(found, valid)]
    order = np.lexsort((found.angles, found.sizes, found.points[:, 1], found.points[:, 0]))
    found = found[order]
    return found[_strongest(found, picture.shape, limit)]


def _supported(found: KeyPoints, valid: np.ndarray) -> np.ndarray:
    """Tell which key points have no invalid pixel within half their radius."""
    import cv2

    if valid.all():
        return np.ones(len(found), bool)
    room = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, 5)
    x, y = np.rint(found.points).astype(int).T
    h, w = valid.shape
    near = room[np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)]
    return np.asarray(near > np.maximum(2.0, found.sizes / 4))


def _strongest(found: KeyPoints, shape: tuple[int, ...], limit: int) -> np.ndarray:
    """Return sorted rows of the strongest key points of every cell, `limit` in all."""
    if len(found) <= limit:
        return np.arange(len(found))
    h, w = shape[:2]
    column = np.clip(found.points[:, 0] * BALANCE_CELLS // w, 0, BALANCE_CELLS - 1)
    row = np.clip(found.points[:, 1] * BALANCE_CELLS // h, 0, BALANCE_CELLS - 1)
    cell = (row * BALANCE_CELLS + column).astype(int)
    by_strength = np.lexsort((-found.responses, cell))
    starts = np.searchsorted(cell[by_strength], np.arange(BALANCE_CELLS**2))
    place = np.empty(len(found), int)
    place[by_strength] = np.arange(len(found)) - starts[cell[by_strength]]
    # The k-th of every cell comes before the (k + 1)-th of any.
    chosen = np.lexsort((-found.responses, place))[:limit]
    return np.sort(chosen)


def sift(picture: np.ndarray, *, contrast: float = CONTRAST, root: bool = True) -> KeyPoints:
    """SIFT of Lowe 2004, free of OpenCV's quarter-pixel bias; RootSIFT with `root`.

    Parameters
    ----------
    picture : ndarray, (h, w), uint8
    contrast : float
        Threshold below which an extremum is not a key point.
    root : bool
        Hellinger instead of Euclidean distance (Arandjelović & Zisserman 2012).
    """
    create = _opencv("SIFT_create", "sift")
    options = {"contrastThreshold": contrast}
    shift = 0.0
    try:
        finder = create(enable_precise_upscale=True, **options)
    except TypeError:
        # Releases without the switch look for key points in a picture that lies 0.25 px off.
        finder, shift = create(**options), 0.25
    found = _gather(*finder.detectAndCompute(picture, None), width=128)
    if shift:
        found = KeyPoints(found.points - shift, *(_rest(found)))
    if not root:
        return found
    total = np.maximum(found.descriptors.sum(1, keepdims=True), 1)
    # Whole numbers up to 512 keep every dot product exact in float32, in any order of summation.
    rooted = np.rint(np.sqrt(found.descriptors / total) * ROOT_SIFT_LEVELS).astype(np.float32)
    return KeyPoints(found.points, found.sizes, found.angles, found.responses, rooted)


def kaze(picture: np.ndarray, *, contrast: float = 3e-4) -> KeyPoints:
    """KAZE of Alcantarilla 2012; in OpenCV 4, and in OpenCV 5 only with its extra modules."""
    finder = _opencv("KAZE_create", "kaze")(threshold=contrast)
    found = _gather(*finder.detectAndCompute(picture, None), width=64)
    # Whole numbers, so that distances do not depend on the order of summation.
    scaled = np.rint(found.descriptors * ROOT_SIFT_LEVELS).astype(np.float32)
    return KeyPoints(found.points, found.sizes, found.angles, found.responses, scaled)


def akaze(picture: np.ndarray, *, contrast: float = 3e-4) -> KeyPoints:
    """AKAZE of Alcantarilla 2013, binary descriptors; in OpenCV as `kaze` is."""
    finder = _opencv("AKAZE_create", "akaze")(threshold=contrast)
    return _gather(*finder.detectAndCompute(picture, None), width=61)


def orb(picture: np.ndarray, *, contrast: int = 5) -> KeyPoints:
    """ORB of Rublee 2011, binary descriptors; in every OpenCV. `contrast` is the threshold of FAST, grey levels."""
    finder = _opencv("ORB_create", "orb")(
        nfeatures=ORB_POINTS, fastThreshold=contrast, scaleFactor=1.2, nlevels=8
    )
    return _gather(*finder.detectAndCompute(picture, None), width=32)


DETECTORS: dict[str, Callable[..., KeyPoints]] = {
    "sift": sift,
    "orb": orb,
    "kaze": kaze,
    "akaze": akaze,
}
CONSTRUCTORS = {
    "sift": "SIFT_create",
    "orb": "ORB_create",
    "kaze": "KAZE_create",
    "akaze": "AKAZE_create",
}


def available_detectors() -> list[str]:
    """Return the detectors that the installed OpenCV has; KAZE and AKAZE left it with release 5."""
    return [name for name, constructor in CONSTRUCTORS.items() if _constructor(constructor)]


def _constructor(name: str) -> Any:
    import cv2

    homes = (cv2, getattr(cv2, "xfeatures2d", None))
    return next((getattr(home, name) for home in homes if hasattr(home, name)), None)


def _opencv(constructor: str, detector: str) -> Any:
    found = _constructor(constructor)
    if found is None:
        raise RegistrationRefused(no_detector(detector))
    return found


def no_detector(detector: str, field: str = "registration.detector") -> Problem:
    """Return the problem of a detector that is unknown, or not in the installed OpenCV."""
    import cv2

    here = ", ".join(f'"{name}"' for name in available_detectors())
    return Problem(
        "E_VALUE",
        f"key points of kind {detector!r} are not available",
        field=field,
        found=detector,
        expected=f"one of {here}, which OpenCV {cv2.__version__} here has",
        fix='Use "sift".',
    )


def _gather(key_points: Any, descriptors: Any, *, width: int) -> KeyPoints:
    n = len(key_points)
    if n == 0 or descriptors is None:
        empty = np.empty(0)
        return KeyPoints(np.empty((0, 2)), empty, empty, empty, np.empty((0, width), np.float32))
    return KeyPoints(
        np.array([k.pt for k in key_points], float).reshape(n, 2),
        np.array([k.size for k in key_points], float),
        np.array([k.angle for k in key_points], float),
        np.array([k.response for k in key_points], float),
        np.asarray(descriptors),
    )


def _rest(found: KeyPoints) -> tuple[np.ndarray, ...]:
    return found.sizes, found.angles, found.responses, found.descriptors
