"""Garments of saints: cloth streaked by the brush, modelled by folds, light and hatching."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.simulation.painting import multiply
from levkas.simulation.strokes import brush, curve

if TYPE_CHECKING:
    from levkas.simulation.painting import Canvas


def lay_garment(
    canvas: Canvas, outline: np.ndarray, paints: tuple[str, str, str], within: np.ndarray
) -> np.ndarray:
    """Lay a garment with streaks of the brush and a dark contour; return its mask."""
    base, light, dark = paints
    mask = multiply(canvas.area(outline), within)
    canvas.sketch([brush(outline + canvas.rng.normal(0, 0.7, 2), 0.8, taper=0)])
    canvas.lay(mask, base, relief=12)
    canvas.vary(mask, dark, canvas.grain((6.0, 16.0), octaves=6), above=0.3, most=0.6)
    canvas.vary(mask, light, canvas.grain((3.0, 16.0), octaves=6), above=0.7, most=0.45)
    canvas.vary(mask, light, canvas.grain((0.7, 4.0), octaves=3), above=0.8, most=0.4)
    canvas.vary(mask, dark, canvas.grain((0.9, 3.0), octaves=3), above=1.0, most=0.4)
    canvas.stroke([brush(outline, 1.5, taper=0.2)], "umber", within=within)
    canvas.stroke([brush(outline, 0.7, taper=0.2)], "black", 0.8, within=within)
    return mask


def paint_folds(
    canvas: Canvas,
    garment: np.ndarray,
    paints: tuple[str, str, str],
    bundles: list[list[tuple[np.ndarray, np.ndarray]]],
    *,
    scale: float = 1.0,
) -> None:
    """Model a garment: dark folds, bands of light beside them, hatching and fine highlights.

    Parameters
    ----------
    canvas : Canvas
    garment : ndarray, uint8
        Mask.
    paints : (base, light, dark)
    bundles : list of list of (path, path)
        Each fold by the line of its shadow and that of its light, (n, 2) mm.
    scale : float
        Of the strokes' widths.
    """
    _, light, dark = paints
    rng = canvas.rng.spawn(1)[0]
    folds = [fold for bundle in bundles for fold in bundle]
    canvas.sketch([brush(shade + rng.normal(0, 0.8, 2), 0.6) for shade, _ in folds])
    canvas.stroke([brush(s, 3.4 * scale) for s, _ in folds], dark, 0.45, within=garment)
    middle, bright, hatching, ridges = [], [], [], []
    for shade, lit in folds:
        for piece in _pieces(len(shade), rng):
            a, b = shade[piece], lit[piece]
            swell = np.sin(np.pi * np.linspace(0, 1, len(a)))[:, None] ** 0.7
            middle.append(np.vstack([a + 0.2 * (b - a), (a + (b - a) * (0.2 + 1.0 * swell))[::-1]]))
            bright.append(
                np.vstack([a + 0.45 * (b - a), (a + (b - a) * (0.45 + 0.6 * swell))[::-1]])
            )
            ridges.append(brush(a + 0.45 * (b - a), 0.6 * scale, taper=0.9))
            for k in range(2, len(a) - 2):
                tip = a[k] + (b[k] - a[k]) * (0.5 + 0.75 * swell[k])
                ends = np.array([a[k], 0.5 * (a[k] + tip) + rng.normal(0, 0.15, 2), tip])
                hatching.append(brush(ends, rng.uniform(0.2, 0.4) * scale, taper=0.9))
    canvas.lay(canvas.areas(middle), light, 0.5, within=garment)
    canvas.lay(canvas.areas(bright), light, 0.75, within=garment, relief=5)
    canvas.stroke([brush(s, 1.3 * scale) for s, _ in folds], dark, 0.9, within=garment)
    canvas.stroke([brush(s, 0.45 * scale) for s, _ in folds], "black", 0.7, within=garment)
    canvas.stroke(hatching, "white", 0.5, within=garment)
    canvas.stroke(ridges, "white", 0.8, within=garment)


def _pieces(count: int, rng: np.random.Generator) -> list[slice]:
    """Break a fold's light into two or three runs."""
    cuts = np.sort(rng.uniform(0.25, 0.8, rng.integers(1, 3)))
    ends = np.round(np.array([0.05, *cuts, 0.97]) * count).astype(int)
    gaps = rng.integers(1, 6, len(ends))
    return [
        slice(a + g, b) for a, b, g in zip(ends[:-1], ends[1:], gaps, strict=False) if b - a - g > 6
    ]


def fan(
    start: tuple[float, float],
    spread: tuple[float, float],
    ends: list[tuple[float, float]],
    *,
    bulge: float,
    gap: float,
    rng: np.random.Generator,
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return folds that run from near `start` (along `spread`) to `ends`, each (shadow, light)."""
    folds = []
    n = max(len(ends) - 1, 1)
    for k, end in enumerate(ends):
        a = np.array(start) + np.array(spread) * (k / n - 0.5)
        b = np.array(end, float) + rng.normal(0, 0.02, 2) * np.hypot(*(end - a))
        a = a + (b - a) * rng.uniform(0, 0.3)
        across = np.array([a[1] - b[1], b[0] - a[0]]) / (np.hypot(*(b - a)) or 1.0)
        side = (bulge * rng.uniform(0.3, 1.7) + rng.normal(0, 0.012)) * np.hypot(*(b - a))
        sway = rng.uniform(-0.4, 1.0) * side
        path = curve([a, a + (b - a) * 0.35 + across * side, a + (b - a) * 0.7 + across * sway, b])
        wide = gap * rng.uniform(0.7, 1.5) * np.linspace(0.5, 1, len(path))[:, None]
        folds.append((path, path + across * wide))
    return folds
