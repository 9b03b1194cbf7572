"""Which of many bands of a sensor are measured, and what the others follow from.

Lateral colour is smooth in wavelength, so that every n-th band predicts those between. That is not taken on trust: a band that was moved
between two shots is found by the bands beside it, and where measured bands do not predict one another all are measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.threads import each
from levkas.registration.chromatic import (
    ChromaticShifts,
    error_between_bands,
    interpolate_chromatic,
)
from levkas.registration.local_shifts import Predictor, WindowShifts, reduce
from levkas.registration.predictors import measure_shifts, principal_components

if TYPE_CHECKING:
    from levkas.registration.bands import BandImage

LEAST_MEASURED = 25
"""Bands that are measured at the least, where there are twice as many."""
SMOOTH_PX, STRAY_PX = 0.02, 0.1
"""Largest error, reference px, at which neighbours predict a measured band, so that others need not be; distance, native px, from the
bands beside it at which a band is measured itself."""
SMALL_PX, CELL_PX = 256, 12
"""Longer side, px, of the pictures in which such bands are looked for, and the cell of their windows."""


def measured_bands(bands: Sequence[BandImage], also: int | None = None) -> list[int]:
    """Return the numbers of bands of a sensor, in the order of wavelength, whose shifts are measured; `also` whatever its number.

    All are where wavelengths are not known, or there are fewer than twice `LEAST_MEASURED` (25). Otherwise every
    n-th, and bands between these that lie `STRAY_PX` (0.1) or more from where the two beside them show the same detail.

    Examples
    --------
    >>> from levkas.registration.bands import BandImage
    >>> scan = [BandImage.of(f"{nm} nm", np.ones((9, 9)), nm) for nm in range(400, 1001, 5)]
    >>> len(scan), len(measured_bands(scan)), measured_bands(scan)[:3], measured_bands(scan)[-1]
    (121, 31, [0, 4, 8], 120)
    """
    count = len(bands)
    every = count // LEAST_MEASURED
    if every < 2 or not all(np.isfinite(band.wavelength) for band in bands):
        return list(range(count))
    evenly = np.linspace(0, count - 1, -(-count // every)).round().astype(int).tolist()
    picks = sorted({*evenly, *([] if also is None else [also])})
    strays = each(lambda ends: _strays(bands[ends[0] : ends[1] + 1]), list(pairwise(picks)))
    return sorted({*picks, *(a + i for a, some in zip(picks, strays, strict=False) for i in some)})


def _strays(bands: Sequence[BandImage]) -> list[int]:
    """Return the numbers of bands that do not lie where the first and the last show the same detail."""
    by = max(1, max(bands[0].size) // SMALL_PX)
    first, *between, last = (
        reduce(np.where(b.valid, np.sqrt(np.maximum(b.values, 0)), np.nan), by) for b in bands
    )
    if not between or not np.isfinite(first + last).any():
        return list(range(1, len(bands) - 1))
    basis = principal_components(np.stack([first, last])).high_passed()
    predictor = Predictor(basis.images, step=by, cell=CELL_PX)
    apart = [_distance(measure_shifts(predictor, picture)) for picture in between]
    return [number for number, px in enumerate(apart, 1) if px >= STRAY_PX]


def _distance(windows: WindowShifts) -> float:
    """Return the mean shift, px, of that quarter of the frame which is shifted most: a turn shifts each otherwise."""
    weights = np.trace(windows.information, axis1=1, axis2=2)
    quarter = (windows.centres > np.median(windows.centres, axis=0)) @ [1, 2]
    parts = [weights * (quarter == number) for number in range(4)]
    shifts = (np.hypot(*(w @ windows.shift / w.sum())) for w in parts if w.any())
    return float(max(shifts, default=0.0))


def is_smooth_in_wavelength(
    chromatic: ChromaticShifts, shown: Sequence[BandImage], bands: Sequence[BandImage]
) -> bool:
    """Return whether measured bands predict those between them: each lies where its neighbours predict it."""
    nm = [band.wavelength for band in shown]
    return len(shown) == len(bands) or error_between_bands(chromatic, nm) <= SMOOTH_PX


def chromatic_of_all(
    chromatic: ChromaticShifts, shown: Sequence[BandImage], bands: Sequence[BandImage]
) -> ChromaticShifts:
    """Return the displacements of all bands from those of the measured ones."""
    if len(shown) == len(bands):
        return chromatic
    measured, wanted = ([band.wavelength for band in some] for some in (shown, bands))
    return interpolate_chromatic(chromatic, measured, wanted)
