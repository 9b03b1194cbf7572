"""Focus, band by band: how wide the sharpest edges of the picture are.

The paper's cameras are focused at one band (550 nm) and the others drift. Where an edge is blurred
by a Gaussian of σ, its steepest slope falls as 1/√(σ² + s²) when it is blurred once more by s. Two
such blurs, s₁ < s₂, and R = slope₁/slope₂ give σ² = (s₂² − R² s₁²)/(R² − 1), whatever the contrast
of the band (after Zhuo and Sim, Pattern Recognition 44, 2011).

Lines are no steps: their slope falls faster than any step's, R > s₂/s₁, and they would look sharper than the
sharpest lens. Icons are full of them. An edge counts where it falls as steps do, from s₁ to s₂ and on to s₃.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.core.threads import each

if TYPE_CHECKING:
    from collections.abc import Sequence

FIRST, SECOND, THIRD = 1.0, 2.0, 4.0
STEEPEST = 0.05
"""Share of the pixels, by slope, that may be edges."""
NEIGHBOURS = 1.05
"""How much faster than a lone step's a slope may fall from the second blur to the third: others are near."""
LEAST_EDGES = 16
LEAST_SLOPE = 5.0
"""Slope over that of noise, below which there are no edges to measure."""
LONGEST = 768
FLOOR_PX = 0.25


class Sharpness(NamedTuple):
    """Focus of one band.

    Parameters
    ----------
    blur_px : float
        Standard deviation of the blur, native px; 0.25 is the least that can be measured. NaN where
        the band has too few step edges to measure.
    edges : int
        Pixels of edges that fall as steps do.
    """

    band: str
    blur_px: float
    edges: int


def band_sharpness(
    values: np.ndarray, labels: Sequence[str], *, left_out: np.ndarray | None = None
) -> list[Sharpness]:
    """Measure the focus of every band on the picture's own edges.

    Examples
    --------
    >>> from scipy.ndimage import gaussian_filter
    >>> scene = np.kron(np.random.default_rng(1).random((12, 12)), np.ones((24, 24)))
    >>> round(band_sharpness(gaussian_filter(scene, 1.5)[..., None], ["G"])[0].blur_px, 1)
    1.6
    """
    middle = middle_of((values.shape[0], values.shape[1]))

    def sharpness(band: int, label: str) -> Sharpness:
        return Sharpness(label, *edge_blur(values[middle][..., band], _of(left_out, middle, band)))

    return each(sharpness, range(len(labels)), labels)


def middle_of(shape: tuple[int, int]) -> tuple[slice, slice]:
    """Return the rows and columns of a picture, (h, w), that are looked at."""
    starts = [max(0, (size - LONGEST) // 2) for size in shape]
    rows, columns = (slice(a, min(a + LONGEST, n)) for a, n in zip(starts, shape, strict=True))
    return rows, columns


def _of(left_out: np.ndarray | None, middle: Any, band: int) -> np.ndarray | None:
    return None if left_out is None else left_out[middle][..., band]


def edge_blur(plane: np.ndarray, left_out: np.ndarray | None = None) -> tuple[float, int]:
    """Return the blur of a plane's sharpest edges, px, and how many edge pixels were looked at.

    Edges nearer than 16 px to what is `left_out`, (h, w) of bool, do not count.
    """
    import cv2

    plane = np.nan_to_num(np.asarray(plane, np.float32))
    if min(plane.shape) < 32:
        return float("nan"), 0
    first = _slope(plane, FIRST)
    edge = min(16, min(plane.shape) // 4)  # what lies beyond the frame is not known
    usable = np.zeros(plane.shape, bool)
    usable[edge:-edge, edge:-edge] = True
    if left_out is not None and left_out.any():
        near = np.ones((2 * edge + 1, 2 * edge + 1), np.uint8)
        usable &= cv2.dilate(left_out.astype(np.uint8), near) == 0
    if np.count_nonzero(usable) < LEAST_EDGES**2:
        return float("nan"), 0
    slope = float(np.quantile(first[usable], 1 - STEEPEST))
    # Noise alone has slopes, too: the median is theirs, for most of a picture is no edge.
    if slope <= LEAST_SLOPE * 0.25 * _noise_slope(plane):
        return float("nan"), 0
    crest = (first == cv2.dilate(first, np.ones((3, 3), np.uint8))) & (first >= slope)
    crest &= usable
    second, third = (_slope(plane, sigma, crest) for sigma in (SECOND, THIRD))
    ratio = first[crest].astype(float) / np.maximum(second, 1e-12)
    onward = second / np.maximum(third, 1e-12)
    steps = (ratio > 1.001) & (ratio < SECOND / FIRST) & (onward < NEIGHBOURS * THIRD / SECOND)
    count = int(np.count_nonzero(steps))
    if count < LEAST_EDGES:
        return float("nan"), count
    squared = ratio[steps] ** 2
    blur = np.sqrt((SECOND**2 - squared * FIRST**2) / (squared - 1))
    return max(FLOOR_PX, float(np.median(blur))), count


def _noise_slope(plane: np.ndarray) -> float:
    """Slope that white noise of the plane's own strength would have after the first blur."""
    fine = plane[1:-1, 1:-1] - (plane[:-2, 1:-1] + plane[2:, 1:-1]) / 2
    return float(np.median(np.abs(fine))) / 0.6745 / np.sqrt(1.5)


def _slope(plane: np.ndarray, sigma: float, at: Any = np.s_[:]) -> np.ndarray:
    """Magnitude of the gradient of a plane behind a Gaussian, per px, in the places `at`."""
    import cv2

    reach = int(4 * sigma + 0.5)
    x = np.arange(-reach, reach + 1)
    bell = np.exp(-0.5 * (x / sigma) ** 2)
    bell /= bell.sum()
    edge = x / sigma**2 * bell
    border = cv2.BORDER_REPLICATE
    along, down = (
        cv2.sepFilter2D(plane, cv2.CV_32F, kernel_x, kernel_y, borderType=border)
        for kernel_x, kernel_y in ((edge, bell), (bell, edge))
    )
    return np.hypot(along[at], down[at])
