"""Optimization of a pair of lamps: a compass search from random starts, and trade-off curves.

Cost = Σ weight · (value / tolerance)²: a criterion at its tolerance costs its weight, one at half of it
a quarter. Tolerances and weights are `criteria.TOLERANCES` and `criteria.WEIGHTS`, fixed for every
object.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.planning.criteria import NAMES, TOLERANCES, WEIGHTS, Arrangement, Judge
from levkas.planning.light import eye_of

if TYPE_CHECKING:
    from levkas.planning.setup import Lighting, StudioSetup

FIRST_STEP, LAST_STEP = 0.16, 0.002
"""Of the search, in shares of the bounds."""
MOST_ROUNDS = 150


@dataclass(frozen=True, eq=False)
class Optimum:
    """What the search found.

    Parameters
    ----------
    best : Arrangement
    cost : float
    values : dict
        What each criterion measures there.
    starts : tuple of (start, end, cost)
        Every random start and where it ended.
    reasons : tuple of str
        Why, in sentences.
    """

    best: Arrangement
    cost: float
    values: dict[str, float]
    starts: tuple[tuple[Arrangement, Arrangement, float], ...]
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
            "starts": [
                {"start": a.to_dict(), "end": b.to_dict(), "cost": c} for a, b, c in self.starts
            ],
            "reasons": list(self.reasons),
        }


def optimise(
    judge: Judge, *, rng: np.random.Generator, starts: int = 5,
    weights: dict[str, float] | None = None,
) -> Optimum:  # fmt: skip
    """Return the arrangement of least cost, searched from random starts.

    Parameters
    ----------
    judge : Judge
    rng : Generator
        Draws the starts, evenly over the bounds.
    starts : int
    weights : dict, optional
        Other weights, to see how much hangs on them.

    Notes
    -----
    Each round tries a step either way along every coordinate, and the pair turned to the other
    axis; the best is taken, and where none is better the step is halved. All starts move at once.
    """
    low, high = judge.bounds.T
    at = rng.uniform(0.05, 0.95, (starts, 5))
    begun = low + at * (high - low)
    step = np.full(starts, FIRST_STEP)
    cost = judge.cost(begun, weights)
    for _ in range(MOST_ROUNDS):
        moving = np.flatnonzero(step >= LAST_STEP)
        if not len(moving):
            break
        tried = _moves(at[moving], step[moving])
        costs = judge.cost((low + tried * (high - low)).reshape(-1, 5), weights)
        costs = costs.reshape(len(moving), -1)
        best = costs.argmin(1)
        better = costs[np.arange(len(moving)), best] < cost[moving] - 1e-9
        step[moving] *= np.where(better, 1.0, 0.5)
        moved = moving[better]
        at[moved] = tried[better, best[better]]
        cost[moved] = costs[better, best[better]]
    ends = low + at * (high - low)
    found = tuple(
        (_arrangement(b), _arrangement(e), float(c))
        for b, e, c in zip(begun, ends, cost, strict=True)
    )
    best_one = found[int(cost.argmin())][1]
    values = judge.values_of(best_one)
    return Optimum(best_one, float(cost.min()), values, found, tuple(_why(judge, best_one, values)))


def _arrangement(row: np.ndarray) -> Arrangement:
    return Arrangement(**dict(zip(NAMES, map(float, row), strict=True)))


def _moves(at: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Return what each start tries, (starts, 16, 5): steps, slants, and pairs along the two axes."""
    unit = np.eye(5)
    slant = np.array([[1.0, 0, 1, 0, 0], [-1, 0, 1, 0, 0]])
    directions = np.concatenate([unit, -unit, slant])
    tried = np.clip(at[:, None] + step[:, None, None] * directions, 0, 1)
    turned = at.copy()
    turned[:, 1] = 1 - turned[:, 1]
    along, across, equal = at.copy(), at.copy(), at.copy()
    along[:, [1, 4]], across[:, [1, 4]], equal[:, 4] = 0.0, (1.0, 0.0), 0.0
    leaps = np.stack([turned, along, across, equal], 1)
    return np.concatenate([tried, leaps], 1)


@dataclass(frozen=True, eq=False)
class TradeOff:
    """Criteria over the lamps' angle, all else as in one arrangement; values over tolerance."""

    angle_deg: np.ndarray
    criteria: dict[str, np.ndarray]
    cost: np.ndarray


def trade_off(judge: Judge, arrangement: Arrangement, *, step_deg: float = 1.0) -> TradeOff:
    """Return how the criteria change with the lamps' angle: what is gained here is lost there."""
    angles = np.arange(30.0, 84.01, step_deg)
    rows = np.repeat(arrangement.row()[None], len(angles), 0)
    rows[:, 0] = angles
    curves = {k: v / TOLERANCES[k] for k, v in judge.values(rows).items()}
    return TradeOff(angles, curves, judge.cost(rows))


def _why(judge: Judge, best: Arrangement, values: dict[str, float]) -> list[str]:
    """Say what each change from the optimum would cost."""
    told = []
    shiny = "varnish" if judge.thing.varnish else "gold" if judge.thing.gold else None

    def times(other: dict[str, float]) -> float:
        return other[shiny] / max(values[shiny], 1e-12) if shiny else 0.0

    if shiny and abs(best.angle_deg - 45) > 3:
        told.append(
            f"At 45° the {shiny} would shine {times(judge.values_of(best, angle_deg=45.0)):.1f} times as "
            f"much as at {best.angle_deg:.0f}°, where the lamps stand well outside the family of angles "
            f"that the panel mirrors into the camera, facets included."
        )
    if judge.thing.relief_slope:
        lower = judge.values_of(best, angle_deg=min(best.angle_deg + 6, 86.0))
        shows = lower["hidden"] > values["hidden"] + 0.005
        told += [
            f"Six degrees lower over the panel, {100 * lower['hidden']:.0f} % of the relief would turn "
            f"away from a lamp instead of {100 * values['hidden']:.1f} %: grazing light exaggerates it."
        ] * shows
    across = judge.values_of(best, azimuth_deg=90.0 - best.azimuth_deg)
    more = f", and the {shiny} shine {times(across):.1f} times as much" if shiny else ""
    told.append(
        f"Along the object's other axis the light would drop by {100 * across['drop']:.1f} % over it "
        f"instead of {100 * values['drop']:.1f} %{more}"
        + (": bent that way, its normals turn towards the lamps." if judge.thing.bend else ".")
    )
    near = max(best.distance_mm / 2, judge.room.nearest_mm)
    told.append(
        f"At {near / 10:.0f} cm instead of {best.distance_mm / 10:.0f} cm the light would drop by "
        f"{100 * judge.values_of(best, distance_mm=near)['drop']:.0f} % over the object."
    )
    other = 0.0 if best.aim > 0.4 else 1.0
    told.append(
        f"Aimed at the {'far edge' if other else 'middle'} the drop would be "
        f"{100 * judge.values_of(best, aim=other)['drop']:.1f} %."
    )
    return told


def judge_of(setup: StudioSetup, lighting: Lighting | None = None) -> Judge:
    """Return the judge of a setup's object, with the beam of a lighting's first lamp."""
    lighting = setup.lighting() if lighting is None else lighting
    return Judge(
        setup.object, setup.bench.room, eye_mm=float(eye_of(setup)[2]), lobe=lighting.lamps[0].lobe
    )
