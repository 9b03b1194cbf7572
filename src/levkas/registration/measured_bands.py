"""Which of many bands of a sensor are measured, and what the others follow from.

Lateral colour is smooth in wavelength, so that every n-th band predicts those between. That is not taken on
trust: a band that was moved between two shots is found by the bands beside it, and where measured bands do
not predict one another all are measured.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import TYPE_CHECKING

import cv2
import numpy as np

from levkas.core.threads import each
from levkas.registration.chromatic import (
    ChromaticShifts,
    error_between_bands,
    interpolate_chromatic,
)
from levkas.registration.local_shifts import Predictor, WindowShifts
from levkas.registration.predictors import measure_shifts, principal_components

if TYPE_CHECKING:
    from levkas.registration.bands import BandImage

#: Bands that are measured at the least, where there are twice as many.
LEAST_MEASURED = 25
#: Largest error, reference px, at which neighbours predict a measured band, so that others need not be.
SMOOTH_PX = 0.02
#: Distance, native px, from the bands beside it at which a band is measured itself.
STRAY_PX = 0.1
#: Longer side, px, of the pictures in which such bands are looked for, and the cell of their windows.
SMALL_PX, CELL_PX = 256, 12


def measured_bands(bands: Sequence[BandImage], also: int | None = None) -> list[int]:
    """Return the numbers of bands, in the order of wavelength, whose shifts are measured.

    All are where wavelengths are not known, or there are fewer than twice `LEAST_MEASURED` (25). Otherwise every
    n-th, and bands between these that lie `STRAY_PX` (0.1) or more from where the two beside them show the same detail.

    Parameters
    ----------
    bands : sequence of BandImage
        Of one sensor, by wavelength.
    also : int, optional
        A band that is measured whatever its number.

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
    picks = np.linspace(0, count - 1, -(-count // every)).round().astype(int).tolist()
    picks = sorted({*picks, *([] if also is None else [also])})
    strays = each(lambda ends: _strays(bands[ends[0] : ends[1] + 1]), list(pairwise(picks)))
    return sorted({*picks, *(a + i for a, some in zip(picks, strays, strict=False) for i in some)})


def _strays(bands: Sequence[BandImage]) -> list[int]:
    """Return the numbers of bands that do not lie where the first and the last show the same detail."""
    if len(bands) < 3:
        return []
    by = max(1, max(bands[0].size) // SMALL_PX)
    first, *between, last = (_reduced(band, by) for band in bands)
    if not np.isfinite(first + last).any():
        return list(range(1, len(bands) - 1))
    basis = principal_components(np.stack([first, last])).high_passed()
    predictor = Predictor(basis.images, step=by, cell=CELL_PX)
    found = []
    for number, picture in enumerate(between, 1):
        if _distance(measure_shifts(predictor, picture)) >= STRAY_PX:
            found.append(number)
    return found


def _distance(windows: WindowShifts) -> float:
    """Return the mean shift, px, of that quarter of the frame which is shifted most: a turn shifts each otherwise."""
    weights = np.trace(windows.information, axis1=1, axis2=2)
    quarter = (windows.centres > np.median(windows.centres, axis=0)) @ [1, 2]
    parts = [weights * (quarter == number) for number in range(4)]
    return max(
        (float(np.hypot(*(w @ windows.shift / w.sum()))) for w in parts if w.any()), default=0.0
    )


def _reduced(band: BandImage, by: int) -> np.ndarray:
    """Return the square root of a band, averaged over blocks of `by` px; NaN where any of them is not valid."""
    values = np.where(band.valid, np.sqrt(np.maximum(band.values, 0)), np.nan).astype(np.float32)
    width, height = (side // by for side in band.size)
    whole = values[: height * by, : width * by]
    return np.asarray(cv2.resize(whole, (width, height), interpolation=cv2.INTER_AREA))


def is_smooth_in_wavelength(
    chromatic: ChromaticShifts, shown: Sequence[BandImage], bands: Sequence[BandImage]
) -> bool:
    """Return whether measured bands predict those between them: each lies where its neighbours predict it."""
    if len(shown) == len(bands):
        return True
    return error_between_bands(chromatic, [band.wavelength for band in shown]) <= SMOOTH_PX


def chromatic_of_all(
    chromatic: ChromaticShifts, shown: Sequence[BandImage], bands: Sequence[BandImage]
) -> ChromaticShifts:
    """Return the displacements of all bands from those of the measured ones."""
    if len(shown) == len(bands):
        return chromatic
    measured, wanted = ([band.wavelength for band in some] for some in (shown, bands))
    return interpolate_chromatic(chromatic, measured, wanted)
