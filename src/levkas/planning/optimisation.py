"""Optimization of a pair of lamps.

Cost = Σ weight · (value / tolerance)²: a criterion at its tolerance costs its weight, one at half of it
a quarter. Tolerances and weights are `criteria.TOLERANCES` and `criteria.WEIGHTS`, fixed for every
object.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import erfc, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.colour.microfacet import AIR, GOLD_INDEX, facet_lobe, fresnel
from levkas.planning.light import eye_of
from levkas.planning.setup import Lighting, Lobe, StudioLamp, lamp_place, lobe_exponent
from levkas.planning.surface import sample_surface, slope_nodes

if TYPE_CHECKING:
    from levkas.planning.setup import Lighting, StudioSetup
    from levkas.planning.tables import Room, StudioObjectKeys


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
"""Exponent of the mean that stands for "the worst places" and has no kinks."""


NAMES = ("angle_deg", "azimuth_deg", "distance_mm", "aim", "balance")


@dataclass(frozen=True)
class Arrangement:
    """A pair of opposed lamps.

    Parameters
    ----------
    angle_deg : float
        From the object's normal.
    azimuth_deg : float
        Of the line through both lamps from x, 0 to 90 by symmetry.
    distance_mm : float
    aim : float
        0 at the middle, 1 at the edge away from the lamp.
    balance : float
        Share of the stronger lamp; 0.5 is an equal pair.
    """

    angle_deg: float
    azimuth_deg: float
    distance_mm: float
    aim: float = 1.0
    balance: float = 0.5

    def row(self) -> np.ndarray:
        """Return it as numbers, (5,)."""
        return np.array([getattr(self, name) for name in NAMES])

    def to_dict(self) -> dict[str, float]:
        """Return a JSON-ready record."""
        return {name: getattr(self, name) for name in NAMES}

    def lighting(self, size_mm: tuple[float, float], lobe: Lobe) -> Lighting:
        """Return it as lamps of 1 cd a mean."""
        reach = edge_reach(np.array([self.azimuth_deg]), size_mm)[0]
        lamps = []
        for name, side, share in (("a", 0.0, self.balance), ("b", 180.0, 1 - self.balance)):
            place = lamp_place(self.angle_deg, self.azimuth_deg + side, self.distance_mm)
            foot = place[:2] / max(float(np.hypot(*place[:2])), 1e-9)
            axis = np.array([*(-self.aim * reach * foot), 0.0]) - place
            lamps.append(StudioLamp(name, place, axis / np.linalg.norm(axis), lobe, 2 * share))
        return Lighting("pair", tuple(lamps))


def edge_reach(azimuth_deg: np.ndarray, size_mm: tuple[float, float]) -> np.ndarray:
    """Return how far the object's edge lies from its middle along an azimuth, mm.

    >>> edge_reach(np.array([0.0, 90.0]), (420.0, 320.0)).tolist()
    [210.0, 160.0]
    """
    turn = np.radians(azimuth_deg)
    sides = (size_mm[0] / 2, size_mm[1] / 2)
    across = sides[0] / np.maximum(np.abs(np.cos(turn)), 1e-9)
    return np.minimum(across, sides[1] / np.maximum(np.abs(np.sin(turn)), 1e-9))


class Judge:
    """Costs of arrangements for one object and one viewpoint.

    Parameters
    ----------
    thing : StudioObjectKeys
    room : Room
        Bounds of the distance.
    eye_mm : float
        How far the camera stands.
    lobe : Lobe, optional
        Of both lamps; a half-width of 20° without.
    """

    def __init__(
        self,
        thing: StudioObjectKeys,
        room: Room,
        *,
        eye_mm: float = 1900.0,
        lobe: Lobe | None = None,
    ) -> None:
        self.thing, self.room = thing, room
        self.lobe = Lobe(lobe_exponent(20.0)) if lobe is None else lobe
        surface = sample_surface(thing, 9)
        self.points = surface.points.reshape(-1, 3)
        self.normals = surface.normals.reshape(-1, 3)
        view = np.array([0.0, 0.0, eye_mm]) - self.points
        self.view = view / np.linalg.norm(view, axis=1, keepdims=True)
        self.bounds = np.array(
            [
                (25.0, 86.0),
                (0.0, 90.0),
                (room.nearest_mm, room.farthest_mm),
                (-0.5, 1.0),
                (0.5, 0.8),
            ]
        )

    def values(self, rows: np.ndarray) -> dict[str, np.ndarray]:
        """Return what each criterion measures.

        Parameters
        ----------
        rows : ndarray, (arrangements, 5)
            In the order of `NAMES`.

        Returns
        -------
        values : dict of ndarray, (arrangements,)
        """
        places, axes, shares = self._lamps(rows)
        away = places[:, :, None] - self.points
        squared = (away * away).sum(-1)
        towards = away / np.sqrt(squared)[..., None]
        strength = self.lobe(-(towards * axes[:, :, None]).sum(-1)) * shares[:, :, None] / squared
        lit = (strength * np.maximum((towards * self.normals).sum(-1), 0)).sum(1)
        white = (strength * np.maximum(towards[..., 2], 0)).sum(1)
        shine = self._shine(rows, strength, towards, white)
        hidden, contrast = self._relief(places, axes, shares)
        flux = np.cos(np.radians(rows[:, 0])) / (rows[:, 2] / 1000) ** 2
        some = float(self.thing.relief_slope > 0)
        return {
            "varnish": shine["varnish"] / self.thing.darkest,
            "gold": shine["gold"],
            "drop": 1 - lit.min(1) / lit.max(1),
            "hidden": hidden,
            "flat": some * LEAST_CONTRAST / np.maximum(contrast, 1e-6),
            "light": LEAST_LIGHT / np.maximum(flux, 1e-9),
        }

    def cost(self, rows: np.ndarray, weights: dict[str, float] | None = None) -> np.ndarray:
        """Return Σ weight · (value / tolerance)², (arrangements,)."""
        weights = WEIGHTS if weights is None else weights
        found = self.values(np.atleast_2d(rows))
        return np.sum([weights[k] * (v / TOLERANCES[k]) ** 2 for k, v in found.items()], axis=0)

    def values_of(self, arrangement: Arrangement, **changed: float) -> dict[str, float]:
        """Return the criteria of one arrangement, some of its numbers changed."""
        row = Arrangement(**{**arrangement.to_dict(), **changed}).row()
        return {k: float(v[0]) for k, v in self.values(row[None]).items()}

    def _lamps(self, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Places and axes, (arrangements, 2, 3), and shares, (arrangements, 2)."""
        angle, azimuth = np.radians(rows[:, 0]), np.radians(rows[:, 1])
        foot = np.stack([np.cos(azimuth), np.sin(azimuth)], 1)
        foot = np.stack([foot, -foot], 1)
        out = rows[:, 2] * np.sin(angle)
        up = rows[:, 2] * np.cos(angle)
        places = np.concatenate([foot * out[:, None, None], np.repeat(up, 2).reshape(-1, 2, 1)], 2)
        reach = rows[:, 3] * edge_reach(rows[:, 1], self.thing.size_mm)
        aims = np.concatenate([-foot * reach[:, None, None], np.zeros((len(rows), 2, 1))], 2)
        axes = aims - places
        axes /= np.linalg.norm(axes, axis=2, keepdims=True)
        return places, axes, np.stack([2 * rows[:, 4], 2 - 2 * rows[:, 4]], 1)

    def _shine(
        self, rows: np.ndarray, strength: np.ndarray, towards: np.ndarray, white: np.ndarray
    ) -> dict[str, Any]:
        """Glare of both coats where it is worst, the ground's unevenness turning every normal."""
        found: dict[str, Any] = {"varnish": np.zeros(len(rows)), "gold": np.zeros(len(rows))}
        coats = [(k, c) for k in found if (c := getattr(self.thing, k)) is not None]
        if not coats:
            return found
        azimuth = np.radians(rows[:, 1])
        lean = np.tan(np.radians(self.thing.unevenness_deg))
        turned = np.stack([np.cos(azimuth), np.sin(azimuth), 0 * azimuth], 1) * lean
        normals = self.normals + np.stack([turned, -turned], 1)[:, :, None]
        normals = (normals / np.linalg.norm(normals, axis=-1, keepdims=True))[:, None]
        half = towards + self.view
        half /= np.linalg.norm(half, axis=-1, keepdims=True)
        tilt = (normals * half[:, :, None]).sum(-1)
        incident = (normals * towards[:, :, None]).sum(-1)
        to_eye = np.broadcast_to((normals * self.view).sum(-1), incident.shape)
        facing = (half * towards).sum(-1)
        got = strength[:, :, None] * np.maximum(incident, 0)
        for name, coat in coats:
            index = GOLD_INDEX if name == "gold" else coat.index / AIR
            mirrored = _reflectance(facing, index)[:, :, None]
            light = got * mirrored * facet_lobe(tilt, incident, to_eye, coat.roughness)
            over = light.sum(1) / white[:, None]
            found[name] = (over**WORST).mean((1, 2)) ** (1 / WORST)
        return found

    def _relief(
        self, places: np.ndarray, axes: np.ndarray, shares: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Share of relief out of reach, and contrast of matte relief, at the object's middle."""
        away = np.linalg.norm(places, axis=2)
        towards = places / away[..., None]
        strength = shares * self.lobe(-(towards * axes).sum(2)) / away**2
        flat = strength * np.maximum(towards[..., 2], 0)
        slope = self.thing.relief_slope
        if not slope:
            return np.zeros(len(places)), np.ones(len(places))
        height = towards[..., 2] / np.maximum(np.hypot(towards[..., 0], towards[..., 1]), 1e-9)
        turned = 0.5 * np.array([erfc(h / (slope * sqrt(2))) for h in height.ravel().tolist()])
        turned = turned.reshape(height.shape)
        hidden = (flat * turned).sum(1) / flat.sum(1)
        slopes, weights = slope_nodes(slope, 20)
        normals = np.concatenate([-slopes, np.ones((len(slopes), 1))], 1)
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        light = np.maximum(towards @ normals.T, 0) * strength[..., None]
        light = light.sum(1)
        mean = light @ weights
        spread = (light - mean[:, None]) ** 2 @ weights
        return hidden, np.sqrt(spread) / mean


def _reflectance(cosine: np.ndarray, index: complex) -> np.ndarray:
    """Unpolarised Fresnel reflectance from a table: a thousand times less work than the formula."""
    nodes = np.linspace(0, 1, 513)
    s, p = fresnel(nodes, index)
    return np.interp(cosine, nodes, (s + p) / 2)


def judge_of(setup: StudioSetup, lighting: Lighting | None = None) -> Judge:
    """Return the judge of a setup's object, with the beam of a lighting's first lamp."""
    lighting = setup.lighting() if lighting is None else lighting
    return Judge(
        setup.object, setup.bench.room, eye_mm=float(eye_of(setup)[2]), lobe=lighting.lamps[0].lobe
    )


POPULATION, ROUNDS = 8, 100
"""Arrangements for each of the five numbers, and generations at most; four seeds agree to 0.1° on the bench."""


@dataclass(frozen=True, eq=False)
class Optimum:
    """The best arrangement.

    Parameters
    ----------
    best : Arrangement
    cost : float
    values : dict
        What each criterion measures there.
    reasons : tuple of str
        What each change from it would cost, in sentences.
    """

    best: Arrangement
    cost: float
    values: dict[str, float]
    reasons: tuple[str, ...]

    @property
    def criteria(self) -> dict[str, float]:
        """Value over tolerance of each criterion; 1 is just tolerated."""
        return {k: v / TOLERANCES[k] for k, v in self.values.items()}

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "best": self.best.to_dict(),
            "cost": self.cost,
            "values": self.values,
            "over_tolerance": self.criteria,
            "weights": WEIGHTS,
            "tolerances": TOLERANCES,
            "reasons": list(self.reasons),
        }


