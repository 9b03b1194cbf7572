"""Key points and descriptors of grey pictures: one SIFT ([lowe2004]_, descriptors as RootSIFT, [arandjelovic2012]_) for both methods.

The paper's method picks a detector from `DETECTORS`, in which a row is all that a new kind needs. The default method finds key points of
several grey pictures of a camera, each when it is first needed: inversion of contrast and mirroring permute the entries of a descriptor,
so that all four cases cost one detection. Where contrast inverts in some places only, edges are what two pictures share: key points
of the gradient's magnitude are found too.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from threading import RLock
from typing import Any

import cv2
import numpy as np

from levkas.geometry.transforms import Affine
from levkas.registration.bands import area_average
from levkas.registration.record import refusal

CONTRAST = 0.01
"""Threshold of SIFT below which an extremum is no key point; half or twice it halves or doubles their number."""
LIMIT, BALANCE_CELLS = 10_000, 8
"""Key points that the paper's method keeps of a picture, the strongest of each cell; cells along either side."""
ROOT_LEVELS = 512
"""RootSIFT in whole numbers up to this keeps every dot product exact in float32, in any order of summation."""
KEY_POINTS, EDGE_THRESHOLD = 4000, 12
"""Of a grey picture in the default method: key points that are kept, the strongest; limit of SIFT for points on edges."""
MOST_GREYS = 4
"""Means of parts of the spectrum in which key points are found, beside that of all bands."""
EDGE_PX = 2.0
"""Scale at which the gradient's magnitude is taken, px of the reduced picture."""
EDGES = -1
"""In place of a picture's number: key points of the gradient's magnitude in the first."""


@dataclass(frozen=True)
class KeyPoints:
    """Key points of one picture, in a total order that does not depend on how they were found."""

    points: np.ndarray
    """(n, 2), px."""
    sizes: np.ndarray
    """(n,), px. Diameter of the neighbourhood that was described."""
    angles: np.ndarray
    """(n,), degrees."""
    responses: np.ndarray
    """(n,)."""
    descriptors: np.ndarray
    """(n, d). float32 (Euclidean distance; whole numbers, or of unit length) or uint8 (Hamming distance)."""

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: np.ndarray) -> KeyPoints:
        return KeyPoints(*(getattr(self, column.name)[rows] for column in fields(self)))


# --- detectors by name


def find_key_points(
    picture: np.ndarray, valid: np.ndarray, *, detector: str = "sift", limit: int = LIMIT
) -> KeyPoints:
    """Find key points of a picture, (h, w) uint8, with no invalid pixel within half their radius, sorted by x, y, size and angle.

    At most `limit`, the strongest of each cell of an 8 x 8 grid. Raises RegistrationRefused where `DETECTORS` has no such row.
    """
    if detector not in DETECTORS:
        raise refusal(
            "E_VALUE",
            f"key points of kind {detector!r} are not available",
            field="registration.detector",
            found=detector,
            expected=", ".join(DETECTORS),
        )
    found = DETECTORS[detector](picture)
    (h, w), (x, y) = valid.shape, np.rint(found.points).astype(int).T
    room = cv2.distanceTransform(valid.astype(np.uint8), cv2.DIST_L2, 5)
    near = room[np.clip(y, 0, h - 1), np.clip(x, 0, w - 1)]
    found = found[near > np.maximum(2.0, found.sizes / 4)]
    found = found[np.lexsort((found.angles, found.sizes, found.points[:, 1], found.points[:, 0]))]
    if len(found) <= limit:
        return found
    cell = np.clip(found.points * BALANCE_CELLS // (w, h), 0, BALANCE_CELLS - 1) @ (
        1,
        BALANCE_CELLS,
    )
    by_strength = np.lexsort((-found.responses, cell))
    place = np.empty(len(found), int)
    place[by_strength] = np.arange(len(found)) - np.searchsorted(
        cell[by_strength], cell[by_strength]
    )
    # The k-th of every cell comes before the (k + 1)-th of any.
    return found[np.sort(np.lexsort((-found.responses, place))[:limit])]


