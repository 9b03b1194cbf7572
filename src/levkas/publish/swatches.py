"""CIELAB gamut of a database in the three views of the paper's Figure 12.

Of the reference camera's layers, where its bands are narrow and cover what the eye sees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.colour.gamut import VIEWS, gamut_cells, lab_colours, lab_of, munsell_lab
from levkas.colour.srgb import LEAST_COVERAGE, visible_coverage
from levkas.core.cube import Flag, is_flagged
from levkas.database.preview import encode_png

if TYPE_CHECKING:
    from levkas.database.catalogue import Entry
    from levkas.publish.publication import Publication

ROWS = 128
"""Of a layer, looked at together."""
UNTRUE = Flag.OUTSIDE | Flag.SATURATED | Flag.GLARE
"""Pixels with one of these in any band show no colour of the painting."""
SCALE, MARGIN, TICK = 3, 46, 20
"""Px a ΔE unit, px around a view, units between ticks."""
LEAST = ((0, -80, -80), (100, 100, 120))
"""What the axes reach at least: L, a, b."""
PAPER, GRID, INK = (255, 255, 255), (225, 225, 225), (40, 40, 40)


def write_gamut(publication: Publication) -> Iterator[str]:
    """Write colour/gamut.csv and colour/gamut.png, where a layer shows true colours."""
    cells = np.zeros((0, 4))
    for entry in publication.entries():
        if _shows_colour(publication, entry):
            yield f"{entry.object}/{entry.camera}"
            cells = _joined(cells, _cells_of(publication, entry))
    if not len(cells):
        return
    yield "drawing"
    lines = "".join(f"{cell[0]:g},{cell[1]:g},{cell[2]:g},{int(cell[3])}\n" for cell in cells)
    publication.write_text("colour/gamut.csv", "L,a,b,pixels\n" + lines)
    picture = draw_gamut(cells, munsell_lab())
    text = (
        "CIELAB gamut under D65: a*b*, a*L*, b*L*; cells of 1 unit; black: Munsell's real colours"
    )
    publication.write_bytes("colour/gamut.png", encode_png(picture, description=text))


def draw_gamut(cells: np.ndarray, others: np.ndarray) -> np.ndarray:
    """Draw three views side by side: filled cells in their own colour, `others` as black dots.

    Parameters
    ----------
    cells : ndarray, (n, 4)
        As `levkas.colour.gamut.gamut_cells` gives them.
    others : ndarray, (m, 3)
        CIELAB.

    Returns
    -------
    picture : ndarray, (height, width, 3), uint8
    """
    colours = lab_colours(cells[:, :3])
    low, high = (_reach(np.floor, -1, cells, LEAST[0]), _reach(np.ceil, 1, cells, LEAST[1]))
    views = []
    for across, up, x, y in VIEWS.values():
        depth = 3 - x - y  # what lies nearer to the eye is drawn last
        order = np.argsort(cells[:, depth], kind="stable")
        spans = (low[x], high[x], low[y], high[y])
        within = np.all((others >= low) & (others <= high), axis=1)
        views.append(
            _view(cells[order], colours[order], others[within], (x, y), spans, (across, up))
        )
    return _side_by_side(views[0], _above(views[1], views[2]))


def _reach(turn: Callable[..., np.ndarray], side: int, cells: np.ndarray, least: Any) -> np.ndarray:
    """Return how far the axes reach on one side: whole ticks around the cells, and at least so far."""
    ends = cells[:, :3].max(0) if side > 0 else cells[:, :3].min(0)
    whole = turn(ends / TICK) * TICK
    return np.maximum(whole, least) if side > 0 else np.minimum(whole, least)


def _above(upper: np.ndarray, lower: np.ndarray) -> np.ndarray:
    width = max(upper.shape[1], lower.shape[1])
    return np.concatenate([_padded(v, v.shape[0], width) for v in (upper, lower)], axis=0)


def _side_by_side(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    height = max(left.shape[0], right.shape[0])
    return np.concatenate([_padded(v, height, v.shape[1]) for v in (left, right)], axis=1)


def _padded(view: np.ndarray, height: int, width: int) -> np.ndarray:
    more = ((0, height - view.shape[0]), (0, width - view.shape[1]), (0, 0))
    return np.pad(view, more, constant_values=255)


def _view(
    cells: np.ndarray,
    colours: np.ndarray,
    others: np.ndarray,
    columns: tuple[int, int],
    spans: tuple[float, float, float, float],
    names: tuple[str, str],
) -> np.ndarray:
    from PIL import Image, ImageDraw

    left, right, bottom, top = spans
    size = (int((right - left) * SCALE) + 2 * MARGIN, int((top - bottom) * SCALE) + 2 * MARGIN)
    image = Image.new("RGB", size, PAPER)
    pen = ImageDraw.Draw(image)

    def place(u: float, v: float) -> tuple[float, float]:
        return MARGIN + (u - left) * SCALE, size[1] - MARGIN - (v - bottom) * SCALE

    for u in np.arange(left, right + 1, TICK):
        pen.line([place(u, bottom), place(u, top)], GRID)
        pen.text((place(u, bottom)[0], size[1] - MARGIN + 6), f"{u:g}", INK, anchor="mt")
    for v in np.arange(bottom, top + 1, TICK):
        pen.line([place(left, v), place(right, v)], GRID)
        pen.text((MARGIN - 6, place(left, v)[1]), f"{v:g}", INK, anchor="rm")
    pen.text((size[0] / 2, size[1] - 12), names[0], INK, anchor="mm")
    pen.text((MARGIN, MARGIN - 16), names[1], INK, anchor="mm")
    canvas = np.array(image)
    half = SCALE // 2
    for dots, shades in ((cells, colours), (others, None)):
        x, y = (np.array(place(0, 0))[:, None] + SCALE * dots[:, columns].T * [[1], [-1]]).round()
        side = half if shades is not None else 0
        for dy in range(-side, side + 1):
            for dx in range(-side, side + 1):
                canvas[y.astype(int) + dy, x.astype(int) + dx] = 0 if shades is None else shades
    return canvas


def _shows_colour(publication: Publication, entry: Entry) -> bool:
    """Whether a layer is the reference camera's, in reflectance, and its bands cover the visible."""
    from levkas.database.described import open_tiff

    camera = publication.facts.reference.partition(":")[0]
    if entry.camera != camera or entry.setup or entry.quantity != "reflectance":
        return False
    bands = open_tiff(publication.folder / f"{entry.layer.path}.tif").bands
    wavelengths = np.array([band.wavelength for band in bands])
    known = len(bands) >= 3 and bool(np.isfinite(wavelengths).all())
    return known and visible_coverage(wavelengths) >= LEAST_COVERAGE


def _cells_of(publication: Publication, entry: Entry) -> np.ndarray:
    from levkas.database.described import describe_pages
    from levkas.database.tiff_pages import open_pages

    path = publication.folder / f"{entry.layer.path}.tif"
    values, flags = open_pages(path), path.with_name(f"{path.stem}.flags.tif")
    marks = open_pages(flags) if flags.is_file() else None
    wavelengths = [band.wavelength for band in describe_pages(values).bands]
    cells, bands = np.zeros((0, 4)), list(range(len(wavelengths)))
    for start in range(0, entry.height, ROWS):
        stop = min(start + ROWS, entry.height)
        lab = lab_of(values.read(start, stop, bands), wavelengths)
        if marks is not None:
            lab[is_flagged(marks.read(start, stop, bands), UNTRUE).any(-1)] = np.nan
        cells = _joined(cells, gamut_cells(lab))
    return cells


def _joined(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """Cells of both, their numbers added."""
    both = np.vstack([one, other])
    places, where = np.unique(both[:, :3], axis=0, return_inverse=True)
    counts = np.bincount(where.reshape(-1), both[:, 3], len(places))
    return np.column_stack([places, counts])
