"""Colour: spectra to XYZ under any light, to sRGB under D65, and honest pseudo-colour where a camera sees none.

With S the light and x̄ an observer function, X = Σ S x̄ R / Σ S ȳ over 1 nm (CIE 15); bands
are interpolated linearly, so that a whole rendering is one matrix from bands to linear sRGB.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from levkas.colour.illuminants import light_on_grid
from levkas.colour.observer import DATA, tables_by_nm

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.colour.illuminants import Light
    from levkas.core.cube import Band

SRGB_TO_XYZ = np.array(
    [[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]]
)
"""IEC 61966-2-1; its rows sum to the white of D65."""
FULL_COVERAGE, LEAST_COVERAGE = 0.99, 0.9
SPARSE_GAP_NM, WIDEST_GAP_NM = 25.0, 60.0
VISIBLE_CENTRES = {"red": (580, 690), "green": (510, 580), "blue": (420, 500)}
LETTERS = "RGB"
COUNTS_PERCENTILE = 99.5
REFLECTANCE_CORRELATION = 0.995
"""Of reflectances 1 nm apart: spectra of paint are smooth, and a camera's matrix may rely on it."""
WORST_COLOUR_SHARE = 0.25


def observer_under(light: Light = "D65") -> tuple[np.ndarray, np.ndarray]:
    """Return the CIE 1931 2° observer times a light.

    Returns
    -------
    wavelengths : ndarray, (401,), nm
        380 to 780 by 1.
    weights : ndarray, (401, 3)
        Columns X, Y, Z; Y sums to 1, and under D65 all three to the white of sRGB.

    Examples
    --------
    >>> observer_under("E")[1].sum(0).round(3).tolist()
    [1.0, 1.0, 1.0]
    """
    rows = tables_by_nm()
    weights = rows[:, 1:4] * light_on_grid(light)[:, None]
    if isinstance(light, str) and light.upper() == "D65":
        return rows[:, 0], weights / weights.sum(0) * SRGB_TO_XYZ.sum(1)
    return rows[:, 0], weights / weights[:, 1].sum()


def xyz_weights(wavelengths: Sequence[float] | np.ndarray, light: Light = "D65") -> np.ndarray:
    """Weigh narrow bands to XYZ under a light.

    Returns
    -------
    weights : ndarray, (bands, 3)
        ``XYZ = reflectance @ weights``. The spectrum is linear between bands, and constant
        beyond the first and the last; a perfect diffuser has Y = 1.

    Examples
    --------
    >>> xyz_weights([450, 550, 650]).sum(0).round(4).tolist()
    [0.9505, 1.0, 1.089]
    """
    centres = np.asarray(wavelengths, float)
    order = np.argsort(centres, kind="stable")
    grid, table = observer_under(light)
    weights = np.empty((len(centres), 3))
    for place, band in enumerate(order):
        hat = np.interp(grid, centres[order], np.eye(len(centres))[place])
        weights[band] = hat @ table
    return weights


def visible_coverage(wavelengths: Sequence[float] | np.ndarray) -> float:
    """Share of X, Y and Z, the least of the three, that lies between the first band and the last.

    Examples
    --------
    >>> round(visible_coverage([400, 700]), 2), round(visible_coverage([650, 1100]), 2)
    (1.0, 0.0)
    """
    grid, table = observer_under()
    inside = (grid >= np.min(wavelengths)) & (grid <= np.max(wavelengths))
    return float((table[inside].sum(0) / table.sum(0)).min())


def encode_srgb(linear: np.ndarray) -> np.ndarray:
    """Encode linear sRGB for display, uint8; NaN is black, what is out of range is clipped.

    Examples
    --------
    >>> encode_srgb(np.array([0.0, 0.18, 1.0, 2.0])).tolist()
    [0, 118, 255, 255]
    """
    x = np.clip(np.nan_to_num(np.asarray(linear, np.float32)), 0, 1)
    curve = np.where(x <= 0.0031308, 12.92 * x, 1.055 * x ** np.float32(1 / 2.4) - 0.055)
    return np.round(255 * curve).astype(np.uint8)


