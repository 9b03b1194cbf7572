"""Painted surfaces: strokes, amounts of paints, ground, roughness, relief."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.compiled import njit
from levkas.simulation import rays
from levkas.simulation.pigments import PAINTS, WAVELENGTHS, paint_spectra

if TYPE_CHECKING:
    from collections.abc import Iterable

    from numpy.typing import ArrayLike


EVEN_FACETS = (0.55**2, 0.16**2)
AGED_FACETS = (0.2, 0.1)
"""GGX alpha of gold and varnish: of a new, even panel, and of the planner's bench."""
UNEVEN_MM, UNEVEN_UM = 1.2, 576.0
"""Distance of the nodes of an uneven ground; its unit for a slope of 1, at 5 samples per mm."""


@dataclass(frozen=True, eq=False)
class Painting:
    """What covers a panel, sampled finely; the first row is at t = −height/2, first column at s = −width/2.

    Parameters
    ----------
    amounts : ndarray, (rows, columns, paints), uint8
        Share of the area that each paint covers, in 255ths.
    spectra : ndarray, (paints, wavelengths)
        Reflectance of each paint at `pigments.WAVELENGTHS`.
    metal : ndarray, (paints,), bool
        Which paints are metal leaf: they reflect only as mirrors of many facets do.
    underdrawing : ndarray, (rows, columns), uint8
        Carbon black under the paint, in 255ths; visible where paint becomes transparent.
    relief : ndarray, (rows, columns), float32
        Height of the surface's texture, µm; for light and gloss, too flat to displace anything.
    gloss : float
        Share of the varnish's mirror reflection that the surface has: 1 varnished, 0 matte.
    names : tuple of str
        Of the paints.
    facets : (gold, varnish)
        GGX alpha of the leaf and of the varnish.
    """

    amounts: np.ndarray
    spectra: np.ndarray
    metal: np.ndarray
    underdrawing: np.ndarray
    relief: np.ndarray
    px_per_mm: float
    gloss: float = 1.0
    names: tuple[str, ...] = ()
    facets: tuple[float, float] = EVEN_FACETS

    def reduced(self, factor: int) -> Painting:
        """Return the painting averaged over blocks of factor x factor samples."""
        import cv2

        if factor == 1:
            return self
        rows, columns = (n // factor for n in self.underdrawing.shape)
        amounts = np.empty((rows, columns, self.amounts.shape[2]), np.uint8)
        shrink(self.amounts, factor, amounts)
        cut = (slice(0, rows * factor), slice(0, columns * factor))
        under, relief = (
            cv2.resize(a[cut], (columns, rows), interpolation=cv2.INTER_AREA)
            for a in (self.underdrawing, self.relief)
        )
        return replace(
            self,
            amounts=amounts,
            underdrawing=under,
            relief=relief,
            px_per_mm=self.px_per_mm / factor,
        )


def make_uneven(painting: Painting, lean_deg: float, rng: np.random.Generator) -> Painting:
    """Let ground and leaf lean from the panel, as hand-scraped gesso and lifted craquelure do.

    Parameters
    ----------
    lean_deg : float
        Along any direction, root mean square, degrees.

    Returns
    -------
    painting : Painting
        With the roughness of the planner's bench, `AGED_FACETS`.
    """
    field = grain(painting.relief.shape, painting.px_per_mm, (UNEVEN_MM,) * 2, rng, octaves=1)
    relief = painting.relief + np.float32(UNEVEN_UM * np.tan(np.radians(lean_deg))) * field
    return replace(painting, relief=relief, facets=AGED_FACETS)


class Canvas:
    """A painting in the making, upright, in millimetres from its top left corner.

    Parameters
    ----------
    width, height : float
        mm.
    paints : tuple of str
        Keys of `pigments.PAINTS`; the first covers all to begin with.
    """

    def __init__(
        self,
        width: float,
        height: float,
        px_per_mm: float,
        rng: np.random.Generator,
        *,
        paints: tuple[str, ...] = tuple(PAINTS),
    ) -> None:
        self.width, self.height, self.px_per_mm, self.paints = width, height, px_per_mm, paints
        self.shape = (int(np.ceil(height * px_per_mm)) + 1, int(np.ceil(width * px_per_mm)) + 1)
        self.amounts = np.zeros((*self.shape, len(paints)), np.uint8)
        self.amounts[..., 0] = 255
        self.underdrawing = np.zeros(self.shape, np.uint8)
        self.relief = np.zeros(self.shape, np.float32)
        self.rng = rng

    def area(self, outline: np.ndarray, *, soft: float = 0.0) -> np.ndarray:
        """Return the mask of a closed outline, (n, 2) mm, its edge blurred by `soft` mm."""
        mask = np.zeros(self.shape, np.uint8)
        fill_area(mask, outline, self.px_per_mm)
        return soften(mask, soft * self.px_per_mm) if soft * self.px_per_mm > 0.3 else mask

    def areas(self, outlines: Iterable[np.ndarray]) -> np.ndarray:
        """Return the mask of several closed outlines, each (n, 2) mm."""
        mask = np.zeros(self.shape, np.uint8)
        for outline in outlines:
            fill_area(mask, outline, self.px_per_mm)
        return mask

    def lines(self, strokes: Iterable[np.ndarray]) -> np.ndarray:
        """Return the mask of strokes, (n, 3) mm."""
        mask = np.zeros(self.shape, np.uint8)
        draw_strokes(mask, strokes, self.px_per_mm)
        return mask

    def grain(
        self, spacing: float | tuple[float, float], *, octaves: int = 5, fall: float = 0.7
    ) -> np.ndarray:
        """Return a random field with nodes `spacing` mm apart, spread about 1."""
        steps = spacing if isinstance(spacing, tuple) else (spacing, spacing)
        child = self.rng.spawn(1)[0]
        return grain(self.shape, self.px_per_mm, steps, child, octaves=octaves, fall=fall)

    def lay(
        self,
        mask: np.ndarray,
        paint: str,
        opacity: float = 1.0,
        *,
        within: np.ndarray | None = None,
        relief: float = 0.0,
    ) -> None:
        """Lay a paint through a mask, `within` another, and raise the surface by `relief` µm."""
        if within is not None:
            mask = multiply(mask, within)
        blend(self.amounts, mask, self.paints.index(paint), opacity)
        if relief:
            self.relief += mask * np.float32(relief / 255)

    def stroke(
        self,
        strokes: Iterable[np.ndarray],
        paint: str,
        opacity: float = 1.0,
        *,
        within: np.ndarray | None = None,
        relief: float = 6.0,
    ) -> None:
        """Paint strokes, (n, 3) mm."""
        self.lay(self.lines(strokes), paint, opacity, within=within, relief=relief)

    def sketch(self, strokes: Iterable[np.ndarray]) -> None:
        """Draw below the paint, with carbon black."""
        mask = (self.lines(strokes) * 0.8).astype(np.uint8)
        np.maximum(self.underdrawing, mask, out=self.underdrawing)

    def vary(
        self, mask: np.ndarray, paint: str, field: np.ndarray, *, above: float, most: float
    ) -> None:
        """Lay a paint within `mask` as `field` rises above a level, at `most` this opaque."""
        share = np.clip((field - np.float32(above)) * np.float32(90), 0, 255).astype(np.uint8)
        self.lay(multiply(share, mask), paint, most)

    def finish(self, panel: Panel) -> Painting:
        """Return the painting on its side, top to the left, as the paper lays icons down.

        The panel's s runs down the icon, its t from the icon's right to its left.
        """
        rows, columns = (round(n * self.px_per_mm) for n in (panel.height_mm, panel.width_mm))
        # Turned about the panel's own size, not the raster's, so that position is kept exactly.
        flat = [np.ascontiguousarray(np.rot90(a)) for a in (self.amounts, self.underdrawing)]
        relief = np.ascontiguousarray(np.rot90(self.relief))
        spare = flat[0].shape[0] - rows
        cut = (slice(spare, spare + rows), slice(0, columns))
        return Painting(
            np.ascontiguousarray(flat[0][cut]),
            paint_spectra(self.paints, WAVELENGTHS),
            np.array([p == "gold" for p in self.paints]),
            np.ascontiguousarray(flat[1][cut]),
            np.ascontiguousarray(relief[cut]),
            self.px_per_mm,
            names=self.paints,
        )


def multiply(mask: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Return the product of two uint8 masks."""
    import cv2

    return cv2.multiply(mask, other, scale=1 / 255)


FLAT_RADIUS_MM = 1e8
STEEPEST_RAY = 0.3  # tangent of the angle to the normal; cameras that look at a panel stay below


@dataclass(frozen=True)
class Panel:
    """Shape of a painted board as it lies before the cameras.

    Parameters
    ----------
    width_mm, height_mm : float
        Along s and t.
    radius_mm : float
        Of the cylinder, convex towards the viewer.
    depth_mm : float
        How far the centre is lowered.
    border_mm, bevel_mm : float
        Width of the rectangular frame left around it, and of the slope between the two.
    twist_mm : float
        Lift of the corners, alternately up and down.

    Raises
    ------
    ValueError
        Where a size is not positive.
    """

    width_mm: float = 421.0
    height_mm: float = 316.0
    radius_mm: float = FLAT_RADIUS_MM
    depth_mm: float = 0.0
    border_mm: float = 30.0
    bevel_mm: float = 4.0
    twist_mm: float = 0.0

    def __post_init__(self) -> None:
        for name in ("width_mm", "height_mm", "radius_mm", "bevel_mm"):
            if getattr(self, name) <= 0:
                raise ValueError(f"panel: {name} must be > 0, got {getattr(self, name)}")

    def vector(self) -> np.ndarray:
        """Return the shape as the numbers that kernels take, float64 (8,)."""
        reach = self.depth_mm + 4 * abs(self.twist_mm) + 0.02
        steps = max(2, ceil(2 * reach * STEEPEST_RAY / self.bevel_mm))
        return np.array(
            [
                self.width_mm,
                self.height_mm,
                self.radius_mm,
                self.depth_mm,
                self.border_mm,
                self.bevel_mm,
                self.twist_mm,
                steps,
            ]
        )

    def heights(self, points: np.ndarray) -> np.ndarray:
        """Return the height above the cylinder, mm, of `points` (n, 2) = (s, t)."""
        return rays.heights(np.ascontiguousarray(points, float), self.vector())

    def contains(self, points: np.ndarray) -> np.ndarray:
        """Return which of `points` (n, 2) = (s, t) lie on the board."""
        s, t = np.abs(np.asarray(points, float)).T
        return (s <= self.width_mm / 2) & (t <= self.height_mm / 2)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record; `Panel(**record)` is its inverse."""
        return asdict(self)


SUB_BITS = 6


def curve(points: ArrayLike, *, count: int = 24, closed: bool = False) -> np.ndarray:
    """Return a smooth curve through `points` (Catmull–Rom), (count·segments + 1, 2)."""
    p = np.asarray(points, float)
    if closed:
        p = np.vstack([p[-1:], p, p[:2]])
    else:
        p = np.vstack([2 * p[0] - p[1], p, 2 * p[-1] - p[-2]])
    t = np.arange(count)[:, None] / count
    parts = [
        0.5
        * (
            2 * b
            + (c - a) * t
            + (2 * a - 5 * b + 4 * c - d) * t**2
            + (3 * b - a - 3 * c + d) * t**3
        )
        for a, b, c, d in zip(p[:-3], p[1:-2], p[2:-1], p[3:], strict=True)
    ]
    return np.vstack([*parts, p[-2:-1]])


def ellipse(centre: ArrayLike, rx: float, ry: float | None = None) -> np.ndarray:
    """Return the closed outline of an ellipse about `centre`, (97, 2); a circle without `ry`."""
    a = np.linspace(0, 2 * np.pi, 97)
    return np.asarray(centre) + np.stack(
        [rx * np.cos(a), (rx if ry is None else ry) * np.sin(a)], 1
    )


def brush(points: np.ndarray, width: float, *, taper: float = 0.7) -> np.ndarray:
    """Give a line the width of a brush stroke, thin at both ends.

    Parameters
    ----------
    points : ndarray, (n, 2), mm
    width : float
        At its widest, mm.
    taper : float
        0 keeps the width, 1 ends in points.

    Returns
    -------
    stroke : ndarray, (n, 3)
        x, y and half the width, mm.
    """
    swell = np.sin(np.pi * np.linspace(0.04, 0.96, len(points))) ** 0.6
    return np.column_stack([points, 0.5 * width * (1 - taper + taper * swell)])


def draw_strokes(mask: np.ndarray, strokes: Iterable[np.ndarray], px_per_mm: float) -> None:
    """Draw strokes (n, 3), as `brush` makes them, into a uint8 mask, edges anti-aliased."""
    parts = [np.hstack([s[:-1], s[1:]]) for s in strokes if len(s) > 1]
    if parts:
        segments = np.vstack(parts) * px_per_mm
        # Raster positions are pixel centres at integers, as everywhere.
        segments[:, [0, 1, 3, 4]] -= 0.5
        _draw(mask, segments)


def fill_area(mask: np.ndarray, outline: np.ndarray, px_per_mm: float) -> None:
    """Fill a closed outline (n, 2), mm, into a uint8 mask."""
    import cv2

    scaled = (np.asarray(outline)[:, :2] * px_per_mm - 0.5) * 2**SUB_BITS
    cv2.fillPoly(mask, [np.round(scaled).astype(np.int32)], 255, cv2.LINE_AA, SUB_BITS)


def soften(mask: np.ndarray, radius: float) -> np.ndarray:
    """Return a mask blurred by a Gaussian of `radius` pixels, at a cost that does not grow with it."""
    import cv2

    factor = max(1.0, radius / 4)
    height, width = mask.shape
    small = (max(2, round(width / factor)), max(2, round(height / factor)))
    reduced = cv2.resize(mask, small, interpolation=cv2.INTER_AREA) if factor > 1 else mask
    blurred = cv2.GaussianBlur(reduced, (0, 0), radius / factor)
    return cv2.resize(blurred, (width, height), interpolation=cv2.INTER_LINEAR)


def grain(
    shape: tuple[int, int],
    px_per_mm: float,
    spacing: tuple[float, float],
    rng: np.random.Generator,
    *,
    octaves: int = 5,
    fall: float = 0.7,
) -> np.ndarray:
    """Return a random field of several octaves, the same at every fineness of the raster.

    Parameters
    ----------
    shape : (rows, columns)
    spacing : (x, y)
        Distance of the nodes of the coarsest octave, mm; unequal for streaks.
    fall : float
        Amplitude of an octave over that of the coarser one.

    Returns
    -------
    field : ndarray, shape, float32
        Mean about 0, spread about 1.
    """
    import cv2

    total = np.zeros(shape, np.float32)
    power = 0.0
    for k, child in enumerate(rng.spawn(octaves)):
        step = np.array(spacing) / 2**k
        if min(step) * px_per_mm < 1.2:
            break
        nodes = [
            int(np.ceil(n / px_per_mm / s)) + 4 for n, s in zip(shape[::-1], step, strict=True)
        ]
        lattice = child.standard_normal((nodes[1], nodes[0]), np.float32)
        size = [round(n * s * px_per_mm) for n, s in zip(nodes, step, strict=True)]
        field = cv2.resize(lattice, size, interpolation=cv2.INTER_CUBIC)
        offset = [round(1.5 * s * px_per_mm) for s in step]
        total += fall**k * field[offset[1] : offset[1] + shape[0], offset[0] : offset[0] + shape[1]]
        power += fall ** (2 * k) * 0.45
    return total / np.float32(max(power, 1e-6) ** 0.5)


@njit(cache=True)
def _draw(mask: np.ndarray, segments: np.ndarray) -> None:
    """Draw capsules whose radius runs linearly from end to end."""
    rows, columns = mask.shape
    for k in range(len(segments)):
        x0, y0, r0, x1, y1, r1 = segments[k]
        reach = max(r0, r1, 0.5) + 1.0
        left, right = int(np.floor(min(x0, x1) - reach)), int(np.ceil(max(x0, x1) + reach))
        top, low = int(np.floor(min(y0, y1) - reach)), int(np.ceil(max(y0, y1) + reach))
        dx, dy = x1 - x0, y1 - y0
        length = dx * dx + dy * dy
        for i in range(max(top, 0), min(low + 1, rows)):
            for j in range(max(left, 0), min(right + 1, columns)):
                at = 0.0
                if length > 0.0:
                    at = min(max(((j - x0) * dx + (i - y0) * dy) / length, 0.0), 1.0)
                away = np.hypot(j - x0 - at * dx, i - y0 - at * dy)
                radius = r0 + at * (r1 - r0)
                # A line thinner than a pixel covers it in part, and keeps its place.
                cover = min(max(radius, 0.5) + 0.5 - away, 1.0) * min(2.0 * radius, 1.0)
                if cover > 0.0:
                    mask[i, j] = max(mask[i, j], np.uint8(255.0 * cover + 0.5))


@njit(cache=True)
def blend(amounts: np.ndarray, mask: np.ndarray, paint: int, opacity: float) -> None:
    """Lay `paint` over what is there, as far as `mask` (uint8) covers it."""
    for i in range(mask.shape[0]):
        for j in range(mask.shape[1]):
            m = mask[i, j] * opacity / 255.0
            if m <= 0.002:
                continue
            rest = 255
            for k in range(amounts.shape[2]):
                value = int(amounts[i, j, k] * (1.0 - m) + 0.5)
                amounts[i, j, k] = value
                if k != paint:
                    rest -= value
            amounts[i, j, paint] = max(rest, 0)


@njit(cache=True)
def shrink(planes: np.ndarray, factor: int, out: np.ndarray) -> None:
    """Average blocks of factor x factor of uint8 planes (rows, columns, n) into `out`."""
    area = factor * factor
    for i in range(out.shape[0]):
        for j in range(out.shape[1]):
            for k in range(out.shape[2]):
                total = area // 2
                for y in range(i * factor, (i + 1) * factor):
                    for x in range(j * factor, (j + 1) * factor):
                        total += planes[y, x, k]
                out[i, j, k] = total // area
