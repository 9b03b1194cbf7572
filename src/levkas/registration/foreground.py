"""Foreground: where the object lies in the reference, as its outline declares it or as an even ground sets it off.

Only the object is compared. An outline that is declared goes before one that is segmented; without either the whole frame is the object.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from scipy import ndimage

from levkas.registration.bands import region_mask

MARGIN_PX = 4
"""Width of the rim of the object that is not compared: there the ground shines through smoothing and parallax."""
LEAST_RIM = 0.6
"""Share of the frame's rim that an even ground takes."""
MOST_UNEVEN = 0.1
"""Five standard deviations of the rim, a share of the picture's range, up to which it is an even ground. Of photographs of
paintings and sections on a ground 0.00 to 0.05, of pictures that fill their frame 0.16 and more."""
LEAST_OBJECT, LEAST_BODY = 0.1, 0.001
"""Shares of the frame: below the first what stands out from a ground is not taken for the object; from the second on a body is a part of
it, and not dust: 28 px square in a megapixel. With half or twice of it outlines of paintings differ by less than 1 %."""
OUTLINE_SHARE = 0.004
"""Tolerance of a segmented outline's polygon, a share of the longer side: 4 px in 1000, as wide as the rim that is left out."""

Corners = Sequence[Sequence[float]] | np.ndarray
_NO_CORNERS = np.empty((0, 2))


