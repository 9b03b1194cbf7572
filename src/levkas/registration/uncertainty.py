"""Uncertainty of the position of every point: one standard deviation, band by band.

The variances of the base map, by a delete-a-group jackknife over spatial folds ([kott2001]_), between models that predict held-out blocks
nearly as well ([buckland1997]_), of the band's chromatic shift, of the reference's own bands, and of displaced lines are added.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from levkas.registration.record import Sigma

if TYPE_CHECKING:
    from levkas.registration.chromatic import ChromaticShifts
    from levkas.registration.model_selection import SelectedModel
    from levkas.registration.window_matching import CheckWindows


LATTICE, DECIMALS = (9, 7), 5
"""Nodes along and down the reference's frame; of sigma, reference px."""
FOLDS_FACTOR = 1.4
"""By which sigma over folds is too small, since no fold shows what errs alike over more than a block (`benchmarks/verdict.py battery`)."""
BANDS_FACTOR = 1.4
"""The same for a band against its neighbours in wavelength: errors are 0.6 to 1.3 sigmas, 0.84 in the median (`benchmarks/registration.py`)."""
LOCAL_SHARE = 0.5
"""Share of the variance of the folds that is taken at the place itself, of which nine folds say little; the rest from the whole frame."""
STRAY = 0.06
"""In px a px that a map reaches beyond what windows confirm (cut and bent pairs of `benchmarks/verdict.py classes`)."""
WINDOW_SHARE = 0.75
"""From the centre of a window to its edge, of how far apart windows lie that share no pixel: 1.5 of 2 cells."""
NINE_OF_TEN = 2.146
"""Radius of the circle that holds nine of ten errors, in sigmas of one axis: sqrt(2 ln 10)."""


def lattice_over(shape: Sequence[int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return x and y of the lattice of sigmas over a frame (height, width), and its points, (n, 2)."""
    x, y = (np.round(np.linspace(0, shape[1 - k] - 1, n), 2) for k, n in enumerate(LATTICE))
    return x, y, np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def measure_sigma(
    shape: tuple[int, int],
    labels: Sequence[str],
    chromatic: ChromaticShifts,
    selected: SelectedModel | None = None,
    reference: Mapping[str, Sigma] | None = None,
    checks: CheckWindows | None = None,
    coarse: float | None = None,
    lines: float = 0.0,
) -> dict[str, Sigma]:
    """Return the sigma of every band of a sensor, in the order of `chromatic`, over a frame (height, width).

    `selected` is the base map, if any, `checks` confirm it: the farther away, the less it is known. `reference` are the sigmas of the bands
    that predicted these; `coarse`, reference px, of a map that outlines alone confirm; `lines`, of each axis, of lines that are displaced.
    """
    x, y, points = lattice_over(shape)
    common = np.zeros(len(points))
    if selected is not None:
        common += _of_map(selected, points)
        far = np.zeros(len(points)) if checks is None else checks.beyond(points)
        if checks is not None and far.any():
            # Other models count in full a window's side beyond what is checked; what none of them shows grows with the distance.
            far = np.minimum(far, float(np.hypot(*shape)))
            share = np.minimum(far / checks.side, 1.0)
            common += (share * selected.sigma_beyond(points)) ** 2 + (STRAY * far) ** 2
    if coarse is not None:
        common = np.where(np.isfinite(common), common, coarse**2)
    if reference:
        common += np.mean([one(points) ** 2 for one in reference.values()], 0)
    result = {}
    for band, label in enumerate(labels):
        apart = BANDS_FACTOR**2 * chromatic.variance(band, points)
        values = np.sqrt(common + apart + lines**2).reshape(LATTICE[::-1])
        result[label] = Sigma(x, y, np.round(values, DECIMALS))
    return result


def _of_map(selected: SelectedModel, points: np.ndarray) -> np.ndarray:
    """Return the variance of a map, as far as windows reach: what it does beyond is not what its folds say."""
    observed = selected.observations.points
    low, high, reach = observed.min(0), observed.max(0), WINDOW_SHARE * selected.terms.apart
    folds = selected.sigma(np.clip(points, low - reach, high + reach)) ** 2
    inside = np.all((points >= low) & (points <= high), 1)
    middle = float(np.median(folds[inside] if inside.any() else folds))
    return np.asarray(FOLDS_FACTOR**2 * (LOCAL_SHARE * folds + (1 - LOCAL_SHARE) * middle))
