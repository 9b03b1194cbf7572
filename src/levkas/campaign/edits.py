"""edits.toml: corrections made by hand on screen, kept beside campaign.toml and replayed by a build.

Several workbenches and a person with an editor may change the file at one time: a change is written on
top of what the file holds by then, and what it holds besides, comments included, stays as it is.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import partial
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from levkas.campaign.schema.tables import ConfirmKeys

FILE_NAME, HISTORY_NAME = "edits.toml", ".edits.history.json"
"""Beside campaign.toml: the corrections, and by which steps the workbench came to them."""
MOST_TURNS = 50
"""Attempts to make a change while others change the file."""
EXPLAINED = "docs/reference/edits.md explains every key; the workbench writes the file for you."
AGAIN = "Check its present state, then make the change again."
BY_HAND = "by hand"
"""Value of `accept`: the map is fitted to the pairs alone."""
HEAD = """\
# Corrections by hand; `levkas inspect` writes this file, `levkas build` replays it.
# A pair is [reference x, reference y, target x, target y], native pixels, centres at whole numbers.
version = 1
"""

Pair = tuple[float, ...]
Outline = tuple[tuple[float, float], ...]


class EditsInvalid(Refused):
    """edits.toml cannot be used; every reason is listed."""


class EditsConflict(Refused):
    """A change contradicts what edits.toml holds by now, which is `present`: a frame's corrections, or an outline."""

    def __init__(self, *problems: Problem, present: Any) -> None:
        super().__init__(*problems)
        self.present = present

    def __reduce__(self) -> tuple[Any, ...]:
        return partial(type(self), present=self.present), self.problems


@dataclass(frozen=True)
class FrameEdits:
    """Corrections of one frame: a camera, its lighting, and a band that names its sensor.

    Parameters
    ----------
    deleted, restored, pinned, added, checks : tuple of (4,) pairs
        Reference x, y and target x, y; px rounded to 0.01.
    moved : tuple of (8,)
        A pair as it was found, and the pair that takes its place.
    reject, stop : float or None, reference px
        Instead of the campaign's.
    accept : {"by hand", ""}
        Whether the map is fitted to the person's pairs and to nothing else.

    Examples
    --------
    >>> edits = FrameEdits(moved=((1, 2, 3, 4, 1, 2, 3, 5),))
    >>> edits.pairs()["added"].tolist(), edits.pairs()["deleted"].tolist()
    ([[1.0, 2.0, 3.0, 5.0]], [[1.0, 2.0, 3.0, 4.0]])
    """

    deleted: tuple[Pair, ...] = ()
    restored: tuple[Pair, ...] = ()
    pinned: tuple[Pair, ...] = ()
    added: tuple[Pair, ...] = ()
    moved: tuple[Pair, ...] = ()
    checks: tuple[Pair, ...] = ()
    reject: float | None = None
    stop: float | None = None
    accept: str = ""

    def __bool__(self) -> bool:
        return self != FrameEdits()

    def pairs(self) -> dict[str, Any]:
        """Return the pairs by their kind, each (n, 4): a move deletes a pair and adds another."""
        rows = {
            "added": (*self.added, *(move[4:] for move in self.moved)),
            "pinned": self.pinned,
            "restored": self.restored,
            "deleted": (*self.deleted, *(move[:4] for move in self.moved)),
            "checks": self.checks,
        }
        return {kind: np.array(found, float).reshape(-1, 4) for kind, found in rows.items()}

    def describe(self) -> str:
        """Return in a few words what a build depends on, with a hash of all of it; empty for nothing.

        >>> FrameEdits(added=((1, 2, 3, 4),)).describe()
        '1 added (e67e0ce8)'
        """
        record = {f.name: getattr(self, f.name) for f in fields(self)}
        if not self.accept:  # as before there was this key: what was built then stays fresh
            del record["accept"]
        parts = [f"{len(v)} {name}" for name, v in record.items() if isinstance(v, tuple) and v]
        parts += [f"{name} {record[name]:g}" for name in ("reject", "stop") if record[name]]
        parts += [f"accepted {self.accept}"] if self.accept else []
        if not parts:
            return ""
        text = json.dumps(
            {k: sorted(v) if isinstance(v, tuple) else v for k, v in record.items()}, sort_keys=True
        )
        return f"{', '.join(parts)} ({hashlib.sha256(text.encode()).hexdigest()[:8]})"