def sift(picture: np.ndarray) -> KeyPoints:
    """SIFT in whole numbers: distances of descriptors do not depend on the order of summation."""
    found = _sift(picture)
    levels = np.rint(found.descriptors * ROOT_LEVELS).astype(np.float32)
    return KeyPoints(found.points, found.sizes, found.angles, found.responses, levels)


def orb(picture: np.ndarray) -> KeyPoints:
    """ORB ([rublee2011]_), binary descriptors; OpenCV's own 500 points lie where contrast is highest."""
    options = {"nfeatures": 40_000, "fastThreshold": 5, "scaleFactor": 1.2, "nlevels": 8}
    finder: Any = getattr(cv2, "ORB_create")(**options)  # noqa: B009
    return _gather(*finder.detectAndCompute(picture, None), width=32)


DETECTORS: dict[str, Callable[[np.ndarray], KeyPoints]] = {"sift": sift, "orb": orb}


def _sift(picture: np.ndarray, mask: np.ndarray | None = None, **options: Any) -> KeyPoints:
    """SIFT without the bias of a quarter pixel that OpenCV has by default, as RootSIFT of unit length."""
    finder: Any = getattr(cv2, "SIFT_create")(  # noqa: B009
        enable_precise_upscale=True, contrastThreshold=CONTRAST, **options
    )
    found = _gather(*finder.detectAndCompute(picture, mask), width=128)
    total = np.maximum(found.descriptors.sum(1, keepdims=True), 1e-9)
    root = np.sqrt(found.descriptors / total)
    return KeyPoints(found.points, found.sizes, found.angles, found.responses, root)


def _gather(key_points: Any, descriptors: Any, *, width: int) -> KeyPoints:
    n = len(key_points)
    return KeyPoints(
        np.array([k.pt for k in key_points], float).reshape(n, 2),
        np.array([k.size for k in key_points], float),
        np.array([k.angle for k in key_points], float),
        np.array([k.response for k in key_points], float),
        np.empty((0, width), np.float32) if descriptors is None else np.asarray(descriptors),
    )


# --- features of the grey pictures of a camera


