"""Records of a registration: matches, the trace of their removal, uncertainty, verdict, transforms."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from levkas.core.json_safe import plain
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from collections.abc import Iterator, Mapping

    from levkas.geometry.transforms import Transform
    from levkas.registration.model_selection import SelectedModel
    from levkas.registration.window_matching import CheckWindows

COLUMNS = (
    "reference_x", "reference_y", "target_x", "target_y", "residual", "leave_one_out", "weight", "state", "reason", "round",
)  # fmt: skip
Decision = Literal["accept", "warn", "by hand", "refuse"]

DECISIONS = {
    "accept": "accepted",
    "warn": "doubtful, please check",
    "confirmed": "confirmed, by a person",
    "by hand": "placed by hand",
    "refuse": "refused",
    "reference": "reference",
    "not built": "not built yet",
}
"""Decisions in the words of every page, screen and table; records hold the keys."""


def decided(verdict: Mapping[str, Any]) -> str:
    """Return the decision of a record's verdict; of a doubtful one that a person confirmed, who and when.

    >>> decided({"decision": "confirmed", "confirmed": {"name": "A. Maker", "date": "2026-10-03"}})
    'accepted by A. Maker, 2026-10-03'
    """
    if verdict.get("decision") != "confirmed":
        return str(verdict.get("decision", ""))
    return f"accepted by {verdict['confirmed']['name']}, {verdict['confirmed']['date']}"


#: Windows of one sensor that a record lists; of more an even selection.
MOST_WINDOWS = 1000


class RegistrationRefused(Refused):
    """No transform at all could be found; `trace` holds how far the removal of outliers came."""

    def __init__(self, *problems: Problem, trace: Trace | None = None) -> None:
        super().__init__(*problems)
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self.problems, {"trace": self.trace}


def refusal(code: str, message: str, **details: Any) -> RegistrationRefused:
    """Return the refusal of a registration with one problem."""
    return RegistrationRefused(Problem(code, message, **details))


class MatchState(StrEnum):
    """State of a match in the table of matches; one to check measures and is never fitted."""

    KEPT = "kept"
    REMOVED = "removed"
    CHECK = "check"


class HandMark(StrEnum):
    """Reason, in the table of matches, of a pair that a person gave or marked."""

    ADDED = "added by hand"
    PINNED = "pinned by hand"
    RESTORED = "restored by hand"
    DELETED = "deleted by hand"
    CHECK = "measured, not fitted"


@dataclass(frozen=True)
class Matches:
    """Pairs of control points and their state; one row a pair.

    Examples
    --------
    >>> m = Matches.of(np.zeros((2, 2)), np.ones((2, 2)))
    >>> len(m), int(m.kept.sum()), next(m.rows())[:4]
    (2, 2, ('0', '0', '1', '1'))
    """

    reference: np.ndarray
    target: np.ndarray
    """(n, 2). Reference px; native px of the target's first sensor."""
    residual: np.ndarray
    """(n,), reference px. How far a target point is mapped from its reference point; NaN where not computed."""
    leave_one_out: np.ndarray
    """(n,), reference px. The same by a fit without the pair."""
    weight: np.ndarray
    """(n,). In the final fit; 0 for a pair that was removed."""
    state: np.ndarray
    """(n,). A `MatchState`."""
    reason: np.ndarray
    """(n,). Why it was removed, in a user's words; of a kept pair only its `HandMark`."""
    round: np.ndarray
    """(n,). Iteration after which it left: 0 is the cut under scale alone; -1 for a kept pair."""

    @classmethod
    def of(cls, reference: np.ndarray, target: np.ndarray, **known: np.ndarray) -> Matches:
        """Return matches of two (n, 2) arrays, all kept unless `known` says otherwise."""
        n, of = len(reference), np.full
        columns = {
            "residual": of(n, np.nan), "leave_one_out": of(n, np.nan), "weight": of(n, 1.0),
            "state": of(n, MatchState.KEPT, object), "reason": of(n, "", object), "round": of(n, -1),
        }  # fmt: skip
        return cls(np.asarray(reference, float), np.asarray(target, float), **(columns | known))

    @classmethod
    def none(cls) -> Matches:
        """Return no matches."""
        return cls.of(np.empty((0, 2)), np.empty((0, 2)))

    def __len__(self) -> int:
        return len(self.reference)

    @property
    def kept(self) -> np.ndarray:
        """Mask of the pairs that the final fit rests on, (n,) bool."""
        return np.asarray(self.state == MatchState.KEPT, bool)

    def rows(self) -> Iterator[tuple[str, ...]]:
        """Yield the rows of CAMERA.matches.csv as text, columns as `COLUMNS` orders them."""
        numbers = np.column_stack(
            [self.reference, self.target, self.residual, self.leave_one_out, self.weight]
        )
        words = zip(self.state, self.reason, self.round, strict=True)
        for row, (state, reason, left) in zip(numbers.tolist(), words, strict=True):
            texts = ("" if np.isnan(v) else f"{v:.6f}".rstrip("0").rstrip(".") for v in row)
            yield (*texts, str(state), str(reason), "" if left < 0 else str(int(left)))


