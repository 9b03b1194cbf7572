"""edits.toml: corrections made by hand on screen, kept beside campaign.toml and replayed by a build.

The file belongs to the program: every change writes it anew, sorted, so that the same corrections are the same bytes. A change
is made of a state that was read; where the file holds another by then, it is refused with what is there.
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

FILE_NAME = "edits.toml"
"""Beside campaign.toml: the corrections."""
EXPLAINED = "docs/reference/edits.md explains every key; the workbench writes the file for you."
AGAIN = "Check its present state, then make the change again."
BY_HAND = "by hand"
"""Value of `accept`: the map is fitted to the pairs alone."""
HEAD = """\
# Corrections by hand; `levkas inspect` writes this file anew, without your comments; `levkas build` replays it.
# A pair is [reference x, reference y, target x, target y], native pixels, centres at whole numbers.
version = 1
"""

Pair = tuple[float, ...]
Outline = tuple[tuple[float, float], ...]


class EditsInvalid(Refused):
    """edits.toml cannot be used; every reason is listed."""


class EditsConflict(Refused):
    """edits.toml has changed since it was read, and holds `present`: a frame's corrections, or an outline."""

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
    """Write the corrections of one frame, `after` instead of `before`, by which they were known; return what the file holds now.

    `frame_of` gives the frame's name in a file of these corrections.

    Raises
    ------
    EditsConflict
        Where the file holds others than `before`; it is as it was.
    EditsInvalid
        Where the file cannot be read.
    WriteRefused, Taken
        Where it cannot be written, or another process holds it.
    """

    def changed(edits: Edits) -> Edits:
        frame = frame_of(edits)
        present = edits.frames.get((name, frame), FrameEdits())
        if present not in (before, after):
            raise _conflict(path, f"objects.{name}.cameras.{frame}", present)
        return edits.with_frame(name, frame, after)

    written = _change(path, changed)
    return written.frames.get((name, frame_of(written)), FrameEdits())


def change_outline(path: Path, name: str, before: Outline, after: Outline) -> Outline:
    """Write the outline of an object, corners in reference px, none for no outline; return what the file holds, rounded to 0.01.

    Raises as `change_edits`; an outline that is no polygon is E_VALUE of EditsInvalid.
    """
    before, after = round_corners(before), round_corners(after)

    def changed(edits: Edits) -> Edits:
        present = edits.outlines.get(name, ())
        if present not in (before, after):
            raise _conflict(path, f"objects.{name}.outline", present)
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
        data, edits = _bytes_of(path), read_edits(path)
        wanted = changed(edits)
        if wanted == edits:
            return edits
        text = to_text(wanted)
        _validated(tomllib.loads(text), path)

        def unchanged() -> None:
            if _bytes_of(path) != data:  # by an editor, which takes no lock
                busy = Problem("E_BUSY", "another program writes edits.toml", str(path), fix=AGAIN)
                raise EditsInvalid(busy)

        with together(before=unchanged):
            write_text(path, text)
        return wanted


def _conflict(path: Path, field: str, present: Any) -> EditsConflict:
    """Return the refusal of a change of what others have changed since, with what is there."""
    message, fix = "edits.toml has changed since it was read", AGAIN
    return EditsConflict(Problem("E_CONFLICT", message, str(path), field, fix=fix), present=present)


def lock_of(path: Path) -> Path:
    """Return the lock of edits.toml: a file that is there while somebody changes that."""
    return path.with_name(f".{path.name}.lock")


def sweep_corrections(folder: Path) -> None:
    """Take away what a killed workbench left beside campaign.toml; what another one holds stays.

    Where the disk refuses it stays too: it is in nobody's way.
    """
    from levkas.core.files import sweep_beside
    from levkas.core.locks import locked

    lock = lock_of(folder / FILE_NAME)
    with contextlib.suppress(Refused, OSError):
        sweep_beside(folder / FILE_NAME)
        if lock.is_file():
            with locked(lock, patience_s=0):  # which removes it
                pass


def _bytes_of(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except OSError:
        return b""


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
