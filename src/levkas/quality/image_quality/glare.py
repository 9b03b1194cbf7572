"""Glare: what a lamp mirrors in varnish and gold instead of what paint reflects.

Two things are distinguished, section 2.1 of [mirhashemi2019]_. *Glare*: the value cannot be paint's, for it
saturates above white paint, or is brighter than white paint can be. *Lifted*: the value could be
paint's, but under another lighting it is darker by about the same in every band, whatever the colour.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from levkas.core.compiled import njit
from levkas.core.cube import Flag, is_flagged
from levkas.core.threads import in_threads

WHITE_PAINT = 0.9
"""Reflectance of the whitest paint: what saturates below it is overexposed, not glare."""
PAINT_LIMIT = 1.25
"""Most that paint reflects: 0.9 on a slope of 20° towards a lamp at 45° (cos 20° + sin 20° = 1.28) is
1.15; a white board that is 5 % too dark, and 3 % of drift, are left for what is not known."""
EXCESS, RELATIVE_EXCESS = 0.1, 0.1
"""What lifts a pixel at least in every band: reflectance, and a share of the paint's own."""
WHITENESS = 0.6
"""Least over greatest excess over the bands: shading follows the paint's colour, glare does not."""
SIGMAS = 4.0
LOOKED_AT_PX = 250_000
"""Pixels from which the ratio of two setups is taken, evenly over the layer."""
ROWS = 64
FULL, BRIGHT = 1, 2
OUTSIDE, SATURATED, GLARE = int(Flag.OUTSIDE), int(Flag.SATURATED), int(Flag.GLARE)


class Glare(NamedTuple):
    """What was found, by sign; (h, w) of bool each.

    `saturated` (above white paint) and `bright` (beyond what paint can be) are glare; `lifted`, against
    another setup, is the softer finding: the paint is visible through a veil.
    """

    saturated: np.ndarray
    bright: np.ndarray
    lifted: np.ndarray

    @property
    def mask(self) -> np.ndarray:
        """Where glare took the place of paint, (h, w) of bool."""
        return self.saturated | self.bright

    @property
    def veiled(self) -> np.ndarray:
        """Where paint is lifted, and still visible, (h, w) of bool."""
        return self.lifted & ~self.mask

    def counts(self) -> dict[str, int]:
        """Return pixels under each sign of glare, under glare, and veiled."""
        parts = ("saturated", "bright", "mask", "veiled")
        names = ("saturated", "bright", "glare", "veiled")
        return {
            n: int(np.count_nonzero(getattr(self, p))) for n, p in zip(names, parts, strict=True)
        }


def find_glare(
    values: np.ndarray,
    flags: np.ndarray,
    sigma: np.ndarray | None = None,
    *,
    other: tuple[np.ndarray, np.ndarray] | None = None,
    gains: np.ndarray | None = None,
) -> Glare:
    """Find glare in reflectance whose bands lie on one another.

    Parameters
    ----------
    values : ndarray, (h, w, bands)
        Reflectance.
    flags : ndarray like `values`, uint8
        Bits of `cube.Flag`; SATURATED and OUTSIDE are read.
    sigma : ndarray like `values`, optional
        Its standard deviation: a limit must be passed by four of it.
    other : (values, flags), optional
        The same object, camera and grid under another lighting.
    gains : ndarray, (bands,), optional
        What `setup_gains` gives of the whole layers, where these are some of their rows.

    Notes
    -----
    One band suffices for glare: a mirror spares none, and varnish adds its 4 % to each. Each pixel is
    judged by itself, so that rows may be looked at one after another. Against another setup the excess must
    be 0.1 + 0.1 of the paint in every band and of about one height in all (bands that saturate, not
    looked at), after the median ratio of the setups is taken out.

    Examples
    --------
    >>> paint = np.full((1, 3, 3), [0.5, 0.3, 0.1]); shown = paint.copy()
    >>> shown[0, 1] += 0.4; shown[0, 2] += 1.1
    >>> none = np.zeros((1, 3, 3), np.uint8)
    >>> found = find_glare(shown, none, other=(paint, none))
    >>> found.mask.tolist(), found.lifted.tolist()
    ([[False, False, True]], [[False, True, True]])
    """
    height, width = values.shape[:2]
    signs, noise = np.zeros((height, width), np.uint8), _noise(sigma)
    in_threads(_judge_pixels, height, values, flags, noise, signs)
    lifted = np.zeros((height, width), bool)
    if other is not None:
        if gains is None:
            step = max(1, int(np.sqrt(height * width / LOOKED_AT_PX)))
            thin = [a[::step, ::step] for a in (values, flags, *other)]
            gains = setup_gains(*thin)
        lifted = _find_lifted(values, flags, sigma, *other, gains)
    return Glare(signs & FULL > 0, signs & BRIGHT > 0, lifted)


