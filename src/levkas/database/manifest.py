"""The files of a database: which there are, that none leads out of its folder, and manifest-sha256.txt with the hash and size of each.

A line is ``HASH  relative/path``, as in BagIt and as ``sha256sum -c`` and ``shasum -a 256 -c`` take
it; what only Levkas reads (sizes, and a hash of the manifest itself) is in comment lines.
"""

from __future__ import annotations

import hashlib
import os
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path, PurePath

from levkas.core.digests import hash_file
from levkas.core.files import DROPPINGS, PARTIAL, write_changed
from levkas.core.machine import count_threads
from levkas.core.problems import Problem, Refused
from levkas.core.text import DEEPEST, unusable_name, what_stands_at

NAME = "manifest-sha256.txt"
LARGEST = 256 << 20
"""Bytes of a manifest, whose size on a server is the server's choice: two million files."""
_HEAD = re.compile(r"# levkas manifest 1: (\d+) files, (\d+) bytes, sha256 ([0-9a-f]{64}) below")
_LINES = re.compile(r"# (\d+) bytes\n([0-9a-f]{64})  (.+)\n")


@dataclass(frozen=True, slots=True)
class Listed:
    """One file as the manifest has it; `size` in bytes."""

    name: str
    sha256: str
    size: int


@dataclass(frozen=True)
class Manifest:
    """What a database should consist of: relative paths with ``/`` and their files, the `bytes` of all, and what is wrong with the manifest itself."""

    path: Path
    files: dict[str, Listed]
    bytes: int = 0
    problems: tuple[Problem, ...] = ()


def write_manifest(
    database: str | Path, known: Mapping[str, str] | None = None, *, threads: int | None = None
) -> Manifest:
    """Write the manifest of a database that is otherwise finished; an unchanged one is not written anew.

    `known`, relative path → SHA-256, are files that were hashed when they were written: they are not read again, and damage
    since then will be found. The manifest is the same for any number of `threads`. Raises WriteRefused.
    """
    root, known = Path(database), known or {}
    names = [name for name in list_files(root) if name != NAME and not is_partial(name)]

    def listed(name: str) -> Listed | None:
        path = root / name
        try:
            return Listed(name, known.get(name) or hash_file(path), path.stat().st_size)
        except FileNotFoundError:  # taken away by a build beside this one, which ends with its own
            return None

    with ThreadPoolExecutor(threads or count_threads(2)) as pool:
        files = {entry.name: entry for entry in pool.map(listed, names) if entry is not None}
    total = sum(entry.size for entry in files.values())
    write_changed(root / NAME, _to_bytes(files, total))
    return Manifest(root / NAME, files, total)


def read_manifest(path: str | Path) -> Manifest:
    """Read a manifest; damage in it is returned, never raised, and nothing of a damaged one is."""
    path, files = Path(path) if isinstance(path, str) else path, dict[str, Listed]()
    try:
        if (size := path.stat().st_size) > LARGEST:
            return _damaged(path, f"it has {size:,} bytes; at most {LARGEST:,} are read")
        head, _, body = path.read_bytes().partition(b"\n")
    except OSError as error:
        return _damaged(path, f"it cannot be read: {error}")
    stated = _HEAD.fullmatch(head.decode("ascii", "replace"))
    if stated is None:
        return _damaged(path, "its first line is not that of a build")
    if hashlib.sha256(body).hexdigest() != stated[3]:
        return _damaged(path, "its lines have changed")
    for found in _LINES.finditer(body.decode("utf-8", "surrogateescape")):
        name = re.sub("%(0A|0D|25)", lambda code: chr(int(code[1], 16)), found[3])
        if not stays_inside(name):
            return _damaged(path, f"{name!r} is not a file of the database")
        files[name] = Listed(name, found[2], int(found[1]))
    total = sum(entry.size for entry in files.values())
    if (len(files), total) != (int(stated[1]), int(stated[2])):
        return _damaged(path, "its totals of files and bytes differ from its lines")
    return Manifest(path, files, total)


def _to_bytes(files: Mapping[str, Listed], total: int) -> bytes:
    body = bytearray()
    for name in sorted(files):
        coded = name.replace("%", "%25").replace("\n", "%0A").replace("\r", "%0D")
        line = f"# {files[name].size} bytes\n{files[name].sha256}  {coded}\n"
        body += line.encode("utf-8", "surrogateescape")
    digest = hashlib.sha256(body).hexdigest()
    head = f"# levkas manifest 1: {len(files)} files, {total} bytes, sha256 {digest} below\n"
    return head.encode("ascii") + body


def _damaged(path: Path, why: str) -> Manifest:
    what, fix = f"the manifest is damaged: {why}", "Copy it again, or build the database again."
    return Manifest(path, {}, problems=(Problem("E_DAMAGED", what, str(path), fix=fix),))


