"""What surrounds the saints: border, vine, inscriptions, a jewelled book."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from levkas.simulation.strokes import brush, curve, ellipse

if TYPE_CHECKING:
    from levkas.simulation.figures import Saint
    from levkas.simulation.painting import Canvas


def rectangle(canvas: Canvas, inset: float) -> np.ndarray:
    """Return the outline `inset` mm inside the canvas, closed, (5, 2)."""
    w, h = canvas.width - inset, canvas.height - inset
    return np.array([(inset, inset), (w, inset), (w, h), (inset, h), (inset, inset)])


def inscribe(
    canvas: Canvas,
    start: tuple[float, float],
    size: float,
    letters: int,
    *,
    rows: int,
    paint: str = "vermilion",
) -> None:
    """Write a line or two of letter-like strokes: stems, bars and bows, a titlo above."""
    rng = canvas.rng.spawn(1)[0]
    strokes = []
    for row in range(rows):
        for k in range(letters):
            x, y = start[0] + 0.95 * size * k * 0.8, start[1] + 2.1 * size * row
            for _ in range(rng.integers(2, 4)):
                kind, u = rng.integers(0, 4), rng.uniform(0, 0.5)
                if kind == 0:
                    path = [(u, -0.8), (u, 0.1), (u, 0.9)]
                elif kind == 1:
                    path = [(0, rng.uniform(-0.7, 0.7)), (0.3, 0.05), (0.6, rng.uniform(-0.7, 0.7))]
                elif kind == 2:
                    path = [(0.1, -0.75), (0.62, -0.5), (0.6, 0.4), (0.1, 0.75)]
                else:
                    path = [(0.6, -0.8), (0.3, 0), (0, 0.85)]
                points = np.array(path) * size * 0.8 + (x, y)
                strokes.append(brush(curve(points), 0.2 * size, taper=0.4))
        titlo = np.array([(0, -1.3), (1.2, -1.5), (2.2, -1.2)]) * size + (
            start[0],
            start[1] + 2.1 * size * row,
        )
        strokes.append(brush(curve(titlo), 0.14 * size))
    canvas.stroke(strokes, paint, 0.95)


def paint_border(canvas: Canvas, inset: float) -> None:
    """Paint the rims and a running ornament with pearls.

    Rims are alike on both sides. A red line with white on one side alone moves by a third of a
    millimetre between blue and red light, and a frame of such lines feigns a magnification.
    """
    rng = canvas.rng.spawn(1)[0]
    rim = brush(rectangle(canvas, inset - 4.0), 2.6, taper=0)
    canvas.stroke([rim], "white", 0.9)
    canvas.stroke([rim * (1, 1, 0.6)], "vermilion")
    canvas.stroke([brush(rectangle(canvas, 4.5), 1.6, taper=0)], "red ochre")
    middle = 0.5 * inset
    corners = rectangle(canvas, middle)
    vine, leaves, pearls = [], [], []
    for a, b in pairwise(corners):
        length = np.hypot(*(b - a))
        along = (b - a) / length
        across = np.array([-along[1], along[0]])
        t = np.linspace(0, 1, int(length))
        swing = 3.2 * np.sin(2 * np.pi * t * round(length / 26))
        vine.append(brush(a + np.outer(t * length, along) + np.outer(swing, across), 0.9, taper=0))
        for k in range(round(length / 13)):
            at = a + along * 13 * (k + 0.5)
            side = 1 if k % 2 else -1
            for lean in (-0.8, 0.0, 0.8):
                tip = at - across * side * 6.0 * np.cos(lean) + along * 6.0 * np.sin(lean)
                bend = at - across * side * 3.5 + along * (2.0 * lean + rng.normal(0, 0.4))
                leaves.append(brush(curve([at, bend, tip]), 1.9, taper=0.95))
            pearls.append(brush(ellipse(at + across * side * 4.5, 0.35), 1.0, taper=0))
    canvas.stroke(vine, "green earth", 0.95)
    canvas.stroke(leaves, "malachite", 0.9)
    canvas.stroke([leaf * (1, 1, 0.3) for leaf in leaves], "malachite light", 0.9)
    canvas.stroke(pearls, "white", relief=20)


def paint_book(canvas: Canvas, saint: Saint, low: float) -> None:
    """Paint a jewelled gospel book."""
    x, y, w, h = 1.75, min(4.6, low - 1.9), 1.0, 1.35
    lean = 0.1

    def corner(u: float, v: float) -> tuple[float, float]:
        return tuple(saint.at(np.array([x + u * w - lean * v, y + v * h + lean * u])))

    cover = np.array([corner(u, v) for u, v in [(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]])
    pages = cover + saint.size * np.array([0.16, 0.12])
    canvas.lay(canvas.area(pages), "vermilion")
    canvas.stroke([brush(pages, 0.8, taper=0)], "umber")
    mask = canvas.area(cover)
    canvas.lay(mask, "ochre", relief=40)
    canvas.lay(mask, "gold", 0.9)
    rim = np.array(
        [corner(0.86 * u, 0.9 * v) for u, v in [(-1, -1), (1, -1), (1, 1), (-1, 1), (-1, -1)]]
    )
    canvas.stroke([brush(cover, 0.9, taper=0), brush(rim, 0.5, taper=0)], "umber")
    for u, v, radius, paint in [
        (0, 0, 0.3, "azurite"), (-0.6, -0.65, 0.17, "malachite"), (0.6, -0.65, 0.17, "vermilion"),
        (-0.6, 0.65, 0.17, "vermilion"), (0.6, 0.65, 0.17, "malachite"), (0, -0.6, 0.12, "ultramarine"),
        (0, 0.6, 0.12, "ultramarine"), (-0.55, 0, 0.12, "madder"), (0.55, 0, 0.12, "madder"),
    ]:  # fmt: skip
        centre = corner(u, v)
        canvas.lay(canvas.area(ellipse(centre, radius * saint.size)), paint, relief=30)
        canvas.stroke([brush(ellipse(centre, radius * saint.size), 0.5, taper=0)], "umber")
        canvas.stroke([brush(ellipse((centre[0] - 0.4, centre[1] - 0.4), 0.3), 0.4)], "white")
    pearls = [
        brush(ellipse(corner(0.93 * np.cos(a) / max(abs(np.cos(a)), abs(np.sin(a))),
                              0.95 * np.sin(a) / max(abs(np.cos(a)), abs(np.sin(a)))), 0.25), 0.9, taper=0)
        for a in np.linspace(0, 2 * np.pi, 44, endpoint=False)
    ]  # fmt: skip
    canvas.stroke(pearls, "white", relief=25)
