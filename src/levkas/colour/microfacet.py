"""Microfacet reflection (GGX) of varnish and gold, as a fraction of a white board's light.

Microfacets of [walter2007]_: ρ = π·D·F·G/(4·cosᵢ·cosₒ), with D of GGX (Trowbridge–Reitz). Beckmann's
agrees with it near the mirror direction and is a thousand times darker far from it.
"""

from __future__ import annotations

import numpy as np

AIR = 1.000277

GOLD_INDEX = 0.3172 + 2.8375j
"""Refractive index of evaporated gold at 560 nm (Johnson and Christy 1972, 10.1103/PhysRevB.6.4370)."""


def fresnel(cosine: np.ndarray | float, index: complex) -> tuple[np.ndarray, np.ndarray]:
    """Return the reflectance of an interface for light across (s) and along (p) its plane.

    Examples
    --------
    >>> [round(float(r), 4) for r in fresnel(1.0, 1.5)]
    [0.04, 0.04]
    """
    c = np.clip(np.asarray(cosine, float), 0.0, 1.0)
    inside = np.sqrt(index**2 - (1 - c * c) + 0j)
    across = (c - inside) / (c + inside)
    along = (index**2 * c - inside) / (index**2 * c + inside)
    return np.abs(across) ** 2, np.abs(along) ** 2


def transmitted(angle_deg: float, index: float = 1.5) -> float:
    """Return the share of unpolarised light that enters varnish at an angle, by Fresnel.

    Light at 70° reads varnished paint 13 % darker than at 45°:

    >>> round(transmitted(70.0) / transmitted(45.0), 3)
    0.873
    """
    c = np.cos(np.radians(angle_deg))
    t = np.sqrt(1 - (1 - c * c) / index**2)
    across, along = (c - index * t) / (c + index * t), (t - index * c) / (t + index * c)
    return float(1 - 0.5 * (across**2 + along**2))


def facet_lobe(
    tilt: np.ndarray, to_light: np.ndarray, to_eye: np.ndarray, roughness: float
) -> np.ndarray:
    """Return π·D·G/(4·cosᵢ·cosₒ), what a perfect mirror of that roughness sends to the eye.

    Parameters
    ----------
    tilt, to_light, to_eye : ndarray, same shape
        Cosines of the normal with the half vector, the lamp and the camera.
    roughness : float
        alpha, > 0.

    Returns
    -------
    lobe : same shape
        Over a white diffuser under the same irradiance; 0 behind the surface.
    """
    c2 = np.clip(tilt, 1e-6, 1.0) ** 2
    tan2 = (1 - c2) / c2
    a2 = roughness * roughness
    density = a2 / (np.pi * c2 * c2 * (a2 + tan2) ** 2)
    light, eye = np.maximum(to_light, 1e-6), np.maximum(to_eye, 1e-6)
    shadow = _shadow(light, roughness) * _shadow(eye, roughness)
    lit = (to_light > 1e-6) & (to_eye > 1e-6)
    return np.where(lit, np.pi * density * shadow / (4 * light * eye), 0.0)


def _shadow(cosine: np.ndarray, roughness: float) -> np.ndarray:
    """Return Smith's G1."""
    tan = np.sqrt(np.maximum(1 - cosine**2, 0)) / cosine
    return 2 / (1 + np.sqrt(1 + (roughness * tan) ** 2))


def lobe_reach_deg(roughness: float) -> float:
    """Return how far from the mirror direction GGX facets still throw 1 % of their peak, degrees.

    The facet's tilt is found where D falls to 1 %; light is turned by twice that.

    >>> round(lobe_reach_deg(0.1))
    35
    """
    tilt = np.radians(np.linspace(0, 45, 4501))
    a2 = roughness**2
    density = a2 * a2 / (np.cos(tilt) ** 4 * (a2 + np.tan(tilt) ** 2) ** 2)
    below = np.flatnonzero(density < 0.01)
    return 2 * float(np.degrees(tilt[below[0]])) if len(below) else 90.0
