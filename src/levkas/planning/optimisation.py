"""The angle of a lighting's lamps that compromises best between glare, evenness, relief and light.

Cost = Σ weight · (value / tolerance)²: a criterion at its tolerance costs its weight, one at half of it
a quarter. Tolerances and weights are fixed for every object.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.planning.light import eye_of, glare
from levkas.planning.setup import Lighting, drop, illuminate, lamp_place
from levkas.planning.surface import Surface, hidden_share, sample_surface, shading_contrast

if TYPE_CHECKING:
    from levkas.planning.setup import StudioSetup

TOLERANCES = {
    "varnish": 0.10,
    "gold": 0.35,
    "drop": 0.10,
    "hidden": 0.05,
    "flat": 1.0,
    "light": 1.0,
}
"""What costs as much as its weight: veil of the varnish over the darkest paint; gold over white; drop
of the light over the object; relief that a lamp cannot reach; `LEAST_CONTRAST` over the contrast of the
relief; `LEAST_LIGHT` over the light."""
WEIGHTS = {"varnish": 2.0, "gold": 2.0, "drop": 1.0, "hidden": 1.0, "flat": 1.0, "light": 1.0}
"""Glare counts twice: unevenness is repaired by the flat field and want of light by time, but what
glare hides nothing brings back."""
MEANINGS = {
    "varnish": "glare of the varnish",
    "gold": "glare of the gold",
    "drop": "unevenness",
    "hidden": "exaggerated relief",
    "flat": "flattened relief",
    "light": "want of light",
}
LEAST_CONTRAST = 0.01
LEAST_LIGHT = 0.04
"""cos(angle)/distance² of each lamp, 1/m²; 70° at 2.1 m has 0.078."""
WORST = 8.0
"""Exponent of the mean that stands for "the worst places"."""
ANGLES = np.arange(25.0, 86.1, 0.5)
"""From the object's normal, degrees, that are tried."""


@dataclass(frozen=True)
class Optimum:
    """The best angle of the lamps, from the object's normal, their distances, azimuths and aims left as they are.

    Parameters
    ----------
    values : dict of str to float
        What each criterion measures there.
    """

    angle_deg: float
    cost: float
    values: dict[str, float]

    @property
    def criteria(self) -> dict[str, float]:
        """Value over tolerance of each criterion; 1 is just tolerated."""
        return {k: v / TOLERANCES[k] for k, v in self.values.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "angle_deg": self.angle_deg,
            "cost": self.cost,
            "values": self.values,
            "over_tolerance": self.criteria,
            "weights": WEIGHTS,
            "tolerances": TOLERANCES,
        }


def turned(lighting: Lighting, angle_deg: float) -> Lighting:
    """Return a lighting whose lamps stand at another angle from the object's normal, and aim at the places they aimed at."""
    lamps = []
    for lamp in lighting.lamps:
        aim = lamp.place - lamp.axis * lamp.place[2] / min(lamp.axis[2], -1e-6)
        place = lamp_place(angle_deg, lamp.azimuth_deg, lamp.distance_mm)
        axis = (aim - place) / np.linalg.norm(aim - place)
        lamps.append(replace(lamp, place=place, axis=axis))
    return replace(lighting, lamps=tuple(lamps))


def criteria_of(setup: StudioSetup, lighting: Lighting) -> dict[str, float]:
    """Return what each criterion measures of a lighting."""
    thing, lamps = setup.object, lighting.lamps
    surface = sample_surface(thing, 9)
    lit = illuminate(lamps, surface.points, surface.normals)
    flux = [np.cos(np.radians(x.angle_deg)) / (x.distance_mm / 1000) ** 2 for x in lamps]
    some = thing.relief_slope > 0
    contrast = shading_contrast(lamps, thing.relief_slope) if some else np.inf
    return {
        **_shine(setup, lighting, surface),
        "drop": drop(lit),
        "hidden": hidden_share(lamps, thing.relief_slope),
        "flat": LEAST_CONTRAST / max(contrast, 1e-6),
        "light": LEAST_LIGHT / max(float(np.mean(flux)), 1e-9),
    }


def _shine(setup: StudioSetup, lighting: Lighting, surface: Surface) -> dict[str, float]:
    """Return glare of both coats where it is worst: veil over the darkest paint, gold over white.

    The ground's unevenness turns every normal along the line through the lamps, to either side.
    """
    azimuth = np.radians(lighting.lamps[0].azimuth_deg)
    lean = np.tan(np.radians(setup.object.unevenness_deg))
    aside = lean * np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
    found: dict[str, list[np.ndarray]] = {"varnish": [], "gold": []}
    for side in (aside, -aside):
        normals = surface.normals + side
        normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
        leaning = replace(surface, normals=normals)
        maps = glare(setup.object, leaning, lighting, eye_of(setup), setup.bench.sheets)
        for name, values in found.items():
            if (shine := getattr(maps, name)) is not None:
                values.append(shine)
    worst = {
        name: float(np.mean(np.array(values) ** WORST) ** (1 / WORST)) if values else 0.0
        for name, values in found.items()
    }
    return worst | {"varnish": worst["varnish"] / setup.object.darkest}


def cost_of(values: dict[str, float], weights: dict[str, float] | None = None) -> float:
    """Return Σ weight · (value / tolerance)²."""
    weights = weights or WEIGHTS
    return sum(weights[k] * (v / TOLERANCES[k]) ** 2 for k, v in values.items())


def optimise(
    setup: StudioSetup, lighting: Lighting | None = None, *, weights: dict[str, float] | None = None
) -> Optimum:
    """Return the angle of least cost for the lamps of a lighting, to half a degree; the first lighting without one.

    `weights` are others, to see how much hangs on them.
    """
    lighting = setup.lighting() if lighting is None else lighting
    tried = [criteria_of(setup, turned(lighting, float(angle))) for angle in ANGLES]
    costs = [cost_of(values, weights) for values in tried]
    best = int(np.argmin(costs))
    return Optimum(float(ANGLES[best]), costs[best], tried[best])