@dataclass(frozen=True)
class ObjectArea:
    """Where the object lies in the reference."""

    body: np.ndarray
    """(h, w). Pixels within the outline."""
    outline: np.ndarray
    """(n, 2), reference px. Corners; empty where the whole frame is the object."""
    automatic: bool
    """Whether the outline was segmented; else it is declared."""
    region: tuple[float, ...] | None = None
    """In reference px: declared for the published frame: nothing outside is compared."""
    edge: np.ndarray = field(default_factory=lambda: _NO_CORNERS)
    """(n, 2), reference px. The outline without tolerance: the corners that are declared, or the hull of what was segmented."""
    sides: tuple[float, float] | None = None
    """In reference px: as of `measure_sides`; None where the whole frame is the object."""

    @classmethod
    def of(
        cls,
        image: np.ndarray,
        region: Sequence[float] | None = None,
        outline: Corners | None = None,
    ) -> ObjectArea:
        """Return where the object lies in a picture, (h, w), NaN where invalid.

        Examples
        --------
        >>> picture = np.zeros((60, 80))
        >>> picture[10:50, 10:70] = 1
        >>> area = ObjectArea.of(picture)
        >>> area.automatic, area.outline.min(0).tolist(), area.outline.max(0).tolist()
        (True, [7.0, 7.0], [72.0, 52.0])
        >>> area.sides
        (40.0, 60.0)
        >>> declared = ObjectArea.of(picture, outline=[(0, 0), (40, 0), (40, 59), (0, 59)])
        >>> declared.automatic, float(round(declared.share_of(None), 2))
        (False, 0.51)
        """
        known = None if region is None else tuple(float(v) for v in region)
        if outline is not None and len(outline) > 0:
            corners = np.asarray(outline, float)
            body = fill_polygon(corners, image.shape)
            return cls(body, corners, False, known, corners, _sides_around(corners))
        body = segment_foreground(image)
        if body.all():
            return cls(body, _NO_CORNERS, False, known)
        sides = measure_sides(image, body)
        return cls(body, corners_of(body), True, known, _hull_of(body), sides)

    @cached_property
    def compared(self) -> np.ndarray:
        """Pixels that are compared, (h, w) bool: in the region, and 4 px inside the outline."""
        inside = region_mask(self.region, self.body.shape)
        if self.body.all():
            return inside
        return inside & ndimage.binary_erosion(self.body, iterations=MARGIN_PX, border_value=1)

    def share_of(self, layer: Corners | None) -> float:
        """Return the share of a layer that shows the object, 0 … 1.

        A layer is given by the four corners of the published frame, reference px, of which what the reference's frame holds counts. Without
        one the region, or the whole frame, is the layer.
        """
        if layer is None:
            return float(self.body[region_mask(self.region, self.body.shape)].mean())
        # A lattice over the quadrangle: its share needs no exact edge.
        u = (np.arange(400) + 0.5)[:, None] / 400
        corners = np.asarray(layer, float)
        top = corners[0] + u * (corners[1] - corners[0])
        bottom = corners[3] + u * (corners[2] - corners[3])
        points = top + u[:, None] * (bottom - top)
        x, y = np.rint(points.reshape(-1, 2)).astype(int).T
        height, width = self.body.shape
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        return float(self.body[y[inside], x[inside]].mean()) if inside.any() else 0.0

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record; ``share`` is the object's of the reference's frame."""
        return {
            "automatic": self.automatic,
            "share": round(float(self.body.mean()), 4),
            "outline": np.round(self.outline, 2).tolist(),
            "region": None if self.region is None else list(self.region),
        }


def segment_foreground(image: np.ndarray) -> np.ndarray:
    """Return where the object is in a picture, (h, w), NaN where invalid: all bodies on an even ground, and what lies between them.

    The ground is what is as even as the frame's rim and connected to it. The object is the convex hull of all that
    stands out from it: parts of a painting that look like the ground (a sky, worn paint) and the spaces between the
    fields of a palette are parts of the object. Where the rim is not even, or next to nothing stands out,
    everything is object.

    Examples
    --------
    >>> picture = np.zeros((60, 80))
    >>> picture[10:50, 10:30] = picture[10:50, 50:70] = 1
    >>> found = segment_foreground(picture)
    >>> bool(found[30, 40]), bool(found[5, 40]), bool(segment_foreground(np.ones((60, 80))).all())
    (True, False, True)
    >>> bool(segment_foreground(np.random.default_rng(1).uniform(size=(60, 80))).all())
    True
    """
    everything = np.ones(image.shape, bool)
    if not np.isfinite(image).any():
        return everything
    smooth = _smooth(image)
    rim = everything.copy()
    width = max(3, min(image.shape) // 100)
    rim[width:-width, width:-width] = False
    level = np.median(smooth[rim])
    spread = 1.4826 * np.median(np.abs(smooth[rim] - level))
    low, high = np.percentile(smooth, (1, 99))
    if not high > low or 5 * spread > MOST_UNEVEN * (high - low):
        return everything
    even = np.abs(smooth - level) < max(5 * spread, 0.04 * (high - low))
    patches, _ = ndimage.label(even)
    touching = np.unique(patches[rim & even])
    ground = np.isin(patches, touching[touching > 0])
    if (ground & rim).sum() < LEAST_RIM * rim.sum():
        return everything
    bodies, _ = ndimage.label(ndimage.binary_opening(~ground, iterations=2))
    sizes = np.bincount(bodies.ravel())
    sizes[0] = 0
    found = np.isin(bodies, np.flatnonzero(sizes >= max(LEAST_BODY * image.size, 1)))
    if not found.any():
        return everything
    hull = fill_polygon(_hull_of(found), found.shape)
    return hull if hull.mean() >= LEAST_OBJECT else everything


def _smooth(image: np.ndarray) -> np.ndarray:
    filled = np.where(np.isfinite(image), image, np.median(image[np.isfinite(image)]))
    return np.asarray(ndimage.gaussian_filter(filled, 1.5))


def measure_sides(image: np.ndarray, body: np.ndarray) -> tuple[float, float]:
    """Return the sides, px, the shorter first, of the smallest rectangle around an object, `body`, (h, w) bool, on an even ground.

    A side lies where its contrast with the ground is half of what it is up to 4 px further in: `segment_foreground`
    takes all that stands out, blurred, and is up to 3 px wider on every side.
    """
    smooth = _smooth(image)
    contrast = np.abs(smooth - np.median(smooth[~body]))
    clear = contrast > 5 * 1.4826 * np.median(contrast[~body])
    found = body & clear & (contrast >= ndimage.maximum_filter(contrast, 9) / 2)
    width, height = _sides_around(_hull_of(found if found.any() else body))
    return width + 1, height + 1  # a hull of pixels joins their centres


def _sides_around(corners: np.ndarray) -> tuple[float, float]:
    sides = sorted(cv2.minAreaRect(np.asarray(corners, np.float32))[1])
    return float(sides[0]), float(sides[1])


def _hull_of(found: np.ndarray) -> np.ndarray:
    """Return the corners of the convex hull of marked pixels, (n, 2) px."""
    y, x = np.nonzero(found)
    return np.asarray(cv2.convexHull(np.stack([x, y], 1).astype(np.int32)).reshape(-1, 2), float)


def fill_polygon(corners: Corners, shape: tuple[int, ...]) -> np.ndarray:
    """Return which pixels of a frame, (h, w) bool, lie within a polygon, (n, 2) px, its sides included.

    >>> fill_polygon([(1, 1), (3, 1), (3, 2), (1, 2)], (4, 5)).sum()
    np.int64(6)
    """
    inside = np.zeros(shape, np.uint8)
    cv2.fillPoly(inside, [np.rint(np.asarray(corners, float)).astype(np.int32)], 1)
    return inside.astype(bool)


def corners_of(body: np.ndarray) -> np.ndarray:
    """Return the corners of the largest body, (n, 2) px, to about as many px as its rim is wide; none without any."""
    found, _ = cv2.findContours(body.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    if not found:
        return _NO_CORNERS
    largest = max(found, key=cv2.contourArea)
    corners = cv2.approxPolyDP(largest, OUTLINE_SHARE * max(body.shape), True)
    return np.asarray(corners.reshape(-1, 2), float)


def nearest_within(outline: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return points, (n, 2), with those outside a polygon, (m, 2), moved to the nearest place on its sides.

    >>> square = np.array([[0.0, 0], [10, 0], [10, 10], [0, 10]])
    >>> nearest_within(square, np.array([[4.0, 5], [13, 5], [-3, -4]])).tolist()
    [[4.0, 5.0], [10.0, 5.0], [0.0, 0.0]]
    """
    outside = ~contains(outline, points)
    side, there = np.roll(outline, -1, 0) - outline, points[outside][:, None]
    along = ((there - outline) * side).sum(2) / np.maximum((side**2).sum(1), 1e-12)
    feet = outline + np.clip(along, 0, 1)[..., None] * side
    closest = np.linalg.norm(there - feet, axis=2).argmin(1)
    moved = np.array(points, float)
    moved[outside] = feet[np.arange(len(feet)), closest]
    return moved


def contains(outline: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return which points, (n, 2), lie inside a polygon, (m, 2): a ray to the right crosses its sides an odd number of times.

    >>> contains(np.array([[0.0, 0], [10, 0], [0, 10]]), np.array([[2.0, 2], [8, 8]])).tolist()
    [True, False]
    """
    (ax, ay), (bx, by) = outline.T, np.roll(outline, -1, 0).T
    x, y = points.T[:, :, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        crosses = ((ay > y) != (by > y)) & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    return np.asarray(crosses.sum(1) % 2 == 1)