def mark_glare(values: np.ndarray, flags: np.ndarray, sigma: np.ndarray | None = None) -> None:
    """Set GLARE in `flags`, in place, band by band: where bands do not yet lie on one another.

    Examples
    --------
    >>> flags = np.zeros((1, 1, 2), np.uint8)
    >>> mark_glare(np.array([[[1.4, 0.6]]]), flags)
    >>> flags.tolist()
    [[[16, 0]]]
    """
    noise = _noise(sigma)
    in_threads(_mark_bands, len(values), values, flags, noise)


def flag_glare(flags: np.ndarray, found: Glare) -> None:
    """Set GLARE, and nothing else of it, in every band of pixels with glare, VEILED in lifted ones."""
    flags &= np.uint8(0xFF & ~(GLARE | int(Flag.VEILED)))
    flags[found.mask] |= np.uint8(GLARE)
    flags[found.veiled] |= np.uint8(Flag.VEILED)


def _noise(sigma: np.ndarray | None) -> np.ndarray:
    return np.zeros((0, 0, 0), np.float32) if sigma is None else sigma


@njit
def _judge(value, flag, noise):  # type: ignore[no-untyped-def]
    """Return the signs of one value."""
    found = 0
    if flag & SATURATED and value >= WHITE_PAINT:
        found |= FULL
    if np.isfinite(noise):
        value -= SIGMAS * noise
    if value > PAINT_LIMIT:
        found |= BRIGHT
    return found


@njit(cache=True)
def _judge_pixels(start, stop, values, flags, sigma, signs):  # type: ignore[no-untyped-def]
    """Set the signs that any band of a pixel shows, of what every band saw."""
    for y in range(start, stop):
        for x in range(values.shape[1]):
            found = 0
            for b in range(values.shape[2]):
                if flags[y, x, b] & OUTSIDE:
                    found = 0
                    break
                noise = np.float64(sigma[y, x, b]) if sigma.size else 0.0
                found |= _judge(np.float64(values[y, x, b]), flags[y, x, b], noise)
            signs[y, x] = found


@njit(cache=True)
def _mark_bands(start, stop, values, flags, sigma):  # type: ignore[no-untyped-def]
    """Set GLARE where a band by itself shows a sign."""
    least = np.float32(WHITE_PAINT)
    for y in range(start, stop):
        for x in range(values.shape[1]):
            pixel = values[y, x]
            bright = False  # hardly any pixel is
            for b in range(pixel.size):
                bright |= pixel[b] >= least
            if not bright:
                continue
            for b in range(pixel.size):
                if flags[y, x, b] & OUTSIDE:
                    continue
                noise = np.float64(sigma[y, x, b]) if sigma.size else 0.0
                if _judge(np.float64(pixel[b]), flags[y, x, b], noise):
                    flags[y, x, b] |= np.uint8(GLARE)


def _find_lifted(
    values: np.ndarray,
    flags: np.ndarray,
    sigma: np.ndarray | None,
    paint: np.ndarray,
    known: np.ndarray,
    gains: np.ndarray,
) -> np.ndarray:
    """Where all bands are lifted against another setup, some rows at a time."""
    lifted = np.zeros(values.shape[:2], bool)
    for top in range(0, len(values), ROWS):
        rows = slice(top, top + ROWS)
        inside = ~is_flagged(flags[rows] | known[rows], Flag.OUTSIDE).any(-1)
        margin = 0.0 if sigma is None else SIGMAS * np.nan_to_num(sigma[rows])
        full = is_flagged(flags[rows], Flag.SATURATED)
        lifted[rows] = _lifted(values[rows], full, paint[rows] * gains, margin) & inside
    return lifted


def setup_gains(
    values: np.ndarray, flags: np.ndarray, paint: np.ndarray, known: np.ndarray
) -> np.ndarray:
    """Return the median ratio of two setups, band by band, within 0.8 … 1.25; 1 where there is little.

    Examples
    --------
    >>> paint = np.linspace(0.1, 0.5, 400).reshape(20, 20, 1)
    >>> none = np.zeros(paint.shape, np.uint8)
    >>> setup_gains(1.13 * paint, none, paint, none)
    array([1.13], dtype=float32)
    """
    good = ~is_flagged(flags | known, Flag.OUTSIDE | Flag.SATURATED) & (paint > 0.01)
    gains = np.ones(values.shape[2], np.float32)
    for band in range(values.shape[2]):
        use = good[..., band]
        if np.count_nonzero(use) > 100:
            ratio = float(np.median(values[..., band][use] / paint[..., band][use]))
            gains[band] = min(max(ratio, 0.8), 1.25)
    return gains


def _lifted(
    part: np.ndarray, full: np.ndarray, paint: np.ndarray, margin: np.ndarray | float
) -> np.ndarray:
    """Whether every band is lifted, and all by about as much."""
    excess = part - paint
    high: np.ndarray = (
        full | (excess - margin > EXCESS + RELATIVE_EXCESS * np.maximum(paint, 0))
    ).all(-1)
    least = np.where(full, np.inf, excess).min(-1)
    most = np.where(full, -np.inf, excess).max(-1)
    return high & ~full.all(-1) & (least >= WHITENESS * most)
