"""manifest-sha256.txt: the hash and the size of every published file, in lines that others read too.

A line is ``HASH  relative/path``, as in BagIt and as ``sha256sum -c`` and ``shasum -a 256 -c`` take
it; what only Levkas reads (sizes, and a hash of the manifest itself) is in comment lines.
"""

from __future__ import annotations

import hashlib
import io
import os
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from levkas.core.digests import hash_file
from levkas.core.files import DROPPINGS, PARTIAL, write_changed
from levkas.core.machine import count_threads
from levkas.core.problems import Problem
from levkas.core.text import DEEPEST
from levkas.database.containment import stays_inside

NAME = "manifest-sha256.txt"
LARGEST_REMOTE = 256 << 20
"""Bytes of a manifest on a server, whose size is the server's choice: two million files."""
LONGEST_LINE = 1 << 16
"""Bytes; the longest path of Linux has 4096, and each may be three letters in a manifest."""

_HEAD = re.compile(r"# levkas manifest 1: (\d+) files, (\d+) bytes, sha256 ([0-9a-f]{64}) below")
_SIZE = re.compile(r"# (\d+) bytes")
_LINE = re.compile(r"([0-9a-fA-F]{64}) [ *](.+)")


@dataclass(frozen=True, slots=True)
class Listed:
    """One file as the manifest has it; `size` in bytes."""

    name: str
    sha256: str
    size: int | None = None


@dataclass(frozen=True)
class Manifest:
    """What a database should consist of.

    Parameters
    ----------
    files : dict
        Relative path with ``/`` → `Listed`.
    bytes : int
        Of all files together.
    problems : tuple of Problem
        What is wrong with the manifest itself; empty where it is whole.
    """

    path: Path
    files: dict[str, Listed]
    bytes: int = 0
    problems: tuple[Problem, ...] = ()


