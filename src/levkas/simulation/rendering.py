"""Rendering: the scene integrated over each sensel's footprint and blurred by the optics.

A sensel's value is the integral over the panel of texture times (box of one pixel ∗ Gaussian of the
optics), taken by quadrature on sub-pixels through the exact map. Pixel centres are integers: the
sub-pixels of pixel i lie symmetrically about i.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, erf, sqrt

import numpy as np

from levkas.core.compiled import njit
from levkas.core.threads import in_threads
from levkas.simulation.optics import Viewpoint, base_to_panel
from levkas.simulation.painting import Panel

PAD = 12
ROWS = 32


@dataclass(frozen=True, eq=False)
class Texture:
    """One band's picture on the board.

    Parameters
    ----------
    values : ndarray, (rows, columns), float32
        Sampled over the board from its corner (−width/2, −height/2); interpolated linearly.
    """

    values: np.ndarray
    px_per_mm: float


@dataclass(frozen=True, eq=False)
class RayLattice:
    """The panel points that a camera's base pixels see, tabulated once for all its bands.

    Parameters
    ----------
    points : ndarray, (height + 2 PAD + 1, width + 2 PAD + 1, 2), float32
        (s, t) in mm at integer base pixels, the first at (−PAD, −PAD).
    """

    points: np.ndarray
    view: Viewpoint
    panel: Panel


def tabulate(view: Viewpoint, panel: Panel) -> RayLattice:
    """Return the lattice of a view.

    Linear interpolation between its nodes is exact to 1e-4 px where the relief is smooth.
    Pixels displaced by more than `PAD` from the base frame are looked up at its rim.
    """
    xs = np.arange(-PAD, view.width + PAD + 1.0)
    points = np.empty((view.height + 2 * PAD + 1, len(xs), 2), np.float32)
    for top in range(0, len(points), 256):
        ys = np.arange(top, min(top + 256, len(points))) - float(PAD)
        block = np.stack(np.meshgrid(xs, ys), -1).reshape(-1, 2)
        points[top : top + 256] = base_to_panel(block, view, panel).reshape(len(ys), len(xs), 2)
    return RayLattice(points, view, panel)


def footprint(supersampling: int, blur: float) -> np.ndarray:
    """Return the weights of sub-pixels: the box of one pixel blurred by a Gaussian.

    Parameters
    ----------
    supersampling : int
        Sub-pixels a pixel.
    blur : float
        Standard deviation of the optics, px.

    Returns
    -------
    weights : ndarray, (supersampling + 2 m,), float32
        Symmetric, of sum 1.

    Examples
    --------
    >>> footprint(2, 0.0)
    array([0.5, 0.5], dtype=float32)
    """
    m = ceil(3.5 * blur * supersampling)
    x = (np.arange(supersampling + 2 * m) - (supersampling + 2 * m - 1) / 2) / supersampling
    if blur > 0:
        edge = [(erf((v + 0.5) / blur / sqrt(2)) - erf((v - 0.5) / blur / sqrt(2))) for v in x]
    else:
        edge = [float(abs(v) < 0.5) for v in x]
    return (np.array(edge) / np.sum(edge)).astype(np.float32)


def render(
    texture: Texture,
    lattice: RayLattice,
    matrix: np.ndarray,
    bow: float = 0.0,
    *,
    surroundings: float = 0.0,
    blur: float = 0.45,
    supersampling: int = 3,
) -> np.ndarray:
    """Return what each sensel of one band integrates.

    Parameters
    ----------
    matrix, bow : ndarray (2, 3), float
        Native pixels of the band → base pixels, as `optics.band_to_base` returns them.
    surroundings : float
        Value beside the board.
    blur : float
        Standard deviation of the optics, native px.
    supersampling : int
        Sub-pixels a pixel and axis.

    Returns
    -------
    image : ndarray, (height, width), float32
        In the unit of the texture.
    """
    view, panel = lattice.view, lattice.panel
    numbers = np.array(
        [
            *np.asarray(matrix, float).ravel(),
            bow,
            view.centre[0],
            view.spread,
            panel.width_mm / 2,
            panel.height_mm / 2,
            texture.px_per_mm,
            (lattice.points.shape[0] - view.height - 1) // 2,
        ]
    )
    image = np.empty((view.height, view.width), np.float32)
    weights = footprint(supersampling, blur)
    in_threads(
        _render,
        -(-view.height // ROWS),
        np.ascontiguousarray(texture.values, np.float32),
        lattice.points,
        numbers,
        np.float32(surroundings),
        (weights, supersampling),
        image,
    )
    return image


@njit
def _look_up(
    x: float,
    y: float,
    texture: np.ndarray,
    lattice: np.ndarray,
    c: np.ndarray,
    surroundings: np.float32,
) -> np.float32:
    """Return the scene at one point of a band's image."""
    bx = c[0] * x + c[1] * y + c[2]
    off = (bx - c[7]) / c[8]
    by = c[3] * x + c[4] * y + c[5] - c[6] * off * off
    gx = min(max(bx + c[12], 0.0), lattice.shape[1] - 1.001)
    gy = min(max(by + c[12], 0.0), lattice.shape[0] - 1.001)
    i, j = int(gy), int(gx)
    fy, fx = np.float32(gy - i), np.float32(gx - j)
    one = np.float32(1.0)
    a, b = (one - fx) * (one - fy), fx * (one - fy)
    d, e = (one - fx) * fy, fx * fy
    p, q, r, w = lattice[i, j], lattice[i, j + 1], lattice[i + 1, j], lattice[i + 1, j + 1]
    s = a * p[0] + b * q[0] + d * r[0] + e * w[0]
    t = a * p[1] + b * q[1] + d * r[1] + e * w[1]
    if not (abs(s) <= c[9] and abs(t) <= c[10]):
        return surroundings
    u = min(max((s + c[9]) * c[11] - 0.5, 0.0), texture.shape[1] - 1.001)
    v = min(max((t + c[10]) * c[11] - 0.5, 0.0), texture.shape[0] - 1.001)
    k, m = int(v), int(u)
    fv, fu = np.float32(v - k), np.float32(u - m)
    top = texture[k, m] + fu * (texture[k, m + 1] - texture[k, m])
    low = texture[k + 1, m] + fu * (texture[k + 1, m + 1] - texture[k + 1, m])
    return top + fv * (low - top)


