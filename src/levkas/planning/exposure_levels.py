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

from levkas.calibration.noise_model import Sensor, snr_db
from levkas.core.blocks import block_means

CHANCE = 1e-6
DRIFT = 0.01  # by which the lamp may grow until the object is captured, relative
PEAK = 0.999  # quantile that is taken for the peak: hot sensels and glints lie beyond
BINS = 64
CELL = 16  # pixels a side whose mean separates shading from noise
FINE = 0.5  # counts: noise in the dark below it is lost in rounding
TIGHT = 0.1  # stops: an exposure closer to the advice needs no change
BASE_ISO = 100.0  # a camera's lowest true one


def safe_mean(
    full_well: float,
    *,
    prnu: float = 0.019,
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

    Returns
    -------
    share : float
        0 to 1.

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
    channel : str
    histogram : ndarray, (64,), int64
        From black to saturation.
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
    histogram: np.ndarray
    mean: float
    peak: float
    unevenness: float
    clipped: float
    room: float

    @property
    def stops_left(self) -> float:
        """Stops from the peak to saturation; 0 or less where it is reached."""
        return float(np.log2(self.room / self.peak)) if self.peak > 0 else float("inf")


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
    >>> white = np.full((64, 64), 1064.0)
    >>> found = read_channel(white, black=64.0, saturation=4064.0)
    >>> found.mean, found.stops_left
    (1000.0, 2.0)
    """
    light, room = np.asarray(plane, float) - black, float(saturation) - black
    histogram, _ = np.histogram(light, BINS, (0.0, room))
    cells = block_means(light, *(min(n, CELL) for n in light.shape))
    low, mean, top = (float(q) for q in np.quantile(cells, (0.01, 0.5, 0.99)))
    return Reading(
        channel,
        histogram,
        mean,
        float(np.quantile(light, PEAK)),
        (top - low) / mean if mean > 0 else 0.0,
        float(np.mean(np.asarray(plane) >= saturation)),
        room,
    )


@dataclass(frozen=True)
class Advice:
    """Advice for one channel, or one band of a tunable filter.

    Parameters
    ----------
    reading : Reading
    target : float
        Share of saturation for the mean of a white.
    factor : float
        By which to multiply the time.
    time_s : float or None
        That the factor gives.
    snr_now : float
        Of one raw shot at the white's mean, linear.
    wavelength : float
        nm; NaN where the channel is broad.
    """

    reading: Reading
    target: float
    factor: float
    time_s: float | None
    snr_now: float
    wavelength: float = float("nan")

    @property
    def stops(self) -> float:
        """Stops by which to lengthen the exposure."""
        return float(np.log2(self.factor))


def advise(
    reading: Reading,
    sensor: Sensor,
    *,
    exposure_s: float | None = None,
    wavelength: float = float("nan"),
) -> Advice:
    """Advise which exposure one channel needs.

    Parameters
    ----------
    reading : Reading
        Not clipped.
    sensor : Sensor
        `gain`, `read`, `prnu`; its `dark` counts as noise.
    exposure_s : float, optional
        Of the frame.

    Examples
    --------
    >>> white = read_channel(np.full((64, 64), 1000.0), black=0.0, saturation=4000.0)
    >>> advice = advise(white, Sensor(full_well=44_000.0), exposure_s=0.1)
    >>> round(advice.target, 2), round(advice.time_s, 2)
    (0.91, 0.36)
    """
    full_well = reading.room / sensor.gain
    target = safe_mean(full_well, prnu=sensor.prnu, unevenness=reading.unevenness)
    factor = target * reading.room / max(reading.mean, 1e-9)
    electrons = max(reading.mean, 0.0) / sensor.gain
    now = 10 ** (float(snr_db(electrons, sensor)) / 10)
    time_s = None if exposure_s is None else exposure_s * factor
    return Advice(reading, target, factor, time_s, now, wavelength)


def limiting(advices: Sequence[Advice]) -> tuple[Advice, Advice]:
    """Return the channel that saturates first, and the one with the poorest signal at its time.

    Raises
    ------
    ValueError
        Without a channel.
    """
    if not advices:
        raise ValueError("limiting channel of none")
    return min(advices, key=lambda a: a.factor), min(advices, key=lambda a: a.reading.mean)


def snr_at(advice: Advice, sensor: Sensor, factor: float) -> float:
    """Return the linear SNR of a channel's white at another channel's factor."""
    electrons = max(advice.reading.mean, 0.0) * factor / sensor.gain
    return float(10 ** (snr_db(electrons, sensor) / 10))


def judge_iso(stops: float, *, dark_noise_dn: float, iso: float | None = None) -> str:
    """Advise whether another ISO would help.

    Parameters
    ----------
    stops : float
        That the exposure can still grow.
    dark_noise_dn : float
        Noise without light, counts.
    iso : float, optional
        As set now.

    Notes
    -----
    ISO multiplies counts, not photons: shot noise, which rules wherever paint is lit, stays what it is,
    and a stop of ISO takes a stop of full well away (1.5 dB of Eq. (1) at the white). It helps only
    where the time cannot grow and the noise in the dark is lost in rounding.

    Examples
    --------
    >>> judge_iso(2.0, dark_noise_dn=1.2)
    'No: expose 2.0 stops longer instead; photons lower the noise, ISO only scales it.'
    """
    if iso is not None and iso > BASE_ISO:
        spare = float(np.log2(iso / BASE_ISO))
        return (
            f"Lower it from {iso:g} to {BASE_ISO:g} and expose {spare:.1f} stops longer: that holds "
            f"{2**spare:.0f} times the photons, {1.5 * spare:.1f} dB more at the white."
        )
    if stops > TIGHT:
        return f"No: expose {stops:.1f} stops longer instead; photons lower the noise, ISO only scales it."
    if dark_noise_dn < FINE:
        return (
            f"Only if the time cannot grow and shadows matter: noise in the dark is {dark_noise_dn:.2f} DN "
            "and lost in rounding. At the white it would cost full well."
        )
    return "No: the white fills the sensor; a higher ISO would clip it."
