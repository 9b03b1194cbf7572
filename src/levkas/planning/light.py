"""Evenness, glare, relief and bright field of a lighting."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.colour.microfacet import (
    AIR,
    GOLD_INDEX,
    facet_lobe,
    fresnel,
    lobe_reach_deg,
)
from levkas.planning.setup import Lighting, drop, illuminate, light_of
from levkas.planning.surface import (
    Surface,
    hidden_share,
    sample_surface,
    shading_contrast,
    slope_nodes,
    wall_deg,
)

if TYPE_CHECKING:
    from levkas.planning.setup import StudioSetup
    from levkas.planning.tables import Sheets, StudioObjectKeys

DEFAULT_EYE_MM = 1900.0
PAINT = 0.2
"""Reflectance of the paint that `texture_varnished` is of."""


@dataclass(frozen=True)
class BrightField:
    """Directions from which a lamp would be mirrored into the camera, in one plane through the normal.

    Angles are degrees from the object's normal, both sides; `facets` adds the reach of the varnish's
    (or gold's) facets down to 1 % of their peak.
    """

    mirror: tuple[float, float]
    facets: tuple[float, float]
    walls: tuple[float, float] | None
    margin: float


@dataclass(frozen=True, eq=False)
class LightPlan:
    """Everything about one lighting; maps are (rows, columns) over `surface`."""

    lighting: Lighting
    surface: Surface
    illuminance: np.ndarray
    glare: GlareMaps
    drop: float
    mean: float
    absolute: bool
    varnish: float
    gold: float
    gold_spread: float
    texture: float
    texture_varnished: float
    hidden: float
    fields: dict[str, BrightField]

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record without the maps."""
        names = (
            "drop", "mean", "absolute", "varnish", "gold", "gold_spread", "texture", "texture_varnished",
            "hidden",
        )  # fmt: skip
        return {
            "setup": self.lighting.name,
            **{n: getattr(self, n) for n in names},
            "facets": "GGX",
            "bright_field": {k: dict(v.__dict__) for k, v in self.fields.items()},
        }


def eye_of(setup: StudioSetup) -> np.ndarray:
    """Return where the first camera stands, mm, or a usual place."""
    cameras = list(setup.cameras.values())
    return cameras[0].place if cameras else np.array([0.0, 0.0, DEFAULT_EYE_MM])


def plan_light(setup: StudioSetup, name: str | None = None, *, columns: int = 61) -> LightPlan:
    """Return what a lighting of a setup file does.

    Parameters
    ----------
    name : str, optional
        Of the lighting; the first without one.
    columns : int
        Of the maps.

    Raises
    ------
    PlanRefused
        Where there is no such lighting.
    """
    lighting = setup.lighting(name)
    thing, eye, sheets = setup.object, eye_of(setup), setup.bench.sheets
    surface = sample_surface(thing, columns)
    lit = illuminate(lighting.lamps, surface.points, surface.normals)
    absolute = all(lamp.measured for lamp in lighting.lamps)
    if lighting.illuminance_lx is not None:
        middle = lit[lit.shape[0] // 2, lit.shape[1] // 2]
        lit, absolute = lit * lighting.illuminance_lx / middle, True
    shine = glare(thing, surface, lighting, eye, sheets)
    return LightPlan(
        lighting, surface, lit, shine, drop(lit), float(lit.mean()), absolute,
        _worst(shine.varnish), _worst(shine.gold), _spread(shine.gold),
        shading_contrast(lighting.lamps, thing.relief_slope) if thing.relief_slope else 0.0,
        rough_texture(thing, lighting, eye, sheets, paint=PAINT) if thing.relief_slope else 0.0,
        hidden_share(lighting.lamps, thing.relief_slope),
        bright_fields(thing, lighting, eye),
    )  # fmt: skip


def compare_lightings(setup: StudioSetup) -> list[LightPlan]:
    """Return the plan of every lighting of a setup file."""
    return [plan_light(setup, name, columns=31) for name in setup.lightings]


def _worst(values: np.ndarray | None) -> float:
    return 0.0 if values is None else float(np.percentile(values, 95))


def _spread(values: np.ndarray | None) -> float:
    return 1.0 if values is None else float(values.max() / max(values.min(), 1e-12))


# --- bright field -------------------------------------------------------------------------------


def bright_fields(
    thing: StudioObjectKeys, lighting: Lighting, eye: np.ndarray
) -> dict[str, BrightField]:
    """Return the family of angles in the two planes along the object's width and height.

    The margin is that of the lamp nearest to the bright field; infinite where no lamp lies within
    30° of that plane.
    """
    surface = sample_surface(thing, 31)
    view = eye - surface.points
    view /= np.linalg.norm(view, axis=-1, keepdims=True)
    n = surface.normals
    mirror = 2 * (n * view).sum(-1, keepdims=True) * n - view
    coats = [c.roughness for c in (thing.varnish, thing.gold) if c is not None]
    reach = lobe_reach_deg(min(coats)) if coats else 0.0
    found = {}
    for axis, name in ((0, "width"), (1, "height")):
        angles = np.degrees(np.arctan2(mirror[..., axis], mirror[..., 2]))
        low, high = float(angles.min()), float(angles.max())
        walls = None
        if thing.recess_mm:
            twice = 2 * wall_deg(thing)
            walls = (twice + low, twice + high)
        wide = (low - reach, high + reach)
        found[name] = BrightField((low, high), wide, walls, _margin(lighting, axis, wide))
    return found


def _margin(lighting: Lighting, axis: int, wide: tuple[float, float]) -> float:
    margins = [np.inf]
    for lamp in lighting.lamps:
        x, y, z = lamp.place
        along, aside = (x, y) if axis == 0 else (y, x)
        if abs(aside) <= 0.58 * abs(along) or np.hypot(x, y) < 0.05 * z:
            angle = np.degrees(np.arctan2(along, z))
            margins.append(float(angle - wide[1] if angle > 0 else wide[0] - angle))
    return float(min(margins))


@dataclass(frozen=True, eq=False)
class GlareMaps:
    """Specular light over a white board's at the same place, arrays (rows, columns) or None."""

    varnish: np.ndarray | None
    gold: np.ndarray | None


def glare(
    thing: StudioObjectKeys, surface: Surface, lighting: Lighting, eye: np.ndarray, sheets: Sheets
) -> GlareMaps:
    """Return the glare of varnish and gold over an object.

    Parameters
    ----------
    eye : ndarray, (3,)
        Where the camera stands, mm.
    sheets : Sheets
        Under crossed polarisers specular light is left as their leak.

    Returns
    -------
    glare : GlareMaps
        1 is as bright as white.
    """
    flat = np.zeros_like(surface.normals)
    flat[..., 2] = 1
    white = illuminate(lighting.lamps, surface.points, flat)
    found: list[np.ndarray | None] = []
    for coat, index in ((thing.varnish, None), (thing.gold, GOLD_INDEX)):
        if coat is None:
            found.append(None)
            continue
        n = coat.index / AIR if index is None else index  # type: ignore[union-attr]
        light = _specular(surface, lighting, eye, coat.roughness, n)
        if lighting.crossed:
            light = light * sheets.leak * 2  # the diffuse light loses half, this all but the leak
        found.append(light / np.maximum(white, 1e-30))
    return GlareMaps(*found)


def _specular(
    surface: Surface, lighting: Lighting, eye: np.ndarray, roughness: float, index: complex
) -> np.ndarray:
    """Return π times the radiance of facets, in the unit of the irradiance."""
    n = surface.normals
    view = eye - surface.points
    view = view / np.linalg.norm(view, axis=-1, keepdims=True)
    to_eye = (n * view).sum(-1)
    total = np.zeros(to_eye.shape)
    for lamp in lighting.lamps:
        strength, towards = light_of(lamp, surface.points)
        half = towards + view
        half = half / np.linalg.norm(half, axis=-1, keepdims=True)
        incident = (n * towards).sum(-1)
        s, p = fresnel((half * towards).sum(-1), index)
        mirrored = {"s": s, "p": p, None: (s + p) / 2}[lamp.polariser]
        emergent = np.broadcast_to(to_eye, incident.shape)
        lobe = facet_lobe((n * half).sum(-1), incident, emergent, roughness)
        total = total + (mirrored * lobe * np.maximum(incident, 0) * strength).sum(0)
    return total


def rough_texture(
    thing: StudioObjectKeys,
    lighting: Lighting,
    eye: np.ndarray,
    sheets: Sheets,
    *,
    paint: float = 0.2,
) -> float:
    """Return the contrast of relief at the object's middle, specular light of the varnish included.

    Slopes are normal with the object's `relief_slope`; the contrast is spread over mean of what the
    camera gets from paint of reflectance `paint`.
    """
    slopes, weights = slope_nodes(thing.relief_slope)
    normals = np.concatenate([-slopes, np.ones((len(slopes), 1))], 1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    spots = Surface(np.zeros(1), np.zeros(1), np.zeros_like(normals), normals)
    shading = illuminate(lighting.lamps, spots.points, normals)
    total = paint * shading
    if thing.varnish is not None:
        index = thing.varnish.index / AIR
        mirror = _specular(spots, lighting, eye, thing.varnish.roughness, index)
        total = total + mirror * (2 * sheets.leak if lighting.crossed else 1.0)
    mean = weights @ total
    return float(np.sqrt(weights @ (total - mean) ** 2) / mean)
