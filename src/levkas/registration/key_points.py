"""Key points of grey pictures: where they are, how large, which way they look and what is around.

What contrast inversion and mirroring do to a SIFT descriptor is a permutation of its entries, so that
all four cases cost one detection. Where contrast inverts in some places and not in others, edges are
what two pictures share: key points of their strength are found too, when they are asked for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

KEY_POINTS = 4000
EDGE_PX = 2.0


@dataclass(frozen=True)
class KeyPoints:
    """Key points of one picture, the strongest first.

    Parameters
    ----------
    positions : ndarray, (n, 2), px of the picture
    descriptors : ndarray, (n, 128), float32
        Of length one.
    sizes : ndarray, (n,), px
    angles : ndarray, (n,), degrees
    """

    positions: NDArray[np.float64]
    descriptors: NDArray[np.float32]
    sizes: NDArray[np.float64]
    angles: NDArray[np.float64]

    def part(self, rows: np.ndarray) -> KeyPoints:
        """Return those of `rows`."""
        return KeyPoints(
            self.positions[rows], self.descriptors[rows], self.sizes[rows], self.angles[rows]
        )


class KeyPictures:
    """Grey pictures of one camera, and their key points, found when they are first asked for.

    Parameters
    ----------
    greys : sequence of ndarray, (h, w), float32
        All of one size, NaN where invalid.
    within : ndarray, (h, w), bool, optional
        Where key points count; they are found in the whole picture all the same.
    """

    def __init__(self, greys: Sequence[np.ndarray], within: np.ndarray | None = None) -> None:
        self.greys, self.within = greys, within
        self._sides: dict[int, Detector] = {}

    def at(self, side: int) -> Detector:
        """Return the key points of pictures made so small that their longer side is `side` px."""
        if side not in self._sides:
            self._sides[side] = Detector(self.greys, side, self.within)
        return self._sides[side]


class Detector:
    """Key points of greys by their number, found when they are first asked for; `EDGES` too."""

    #: In place of a number: key points of the strength of edges in the first grey.
    EDGES = -1

    def __init__(self, greys: Sequence[np.ndarray], side: int, within: np.ndarray | None) -> None:
        self.greys, self.side, self.within = greys, side, within
        self._found: dict[int, KeyPoints] = {}

    @property
    def shape(self) -> tuple[int, ...]:
        """(height, width) of the pictures, before they are made smaller."""
        return self.greys[0].shape

    def __getitem__(self, i: int) -> KeyPoints:
        if i not in self._found:
            edges = i == self.EDGES
            found = _detect(self.greys[0 if edges else i], self.side, edges=edges)
            self._found[i] = _inside(found, self.within)
        return self._found[i]


def _inside(points: KeyPoints, within: np.ndarray | None) -> KeyPoints:
    if within is None or not len(points.positions):
        return points
    column, row = np.round(points.positions).astype(int).T
    height, width = within.shape
    kept = within[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return points.part(kept)


def _detect(image: np.ndarray, side: int, *, edges: bool = False) -> KeyPoints:
    import cv2

    n = max(1, -(-max(image.shape) // side))
    h, w = (image.shape[0] // n) * n, (image.shape[1] // n) * n
    small = image[:h, :w].reshape(h // n, n, w // n, n).mean((1, 3)) if n > 1 else image
    if edges:
        small = _strength(small)
    # Precise upscaling mends OpenCV's bias of a quarter pixel.
    sift = cv2.SIFT_create(  # type: ignore[attr-defined]
        KEY_POINTS, 3, 0.01, 12, 1.6, enable_precise_upscale=True
    )
    mask = np.isfinite(small).astype(np.uint8) * 255
    keys, descriptors = sift.detectAndCompute(_equalised(small), mask)
    if not keys:
        return KeyPoints(np.zeros((0, 2)), np.zeros((0, 128), np.float32), np.zeros(0), np.zeros(0))
    order = sorted(range(len(keys)), key=lambda i: (-keys[i].response, keys[i].pt, keys[i].angle))
    order = order[:KEY_POINTS]
    positions = np.array([keys[i].pt for i in order], float)
    root = np.sqrt(descriptors[order] / np.maximum(descriptors[order].sum(1, keepdims=True), 1e-9))
    sizes, angles = (np.array([getattr(keys[i], k) for i in order]) for k in ("size", "angle"))
    return KeyPoints((positions + 0.5) * n - 0.5, root.astype(np.float32), sizes * n, angles)


def _strength(image: np.ndarray) -> np.ndarray:
    """Return the root of how steep a picture is, which knows no sign; NaN where invalid."""
    import cv2

    known = np.isfinite(image)
    low, high = np.percentile(image[known], (0.5, 99.5)) if known.any() else (0.0, 1.0)
    filled = np.clip(np.where(known, image, (low + high) / 2), low, high)
    flat = ((filled - low) / max(high - low, 1e-12)).astype(np.float32)
    soft = cv2.GaussianBlur(flat, (0, 0), EDGE_PX)
    slope = np.hypot(cv2.Sobel(soft, cv2.CV_32F, 1, 0), cv2.Sobel(soft, cv2.CV_32F, 0, 1))
    return np.where(known, np.sqrt(slope), np.float32(np.nan))


def _equalised(image: np.ndarray) -> np.ndarray:
    """8 bits, local mean taken out and local contrast evened, so that glare does not blind it."""
    import cv2

    low, high = np.nanpercentile(image, (0.5, 99.5)) if np.isfinite(image).any() else (0.0, 1.0)
    filled = np.where(np.isfinite(image), image, (low + high) / 2)
    flat = np.clip((filled - low) / max(high - low, 1e-12), 0, 1).astype(np.float32)
    sigma = max(4.0, max(image.shape) / 40)
    mean = cv2.GaussianBlur(flat, (0, 0), sigma)
    spread = np.sqrt(np.maximum(cv2.GaussianBlur((flat - mean) ** 2, (0, 0), sigma), 0))
    even = (flat - mean) / (spread + 0.25 * float(spread.mean()) + 1e-6)
    return (np.clip(even * 40 + 128, 0, 255)).astype(np.uint8)


def inverted(descriptors: np.ndarray) -> np.ndarray:
    """Descriptors of the same points in the negative: the main direction turns by 180 degrees."""
    return descriptors.reshape(-1, 4, 4, 8)[:, ::-1, ::-1].reshape(-1, 128)


def mirrored(descriptors: np.ndarray) -> np.ndarray:
    """Descriptors of the same points in the mirror: across the main direction, angles negated."""
    turned = descriptors.reshape(-1, 4, 4, 8)[:, ::-1]
    return turned[..., (-np.arange(8)) % 8].reshape(-1, 128)