def merge(base: FrameEdits, ours: FrameEdits, theirs: FrameEdits) -> FrameEdits:
    """Return what came of `base` by the changes of both; where both changed one number, theirs.

    Pairs are merged one by one: what either added is there, what either took away is not.

    >>> base = FrameEdits(deleted=((1, 2, 3, 4), (5, 6, 7, 8)))
    >>> merge(base, FrameEdits(deleted=base.deleted[:1]), replace(base, pinned=((9, 9, 9, 9),)))
    FrameEdits(deleted=((1, 2, 3, 4),), restored=(), pinned=((9, 9, 9, 9),), added=(), moved=(), checks=(), reject=None, stop=None, accept='')
    """
    merged: dict[str, Any] = {}
    for name in (f.name for f in fields(FrameEdits)):
        first, one, other = (getattr(edits, name) for edits in (base, ours, theirs))
        if isinstance(first, tuple):
            removed, new = set(first) - set(one), set(one) - set(first)
            merged[name] = tuple(sorted((set(other) - removed) | new))
        else:
            merged[name] = other if other != first else one
    return FrameEdits(**merged)


@dataclass(frozen=True)
class Edits:
    """All corrections of a campaign: (object, frame) → what was corrected.

    Parameters
    ----------
    frames : mapping
        Frames as the contract names them: ``"d80"``, ``"d80@45-degree"``, ``"msbs:IR"``, ``"xray#left"``; ``"d80#r2c3#r2c2"`` is
        a tile of the reference beside its neighbour.
    outlines : mapping
        Object → the corners of its outline, reference px, in place of campaign.toml's.
    confirmed : mapping
        (object, layer) → who accepts it in spite of doubts.
    """

    frames: Mapping[tuple[str, str], FrameEdits] = field(default_factory=dict)
    outlines: Mapping[str, Outline] = field(default_factory=dict)
    confirmed: Mapping[tuple[str, str], ConfirmKeys] = field(default_factory=dict)

    def of_layer(self, name: str, layer: str) -> dict[str, FrameEdits]:
        """Return the corrections of a layer: band ("" for its first sensor) → what was corrected."""
        found = {}
        for (object_, frame), edits in sorted(self.frames.items()):
            here, _, band = frame.partition(":")
            if object_ == name and here == layer and edits:
                found[band] = edits
        return found

    def of_tiles(self, name: str, layer: str) -> dict[str, dict[str, FrameEdits]]:
        """Return the corrections of the tiles of a layer: tile, or tile#neighbour → band → what was corrected."""
        frames = {frame.partition(":")[0] for object_, frame in self.frames if object_ == name}
        tiles = sorted(f.partition("#")[2] for f in frames if f.partition("#")[:2] == (layer, "#"))
        found = {tile: self.of_layer(name, f"{layer}#{tile}") for tile in tiles}
        return {tile: bands for tile, bands in found.items() if bands}

    def with_frame(self, name: str, frame: str, edits: FrameEdits) -> Edits:
        """Return these corrections with those of one frame replaced; without it where there are none."""
        frames = {key: value for key, value in self.frames.items() if key != (name, frame)}
        return replace(self, frames=frames | ({(name, frame): edits} if edits else {}))

    def with_outline(self, name: str, outline: Outline) -> Edits:
        """Return these corrections with the outline of one object replaced; without it where it has no corners."""
        others = {key: value for key, value in self.outlines.items() if key != name}
        return replace(self, outlines=others | ({name: outline} if outline else {}))


