"""What was made of what: fingerprints of stages, so that a build does only what is stale."""

from __future__ import annotations

import hashlib
import json
import os
import re
from dataclasses import dataclass, replace
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.building.hashes import HASHES, Hashes
from levkas.core.digests import hash_file
from levkas.core.files import (
    make_folder,
    move_files,
    remove,
    rename_file,
    write_changed,
    write_json,
    write_text,
)
from levkas.core.internal_errors import CODE as INTERNAL
from levkas.core.internal_errors import InternalError
from levkas.core.json_safe import to_json
from levkas.core.problems import Problem, Refused
from levkas.core.text import read_text
from levkas.database.containment import stays_inside
from levkas.database.layout import LayerId, layer_name

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator

    from levkas.campaign.discovery.captures import Capture

STAGES = ("calibrate", "measure", "register", "resample")
"""Of a capture, in their order."""
WAS = ".was"
"""Suffix of the record of a stage that is being done anew."""
REFUSED = ".refused"
"""Suffix of what a refused stage was refused for: it is tried again by every build, and read by `status`."""
REPORT = ".error.txt"
"""Suffix of the report of an exception that no check foresaw."""

UNREADABLE = "cannot be read"
"""Of a fingerprint: why there is none. A stage of such is never fresh."""
MOST_KNOWN = 10_000
"""Records in memory, some 8 kB each."""


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

    def to_dict(self) -> dict[str, str]:
        """Return the identifying fields of a stage report."""
        return {
            "object": self.object,
            "camera": self.camera,
            "setup": self.setup,
            "stage": self.stage,
        }


CATALOGUE = Key("", stage="catalogue")


def key_of(capture: Capture, stage: str) -> Key:
    """Return the key of a stage of a capture."""
    return Key(capture.object, capture.camera, capture.setup, stage)