@dataclass(frozen=True)
class Trace:
    """The removal of outliers round by round: the paper's Figures 9 and 10."""

    reject: float
    stop: float
    """In reference px: t1 and T2 of the paper."""
    scale: Transform
    """The scale-only map target → reference under which the first cut was made."""
    scale_errors: np.ndarray
    """(n,), reference px. Error of every match under `scale`."""
    largest: np.ndarray
    """(rounds,), reference px. Largest error among the kept matches at each round; the last is <= `stop`."""
    removed: np.ndarray
    """(rounds,). Index of the match that leaves after the round; -1 where none does."""
    corners: np.ndarray
    """(rounds, 4, 2), reference px. Corners of the target's frame under the model of each round, clockwise from the top left."""
    frame: np.ndarray
    """(4, 2), reference px. The same corners under `scale`."""
    size: tuple[int, int]
    pinned: np.ndarray | None = None
    """(n,). Pairs that a person gave: they stay, whatever their error."""
    order: int = 3
    """Of the polynomial."""

    @property
    def rounds(self) -> int:
        """How many fits were made."""
        return len(self.largest)

    def kept_at(self, number: int) -> np.ndarray:
        """Return the mask, (n,) bool, of the matches that the fit of round `number` rests on."""
        kept = np.asarray(self.scale_errors < self.reject).copy()
        if self.pinned is not None:
            kept |= self.pinned
        dropped = self.removed[: number if number >= 0 else self.rounds + number]
        kept[dropped[dropped >= 0]] = False
        return kept

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record; which match left when is in the matches' rows."""
        return {
            "kind": "removal",
            "reject": float(self.reject),
            "stop": float(self.stop),
            "matches": len(self.scale_errors),
            "cut": int((~self.kept_at(0)).sum()),
            "rounds": self.rounds,
            "size": list(self.size),
            "scale": self.scale.to_dict(),
            "frame": np.round(self.frame, 3).tolist(),
            "largest": np.round(self.largest, 4).tolist(),
            "removed": self.removed.tolist(),
            "corners": np.round(self.corners, 3).tolist(),
        }


@dataclass(frozen=True)
class Sigma:
    """One standard deviation, of each axis, of where a band lies.

    Examples
    --------
    >>> sigma = Sigma(np.array([0.0, 10.0]), np.array([0.0, 10.0]), np.array([[0.0, 1], [0, 1]]))
    >>> sigma(np.array([[2.5, 7.0], [20.0, 0.0]])).tolist()
    [0.25, 1.0]
    """

    x: np.ndarray
    y: np.ndarray
    """(n,) and (m,), reference px. Of a lattice over the reference's frame."""
    values: np.ndarray
    """(m, n), reference px."""

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Return sigma at `points`, (n, 2) reference px → (n,) reference px; the rim's beyond it."""
        (column, u), (row, v) = _cell(self.x, points[:, 0]), _cell(self.y, points[:, 1])
        upper, lower = (
            (1 - u) * self.values[r, column] + u * self.values[r, column + 1]
            for r in (row, row + 1)
        )
        return np.asarray((1 - v) * upper + v * lower)

    def nowhere_exceeds(self, other: Sigma) -> bool:
        """Return whether another one has the same lattice and is as large everywhere."""
        alike = np.array_equal(self.x, other.x) and np.array_equal(self.y, other.y)
        return alike and bool((self.values <= other.values).all())

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {"x": self.x.tolist(), "y": self.y.tolist(), "sigma_px": self.values.tolist()}

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> Sigma:
        """Read what `to_dict` wrote."""
        return cls(*(np.array(record[key], float) for key in ("x", "y", "sigma_px")))