def optimise(
    judge: Judge, *, rng: np.random.Generator, weights: dict[str, float] | None = None
) -> Optimum:
    """Return the arrangement of least cost, by differential evolution, polished by quasi-Newton steps.

    Parameters
    ----------
    judge : Judge
    rng : Generator
        Draws the first population, evenly over the bounds.
    weights : dict, optional
        Other weights, to see how much hangs on them.

    Notes
    -----
    Storn and Price 1997 (10.1023/A:1008202821328), as SciPy has it: all arrangements of a generation are judged at once.
    """
    from scipy.optimize import differential_evolution

    found = differential_evolution(
        lambda columns: judge.cost(columns.T, weights), judge.bounds, popsize=POPULATION, maxiter=ROUNDS,
        seed=rng, vectorized=True, updating="deferred",
    )  # fmt: skip
    best = Arrangement(*map(float, found.x))
    values = judge.values_of(best)
    return Optimum(best, float(found.fun), values, tuple(_why(judge, best, values)))


def _why(judge: Judge, best: Arrangement, values: dict[str, float]) -> list[str]:
    """Report what each change from the optimum would cost."""
    sentences = []
    shiny = "varnish" if judge.thing.varnish else "gold" if judge.thing.gold else None

    def times(other: dict[str, float]) -> float:
        return other[shiny] / max(values[shiny], 1e-12) if shiny else 0.0

    if shiny and abs(best.angle_deg - 45) > 3:
        sentences.append(
            f"At 45° the {shiny} would shine {times(judge.values_of(best, angle_deg=45.0)):.1f} times as "
            f"much as at {best.angle_deg:.0f}°, where the lamps stand well outside the family of angles "
            f"that the panel mirrors into the camera, facets included."
        )
    if judge.thing.relief_slope:
        lower = judge.values_of(best, angle_deg=min(best.angle_deg + 6, 86.0))
        shows = lower["hidden"] > values["hidden"] + 0.005
        sentences += [
            f"Six degrees lower over the panel, {100 * lower['hidden']:.0f} % of the relief would turn "
            f"away from a lamp instead of {100 * values['hidden']:.1f} %: grazing light exaggerates it."
        ] * shows
    across = judge.values_of(best, azimuth_deg=90.0 - best.azimuth_deg)
    more = f", and the {shiny} shine {times(across):.1f} times as much" if shiny else ""
    sentences.append(
        f"Along the object's other axis the light would drop by {100 * across['drop']:.1f} % over it "
        f"instead of {100 * values['drop']:.1f} %{more}."
    )
    near = max(best.distance_mm / 2, judge.room.nearest_mm)
    sentences.append(
        f"At {near / 10:.0f} cm instead of {best.distance_mm / 10:.0f} cm the light would drop by "
        f"{100 * judge.values_of(best, distance_mm=near)['drop']:.0f} % over the object."
    )
    other = 0.0 if best.aim > 0.4 else 1.0
    sentences.append(
        f"Aimed at the {'far edge' if other else 'middle'} the drop would be "
        f"{100 * judge.values_of(best, aim=other)['drop']:.1f} %."
    )
    return sentences