class BuildRecords:
    """Fingerprints and products of finished stages, one small file a stage.

    A record is read once: what this build has read or written stays valid for it, whatever
    another build that runs beside it takes away or writes. Of more than `MOST_KNOWN` the first are read again.

    Parameters
    ----------
    folder : Path
        Where the records are kept, beside the database and never inside it.
    output : Path
        The database; products are recorded relative to it.
    keep_removed : bool
        Leave what the campaign no longer has where it is.
    verify : bool
        Read every file anew, whatever is kept of its hash.
    """

    def __init__(
        self, folder: Path, output: Path, *, keep_removed: bool = False, verify: bool = False
    ) -> None:
        self.folder, self.output, self.keep_removed = folder, output, keep_removed
        self.hashes = Hashes(folder / HASHES, verify=verify)
        self._known: dict[str, dict[str, Any]] = {}
        self._put_away: Path | None = None

    def why_stale(self, key: Key, fingerprint: dict[str, Any]) -> str:
        """Say why a stage must be done; empty where its products stand and fit."""
        if UNREADABLE in fingerprint:
            return f"its files cannot be read: {fingerprint[UNREADABLE]}"
        if not (record := self._record(key)):
            return "its record is damaged" if self.path_of(key).is_file() else "not yet built"
        if changed := _difference(record.get("fingerprint", {}), fingerprint):
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

        `why_stale` believes size and time of a file; before a product is read again, nothing is
        believed.
        """
        for path, name, digest in self._made(self._record(key)):
            if not _is_file(path) or hash_file(path) != digest:
                return name
        return ""

    def check(self, key: Key) -> str:
        """Return the hash of the record of a finished stage; empty where it is not finished."""
        record = self._record(key)
        return _check(record) if record else ""

    def reread(self, key: Key) -> None:
        """Read a record again when it is needed: another process may have written it since."""
        self._known.pop(str(self.path_of(key)), None)

    def fingerprint(self, key: Key) -> dict[str, Any]:
        """Return what a finished stage was made of; empty where it is not finished."""
        return dict(self._record(key).get("fingerprint", {}))

    def products(self, key: Key) -> dict[str, str]:
        """Return the names and hashes of what a finished stage made."""
        return dict(self._record(key).get("products", {}))

    def products_that_stand(self) -> Iterator[tuple[str, str]]:
        """Yield name and SHA-256 of every existing product of every finished stage."""
        root = str(self.output)
        for place, folders, names in os.walk(self.folder):
            folders.sort()
            if place != str(self.folder):
                for record in sorted(n for n in names if n.endswith(".json")):
                    made = self._recorded(f"{place}{os.sep}{record}").get("products", {})
                    for name, sha in made.items():
                        if _is_file(f"{root}{os.sep}{name}"):
                            yield name, sha

    def notes(self, key: Key) -> dict[str, Any]:
        """Return what a finished stage noted for later ones."""
        return dict(self._record(key).get("notes", {}))

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
        made = {
            p.relative_to(self.output).as_posix(): self.hashes(p, own=True)
            for p in sorted(products)
        }
        told: dict[str, Any] = {"fingerprint": fingerprint, "products": made, "notes": notes}
        if left := self.put_away_left(key, made):
            told["left"] = left
        if kept := {
            p.relative_to(self.folder).as_posix(): self.hashes(p, own=True) for p in sorted(aside)
        }:
            told["aside"] = kept
        path = self.path_of(key)
        make_folder(path.parent)
        record = json.loads(to_json(told))
        write_json(path, {**record, "check": _check(record)})
        self._known[str(path)] = record
        self._remove(path, WAS, REFUSED, REPORT)
        self.hashes.save()

    def forget(self, key: Key) -> None:
        """Drop the record of a stage that is about to be done anew.

        It stays under another name until the stage has ended: what the stage does not make any more is
        still known then.
        """
        path = self.path_of(key)
        self._known[str(path)] = {}
        rename_file(path, path.with_suffix(WAS))

    def refuse(self, key: Key, fingerprint: dict[str, Any], problems: Iterable[Problem]) -> None:
        """Note what a stage was made of when it was refused, and why."""
        told = {"fingerprint": fingerprint, "refused": [p.to_dict() for p in problems]}
        record = json.loads(to_json(told))
        path = self.path_of(key).with_suffix(REFUSED)
        make_folder(path.parent)
        write_changed(path, to_json({**record, "check": _check(record)}).encode())

    def refusal(self, key: Key, fingerprint: dict[str, Any]) -> tuple[Problem, ...]:
        """Return why a stage was refused that was made of the same; empty where it was not."""
        path = self.path_of(key).with_suffix(REFUSED)
        record = _sound(_read(path)) if _is_file(path) else {}
        if not record or _difference(record.get("fingerprint", {}), fingerprint):
            return ()
        return tuple(self._with_advice(key, Problem(**problem)) for problem in record["refused"])

    def with_report(self, key: Key, refused: Refused) -> Refused:
        """Keep the report of an exception that no check foresaw, and return a refusal that says where.

        Other refusals, and those whose report the disk refuses, are returned as they are.
        """
        if not (isinstance(refused, InternalError) and refused.report):
            return refused
        path = self.path_of(key, REPORT)
        try:
            make_folder(path.parent)
            write_text(path, refused.report)
        except Refused:
            return refused
        return InternalError(*(self._with_advice(key, problem) for problem in refused.problems))

    def _with_advice(self, key: Key, problem: Problem) -> Problem:
        """Return a problem with where its report is, if it is of an exception that no check foresaw."""
        path = self.path_of(key, REPORT)
        if problem.code != INTERNAL or not path.is_file():
            return problem
        fix = f"This is an error of the program. Please send its report to the authors: {path}"
        return replace(problem, fix=fix)

    def drop_report(self, key: Key) -> None:
        """Remove the report of an exception of an earlier build, where there is one."""
        self._remove(self.path_of(key), REPORT)

    def drop(self, key: Key) -> None:
        """Forget a stage that will not be done again, and what was kept aside of it; a report stays."""
        path = self.path_of(key)
        for name in self._record(key).get("aside", {}):
            remove(self.folder / name)
        self._known[str(path)] = {}
        self._remove(path, path.suffix, WAS, REFUSED)

    def recorded(self) -> list[Key]:
        """Return the stages that are recorded, or were being done anew when a build was interrupted."""
        found = set()
        for place, _, names in os.walk(self.folder):
            above = place[len(str(self.folder)) :].replace(os.sep, "/")
            where = [part for part in above.split("/") if part]
            for stem, suffix in map(os.path.splitext, names):
                if suffix not in (".json", WAS):
                    continue
                if len(where) == 2 and stem in STAGES:
                    layer = LayerId.parse(where[0], where[1])
                    found.add(Key(layer.object, layer.camera, layer.setup, stem))
                elif len(where) == 1 and stem == "report":
                    found.add(Key(where[0], stage=stem))
                elif len(where) == 1 and stem == "camera":
                    found.add(Key("", where[0], stage=stem))
        return sorted(found)

    def made_by(self, key: Key) -> set[str]:
        """Return the names of all that a stage has made, also of one that was being done anew."""
        was = self.path_of(key).with_suffix(WAS)
        records = self._record(key), _sound(_read(was)) if _is_file(was) else {}
        return {
            n for record in records for part in ("products", "left") for n in record.get(part, ())
        }

    def put_away_left(self, key: Key, made: Iterable[str]) -> list[str]:
        """Put away what a stage has made before and does not make any more; return what stays of it."""
        left = self.made_by(key) - {*made}
        stays = {n for n in left if self.keep_removed and n.startswith(("charts/", "setups/"))}
        self.put_away(left - stays)
        return sorted(n for n in stays if _is_file(f"{self.output}{os.sep}{n}"))

    def put_away(self, names: Iterable[str]) -> Path | None:
        """Move products out of the database, to a folder of this build; None where there are none."""
        there = [name for name in names if _is_file(f"{self.output}{os.sep}{name}")]
        if not there:
            return None
        if self._put_away is None:
            beside = self.output.with_name(self.output.name + ".removed")
            numbers = (str(n) for n in count(1))
            self._put_away = next(beside / n for n in numbers if not (beside / n).exists())
        move_files(there, self.output, self._put_away)
        return self._put_away

    def _remove(self, path: Path, *suffixes: str) -> None:
        """Remove the record at a path, or files beside it, where they exist."""
        for suffix in suffixes:
            if (one := path.with_suffix(suffix)).is_file():
                remove(one)

    def _made(self, record: dict[str, Any]) -> Iterator[tuple[str, str, str]]:
        """Yield path, name and hash of everything that a stage made."""
        for part, folder in (("products", self.output), ("aside", self.folder)):
            for name, digest in record.get(part, {}).items():
                yield f"{folder}{os.sep}{name}", name, digest

    def _record(self, key: Key) -> dict[str, Any]:
        return self._recorded(str(self.path_of(key)))

    def _recorded(self, path: str) -> dict[str, Any]:
        if path not in self._known:
            while len(self._known) >= MOST_KNOWN:
                del self._known[next(iter(self._known))]
            self._known[path] = _sound(_read(Path(path))) if _is_file(path) else {}
        return self._known[path]

    def path_of(self, key: Key, suffix: str = ".json") -> Path:
        """Return the path of the record of a stage, or of a file beside it."""
        parts = [part for part in (key.object, key.layer, key.stage) if part]
        return self.folder.joinpath(*parts[:-1], f"{parts[-1]}{suffix}")


def _read(path: Path) -> dict[str, Any]:
    try:
        # Parsed as it is: there are thousands where all is fresh, and a record bears its own hash.
        record = json.loads(read_text(path, "a JSON table in UTF-8"))
    except (Refused, ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) else {}


def _check(record: dict[str, Any]) -> str:
    """Hash of what a record says, so that a bit that flips in its file is seen."""
    return hashlib.sha256(json.dumps(record, ensure_ascii=False).encode()).hexdigest()


def _is_file(path: str | Path) -> bool:
    return os.path.isfile(path)  # noqa: PTH113 -- thousands of times where all is fresh


def _sound(record: dict[str, Any]) -> dict[str, Any]:
    """Return a record without its check; nothing where it is not what was written.

    One that names a file outside is none of ours: what it names is moved out or taken away some day.
    """
    body = {name: value for name, value in record.items() if name != "check"}
    made = [n for part in ("products", "left", "aside") for n in body.get(part, ())]
    return body if record.get("check") == _check(body) and all(map(stays_inside, made)) else {}


def _difference(before: dict[str, Any], now: dict[str, Any]) -> str:
    changes = [name for name in {**before, **now} if before.get(name) != now.get(name)]
    if not changes:
        return ""
    name = changes[0]
    more = f" and {len(changes) - 1} more" if len(changes) > 1 else ""
    if name not in before:
        return f"{name} is new{more}"
    if name not in now:
        return f"{name} is gone{more}"
    if name.startswith("file ") or name == "code":
        return f"{name} changed{more}"
    if name.startswith("frame "):
        return f"{name}{_other_use(before[name], now[name])}{more}"
    if _is_hash(before[name]) or _is_hash(now[name]):
        return f"{name} changed{more}"
    return f"{name} {_short(before[name])} → {_short(now[name])}{more}"


def _is_hash(value: Any) -> bool:
    return isinstance(value, str) and re.fullmatch("[0-9a-f]{8,}", value) is not None


def _other_use(before: list[dict[str, Any]], now: list[dict[str, Any]]) -> str:
    """Say how the use of a file as a frame differs, by the first thing that does.

    >>> _other_use([{"role": "dark"}], [{"role": "white"}])
    ': role "dark" → "white"'
    """
    for one, other in zip(before, now, strict=False):
        for key in {**one, **other}:
            if one.get(key) != other.get(key):
                return f": {key} {_short(one.get(key))} → {_short(other.get(key))}"
    return f" is used {len(now)} times instead of {len(before)}"


def _short(value: Any) -> str:
    text = json.dumps(value, ensure_ascii=False)
    return text if len(text) <= 40 else text[:37] + "…"