def read_edits(path: Path) -> Edits:
    """Read edits.toml; no corrections where there is no such file.

    Raises
    ------
    EditsInvalid
        With everything that is wrong with it.
    """
    if not os.path.lexists(path):  # a link that leads nowhere is there, and refused
        return Edits()
    from levkas.campaign.schema.toml import TomlRefused, read_toml

    try:
        return _validated(read_toml(path), path)
    except TomlRefused as refused:
        raise EditsInvalid(*refused.problems) from None


def _validated(record: dict[str, Any], path: Path) -> Edits:
    from pydantic import ValidationError

    from levkas.campaign.schema.error_messages import MOST_PROBLEMS, explain
    from levkas.campaign.schema.tables import EditsDocument

    try:
        document = EditsDocument.model_validate(record)
    except ValidationError as invalid:
        errors = invalid.errors(include_url=False, include_context=False)
        problems = explain(record, errors, EditsDocument)
        raise EditsInvalid(*(with_explanation(p, path) for p in problems)) from None
    frames = {
        (name, frame): FrameEdits(**{k: _rounded(v) for k, v in dict(keys).items()})
        for name, table in document.objects.items()
        for frame, keys in table.cameras.items()
    }
    outlines = {
        name: round_corners(table.outline)
        for name, table in document.objects.items()
        if table.outline is not None
    }
    confirmed = {one.camera.partition("/")[::2]: one for one in document.confirm}
    edits = Edits({key: value for key, value in frames.items() if value}, outlines, confirmed)
    problems = list(islice(_contradictions(edits), MOST_PROBLEMS))
    if len(confirmed) < len(document.confirm):
        problems.append(Problem("E_VALUE", "a layer is confirmed twice", field="confirm"))
    if problems:
        raise EditsInvalid(*(with_explanation(p, path) for p in problems))
    return edits


def write_edits(path: Path, edits: Edits) -> None:
    """Write edits.toml: the same corrections give the same bytes, in whatever order they were made."""
    from levkas.core.files import write_text

    write_text(path, to_text(edits))


def change_edits(
    path: Path, name: str, frame_of: Callable[[Edits], str], before: FrameEdits, after: FrameEdits
) -> FrameEdits:
    """Write what a change made of one frame's corrections, on top of what edits.toml holds by now.

    Parameters
    ----------
    path : Path
        edits.toml, which may not exist yet.
    name : str
        Of the object.
    frame_of : callable
        Gives the frame's name in a file of these corrections.
    before, after : FrameEdits
        The corrections as they were known, and with the change.

    Returns
    -------
    written : FrameEdits
        What the file holds of the frame now; it is on the disk.

    Raises
    ------
    EditsConflict
        Where the change contradicts what others wrote meanwhile; the file is as it was.
    EditsInvalid
        Where the file cannot be read.
    WriteRefused, Taken
        Where it cannot be written, or another process holds it.
    """

    def changed(edits: Edits) -> Edits:
        frame = frame_of(edits)
        present = edits.frames.get((name, frame), FrameEdits())
        merged = merge(before, after, present)
        where = f"objects.{name}.cameras.{frame}"
        if problems := _clashes(before, after, present, merged, where):
            raise EditsConflict(*(with_explanation(p, path) for p in problems), present=present)
        return edits.with_frame(name, frame, merged)

    written = _change(path, changed)
    return written.frames.get((name, frame_of(written)), FrameEdits())


