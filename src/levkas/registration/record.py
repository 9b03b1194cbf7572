"""What a registration leaves behind: matches, the trace of their removal, the verdict, the transforms."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from collections.abc import Iterator

    from levkas.geometry.transforms import Transform
    from levkas.registration.observations import Sighting
    from levkas.registration.uncertainty import Sigma

COLUMNS = (
    "reference_x",
    "reference_y",
    "target_x",
    "target_y",
    "residual",
    "leave_one_out",
    "weight",
    "state",
    "reason",
    "round",
)
Decision = Literal["accept", "warn", "refuse"]


class RegistrationRefused(Refused):
    """No transform at all could be found; `trace` holds how far the removal of outliers came."""

    def __init__(self, *problems: Problem, trace: Trace | None = None) -> None:
        super().__init__(*problems)
        self.trace = trace

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), self.problems, {"trace": self.trace}


@dataclass(frozen=True)
class Matches:
    """Pairs of control points and what became of them; one row a pair.

    Parameters
    ----------
    reference, target : ndarray, (n, 2)
        Reference px; native px of the target (of its first sensor, where it has several).
    residual : ndarray, (n,), reference px
        Distance of the reference point from the mapped target point; NaN where not computed.
    leave_one_out : ndarray, (n,), reference px
        The same by a fit without the pair.
    weight : ndarray, (n,)
        In the final fit; 0 for a pair that was removed.
    state : ndarray of str, (n,)
        ``"kept"``, ``"removed"`` or, for what measures and is never fitted, ``"check"``.
    reason : ndarray of str, (n,)
        Why it was removed, in a user's words; of a kept pair only that a person gave it.
    round : ndarray of int, (n,)
        Iteration after which it left: 0 is the cut under scale alone; -1 for a kept pair.

    Examples
    --------
    >>> m = Matches.of(np.zeros((2, 2)), np.ones((2, 2)))
    >>> len(m), int(m.kept.sum()), next(m.rows())[:4]
    (2, 2, ('0', '0', '1', '1'))
    """

    reference: np.ndarray
    target: np.ndarray
    residual: np.ndarray
    leave_one_out: np.ndarray
    weight: np.ndarray
    state: np.ndarray
    reason: np.ndarray
    round: np.ndarray

    @classmethod
    def of(cls, reference: np.ndarray, target: np.ndarray, **known: np.ndarray) -> Matches:
        """Return matches of two (n, 2) arrays, all kept unless `known` says otherwise."""
        n = len(reference)
        columns: dict[str, np.ndarray] = {
            "residual": np.full(n, np.nan),
            "leave_one_out": np.full(n, np.nan),
            "weight": np.ones(n),
            "state": np.full(n, "kept", object),
            "reason": np.full(n, "", object),
            "round": np.full(n, -1),
        }
        return cls(np.asarray(reference, float), np.asarray(target, float), **(columns | known))

    def __len__(self) -> int:
        return len(self.reference)

    @property
    def kept(self) -> np.ndarray:
        """Mask of the pairs that the final fit rests on, (n,) bool."""
        return np.asarray(self.state == "kept", bool)

    def rows(self) -> Iterator[tuple[str, ...]]:
        """Yield the rows of CAMERA.matches.csv as text, columns as `COLUMNS` orders them."""
        for i in range(len(self)):
            numbers = (*self.reference[i], *self.target[i], self.residual[i])
            numbers += (self.leave_one_out[i], self.weight[i])
            left = int(self.round[i])
            yield (
                *(_number(v) for v in numbers),
                str(self.state[i]),
                str(self.reason[i]),
                "" if left < 0 else str(left),
            )


@dataclass(frozen=True)
class Trace:
    """What the removal of outliers did, round by round: the paper's Figures 9 and 10.

    Parameters
    ----------
    reject, stop : float, reference px
        T1 and T2 of the paper.
    scale : Transform
        The scale-only map target → reference under which the first cut was made.
    scale_errors : ndarray, (n,), reference px
        Error of every match under `scale`.
    largest : ndarray, (rounds,), reference px
        Largest error among the kept matches at each round; the last is <= `stop`.
    removed : ndarray of int, (rounds,)
        Index of the match that leaves after the round; -1 where none does.
    corners : ndarray, (rounds, 4, 2), reference px
        Corners of the target's frame under the model of each round, clockwise from the top left.
    frame : ndarray, (4, 2), reference px
        The same corners under `scale`.
    size : (width, height) of the reference
    pinned : ndarray of bool, (n,), optional
        Pairs that a person gave: they stay, whatever their error.
    """

    reject: float
    stop: float
    scale: Transform
    scale_errors: np.ndarray
    largest: np.ndarray
    removed: np.ndarray
    corners: np.ndarray
    frame: np.ndarray
    size: tuple[int, int]
    pinned: np.ndarray | None = None

    @property
    def rounds(self) -> int:
        """How many fits were made."""
        return len(self.largest)

    def kept_at(self, number: int) -> np.ndarray:
        """Return the mask, (n,) bool, of the matches that the fit of round `number` rests on."""
        kept = np.asarray(self.scale_errors < self.reject).copy()
        if self.pinned is not None:
            kept |= self.pinned
        gone = self.removed[: number if number >= 0 else self.rounds + number]
        kept[gone[gone >= 0]] = False
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
class Verdict:
    """Whether a registration can be believed, why, and what to do next.

    Parameters
    ----------
    decision : {"accept", "warn", "refuse"}
    reasons : tuple of str
        One sentence each, with the numbers, in a user's words.
    next_step : str
        What to do; empty where nothing is to be done.
    numbers : dict
        The evidence, by name, JSON-ready.
    """

    decision: Decision
    reasons: tuple[str, ...] = ()
    next_step: str = ""
    numbers: dict[str, Any] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "decision": self.decision,
            "reasons": list(self.reasons),
            "next_step": self.next_step,
            "numbers": _plain(self.numbers),
        }


@dataclass(frozen=True)
class Registration:
    """One camera registered to the reference band.

    Parameters
    ----------
    method : str
        A key of `levkas.registration.METHODS`.
    transforms : dict of str to Transform
        Band label → map from reference px to native px of that band.
    verdict : Verdict
    errors : dict
        Residual statistics, reference px, JSON-ready.
    matches : Matches
        Of the target's first sensor; of the reference camera itself there are none.
    trace : Trace or None
        Of a method that removes outliers one by one.
    basis : dict
        What a map without such a trace rests on, as `describe_basis` tells it of each sensor, JSON-ready.
    model : dict
        ``kind`` and what else describes the model, JSON-ready.
    sigma : dict of str to Sigma
        Band label → one standard deviation of where it lies; empty where a method does not know.
    others : dict of str to Matches
        Sensor → its matches, for the target's other sensors; empty where a method has none.
    sightings : tuple of Sighting
        One a sensor, for adjusting several captures together; empty where a method has none.
    """

    method: str
    transforms: dict[str, Transform]
    verdict: Verdict
    errors: dict[str, Any]
    matches: Matches
    trace: Trace | None = None
    model: dict[str, Any] = field(default_factory=dict)
    sigma: dict[str, Sigma] = field(default_factory=dict)
    others: dict[str, Matches] = field(default_factory=dict)
    sightings: tuple[Sighting, ...] = ()
    basis: dict[str, Any] = field(default_factory=dict)

    def to_dict(self, *, reference: str = "", target: str = "") -> dict[str, Any]:
        """Return the record of CAMERA.json; `reference` and `target` are the names of frames."""
        return {
            "method": self.method,
            "reference": reference,
            "target": target,
            "verdict": self.verdict.to_dict(),
            "model": _plain(self.model),
            "bands": {label: t.to_dict() for label, t in self.transforms.items()},
            "errors": _plain(self.errors),
            "trace": self.trace.to_dict() if self.trace else _plain(self.basis),
        }


def _number(value: float) -> str:
    return "" if np.isnan(value) else f"{value:.6f}".rstrip("0").rstrip(".")


def _plain(value: Any) -> Any:
    """Turn numpy values into JSON's own; NaN and infinities, which JSON lacks, into None."""
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, (list, tuple, np.ndarray)):
        return [_plain(v) for v in value]
    if isinstance(value, (bool, np.bool_)):
        return bool(value)
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    return value
