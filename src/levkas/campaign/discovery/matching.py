"""Matching of a name with a pattern in steps that grow with both lengths, however many wildcards there are.

A regular expression tries every way to share a name out among its wildcards: of twelve stars and a name of sixty
letters those are 10¹². Here a place at which a part of the pattern failed is never tried again; what is found
is what the expression finds first.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

from levkas.core.problems import Problem, Refused

MOST_STEPS = 200_000
"""Of one name; only placeholders that stand twice with many readings of the first come near it."""
_DIGITS = re.compile(r"\d+")
_OPEN = re.compile(r"(?<![^\W_])")
_CLOSED = re.compile(r"(?![^\W_])")


@dataclass(frozen=True)
class Fixed:
    """Text that stands as it is, upper and lower case alike in its suffix."""

    source: re.Pattern[str]

    def ends(self, text: str, start: int) -> Iterator[int]:
        """Yield where it ends that begins at `start`, what an expression tries first coming first."""
        if found := self.source.match(text, start):
            yield found.end()


@dataclass(frozen=True)
class Span:
    """Any text within a name, of `least` letters or more; as much as it can be, or as little."""

    least: int = 0
    greedy: bool = True

    def ends(self, text: str, start: int, tried: int | None = None) -> Iterator[int]:
        """Yield as the others do; `tried` is a later start in the same name, whose ends have failed."""
        last = end_of_name(text, start) if tried is None else tried + self.least - 1
        places = range(start + self.least, last + 1)
        yield from reversed(places) if self.greedy else places


@dataclass(frozen=True)
class Number:
    """A number with or without decimals, never a part of a longer one."""

    def ends(self, text: str, start: int) -> Iterator[int]:
        before, point = text[start - 1 : start], text[max(start - 2, 0) : start]
        if before.isdecimal() or (len(point) == 2 and point[0].isdecimal() and point[1] == "."):
            return
        whole = _DIGITS.match(text, start)
        if whole is None:
            return
        point = text[whole.end() : whole.end() + 1]
        decimals = _DIGITS.match(text, whole.end() + 1) if point == "." else None
        if decimals:
            yield decimals.end()
        yield whole.end()


@dataclass(frozen=True)
class OneOf:
    """One of some values; beside a wildcard no part of a longer word."""

    values: tuple[str, ...]
    open_before: bool = False
    open_after: bool = False

    def ends(self, text: str, start: int) -> Iterator[int]:
        if self.open_before and not _OPEN.match(text, start):
            return
        for length in self.lengths:
            end = start + length
            if text[start:end] in self.known and (not self.open_after or _CLOSED.match(text, end)):
                yield end

    @cached_property
    def known(self) -> frozenset[str]:
        """The values, to be looked up: there may be thousands."""
        return frozenset(self.values)

    @cached_property
    def lengths(self) -> tuple[int, ...]:
        """How long they are, in their order."""
        return tuple(dict.fromkeys(map(len, self.values)))


@dataclass(frozen=True)
class Depths:
    """Any number of whole folders, none included; as many as there can be."""

    def ends(self, text: str, start: int) -> Iterator[int]:
        found = [start]
        while (slash := text.find("/", found[-1])) > found[-1]:
            found.append(slash + 1)
        yield from reversed(found)


def end_of_name(text: str, start: int) -> int:
    """Return where the name of a folder or file ends that a place lies in."""
    slash = text.find("/", start)
    return len(text) if slash < 0 else slash


Kind = Fixed | Span | Number | OneOf | Depths
Piece = tuple[Kind, str]
"""What it matches, and the name of the placeholder; empty for none."""


def match_pieces(pieces: Sequence[Piece], text: str) -> dict[str, str] | None:
    """Return what a text says by placeholder; None where it does not fit.

    A placeholder that stands twice stands for the same text.

    Raises
    ------
    Refused
        Where that alone leaves too many ways to read a name.
    """
    names = [name for _, name in pieces]
    twice = {name for name in names if name and names.count(name) > 1}
    failed: dict[tuple[object, ...], int] = {}
    places: list[int] = []
    known: list[dict[str, str]] = []
    waiting: list[Iterator[int]] = []

    def enter(index: int, start: int, said: dict[str, str]) -> None:
        """Go on with a piece at a place, unless it failed there."""
        tried = failed.get(_state(pieces, index, text, start, said))
        if tried is not None and tried <= start:
            return
        kind, name = pieces[index]
        places.append(start)
        known.append(said)
        if name in said:
            same = text.startswith(said[name], start)
            waiting.append(iter([start + len(said[name])] if same else []))
        elif isinstance(kind, Span):
            waiting.append(kind.ends(text, start, tried))
        else:
            waiting.append(kind.ends(text, start))

    enter(0, 0, {})
    for _ in range(MOST_STEPS):
        if not waiting:
            return None
        index, start, said = len(waiting) - 1, places[-1], known[-1]
        end = next(waiting[-1], None)
        if end is None:
            failed[_state(pieces, index, text, start, said)] = start
            for stack in (waiting, places, known):
                stack.pop()  # type: ignore[attr-defined]
        elif index + 1 < len(pieces):
            name = names[index]
            if name in twice and name not in said:
                said = {**said, name: text[start:end]}
            enter(index + 1, end, said)
        elif end == len(text):
            return _told(names, [*places, end], text)
    raise Refused(
        Problem(
            "E_VALUE",
            "a name can be read in too many ways",
            field="files",
            found=text[:80],
            expected="a pattern whose placeholders stand apart",
            fix="Put letters between the placeholders of `files`.",
        )
    )


def _state(
    pieces: Sequence[Piece], index: int, text: str, start: int, said: dict[str, str]
) -> tuple[object, ...]:
    """Return what a failure depends on: of a span the name that it lies in, for a later start ends where it may."""
    free = isinstance(pieces[index][0], Span) and pieces[index][1] not in said
    return index, end_of_name(text, start) if free else start, free, *said.items()


def _told(names: Sequence[str], places: Sequence[int], text: str) -> dict[str, str]:
    told: dict[str, str] = {}
    for name, start, end in zip(names, places[:-1], places[1:], strict=True):
        if name:
            told.setdefault(name, text[start:end])
    return told
