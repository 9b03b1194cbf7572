"""Control points: pairs of places that a person, or another program, says are the same."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from levkas.core.problems import Problem, Refused

MOST_POINTS = 100_000
LARGEST_COORDINATE = 1e7
LONGEST_NAME = 200

Size = tuple[int, int]


class PointsRefused(Refused):
    """Control points that cannot be read, written or used."""


@dataclass(frozen=True, eq=False)
class ControlPoints:
    """Pairs of points in two frames; pixel centres are integers, y points down.

    Parameters
    ----------
    reference, target : array_like, (n, 2)
        x, y of every pair in either frame, px.
    names : sequence of str, n
        Empty where a pair has none.
    weights : array_like, (n,)
        > 0; 1 by default.
    enabled : array_like of bool, (n,)
        A pair that is not enabled is kept and never used.
    check : array_like of bool, (n,)
        A check point measures and never fits.
    reference_frame, target_frame : str
        Names of the frames, or of the files that the points were set in; may be empty.
    reference_size, target_size : (width, height), px, optional
        Sizes of both pictures; some dialects cannot do without.

    Raises
    ------
    PointsRefused
        Where lengths differ, or a value is not finite or too large.

    Examples
    --------
    >>> pairs = ControlPoints([[0, 0], [10, 5]], [[1, 2], [11, 7]], names=["eye", "hand"])
    >>> len(pairs), pairs.names[1], pairs.enabled.all()
    (2, 'hand', np.True_)
    """

    reference: Any  # these five are arrays once the value is made
    target: Any
    names: tuple[str, ...] = ()
    weights: Any = None
    enabled: Any = None
    check: Any = None
    reference_frame: str = ""
    target_frame: str = ""
    reference_size: Size | None = None
    target_size: Size | None = None

    def __post_init__(self) -> None:
        reference, target = (_pairs(v) for v in (self.reference, self.target))
        n = len(reference)
        columns = {
            "reference": reference,
            "target": target,
            "names": tuple(str(v) for v in self.names) if len(self.names) else ("",) * n,
            "weights": _column(self.weights, n, 1.0, float),
            "enabled": _column(self.enabled, n, True, bool),
            "check": _column(self.check, n, False, bool),
        }
        problems = _faults(columns, n)
        if problems:
            raise PointsRefused(*problems)
        for name, value in columns.items():
            if isinstance(value, np.ndarray):
                value.flags.writeable = False
            object.__setattr__(self, name, value)

    def __len__(self) -> int:
        return len(self.reference)

    def keep(self, which: np.ndarray) -> ControlPoints:
        """Return the pairs where `which`, a mask or an index, says so."""
        index = np.arange(len(self))[which]
        return replace(
            self,
            reference=self.reference[index],
            target=self.target[index],
            names=tuple(self.names[i] for i in index),
            weights=self.weights[index],
            enabled=self.enabled[index],
            check=self.check[index],
        )

    def sized(self, reference: Size | None, target: Size | None) -> ControlPoints:
        """Return the same pairs with the sizes of both pictures, where they are given."""
        return replace(
            self,
            reference_size=reference or self.reference_size,
            target_size=target or self.target_size,
        )


def parse_size(text: str | None) -> Size | None:
    """Read a size as a person writes it.

    Examples
    --------
    >>> parse_size("1392,1040"), parse_size("3900x2600"), parse_size(None)
    ((1392, 1040), (3900, 2600), None)
    """
    if text is None:
        return None
    parts = text.lower().replace("x", ",").split(",")
    if len(parts) != 2 or not all(p.strip().isdecimal() and int(p) > 0 for p in parts):
        raise PointsRefused(
            Problem(
                "E_VALUE", "this is no size of a picture", found=text[:40], expected="1392,1040"
            )
        )
    return int(parts[0]), int(parts[1])


def _pairs(values: object) -> np.ndarray:
    return np.array(values, np.float64).reshape(-1, 2)


def _column(values: Any, n: int, default: float | bool, kind: type) -> np.ndarray:
    return np.full(n, default, kind) if values is None else np.array(values, kind).reshape(-1)


def _faults(columns: dict[str, Any], n: int) -> list[Problem]:
    problems = []
    for name, value in columns.items():
        if len(value) != n:
            problems.append(
                Problem("E_SIZE", "points do not pair up", field=name, found=len(value), expected=n)
            )
    if n > MOST_POINTS:
        problems.append(
            Problem("E_SIZE", "too many points", found=n, expected=f"at most {MOST_POINTS}")
        )
    for name in ("reference", "target"):
        points = np.asarray(columns[name])
        wrong = ~np.all(np.abs(points) <= LARGEST_COORDINATE, axis=1)
        if wrong.any():
            row = int(np.flatnonzero(wrong)[0])
            problems.append(
                Problem(
                    "E_VALUE",
                    f"point {row + 1} is no place in a picture",
                    field=name,
                    found=points[row].tolist(),
                    expected=f"finite numbers up to {LARGEST_COORDINATE:.0f}",
                )
            )
    weights = np.asarray(columns["weights"])
    if not (np.isfinite(weights).all() and (weights > 0).all()):
        problems.append(
            Problem("E_VALUE", "a weight is not > 0 and finite", field="weights", expected="> 0")
        )
    names = columns["names"]
    long = next((v for v in names if len(v) > LONGEST_NAME or not v.isprintable()), None)
    if long is not None:
        problems.append(
            Problem(
                "E_VALUE",
                "the name of a point cannot be used",
                field="names",
                found=repr(long)[:80],
                expected=f"at most {LONGEST_NAME} printable characters",
            )
        )
    return problems
