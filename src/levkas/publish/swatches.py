"""CIELAB gamut of a database in the three views of the paper's Figure 12.

Of the reference camera's layers, where its bands are narrow and cover what the eye sees.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

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
SIZE = 1100, 620
"""Of the picture, px."""


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
    """Draw three views: filled cells in their own colour, `others` as black dots.

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
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    from levkas.pages.plots import new_figure

    figure = new_figure(*SIZE)
    canvas = FigureCanvasAgg(figure)
    panels = figure.subplot_mosaic("AB;AC")
    colours = lab_colours(cells[:, :3])
    for axes, (across, up, x, y) in zip(panels.values(), VIEWS.values(), strict=True):
        order = np.argsort(cells[:, 3 - x - y], kind="stable")  # what lies nearer is drawn last
        shades = colours[order] / 255
        axes.scatter(cells[order, x], cells[order, y], 5, shades, marker="s", linewidths=0)
        axes.scatter(others[:, x], others[:, y], 0.4, "black")
        axes.set(xlabel=across, ylabel=up, aspect="equal")
        axes.grid(alpha=0.4)
    canvas.draw()
    return np.array(canvas.buffer_rgba())[..., :3].copy()


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