def change_outline(path: Path, name: str, before: Outline, after: Outline) -> Outline:
    """Write the outline of an object, on top of what edits.toml holds by now; none where it has no corners.

    Parameters
    ----------
    path : Path
        edits.toml, which may not exist yet.
    name : str
        Of the object.
    before, after : (n, 2) corners, reference px
        The outline as it was known, and as it is to be.

    Returns
    -------
    written : (n, 2) corners, reference px, rounded to 0.01
        What the file holds now; it is on the disk.

    Raises
    ------
    EditsConflict, EditsInvalid, WriteRefused, Taken
        As `change_edits` does; an outline that is no polygon is E_VALUE of EditsInvalid.
    """
    before, after = round_corners(before), round_corners(after)

    def changed(edits: Edits) -> Edits:
        present = edits.outlines.get(name, ())
        if present not in (before, after):
            problem = Problem(
                "E_CONFLICT",
                "the outline has changed in the meantime",
                str(path),
                field=f"objects.{name}.outline",
                found=f"{len(present)} corners",
                expected=f"{len(before)} corners",
                fix=AGAIN,
            )
            raise EditsConflict(problem, present=present)
        return edits.with_outline(name, after)

    return _change(path, changed).outlines.get(name, ())


def change_confirmation(path: Path, name: str, layer: str, word: ConfirmKeys | None) -> None:
    """Write who accepts a layer into edits.toml, None that nobody does any more; raises as `change_outline`."""

    def changed(edits: Edits) -> Edits:
        others = {key: value for key, value in edits.confirmed.items() if key != (name, layer)}
        return replace(edits, confirmed=others | ({(name, layer): word} if word else {}))

    _change(path, changed)


def _change(path: Path, changed: Callable[[Edits], Edits]) -> Edits:
    """Write what `changed` makes of the corrections that the file holds by now; return what it holds then."""
    from levkas.core.files import together, write_text
    from levkas.core.locks import locked

    with locked(lock_of(path)):
        for _ in range(MOST_TURNS):
            data = _bytes_of(path)
            edits = read_edits(path)
            wanted = changed(edits)
            if wanted == edits:
                return edits
            text = _revised(data, edits, wanted, path)

            def unchanged(data: bytes = data) -> None:
                if _bytes_of(path) != data:
                    raise _Changed

            try:
                with together(before=unchanged):
                    write_text(path, text)
            except _Changed:  # by an editor, which takes no lock
                continue
            return wanted
    problem = Problem("E_BUSY", "another program keeps changing edits.toml", str(path))
    raise EditsInvalid(with_explanation(problem, path))


def lock_of(path: Path) -> Path:
    """Return the lock of edits.toml: a file that is there while somebody changes that."""
    return path.with_name(f".{path.name}.lock")


def sweep_corrections(folder: Path) -> None:
    """Take away what a killed workbench left beside campaign.toml; what another one holds stays.

    Where the disk refuses it stays too: it is in nobody's way.
    """
    from levkas.core.locks import locked
    from levkas.core.sweeping import sweep_beside

    lock = lock_of(folder / FILE_NAME)
    with contextlib.suppress(Refused, OSError):
        for name in (FILE_NAME, HISTORY_NAME):
            sweep_beside(folder / name)
        if lock.is_file():
            with locked(lock, patience_s=0):  # which removes it
                pass


class _Changed(Exception):
    """The file is no longer what it was when it was read."""


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


def _clashes(
    before: FrameEdits, after: FrameEdits, present: FrameEdits, merged: FrameEdits, where: str
) -> list[Problem]:
    """Return the conflicts of a change with the present state."""
    found = [
        Problem(
            "E_CONFLICT",
            f"`{name}` has changed in the meantime",
            field=f"{where}.{name}",
            found=getattr(present, name),
            expected=getattr(before, name),
            fix=AGAIN,
        )
        for name in ("reject", "stop", "accept")
        if getattr(before, name) not in (getattr(after, name), getattr(present, name))
        and getattr(after, name) != getattr(present, name)
    ]
    if merged != present:
        for problem in _contradictions(Edits({("", ""): merged})):
            key = (problem.field or "").rpartition(".")[2]
            message = f"{problem.message}: it has changed in the meantime"
            field_ = f"{where}.{key}"
            found.append(
                replace(problem, code="E_CONFLICT", message=message, field=field_, fix=AGAIN)
            )
    return found


