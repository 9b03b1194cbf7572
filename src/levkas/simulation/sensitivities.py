"""Sensitivities: light, silicon, dyes and filters behind the bands of the simulated cameras."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.simulation.pigments import WAVELENGTHS

PEAK = 0.85


@dataclass(frozen=True, eq=False)
class BandModel:
    """One channel.

    Parameters
    ----------
    label : str
    response : ndarray, (n,)
        Light times sensitivity at `pigments.WAVELENGTHS`, of sum 1.
    level : float
        Where the brightest white lies, as a share of the sensor's range.
    wavelength : float
        Nominal, nm; the centroid of the response if left out.
    """

    label: str
    response: np.ndarray
    level: float
    wavelength: float = float("nan")

    @property
    def centre(self) -> float:
        """Wavelength at which the lens acts, nm."""
        if np.isfinite(self.wavelength):
            return self.wavelength
        return float(WAVELENGTHS @ self.response)


def bell(centre: float, width: float) -> np.ndarray:
    """Return a Gaussian of peak 1 at `pigments.WAVELENGTHS`; width one standard deviation, nm."""
    return np.exp(-0.5 * ((WAVELENGTHS - centre) / width) ** 2)


def _lamp_light() -> np.ndarray:
    """Halogen behind a D50 simulator: flat, falling into the near infrared."""
    return (0.35 + 0.65 / (1 + np.exp(-(WAVELENGTHS - 430) / 22))) * (
        0.30 + 0.70 / (1 + np.exp((WAVELENGTHS - 780) / 55))
    )


def silicon() -> np.ndarray:
    """Quantum efficiency of a CCD."""
    return (0.25 + 0.75 * bell(560, 130)) / (1 + np.exp((WAVELENGTHS - 935) / 40))


def _responses(sensitivities: list[np.ndarray], light: np.ndarray) -> list[np.ndarray]:
    return [s * light / (s * light).sum() for s in sensitivities]


def broad(labels: str, shapes: list[np.ndarray], groups: tuple[int, ...]) -> tuple[BandModel, ...]:
    """Return broad bands, the brightest of each sensor exposed to the peak."""
    light = _lamp_light()
    totals = np.array([(s * light).sum() for s in shapes])
    levels = np.concatenate(
        [PEAK * part / part.max() for part in np.split(totals, np.cumsum(groups)[:-1])]
    )
    return tuple(
        BandModel(*b) for b in zip(labels.split(), _responses(shapes, light), levels, strict=True)
    )


def narrow(
    wavelengths: np.ndarray, fwhm: float, transmission: np.ndarray, *, one_exposure: bool
) -> tuple[BandModel, ...]:
    """Return bands of a filter or a spectrograph; an own exposure each, up to six-fold, or one."""
    power = _lamp_light() * silicon() * transmission
    shapes = [bell(w, fwhm / 2.355) for w in wavelengths]
    totals = np.array([(s * power).sum() for s in shapes])
    share = totals / totals.max()
    levels = PEAK * (share if one_exposure else np.minimum(1.0, 6 * share))
    return tuple(
        BandModel(f"{w:g} nm", r, float(v), float(w))
        for w, r, v in zip(wavelengths, _responses(shapes, power), levels, strict=True)
    )


def response_table(bands: Sequence[BandModel]) -> tuple[list[str], np.ndarray]:
    """Return the labels and sensitivities, (wavelengths, bands), each with a peak of 1.

    The light is divided out of what `BandModel.response` holds.
    """
    shapes = np.stack([b.response / _lamp_light() for b in bands], 1)
    return [b.label for b in bands], shapes / shapes.max(0)
