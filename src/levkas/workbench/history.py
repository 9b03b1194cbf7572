"""Steps of corrections, and the file beside edits.toml that keeps them, so that undo outlives the server.

A step is what one change took away and brought, not a state: undo takes a step back from whatever the
corrections are by then, so that changes by others stay. edits.toml alone decides what is built; a history
that is damaged or missing costs undo and the numbers of pairs by hand, nothing else.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, field, fields, replace
from itertools import islice
from typing import TYPE_CHECKING, Any

from levkas.campaign.edits import FILE_NAME, HISTORY_NAME, FrameEdits, Outline, Pair, lock_of
from levkas.core.problems import Refused

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from pathlib import Path

VERSION = 2
MOST_STEPS = 200
"""Steps that are kept of a camera; the oldest go."""
MOST_ROWS = 100_000
"""Pairs that all steps of a camera may name."""
QUARTERS = (0, 90, 180, 270)


@dataclass(frozen=True)
class CorrectionStep:
    """One change of the corrections of a camera, or of the outline of its object.

    Parameters
    ----------
    removed, new : dict of str to tuple of pairs
        By the field of `FrameEdits`: what the change took away, and what it brought.
    values : dict of str to (before, after)
        Of `reject`, `stop` and `accept`.
    outline : (before, after) or None
        Corners in reference px, none where no outline was drawn. Such a step changes nothing else.

    Examples
    --------
    >>> before, after = FrameEdits(), FrameEdits(pinned=((1.0, 2.0, 3.0, 4.0),), stop=2.0)
    >>> step = CorrectionStep.between(before, after)
    >>> step.onward(before) == after, step.back(after) == before
    (True, True)
    """

    removed: dict[str, tuple[Pair, ...]] = field(default_factory=dict)
    new: dict[str, tuple[Pair, ...]] = field(default_factory=dict)
    values: dict[str, tuple[Any, Any]] = field(default_factory=dict)
    outline: tuple[Outline, Outline] | None = None

    @classmethod
    def between(cls, before: FrameEdits, after: FrameEdits) -> CorrectionStep:
        """Return the step from one state to another."""
        step = cls()
        for name in (f.name for f in fields(FrameEdits)):
            one, other = getattr(before, name), getattr(after, name)
            if one == other:
                continue
            if not isinstance(one, tuple):
                step.values[name] = (one, other)
                continue
            step.removed[name] = tuple(sorted(set(one) - set(other)))
            step.new[name] = tuple(sorted(set(other) - set(one)))
        return step

    def onward(self, edits: FrameEdits) -> FrameEdits:
        """Return corrections with this step taken; what others set meanwhile stays."""
        changed: dict[str, Any] = {}
        for name in {**self.removed, **self.new}:
            rows = set(getattr(edits, name)) - set(self.removed.get(name, ()))
            changed[name] = tuple(sorted(rows | set(self.new.get(name, ()))))
        for name, (before, after) in self.values.items():
            changed[name] = after if getattr(edits, name) == before else getattr(edits, name)
        return replace(edits, **changed)

    def back(self, edits: FrameEdits) -> FrameEdits:
        """Return corrections with this step taken back."""
        return self.reversed().onward(edits)

    def reversed(self) -> CorrectionStep:
        """Return the step that takes this one back."""
        values = {name: (after, before) for name, (before, after) in self.values.items()}
        outline = self.outline and self.outline[::-1]
        return CorrectionStep(self.new, self.removed, values, outline)

    def changes(self, edits: FrameEdits, outline: Outline) -> bool:
        """Return whether the step would change anything: not where others have changed the same meanwhile."""
        if self.outline is not None:
            return self.outline[0] == outline
        return self.onward(edits) != edits

    def to_dict(self) -> dict[str, Any]:
        """Return it JSON-ready."""
        record = {"removed": self.removed, "new": self.new, "values": self.values}
        return record if self.outline is None else {**record, "outline": self.outline}

    @classmethod
    def from_dict(cls, record: Any) -> CorrectionStep:
        """Read what `to_dict` gave; raises ValueError, TypeError, KeyError or AttributeError."""
        empty = FrameEdits()
        rows: list[dict[str, tuple[Pair, ...]]] = []
        for part in (record["removed"], record["new"]):
            rows.append({name: _rows(name, found) for name, found in part.items()})
        values = {}
        for name, (before, after) in record["values"].items():
            kinds = (str,) if name == "accept" else (float, type(None))
            if isinstance(getattr(empty, name), tuple) or not all(
                isinstance(value, kinds) for value in (before, after)
            ):
                raise ValueError(name)
            values[name] = (before, after)
        outline = record.get("outline")
        if outline is not None:
            before, after = (_corners(found) for found in outline)
            outline = before, after
        return cls(rows[0], rows[1], values, outline)


def _rows(name: str, found: Any) -> tuple[Pair, ...]:
    if not isinstance(getattr(FrameEdits(), name), tuple):
        raise ValueError(name)
    rows = tuple(tuple(float(value) for value in row) for row in found)
    if any(len(row) != (8 if name == "moved" else 4) for row in rows):
        raise ValueError(name)
    return rows


def _corners(found: Any) -> Outline:
    return tuple((float(x), float(y)) for x, y in found)


@dataclass
class History:
    """Changes of one camera that can be undone and redone, and the numbers of a person's own pairs.

    Parameters
    ----------
    done, undone : list of CorrectionStep
        The last is the next to be undone, or redone.
    numbers : dict of pair to int
        Numbers by which a person's own pairs are known, wherever they stand in the table.
    """

    done: list[CorrectionStep] = field(default_factory=list)
    undone: list[CorrectionStep] = field(default_factory=list)
    numbers: dict[Pair, int] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return the latest of it JSON-ready, bounded in steps and in pairs."""
        kept: list[CorrectionStep] = []
        rows = 0
        for step in reversed(self.done[-MOST_STEPS:]):
            rows += sum(
                map(len, (*step.removed.values(), *step.new.values(), *(step.outline or ())))
            )
            if rows > MOST_ROWS:
                break
            kept.insert(0, step)
        numbers = [[*pair, number] for pair, number in list(self.numbers.items())[-MOST_ROWS:]]
        undone = self.undone[-MOST_STEPS:] if rows <= MOST_ROWS else []
        steps = {"done": kept, "undone": undone}
        return {
            **{name: [step.to_dict() for step in found] for name, found in steps.items()},
            "numbers": numbers,
        }

    @classmethod
    def from_dict(cls, record: Any) -> History:
        """Read what `to_dict` gave; an empty one where that is damaged."""
        try:
            done, undone = (
                [CorrectionStep.from_dict(step) for step in record[name][-MOST_STEPS:]]
                for name in ("done", "undone")
            )
            numbers = {
                tuple(float(value) for value in pair): int(number)
                for *pair, number in record["numbers"][-MOST_ROWS:]
                if len(pair) == 4 and int(number) > 0
            }
        except (ValueError, TypeError, KeyError, AttributeError, OverflowError):
            return cls()
        return cls(done, undone, numbers)


