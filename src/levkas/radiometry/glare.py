"""Glare: what a lamp mirrors in varnish and gold instead of what paint reflects.

Three signs, section 2.1 of [mirhashemi2019]_: it saturates; it is brighter than any paint can be (no
diffuser reflects more than the perfect one); and, where the object was taken under two lightings,
it adds the same to every band, whatever the paint below.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numba import njit

from levkas.cube import Flag
from levkas.machine import count_threads

BRIGHT_PAINT = 0.9
"""Reflectance of the whitest paint: what saturates below it is overexposed, not glare."""
WHITE_LIMIT, METAL_LIMIT = 1.0, 1.25
"""Reflectance above which all bands are glare of varnish, and any band is glare of metal."""
EXCESS, RELATIVE_EXCESS = 0.1, 0.1
"""What glare adds at least to every band: reflectance, and a share of the paint's own."""
WHITENESS = 0.6
"""Least over greatest excess over the bands: shading follows the paint's colour, glare does not."""
SIGMAS = 4.0
ROWS = 64
FULL, CORE, WHITE, METAL = 1, 2, 4, 8
OUTSIDE, SATURATED = int(Flag.OUTSIDE), int(Flag.SATURATED)


class Glare(NamedTuple):
    """Where glare was found, by sign; (h, w) of bool each.

    `saturated`, `white` (brighter than paint in all bands), `metallic` (far brighter in one) and
    `added` (against another setup).
    """

    saturated: np.ndarray
    white: np.ndarray
    metallic: np.ndarray
    added: np.ndarray

    @property
    def mask(self) -> np.ndarray:
        """Where any sign was seen, (h, w) of bool."""
        return self.saturated | self.white | self.metallic | self.added

    def counts(self) -> dict[str, int]:
        """Return pixels under each sign and under any."""
        found = {name: int(np.count_nonzero(part)) for name, part in self._asdict().items()}
        return {**found, "glare": int(np.count_nonzero(self.mask))}


def find_glare(
    values: np.ndarray,
    flags: np.ndarray,
    sigma: np.ndarray | None = None,
    *,
    other: tuple[np.ndarray, np.ndarray] | None = None,
    whole: bool = True,
) -> Glare:
    """Find glare in reflectance.

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
    whole : bool
        Whether this is all of the layer. Of some of its rows no region can be followed: a saturated
        pixel counts where it reaches 0.9 itself, whatever rows it is looked at with.

    Returns
    -------
    glare : Glare

    Notes
    -----
    A saturated region counts where it reaches 0.9 somewhere: below, the frame was overexposed, and
    nothing tells paint from glare. Against another setup the excess must be 0.1 + 0.1 of the
    paint in every band and of about one height in all (bands that saturate, not looked at), after
    the median ratio of the setups is taken out.

    Examples
    --------
    >>> paint = np.full((1, 3, 3), [0.5, 0.3, 0.1]); shown = paint.copy(); shown[0, 1] += 0.4
    >>> none = np.zeros((1, 3, 3), np.uint8)
    >>> find_glare(shown, none, other=(paint, none)).mask.tolist()
    [[False, True, False]]
    """
    height, width = values.shape[:2]
    signs = np.zeros((height, width), np.uint8)
    noise = np.zeros((0, 0, 0), np.float32) if sigma is None else sigma
    edges = np.linspace(0, height, 2 * count_threads() + 1).astype(int).tolist()
    with ThreadPoolExecutor(count_threads()) as pool:
        jobs = [pool.submit(_signs, *e, values, flags, noise, signs) for e in pairwise(edges)]
        for job in jobs:
            job.result()
    saturated, core, white, metallic = (signs & bit > 0 for bit in (FULL, CORE, WHITE, METAL))
    added = np.zeros((height, width), bool)
    if other is not None:
        added = _find_added(values, flags, sigma, *other)
    return Glare(_grown(core, saturated) if whole else core, white, metallic & ~white, added)


