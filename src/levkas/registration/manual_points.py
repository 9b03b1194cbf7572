"""Manual points: pairs that a person gave, which every method keeps, leaves out, or is measured by.

A pair is known by where it lies: four coordinates, rounded to 0.01 px. A rebuild finds the same
places again, numbers of rows it does not.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import solve_2x2
from levkas.registration.record import HandMark, Matches, MatchState

if TYPE_CHECKING:
    from collections.abc import Callable

    from levkas.geometry.transforms import Transform

    Mapper = Callable[[np.ndarray], np.ndarray]

#: How far two coordinates of one pair may differ, px.
NEAR_PX = 0.011
#: Standard deviation of a place that a person points at, native px of either picture.
HAND_PX = 0.5
#: Kind of pairs, a field of `ManualPoints` → its mark.
MARKS = {
    "added": HandMark.ADDED,
    "pinned": HandMark.PINNED,
    "restored": HandMark.RESTORED,
    "deleted": HandMark.DELETED,
    "checks": HandMark.CHECK,
}
KINDS, FIXED = (*MARKS, "starts"), ("restored", "pinned", "added")
"""Kinds of pairs; those that are never removed."""


def _none() -> np.ndarray:
    return np.empty((0, 4))


@dataclass(frozen=True)
class ManualPoints:
    """Pairs given by hand for one sensor; each an (n, 4) array of reference x, y and target x, y.

    Examples
    --------
    >>> given = ManualPoints(added=np.array([[1.0, 2.0, 3.0, 4.0]]))
    >>> len(given.fixed), bool(given)
    (1, True)
    """

    added: np.ndarray = field(default_factory=_none)
    pinned: np.ndarray = field(default_factory=_none)
    restored: np.ndarray = field(default_factory=_none)
    """`added`, `pinned`, `restored`: (n, 4). Pairs that are never removed; `added` are a person's own, the others were found
    by a method."""
    deleted: np.ndarray = field(default_factory=_none)
    """(n, 4). Pairs that no fit may rest on."""
    checks: np.ndarray = field(default_factory=_none)
    """(n, 4). Pairs that measure and are never fitted."""
    starts: np.ndarray = field(default_factory=_none)
    """(n, 4). Pairs of another program, wrong ones among them: candidates of a start, where the pictures alone are refused."""
    placed: tuple[str, ...] = ()
    """Band of the sensor in which each check point was placed, whose map measures it; where it is empty, or one of its names
    is, the sensor's first band."""
    accepted: bool = False
    """Whether the map is to be fitted to the pairs that are never removed, and to nothing else."""

    def __bool__(self) -> bool:
        count = len(self.fixed) + len(self.deleted) + len(self.checks) + len(self.starts)
        return bool(count) or self.accepted

    @property
    def fixed(self) -> np.ndarray:
        """Pairs that are never removed, (n, 4)."""
        return np.concatenate([self.added, self.pinned, self.restored])

    def reduced(self, factor: int) -> ManualPoints:
        """Return the pairs with target px of pictures that are smaller by a whole factor."""
        middle = (factor - 1) / 2
        return self.moved(lambda reference: reference, lambda target: (target - middle) / factor)

    def moved(self, reference: Mapper, target: Mapper) -> ManualPoints:
        """Return the pairs with their places in either picture moved, px → px."""
        parts: dict[str, Any] = {
            kind: np.hstack([reference(p[:, :2]), target(p[:, 2:])])
            for kind in KINDS
            for p in [getattr(self, kind)]
        }
        return replace(self, **parts)

    def joined(self, other: ManualPoints) -> ManualPoints:
        """Return the pairs of both, of which all check points say in which band they were placed."""
        pairs: dict[str, Any] = {
            kind: np.concatenate([getattr(self, kind), getattr(other, kind)]) for kind in KINDS
        }
        accepted = self.accepted or other.accepted
        return ManualPoints(**pairs, placed=self.placed + other.placed, accepted=accepted)

    def mark(self, reference: np.ndarray, target: np.ndarray) -> MarkedMatches:
        """Find the given pairs among those of a method, (n, 2) each, and append those it lacks."""
        found = np.hstack([reference, target]).reshape(-1, 4)
        reason = np.full(len(found), "", object)
        reason[nearest_rows(found, self.deleted) >= 0] = HandMark.DELETED
        reason[nearest_rows(found, self.checks) >= 0] = HandMark.CHECK
        more, why = [], []
        for kind in FIXED:
            pairs, mark = getattr(self, kind), MARKS[kind]
            at = nearest_rows(pairs, found)
            reason[at[at >= 0]] = mark
            more.append(pairs[at < 0])
            why += [mark] * int((at < 0).sum())
        pairs = np.concatenate([found, *more])
        reasons = np.concatenate([reason, np.array(why, object)])
        return MarkedMatches(pairs[:, :2].copy(), pairs[:, 2:].copy(), reasons)


