"""Exposure to the right: the brightest mean level at which clipping stays improbable.

The mean of an even white may stand at f of saturation when its brightest pixel must not clip with more
than a given chance: f = 1/[(1 + z·√(1/(f·FW) + PRNU²))·(1 + U/2)·(1 + drift)].  With the sensor of
[mirhashemi2019]_, light that varies by 10 % over the field and a lamp that drifts by 1 %, f is 0.86: the
paper's 85 %.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.core.transpose import block_means

CHANCE = 1e-6
DRIFT = 0.01  # by which the lamp may grow until the object is captured, relative
FULL_WELL, PRNU = (
    15_000.0,
    0.019,
)  # e⁻; the paper's sensors: those of others hold more, and differ less
PEAK = 0.999  # quantile that is taken for the peak: hot sensels and glints lie beyond
CELL = 16  # pixels a side whose mean separates shading from noise


def safe_mean(
    full_well: float = FULL_WELL,
    *,
    prnu: float = PRNU,
    unevenness: float = 0.1,
    chance: float = CHANCE,
) -> float:
    """Return the share of saturation at which the mean of a white may stand.

    Parameters
    ----------
    full_well : float
        Electrons at saturation, > 0.
    prnu : float
        Relative spread of the response.
    unevenness : float
        Of the light over the field: (brightest − darkest)/mean.
    chance : float
        That a pixel at the brightest place saturates.

    Examples
    --------
    >>> [round(safe_mean(electrons), 3) for electrons in (15_000, 45_000)]
    [0.858, 0.862]
    """
    from scipy.special import ndtri

    z, share = -float(ndtri(chance)), 0.85
    for _ in range(50):
        noise = np.sqrt(1 / (share * full_well) + prnu**2)
        share = 1 / ((1 + z * noise) * (1 + unevenness / 2) * (1 + DRIFT))
    return float(share)


@dataclass(frozen=True)
class Reading:
    """Exposure of one channel of a frame; counts above black.

    Parameters
    ----------
    mean, peak : float
        Of the middle of the field's brightest half, and the 99.9th percentile.
    unevenness : float
        (brightest − darkest)/mean of the light over the field, noise averaged out.
    clipped : float
        Share of pixels at saturation.
    room : float
        Saturation above black.
    """

    channel: str
    mean: float
    peak: float
    unevenness: float
    clipped: float
    room: float

    @property
    def stops_left(self) -> float:
        """Stops from the peak to saturation; 0 or less where it is reached."""
        return float(np.log2(self.room / self.peak)) if self.peak > 0 else float("inf")

    @property
    def target(self) -> float:
        """Share of saturation for the mean of a white."""
        return safe_mean(unevenness=self.unevenness)

    @property
    def factor(self) -> float:
        """By which to multiply the time."""
        return self.target * self.room / max(self.mean, 1e-9)


def read_channel(
    plane: np.ndarray, *, black: float, saturation: float, channel: str = ""
) -> Reading:
    """Read one channel of one frame.

    Parameters
    ----------
    plane : ndarray, (h, w)
        Raw counts of one colour phase.
    black, saturation : float
        Counts.

    Examples
    --------
    >>> found = read_channel(np.full((64, 64), 1064.0), black=64.0, saturation=4064.0)
    >>> found.mean, found.stops_left, round(found.target, 2), round(found.factor, 1)
    (1000.0, 2.0, 0.9, 3.6)
    """
    light, room = np.asarray(plane, float) - black, float(saturation) - black
    cells = block_means(light, *(min(n, CELL) for n in light.shape))
    low, mean, top = (float(q) for q in np.quantile(cells, (0.01, 0.5, 0.99)))
    return Reading(
        channel,
        mean,
        float(np.quantile(light, PEAK)),
        (top - low) / mean if mean > 0 else 0.0,
        float(np.mean(np.asarray(plane) >= saturation)),
        room,
    )


def limiting(readings: Sequence[Reading]) -> tuple[Reading, Reading]:
    """Return the channel that saturates first, and the one with the least light."""
    return min(readings, key=lambda r: r.factor), min(readings, key=lambda r: r.mean)
