"""The index of a large campaign: how its last build ended, and by what a change since would show.

A database of 10⁵ objects has some 10⁷ files, and more records than a person waits for. Where a build, or a
comparison of every stage with its record, ends with nothing stale, it leaves an index beside the records:
how the stages ended, every file of every folder that the campaign reads, as a digest of names and stamps,
and the stamps of all folders of the database and of the records. `status`, and a build where nothing is to
be done, compare these only.

The records stay the truth. An index that is missing, damaged, older than the records, or of other code is
none, and all stages are compared anew. It is removed before a build writes anything.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import secrets
import sqlite3
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from levkas.building.build_records import CATALOGUE, WAS, Key
from levkas.building.graph import Step
from levkas.building.hashes import COARSE_TICK_NS, HASHES, is_settled
from levkas.building.removal import REMOVED
from levkas.building.sources import package_stamp
from levkas.core.digests import stamp_of
from levkas.core.files import OURS
from levkas.core.json_safe import to_json
from levkas.core.problems import Problem
from levkas.database.catalogue import NAME as TABLE
from levkas.database.manifest import NAME as MANIFEST

if TYPE_CHECKING:
    from levkas.building.build_records import BuildRecords
    from levkas.building.plan import Plan
    from levkas.campaign.campaign import Campaign
    from levkas.database.layout import Places

INDEX = "index.sqlite"
"""Among what is kept."""
FORMAT = 1
LARGE = 5_000
"""Stages from which there is an index: to compare them one by one takes some seconds."""
MOST_STAMPED = 300_000
"""Files of frames whose stamps `status` compares, some 5 µs each; of more, the stamps of their folders."""
MOST_STEPS, MOST_WARNINGS, MOST_FOLDERS = 1_000, 100, 20
"""Refused stages and warnings that are kept in words, and changed folders that are named."""
TABLES = """
CREATE TABLE facts (text TEXT, sha256 TEXT);
CREATE TABLE inputs (
    folder BLOB PRIMARY KEY, digest TEXT, files INTEGER, stamp TEXT
) WITHOUT ROWID;
CREATE TABLE products (folder BLOB PRIMARY KEY, stamp TEXT) WITHOUT ROWID
"""
INPUTS = "inputs"
"""Stage of the steps that name what changed since the last build."""


class Look(NamedTuple):
    """A folder of inputs: digest of its names and of the stamps of its files, their number, newest time in ns."""

    digest: str
    files: int
    newest: int


@dataclass
class InputFolders:
    """The folders that a campaign is read from, as they were before a build began.

    Parameters
    ----------
    looks : dict of folder to Look
    hashes : tuple
        Stamp of the index of hashes; empty where there is none.
    never : frozenset of str
        The database and what is kept and removed of it: no inputs, wherever they stand.
    """

    looks: dict[str, Look]
    hashes: tuple[int, ...]
    never: frozenset[str]


@dataclass
class StageCounts:
    """How the stages of a build ended, counted.

    Parameters
    ----------
    lost : frozenset of Key
        Stages of captures that cannot be begun.
    """

    lost: frozenset[Key]
    states: Counter[str] = field(default_factory=Counter)
    refused: list[Step] = field(default_factory=list)
    warnings: dict[str, None] = field(default_factory=dict)
    tried_again: int = 0

    def add(self, step: Step, records: BuildRecords) -> Step:
        """Count a step; a refusal without a record is tried again by every build."""
        if not step.finished:
            return step
        state = "fresh" if step.state == "done" else step.state
        self.states["stale" if step.key == REMOVED else state] += 1
        self.warnings.update(dict.fromkeys(step.warnings))
        if step.state == "refused":
            self.refused.append(step)
            recorded = records.notes(step.key).get("refused")
            follows = any(problem.code == "E_NO_REFERENCE" for problem in step.problems)
            self.tried_again += not (recorded or follows or step.key in self.lost)
        return step


def read_inputs(plan: Plan, places: Places, started_ns: int) -> InputFolders | None:
    """Look at all that a campaign is read from; None where some of it was changed just before the start.

    What was changed after the start of the build may have been read before, and is not in this look.
    """
    never = _own_folders(places)
    looks = {folder: look_at(folder, never) for folder in _input_folders(plan, never)}
    newest = max((look.newest for look in looks.values()), default=0)
    newest = max(newest, *(max(_stamp(f)[1:3], default=0) for f in looks), 0)
    if started_ns - newest <= COARSE_TICK_NS:
        return None
    return InputFolders(looks, _stamp(places.kept / HASHES), never)


def look_at(folder: str, never: frozenset[str] = frozenset()) -> Look:
    """Return names and stamps of a folder's files, links followed, and the names of its folders, as a digest."""
    lines, files, newest = [], 0, 0
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if ".partial-" in entry.name and OURS.fullmatch(entry.name):
                    continue
                if never and entry.path in never:
                    continue
                if entry.is_dir():
                    lines.append(f"{entry.name}/")
                    continue
                files += 1
                try:
                    s = entry.stat()
                except OSError:
                    lines.append(f"{entry.name}\0")
                    continue
                newest = max(newest, s.st_mtime_ns, s.st_ctime_ns)
                told = f"{s.st_size} {s.st_mtime_ns} {s.st_ctime_ns} {s.st_ino}"
                lines.append(f"{entry.name}\0{told}")
    except OSError as error:
        return Look(f"error {error.errno}", 0, 0)
    lines.sort()
    text = "\n".join(lines).encode("utf-8", "surrogateescape")
    return Look(hashlib.sha256(text).hexdigest(), files, newest)


