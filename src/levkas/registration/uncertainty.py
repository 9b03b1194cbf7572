"""Uncertainty of the position of every point: one standard deviation, band by band.

Four variances are added: that of the base map by a delete-a-group jackknife over spatial folds
([kott2001]_), the spread between models that predict held-out blocks nearly as well ([buckland1997]_), that
of the band's chromatic shift, and that of the reference's own bands, from which this one was predicted. Lines that
are displaced against one another (`line_displacement`) add a fifth.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.registration.record import Sigma

if TYPE_CHECKING:
    from levkas.registration.chromatic import ChromaticShifts
    from levkas.registration.model_selection import SelectedModel
    from levkas.registration.window_matching import CheckWindows


@dataclass(frozen=True)
class UncertaintySettings:
    """Constants of the uncertainty."""

    lattice: tuple[int, int] = (9, 7)
    """Nodes along and down the reference's frame."""
    decimals: int = 5
    """Of sigma, reference px."""
    folds_factor: float = 1.4
    """The variance over folds is this much too small: of few of them it is uncertain, and what errs alike over more than a
    block none of them shows. Measured on pairs of pictures (`benchmarks/verdict.py battery`)."""
    bands_factor: float = 1.4
    """The same for a band against its neighbours in wavelength; measured on nine simulated campaigns and two paintings of
    another simulation: with 1.4 the errors of the reference's own bands are 0.6 to 1.3 sigmas, in the median 0.84.
    `benchmarks/registration.py` measures both on others."""
    local_share: float = 0.5
    """Share of the variance of the folds that is taken at the place itself, the rest from the whole frame: nine folds say
    little of one place."""
    stray: float = 0.06
    """In px a px: how far a map may stray for each px that it reaches beyond what windows confirm; measured on cut and bent
    pairs (those of `benchmarks/verdict.py classes`)."""


SETTINGS = UncertaintySettings()
#: From the centre of a window to its edge, of how far apart windows lie that share no pixel: 1.5 of 2 cells.
WINDOW_SHARE = 0.75
#: Radius of the circle that holds nine of ten errors, in sigmas of one axis: sqrt(2 ln 10).
NINE_OF_TEN = 2.146


def measure_sigma(
    shape: tuple[int, int],
    labels: Sequence[str],
    chromatic: ChromaticShifts,
    selected: SelectedModel | None = None,
    reference: Mapping[str, Sigma] | None = None,
    checks: CheckWindows | None = None,
    coarse: float | None = None,
) -> dict[str, Sigma]:
    """Return the sigma of every band of a sensor.

    Parameters
    ----------
    shape : (height, width) of the reference
    labels : sequence of str
        Bands, in the order of `chromatic`.
    selected : SelectedModel, optional
        The base map; the reference's own sensor has none.
    reference : mapping of label to Sigma, optional
        Of the bands that predicted these.
    checks : CheckWindows, optional
        Windows that confirm the base map; away from them it is known the less the farther.
    coarse : float, reference px, optional
        Sigma of a map that outlines alone confirm, where too little was measured to leave some of it out.
    """
    x, y = (
        np.round(np.linspace(0, n - 1, k), 2)
        for n, k in zip(shape[::-1], SETTINGS.lattice, strict=True)
    )
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    common = np.zeros(len(points))
    if selected is not None:
        observed = selected.observations.points
        # As far as windows reach; what a map does beyond is not what its folds say.
        reach = WINDOW_SHARE * selected.terms.apart
        within = np.clip(points, observed.min(0) - reach, observed.max(0) + reach)
        folds = selected.sigma(within) ** 2
        inside = np.all((points >= observed.min(0)) & (points <= observed.max(0)), 1)
        middle = float(np.median(folds[inside])) if inside.any() else float(np.median(folds))
        common += SETTINGS.folds_factor**2 * (
            SETTINGS.local_share * folds + (1 - SETTINGS.local_share) * middle
        )
        if checks is not None:
            common += _beyond(selected, points, checks.beyond(points), checks.side, shape)
    if coarse is not None:
        common = np.where(np.isfinite(common), common, coarse**2)
    if reference:
        common += np.mean([one(points) ** 2 for one in reference.values()], 0)
    result = {}
    for band, label in enumerate(labels):
        apart = SETTINGS.bands_factor**2 * chromatic.variance(band, points)
        values = np.sqrt(common + apart).reshape(SETTINGS.lattice[::-1])
        result[label] = Sigma(x, y, np.round(values, SETTINGS.decimals))
    return result


def _beyond(
    selected: SelectedModel,
    points: np.ndarray,
    far: np.ndarray,
    side: float,
    shape: tuple[int, int],
) -> np.ndarray:
    """Return the variance that a map has more where nothing confirms it.

    Other models that saw the same and reach elsewhere count in full a window's `side` beyond what is
    checked; what none of them shows grows with the distance.
    """
    far = np.minimum(far, float(np.hypot(*shape)))
    if not far.any():
        return np.zeros(len(points))
    share = np.minimum(far / side, 1.0)
    return np.asarray((share * selected.sigma_beyond(points)) ** 2 + (SETTINGS.stray * far) ** 2)


def with_lines(known: Mapping[str, Sigma], lines: float) -> dict[str, Sigma]:
    """Return sigmas of bands of which single lines are displaced by `lines`, one sigma of each axis, reference px.

    Examples
    --------
    >>> flat = Sigma(np.arange(2.0), np.arange(2.0), np.full((2, 2), 0.3))
    >>> with_lines({"550 nm": flat}, 0.4)["550 nm"].values.tolist()
    [[0.5, 0.5], [0.5, 0.5]]
    """
    return {
        label: Sigma(one.x, one.y, np.round(np.hypot(one.values, lines), SETTINGS.decimals))
        for label, one in known.items()
    }
