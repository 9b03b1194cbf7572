"""Demosaicing weights for a camera's own channels: the linear estimate of least mean square error.

Malvar's weights are the optimum for red, green and blue of ordinary cameras. Behind other filters, as in a beam-splitter
camera, channels are correlated otherwise: how much, follows from their sensitivities and how smooth spectra of paint are.
"""

from __future__ import annotations

import numpy as np

from levkas.calibration.mosaic import Method, Place, Taps, normalised
from levkas.calibration.templates import CalibrationRefused
from levkas.core.problems import Problem

SMOOTHNESS = 0.9
"""Correlation of reflectances 10 nm apart, of a first-order Markov process [pratt1976]_. Chosen on paintings imaged by a
beam splitter's six channels: with 0.8 or 0.95 the mean of two kinds of spectra is 0.6 or 0.2 dB worse."""
STEP_NM = 10.0
NUGGET = 0.02
"""Noise of a sensel, as a share of the variance by which two sensels a pixel apart differ; ten times more or less changes the
error by less than 0.1 dB."""


def correlate_channels(wavelengths: np.ndarray, sensitivities: np.ndarray) -> np.ndarray:
    """Return how channels are correlated over spectra of reflectance.

    Parameters
    ----------
    wavelengths : ndarray, (n,), nm, ascending
    sensitivities : ndarray, (n, channels)
        Of any scale: a white board is 1 in every channel.

    Returns
    -------
    correlation : ndarray, (channels, channels)

    Raises
    ------
    CalibrationRefused
        E_VALUE where a channel sees nothing.

    Notes
    -----
    WᵀPW, with P a Markov prior of reflectance, ρ^(|λ − λ′|/10 nm), and W the sensitivities over their sums.

    Examples
    --------
    >>> correlate_channels(np.array([500.0, 510.0]), np.eye(2)).round(2).tolist()
    [[1.0, 0.9], [0.9, 1.0]]
    """
    weights = np.maximum(sensitivities, 0) * np.gradient(wavelengths)[:, None]
    if not (weights.sum(0) > 0).all():
        raise CalibrationRefused(
            Problem(
                "E_VALUE",
                "Wiener demosaicing needs the sensitivity of every channel",
                field="sensitivity",
                found=f"channel {int(np.argmin(weights.sum(0))) + 1} is 0 at every wavelength",
                expected="a curve a channel",
            )
        )
    weights /= weights.sum(0)
    apart = np.abs(wavelengths[:, None] - wavelengths) / STEP_NM
    covariance = weights.T @ SMOOTHNESS**apart @ weights
    spread = np.sqrt(np.diag(covariance))
    return np.asarray(covariance / np.outer(spread, spread))


def wiener_method(correlation: np.ndarray) -> Method:
    """Return the stencil method of a camera whose channels are so correlated; `mosaic.normalised` near a border.

    Notes
    -----
    Of all weights over 5 x 5 sensels (of patterns larger than 2 x 2 a period to each side) that are exact on a plane in every
    channel, those of least expected square error, where detail has the covariance R[k, l] · (c − |d|) over a distance of
    d px, plus noise: universal cokriging with a linear variogram. c drops out, for the weights of each channel sum to
    1 or 0.
    """
    known: dict[tuple[int, int, int], Taps] = {}

    def method(place: Place, channel: int) -> Taps:
        rows, columns = place.table.shape
        reach = max(2, rows, columns) if max(rows, columns) > 2 else 2
        if place.channel == channel or not place.holds(reach):
            return normalised(place, channel)
        key = (place.y % rows, place.x % columns, channel)
        if key not in known:
            known[key] = _optimum(place, channel, reach, correlation)
        return known[key]

    return method


def _optimum(place: Place, channel: int, reach: int, correlation: np.ndarray) -> Taps:
    side = np.arange(-reach, reach + 1)
    offset = np.stack(np.meshgrid(side, side, indexing="ij"), -1).reshape(-1, 2)
    which = np.array([place.channel_at(int(dy), int(dx)) for dy, dx in offset])
    apart = np.linalg.norm(offset[:, None] - offset, axis=-1)
    covariance = -apart * correlation[np.ix_(which, which)] + NUGGET * np.eye(len(offset))
    wanted = -np.linalg.norm(offset, axis=1) * correlation[which, channel]
    rules, goals = [], []
    for k in range(len(correlation)):
        here = (which == k).astype(float)
        rules += [here, here * offset[:, 0], here * offset[:, 1]]
        goals += [float(k == channel), 0.0, 0.0]
    plane = np.array(rules)
    system = np.block([[covariance, plane.T], [plane, np.zeros((len(plane), len(plane)))]])
    weight = np.linalg.lstsq(system, np.append(wanted, goals), rcond=1e-12)[0][: len(offset)]
    if not np.allclose(plane @ weight, goals, atol=1e-9):
        return normalised(place, channel)
    return [
        (int(dy), int(dx), float(w), bool(k == channel))
        for (dy, dx), w, k in zip(offset, weight, which, strict=True)
        if abs(w) > 1e-9
    ]