def write_index(
    plan: Plan, places: Places, before: InputFolders | None, counts: StageCounts, *, writes: bool
) -> None:
    """Keep how a build ended, unless an input has changed meanwhile, or something is stale, failed or gone.

    `writes` says that the hashes were written by this build itself. Where the disk refuses, there is no index.
    """
    ended = {"fresh", "refused"}
    if before is None or set(counts.states) - ended or counts.states["fresh"] == 0:
        return
    hashes = _stamp(places.kept / HASHES)
    if not writes and hashes != before.hashes:
        return
    lost = {os.path.normpath(places.kept / s.key.object / s.key.layer) for s in counts.refused}
    folders = _settled_folders(places, lost)
    after = {folder: look_at(folder, before.never) for folder in before.looks}
    if folders is None or after != before.looks:
        return
    products = [(os.fsencode(folder), _text(stamp)) for folder, stamp in folders.items()]
    inputs = [
        (os.fsencode(folder), look.digest, look.files, _text(_stamp(folder)))
        for folder, look in after.items()
    ]
    warnings = [*plan.campaign.without_effect, *counts.warnings]
    refused = sorted(counts.refused, key=lambda step: step.place)
    facts = {
        "format": FORMAT,
        "package": package_stamp(),
        "campaign": str(plan.campaign.path),
        "output": str(places.output),
        "hashes": _text(hashes),
        "of all": _of_all(places),
        "folders": [len(inputs), len(products)],
        "files": sum(look.files for look in after.values()),
        "states": dict(counts.states),
        "tried again": counts.tried_again,
        "refused": [_to_record(step) for step in refused[:MOST_STEPS]],
        "warnings": warnings[:MOST_WARNINGS],
        "more warnings": max(len(warnings) - MOST_WARNINGS, 0),
    }
    with suppress(OSError, sqlite3.Error):
        _write(places.kept / INDEX, facts, inputs, products)