@dataclass(frozen=True)
class MarkedMatches:
    """Pairs of a method and given ones together, each with its mark."""

    reference: np.ndarray
    target: np.ndarray
    """`reference`, `target`: (n, 2)."""
    reason: np.ndarray
    """(n,). A `HandMark`; empty of pairs that are not marked."""

    @cached_property
    def dropped(self) -> np.ndarray:
        """Mask of the pairs that no fit may rest on, (n,) bool."""
        return np.asarray((self.reason == HandMark.DELETED) | (self.reason == HandMark.CHECK), bool)

    @cached_property
    def fixed(self) -> np.ndarray:
        """Mask of the pairs that are never removed, (n,) bool."""
        return np.asarray((self.reason != "") & ~self.dropped, bool)


def nearest_rows(pairs: np.ndarray, among: np.ndarray) -> np.ndarray:
    """Return for each of `pairs`, (n, 4), the row of `among`, (m, 4), at the same place; -1 for none.

    >>> nearest_rows(np.array([[1.0, 2, 3, 4.004], [1, 2, 3, 5]]), np.array([[1.0, 2, 3, 4]])).tolist()
    [0, -1]
    """
    if not len(pairs) or not len(among):
        return np.full(len(pairs), -1)
    from scipy.spatial import cKDTree

    reach = np.nextafter(NEAR_PX, 1)
    distance, row = cKDTree(among).query(pairs, p=np.inf, distance_upper_bound=reach)
    return np.where(np.isfinite(distance), row, -1)


def measure_checks(checks: np.ndarray, transform: Transform) -> np.ndarray:
    """Return how far check points, (n, 4), are off, (n,), reference px; `transform` maps the reference."""
    miss = checks[:, 2:] - transform(checks[:, :2])
    errors = np.hypot(*solve_2x2(transform.jacobian(checks[:, :2]), miss).T)
    return np.where(np.isfinite(errors), errors, np.nan)


def with_checks(matches: Matches, checks: np.ndarray, errors: np.ndarray) -> Matches:
    """Append check points to matches, state `MatchState.CHECK`, weight 0; those that are pairs become it."""
    at = nearest_rows(checks, np.hstack([matches.reference, matches.target]).reshape(-1, 4))
    names = Matches.__dataclass_fields__
    n = int((at < 0).sum())
    more = Matches.of(checks[at < 0, :2], checks[at < 0, 2:], weight=np.zeros(n))
    columns = {k: np.concatenate([getattr(matches, k), getattr(more, k)]) for k in names}
    rows = np.where(at < 0, 0, at)
    rows[at < 0] = len(matches) + np.arange(n)
    for name, value in (("residual", errors), ("leave_one_out", errors), ("weight", 0.0),
                        ("state", MatchState.CHECK), ("reason", HandMark.CHECK), ("round", -1)):  # fmt: skip
        columns[name][rows] = value
    return Matches(**columns)