@njit(cache=True)
def _render(
    start: int,
    stop: int,
    texture: np.ndarray,
    lattice: np.ndarray,
    c: np.ndarray,
    surroundings: np.float32,
    sampling: tuple[np.ndarray, int],
    image: np.ndarray,
) -> None:
    weights, n = sampling
    height, width = image.shape
    taps = len(weights)
    margin = (taps - n) // 2
    for first in range(start * ROWS, stop * ROWS, ROWS):
        rows = min(ROWS, height - first)
        # Rows of sub-pixels are brought to the sampling of columns at once, so that a block stays
        # in the processor's cache whatever the size of the image.
        narrow = np.empty((rows * n + 2 * margin, width), np.float32)
        line = np.empty(width * n + 2 * margin, np.float32)
        for k in range(narrow.shape[0]):
            y = first + (k - margin + 0.5) / n - 0.5
            for j in range(line.shape[0]):
                x = (j - margin + 0.5) / n - 0.5
                line[j] = _look_up(x, y, texture, lattice, c, surroundings)
            for j in range(width):
                total = np.float32(0.0)
                for q in range(taps):
                    total += weights[q] * line[j * n + q]
                narrow[k, j] = total
        for i in range(rows):
            for j in range(width):
                total = np.float32(0.0)
                for q in range(taps):
                    total += weights[q] * narrow[i * n + q, j]
                image[first + i, j] = total