def list_files(folder: Path) -> list[str]:
    """Return what `walk_files` finds, sorted by code point; of a folder on a server, what its manifest lists."""
    return sorted(walk_files(folder) if isinstance(folder, Path) else folder.names())


def walk_files(root: Path) -> Iterator[str]:
    """Yield the files below a folder, relative with ``/``, in no order; links to folders, and folders deeper than `DEEPEST`, too.

    What file browsers and viewers leave behind (`core.files.DROPPINGS`) is left out.
    """
    # Thousands of names where all is fresh: texts, not paths.
    for place, folders, names in os.walk(root):
        above = place[len(str(root)) :].replace(os.sep, "/").strip("/")
        closed = [name for name in folders if os.path.islink(f"{place}{os.sep}{name}")]  # noqa: PTH114
        if above.count("/") + 1 >= DEEPEST:
            closed, folders[:] = [*folders], []
        for name in (*names, *closed):
            if not DROPPINGS.fullmatch(name):
                yield f"{above}/{name}" if above else name


def is_partial(name: str) -> bool:
    """Whether a file, or a folder above it, bears a name that only unfinished ones bear."""
    return any(PARTIAL.fullmatch(part) for part in name.split("/"))


def plain(name: str) -> str:
    """Return a name as it is compared: some file systems hand accents back in another spelling."""
    return unicodedata.normalize("NFC", name)


class LinkRefused(Refused):
    """A file of a database is a link, or lies behind one, that leads out of the database."""


@lru_cache(maxsize=4096)
def is_plain_name(name: str) -> bool:
    """Whether a name is one part of a path and no way up, on this system.

    >>> [is_plain_name(n) for n in ("icon 1", "..", "a/b", "/a", "")]
    [True, False, False, False, False]
    """
    return PurePath(name).parts == (name,) and stays_inside(name) and not unusable_name(name)


def stays_inside(name: str) -> bool:
    """Whether a path is relative and leads up nowhere, on this system.

    >>> [stays_inside(n) for n in ("objects/icon1/a.tif", "../a", "/a", "a/../..", "")]
    [True, False, False, False, False]
    """
    path = PurePath(name)
    return bool(name) and not path.anchor and ".." not in path.parts and "\0" not in name


def check_plain_names(*names: str) -> None:
    """Raise ValueError for the first of some names of objects, cameras or setups that is a path, or too long."""
    for name in names:
        if why := unusable_name(name):
            raise ValueError(f"{name[:40]!r} is not a name: {why}")
        if not is_plain_name(name):
            raise ValueError(f"{name!r} is not a name; it points to another folder")


def find_escapes(root: Path, names: Iterable[str]) -> Iterator[Problem]:
    """Yield a problem for each of some files and links that cannot be read as a file of its own database.

    ``E_LINK`` for a link that leads out, ``E_UNREADABLE`` for a pipe, a socket or a device; one to nothing is reported as missing.
    """
    if not isinstance(root, Path):  # on a server, where there are no links
        return
    for name in names:
        text = f"{root}{os.sep}{name}"
        link = os.path.islink(text)  # noqa: PTH114
        if os.path.isfile(text) and not link:  # noqa: PTH113 -- thousands of them
            continue
        path, found = root / name, what_stands_at(root / name)
        if link and (outside := _place_outside(root, path)):
            yield _stray("E_LINK", path, "a link points outside the database", outside)
        elif found not in ("a file", "a folder", "no such file") and not (link and "link" in found):
            yield _stray("E_UNREADABLE", path, "it is not a file", found)


def check_inside(root: Path, *paths: Path) -> None:
    """Refuse files of a database that lie, all links followed, outside it; those that are not there pass.

    Raises LinkRefused: ``E_LINK`` with every such file.
    """
    if isinstance(root, Path):
        places = [(path, _place_outside(root, path)) for path in paths]
        why = "a link points outside the database"
        if wrong := [_stray("E_LINK", path, why, place) for path, place in places if place]:
            raise LinkRefused(*wrong)


def _place_outside(root: Path, path: Path) -> str:
    """Return where a path leads, all links followed, if that is outside a folder; ``""`` where it is inside."""
    place = os.path.realpath(path)
    return "" if place.startswith(os.path.join(os.path.realpath(root), "")) else place  # noqa: PTH118 -- once a file that is opened


def _stray(code: str, path: Path, why: str, found: str) -> Problem:
    what, expected = f"{path.name}: {why}", "a file of the database itself"
    fix = "Replace the entry by the file itself, or remove it."
    return Problem(code, what, str(path), found=found, expected=expected, fix=fix)
