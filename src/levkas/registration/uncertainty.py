"""How well the position of every point is known: one standard deviation, band by band.

Four things are added up: how far the base map moves when a fold of blocks is left out, how far models
lie from it that predict those blocks nearly as well, how well windows tell the band from its neighbours
in wavelength, and how well the reference's own bands, from which this one was predicted, are known to
lie where they should.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from levkas.registration.checks import Checks
    from levkas.registration.chromatic import Chromatic
    from levkas.registration.model_selection import Rung

LATTICE = (9, 7)
DECIMALS = 5
#: What folds say of a map is this much too little: few of them tell a variance badly, and what errs
#: alike over more than a block none of them shows. Of pairs of pictures (`benchmarks/pairs.py`); what
#: windows say of a band against its neighbours, of three simulated campaigns. benchmarks/sigma.py
#: measures both on others.
FOLDS_FACTOR, BANDS_FACTOR = 1.4, 2.0
#: Half of the variance of the folds is taken where it is seen, half from the whole frame: nine
#: folds know a place badly.
LOCAL_SHARE = 0.5
#: By so much a map may stray, per px that it reaches beyond what windows confirm. Of cut and bent pairs
#: (`benchmarks/unchecked.py`).
STRAY = 0.06
#: Radius of the circle that holds nine of ten errors, in sigmas of one axis: sqrt(2 ln 10).
NINE_OF_TEN = 2.146


@dataclass(frozen=True)
class Sigma:
    """One standard deviation, of each axis, of where a band lies.

    Parameters
    ----------
    x, y : ndarray, (n,) and (m,), reference px
        Of a lattice over the reference's frame.
    values : ndarray, (m, n), reference px

    Examples
    --------
    >>> sigma = Sigma(np.array([0.0, 10.0]), np.array([0.0, 10.0]), np.array([[0.0, 1], [0, 1]]))
    >>> sigma(np.array([[2.5, 7.0], [20.0, 0.0]])).tolist()
    [0.25, 1.0]
    """

    x: np.ndarray
    y: np.ndarray
    values: np.ndarray

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return sigma at `points`, (n, 2) reference px → (n,) reference px; the rim's beyond it."""
        column, u = _cell(self.x, points[:, 0])
        row, v = _cell(self.y, points[:, 1])
        table = self.values
        upper = (1 - u) * table[row, column] + u * table[row, column + 1]
        lower = (1 - u) * table[row + 1, column] + u * table[row + 1, column + 1]
        return np.asarray((1 - v) * upper + v * lower)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {"x": self.x.tolist(), "y": self.y.tolist(), "sigma_px": self.values.tolist()}

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> Sigma:
        """Read what `to_dict` wrote."""
        return cls(*(np.array(record[key], float) for key in ("x", "y", "sigma_px")))


def _cell(lattice: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    cell = np.clip(np.searchsorted(lattice, places) - 1, 0, len(lattice) - 2)
    share = (places - lattice[cell]) / (lattice[cell + 1] - lattice[cell])
    return cell, np.clip(share, 0, 1)


def measure_sigma(
    shape: tuple[int, int],
    labels: Sequence[str],
    chromatic: Chromatic,
    rung: Rung | None = None,
    reference: Mapping[str, Sigma] | None = None,
    behind: Rung | None = None,
    checks: Checks | None = None,
) -> dict[str, Sigma]:
    """Return the sigma of every band of a sensor.

    Parameters
    ----------
    shape : (height, width) of the reference
    labels : sequence of str
        Bands, in the order of `chromatic`.
    chromatic : Chromatic
    rung : Rung, optional
        The base map; the reference's own sensor has none.
    reference : mapping of label to Sigma, optional
        Of the bands that predicted these.
    behind : Rung, optional
        A map that the base map rests on, fitted to more than this sensor saw.
    checks : Checks, optional
        Windows that confirm the base map; away from them it is known the less the farther.
    """
    x, y = (
        np.round(np.linspace(0, n - 1, k), 2) for n, k in zip(shape[::-1], LATTICE, strict=True)
    )
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    common = np.zeros(len(points))
    if rung is not None:
        folds = rung.sigma(points) ** 2
        seen = rung.observations.points
        inside = np.all((points >= seen.min(0)) & (points <= seen.max(0)), 1)
        middle = float(np.median(folds[inside])) if inside.any() else float(np.median(folds))
        common += FOLDS_FACTOR**2 * (LOCAL_SHARE * folds + (1 - LOCAL_SHARE) * middle)
        if checks is not None:
            common += _beyond(rung, points, checks.beyond(points), checks.side, shape)
    if behind is not None:
        common += behind.sigma(points) ** 2
    if reference:
        common += np.mean([one(points) ** 2 for one in reference.values()], 0)
    result = {}
    for band, label in enumerate(labels):
        apart = BANDS_FACTOR**2 * chromatic.variance(band, points)
        values = np.sqrt(common + apart).reshape(LATTICE[::-1])
        result[label] = Sigma(x, y, np.round(values, DECIMALS))
    return result


def _beyond(
    rung: Rung, points: np.ndarray, far: np.ndarray, side: float, shape: tuple[int, int]
) -> np.ndarray:
    """Return the variance that a map has more where nothing confirms it.

    Other models that saw the same and reach elsewhere count in full a window's `side` beyond what is
    checked; what none of them shows grows with the distance.
    """
    far = np.minimum(far, float(np.hypot(*shape)))
    if not far.any():
        return np.zeros(len(points))
    share = np.minimum(far / side, 1.0)
    return np.asarray((share * rung.sigma_beyond(points)) ** 2 + (STRAY * far) ** 2)


def with_colour(known: Sigma, band: int, before: Chromatic, after: Chromatic) -> Sigma:
    """Return the sigma of a band whose colour is known otherwise than it was, all else being as it was.

    Parameters
    ----------
    known : Sigma
    band : int
        Its number in `before` and `after`, in which sigma has its part of the variance.
    """
    points = np.stack(np.meshgrid(known.x, known.y), -1).reshape(-1, 2)
    apart = after.variance(band, points) - before.variance(band, points)
    variance = known.values**2 + BANDS_FACTOR**2 * apart.reshape(known.values.shape)
    return Sigma(known.x, known.y, np.round(np.sqrt(np.maximum(variance, 0.0)), DECIMALS))
