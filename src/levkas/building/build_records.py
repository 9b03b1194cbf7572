"""What was made of what: fingerprints of stages, so that a build does only what is stale.

A record is written when its stage is finished and stands until that is done anew. What a killed build leaves between old and
new files is not what its record says, and is made again.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import count, groupby
from typing import TYPE_CHECKING, Any

from levkas.building.hashes import Hashes
from levkas.building.records_file import NAME, read_rows, write_rows
from levkas.core.digests import hash_file
from levkas.core.disk import refusing
from levkas.core.files import make_folder, remove, write_bytes, write_text
from levkas.core.internal_errors import InternalError
from levkas.core.json_safe import plain
from levkas.core.problems import Problem, Refused
from levkas.database.catalogue import MEASURED, DatabaseRefused, Entry, entry_of, read_catalogue
from levkas.database.layout import LayerId, layer_name
from levkas.database.manifest import stays_inside

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence
    from pathlib import Path

    from levkas.campaign.discovery.captures import Capture

STAGES = ("calibrate", "register", "resample")
"""Of a capture, in their order."""
DONE, REFUSED = "done", "refused"
"""States of a record: of a finished stage; of one that was refused the last time, is tried again, and `status` says why."""
REPORT = ".error.txt"
"""Suffix of the report of an exception that no check foresaw, a file for whoever sends it."""
ALL = "SELECT object, camera, setup, stage, state, record, sha256 FROM stages"
OF_A_STAGE = "WHERE object = ? AND camera = ? AND setup = ? AND stage = ?"
RECORD = "INSERT OR REPLACE INTO stages VALUES (?, ?, ?, ?, ?, ?, ?)"
DROP = f"DELETE FROM stages {OF_A_STAGE}"
UNREADABLE = "cannot be read"
"""Of a fingerprint: why there is none. A stage of such is never fresh."""


@dataclass(frozen=True, order=True)
class Key:
    """One stage of one capture; camera and setup are empty where a stage has none."""

    object: str
    camera: str = ""
    setup: str = ""
    stage: str = ""

    @property
    def layer(self) -> str:
        """Camera and setup as frames and files name them: ``d80`` or ``d80@45-degree``."""
        return layer_name(self.camera, self.setup)

    @property
    def of(self) -> LayerId:
        """Which layer it is of."""
        return LayerId(self.object, self.camera, self.setup)

    def to_dict(self) -> dict[str, str]:
        """Return the identifying fields of a stage report."""
        return dict(vars(self))


CATALOGUE = Key("", stage="catalogue")


def key_of(capture: Capture, stage: str) -> Key:
    """Return the key of a stage of a capture."""
    return Key(capture.object, capture.camera, capture.setup, stage)


class BuildRecords:
    """Fingerprints and products of finished stages, and why others were refused.

    A record is read once: what this build has read or written stays valid for it, whatever another build beside it writes.
    Records are kept in `folder`, beside the database; products are recorded relative to `output`, the database. `verify` and
    `session` as of `Hashes`.
    """

    def __init__(
        self, folder: Path, output: Path, *, verify: bool = False, session: Path | None = None
    ) -> None:
        self.folder, self.output = folder, output
        self._file = folder / NAME
        self.hashes = Hashes(self._file, verify=verify, session=session)
        self._known: dict[Key, dict[str, dict[str, Any]]] = {}
        self._put_away: Path | None = None

    # --- what is recorded -----------------------------------------------------------------------

    def _states(self, key: Key) -> dict[str, dict[str, Any]]:
        """Return what is recorded of a stage by its state; a record that is damaged is empty."""
        if key not in self._known:
            rows = read_rows(self._file, f"{ALL} {OF_A_STAGE}", *vars(key).values())
            self._known[key] = _sound(key, rows)
        return self._known[key]

    def _record(self, key: Key) -> dict[str, Any]:
        return self._states(key).get(DONE, {})

    def is_begun(self, key: Key) -> bool:
        """Return whether anything was ever recorded of a stage."""
        return bool(self._states(key))

    def fingerprint(self, key: Key) -> dict[str, Any]:
        """Return what a finished stage was made of; empty where it is not finished."""
        return dict(self._record(key).get("fingerprint", {}))

    def products(self, key: Key) -> dict[str, str]:
        """Return the names and hashes of what a finished stage made."""
        return dict(self._record(key).get("products", {}))

    def notes(self, key: Key) -> dict[str, Any]:
        """Return what a finished stage noted for later ones."""
        return dict(self._record(key).get("notes", {}))

    def recorded(self) -> list[Key]:
        """Return the finished stages but the catalogue."""
        found = []
        rows = read_rows(self._file, f"{ALL} ORDER BY object, camera, setup, stage")
        for names, mine in groupby(rows, lambda row: row[:4]):
            key = Key(*names)
            if key not in self._known:
                self._known[key] = _sound(key, mine)
            if key != CATALOGUE and self._record(key):
                found.append(key)
        return found

    def products_that_stand(self) -> Iterator[tuple[str, str]]:
        """Yield name and SHA-256 of every existing product of every finished stage but the catalogue."""
        for key in self.recorded():
            for name, sha in self.products(key).items():
                if _is_file(f"{self.output}{os.sep}{name}"):
                    yield name, sha

    # --- finished layers ------------------------------------------------------------------------

    @cached_property
    def listed(self) -> dict[LayerId, Entry]:
        """Rows of the measured layers in the catalogue of the build before this one."""
        try:
            return {e.layer: e for e in read_catalogue(self.output) if e.kind == MEASURED}
        except DatabaseRefused:
            return {}

    def layers(self) -> list[Key]:
        """Return the last stages of all layers that are recorded or listed."""
        listed = {Key(e.object, e.camera, e.setup, STAGES[-1]) for e in self.listed.values()}
        return sorted(listed | {key for key in self.recorded() if key.stage == STAGES[-1]})

    def finished(self, key: Key) -> Entry | None:
        """Return the row of the layer that a stage belongs to, where a build has finished it and it stands.

        What is kept may have been deleted: then the catalogue says which layers were finished.
        """
        last = replace(key, stage=STAGES[-1])
        cells = self.notes(last).get("entry")
        row = entry_of(cells) if cells else None if self.is_begun(last) else self.listed.get(key.of)
        return row if row and _is_file(self.output / f"{row.layer.path}.tif") else None

    def copied(self, key: Key) -> tuple[dict[str, Any], dict[str, bytes]]:
        """Return the record of a finished stage and the bytes of its products, for `put_back`."""
        paths = {name: self.output / name for name in self.products(key)}
        return self._record(key), {n: p.read_bytes() for n, p in paths.items() if _is_file(p)}

    def put_back(self, key: Key, record: dict[str, Any], products: dict[str, bytes]) -> None:
        """Undo what was written and recorded of a stage since it was `copied`."""
        if not record or self._record(key) == record:
            return
        for name in self.products(key).keys() - products.keys():
            remove(self.output / name)
        for name, data in products.items():
            write_bytes(self.output / name, data)
        row = _row(key, DONE, {part: record[part] for part in record if part != "sha256"})
        self._write(key, (RECORD, [row]))

    # --- what is fresh --------------------------------------------------------------------------

    def why_stale(self, key: Key, fingerprint: dict[str, Any]) -> str:
        """Report why a stage must be done; empty where its products stand and fit."""
        if UNREADABLE in fingerprint:
            return f"its files cannot be read: {fingerprint[UNREADABLE]}"
        if not (record := self._record(key)):
            return "its record is damaged" if DONE in self._states(key) else "not yet built"
        if changed := _difference(record["fingerprint"], fingerprint):
            return changed
        for path, name, digest in self._made(record):
            try:
                if self.hashes(path, own=True) != digest:
                    return f"{name} was changed after it was built"
            except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
                return f"{name} is missing"
        return ""

    def damaged(self, key: Key) -> str:
        """Read every product of a finished stage, and name the first that is not what was written.

        `why_stale` relies on size and time of a file; before a product is read again, its bytes are read.
        """
        for path, name, digest in self._made(self._record(key)):
            if not _is_file(path) or hash_file(path) != digest:
                return name
        return ""

    def _made(self, record: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        """Yield path, name and hash of everything that a stage made."""
        for part, folder in (("products", self.output), ("aside", self.folder)):
            for name, digest in record.get(part, {}).items():
                yield f"{folder}{os.sep}{name}", name, digest

    # --- what is done ---------------------------------------------------------------------------

    def keep(
        self,
        key: Key,
        fingerprint: dict[str, Any],
        products: Iterable[Path],
        *,
        aside: Iterable[Path] = (),
        **notes: Any,
    ) -> None:
        """Record a finished stage; called last, so that an interrupted one is done again.

        `products` stand in the database, what is kept `aside` for later stages beside it.
        """
        made, kept = self._hashed(products, self.output), self._hashed(aside, self.folder)
        self.put_away_left(key, made)
        for name in self._record(key).get("aside", {}).keys() - kept.keys():
            if _is_file(self.folder / name):
                remove(self.folder / name)
        record = {"fingerprint": fingerprint, "products": made, "aside": kept, "notes": notes}
        row = _row(key, DONE, record)
        changes = (DROP, [tuple(vars(key).values())]), (RECORD, [row]), self.hashes.unsaved()
        write_rows(self._file, *changes)
        self._known[key] = _sound(key, [row])
        self.drop_report(key)

    def keep_again(self, key: Key, **notes: Any) -> None:
        """Record a finished stage as made of the same, where something was written into its files, and these notes."""
        record = self._record(key)
        made = [self.output / name for name in record["products"]]
        aside = [self.folder / name for name in record["aside"]]
        self.keep(key, record["fingerprint"], made, aside=aside, **record["notes"] | notes)

    def _hashed(self, paths: Iterable[Path], folder: Path) -> dict[str, str]:
        return {p.relative_to(folder).as_posix(): self.hashes(p, own=True) for p in sorted(paths)}

    def _write(self, key: Key, *changes: tuple[str, Iterable[Sequence[Any]]]) -> None:
        write_rows(self._file, *changes)
        self._known.pop(key, None)

    def drop(self, key: Key) -> None:
        """Forget a stage that will not be done again, and what was kept aside of it; a report stays."""
        for name in self._record(key).get("aside", {}):
            remove(self.folder / name)
        self._write(key, (DROP, [tuple(vars(key).values())]))

    def refuse(self, key: Key, fingerprint: dict[str, Any], problems: Iterable[Problem]) -> None:
        """Record what a stage was made of when it was refused, and why."""
        record = {"fingerprint": fingerprint, "refused": [p.to_dict() for p in problems]}
        self._write(key, (RECORD, [_row(key, REFUSED, record)]))

    def refusal(self, key: Key, fingerprint: dict[str, Any]) -> tuple[Problem, ...]:
        """Return why a stage was refused that was made of the same; empty where it was not."""
        record = self._states(key).get(REFUSED)
        if not record or _difference(record["fingerprint"], fingerprint):
            return ()
        return tuple(Problem(**problem) for problem in record["refused"])

    # --- reports of exceptions that no check foresaw --------------------------------------------

    def report_of(self, key: Key) -> Path:
        """Return the path of the report of a stage among what is kept."""
        parts = [part for part in (key.object, key.layer, key.stage) if part]
        return self.folder.joinpath(*parts[:-1], f"{parts[-1]}{REPORT}")

    def with_report(self, key: Key, refused: Refused) -> Refused:
        """Keep the report of an exception that no check foresaw, and return a refusal that says where.

        Other refusals, and those whose report the disk refuses, are returned as they are.
        """
        if not (isinstance(refused, InternalError) and refused.report):
            return refused
        path = self.report_of(key)
        try:
            make_folder(path.parent)
            write_text(path, refused.report)
        except Refused:
            return refused
        fix = f"This is an error of the program. Please send its report to the authors: {path}"
        return InternalError(*(replace(problem, fix=fix) for problem in refused.problems))

    def drop_report(self, key: Key) -> None:
        """Remove the report of an exception of an earlier build, where there is one."""
        if (path := self.report_of(key)).is_file():
            remove(path)

    # --- what a stage does not make any more ----------------------------------------------------

    def put_away_left(self, key: Key, made: Iterable[str]) -> None:
        """Put away what a stage has made before and does not make any more."""
        self.put_away(self.products(key).keys() - {*made})

    def put_away(self, names: Iterable[str]) -> Path | None:
        """Move products out of the database, to a folder of this build; None where there are none."""
        there = [name for name in names if _is_file(f"{self.output}{os.sep}{name}")]
        if not there:
            return None
        if self._put_away is None:
            beside = self.output.with_name(self.output.name + ".removed")
            numbers = (str(n) for n in count(1))
            self._put_away = next(beside / n for n in numbers if not (beside / n).exists())
        for name in there:
            source, target = self.output / name, self._put_away / name
            make_folder(target.parent)
            with refusing(target, None), suppress(FileNotFoundError):
                source.replace(target)
            with suppress(OSError):  # other files are in it
                os.removedirs(source.parent)
        return self._put_away


def _row(key: Key, state: str, record: dict[str, Any]) -> tuple[str, ...]:
    """Return a row of the table of stages, with a hash that shows where a bit of it has flipped."""
    text = json.dumps(plain(record), ensure_ascii=False, allow_nan=False)
    return *vars(key).values(), state, text, _hash_of(key, text)


def _hash_of(key: Key, text: str) -> str:
    return hashlib.sha256("\n".join([*vars(key).values(), text]).encode()).hexdigest()


def _sound(key: Key, rows: Iterable[Sequence[Any]]) -> dict[str, dict[str, Any]]:
    """Return the records of a stage by state, each with its hash; an empty one where it is not what was written.

    One that names a file outside is none of ours: what it names is moved out or taken away some day.
    """
    found: dict[str, dict[str, Any]] = {}
    for *_, state, text, sha256 in rows:
        found[state] = {}
        if sha256 == _hash_of(key, str(text)):
            record = json.loads(text)
            made = (n for part in ("products", "aside") for n in record.get(part, ()))
            if all(map(stays_inside, made)):
                found[state] = {**record, "sha256": sha256}
    return found


def _is_file(path: str | Path) -> bool:
    return os.path.isfile(path)  # noqa: PTH113 -- thousands of times where all is fresh


def _difference(before: dict[str, Any], now: dict[str, Any]) -> str:
    changes = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    if not changes:
        return ""
    name, more = changes[0], f" and {len(changes) - 1} more" if len(changes) > 1 else ""
    if name not in before or name not in now:
        return f"{name} is {'gone' if name in before else 'new'}{more}"
    values = [json.dumps(one[name], ensure_ascii=False) for one in (before, now)]
    if any(len(text) > 40 or re.fullmatch('"[0-9a-f]{8,}"', text) for text in values):
        return f"{name} changed{more}"
    return f"{name} {' → '.join(values)}{more}"