@dataclass(frozen=True)
class BuildIndex:
    """An index that fits the code, the campaign and the records of a database.

    Parameters
    ----------
    path : Path
    facts : dict
        How the last build ended.
    places : Places
    """

    path: Path
    facts: dict[str, Any]
    places: Places

    @property
    def tries_again(self) -> bool:
        """Whether a build tries a refused stage again, whatever has changed."""
        return bool(self.facts["tried again"])

    @property
    def total(self) -> int:
        """Number of stages that ended."""
        return sum(self.facts["states"].values())

    def is_current(self) -> bool:
        """Whether no input, no folder of the database and none of the records has changed; every one is looked at."""
        try:
            with closing(sqlite3.connect(self.path)) as index:
                rows = index.execute("SELECT folder, stamp FROM products")
                number = 0
                for folder, stamp in rows:
                    number += 1
                    if _text(_stamp(folder)) != stamp:
                        return False
            same = not any(self._changed(names_only=False))
            return same and number == self.facts["folders"][1]
        except (sqlite3.Error, TypeError, ValueError):  # a row was damaged
            return False

    def steps(self, *, building: bool = False) -> list[Step] | None:
        """Return how the stages ended, and what has changed since; None where the index cannot be read.

        Stages that ended well are counted in the step of the catalogue, which comes last.
        `building` says that `is_current` has compared everything. Else files are compared where they are not
        too many, and folders otherwise.
        """
        facts = self.facts
        try:
            names_only = facts["files"] > MOST_STAMPED
            changed = [] if building else [*self._changed(names_only=names_only)]
        except (sqlite3.Error, TypeError, ValueError):
            return None
        steps = [_from_record(record) for record in facts["refused"]]
        steps += [Step(Key("", stage=INPUTS), "stale", why) for why in changed[:MOST_FOLDERS]]
        if more := len(changed) - MOST_FOLDERS:
            why = f"{more} more folders of inputs have changed since the last build"
            steps += [Step(Key("", stage=INPUTS), "stale", why)] if more > 0 else []
        states = Counter(facts["states"])
        states["refused"] -= len(facts["refused"])
        state = "stale" if changed else "fresh"
        states["fresh"] -= 1  # the catalogue, which is listed
        unlisted = tuple((name, number) for name, number in states.items() if number > 0)
        why = "it may list stale files" if changed else ""
        warnings = (*facts["warnings"], *_more_warnings(facts["more warnings"]))
        last = Step(
            CATALOGUE,
            state,
            why,
            warnings=warnings,
            output=self.places.output,
            unlisted=unlisted,
            compared=self._compared(building=building),
        )
        return [*steps, last]

    def _compared(self, *, building: bool) -> str:
        """Say what was compared with the last build, and what was not."""
        facts = self.facts
        folders, files = facts["folders"][0], facts["files"]
        names_only = not building and files > MOST_STAMPED
        what = f"names in {folders:,} folders" if names_only else f"stamps of all {files:,} files"
        products = "folders of the database" if building else "no file of the database"
        inside = " in place" if building else ""
        return (
            f"as of the last build; compared since then: {what} of frames, campaign.toml and tables, "
            f"{products}. --full compares every stage, also files that were changed{inside}"
        )

    def _changed(self, *, names_only: bool) -> Iterator[str]:
        """Yield what has changed of the inputs, a sentence a folder; raises sqlite3.Error."""
        never, number = _own_folders(self.places), 0
        with closing(sqlite3.connect(self.path)) as index:
            rows = index.execute("SELECT folder, digest, files, stamp FROM inputs")
            for name, digest, files, stamp in rows:
                number += 1
                folder = os.fsdecode(name)
                if names_only and _text(_stamp(folder)) == stamp:
                    continue
                if (now := look_at(folder, never)).digest != digest:
                    yield _difference(folder, self.path, files, now.files)
        if number != self.facts["folders"][0]:
            raise sqlite3.DatabaseError("folders are missing")


def open_index(campaign: Campaign, places: Places) -> BuildIndex | None:
    """Return the index of a database; None where there is none, or it is not of these records and this code."""
    path = places.kept / INDEX
    if not path.is_file():
        return None
    try:
        with closing(sqlite3.connect(path)) as index:
            text, digest = index.execute("SELECT text, sha256 FROM facts").fetchone()
        if hashlib.sha256(text.encode()).hexdigest() != digest:
            return None
        facts = json.loads(text)
    except (sqlite3.Error, TypeError, ValueError, AttributeError):
        return None
    now = {
        "format": FORMAT,
        "package": package_stamp(),
        "campaign": str(campaign.path),
        "output": str(places.output),
        "hashes": _text(_stamp(places.kept / HASHES)),
        "of all": _of_all(places),
    }
    same = all(facts.get(name) == value for name, value in now.items())
    return BuildIndex(path, facts, places) if same else None


def drop_index(places: Places) -> None:
    """Remove the index before a build writes anything; raises WriteRefused."""
    from levkas.core.files import remove

    if (path := places.kept / INDEX).is_file():
        remove(path)


def _input_folders(plan: Plan, never: frozenset[str]) -> Iterable[str]:
    """Return every folder that the campaign's frames, tables and points are looked for in."""
    campaign = plan.campaign
    root = str(campaign.root)
    folders = {root, *plan.listed}
    tables = (*campaign.cameras.values(), campaign.targets, *campaign.setups.values())
    texts = [t for table in (*tables, campaign.registration) for t in _texts(table.model_dump())]
    for text in texts:
        if len(text) < 4096 and not {"\0", "\n"} & {*text}:
            folders.add(_folder_of(root, text))
    for name in (text for text in texts if "{" in text.rpartition("/")[0]):
        for c in plan.captures:
            told = (("{object}", c.object), ("{camera}", c.camera), ("{setup}", c.setup))
            own = name
            for mark, value in told:
                own = own.replace(mark, value)
            if "{" not in own:
                folders.add(_folder_of(root, own))
    return sorted(folders - never)


