"""Pigments of icon painting as reflectance spectra, 400–1000 nm, and paints mixed from them.

Each pigment is a few numbers: absorption edges (sigmoids) and bands (Gaussians) placed where the
published spectra of historical pigments have them: the edge of vermilion at 600 nm, the Cu²⁺ band
of azurite and malachite in the near infrared, Co²⁺ of smalt at 540, 590 and 640 nm, Fe³⁺ of the
ochres near 650 and 870 nm. Paints mix by Kubelka and Munk's single constant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

WAVELENGTHS = np.arange(380.0, 1021.0, 2.0)


@dataclass(frozen=True)
class Pigment:
    """Reflectance of a thick layer as floor + edges + bands.

    Parameters
    ----------
    floor : float
        Reflectance where everything is absorbed.
    edges : tuple of (height, centre, width)
        Sigmoids, width in nm to rise from 27 to 73 %, negative heights fall.
    bands : tuple of (height, centre, width)
        Gaussians, width one standard deviation in nm, negative heights absorb.
    """

    floor: float
    edges: tuple[tuple[float, float, float], ...] = ()
    bands: tuple[tuple[float, float, float], ...] = ()

    def reflectance(self, wavelengths: np.ndarray) -> np.ndarray:
        """Return the reflectance at `wavelengths`, nm; within 0.01 and 0.98.

        Examples
        --------
        >>> PIGMENTS["vermilion"].reflectance(np.array([500.0, 700.0])).round(2)
        array([0.06, 0.82])
        """
        w = np.asarray(wavelengths, float)
        value = np.full_like(w, self.floor)
        for height, centre, width in self.edges:
            value += height / (1 + np.exp(-2 * (w - centre) / width))
        for height, centre, width in self.bands:
            value += height * np.exp(-0.5 * ((w - centre) / width) ** 2)
        return value.clip(0.01, 0.98)


PIGMENTS: dict[str, Pigment] = {
    "lead white": Pigment(0.70, ((0.20, 396, 14), (0.04, 520, 90)), ((-0.02, 960, 30),)),
    "gesso": Pigment(0.58, ((0.20, 405, 40), (0.10, 520, 110)), ((-0.02, 975, 30),)),
    "vermilion": Pigment(0.06, ((0.74, 601, 13), (0.06, 720, 80)), ((0.02, 430, 25),)),
    "red lead": Pigment(0.05, ((0.78, 567, 12), (0.08, 700, 80)), ((0.02, 420, 20),)),
    "red ochre": Pigment(
        0.05, ((0.27, 585, 22), (0.24, 715, 45)), ((-0.05, 660, 28), (-0.13, 868, 55))
    ),
    "yellow ochre": Pigment(
        0.07,
        ((0.42, 542, 27), (0.16, 720, 50)),
        ((0.05, 447, 24), (-0.06, 645, 35), (-0.13, 915, 60)),
    ),
    "raw umber": Pigment(0.05, ((0.13, 575, 60), (0.22, 800, 150)), ()),
    "burnt umber": Pigment(0.04, ((0.07, 610, 50), (0.20, 840, 130)), ()),
    "carbon black": Pigment(0.035, ((0.02, 900, 150),), ()),
    "azurite": Pigment(0.07, ((0.30, 975, 55),), ((0.27, 455, 45), (0.09, 520, 42))),
    "malachite": Pigment(0.08, ((0.05, 430, 30), (0.16, 1000, 55)), ((0.28, 528, 52),)),
    "green earth": Pigment(0.10, ((0.10, 880, 60),), ((0.20, 555, 65), (0.05, 820, 60))),
    "smalt": Pigment(
        0.12,
        ((0.62, 691, 15),),
        ((0.36, 440, 42), (0.07, 500, 22), (0.05, 562, 14), (0.04, 612, 12)),
    ),
    "ultramarine": Pigment(0.04, ((0.62, 722, 38),), ((0.42, 452, 36), (-0.02, 600, 40))),
    "indigo": Pigment(0.04, ((0.68, 728, 24), (0.08, 850, 60)), ((0.05, 455, 40),)),
    "lead-tin yellow": Pigment(0.20, ((0.58, 470, 17), (0.10, 540, 60)), ((-0.03, 415, 15),)),
    "madder": Pigment(
        0.05,
        ((0.48, 610, 20), (0.30, 700, 60)),
        ((0.04, 430, 30), (-0.01, 512, 13), (-0.01, 547, 13)),
    ),
    "gold": Pigment(0.36, ((0.46, 517, 24), (0.13, 600, 70)), ((0.02, 400, 30),)),
    "wood": Pigment(0.10, ((0.22, 560, 70), (0.30, 720, 110)), ((-0.04, 975, 25),)),
}

PAINTS: dict[str, dict[str, float]] = {
    "gesso": {"gesso": 1},
    "wood": {"wood": 1},
    "gold": {"gold": 1},
    "white": {"lead white": 1},
    "black": {"carbon black": 1},
    "vermilion": {"vermilion": 1},
    "red ochre": {"red ochre": 1},
    "ochre": {"yellow ochre": 1},
    "ochre light": {"yellow ochre": 0.45, "lead white": 0.55},
    "umber": {"burnt umber": 1},
    "umber light": {"raw umber": 0.35, "lead white": 0.65},
    "sankir": {"yellow ochre": 0.50, "green earth": 0.25, "burnt umber": 0.25},
    "flesh": {"yellow ochre": 0.30, "lead white": 0.60, "vermilion": 0.10},
    "azurite": {"azurite": 1},
    "azurite light": {"azurite": 0.35, "lead white": 0.65},
    "azurite dark": {"azurite": 0.75, "carbon black": 0.08, "indigo": 0.17},
    "ultramarine": {"ultramarine": 0.8, "lead white": 0.2},
    "smalt": {"smalt": 1},
    "indigo": {"indigo": 0.85, "lead white": 0.15},
    "malachite": {"malachite": 1},
    "malachite light": {"malachite": 0.45, "lead white": 0.55},
    "green earth": {"green earth": 1},
    "madder": {"madder": 1},
    "madder dark": {"madder": 0.85, "carbon black": 0.06, "red ochre": 0.09},
    "pink": {"madder": 0.35, "lead white": 0.65},
    "red lead": {"red lead": 1},
    "yellow": {"lead-tin yellow": 1},
}

FAMILIES: dict[str, tuple[str, ...]] = {
    "blue": ("azurite", "ultramarine", "smalt", "indigo", "Prussian blue", "cobalt blue"),
    "red": ("vermilion", "red lead", "madder", "cadmium red"),
    "green": ("malachite", "green earth", "verdigris", "viridian"),
    "yellow": ("lead-tin yellow", "yellow ochre", "orpiment", "Naples yellow"),
}
"""Pigments of like colour, of which a workshop has one or another."""

WORKSHOP_PIGMENTS: dict[str, Pigment] = {
    "Prussian blue": Pigment(0.03, ((0.06, 900, 120),), ((0.20, 455, 40),)),
    "cobalt blue": Pigment(0.08, ((0.55, 695, 18),), ((0.42, 455, 38), (0.06, 565, 14))),
    "cadmium red": Pigment(0.05, ((0.80, 618, 16), (0.05, 720, 60)), ()),
    "verdigris": Pigment(0.04, ((0.03, 900, 80),), ((0.36, 500, 42),)),
    "viridian": Pigment(0.04, ((0.40, 735, 28),), ((0.26, 512, 34),)),
    "orpiment": Pigment(0.10, ((0.66, 500, 16), (0.08, 600, 60)), ()),
    "Naples yellow": Pigment(0.22, ((0.46, 505, 28), (0.10, 580, 60)), ()),
}
"""What the first workshop's `PIGMENTS` lack, by the edges and bands of their published spectra."""

