"""A simulated icon from a seed: gilded ground, saints, inscriptions, border, ageing."""

from __future__ import annotations

from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from levkas.simulation.figures import (
    Saint,
    fan,
    lay_garment,
    paint_folds,
    paint_halo,
    paint_hand,
    paint_head,
)
from levkas.simulation.painting import Canvas, Painting, brush, curve, ellipse, multiply

if TYPE_CHECKING:
    from levkas.simulation.figures import Saint
    from levkas.simulation.painting import Canvas, Panel

Garment = tuple[str, str, str]
Pair = tuple[Garment, Garment]

BLUES = ("azurite", "azurite light", "azurite dark")
REDS = ("madder", "pink", "madder dark")
GREENS = ("malachite", "malachite light", "green earth")
OCHRES = ("ochre", "ochre light", "umber")
VIOLETS = ("smalt", "azurite light", "indigo")
SCARLETS = ("vermilion", "red lead", "madder dark")
PAIRS = (
    (BLUES, REDS),
    (SCARLETS, GREENS),
    (OCHRES, VIOLETS),
    (GREENS, SCARLETS),
    (VIOLETS, OCHRES),
    (REDS, BLUES),
)


def paint_icon(
    panel: Panel,
    px_per_mm: float,
    rng: np.random.Generator,
    *,
    saints: int = 1,
) -> Painting:
    """Paint an icon on a panel that lies on its side.

    Parameters
    ----------
    px_per_mm : float
        Fineness; shapes and grain are the same at any.
    rng : Generator
        Colours, brushwork, craquelure: another one paints another icon.
    saints : int
        1: half-length, with a book. 2 or 3: standing side by side.

    Returns
    -------
    painting : Painting
    """
    canvas = Canvas(panel.height_mm, panel.width_mm, px_per_mm, rng)
    inset = panel.border_mm
    _paint_ground(canvas, inset)
    pairs = [PAIRS[i] for i in rng.permutation(len(PAIRS))]
    if saints == 1:
        _paint_half_length(canvas, inset, pairs[0])
    else:
        _paint_standing(canvas, inset, pairs, saints)
    paint_border(canvas, inset)
    age(canvas, field=rectangle(canvas, inset))
    return canvas.finish(panel)


def _paint_ground(canvas: Canvas, inset: float) -> None:
    """Lay gesso, ochre on the border, gold on bole in the field, with marks of the leaves."""
    every = np.full(canvas.shape, 255, np.uint8)
    canvas.lay(every, "ochre")
    canvas.vary(every, "ochre light", canvas.grain((9.0, 40.0)), above=0.4, most=0.5)
    canvas.vary(every, "umber", canvas.grain((4.0, 22.0)), above=0.9, most=0.55)
    canvas.vary(every, "red ochre", canvas.grain((0.8, 5.0), octaves=3), above=1.0, most=0.4)
    field = canvas.area(rectangle(canvas, inset))
    canvas.lay(field, "red ochre")
    canvas.lay(field, "gold", 0.97)
    canvas.vary(field, "red ochre", canvas.grain(16.0, octaves=6), above=1.1, most=0.7)
    canvas.vary(field, "umber", canvas.grain((0.8, 2.4), octaves=3), above=1.3, most=0.35)
    canvas.vary(field, "ochre light", canvas.grain(3.0, octaves=5), above=1.2, most=0.4)
    rng = canvas.rng.spawn(1)[0]
    scratches = [
        brush(start + np.outer([0, 0.5, 1], turn * long), 0.18)
        for start, turn, long in zip(
            rng.uniform(0, (canvas.width, canvas.height), (260, 2)),
            rng.normal(0, 1, (260, 2)),
            rng.exponential(7.0, 260),
            strict=True,
        )
    ]
    canvas.stroke(scratches, "red ochre", 0.6, within=field, relief=-8)
    leaf = 78.0
    seams = [
        brush(np.array([(x + rng.normal(0, 0.8), 0), (x + rng.normal(0, 0.8), canvas.height)]), 0.7)
        for x in np.arange(inset + 0.4 * leaf, canvas.width - inset, leaf)
    ] + [
        brush(np.array([(0, y + rng.normal(0, 0.8)), (canvas.width, y + rng.normal(0, 0.8))]), 0.7)
        for y in np.arange(inset + 0.6 * leaf, canvas.height - inset, leaf)
    ]
    canvas.stroke(seams, "ochre", 0.5, within=field, relief=2)


