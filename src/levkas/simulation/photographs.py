"""Paintings made from photographs, and charts: colours matched by mixtures of paints."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.problems import Problem, Refused
from levkas.quality.targets.charts import CHARTS, reference_of
from levkas.simulation.icon import age
from levkas.simulation.painting import Canvas, Painting, Panel
from levkas.simulation.pigments import WAVELENGTHS, paint_spectra

if TYPE_CHECKING:
    from levkas.simulation.painting import Panel

LEVELS = 32


class PhotographRefused(Refused):
    """A photograph that cannot be read."""


def paint_photograph(
    panel: Panel,
    px_per_mm: float,
    rng: np.random.Generator,
    *,
    photograph: Path | str,
    library: Path | str | None = None,
) -> Painting:
    """Paint a photograph on a panel: its colours in paints, its age and underdrawing its own.

    Parameters
    ----------
    panel : Panel
    px_per_mm : float
    rng : Generator
    photograph : path
        An RGB image, sRGB; cropped to the panel, turned if it lies.
    library : path, optional
        Spectral library for the pigments.

    Raises
    ------
    PhotographRefused
        Where the file cannot be read.
    """
    canvas = Canvas(panel.height_mm, panel.width_mm, px_per_mm, rng)
    image = _fitted(_read(Path(photograph)), canvas.shape)
    # Below the photograph's own sampling the brush goes on: colours waver by a step or so.
    image += 0.02 * canvas.grain((0.8, 2.5), octaves=3)[..., None]
    codes = np.clip(image * LEVELS, 0, LEVELS - 1).astype(np.uint16)
    index = (codes[..., 0] * LEVELS + codes[..., 1]) * LEVELS + codes[..., 2]
    used, inverse = np.unique(index, return_inverse=True)
    spectra = paint_spectra(canvas.paints, WAVELENGTHS, library=library)
    canvas.amounts[:] = _mixtures(used, spectra)[inverse.reshape(index.shape)]
    edges = np.abs(np.diff(image.mean(2), axis=0, prepend=0.0))
    canvas.underdrawing[:] = np.clip(edges * 1500, 0, 160).astype(np.uint8)
    canvas.relief += canvas.grain((0.8, 2.5), octaves=4) * np.float32(5)
    b = panel.border_mm
    w, h = canvas.width - b, canvas.height - b
    age(canvas, field=np.array([(b, b), (w, b), (w, h), (b, h)]))
    return canvas.finish(panel, library=library)


def _read(path: Path) -> np.ndarray:
    from PIL import Image, UnidentifiedImageError

    try:
        with Image.open(path) as opened:
            return np.asarray(opened.convert("RGB"), np.float32) / 255
    except (OSError, UnidentifiedImageError) as error:
        raise PhotographRefused(
            Problem("E_UNREADABLE", f"the photograph cannot be read: {error}", file=str(path))
        ) from error


def _fitted(image: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    import cv2

    if (image.shape[0] < image.shape[1]) != (shape[0] < shape[1]):
        image = np.rot90(image)
    scale = max(shape[0] / image.shape[0], shape[1] / image.shape[1])
    rows, columns = (
        min(n, int(np.ceil(s / scale))) for n, s in zip(image.shape, shape, strict=False)
    )
    top, left = (image.shape[0] - rows) // 2, (image.shape[1] - columns) // 2
    part = np.ascontiguousarray(image[top : top + rows, left : left + columns])
    return cv2.resize(part, shape[::-1], interpolation=cv2.INTER_CUBIC)


def _mixtures(codes: np.ndarray, spectra: np.ndarray) -> np.ndarray:
    """Return the amounts, uint8 (codes, paints), whose colour is nearest to each code's."""
    from scipy.optimize import nnls

    from levkas.simulation.cameras import camera_models

    responses = np.stack([band.response for band in camera_models()["d80"].bands])
    paints = responses @ spectra.T
    system = np.vstack([paints, np.full(paints.shape[1], 0.5)])
    amounts = np.zeros((len(codes), paints.shape[1]), np.uint8)
    for row, code in zip(amounts, codes.tolist(), strict=True):
        rgb = np.array([code // LEVELS**2, code // LEVELS % LEVELS, code % LEVELS])
        linear = ((rgb + 0.5) / LEVELS) ** 2.2
        share = nnls(system, np.append(linear, 0.5))[0]
        whole = np.floor(share / max(share.sum(), 1e-9) * 255).astype(np.uint8)
        row[:] = whole
        row[share.argmax()] += 255 - int(whole.sum())
    return amounts


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
