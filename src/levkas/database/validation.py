"""Every damage of a database found, and the file named: each file is hashed and compared with the manifest."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from levkas.core.digests import hash_file
from levkas.core.files import DROPPINGS
from levkas.core.machine import count_threads
from levkas.core.problems import Problem
from levkas.database.catalogue import NAME as CATALOGUE
from levkas.database.catalogue import DatabaseRefused, database_of, no_database, read_catalogue
from levkas.database.containment import find_escapes
from levkas.database.manifest import (
    NAME,
    Listed,
    is_partial,
    list_files,
    plain,
    read_manifest,
    unfinished,
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
        """One line for a log."""
        return f"{self.name}: {'damaged' if self.problems else 'whole'}"

    @property
    def state(self) -> str:
        """``"done"``, or ``"failed"`` where the file is damaged."""
        return "failed" if self.problems else "done"


@dataclass(frozen=True)
class ValidationReport:
    """What a validation found.

    Parameters
    ----------
    checked : int
        Files.
    problems : tuple of Problem
        At most one a file; empty where all is as it was published. Of a manifest that is missing or damaged that alone.
    """

    root: Path
    checked: int
    problems: tuple[Problem, ...] = field(default=())

    @property
    def ok(self) -> bool:
        """Whether nothing is damaged."""
        return not self.problems

    @property
    def text(self) -> str:
        """Two lines for people."""
        files = len({p.file for p in self.problems})
        end = "all intact" if self.ok else f"{files} damaged, missing or foreign"
        return f"{self.root}: {self.checked} files checked, {end}"

    def to_dict(self) -> dict[str, Any]:
        """Return what `--json` adds to the problems."""
        return {"checked": self.checked}


def validate(
    database: str | Path,
    *,
    threads: int | None = None,
    draw: Callable[[Iterable[Checked]], list[Checked]] = list,
) -> ValidationReport:
    """Check a whole database.

    Parameters
    ----------
    database : path
        A folder as `levkas build` writes it, that of the campaign that it was built from, or the address of a database.
    threads : int, optional
        For hashing; default: `levkas.core.machine.count_threads`.
    draw : callable
        Consumes the steps; the command line draws them.

    Raises DatabaseRefused where there is no database at all.

    Examples
    --------
    >>> validate("no/such/folder")
    Traceback (most recent call last):
    levkas.database.catalogue.DatabaseRefused: this folder does not exist...
    """
    root = database_of(database)
    steps = draw(check_files(root, threads=threads))
    problems = _once(p for step in steps for p in step.problems)
    return ValidationReport(root, len([s for s in steps if s.name]), tuple(problems))


def check_files(database: str | Path, *, threads: int | None = None) -> Iterator[Checked]:
    """Yield every file as it is checked, then what is missing, too many, or does not agree.

    Raises DatabaseRefused where there is no database at all.
    """
    root = database_of(database)
    if not any((root / name).is_file() for name in (NAME, CATALOGUE)):
        raise no_database(root, f"a folder with {CATALOGUE} and {NAME}")
    manifest = read_manifest(root / NAME)
    if manifest.problems:
        yield Checked(NAME, manifest.problems)
        return
    names = list_files(root)
    escapes = {str(p.file): p for p in find_escapes(root, names)}
    for name in (n for n in names if str(root / n) in escapes):
        yield Checked(name, (escapes[str(root / name)],), total=len(names))
    names = [name for name in names if str(root / name) not in escapes]
    files = {n: f for n, f in manifest.files.items() if str(root / n) not in escapes}
    count = threads or (THREADS if is_remote(root) else count_threads())
    yield from _by_hash(root, files, names, count)


def _by_hash(
    root: Path, files: Mapping[str, Listed], names: list[str], threads: int
) -> Iterator[Checked]:
    """Compare every file with the manifest."""
    # An older build listed what viewers left.
    kept = {n: one for n, one in files.items() if not DROPPINGS.fullmatch(n.split("/")[-1])}
    listed = {plain(n): one for n, one in kept.items()}
    there = {plain(name): name for name in names if name != NAME}
    missing = [listed[key] for key in listed if key not in there]
    extra = [there[key] for key in there if key not in listed]
    total = len(names) + len(missing)
    found: dict[str, str] = {}
    damaged: dict[str, Listed] = {}
    with ThreadPoolExecutor(max(1, threads)) as pool:
        hashes = pool.map(lambda name: _hash(root / name), there.values())
        for done, (key, digest) in enumerate(zip(there, hashes, strict=True), 1):
            found[key] = digest
            if key in listed and digest != listed[key].sha256:
                damaged[key] = listed[key]
            else:
                yield Checked(there[key], done=done, total=total)
    for name in (n for n in names if n == NAME):
        yield Checked(name, done=len(there) + 1, total=total)
    for key, entry in damaged.items():
        problem = _damage_of(root, there[key], entry, found[key], listed)
        yield Checked(there[key], (problem,), total, total)
    for entry in missing:
        where = [there[key] for key, digest in found.items() if digest == entry.sha256]
        more = {"found": f"its content is at {where[0]}"} if where else {}
        yield Checked(
            "", (_problem(root, entry.name, "E_MISSING", "it is missing", **more),), total, total
        )
    for name in extra:
        yield Checked(name, (_unlisted(root, name),), total, total)
    if not (missing or damaged):
        stale = tuple(_check_catalogue(root, listed))
        yield Checked("", stale, total, total)


def _check_catalogue(root: Path, listed: dict[str, Listed]) -> Iterator[Problem]:
    """Hold the catalogue's own hashes against the manifest's, which were just found to be true."""
    if not (root / CATALOGUE).is_file():
        return
    try:
        entries = read_catalogue(root)
    except DatabaseRefused as refused:
        yield from refused.problems
        return
    for entry in entries:
        name = f"{entry.layer.path}.tif"
        file = listed.get(plain(name))
        if file is None:
            yield _problem(root, name, "E_MISSING", f"{CATALOGUE} lists it, but it is missing")
        elif file.sha256 != entry.sha256.lower():
            details = {"field": f"sha256 of {name}", "found": entry.sha256, "expected": file.sha256}
            yield _problem(
                root, CATALOGUE, "E_DAMAGED", "a hash in it differs from the file", **details
            )


def _damage_of(
    root: Path, name: str, entry: Listed, digest: str, listed: dict[str, Listed]
) -> Problem:
    """Return as closely as can be what happened to a file whose hash is not the one it had."""
    if digest.startswith("cannot"):
        if is_remote(root) and not (root / name).is_file():  # the manifest was taken for a listing
            return _problem(root, name, "E_MISSING", "it is missing")
        return _problem(root, name, "E_UNREADABLE", f"it {digest}")
    others = [e.name for e in listed.values() if e.sha256 == digest and e.name != entry.name]
    if others:
        details = {"found": f"the content of {others[0]}", "expected": f"sha256 {entry.sha256}"}
        return _problem(root, name, "E_SWAPPED", "it holds the content of another file", **details)
    size = (root / name).stat().st_size
    if entry.size is not None and size != entry.size:
        details = {"found": f"{size} bytes", "expected": f"{entry.size} bytes"}
        if size < entry.size:
            return _problem(root, name, "E_TRUNCATED", "it is truncated", **details)
        return _problem(root, name, "E_SIZE", "it has extra bytes", **details)
    details = {"found": f"sha256 {digest}", "expected": entry.sha256}
    return _problem(root, name, "E_DAMAGED", "its bytes have changed", **details)


def _unlisted(root: Path, name: str) -> Problem:
    """Return the problem of a file that the manifest does not have."""
    if is_partial(name):
        return unfinished(root / name)
    return Problem(
        "E_EXTRA",
        "this file is not in the manifest",
        str(root / name),
        fix="Remove it; only a build adds files here.",
    )


def _hash(path: Path) -> str:
    """Return the SHA-256 of a file, or why it cannot be read."""
    try:
        return hash_file(path)
    except OSError as error:
        return f"cannot be read: {error.strerror or error}"
    except RemoteRefused as refused:
        return f"cannot be read: {refused.problems[0].message}"


def _problem(root: Path, name: str, code: str, why: str, **more: Any) -> Problem:
    """Return the problem of one file of a database."""
    fix = "Copy it again, or build the database again."
    return Problem(code, f"{Path(name).name}: {why}", file=str(root / name), fix=fix, **more)


def _once(problems: Iterable[Problem]) -> Iterator[Problem]:
    """Leave out what was reported of a file before in other words."""
    reported: set[str | None] = set()
    for problem in problems:
        if problem.file not in reported:
            yield problem
        reported.add(problem.file)
