"""A painted surface: amounts of paints, ground, roughness, relief."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from math import ceil
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.simulation import rays
from levkas.simulation.pigments import PAINTS, WAVELENGTHS, paint_spectra
from levkas.simulation.strokes import blend, draw_strokes, fill_area, grain, shrink, soften

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path


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
        Carbon black under the paint, in 255ths; seen where paint becomes transparent.
    relief : ndarray, (rows, columns), float32
        Height of the surface's texture, µm; for light and gloss, too flat to displace anything.
    gloss : float
        Share of the varnish's mirror reflection that the surface has: 1 varnished, 0 matte.
    px_per_mm : float
    names : tuple of str
        Of the paints.
    """

    amounts: np.ndarray
    spectra: np.ndarray
    metal: np.ndarray
    underdrawing: np.ndarray
    relief: np.ndarray
    px_per_mm: float
    gloss: float = 1.0
    names: tuple[str, ...] = ()

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


class Canvas:
    """A painting in the making, upright, in millimetres from its top left corner.

    Parameters
    ----------
    width, height : float
        mm.
    px_per_mm : float
    paints : tuple of str
        Keys of `pigments.PAINTS`; the first covers all to begin with.
    rng : Generator
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

    def sketch(self, strokes: Iterable[np.ndarray], opacity: float = 0.8) -> None:
        """Draw below the paint, with carbon black."""
        mask = (self.lines(strokes) * opacity).astype(np.uint8)
        np.maximum(self.underdrawing, mask, out=self.underdrawing)

    def vary(
        self, mask: np.ndarray, paint: str, field: np.ndarray, *, above: float, most: float
    ) -> None:
        """Lay a paint within `mask` as `field` rises above a level, at `most` this opaque."""
        share = np.clip((field - np.float32(above)) * np.float32(90), 0, 255).astype(np.uint8)
        self.lay(multiply(share, mask), paint, most)

    def finish(self, panel: Panel, *, library: Path | str | None = None) -> Painting:
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
            paint_spectra(self.paints, WAVELENGTHS, library=library),
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