def _folder_of(root: str, text: str) -> str:
    """Return the folder of a file, or of a pattern as far as it is one folder."""
    start = re.split("[{*]", text)[0]
    return os.path.normpath(Path(root, f"{start}x").parent)


def _texts(value: Any) -> Iterator[str]:
    if isinstance(value, str):
        yield value
    elif isinstance(value, dict):
        for inner in value.values():
            yield from _texts(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _texts(inner)


def _own_folders(places: Places) -> frozenset[str]:
    return frozenset(map(str, (places.output, places.kept, places.removed)))


def _settled_folders(places: Places, refused: Collection[str]) -> dict[str, tuple[int, ...]] | None:
    """Return the stamps of all folders of a database and of its records, once the clock has gone on.

    None where a stage is being done anew in another folder of records than those of the `refused` layers, or
    where files are still written.
    """
    for pause_s in (0.0, 0.2, 2 * COARSE_TICK_NS / 1e9):
        time.sleep(pause_s)
        folders: dict[str, tuple[int, ...]] = {}
        for folder, anew in (*_folders(str(places.output)), *_folders(str(places.kept))):
            if anew and folder not in refused:
                return None
            folders[folder] = _stamp(folder)
        del folders[str(places.kept)]  # the index itself is written there
        now = time.time_ns()
        if all(is_settled(stamp, now) for stamp in folders.values()):
            return folders
    return None


def _folders(root: str) -> Iterator[tuple[str, bool]]:
    """Yield a folder and all below it, and whether the record of a stage is put aside in it."""
    waiting = [root]
    while waiting:
        folder, anew = waiting.pop(), False
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.is_dir(follow_symlinks=False):
                    waiting.append(entry.path)
                else:
                    anew = anew or entry.name.endswith(WAS)
        yield folder, anew


def _of_all(places: Places) -> list[str]:
    """Return the stamps of the files that speak of all layers, and of their record."""
    record = places.kept / f"{CATALOGUE.stage}.json"
    return [_text(_stamp(p)) for p in (record, places.output / TABLE, places.output / MANIFEST)]


def _difference(folder: str, index: Path, before: int, now: int) -> str:
    """Say what came to a folder, or was changed in it, since an index was written."""
    since = index.stat().st_mtime_ns
    found = []
    with suppress(OSError), os.scandir(folder) as entries:
        for entry in entries:
            with suppress(OSError):
                s = entry.stat()
                if entry.is_file() and max(s.st_mtime_ns, s.st_ctime_ns) > since:
                    found.append(entry.name)
    if found:
        more = f" and {len(found) - 1} more" if len(found) > 1 else ""
        what = f"{min(found)}{more} came or changed"
    else:
        what = f"{before:,} files were here, now {now:,}" if before != now else "names changed"
    return f"{folder}: {what} since the last build"


def _more_warnings(number: int) -> tuple[str, ...]:
    return (f"{number} more warnings; --full gives them all",) if number else ()


def _stamp(path: str | bytes | Path) -> tuple[int, ...]:
    try:
        return stamp_of(path)  # type: ignore[arg-type]
    except OSError:
        return ()


def _text(stamp: tuple[int, ...]) -> str:
    return " ".join(map(str, stamp))


def _to_record(step: Step) -> dict[str, Any]:
    problems = [problem.to_dict() for problem in step.problems]
    return {"key": step.key.to_dict(), "why": step.why, "problems": problems}


def _from_record(record: dict[str, Any]) -> Step:
    problems = tuple(Problem(**problem) for problem in record["problems"])
    return Step(Key(**record["key"]), "refused", record["why"], problems=problems)


def _write(
    path: Path,
    facts: dict[str, Any],
    inputs: list[tuple[bytes, str, int, str]],
    products: list[tuple[bytes, str]],
) -> None:
    """Write an index under another name, then give it its own: nobody reads half of one."""
    text = to_json(facts)
    partial = path.with_name(f"{path.name}.levkas.partial-{secrets.token_hex(4)}")
    try:
        with closing(sqlite3.connect(partial)) as index, index:
            index.executescript(TABLES)
            index.execute(
                "INSERT INTO facts VALUES (?, ?)", (text, hashlib.sha256(text.encode()).hexdigest())
            )
            index.executemany("INSERT INTO inputs VALUES (?, ?, ?, ?)", inputs)
            index.executemany("INSERT INTO products VALUES (?, ?)", products)
        partial.replace(path)
    finally:
        partial.unlink(missing_ok=True)