def _revised(data: bytes, edits: Edits, wanted: Edits, path: Path) -> str:
    """Return the file's text as wanted: written anew where it is as we write it, else in place, where it differs."""
    text = data.decode("utf-8-sig")
    made = to_text(wanted)
    if text.strip() and text != to_text(edits):
        made = _revised_in_place(text, edits, wanted)
    with contextlib.suppress(tomllib.TOMLDecodeError):
        if _validated(tomllib.loads(made), path) == wanted:
            return made
    problem = Problem(
        "E_VALUE",
        "the layout of edits.toml does not allow changes in place",
        field="objects",
        expected="a table of its own for every object and camera",
    )
    raise EditsInvalid(with_explanation(problem, path))


def _revised_in_place(text: str, edits: Edits, wanted: Edits) -> str:
    """Return a text of a person's own making with the tables changed in which `wanted` differs; a table that is missing is added at the end."""
    import tomlkit

    document = tomlkit.parse(text)
    changes: list[tuple[tuple[str, ...], dict[str, Any], Edits]] = []
    for name in sorted(edits.outlines.keys() | wanted.outlines.keys()):
        corners = wanted.outlines.get(name, ())
        if corners != edits.outlines.get(name, ()):
            made = Edits().with_outline(name, corners)
            values = {"outline": [list(corner) for corner in corners] or None}
            changes.append((("objects", name), values, made))
    for name, frame in sorted(edits.frames.keys() | wanted.frames.keys()):
        one = wanted.frames.get((name, frame), FrameEdits())
        if one != edits.frames.get((name, frame), FrameEdits()):
            values = {f.name: getattr(one, f.name) for f in fields(FrameEdits)}
            table_of = ("objects", name, "cameras", frame)
            changes.append((table_of, values, Edits().with_frame(name, frame, one)))
    added = []
    for place, values, made in changes:
        table: Any = document
        for part in place:
            table = table.get(part) if table is not None else None
        if table is None:
            added.append(to_text(made).removeprefix(f"{HEAD}\n"))
        else:
            if isinstance(table, tomlkit.items.Table) and table.is_super_table():
                table.trivia.comment = table.trivia.comment_ws = (
                    ""  # which tomlkit took from the first table below it
                )
            for key, value in values.items():
                _revise(table, key, value)
    if wanted.confirmed != edits.confirmed:
        document.pop("confirm", None)
        if wanted.confirmed:
            added.append(to_text(Edits(confirmed=wanted.confirmed)).removeprefix(f"{HEAD}\n"))
    text = tomlkit.dumps(document)
    return "\n\n".join([text.rstrip(), *added]) if added else text


def _revise(table: Any, key: str, value: Any) -> None:
    """Change one key of a table of tomlkit; rows that stay keep their place and their comments."""
    import tomlkit

    if value in (None, "", ()):
        table.pop(key, None)
        return
    if not isinstance(value, tuple):
        if table.get(key) != value:
            _put(table, key, value)
        return
    if key not in table:
        rows = "".join(f"  {_row(row)},\n" for row in value)
        _put(table, key, tomlkit.parse(f"{key} = [\n{rows}]\n")[key])
        return
    array, missing = table[key], set(value)
    for at in reversed(range(len(array))):
        row = round_pair(array[at])
        if row in missing:
            missing.discard(row)
        else:
            del array[at]
    for row in sorted(missing):
        new: Any = tomlkit.parse(f"{key} = {_row(row)}")[key]
        if "\n" in array.as_string():
            array.add_line(new, indent="  ")
        else:
            array.append(new)


def _put(table: Any, key: str, value: Any) -> None:
    """Set a key; a new one comes before the comments that lead to the next table."""
    body = table.value.body if hasattr(table.value, "body") else []
    trailing = []
    while key not in table and body and body[-1][0] is None:
        trailing.append(body.pop()[1])
    table[key] = value
    for item in reversed(trailing):
        table.add(item)