def write_manifest(
    database: str | Path, known: Mapping[str, str] | None = None, *, threads: int | None = None
) -> Manifest:
    """Write the manifest of a database that is otherwise finished.

    Parameters
    ----------
    known : mapping, optional
        Relative path with ``/`` → SHA-256, of files that were hashed when they were written: they
        are not read again, and damage since then will be found.
    threads : int, optional
        For hashing; the manifest is the same for any number.

    Returns
    -------
    manifest : Manifest
        With the number and the size of the files. An unchanged one is not written anew.

    Raises WriteRefused where the disk refuses.
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
    total = sum(entry.size or 0 for entry in files.values())
    data = _to_bytes(files, total)
    path = root / NAME
    write_changed(path, data)
    return Manifest(path, files, total)


def read_manifest(path: str | Path) -> Manifest:
    """Read a manifest; damage in it is returned, never raised, and nothing of a damaged one is.

    It is read line by line; its files, and no second copy of its text, are in memory.
    """
    path = Path(path) if isinstance(path, str) else path
    try:
        size = path.stat().st_size
        if not isinstance(path, Path) and size > LARGEST_REMOTE:
            return _damaged(path, f"it has {size:,} bytes; on a server at most {LARGEST_REMOTE:,}")
        if isinstance(path, Path):
            with path.open("rb") as file:
                return _read(path, file)
        return _read(path, io.BytesIO(path.read_bytes()))
    except OSError as error:
        return _damaged(path, f"it cannot be read: {error}")


def _read(path: Path, file: BinaryIO) -> Manifest:
    """Read an open manifest, and compare its lines with its head."""
    lines = iter(lambda: file.readline(LONGEST_LINE), b"")
    head = next(lines, b"").removesuffix(b"\n").decode("ascii", "replace")
    stated = _HEAD.fullmatch(head)
    if stated is None:
        return _damaged(path, "its first line is not that of a build")
    digest = hashlib.sha256()
    manifest = _parse(path, _hashing(lines, digest))
    if digest.hexdigest() != stated.group(3):
        return _damaged(path, "its lines have changed")
    if (len(manifest.files), manifest.bytes) != (int(stated.group(1)), int(stated.group(2))):
        return _damaged(path, "its totals of files and bytes differ from its lines")
    return manifest


def _hashing(lines: Iterable[bytes], digest: hashlib._Hash) -> Iterator[bytes]:
    """Yield lines, and hash them."""
    for line in lines:
        digest.update(line)
        yield line


def list_files(folder: str | Path) -> list[str]:
    """Return the files below `folder`, relative with ``/``, sorted by code point; links to folders too.

    What file browsers and viewers leave behind (`core.files.DROPPINGS`) is left out. A folder deeper than `DEEPEST` is listed like a file.
    One on a server is listed as that does it, or as its manifest does.
    """
    if not isinstance(folder, str | Path):
        return sorted(folder.names())
    return sorted(walk_files(Path(folder)))


def is_partial(name: str) -> bool:
    """Whether a file, or a folder above it, bears a name that only unfinished ones bear."""
    return any(PARTIAL.fullmatch(part) for part in name.split("/"))


def unfinished(path: Path) -> Problem:
    """Return the problem of a file that an interrupted build left behind."""
    fix = "An interrupted build left it; the next build removes it."
    return Problem("E_EXTRA", "a file that was never finished", str(path), fix=fix)


def plain(name: str) -> str:
    """Return a name as it is compared: some file systems hand accents back in another spelling."""
    return unicodedata.normalize("NFC", name)


def walk_files(root: Path) -> Iterator[str]:
    """Yield the files below a folder as `list_files` has them, in no order."""
    # Thousands of names where all is fresh: texts, not paths.
    for place, folders, names in os.walk(root):
        above = place[len(str(root)) :].replace(os.sep, "/").strip("/")
        closed = [name for name in folders if os.path.islink(f"{place}{os.sep}{name}")]  # noqa: PTH114
        if above.count("/") + 1 >= DEEPEST:
            closed, folders[:] = [*folders], []
        for name in (*names, *closed):
            if not DROPPINGS.fullmatch(name):
                yield f"{above}/{name}" if above else name


def _to_bytes(files: Mapping[str, Listed], total: int) -> bytes:
    body = bytearray()
    for name in sorted(files):
        line = f"# {files[name].size} bytes\n{files[name].sha256}  {_encode(name)}\n"
        body += line.encode("utf-8", "surrogateescape")
    digest = hashlib.sha256(body).hexdigest()
    head = f"# levkas manifest 1: {len(files)} files, {total} bytes, sha256 {digest} below\n"
    return head.encode("ascii") + body


def _parse(path: Path, lines: Iterable[bytes]) -> Manifest:
    """Read the lines; those that cannot be are counted as one problem."""
    files: dict[str, Listed] = {}
    size: int | None = None
    wrong = first = 0
    for number, line in enumerate(lines, 1):
        text = line.decode("utf-8", "surrogateescape").removesuffix("\n").rstrip("\r")
        if stated := _SIZE.fullmatch(text):
            size = int(stated.group(1))
            continue
        found = _LINE.fullmatch(text)
        name = _decode(found.group(2)) if found else ""
        if found and name not in files and stays_inside(name):
            files[name] = Listed(name, found.group(1).lower(), size)
        elif text.strip():
            wrong, first = wrong + 1, first or number
        size = None
    total = sum(entry.size or 0 for entry in files.values())
    manifest = Manifest(path, files, total)
    if wrong:
        return _damaged(path, f"{wrong} lines cannot be read, the first is {first}")
    return manifest


def _encode(name: str) -> str:
    return name.replace("%", "%25").replace("\n", "%0A").replace("\r", "%0D")


def _decode(name: str) -> str:
    name = re.sub("%0a", "\n", re.sub("%0d", "\r", name, flags=re.I), flags=re.I)
    return name.removeprefix("./").replace("%25", "%")


def _damaged(path: Path, why: str) -> Manifest:
    problem = Problem(
        "E_DAMAGED",
        f"the manifest is damaged: {why}",
        file=str(path),
        fix="Copy it again, or build the database again to write it.",
    )
    return Manifest(path, {}, problems=(problem,))
