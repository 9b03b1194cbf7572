"""Operations on pairs, each a function from corrections to corrections."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from levkas.campaign.edits import FrameEdits, Pair, round_pair
from levkas.core.problems import Problem, Refused

OWN = ("added", "moved")
KINDS = ("deleted", "restored", "pinned", "added", "checks")
THRESHOLDS = {"reject": (0.1, 1e6), "stop": (0.001, 1e6)}


class OperationRefused(Refused):
    """Something that cannot be done to this pair."""


def delete(edits: FrameEdits, pair: Pair) -> FrameEdits:
    """No fit rests on the pair any more; a pair of one's own goes altogether.

    >>> mine = add(FrameEdits(), (1, 2, 3, 4))
    >>> delete(mine, (1, 2, 3, 4)) == FrameEdits()
    True
    """
    pair = round_pair(pair)
    if pair in edits.added or pair in edits.checks:
        return _without(edits, pair)
    for move in edits.moved:
        if move[4:] == pair:
            rest = tuple(m for m in edits.moved if m != move)
            return _with(replace(edits, moved=rest), "deleted", move[:4])
    return _with(_without(edits, pair), "deleted", pair)


def restore(edits: FrameEdits, pair: Pair) -> FrameEdits:
    """Take back a deletion; a pair that the removal of outliers dropped stays from now on."""
    pair = round_pair(pair)
    if pair in edits.deleted:
        return _without(edits, pair)
    for move in edits.moved:
        if pair in (move[:4], move[4:]):
            return replace(edits, moved=tuple(m for m in edits.moved if m != move))
    return _with(_without(edits, pair), "restored", pair)


def pin(edits: FrameEdits, pair: Pair) -> FrameEdits:
    """The pair is never removed; pinned again, it is let go."""
    pair = round_pair(pair)
    if pair in edits.pinned:
        return _without(edits, pair)
    if _is_own(edits, pair):
        return edits
    return _with(_without(edits, pair), "pinned", pair)


def add(edits: FrameEdits, pair: Pair) -> FrameEdits:
    """Add a pair of one's own."""
    return _with(_without(edits, round_pair(pair)), "added", round_pair(pair))


def move(edits: FrameEdits, pair: Pair, to: Pair) -> FrameEdits:
    """Put a pair elsewhere; it is then a person's own.

    >>> moved = move(FrameEdits(), (1, 2, 3, 4), (1, 2, 3, 4.5))
    >>> moved.moved, move(moved, (1, 2, 3, 4.5), (1, 2, 3, 4)) == FrameEdits()
    (((1.0, 2.0, 3.0, 4.0, 1.0, 2.0, 3.0, 4.5),), True)
    """
    pair, to = round_pair(pair), round_pair(to)
    if pair == to:
        return edits
    for kind in ("added", "checks"):
        if pair in getattr(edits, kind):
            return _with(_without(edits, pair), kind, to)
    first = next((m[:4] for m in edits.moved if m[4:] == pair), pair)
    kept = tuple(m for m in edits.moved if m[:4] != first)
    edits = replace(_without(edits, first), moved=kept)
    if first == to:
        return edits
    return replace(edits, moved=tuple(sorted((*kept, (*first, *to)))))


def check(edits: FrameEdits, pair: Pair) -> FrameEdits:
    """Keep a pair as a check point, which measures and is never fitted; or let it go again."""
    pair = round_pair(pair)
    if pair in edits.checks:
        return _without(edits, pair)
    return _with(_without(edits, pair), "checks", pair)


def set_threshold(edits: FrameEdits, name: str, value: float | None) -> FrameEdits:
    """Set `reject` or `stop`, reference px; None gives the campaign's back.

    Raises OperationRefused where the value makes no sense.
    """
    if name not in THRESHOLDS:
        raise refused("there is no such slider", name, ", ".join(THRESHOLDS))
    if value is None:
        return _set(edits, name, None)
    low, high = THRESHOLDS[name]
    if not low <= value <= high:
        raise refused(f"`{name}` cannot be that", value, f"{low:g} to {high:g} reference px")
    return _set(edits, name, round(float(value), 3))


OPERATIONS: dict[str, Callable[..., FrameEdits]] = {
    "delete": delete,
    "restore": restore,
    "pin": pin,
    "add": add,
    "move": move,
    "check": check,
}


def refused(message: str, found: object, expected: str) -> OperationRefused:
    """Return the refusal of an operation."""
    return OperationRefused(Problem("E_VALUE", message, found=found, expected=expected))


def _is_own(edits: FrameEdits, pair: Pair) -> bool:
    return pair in edits.added or any(m[4:] == pair for m in edits.moved)


def _without(edits: FrameEdits, pair: Pair) -> FrameEdits:
    for kind in KINDS:
        pairs = getattr(edits, kind)
        if pair in pairs:
            edits = _set(edits, kind, tuple(p for p in pairs if p != pair))
    return edits


def _with(edits: FrameEdits, kind: str, pair: Pair) -> FrameEdits:
    return _set(edits, kind, tuple(sorted({*getattr(edits, kind), pair})))


def _set(edits: FrameEdits, name: str, value: Any) -> FrameEdits:
    return replace(edits, **{name: value})