def to_text(edits: Edits) -> str:
    """Return the text of edits.toml."""
    from levkas.campaign.schema.toml import to_inline_toml

    lines = [HEAD]
    for name, outline in sorted(edits.outlines.items()):
        lines += [f"[objects.{to_inline_toml(name)}]", f"outline = {_row_of_corners(outline)}", ""]
    for (name, frame), one in sorted(edits.frames.items()):
        if not one:
            continue
        lines.append(f"[objects.{to_inline_toml(name)}.cameras.{to_inline_toml(frame)}]")
        for key in (f.name for f in fields(FrameEdits)):
            value = getattr(one, key)
            if isinstance(value, tuple) and value:
                lines.append(f"{key} = [")
                lines += [f"  {_row(row)}," for row in sorted(value)]
                lines.append("]")
            elif isinstance(value, float):
                lines.append(f"{key} = {value!r}")
            elif value:
                lines.append(f"{key} = {to_inline_toml(value)}")
        lines.append("")
    for _, word in sorted(edits.confirmed.items()):
        rows = (f"{key} = {to_inline_toml(value)}" for key, value in word)
        lines += ["[[confirm]]", *rows, ""]
    return "\n".join(lines)


def round_pair(pair: Iterable[float]) -> Pair:
    """Round a pair as edits.toml keeps it.

    >>> round_pair((1.004, -0.001, 2.126, 3))
    (1.0, 0.0, 2.13, 3.0)
    """
    return tuple(round(float(v), 2) + 0.0 for v in pair)


def _row(row: Pair) -> str:
    return f"[{', '.join(f'{v:.2f}' for v in row)}]"


def _row_of_corners(outline: Outline) -> str:
    return f"[{', '.join(_row(corner) for corner in outline)}]"


def round_corners(outline: Iterable[Iterable[float]]) -> Outline:
    """Round the corners of an outline as edits.toml keeps them.

    >>> round_corners([(1.004, -0.001), (9, 0), (9, 2.126)])
    ((1.0, 0.0), (9.0, 0.0), (9.0, 2.13))
    """
    return tuple((round(float(x), 2) + 0.0, round(float(y), 2) + 0.0) for x, y in outline)


def _rounded(value: Any) -> Any:
    if isinstance(value, tuple):
        return tuple(sorted({round_pair(row) for row in value}))
    return float(value) if isinstance(value, int) else value


def _contradictions(edits: Edits) -> Iterator[Problem]:
    """Yield pairs that are corrected in two ways at once."""
    for (name, frame), one in sorted(edits.frames.items()):
        kinds: dict[Pair, str] = {}
        where = f"objects.{name}.cameras.{frame}"
        for key in ("deleted", "restored", "pinned", "added", "checks", "moved"):
            for row in getattr(one, key):
                before = kinds.setdefault(row[:4], key)
                if before != key:
                    yield Problem(
                        "E_VALUE",
                        f"a pair is both {before} and {key}",
                        field=f"{where}.{key}",
                        found=", ".join(f"{v:.2f}" for v in row[:4]),
                        fix="Keep one of them.",
                    )
        if len({row[:4] for row in one.moved}) < len(one.moved):
            yield Problem(
                "E_VALUE",
                "a pair is moved to two places",
                field=f"{where}.moved",
                fix="Keep one of them.",
            )
        if one.reject is not None and one.stop is not None and one.reject <= one.stop:
            yield Problem(
                "E_VALUE",
                "`reject` must be above `stop`",
                field=f"{where}.reject",
                found=one.reject,
                expected=f"more than {one.stop:g}",
            )


def with_explanation(problem: Problem, path: Path) -> Problem:
    """Return a problem with the file, and where the keys are explained unless it has a fix of its own."""
    return replace(problem, file=str(path), fix=problem.fix or EXPLAINED)
