"""Features: key points and descriptors of grey pictures.

Two kinds of users share one SIFT ([lowe2004]_). The paper's method picks a detector from `DETECTORS`, in which
a row is all that a new kind needs. The default method finds SIFT of several grey pictures of a camera, each
when it is first needed (`CameraFeatures`): contrast inversion and mirroring permute the entries of a
descriptor, so that all four cases cost one detection. Where contrast inverts in some places and not in
others, edges are what two pictures share: key points of the gradient's magnitude are found too.
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


@dataclass(frozen=True)
class FeatureSettings:
    """Constants of the features."""

    contrast: float = 0.01
    """Threshold of SIFT below which an extremum is no key point."""
    limit: int = 10_000
    """Key points of a picture that the paper's method keeps, the strongest of each cell."""
    balance_cells: int = 8
    """Cells along either side from which they are taken evenly."""
    root_levels: int = 512
    """RootSIFT in whole numbers up to this keeps every dot product exact in float32, in any order of summation."""
    orb_points: int = 40_000
    """Of ORB before the strongest of each cell are kept; OpenCV's 500 lie where contrast is highest."""
    fast_threshold: int = 5
    """In grey levels: of FAST, in ORB."""
    key_points: int = 4000
    """Of a grey picture that the default method keeps, the strongest first."""
    edge_threshold: int = 12
    """Of SIFT, above which an extremum lies on an edge; in the default method."""
    most_greys: int = 4
    """Means of parts of the spectrum in which key points are found, beside that of all bands."""
    edge_px: float = 2.0
    """Scale at which the gradient's magnitude is taken."""


SETTINGS = FeatureSettings()


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
    picture: np.ndarray, valid: np.ndarray, *, detector: str = "sift", limit: int = SETTINGS.limit
) -> KeyPoints:
    """Find key points whose neighbourhood is valid.

    Raises RegistrationRefused where there is no such detector.

    Parameters
    ----------
    picture : ndarray, (h, w), uint8
    valid : ndarray, (h, w), bool
    detector : str
        A key of `DETECTORS`.
    limit : int
        At most so many, the strongest of each cell of an 8 x 8 grid.

    Returns
    -------
    key_points : KeyPoints
        Sorted by x, then y, then size, then angle.
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
    found = found[_supported(found, valid)]
    order = np.lexsort((found.angles, found.sizes, found.points[:, 1], found.points[:, 0]))
    found = found[order]
    return found[_strongest(found, picture.shape, limit)]


def _supported(found: KeyPoints, valid: np.ndarray) -> np.ndarray:
    """Return which key points have no invalid pixel within half their radius."""
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
    cells = SETTINGS.balance_cells
    column = np.clip(found.points[:, 0] * cells // w, 0, cells - 1)
    row = np.clip(found.points[:, 1] * cells // h, 0, cells - 1)
    cell = (row * cells + column).astype(int)
    by_strength = np.lexsort((-found.responses, cell))
    starts = np.searchsorted(cell[by_strength], np.arange(cells**2))
    place = np.empty(len(found), int)
    place[by_strength] = np.arange(len(found)) - starts[cell[by_strength]]
    # The k-th of every cell comes before the (k + 1)-th of any.
    chosen = np.lexsort((-found.responses, place))[:limit]
    return np.sort(chosen)


def sift(picture: np.ndarray) -> KeyPoints:
    """SIFT of [lowe2004]_ with RootSIFT ([arandjelovic2012]_), in whole numbers: distances do not depend on the order of summation."""
    found = _sift(picture, contrastThreshold=SETTINGS.contrast)
    total = np.maximum(found.descriptors.sum(1, keepdims=True), 1)
    levels = np.rint(np.sqrt(found.descriptors / total) * SETTINGS.root_levels)
    return KeyPoints(
        found.points, found.sizes, found.angles, found.responses, levels.astype(np.float32)
    )


def _sift(picture: np.ndarray, mask: np.ndarray | None = None, **options: Any) -> KeyPoints:
    """SIFT without the bias of a quarter pixel that OpenCV has by default."""
    finder: Any = getattr(cv2, "SIFT_create")(enable_precise_upscale=True, **options)  # noqa: B009
    return _gather(*finder.detectAndCompute(picture, mask), width=128)


def orb(picture: np.ndarray) -> KeyPoints:
    """ORB ([rublee2011]_), binary descriptors; in every OpenCV."""
    finder: Any = getattr(cv2, "ORB_create")(  # noqa: B009
        nfeatures=SETTINGS.orb_points,
        fastThreshold=SETTINGS.fast_threshold,
        scaleFactor=1.2,
        nlevels=8,
    )
    return _gather(*finder.detectAndCompute(picture, None), width=32)


DETECTORS: dict[str, Callable[[np.ndarray], KeyPoints]] = {"sift": sift, "orb": orb}


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


# --- features of the grey pictures of a camera


class GreyImages(Sequence[np.ndarray]):
    """Grey images of a camera: the mean of all bands at one contrast, and up to four others, computed when first used.

    Those are the bands themselves where they are few, else means of parts of the spectrum.
    """

    def __init__(self, images: Sequence[np.ndarray]) -> None:
        self._images = images
        parts = np.array_split(np.arange(len(images)), min(SETTINGS.most_greys, len(images)))
        self._groups = [range(len(images)), *(parts if len(images) > 1 else ())]
        self._features: dict[int, np.ndarray] = {}

    def __len__(self) -> int:
        return len(self._groups)

    def freeze(self) -> None:
        """Compute all of them, and free the bands."""
        for i in range(len(self)):
            self[i]
        self._images = []

    def __getitem__(self, i: Any) -> Any:
        if isinstance(i, slice):
            return [self[k] for k in range(*i.indices(len(self)))]
        if i not in self._features:
            self._features[i] = _mean([self._images[k] for k in self._groups[i]])
        return self._features[i]


def _mean(images: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean of images, each in units of its standard deviation, over what is finite."""
    total, count = np.zeros((2, *images[0].shape), np.float32)
    for image in images:
        known = np.isfinite(image)
        some = image[::2, ::2][known[::2, ::2]]
        if not some.size:
            continue
        spread = np.float32(max(float(np.std(some)), 1e-12))
        total += np.where(known, image / spread, np.float32(0))
        count += known
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(total / count)