# --- renderings ---------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Rendering:
    """How a camera's bands become a picture.

    Parameters
    ----------
    matrix : ndarray, (bands, 3), float32
        To linear sRGB; 1.0 is display white.
    description : str
        What the picture shows, for captions: never claims more than is so.
    colour : bool
        Whether the colours are meant as an observer would see them.
    encoded : bool
        Whether the values are display values already, as in a plain photograph.
    """

    matrix: np.ndarray
    description: str
    colour: bool
    encoded: bool = False

    def __call__(self, values: np.ndarray, *, white: float = 1.0) -> np.ndarray:
        """Render (…, bands) as (…, 3) uint8, `white` shown as white."""
        used = np.flatnonzero(np.any(self.matrix != 0, axis=1))
        span = slice(used[0], used[-1] + 1)
        # einsum, unlike a matrix product, sums in one order for any number of threads.
        gains = np.ascontiguousarray(self.matrix[span].T / np.float32(white), np.float32)
        shown = np.asarray(values[..., span], np.float32)
        linear = np.stack([np.einsum("...b,b->...", shown, gain) for gain in gains], -1)
        if self.encoded:
            return np.round(255 * np.clip(np.nan_to_num(linear), 0, 1)).astype(np.uint8)
        return encode_srgb(linear)


def find_rendering(
    bands: Sequence[Band],
    *,
    sensitivity: tuple[np.ndarray, np.ndarray] | None = None,
    encoded: bool = False,
) -> Rendering:
    """Choose how bands are shown: in colour where they allow it, in pseudo-colour, or in grey.

    Parameters
    ----------
    sensitivity : (wavelengths (n,), table (n, bands)), optional
        Of a broad-band camera: a least-squares matrix to XYZ is used.
    encoded : bool
        Whether the values are display values already.
    """
    good = [i for i, band in enumerate(bands) if not band.bad]
    if 0 < len(good) < len(bands):  # a bad band has no part in any picture
        table = (sensitivity[0], sensitivity[1][:, good]) if sensitivity is not None else None
        found = find_rendering([bands[i] for i in good], sensitivity=table, encoded=encoded)
        matrix = np.zeros((len(bands), 3), np.float32)
        matrix[good] = found.matrix
        return replace(found, matrix=matrix)
    wavelengths = np.array([band.wavelength for band in bands], float)
    if sensitivity is not None and len(bands) >= 3 and not encoded:
        matrix, missed = camera_matrix(*sensitivity)
        if missed <= WORST_COLOUR_SHARE:
            text = f"sRGB under D65, by a least-squares matrix from {len(bands)} channels"
            return _from_xyz(matrix, text)
    if len(bands) >= 3 and np.all(np.isfinite(wavelengths)):
        return _in_colour(wavelengths) or _false_colour(bands, wavelengths)
    return _by_letters(bands, encoded) or _grey(bands, encoded)


def counts_white(values: np.ndarray, rendering: Rendering, *, step: int = 4) -> float:
    """Return the count that is shown as white: the 99.5 % point of the brighter bands shown.

    Every `step`-th pixel of either axis is looked at.
    """
    used = np.any(rendering.matrix != 0, axis=1)
    thin = values[::step, ::step][..., used]
    finite = thin[np.isfinite(thin)]
    if finite.size == 0:
        return 1.0
    level = float(np.percentile(finite, COUNTS_PERCENTILE))
    return float(f"{level:.3g}") if level > 0 else 1.0


def camera_matrix(wavelengths: np.ndarray, table: np.ndarray) -> tuple[np.ndarray, float]:
    """Fit the matrix from a camera's flat-fielded channels to XYZ under D65.

    Returns
    -------
    matrix : ndarray, (channels, 3)
        ``XYZ = channels @ matrix``; white, all channels 1, is exactly the white of D65.
    missed : float, 0 … 1
        Share of XYZ's variance over smooth reflectances that the camera cannot resolve.

    Notes
    -----
    The light of the captures is taken for D65: flat-fielding removes its level, not its part in
    the channels' shape. Reflectances are taken for a first-order Markov process over wavelength.
    """
    rows = tables_by_nm()
    grid, target = observer_under()
    full = np.arange(min(380.0, wavelengths.min()), max(780.0, wavelengths.max()) + 1)
    light = np.interp(full, grid, rows[:, 4])
    captured = np.stack([np.interp(full, wavelengths, c, left=0, right=0) for c in table.T], 1)
    captured = np.maximum(captured, 0) * light[:, None]
    captured = captured / captured.sum(0)
    wanted = np.stack([np.interp(full, grid, c, left=0, right=0) for c in target.T], 1)
    root = np.linalg.cholesky(REFLECTANCE_CORRELATION ** np.abs(full[:, None] - full)).T
    white = wanted.sum(0)
    # White is kept exactly: the first channel's row is what the others leave of it.
    rest = root @ (captured[:, 1:] - captured[:, :1])
    goal = root @ (wanted - captured[:, :1] * white)
    others = np.linalg.lstsq(rest, goal, rcond=1e-6)[0]
    matrix = np.vstack([white - others.sum(0), others])
    centred = root @ (wanted - white * wanted.sum(1, keepdims=True) / white.sum())
    missed = np.linalg.norm(goal - rest @ others) / np.linalg.norm(centred)
    return matrix, min(1.0, float(missed))


