"""A small painted icon to look at under planned light: gold halo, dark robe, garment, hatching."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from levkas.planning.tables import ObjectKeys


@dataclass(frozen=True, eq=False)
class Motif:
    """Maps over an object, (rows, columns), the first row at its top.

    Parameters
    ----------
    colour : ndarray, (rows, columns, 3)
        sRGB, 0 to 1.
    gold : ndarray
        Share of leaf, 0 to 1.
    height : ndarray
        mm above the bent board, recess included.
    details : dict
        Name of a close-up → (x, y) of its middle and its side, mm.
    """

    colour: np.ndarray
    gold: np.ndarray
    height: np.ndarray
    details: dict[str, tuple[float, float, float]]


def draw_motif(thing: ObjectKeys, *, rng: np.random.Generator, px_per_mm: float = 1.6) -> Motif:
    """Return the motif, drawn to an object's size; relief has the object's rms slope."""
    width, height = thing.size_mm
    columns, rows = round(width * px_per_mm) | 1, round(height * px_per_mm) | 1
    # Centimetres of an icon of 32 cm: the drawing scales with the shorter side.
    unit = min(width, height) / 320
    x = np.linspace(-width / 2, width / 2, columns)[None] / unit
    y = np.linspace(-height / 2, height / 2, rows)[:, None] / unit
    # The icon lies on its side: its top is at the left.
    u, v = y, x
    colour = np.empty((rows, columns, 3))
    colour[:] = (0.72, 0.58, 0.36)
    gold = np.zeros((rows, columns))
    inner = (np.abs(x * unit) < width / 2 - thing.border_mm) & (
        np.abs(y * unit) < height / 2 - thing.border_mm
    )
    colour[inner] = (0.80, 0.70, 0.48)
    robe = (np.abs(u) < 40 + 0.42 * (v + 60)) & (v > -20)
    garment = robe & (u > 4 - 0.10 * v)
    colour[robe] = (0.20, 0.13, 0.10)
    colour[garment] = (0.55, 0.14, 0.10)
    halo = np.hypot(u, v + 62) < 62
    gold[halo & inner] = 1.0
    face = np.hypot(u / 0.78, v + 58) < 34
    gold[face] = 0.0
    colour[face] = (0.62, 0.44, 0.28)
    folds = garment & (np.abs(np.mod(u * 0.9 + 0.55 * v + 6 * np.sin(v / 17), 34) - 17) < 3)
    colour[folds] = (0.80, 0.38, 0.28)
    hatch = robe & ~garment & (np.mod(u + 0.9 * v, 9) < 1.3) & (v > 15) & (v < 96)
    gold[hatch & inner] = 1.0
    gold = gold * inner
    relief = _relief(rows, columns, px_per_mm, rng) * np.where(gold > 0, 0.5, 1.0)
    slope = np.sqrt(np.mean(np.square(np.gradient(relief, 1 / px_per_mm))))
    relief *= thing.relief_slope / slope if thing.relief_slope else 0.0
    edge = np.minimum(width / 2 - np.abs(x * unit), height / 2 - np.abs(y * unit))
    sunk = np.clip((edge - thing.border_mm) / thing.bevel_mm, 0, 1) * thing.recess_mm
    places = {
        "gold": (-95.0, 38.0), "varnish": (128.0, -32.0), "garment": (60.0, 45.0),
        "hatching": (50.0, -20.0),
    }  # fmt: skip
    details = {k: (a * unit, b * unit, 62.0 * unit) for k, (a, b) in places.items()}
    return Motif(np.clip(colour, 0, 1), gold, relief - sunk, details)


def _relief(rows: int, columns: int, px_per_mm: float, rng: np.random.Generator) -> np.ndarray:
    """Brush strokes, long in one direction, and a net of cracks."""
    noise = rng.standard_normal((rows, columns))
    fx = np.fft.rfftfreq(columns)[None] * px_per_mm
    fy = np.fft.fftfreq(rows)[:, None] * px_per_mm
    strokes = np.exp(-((fx / 0.16) ** 2) - ((fy / 0.45) ** 2)) * (np.hypot(fx, fy) > 0.02)
    brush = np.fft.irfft2(np.fft.rfft2(noise) * strokes, (rows, columns))
    seeds = rng.uniform(0, 1, (260, 2)) * [rows, columns]
    from scipy.spatial import cKDTree

    grid = np.stack(np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij"), -1)
    near, _ = cKDTree(seeds).query(grid.reshape(-1, 2), k=2)
    crack = ((near[:, 1] - near[:, 0]) < 1.6).reshape(rows, columns)
    return brush / brush.std() - 2.0 * crack