def grey_pictures(images: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Return the mean of all bands of a camera, and up to four others: the bands themselves where they are few, else means of parts of the spectrum."""
    parts = np.array_split(np.arange(len(images)), min(MOST_GREYS, len(images)))
    groups = [range(len(images)), *(parts if len(images) > 1 else ())]
    return [mean_picture([images[k] for k in group]) for group in groups]


def mean_picture(images: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean of images, (h, w), each in units of its standard deviation, over what is finite."""
    total, count = np.zeros((2, *images[0].shape), np.float32)
    for image in images:
        known = np.isfinite(image)
        some = image[::2, ::2][known[::2, ::2]]
        if some.size:
            spread = np.float32(max(float(np.std(some)), 1e-12))
            total += np.where(known, image / spread, np.float32(0))
            count += known
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(total / count)


class CameraFeatures:
    """Grey pictures of one camera, and their key points, found when first used.

    `greys` are (h, w) float32, all of one size, NaN where invalid. `within`, (h, w) bool, is where key points count; they are found
    in the whole picture all the same.
    """

    def __init__(self, greys: Sequence[np.ndarray], within: np.ndarray | None = None) -> None:
        self.greys, self.within = greys, within
        self._found: dict[tuple[int, int], KeyPoints] = {}
        self._lock = RLock()  # several sensors need those of the reference

    @property
    def shape(self) -> tuple[int, ...]:
        """(height, width) of the pictures."""
        return self.greys[0].shape

    def reduced(self, share: float) -> tuple[CameraFeatures, Affine]:
        """Return the features of pictures reduced to `share`, 0 < share <= 1, of their size, and reduced px → px of these."""
        greys = []
        for grey in self.greys:
            known = np.isfinite(grey)
            small, valid, back = area_average(np.where(known, grey, 0), known, share)
            greys.append(np.where(valid, small, np.float32(np.nan)))
        within = self.within
        if within is not None:
            size = greys[0].shape[::-1]
            within = cv2.resize(within.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST) > 0
        return CameraFeatures(greys, within), back

    def key_points(self, side: int, number: int) -> KeyPoints:
        """Return those of a picture, or of `EDGES`, in its own px; it is reduced until its longer side is `side` px."""
        factor = max(1, -(-max(self.shape) // side))
        with self._lock:
            if (factor, number) not in self._found:
                self._found[factor, number] = self._find(factor, number)
            return self._found[factor, number]

    def _find(self, n: int, number: int) -> KeyPoints:
        image = self.greys[max(number, 0)]
        h, w = (image.shape[0] // n) * n, (image.shape[1] // n) * n
        small = image[:h, :w].reshape(h // n, n, w // n, n).mean((1, 3)) if n > 1 else image
        picture = _equalised(_gradient_magnitude(small) if number == EDGES else small)
        shown = np.isfinite(small).astype(np.uint8) * 255
        found = _sift(picture, shown, nfeatures=KEY_POINTS, edgeThreshold=EDGE_THRESHOLD)
        x, y = found.points.T
        found = found[np.lexsort((found.angles, y, x, -found.responses))[:KEY_POINTS]]
        points, sizes = (found.points + 0.5) * n - 0.5, found.sizes * n
        found = KeyPoints(points, sizes, found.angles, found.responses, found.descriptors)
        if self.within is None or not len(found):
            return found
        column, row = np.round(points).astype(int).T
        h, w = self.within.shape
        return found[self.within[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]]


def _stretched(image: np.ndarray) -> np.ndarray:
    """Return the range of 0.5 to 99.5 % of an image as 0..1, float32; the middle where invalid."""
    known = np.isfinite(image)
    low, high = np.percentile(image[known], (0.5, 99.5)) if known.any() else (0.0, 1.0)
    filled = np.where(known, image, (low + high) / 2)
    return np.clip((filled - low) / max(high - low, 1e-12), 0, 1).astype(np.float32)


def _gradient_magnitude(image: np.ndarray) -> np.ndarray:
    """Return the square root of the gradient's magnitude, which does not depend on the sign of contrast; NaN where invalid."""
    soft = cv2.GaussianBlur(_stretched(image), (0, 0), EDGE_PX)
    slope = np.hypot(cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1))
    return np.where(np.isfinite(image), np.sqrt(slope), np.float32(np.nan))


def _equalised(image: np.ndarray) -> np.ndarray:
    """Return 8 bits with local mean subtracted and local contrast equalised, so that glare hides little."""
    flat, sigma = _stretched(image), max(4.0, max(image.shape) / 40)
    mean = cv2.GaussianBlur(flat, (0, 0), sigma)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur((flat - mean) ** 2, (0, 0), sigma), 0))
    even = (flat - mean) / (spread + 0.25 * float(spread.mean()) + 1e-6)
    return (np.clip(even * 40 + 128, 0, 255)).astype(np.uint8)


def invert_descriptors(descriptors: np.ndarray) -> np.ndarray:
    """Descriptors of the same points in the negative: the main direction turns by 180 degrees."""
    return descriptors.reshape(-1, 4, 4, 8)[:, ::-1, ::-1].reshape(-1, 128)


def mirror_descriptors(descriptors: np.ndarray) -> np.ndarray:
    """Descriptors of the same points in the mirror: across the main direction, angles negated."""
    turned = descriptors.reshape(-1, 4, 4, 8)[:, ::-1]
    return turned[..., (-np.arange(8)) % 8].reshape(-1, 128)
