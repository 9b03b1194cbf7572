"""Maps of one scan: a stack of weak pictures that share one map, as the few pictures in which their signal is gathered.

Maps of elements (XRF) or of spectra (RIS) come from one passage of one beam over the object: they lie on one another exactly. Each alone shows little, and
some nothing but noise. The minimum noise fraction of [green1988]_ turns them into uncorrelated pictures in the order of their
signal over noise, which the Laplacian of [immerkaer1996]_ measures; those with a signal are registered in place of the maps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
from scipy import linalg

from levkas.registration.bands import BandImage

LAPLACIAN = np.outer((1, -2, 1), (1, -2, 1)).astype(np.float32) / 6
MOST = 8
"""Pictures that are kept; of simulated scans of 6 to 20 maps, 2 to 8 have a signal."""
LEAST_SIGNAL = 1.5
"""Variance over that of noise from which a picture is kept; noise alone has 1. At 1.2 or 2.0, one picture more or less."""


def gather_signal(maps: Sequence[BandImage]) -> list[BandImage]:
    """Return the pictures of a stack in which its signal is gathered, the clearest first, in units of their noise.

    Parameters
    ----------
    maps : sequence of BandImage
        Of one size; counts or any other quantity. Their square roots are combined, which makes the noise of counts even ([anscombe1948]_).

    Returns
    -------
    pictures : list of BandImage
        At least one and at most eight; a pixel is valid where all maps that are used are.

    Examples
    --------
    Two maps of one edge in noise, and one of noise alone:

    >>> rng = np.random.default_rng(1)
    >>> edge = np.repeat([[9.0] * 20 + [14.0] * 20], 30, axis=0)
    >>> maps = [BandImage.of(n, rng.poisson(v)) for n, v in (("Pb", edge), ("Hg", edge), ("Ar", 0 * edge + 9))]
    >>> gathered = gather_signal([BandImage(m.label, m.wavelength, 30 * m.values, m.valid) for m in maps])
    >>> len(gathered), bool(gathered[0].valid.all())
    (1, True)
    """
    used = [one for one in maps if _varies(one)] or list(maps[:1])
    valid = np.logical_and.reduce([one.valid & np.isfinite(one.values) for one in used])
    if not valid.any():
        return [replace(one, one_scan=True) for one in used]
    stack = np.stack([_even_noise(one.values, valid) for one in used])
    inner = cv2.erode(valid.astype(np.uint8), np.ones((3, 3), np.uint8), borderValue=0) > 0
    noise = np.stack([cv2.filter2D(one, -1, LAPLACIAN)[inner] for one in stack])
    signal = stack[:, valid]
    floor = 1e-6 * np.eye(len(used))
    covariances = (
        values @ values.T / max(values.shape[1], 1) + floor for values in (signal, noise)
    )
    ratios, vectors = linalg.eigh(*covariances)
    kept = np.argsort(-ratios)[: max(1, min(MOST, int((ratios > LEAST_SIGNAL).sum())))]
    loadings = vectors[:, kept].T
    loadings *= np.sign(loadings[np.arange(len(kept)), np.abs(loadings).argmax(1)])[:, None]
    pictures = np.einsum("kn,nhw->khw", loadings, stack).astype(np.float32)
    return [
        BandImage(
            f"signal {k}",
            np.nan,
            np.where(valid, one, np.float32(np.nan)),
            valid,
            used[0].sensor,
            one_scan=True,
        )
        for k, one in enumerate(pictures, 1)
    ]


def _varies(one: BandImage) -> bool:
    return bool(one.valid.any() and np.ptp(one.values[one.valid]) > 0)


def _even_noise(values: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Return the square root of a map over its spread, about its mean; 0 where not valid."""
    known = np.where(valid, values, 0).astype(np.float64)
    low = min(float(known[valid].min()), 0.0)
    roots = np.sqrt(known - low)
    roots = np.where(valid, roots - roots[valid].mean(), 0)
    return np.asarray(roots / max(float(roots[valid].std()), 1e-12))