# --- kinds of rendering -------------------------------------------------------------------------


def _from_xyz(weights: np.ndarray, text: str) -> Rendering:
    matrix = weights @ np.linalg.inv(SRGB_TO_XYZ).T
    return Rendering(matrix.astype(np.float32), text, True)


def _in_colour(wavelengths: np.ndarray) -> Rendering | None:
    coverage = visible_coverage(wavelengths)
    low, high = wavelengths.min(), wavelengths.max()
    visible = np.sort(wavelengths[(wavelengths > 360) & (wavelengths < 740)])
    if coverage < LEAST_COVERAGE or np.diff(visible).max(initial=0) > WIDEST_GAP_NM:
        return None
    text = "sRGB under D65"
    if coverage < FULL_COVERAGE:
        text += f", from {low:g}–{high:g} nm ({coverage:.0%} of the visible weight)"
    if np.diff(visible).max(initial=0) > SPARSE_GAP_NM:
        text += f", interpolated between {len(visible)} bands"
    return _from_xyz(xyz_weights(wavelengths), text)


def _false_colour(bands: Sequence[Band], wavelengths: np.ndarray) -> Rendering:
    chosen = []
    for low, high in VISIBLE_CENTRES.values():
        inside = np.flatnonzero((wavelengths >= low) & (wavelengths <= high))
        if len(inside):
            nearest = np.abs(wavelengths[inside] - (low + high) / 2)
            chosen.append(int(inside[np.argmin(nearest)]))
    if len(chosen) < 3:
        order = np.argsort(wavelengths, kind="stable")
        chosen = [int(order[-1]), int(order[len(order) // 2]), int(order[0])]
    matrix = np.zeros((len(bands), 3), np.float32)
    matrix[chosen, [0, 1, 2]] = 1
    names = "/".join(f"{wavelengths[i]:g}" for i in chosen)
    return Rendering(matrix, f"pseudo-colour: {names} nm as red/green/blue", False)


def _by_letters(bands: Sequence[Band], encoded: bool) -> Rendering | None:
    """Sum the channels of each letter: R1 and R2 are red, as in Figure 13b of the paper."""
    groups = [[i for i, b in enumerate(bands) if _is_channel(b.label, c)] for c in LETTERS]
    if not all(groups):
        return None
    matrix = np.zeros((len(bands), 3), np.float32)
    for column, group in enumerate(groups):
        matrix[group, column] = 1 / len(group)
    if all(len(group) == 1 for group in groups):
        text = "the camera's RGB" + (" as it is" if encoded else ", taken for linear sRGB")
        return Rendering(matrix, text, encoded, encoded)
    names = " / ".join("+".join(bands[i].label for i in group) for group in groups)
    return Rendering(matrix, f"pseudo-colour: {names} as red/green/blue", False, encoded)


def _is_channel(label: str, letter: str) -> bool:
    return label[:1].upper() == letter and (label[1:] == "" or label[1:].isdigit())


def _grey(bands: Sequence[Band], encoded: bool) -> Rendering:
    matrix = np.full((len(bands), 3), 1 / len(bands), np.float32)
    text = (
        f"greyscale: {bands[0].label}"
        if len(bands) == 1
        else f"greyscale: mean of {len(bands)} bands"
    )
    return Rendering(matrix, text, False, encoded)


@cache
def srgb_profile() -> bytes:
    """Return an ICC version 2 display profile of sRGB, 2.6 kB, primaries adapted to D50 by Bradford.

    Examples
    --------
    >>> profile = srgb_profile()
    >>> len(profile) == int.from_bytes(profile[:4], "big"), profile[36:40]
    (True, b'acsp')
    """
    return (DATA / "srgb.icc").read_bytes()
