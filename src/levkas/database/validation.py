"""Every damage of a database found, and the file named: each file is hashed and compared with the manifest."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from levkas.core.digests import hash_file
from levkas.core.machine import count_threads
from levkas.core.problems import Problem
from levkas.database.catalogue import NAME as CATALOGUE
from levkas.database.catalogue import (
    DatabaseRefused,
    Entry,
    database_of,
    no_database,
    read_catalogue,
)
from levkas.database.manifest import (
    NAME,
    Listed,
    find_escapes,
    is_partial,
    list_files,
    plain,
    read_manifest,
)
from levkas.database.remote import THREADS, RemoteRefused, is_remote


@dataclass(frozen=True)
class Checked:
    """One file that was checked; `done` of `total` files are."""

    name: str
    problems: tuple[Problem, ...] = ()
    done: int = 0
    total: int = 0
    label: str = "checking"
    finished: bool = True

    @property
    def line(self) -> str:
        return f"{self.name}: {'damaged' if self.problems else 'whole'}"

    @property
    def state(self) -> str:
        return "failed" if self.problems else "done"


@dataclass(frozen=True)
class ValidationReport:
    """How many files were `checked`, and at most one problem a file; of a damaged manifest that alone."""

    root: Path
    checked: int
    problems: tuple[Problem, ...] = ()

    @property
    def ok(self) -> bool:
        return not self.problems

    @property
    def text(self) -> str:
        files = len({p.file for p in self.problems})
        end = "all intact" if self.ok else f"{files} damaged, missing or foreign"
        return f"{self.root}: {self.checked} files checked, {end}"

    def to_dict(self) -> dict[str, Any]:
        return {"checked": self.checked}


def validate(
    database: str | Path,
    *,
    threads: int | None = None,
    draw: Callable[[Iterable[Checked]], list[Checked]] = list,
) -> ValidationReport:
    """Check a whole database: a folder as `levkas build` writes it, that of its campaign, or an address.

    `draw` consumes the steps; the command line draws them. Raises DatabaseRefused where there is no database at all.

    >>> validate("no/such/folder")
    Traceback (most recent call last):
    levkas.database.catalogue.DatabaseRefused: this folder does not exist...
    """
    root = database_of(database)
    steps = draw(check_files(root, threads=threads))
    once = {p.file: p for step in reversed(steps) for p in reversed(step.problems)}
    return ValidationReport(root, len([s for s in steps if s.name]), tuple(reversed(once.values())))


def check_files(database: str | Path, *, threads: int | None = None) -> Iterator[Checked]:
    """Yield every file as it is checked, then what is missing, too many, or does not agree; raises as `validate`."""
    root = database_of(database)
    if not any((root / name).is_file() for name in (NAME, CATALOGUE)):
        raise no_database(root, f"a folder with {CATALOGUE} and {NAME}")
    manifest = read_manifest(root / NAME)
    if manifest.problems:
        yield Checked(NAME, manifest.problems)
        return
    names = list_files(root)
    escapes = {str(p.file): p for p in find_escapes(root, names)}
    for name in names:
        if problem := escapes.get(str(root / name)):
            yield Checked(name, (problem,), total=len(names))
    names = [name for name in names if str(root / name) not in escapes]
    within = (file for name, file in manifest.files.items() if str(root / name) not in escapes)
    yield from _by_hash(root, {plain(file.name): file for file in within}, names, threads)


def _by_hash(
    root: Path, listed: Mapping[str, Listed], names: list[str], threads: int | None
) -> Iterator[Checked]:
    """Compare every file with the manifest."""
    there = {plain(name): name for name in names if name != NAME}
    missing = [file for key, file in listed.items() if key not in there]
    total = len(names) + len(missing)
    found: dict[str, str] = {}
    threads = threads or (THREADS if is_remote(root) else count_threads())
    with ThreadPoolExecutor(max(1, threads)) as pool:
        hashes = pool.map(lambda name: _hash(root / name), there.values())
        for done, (key, digest) in enumerate(zip(there, hashes, strict=True), 1):
            found[key] = digest
            if key not in listed or digest == listed[key].sha256:
                yield Checked(there[key], done=done, total=total)
    if NAME in names:
        yield Checked(NAME, done=len(there) + 1, total=total)
    damaged = [key for key in there if key in listed and found[key] != listed[key].sha256]
    for key in damaged:
        problem = _damage_of(root, there[key], listed[key], found[key], listed)
        yield Checked(there[key], (problem,), total, total)
    places = {digest: there[key] for key, digest in reversed(found.items())}
    problems = []
    for file in missing:
        more = {"found": f"its content is at {at}"} if (at := places.get(file.sha256)) else {}
        problems.append(_problem(root, file.name, "E_MISSING", "it is missing", **more))
    problems += [_unlisted(root, name) for key, name in there.items() if key not in listed]
    if not (missing or damaged):
        problems += _check_catalogue(root, listed)
    yield from (Checked("", (problem,), total, total) for problem in problems)


def _check_catalogue(root: Path, listed: Mapping[str, Listed]) -> Iterator[Problem]:
    """Hold the catalogue's own hashes against the manifest's, which were just found to be true."""
    entries: tuple[Entry, ...] = ()
    try:
        entries = read_catalogue(root) if (root / CATALOGUE).is_file() else ()
    except DatabaseRefused as refused:
        yield from refused.problems
    for entry in entries:
        name = f"{entry.layer.path}.tif"
        file = listed.get(plain(name))
        if file is None:
            yield _problem(root, name, "E_MISSING", f"{CATALOGUE} lists it, but it is missing")
        elif file.sha256 != entry.sha256.lower():
            more = {"field": f"sha256 of {name}", "found": entry.sha256, "expected": file.sha256}
            why = "a hash in it differs from the file"
            yield _problem(root, CATALOGUE, "E_DAMAGED", why, **more)


def _damage_of(
    root: Path, name: str, file: Listed, digest: str, listed: Mapping[str, Listed]
) -> Problem:
    """Return as closely as can be what happened to a file whose hash is not the one it had."""
    if digest.startswith("cannot"):
        if is_remote(root) and not (root / name).is_file():  # the manifest was taken for a listing
            return _problem(root, name, "E_MISSING", "it is missing")
        return _problem(root, name, "E_UNREADABLE", f"it {digest}")
    other = next((e.name for e in listed.values() if e.sha256 == digest), None)
    code, why = "E_DAMAGED", "its bytes have changed"
    found, expected = f"sha256 {digest}", f"sha256 {file.sha256}"
    size = (root / name).stat().st_size
    if other:
        code, why, found = "E_SWAPPED", "it is another file", f"the content of {other}"
    elif size != file.size:
        code, why = ("E_TRUNCATED", "it is cut") if size < file.size else ("E_SIZE", "it is longer")
        found, expected = f"{size} bytes", f"{file.size} bytes"
    return _problem(root, name, code, why, found=found, expected=expected)


def _unlisted(root: Path, name: str) -> Problem:
    what = "a file that was never finished" if is_partial(name) else "a file of no build"
    return Problem("E_EXTRA", what, str(root / name), fix="Remove it.")


def _hash(path: Path) -> str:
    """Return the SHA-256 of a file, or why it cannot be read."""
    try:
        return hash_file(path)
    except (OSError, RemoteRefused) as error:
        return f"cannot be read: {getattr(error, 'strerror', '') or error}"


def _problem(root: Path, name: str, code: str, why: str, **more: Any) -> Problem:
    fix = "Copy it again, or build the database again."
    return Problem(code, f"{Path(name).name}: {why}", file=str(root / name), fix=fix, **more)