class CameraFeatures:
    """Grey pictures of one camera, and their key points, found when first used.

    Parameters
    ----------
    greys : sequence of ndarray, (h, w), float32
        All of one size, NaN where invalid.
    within : ndarray, (h, w), bool, optional
        Where key points count; they are found in the whole picture all the same.
    """

    def __init__(self, greys: Sequence[np.ndarray], within: np.ndarray | None = None) -> None:
        self.greys, self.within = greys, within
        self._scaled: dict[int, ScaledFeatures] = {}
        self._lock = RLock()  # several sensors need those of the reference

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

    def at(self, side: int) -> ScaledFeatures:
        """Return the key points of pictures reduced until their longer side is `side` px."""
        factor = max(1, -(-max(self.greys[0].shape) // side))
        with self._lock:
            if factor not in self._scaled:
                self._scaled[factor] = ScaledFeatures(self.greys, factor, self.within)
            return self._scaled[factor]


class ScaledFeatures:
    """Key points of grey pictures at one size, by the number of the picture, found when first used."""

    #: In place of a number: key points of the gradient's magnitude in the first grey.
    EDGES = -1

    def __init__(self, greys: Sequence[np.ndarray], factor: int, within: np.ndarray | None) -> None:
        self.greys, self.factor, self.within = greys, factor, within
        self._found: dict[int, KeyPoints] = {}
        self._lock = RLock()  # as of `CameraFeatures`

    @property
    def shape(self) -> tuple[int, ...]:
        """(height, width) of the pictures, before they are reduced."""
        return self.greys[0].shape

    def __getitem__(self, i: int) -> KeyPoints:
        with self._lock:
            if i not in self._found:
                self._found[i] = self._key_points(i)
            return self._found[i]

    def _key_points(self, i: int) -> KeyPoints:
        edges = i == self.EDGES
        found = _find(self.greys[0 if edges else i], self.factor, edges=edges)
        if self.within is None or not len(found):
            return found
        column, row = np.round(found.points).astype(int).T
        h, w = self.within.shape
        return found[self.within[np.clip(row, 0, h - 1), np.clip(column, 0, w - 1)]]


def _find(image: np.ndarray, n: int, *, edges: bool) -> KeyPoints:
    """Return the strongest key points of an image reduced `n` times, in px of the image; RootSIFT of unit length."""
    h, w = (image.shape[0] // n) * n, (image.shape[1] // n) * n
    small = image[:h, :w].reshape(h // n, n, w // n, n).mean((1, 3)) if n > 1 else image
    if edges:
        small = _gradient_magnitude(small)
    found = _sift(
        _equalised(small),
        np.isfinite(small).astype(np.uint8) * 255,
        nfeatures=SETTINGS.key_points,
        contrastThreshold=SETTINGS.contrast,
        edgeThreshold=SETTINGS.edge_threshold,
    )
    x, y = found.points.T
    order = np.lexsort((found.angles, y, x, -found.responses))[: SETTINGS.key_points]
    total = np.maximum(found.descriptors.sum(1, keepdims=True), 1e-9)
    root = np.sqrt(found.descriptors / total).astype(np.float32)
    points, sizes = (found.points + 0.5) * n - 0.5, found.sizes * n
    return KeyPoints(points, sizes, found.angles, found.responses, root)[order]


def _gradient_magnitude(image: np.ndarray) -> np.ndarray:
    """Return the square root of the gradient's magnitude, which does not depend on the sign of contrast; NaN where invalid."""
    known = np.isfinite(image)
    low, high = np.percentile(image[known], (0.5, 99.5)) if known.any() else (0.0, 1.0)
    filled = np.clip(np.where(known, image, (low + high) / 2), low, high)
    flat = ((filled - low) / max(high - low, 1e-12)).astype(np.float32)
    soft = cv2.GaussianBlur(flat, (0, 0), SETTINGS.edge_px)
    slope = np.hypot(cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1))
    return np.where(known, np.sqrt(slope), np.float32(np.nan))


def _equalised(image: np.ndarray) -> np.ndarray:
    """Return 8 bits with local mean subtracted and local contrast equalised, so that glare hides little."""
    low, high = np.nanpercentile(image, (0.5, 99.5)) if np.isfinite(image).any() else (0.0, 1.0)
    filled = np.where(np.isfinite(image), image, (low + high) / 2)
    flat = np.clip((filled - low) / max(high - low, 1e-12), 0, 1).astype(np.float32)
    sigma = max(4.0, max(image.shape) / 40)
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
