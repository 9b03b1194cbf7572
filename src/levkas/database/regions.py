"""Statistics of a region of a layer: pixels within a rectangle, circle or polygon, of which the sound ones count."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.flags import MARKS
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    import xarray

BLOCK_SAMPLES = 16_000_000
"""Read at a time."""
TRUSTED = np.uint8(sum(flag for flag, mark in MARKS.items() if mark.trusted))
"""Bits with which a value is an estimate of the paint all the same; any other makes it unsound."""


class RegionRefused(Refused):
    """A region that is none, or that lies outside."""


@dataclass(frozen=True)
class Region:
    """A part of the grid: the corners of a polygon, (n, 2) px, or the centre of a circle of `radius` px; pixel centres are whole numbers."""

    vertices: np.ndarray
    radius: float = 0.0

    @property
    def bounds(self) -> tuple[float, float, float, float]:
        """Least x and y, largest x and y."""
        low, high = self.vertices.min(0) - self.radius, self.vertices.max(0) + self.radius
        return float(low[0]), float(low[1]), float(high[0]), float(high[1])

    def contains(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        """Return which pixel centres lie within; a polygon by the even-odd rule.

        >>> triangle = Region(np.array([(0.0, 0.0), (4.0, 0.0), (0.0, 4.0)]))
        >>> triangle.contains(np.array([1, 3]), np.array([1, 3])).tolist()
        [True, False]
        """
        if self.radius:
            (cx, cy), r = self.vertices[0], self.radius
            return np.asarray((x - cx) ** 2 + (y - cy) ** 2 <= r * r)
        inside, beside = np.zeros(np.broadcast(x, y).shape, bool), np.roll(self.vertices, -1, 0)
        for (ax, ay), (bx, by) in zip(self.vertices, beside, strict=True):
            if ay != by:
                between = (ay > y) != (by > y)
                inside ^= between & (x < ax + (y - ay) / (by - ay) * (bx - ax))
        return inside


def make_region(
    polygon: Sequence[tuple[float, float]] | None,
    rectangle: tuple[float, float, float, float] | None,
    circle: tuple[float, float, float] | None,
) -> Region:
    """Return the one region that is described; raises RegionRefused."""
    named = [one for one in (polygon, rectangle, circle) if one is not None]
    if len(named) != 1:
        raise refused(f"{len(named)} of them", "one of polygon, rectangle and circle")
    numbers = np.atleast_1d(np.asarray(named[0], float))
    expected, sound = "three or more corners (x, y)", numbers.shape == (len(numbers), 2)
    if rectangle is not None:
        expected = "x0, y0, x1, y1 with x0 ≤ x1 and y0 ≤ y1"
        sound = numbers.shape == (4,) and bool((numbers[2:] >= numbers[:2]).all())
    elif circle is not None:
        expected, sound = "x, y and a radius above 0", numbers.shape == (3,) and numbers[2] > 0
    if not sound or len(numbers) < 3 or not np.isfinite(numbers).all():
        raise refused(str(named[0]), f"{expected}, finite")
    if rectangle is not None:
        # Half a pixel more on each side: the pixels of both corners belong to it.
        x0, y0, x1, y1 = numbers + np.array([-0.5, -0.5, 0.5, 0.5])
        return Region(np.array([(x0, y0), (x1, y0), (x1, y1), (x0, y1)]))
    return Region(numbers) if circle is None else Region(numbers[None, :2], float(numbers[2]))


def region_statistics(
    layer: xarray.DataArray, flags: xarray.DataArray, region: Region
) -> xarray.Dataset:
    """Return `mean`, `std` (of n − 1) and number `n` of the sound pixels of a region, band by band, and `pixels`, all that lie within.

    NaN where no pixel is sound. `layer` and `flags` are read some rows at a time. Raises RegionRefused: ``E_REGION``.
    """
    import xarray

    layer, flags = (array.transpose("y", "x", "band") for array in (layer, flags))
    pixels, (count, mean, spread) = 0, np.zeros((3, layer.sizes["band"]))
    for values, sound in _blocks(layer, flags, region):
        pixels += len(values)
        n = sound.sum(0)
        here = np.where(sound, values, 0.0).sum(0) / np.maximum(n, 1)
        rest = np.where(sound, values - here, 0.0)
        total = np.maximum(count + n, 1)
        # Two groups joined: Chan, Golub, LeVeque (1983), 10.1080/00031305.1983.10483115.
        spread += np.square(rest).sum(0) + np.square(here - mean) * count * n / total
        mean += (here - mean) * n / total
        count += n
    if not pixels:
        raise refused("no pixel within", "the centre of a pixel of the array, by its x and y")
    with np.errstate(invalid="ignore", divide="ignore"):
        std = np.sqrt(np.where(count > 1, spread / (count - 1), np.nan))
    found = {
        "mean": ("band", np.where(count > 0, mean, np.nan)),
        "std": ("band", std),
        "n": ("band", count.astype(np.int64)),
        "pixels": ((), pixels),
    }
    coords = {k: v for k, v in layer.coords.items() if v.dims == ("band",)}
    return xarray.Dataset(found, coords=coords)


def _blocks(
    layer: xarray.DataArray, flags: xarray.DataArray, region: Region
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield values of a region's pixels and which are sound, (pixels, bands), some rows at a time."""
    x0, y0, x1, y1 = region.bounds
    columns, rows = _within(layer["x"].values, x0, x1), _within(layer["y"].values, y0, y1)
    x, y = layer["x"].values[columns], layer["y"].values
    step = max(1, BLOCK_SAMPLES // max(1, len(x) * layer.sizes["band"]))
    for top in range(rows.start, rows.stop, step) if len(x) else ():
        down = slice(top, min(top + step, rows.stop))
        mask = region.contains(x[None], y[down, None])
        part = {"y": down, "x": columns}
        values = layer.isel(part).values[mask].astype(np.float64)
        yield values, is_sound(values, flags.isel(part).values[mask])


def is_sound(values: np.ndarray, flags: np.ndarray) -> np.ndarray:
    """Return which values are of the paint: finite, and without a flag that is not trusted."""
    return ((flags & ~TRUSTED) == 0) & np.isfinite(values)


def _within(places: np.ndarray, low: float, high: float) -> slice:
    """Return from which to which index places lie between two, in whatever order they are."""
    found = np.flatnonzero((places >= low) & (places <= high))
    return slice(found[0], found[-1] + 1) if len(found) else slice(0, 0)


def refused(found: str, expected: str, code: str = "E_REGION") -> RegionRefused:
    """Return the refusal of a region, or with ``E_VALUE`` of what cannot be made of it."""
    of_region = "this is not a region of the layer"
    what = of_region if code == "E_REGION" else "no uncertainty of this can be stated"
    return RegionRefused(Problem(code, what, found=found, expected=expected))
