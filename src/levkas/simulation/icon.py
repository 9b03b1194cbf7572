"""An icon, painted anew from a seed: gilded field, saints, inscriptions, border, and its age."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.simulation.ageing import age
from levkas.simulation.figures import (
    Saint,
    paint_halo,
    paint_hand,
    paint_head,
)
from levkas.simulation.garments import fan, lay_garment, paint_folds
from levkas.simulation.ornaments import inscribe, paint_book, paint_border, rectangle
from levkas.simulation.painting import Canvas, Painting, multiply
from levkas.simulation.strokes import brush, curve

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.simulation.panel import Panel

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
    library: Path | str | None = None,
) -> Painting:
    """Paint an icon on a panel that lies on its side.

    Parameters
    ----------
    panel : Panel
    px_per_mm : float
        Fineness; shapes and grain are the same at any.
    rng : Generator
        Colours, brushwork, craquelure: another one paints another icon.
    saints : int
        1: half-length, with a book. 2 or 3: standing side by side.
    library : path, optional
        Spectral library for the pigments, as in `pigments.paint_spectra`.

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
    return canvas.finish(panel, library=library)


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
    """Lay the fine gold lines that stand for divine light on a garment."""
    rng = canvas.rng.spawn(1)[0]
    lines = []
    for _ in range(26):
        x, y = side * rng.uniform(1.4, 3.6), rng.uniform(2.4, 5.6)
        for k in range(5):
            a = np.array([x, y]) + k * np.array([0.05 * side, 0.07])
            lines.append(saint.line([tuple(a), (a[0] + 0.2 * side, a[1] + 0.12),
                                     (a[0] + 0.42 * side, a[1] + 0.34)], 0.4, 0.9))  # fmt: skip
    canvas.stroke(lines, "gold", 0.95, within=mantle, relief=10)