def _cell(lattice: np.ndarray, places: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    cell = np.clip(np.searchsorted(lattice, places) - 1, 0, len(lattice) - 2)
    share = (places - lattice[cell]) / (lattice[cell + 1] - lattice[cell])
    return cell, np.clip(share, 0, 1)


@dataclass(frozen=True)
class Verdict:
    """Decision on a registration, its reasons, and what to do next."""

    decision: Decision
    reasons: tuple[str, ...] = ()
    """One sentence each, with the numbers, in a user's words."""
    next_step: str = ""
    numbers: dict[str, Any] = field(default_factory=dict)
    """The evidence by sensor, JSON-ready."""
    unchecked: float = 0.0
    """Share of the layer, 0 … 1, that does not show the object, or where nothing confirms the map."""
    outside: float = 0.0
    """The part of `unchecked` that lies outside the object's outline."""

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "decision": self.decision,
            "reasons": list(self.reasons),
            "next_step": self.next_step,
            "unchecked": round(self.unchecked, 4),
            "outside": round(self.outside, 4),
            "numbers": plain(self.numbers),
        }


@dataclass(frozen=True)
class Registration:
    """One camera registered to the reference band."""

    method: str
    """A key of `levkas.registration.METHODS`."""
    transforms: dict[str, Transform]
    """Band label → map from reference px to native px of that band."""
    verdict: Verdict
    errors: dict[str, Any]
    """Residual statistics, reference px, JSON-ready."""
    matches: Matches
    """Of the target's first sensor; of the reference camera itself there are none."""
    trace: Trace | None = None
    """Of a method that removes outliers one by one."""
    model: dict[str, Any] = field(default_factory=dict)
    """``kind`` and what else describes the model, JSON-ready."""
    sigma: dict[str, Sigma] = field(default_factory=dict)
    """Band label → one standard deviation of where it lies; empty where a method does not know."""
    others: dict[str, Matches] = field(default_factory=dict)
    """Sensor → its matches, for the target's other sensors; empty where a method has none."""
    basis: dict[str, Any] = field(default_factory=dict)
    """What a map without a trace rests on, `describe_windows` of each sensor, JSON-ready."""

    def to_dict(self, *, reference: str = "", target: str = "") -> dict[str, Any]:
        """Return the record of CAMERA.json; `reference` and `target` are the names of frames."""
        return {
            "method": self.method,
            "reference": reference,
            "target": target,
            "verdict": self.verdict.to_dict(),
            "model": plain(self.model),
            "bands": {label: t.to_dict() for label, t in self.transforms.items()},
            "errors": plain(self.errors),
            "trace": self.trace.to_dict() if self.trace else plain(self.basis),
        }


def describe_windows(
    sensor: str, source: str, band: str, selected: SelectedModel, checks: CheckWindows
) -> dict[str, Any]:
    """Return the windows on which the base map of a sensor rests, JSON-ready; a list a column, reference px.

    `source` is ``"fused"`` where the windows of several bands were put together, else the band; by `band` the map was checked.
    ``windows``, at most 1000 of all ``count``, evenly: ``x``, ``y``; ``shift_x``, ``shift_y`` from where the map puts a window to where it
    is found; ``sigma`` of that, either axis; ``held_out``, the length of the shift from a map fitted without its block, or None;
    ``weight`` in the fit, 0..1. ``checks``: the windows that were searched freely.
    """
    observations = selected.observations
    chosen = slice(None, None, max(1, -(-len(observations) // MOST_WINDOWS)))
    known = np.trace(observations.information, axis1=1, axis2=2) / 2
    (x, y), (shift_x, shift_y) = observations.points.T, observations.residuals(selected.transform).T
    columns = {
        "x": (x, 1),
        "y": (y, 1),
        "shift_x": (shift_x, 4),
        "shift_y": (shift_y, 4),
        "sigma": (np.where(known > 0, known, np.nan) ** -0.5, 4),
        "held_out": (selected.held_out(), 4),
        "weight": (selected.weights, 3),
    }
    return {
        "sensor": sensor,
        "source": source,
        "band": band,
        "count": len(observations),
        "windows": {
            name: plain(np.round(values[chosen], digits).tolist())
            for name, (values, digits) in columns.items()
        },
        "checks": checks.to_dict(),
    }