def _paint_half_length(canvas: Canvas, inset: float, pair: Pair) -> None:
    w, bottom = canvas.width, canvas.height - inset
    size = 0.082 * w
    saint = Saint(
        0.5 * w, inset + 0.30 * (bottom - inset), size, *pair,
        beard=float(canvas.rng.uniform(0.6, 1.2)), hair=("umber", "umber light"),
    )  # fmt: skip
    low = (bottom - saint.y) / size
    shoulders = saint.at(
        curve(
            [(-0.9, 1.35), (-2.4, 2.0), (-3.6, 3.2), (-4.1, low), (4.1, low), (3.6, 3.2),
             (2.4, 2.0), (0.9, 1.35), (0, 1.75)], closed=True,
        )
    )  # fmt: skip
    field = canvas.area(rectangle(canvas, inset + 1))
    paint_halo(canvas, saint)
    robe = lay_garment(canvas, shoulders, saint.robe, field)
    paint_folds(
        canvas, robe, saint.robe,
        [
            fan((saint.x, saint.y + 1.9 * size), (1.5 * size, 0),
                [tuple(saint.at(np.array([x, low]))) for x in np.linspace(-1.6, 1.6, 7)],
                bulge=0.04, gap=4.0, rng=canvas.rng),
        ],
    )  # fmt: skip
    for side in (-1, 1):
        outline = curve(
            [(side * x, y) for x, y in
             [(0.75, 1.3), (2.4, 2.0), (3.65, 3.2), (4.2, low), (1.7, low), (1.2, 3.9), (1.05, 2.6)]],
            closed=True,
        )  # fmt: skip
        mantle = lay_garment(canvas, saint.at(outline), saint.mantle, field)
        ends = [
            (side * x, y)
            for x, y in zip(np.linspace(1.6, 4.0, 9), np.linspace(low, 3.4, 9), strict=True)
        ]
        paint_folds(
            canvas, mantle, saint.mantle,
            [
                fan(tuple(saint.at(np.array([[side * 1.3, 1.75]]))[0]), (side * 1.4 * size, 0.5 * size),
                    [tuple(saint.at(np.array(e))) for e in ends], bulge=0.06 * side, gap=3.6 * side, rng=canvas.rng),
            ],
        )  # fmt: skip
        _paint_assist(canvas, mantle, saint, side)
    paint_head(canvas, saint)
    paint_book(canvas, saint, low)
    paint_hand(canvas, saint.at(np.array([-1.75, 3.55])), size)
    for x, text in ((-3.75, 4), (2.55, 4)):
        inscribe(canvas, tuple(saint.at(np.array([x, -0.7]))), 0.42 * size, text, rows=2)


def _paint_standing(canvas: Canvas, inset: float, pairs: list[Pair], count: int) -> None:
    inner, bottom = canvas.width - 2 * inset, canvas.height - inset
    size = min(0.13 * inner / count, 0.062 * inner)
    field = canvas.area(rectangle(canvas, inset + 1))
    ground = np.array(
        [(0, bottom - 26), (canvas.width, bottom - 26), (canvas.width, bottom + 9), (0, bottom + 9)]
    )
    earth = multiply(canvas.area(ground), field)
    canvas.lay(earth, "green earth")
    canvas.vary(earth, "malachite light", canvas.grain((8.0, 3.0)), above=0.4, most=0.6)
    for k in range(count):
        robe, mantle = pairs[k % len(pairs)]
        saint = Saint(
            inset + inner * (k + 0.5) / count,
            inset + 0.2 * (bottom - inset) + (6 if k % 2 else 0),
            size, robe, mantle,
            beard=(0.9, 0.0, 0.4)[k % 3], hood=k % 3 == 1,
            hair=(("umber", "umber light"), ("umber", "ochre"), ("black", "umber"))[k % 3],
        )  # fmt: skip
        paint_halo(canvas, saint)
        low = (bottom - 12 - saint.y) / size
        body = curve(
            [(-0.9, 1.3), (-1.9, 1.9), (-2.2, 4.5), (-1.95, low), (0, low + 0.25), (1.95, low),
             (2.2, 4.5), (1.9, 1.9), (0.9, 1.3), (0, 1.6)], closed=True,
        )  # fmt: skip
        dress = lay_garment(canvas, saint.at(body), robe, field)
        ends = [tuple(saint.at(np.array([x, low + 0.2]))) for x in np.linspace(-1.8, 1.8, 8)]
        paint_folds(
            canvas, dress, robe,
            [fan(tuple(saint.at(np.array([0.0, 2.6]))), (2.4 * size, 0), ends, bulge=0.02, gap=2.4, rng=canvas.rng)],
            scale=0.7,
        )  # fmt: skip
        drape = curve(
            [(-0.8, 1.3), (-2.0, 1.9), (-2.5, 4.0), (-2.3, 0.62 * low), (-0.9, 0.75 * low),
             (0.9, 0.55 * low), (2.3, 0.42 * low), (2.0, 3.0), (0.6, 3.6), (-0.5, 2.6)], closed=True,
        )  # fmt: skip
        cloak = lay_garment(canvas, saint.at(drape), mantle, field)
        sweep = [tuple(saint.at(np.array(p))) for p in
                 zip(np.linspace(-2.2, 2.2, 10), np.linspace(0.7, 0.42, 10) * low, strict=True)]  # fmt: skip
        paint_folds(
            canvas, cloak, mantle,
            [fan(tuple(saint.at(np.array([-1.5, 2.0]))), (1.0 * size, 0.7 * size), sweep,
                 bulge=0.08, gap=2.4, rng=canvas.rng)],
            scale=0.7,
        )  # fmt: skip
        paint_head(canvas, saint)
        paint_hand(canvas, saint.at(np.array([0.9, 3.3])), 0.9 * size)
        inscribe(canvas, (saint.x - 1.6 * size, inset + 14), 0.5 * size, 6, rows=1)
    inscribe(canvas, (inset + 20, bottom - 8), 3.2, 22, rows=1, paint="white")


def _paint_assist(canvas: Canvas, mantle: np.ndarray, saint: Saint, side: int) -> None:
    """Lay the fine gold lines that show divine light on a garment."""
    rng = canvas.rng.spawn(1)[0]
    lines = []
    for _ in range(26):
        x, y = side * rng.uniform(1.4, 3.6), rng.uniform(2.4, 5.6)
        for k in range(5):
            a = np.array([x, y]) + k * np.array([0.05 * side, 0.07])
            lines.append(saint.line([tuple(a), (a[0] + 0.2 * side, a[1] + 0.12),
                                     (a[0] + 0.42 * side, a[1] + 0.34)], 0.4, 0.9))  # fmt: skip
    canvas.stroke(lines, "gold", 0.95, within=mantle, relief=10)


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


CELL_MM = (7.0, 4.6)


def age(canvas: Canvas, *, field: np.ndarray) -> None:
    """Let a finished painting age.

    Parameters
    ----------
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