REPLACED, SHIFT_NM, STRENGTH = 0.5, 6.0, 0.12
"""Chance that a pigment is another of its family; spread of edges, nm; relative spread of heights."""


def draw_pigments(rng: np.random.Generator) -> dict[str, Pigment]:
    """Draw the pigments of another workshop: some replaced by their like, all of another grind.

    Returns
    -------
    pigments : dict
        Keys of `PIGMENTS`; gold stays gold.

    Examples
    --------
    >>> drawn = draw_pigments(np.random.default_rng(1))
    >>> list(drawn) == list(PIGMENTS), drawn["gold"] == PIGMENTS["gold"]
    (True, True)
    """
    known = PIGMENTS | WORKSHOP_PIGMENTS
    drawn = {}
    for name, pigment in PIGMENTS.items():
        family = next((f for f in FAMILIES.values() if name in f), (name,))
        other = family[rng.integers(len(family))] if rng.random() < REPLACED else name
        drawn[name] = pigment if name == "gold" else _ground_anew(known[other], rng)
    return drawn


def _ground_anew(pigment: Pigment, rng: np.random.Generator) -> Pigment:
    """Shift edges and bands of a pigment, and scale their heights and widths."""

    def moved(part: tuple[float, float, float]) -> tuple[float, float, float]:
        height, centre, width = part
        scale, shift, stretch = rng.normal(0, (STRENGTH, SHIFT_NM, STRENGTH)).tolist()
        return height * (1 + scale), centre + shift, width * max(0.5, 1 + stretch)

    edges, bands = (
        tuple(moved(part) for part in parts) for parts in (pigment.edges, pigment.bands)
    )
    return Pigment(pigment.floor * (1 + 0.2 * float(rng.uniform(-1, 1))), edges, bands)


def mix(recipe: Mapping[str, float], spectra: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the reflectance of a paint, Kubelka–Munk, single constant.

    Parameters
    ----------
    recipe : mapping of str to float
        Shares of pigments, normalised to sum 1.
    spectra : mapping of str to ndarray, (n,)
        Reflectance of each pigment in a thick layer, in (0, 1].

    Returns
    -------
    reflectance : ndarray, (n,)

    Examples
    --------
    >>> mix({"a": 3, "b": 1}, {"a": np.array([0.9]), "b": np.array([0.1])}).round(3)
    array([0.265])
    """
    total = sum(recipe.values())
    absorbed = sum(
        share / total * (1 - spectra[name]) ** 2 / (2 * spectra[name])
        for name, share in recipe.items()
    )
    k = np.asarray(absorbed)
    return 1 + k - np.sqrt(k * k + 2 * k)


def paint_spectra(
    paints: Sequence[str],
    wavelengths: np.ndarray,
    *,
    pigments: Mapping[str, Pigment] = PIGMENTS,
) -> np.ndarray:
    """Return the reflectance of paints of `PAINTS`.

    Parameters
    ----------
    wavelengths : ndarray, (n,), nm
    pigments : mapping
        Of the painting's workshop, keys as of `PIGMENTS`.

    Returns
    -------
    reflectance : ndarray, (paints, n)
    """
    spectra = {name: p.reflectance(wavelengths) for name, p in pigments.items()}
    return np.stack([mix(PAINTS[name], spectra) for name in paints])
