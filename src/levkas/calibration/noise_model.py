"""Noise of a sensor in closed form: Eqs. (1) and (2) of [mirhashemi2019]_, doi:10.3390/computation7030047.

A raw value in photo-electrons is, Eq. (2), ``shot · (1 + u) + dark · (1 + v) + read`` with Poisson counts of means e and d,
u ~ N(0, prnu), v ~ N(0, dsnu), read ~ N(0, read).  `simulation.sensing` draws frames from it; here are its moments.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Sensor:
    """Sensor of the noise model; the defaults are the example of [mirhashemi2019]_.

    Parameters
    ----------
    dark : float
        Mean dark current of one exposure, electrons, >= 0.
    read : float
        Standard deviation of the read-out, electrons, >= 0.
    prnu, dsnu : float
        Relative spread of the response and of the dark current from sensel to sensel, >= 0.
    gain : float
        Counts per electron, > 0.
    black : float
        Offset added before quantisation, counts.
    bits : int
        Of the analogue-digital converter.
    full_well : float
        Electrons at which a sensel saturates, > 0.

    Raises
    ------
    ValueError
        Where a spread or the dark current is negative, or gain or full well is not positive.

    Notes
    -----
    Eq. (2) of [mirhashemi2019]_, doi:10.3390/computation7030047.

    Examples
    --------
    >>> Sensor(bits=14).saturation
    16383
    """

    dark: float = 32.0
    read: float = 5.0
    prnu: float = 0.019
    dsnu: float = 0.019
    gain: float = 0.09
    black: float = 0.0
    bits: int = 12
    full_well: float = 45_000.0

    def __post_init__(self) -> None:
        for name in ("dark", "read", "prnu", "dsnu"):
            if getattr(self, name) < 0:
                raise ValueError(f"sensor: {name} must be >= 0, got {getattr(self, name)}")
        for name in ("gain", "full_well"):
            if getattr(self, name) <= 0:
                raise ValueError(f"sensor: {name} must be > 0, got {getattr(self, name)}")

    @property
    def saturation(self) -> int:
        """Highest code of the converter, counts."""
        return 2**self.bits - 1


def noise_variance(exposure: float | np.ndarray, sensor: Sensor) -> np.ndarray:
    """Variance of one raw pixel value.

    Parameters
    ----------
    exposure : float or ndarray, any shape
        Mean photo-electrons e, >= 0.
    sensor : Sensor
        `dark`, `read` in electrons; `prnu`, `dsnu` relative. All are standard deviations.

    Returns
    -------
    variance : ndarray, same shape as `exposure`
        Electrons squared.

    Raises
    ------
    ValueError
        Where an exposure is negative.

    Notes
    -----
    Second moment of Eq. (2) of [mirhashemi2019]_, doi:10.3390/computation7030047, terms independent. Valid below full well.
    Over many sensels; the frames of one sensel share u and v, so that their variance lacks
    ``(prnu·e)² + (dsnu·d)²``.

    Examples
    --------
    >>> float(noise_variance(0.0, Sensor(dark=0, read=5.0)))
    25.0
    """
    e, d = np.asarray(exposure, float), sensor.dark
    if np.any(e < 0):
        raise ValueError(f"an exposure must be >= 0 electrons, got {e.min():g}")
    shot = e * (1 + sensor.prnu**2) + (sensor.prnu * e) ** 2
    dark = d * (1 + sensor.dsnu**2) + (sensor.dsnu * d) ** 2
    return shot + dark + sensor.read**2


def snr_db(
    exposure: float | np.ndarray, sensor: Sensor, *, subtract_dark: bool = True
) -> np.ndarray:
    """Return the signal-to-noise ratio in the dB of Eq. (1), 10·log10(mean/std), half of EMVA 1288's; -inf without signal.

    Without `subtract_dark` the dark current counts as signal, as in Figure 3 of the paper, which starts at +6.26 dB:

    >>> round(float(snr_db(0.0, Sensor(), subtract_dark=False)), 2)
    6.26
    """
    e = np.asarray(exposure, float)
    mean = e if subtract_dark else e + sensor.dark
    with np.errstate(divide="ignore"):
        return 10 * np.log10(mean / np.sqrt(noise_variance(e, sensor)))  # Eq. (1)