@dataclass(frozen=True)
class HistoryFile:
    """The file of the histories of a campaign, and of how each object is turned on screen.

    Parameters
    ----------
    root : Path
        Folder of the campaign.
    """

    root: Path

    @property
    def path(self) -> Path:
        """Of the file."""
        return self.root / HISTORY_NAME

    def read(self, name: str, frame: str) -> History:
        """Return the history of a camera of an object."""
        return History.from_dict(_at(self._record(), "objects", name, "cameras", frame))

    def write(self, name: str, frame: str, record: dict[str, Any]) -> None:
        """Keep the history of a camera, of `to_dict`; in silence where it cannot be written: edits.toml is what counts."""

        def put(one: dict[str, Any]) -> None:
            _table(one, "cameras")[frame] = record

        with contextlib.suppress(Refused, OSError):
            self._change(name, put)

    def turn(self, name: str) -> int | None:
        """Return by how many degrees clockwise a person turned an object; None where nobody did."""
        found = _at(self._record(), "objects", name, "turn")
        return int(found) if found in QUARTERS else None

    def set_turn(self, name: str, degrees: int) -> None:
        """Keep how an object is turned. Raises WriteRefused, Taken."""
        self._change(name, lambda one: one.update(turn=degrees))

    def _record(self) -> dict[str, Any]:
        from levkas.core.text import read_json

        if not self.path.is_file():
            return {}
        try:
            record = read_json(self.path)
        except Refused:
            return {}
        return record if record.get("version") == VERSION else {}

    def _change(self, name: str, put: Callable[[dict[str, Any]], object]) -> None:
        from levkas.core.files import write_text
        from levkas.core.json_safe import to_json
        from levkas.core.locks import locked

        with locked(lock_of(self.root / FILE_NAME)):
            record = {**self._record(), "version": VERSION}
            put(_table(_table(record, "objects"), name))
            write_text(self.path, to_json(record))


def _at(record: Any, *names: str) -> Any:
    for name in names:
        record = record.get(name) if isinstance(record, dict) else None
    return record


def _table(record: dict[str, Any], name: str) -> dict[str, Any]:
    if not isinstance(record.get(name), dict):
        record[name] = {}
    return dict.__getitem__(record, name)


def number_pairs(
    found: int, own: Sequence[Pair], numbers: dict[Pair, int], origins: dict[Pair, int]
) -> list[int]:
    """Return a number for each pair: those that a method found in their order, then a person's own.

    A person's own pair has a number by its place, in `numbers`, which is extended: it keeps it while others come
    and go, and has it again when it comes back. A found pair that was moved keeps the number that it had.

    Parameters
    ----------
    found : int
        How many a method found.
    own : sequence of pairs
        Of a person, in the order of the table.
    numbers : dict of pair to int
        Numbers given so far.
    origins : dict of pair to int
        Places to which a found pair was moved, and its row.

    Examples
    --------
    >>> given = {}
    >>> number_pairs(2, [(1.0, 1.0, 1.0, 1.0)], given, {})
    [1, 2, 3]
    >>> number_pairs(2, [(0.0, 0.0, 0.0, 0.0), (1.0, 1.0, 1.0, 1.0)], given, {})
    [1, 2, 4, 3]
    """
    taken = set(numbers.values())
    free = (number for number in range(1, found + len(taken) + 1) if number not in taken)
    first = list(islice(free, found))
    following = max([0, *first[-1:], *taken])
    for pair in own:
        if pair not in numbers and pair not in origins:
            following += 1
            numbers[pair] = following
    return first + [first[origins[p]] if p in origins else numbers[p] for p in own]
