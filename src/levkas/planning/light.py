"""Evenness, glare, relief and bright field of a lighting, and its sensitivity to changes."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.colour.microfacet import (
    AIR,
    GOLD_INDEX,
    facet_lobe,
    fresnel,
    lobe_reach_deg,
    transmitted,
)
from levkas.planning.setup import Lighting, Lobe, StudioLamp, aim_point, drop, illuminate, light_of
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
    darkening: float
    fields: dict[str, BrightField]
    levers: tuple[str, ...] = field(default=())

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record without the maps."""
        names = (
            "drop", "mean", "absolute", "varnish", "gold", "gold_spread", "texture", "texture_varnished",
            "hidden", "darkening",
        )  # fmt: skip
        return {
            "setup": self.lighting.name,
            **{n: getattr(self, n) for n in names},
            "facets": "GGX",
            "bright_field": {k: dict(v.__dict__) for k, v in self.fields.items()},
            "levers": list(self.levers),
        }


def eye_of(setup: StudioSetup) -> np.ndarray:
    """Return where the first camera stands, mm, or a usual place."""
    cameras = list(setup.cameras.values())
    return cameras[0].place if cameras else np.array([0.0, 0.0, DEFAULT_EYE_MM])


def plan_light(
    setup: StudioSetup, name: str | None = None, *, columns: int = 61, levers: bool = True
) -> LightPlan:
    """Return what a lighting of a setup file does.

    Parameters
    ----------
    setup : StudioSetup
    name : str, optional
        Of the lighting; the first without one.
    columns : int
        Of the maps.
    levers : bool
        Whether to describe what each change of the lamps would do.

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
    plan = LightPlan(
        lighting, surface, lit, shine, drop(lit), float(lit.mean()), absolute,
        _worst(shine.varnish), _worst(shine.gold), _spread(shine.gold),
        shading_contrast(lighting.lamps, thing.relief_slope) if thing.relief_slope else 0.0,
        rough_texture(thing, lighting, eye, sheets, paint=PAINT) if thing.relief_slope else 0.0,
        hidden_share(lighting.lamps, thing.relief_slope), _darkening(thing, lighting),
        bright_fields(thing, lighting, eye),
    )  # fmt: skip
    return replace(plan, levers=tuple(describe_levers(setup, plan))) if levers else plan


def compare_lightings(setup: StudioSetup) -> list[LightPlan]:
    """Return the plan of every lighting of a setup file, without levers."""
    return [plan_light(setup, name, columns=31, levers=False) for name in setup.lightings]


def _worst(values: np.ndarray | None) -> float:
    return 0.0 if values is None else float(np.percentile(values, 95))


def _spread(values: np.ndarray | None) -> float:
    return 1.0 if values is None else float(values.max() / max(values.min(), 1e-12))


def _darkening(thing: StudioObjectKeys, lighting: Lighting) -> float:
    """Light that enters the varnish over that of a 45° lamp: paint reads darker by 1 − this."""
    if thing.varnish is None:
        return 1.0
    got = [transmitted(lamp.angle_deg, thing.varnish.index) for lamp in lighting.lamps]
    weights = [lamp.candela / lamp.distance_mm**2 for lamp in lighting.lamps]
    return float(np.average(got, weights=weights)) / transmitted(45.0, thing.varnish.index)


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


# --- levers -------------------------------------------------------------------------------------


def describe_levers(setup: StudioSetup, plan: LightPlan) -> list[str]:
    """Describe what each change of the lamps would do, in sentences, the strongest on evenness first."""
    rated = []
    for text, lighting in _changes(setup, plan.lighting):
        other = _quick(setup, lighting)
        effects = [
            f"the drop of light goes from {100 * plan.drop:.1f} to {100 * other['drop']:.1f} %"
        ]
        for key, before in (("varnish", plan.varnish), ("gold", plan.gold)):
            if before > 0 and abs(other[key] / before - 1) > 0.08:
                effects.append(f"{key} shines {other[key] / before:.2f} times as much")
        before = plan.texture
        if before > 0 and abs(other["texture"] / before - 1) > 0.15:
            effects.append(f"relief shows {other['texture'] / before:.1f} times as strongly")
        if abs(other["mean"] / plan.mean - 1) > 0.1:
            effects.append(f"the light is {other['mean'] / plan.mean:.2f} times as strong")
        rated.append((abs(other["drop"] - plan.drop), f"{text}: {', '.join(effects)}."))
    return [text for _, text in sorted(rated, key=lambda r: -r[0])]


def _quick(setup: StudioSetup, lighting: Lighting) -> dict[str, float]:
    thing = setup.object
    surface = sample_surface(thing, 21)
    lit = illuminate(lighting.lamps, surface.points, surface.normals)
    shine = glare(thing, surface, lighting, eye_of(setup), setup.bench.sheets)
    texture = shading_contrast(lighting.lamps, thing.relief_slope) if thing.relief_slope else 0.0
    scale = 1.0
    if lighting.illuminance_lx is not None:
        base = illuminate(setup.lighting(lighting.name).lamps, np.zeros(3), np.array([0, 0, 1.0]))
        scale = lighting.illuminance_lx / float(base)
    return {
        "drop": drop(lit), "varnish": _worst(shine.varnish), "gold": _worst(shine.gold),
        "texture": texture, "mean": float(lit.mean()) * scale,
    }  # fmt: skip


def _changes(setup: StudioSetup, lighting: Lighting) -> list[tuple[str, Lighting]]:
    """Return each lever in words and the lighting it leads to."""
    size = setup.object.size_mm
    lamps = lighting.lamps

    def with_lamps(changed: list[StudioLamp]) -> Lighting:
        return replace(lighting, lamps=tuple(changed))

    def turned(lamp: StudioLamp, degrees: float) -> StudioLamp:
        angle = np.radians(min(max(lamp.angle_deg + degrees, 5.0), 86.0))
        foot = lamp.place[:2] / max(float(np.hypot(*lamp.place[:2])), 1e-9)
        place = lamp.distance_mm * np.array([*(np.sin(angle) * foot), np.cos(angle)])
        return _moved(lamp, place)

    changes = [
        ("Lamps a quarter farther away", with_lamps([_moved(x, 1.25 * x.place) for x in lamps])),
        ("Lamps at half the distance", with_lamps([_moved(x, 0.5 * x.place) for x in lamps])),
        ("Lamps 5° lower over the panel", with_lamps([turned(x, 5.0) for x in lamps])),
    ]
    if any(abs(x.angle_deg - 45.0) > 3 for x in lamps):
        changes.append(("Lamps at 45°", with_lamps([turned(x, 45.0 - x.angle_deg) for x in lamps])))
    if len(lamps) == 1:
        other = replace(
            lamps[0], place=lamps[0].place * [-1, -1, 1], axis=lamps[0].axis * [-1, -1, 1]
        )
        changes.append(("A second lamp opposite", with_lamps([lamps[0], other])))
    else:
        changes.append((f"Only {lamps[0].name}", with_lamps([lamps[0]])))
        weaker = replace(lamps[0], candela=0.95 * lamps[0].candela)
        changes.append(("One lamp 5 % weaker", with_lamps([weaker, *lamps[1:]])))
        uneven = [
            replace(x, candela=x.candela * f) for x, f in zip(lamps, (1.4, 0.6), strict=False)
        ]
        changes.append(("Lamps at 70:30, for more relief", with_lamps([*uneven, *lamps[2:]])))
    for aim in ("far edge", "middle"):
        aimed = [_aimed(x, aim_point(aim, x.place, size)) for x in lamps]
        if any(np.abs(a.axis - b.axis).max() > 1e-6 for a, b in zip(aimed, lamps, strict=True)):
            changes.append((f"Aimed at the {aim}", with_lamps(aimed)))
    if all(x.lobe.table is None and x.lobe.exponent > 1 for x in lamps):
        wide = [replace(x, lobe=Lobe(x.lobe.exponent / 2), candela=x.candela / 2) for x in lamps]
        changes.append(("A beam 1.4 times as wide", with_lamps(wide)))
    return changes


def _moved(lamp: StudioLamp, place: np.ndarray) -> StudioLamp:
    """Move a lamp, aimed at the same point of the object's plane."""
    target = lamp.place - lamp.axis * lamp.place[2] / min(lamp.axis[2], -1e-6)
    return _aimed(replace(lamp, place=place), target)


def _aimed(lamp: StudioLamp, target: np.ndarray) -> StudioLamp:
    axis = target - lamp.place
    return replace(lamp, axis=axis / np.linalg.norm(axis))


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
    thing : StudioObjectKeys
    surface : Surface
    lighting : Lighting
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
