"""What time does to an icon: craquelure, losses down to the gesso, wear, soot."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.simulation.strokes import brush

if TYPE_CHECKING:
    from levkas.simulation.painting import Canvas

CELL_MM = (7.0, 4.6)


def age(canvas: Canvas, *, field: np.ndarray) -> None:
    """Let a finished painting age.

    Parameters
    ----------
    canvas : Canvas
    field : ndarray, (n, 2), mm
        Outline of the lowered centre; the border around it wears faster.
    """
    every = np.full(canvas.shape, 255, np.uint8)
    border = every - canvas.area(field)
    # Soot and dirt are dark, losses bright, in every band: what all the bands have in common.
    canvas.vary(every, "umber", canvas.grain(60.0, octaves=3), above=0.4, most=0.25)
    canvas.vary(every, "black", canvas.grain((9.0, 13.0), octaves=6), above=0.9, most=0.45)
    canvas.vary(every, "black", canvas.grain(2.4, octaves=3), above=1.5, most=0.5)
    canvas.vary(border, "gesso", canvas.grain((7.0, 12.0), octaves=6), above=2.0, most=0.95)
    canvas.vary(every, "gesso", canvas.grain((5.0, 8.0), octaves=6), above=2.5, most=0.9)
    canvas.vary(border, "wood", canvas.grain((5.0, 9.0), octaves=5), above=2.6, most=0.9)
    cracks = crack_lines(canvas.width, canvas.height, canvas.rng.spawn(1)[0])
    canvas.stroke(cracks, "black", 0.75, relief=-30)
    canvas.relief += canvas.grain((1.0, 3.0), octaves=3) * np.float32(4)


def crack_lines(width: float, height: float, rng: np.random.Generator) -> list[np.ndarray]:
    """Return a net of cracks: ragged edges of cells that are longer along the grain of the wood.

    Returns
    -------
    strokes : list of ndarray, (5, 3)
        x, y and half the width, mm: a tenth to a third of a millimetre wide.
    """
    from scipy.spatial import Voronoi

    step = np.array(CELL_MM)
    columns, rows = (int(np.ceil(n / s)) + 2 for n, s in zip((width, height), step, strict=True))
    nodes = np.stack(np.meshgrid(np.arange(columns), np.arange(rows)), -1).reshape(-1, 2) - 0.5
    cells = Voronoi((nodes + rng.uniform(-0.48, 0.48, nodes.shape)) * step)
    pairs = np.array([r for r in cells.ridge_vertices if -1 not in r])
    pairs = pairs[rng.random(len(pairs)) < 0.72]
    a, b = cells.vertices[pairs[:, 0]], cells.vertices[pairs[:, 1]]
    long = np.hypot(*(b - a).T)
    keep = (long > 0.3) & (long < 15)
    a, b, long = a[keep], b[keep], long[keep]
    across = np.stack([a[:, 1] - b[:, 1], b[:, 0] - a[:, 0]], 1) / long[:, None]
    ragged = rng.normal(0, 0.07, (len(a), 5)) * long[:, None]
    ragged[:, [0, 4]] = 0
    wide = rng.uniform(0.10, 0.32, len(a))
    t = np.linspace(0, 1, 5)
    lines = a[:, None] + (b - a)[:, None] * t[:, None] + across[:, None] * ragged[..., None]
    return [brush(line, w, taper=0.3) for line, w in zip(lines, wide, strict=True)]
