"""Painted saints: head, hands, garments with folds, on a canvas in millimetres."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.simulation.painting import brush, curve, ellipse, multiply

if TYPE_CHECKING:
    from levkas.simulation.painting import Canvas


@dataclass(frozen=True)
class Saint:
    """Where a saint stands and what the painter gave him.

    Parameters
    ----------
    x, y : float
        Middle of the face, mm.
    size : float
        Half the width of the face, mm.
    robe, mantle : (base, light, dark)
        Paints of the inner and the outer garment.
    beard : float
        Length in units of `size`, 0 for none.
    hood : bool
        The mantle covers the head.
    hair : (base, light)
    """

    x: float
    y: float
    size: float
    robe: tuple[str, str, str] = ("azurite", "azurite light", "azurite dark")
    mantle: tuple[str, str, str] = ("madder", "pink", "madder dark")
    beard: float = 0.9
    hood: bool = False
    hair: tuple[str, str] = ("umber", "umber light")

    def at(self, points: np.ndarray) -> np.ndarray:
        """Bring (n, 2) from units of the face on to the canvas, mm."""
        return np.asarray(points, float) * self.size + (self.x, self.y)

    def line(
        self, points: list[tuple[float, float]], width: float, taper: float = 0.7
    ) -> np.ndarray:
        """Return a brush stroke through points in units of the face; `width` in mm."""
        return brush(curve(self.at(np.array(points))), width, taper=taper)


def paint_halo(canvas: Canvas, saint: Saint) -> None:
    """Gild the halo: leaf, an incised pattern of rays and circles, a red rim."""
    centre, radius = saint.at(np.array([[0.0, -0.12]]))[0], 2.35 * saint.size
    disc = canvas.area(ellipse(centre, radius))
    canvas.lay(disc, "red ochre", relief=8)
    canvas.lay(disc, "gold", 0.97)
    angles = np.linspace(0, 2 * np.pi, 120, endpoint=False)
    inner, outer = 1.62 * saint.size, 2.12 * saint.size
    rays = [
        brush(centre + np.outer([r0, r1], (np.cos(a), np.sin(a))), 0.35, taper=0)
        for k, a in enumerate(angles)
        for r0, r1 in [(inner, outer if k % 2 else inner + 0.3 * (outer - inner))]
    ]
    rings = [brush(ellipse(centre, r), 0.4, taper=0) for r in (inner, outer, 0.97 * outer)]
    canvas.stroke(rays + rings, "red ochre", 0.45, relief=-25)
    dots = [
        brush(ellipse(centre + 0.5 * (inner + outer) * np.array([np.cos(a), np.sin(a)]), 0.7), 0.4)
        for a in angles[::3] + angles[1] / 2
    ]
    canvas.stroke(dots, "umber", 0.7, relief=-25)
    rim = brush(ellipse(centre, radius), 2.2, taper=0)
    canvas.stroke([rim], "white", 0.9)
    canvas.stroke([rim * (1, 1, 0.6)], "vermilion")


def paint_head(canvas: Canvas, saint: Saint) -> None:
    """Paint hair, face and beard from the dark ground of sankir up to white highlights."""
    rng, at, line = canvas.rng.spawn(1)[0], saint.at, saint.line
    face = at(curve(FACE, closed=True))
    canvas.sketch([brush(face + rng.normal(0, 0.4, 2), 0.7, taper=0)])
    back = at(ellipse((0, -0.25), 1.25, 1.5)) if not saint.hood else at(curve(HOOD, closed=True))
    canvas.lay(canvas.area(back), saint.mantle[0] if saint.hood else saint.hair[0], relief=10)
    canvas.lay(canvas.area(at(curve(NECK, closed=True))), "sankir")
    mask = canvas.area(face)
    canvas.lay(mask, "sankir", relief=8)
    for x, y, rx, ry, paint, opacity in FLESH:
        canvas.lay(
            canvas.area(at(ellipse((x, y), rx, ry)), soft=0.13 * saint.size),
            paint,
            opacity,
            within=mask,
        )
    if saint.beard:
        _paint_hair(canvas, saint, rng, beard=True)
    if saint.hood:
        edge = at(curve(HOOD, closed=True))
        canvas.stroke([brush(edge, 1.6, taper=0)], "gold", relief=12)
        veil = at(curve([(-0.98, 0.5), (-0.92, -0.5), (0, -1.18), (0.92, -0.5), (0.98, 0.5)]))
        canvas.stroke([brush(veil, 0.16 * saint.size)], saint.robe[1])
        canvas.stroke([brush(veil, 1.0)], saint.robe[2])
    else:
        _paint_hair(canvas, saint, rng, beard=False)
    _paint_features(canvas, saint)
    strokes = []
    for x, y, dx, dy, count in HIGHLIGHTS:
        for k in range(count):
            start = np.array([x, y]) + k * np.array([0.02, 0.045]) + rng.normal(0, 0.006, 2)
            bend = start + 0.5 * np.array([dx, dy]) + (0, -0.02)
            strokes.append(
                line([tuple(start), tuple(bend), (start[0] + dx, start[1] + dy)], 0.5, 0.9)
            )
    canvas.stroke(strokes, "white", 0.85, within=mask)


def _paint_features(canvas: Canvas, saint: Saint) -> None:
    line, size = saint.line, saint.size
    for side in (-1, 1):

        def both(*points: tuple[float, float], side: int = side) -> list[tuple[float, float]]:
            return [(side * x, y) for x, y in points]

        lid = both((0.17, -0.10), (0.28, -0.19), (0.42, -0.21), (0.56, -0.16), (0.66, -0.07))
        low = both((0.19, -0.09), (0.32, -0.03), (0.45, -0.02), (0.62, -0.08))
        white = np.vstack([curve(saint.at(np.array(lid))), curve(saint.at(np.array(low)))[::-1]])
        canvas.lay(canvas.area(white), "umber light")
        canvas.stroke([line(both((0.2, -0.08), (0.27, -0.13), (0.3, -0.07)), 0.05 * size)], "white")
        canvas.lay(
            canvas.area(saint.at(ellipse((side * 0.42, -0.115), 0.098))),
            "umber",
            within=canvas.area(white),
        )
        canvas.lay(canvas.area(saint.at(ellipse((side * 0.42, -0.115), 0.055))), "black")
        canvas.stroke([line(both((0.385, -0.15), (0.40, -0.14)), 0.035 * size, 0)], "white")
        canvas.stroke([line(lid, 0.05 * size)], "black", 0.95)
        canvas.stroke(
            [
                line(low, 0.024 * size),
                line(both((0.16, -0.26), (0.3, -0.30), (0.5, -0.29), (0.66, -0.2)), 0.025 * size),
                line(both((0.22, 0.03), (0.4, 0.09), (0.6, 0.03)), 0.02 * size),
                line(both((0.98, -0.2), (1.08, -0.08), (1.02, 0.12), (0.95, 0.2)), 0.03 * size),
            ],
            "umber",
            0.85,
        )
        brow = both((0.12, -0.36), (0.3, -0.46), (0.5, -0.45), (0.74, -0.30))
        canvas.stroke([line(brow, 0.07 * size)], saint.hair[0], 0.9)
    dark = [
        line(
            [(-0.12, -0.36), (-0.09, -0.1), (-0.085, 0.15), (-0.14, 0.3), (-0.1, 0.37)],
            0.035 * size,
        ),
        line([(-0.1, 0.37), (0.0, 0.41), (0.1, 0.37)], 0.045 * size),
        line([(0.1, 0.37), (0.15, 0.31), (0.12, 0.27)], 0.03 * size),
        line([(-0.24, 0.64), (-0.1, 0.62), (0.0, 0.64), (0.1, 0.62), (0.24, 0.64)], 0.035 * size),
    ]
    canvas.stroke(dark, "umber", 0.95)
    lips = [
        line([(-0.2, 0.60), (-0.08, 0.575), (0, 0.59), (0.08, 0.575), (0.2, 0.60)], 0.07 * size),
        line([(-0.14, 0.69), (0.0, 0.71), (0.14, 0.69)], 0.085 * size),
    ]
    canvas.stroke(lips, "vermilion", 0.55)
    canvas.stroke([line([(0.015, -0.25), (0.02, 0.0), (0.02, 0.27)], 0.05 * size)], "white", 0.7)


def _paint_hair(canvas: Canvas, saint: Saint, rng: np.random.Generator, *, beard: bool) -> None:
    base, light = saint.hair
    if beard:
        b = saint.beard
        outline = [
            (-0.93, 0.05), (-0.86, 0.45), (-0.5, 0.52), (-0.28, 0.50), (0, 0.54), (0.28, 0.50),
            (0.5, 0.52), (0.86, 0.45), (0.93, 0.05), (1.0, 0.5), (0.86, 1.0 + 0.3 * b),
            (0.35, 1.1 + b), (0, 1.0 + b), (-0.35, 1.1 + b), (-0.86, 1.0 + 0.3 * b), (-1.0, 0.5),
        ]  # fmt: skip
        canvas.lay(
            canvas.area(saint.at(curve(outline, closed=True, count=8))), base, 0.92, relief=8
        )
        mouth = canvas.area(saint.at(ellipse((0, 0.66), 0.26, 0.13)), soft=0.03 * saint.size)
        canvas.lay(mouth, "sankir", 0.9)
    strands = []
    for u in np.linspace(-1, 1, 46):
        if beard:
            x0, y0 = 0.9 * u, 0.75 - 0.35 * abs(u) + rng.normal(0, 0.05)
            length = 0.45 + saint.beard * (1 - 0.5 * u * u) * rng.uniform(0.5, 0.9)
            wave = 0.07 * np.sin(5 * u + 1)
            path = [
                (x0, y0),
                (x0 * 0.98 + wave, y0 + 0.35 * length),
                (x0 * 0.8 - wave, y0 + 0.7 * length),
                (x0 * 0.55 + 0.4 * wave, y0 + length),
            ]
        else:
            side = np.sign(u) or 1.0
            r = abs(u)
            path = [
                (0.03 * side, -1.66 + 0.45 * r),
                (side * (0.25 + 0.75 * (1 - r)), -1.50 + 0.55 * r),
                (side * (0.75 + 0.45 * (1 - r)), -0.85 + 0.3 * r),
                (side * (0.98 + 0.22 * (1 - r)), -0.1 + rng.normal(0, 0.05)),
            ]
        strands.append(saint.line(path, rng.uniform(0.35, 0.8), 0.9))
    canvas.stroke(strands[::2], light, 0.75)
    canvas.stroke(strands[1::4], "black", 0.5)


def paint_hand(canvas: Canvas, centre: np.ndarray, size: float) -> None:
    """Paint a hand raised in blessing."""

    def at(points: list[tuple[float, float]]) -> np.ndarray:
        return np.array(points) * size + centre

    palm = curve(
        at([(-0.35, 0.75), (-0.42, 0.1), (-0.25, -0.2), (0.25, -0.2), (0.42, 0.15), (0.3, 0.8)]),
        closed=True,
    )
    fingers = [
        [(-0.2, -0.1), (-0.27, -0.6), (-0.24, -1.05)],
        [(0.0, -0.15), (0.0, -0.65), (0.08, -1.12)],
        [(0.16, -0.1), (0.3, -0.45), (0.22, -0.75)],
        [(0.28, 0.0), (0.46, -0.25), (0.36, -0.55)],
        [(-0.32, 0.3), (-0.5, 0.0), (0.05, -0.35)],
    ]
    ribbons = [brush(curve(at(f)), 0.25 * size, taper=0.35) for f in fingers]
    canvas.lay(canvas.area(palm), "sankir", relief=8)
    canvas.stroke([r * (1, 1, 1.25) for r in ribbons], "umber")
    canvas.stroke(ribbons, "sankir")
    canvas.stroke([r * (1, 1, 0.6) for r in ribbons], "ochre light", 0.9)
    canvas.stroke(
        [brush(curve(at([(-0.2, 0.55), (-0.1, 0.2), (0.15, 0.1)])), 0.3 * size)], "ochre light", 0.7
    )
    canvas.stroke([r * (1, 1, 0.18) for r in ribbons], "white", 0.8)
    canvas.stroke([brush(palm, 0.6, taper=0.2)], "umber")


FACE = [
    (0, -1.28), (0.55, -1.12), (0.9, -0.6), (0.97, 0.0), (0.85, 0.55), (0.5, 1.02), (0, 1.2),
    (-0.5, 1.02), (-0.85, 0.55), (-0.97, 0.0), (-0.9, -0.6), (-0.55, -1.12),
]  # fmt: skip
HOOD = [
    (0, -1.75), (0.8, -1.5), (1.3, -0.8), (1.38, 0.1), (1.3, 1.0), (1.5, 2.0), (0, 2.4),
    (-1.5, 2.0), (-1.3, 1.0), (-1.38, 0.1), (-1.3, -0.8), (-0.8, -1.5),
]  # fmt: skip
NECK = [(-0.6, 0.5), (0.6, 0.5), (0.62, 1.5), (0.85, 2.0), (0, 2.2), (-0.85, 2.0), (-0.62, 1.5)]
FLESH = [
    (0.0, -0.80, 0.74, 0.40, "ochre light", 0.85),
    (-0.52, 0.24, 0.34, 0.32, "ochre light", 0.85),
    (0.52, 0.24, 0.34, 0.32, "ochre light", 0.85),
    (0.02, 0.0, 0.13, 0.46, "ochre light", 0.9),
    (0.0, 0.92, 0.26, 0.16, "ochre light", 0.6),
    (-0.5, 0.3, 0.16, 0.14, "flesh", 0.7),
    (0.5, 0.3, 0.16, 0.14, "flesh", 0.7),
    (0.0, -0.85, 0.42, 0.2, "flesh", 0.7),
    (-0.43, -0.31, 0.24, 0.06, "ochre light", 0.7),
    (0.43, -0.31, 0.24, 0.06, "ochre light", 0.7),
]
HIGHLIGHTS = [
    (-0.62, 0.12, 0.22, 0.06, 3), (0.36, 0.16, 0.24, -0.05, 3), (-0.35, -0.9, 0.26, -0.05, 4),
    (0.08, -0.94, 0.26, 0.05, 4), (-0.6, -0.36, 0.26, -0.05, 1), (0.32, -0.42, 0.26, 0.06, 1),
]  # fmt: skip


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