@njit(nogil=True, cache=True)
def _signs(start, stop, values, flags, sigma, signs):  # type: ignore[no-untyped-def]
    """Set the bits of what each pixel of some rows shows by itself."""
    for y in range(start, stop):
        for x in range(values.shape[1]):
            found, brightest, dimmest = 0, -np.inf, np.inf
            for b in range(values.shape[2]):
                flag = flags[y, x, b]
                if flag & OUTSIDE:
                    found, brightest, dimmest = 0, -np.inf, -np.inf
                    break
                value = np.float64(values[y, x, b])
                if flag & SATURATED:
                    found |= (FULL | CORE) if value >= BRIGHT_PAINT else FULL
                if sigma.size and np.isfinite(sigma[y, x, b]):
                    value -= SIGMAS * sigma[y, x, b]
                brightest, dimmest = max(brightest, value), min(dimmest, value)
            found |= WHITE if dimmest > WHITE_LIMIT else 0
            found |= METAL if brightest > METAL_LIMIT else 0
            signs[y, x] = found


def flag_glare(flags: np.ndarray, mask: np.ndarray) -> None:
    """Set GLARE in every band of the pixels of `mask`, in place."""
    flags[mask] |= np.uint8(Flag.GLARE)


def _find_added(
    values: np.ndarray,
    flags: np.ndarray,
    sigma: np.ndarray | None,
    paint: np.ndarray,
    known: np.ndarray,
) -> np.ndarray:
    """Where all bands are lifted against another setup, some rows at a time."""
    added = np.zeros(values.shape[:2], bool)
    gains = _gains(values, flags, paint, known)
    for top in range(0, len(values), ROWS):
        rows = slice(top, top + ROWS)
        seen = (((flags[rows] | known[rows]) & Flag.OUTSIDE) == 0).all(-1)
        margin = 0.0 if sigma is None else SIGMAS * np.nan_to_num(sigma[rows])
        full = (flags[rows] & Flag.SATURATED) != 0
        added[rows] = _added(values[rows], full, paint[rows] * gains, margin) & seen
    return added


def _gains(
    values: np.ndarray, flags: np.ndarray, paint: np.ndarray, known: np.ndarray
) -> np.ndarray:
    """Median ratio of the setups, band by band; glare is on too few pixels to move it, or is added."""
    step = max(1, int(np.sqrt(values.shape[0] * values.shape[1] / 250_000)))
    a, b = values[::step, ::step], paint[::step, ::step]
    bad = (flags[::step, ::step] | known[::step, ::step]) & (Flag.OUTSIDE | Flag.SATURATED)
    good = (bad == 0) & (b > 0.01)
    gains = np.ones(values.shape[2], np.float32)
    for band in range(values.shape[2]):
        use = good[..., band]
        if np.count_nonzero(use) > 100:
            ratio = float(np.median(a[..., band][use] / b[..., band][use]))
            gains[band] = min(max(ratio, 0.8), 1.25)
    return gains


def _added(
    part: np.ndarray, full: np.ndarray, paint: np.ndarray, margin: np.ndarray | float
) -> np.ndarray:
    """Whether every band is lifted, and all by about as much."""
    excess = part - paint
    lifted: np.ndarray = (
        full | (excess - margin > EXCESS + RELATIVE_EXCESS * np.maximum(paint, 0))
    ).all(-1)
    least = np.where(full, np.inf, excess).min(-1)
    most = np.where(full, -np.inf, excess).max(-1)
    return lifted & ~full.all(-1) & (least >= WHITENESS * most)


def _grown(core: np.ndarray, within: np.ndarray) -> np.ndarray:
    """Regions of `within` that hold a pixel of `core`."""
    if not core.any():
        return core
    from scipy import ndimage

    labels, count = ndimage.label(within, np.ones((3, 3), int))
    chosen = np.zeros(count + 1, bool)
    chosen[np.unique(labels[core])] = True
    grown: np.ndarray = chosen[labels]
    return grown
