"""Microfacet reflection (GGX) of varnish and gold, as a fraction of a white board's light.

Microfacets of [walter2007]_: ρ = π·D·F·G/(4·cosᵢ·cosₒ), with D either GGX (Trowbridge–Reitz), the
default, or Beckmann. The two agree near the mirror direction and differ a thousandfold far from it,
so a plan says which one it used.
"""

from __future__ import annotations

from functools import cache

import numpy as np

AIR = 1.000277

# nm, n, k of evaporated gold (Johnson and Christy 1972, smoothed as renderers ship it).
GOLD = """
300 1.795 1.92 380 1.6876 1.9182 400 1.6579 1.9560 420 1.6283 1.9516 440 1.5743 1.9114
460 1.4186 1.8431 480 1.1899 1.7965 500 0.8512 1.8868 520 0.5720 2.1838 540 0.3976 2.5549
560 0.3172 2.8375 580 0.2600 2.9477 600 0.2203 3.0000 620 0.1939 3.0600 640 0.1748 3.0900
660 0.1639 3.2750 680 0.1605 3.6326 700 0.1605 3.9637 740 0.1667 4.4794 780 0.1771 4.9142
820 0.1864 5.3250 860 0.2000 5.6715 885 0.2100 5.8800 1000 0.2700 6.8000
"""


@cache
def _gold_table() -> np.ndarray:
    return np.array(GOLD.split(), float).reshape(-1, 3)


def gold_index(wavelength_nm: float = 560.0) -> complex:
    """Return the complex refractive index of gold, 300 to 1000 nm.

    >>> gold_index(560.0)
    (0.3172+2.8375j)
    """
    table = _gold_table()
    n, k = (np.interp(wavelength_nm, table[:, 0], table[:, i]) for i in (1, 2))
    return complex(n, k)


def fresnel(cosine: np.ndarray | float, index: complex) -> tuple[np.ndarray, np.ndarray]:
    """Return the reflectance of an interface for light across (s) and along (p) its plane.

    Parameters
    ----------
    cosine : ndarray
        Of the angle of incidence.
    index : complex
        Refractive index over that outside; imaginary for a metal.

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


def transmitted(angle_deg: float, index: float = 1.5, polariser: str | None = None) -> float:
    """Return the share of light that enters varnish, by Fresnel.

    Light at 70° reads varnished paint 13 % darker than at 45°, and p-light passes 37 % better
    than s-light:

    >>> round(transmitted(70.0) / transmitted(45.0), 3)
    0.873
    >>> round(transmitted(70.0, polariser="p") / transmitted(70.0, polariser="s"), 2)
    1.37
    """
    s, p = fresnel(np.cos(np.radians(angle_deg)), index)
    lost = {"s": s, "p": p, None: (s + p) / 2}[polariser]
    return float(1 - lost)


def facet_lobe(
    tilt: np.ndarray, to_light: np.ndarray, to_eye: np.ndarray, roughness: float,
    *, model: str = "ggx",
) -> np.ndarray:  # fmt: skip
    """Return π·D·G/(4·cosᵢ·cosₒ), what a perfect mirror of that roughness sends to the eye.

    Parameters
    ----------
    tilt, to_light, to_eye : ndarray, same shape
        Cosines of the normal with the half vector, the lamp and the camera.
    roughness : float
        alpha, > 0.
    model : {"ggx", "beckmann"}
        Beckmann's shadowing is the rational fit of [walter2007]_.

    Returns
    -------
    lobe : same shape
        Over a white diffuser under the same irradiance; 0 behind the surface.
    """
    c2 = np.clip(tilt, 1e-6, 1.0) ** 2
    tan2 = (1 - c2) / c2
    a2 = roughness * roughness
    if model == "ggx":
        density = a2 / (np.pi * c2 * c2 * (a2 + tan2) ** 2)
    else:
        density = np.exp(-tan2 / a2) / (np.pi * a2 * c2 * c2)
    light, eye = np.maximum(to_light, 1e-6), np.maximum(to_eye, 1e-6)
    shadow = _shadow(light, roughness, model) * _shadow(eye, roughness, model)
    lit = (to_light > 1e-6) & (to_eye > 1e-6)
    return np.where(lit, np.pi * density * shadow / (4 * light * eye), 0.0)


def _shadow(cosine: np.ndarray, roughness: float, model: str) -> np.ndarray:
    """Return Smith's G1."""
    tan = np.sqrt(np.maximum(1 - cosine**2, 0)) / cosine
    if model == "ggx":
        return 2 / (1 + np.sqrt(1 + (roughness * tan) ** 2))
    b = 1 / np.maximum(roughness * tan, 1e-9)
    return np.where(b < 1.6, (3.535 * b + 2.181 * b * b) / (1 + 2.276 * b + 2.577 * b * b), 1.0)


def specular(
    angle_deg: float, roughness: float, *, index: complex = 1.5 / AIR, tilt_deg: float = 0.0,
    model: str = "ggx",
) -> float:  # fmt: skip
    """Return the specular light of a surface over a white board's, seen along the board's normal.

    Parameters
    ----------
    angle_deg : float
        Of the lamp from the board's normal.
    roughness : float
        alpha of the facets.
    index : complex
        Refractive index over air.
    tilt_deg : float
        The surface's own normal, turned towards the lamp.

    Examples
    --------
    Per cent at 45, 60, 70 and 78° (Mitsuba: 0.5930, 0.3104, 0.2739, 0.3181):

    >>> [round(100 * specular(a, 0.1), 3) for a in (45.0, 60.0, 70.0, 78.0)]
    [0.593, 0.31, 0.274, 0.318]
    """
    light, tilt = np.radians(angle_deg), np.radians(tilt_deg)
    half = light / 2
    s, p = fresnel(np.cos(half), index)
    incident = np.cos(light - tilt)
    lobe = facet_lobe(
        np.cos(half - tilt), np.asarray(incident), np.cos(tilt), roughness, model=model
    )
    return float((s + p) / 2 * lobe * incident / np.cos(light))


def lobe_reach_deg(roughness: float, share: float = 0.01) -> float:
    """Return how far from the mirror direction GGX facets still throw `share` of their peak, degrees.

    The facet's tilt is found where D falls to `share`; light is turned by twice that.

    >>> round(lobe_reach_deg(0.1))
    35
    """
    tilt = np.radians(np.linspace(0, 45, 4501))
    a2 = roughness**2
    density = a2 * a2 / (np.cos(tilt) ** 4 * (a2 + np.tan(tilt) ** 2) ** 2)
    below = np.flatnonzero(density < share)
    return 2 * float(np.degrees(tilt[below[0]])) if len(below) else 90.0
