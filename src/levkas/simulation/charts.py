"""A simulated colour chart: a ColorChecker Classic on its board."""

from __future__ import annotations

import numpy as np

from levkas.quality.targets.charts import CHARTS, reference_of
from levkas.simulation.painting import Painting, Panel
from levkas.simulation.pigments import WAVELENGTHS

COLUMNS, ROWS = 6, 4
PITCH_MM, PATCH_MM = 43.0, 40.0
BOARD_MM = (289.0, 204.0)
FRAME_REFLECTANCE = 0.035


def chart_panel() -> Panel:
    """Return the board: flat, 289 x 204 mm."""
    return Panel(width_mm=BOARD_MM[0], height_mm=BOARD_MM[1], border_mm=0.0)


def patch_centres() -> np.ndarray:
    """Return the middles of the patches on the board, (24, 2) = (s, t) mm, row by row."""
    s = (np.arange(COLUMNS) - (COLUMNS - 1) / 2) * PITCH_MM
    t = (np.arange(ROWS) - (ROWS - 1) / 2) * PITCH_MM
    return np.stack(np.meshgrid(s, t), -1).reshape(-1, 2)


def patch_spectra() -> np.ndarray:
    """Return the reflectance of the 24 patches at `pigments.WAVELENGTHS`, (24, n).

    Notes
    -----
    BabelColor's average of 30 charts, 380–730 nm. Beyond 730 nm the last value is held: nobody has published the
    charts there.
    """
    published = reference_of(CHARTS["ColorChecker24"])
    assert published is not None, "spectra of the Classic are in the package"
    return np.stack([np.interp(WAVELENGTHS, published.wavelengths, s) for s in published.spectra])


def paint_chart(px_per_mm: float) -> Painting:
    """Return a ColorChecker Classic on its board, matte."""
    columns, rows = (round(n * px_per_mm) for n in BOARD_MM)
    s = (np.arange(columns) + 0.5) / px_per_mm - BOARD_MM[0] / 2
    t = (np.arange(rows) + 0.5) / px_per_mm - BOARD_MM[1] / 2
    amounts = np.zeros((rows, columns, 25), np.uint8)
    amounts[..., 24] = 255
    for k, (x, y) in enumerate(patch_centres()):
        across = np.clip((PATCH_MM / 2 - np.abs(s - x)) * px_per_mm + 0.5, 0, 1)
        down = np.clip((PATCH_MM / 2 - np.abs(t - y)) * px_per_mm + 0.5, 0, 1)
        share = np.round(255 * np.outer(down, across)).astype(np.uint8)
        amounts[..., k] = share
        amounts[..., 24] -= share
    frame = np.full((1, len(WAVELENGTHS)), FRAME_REFLECTANCE)
    return Painting(
        amounts,
        np.vstack([patch_spectra(), frame]),
        np.zeros(25, bool),
        np.zeros((rows, columns), np.uint8),
        np.zeros((rows, columns), np.float32),
        px_per_mm,
        gloss=0.0,
    )
