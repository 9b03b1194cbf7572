"""Marks of files that Levkas wrote: only these are ever replaced or removed.

A database bears `MARK` in the first line of its database.toml, which a build writes before anything
else; a finished one also in its manifest, as a publication does. Of files
that are written into a folder of somebody else's, such as an export, a record beside them says which.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import os
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Literal

from levkas.core.digests import hash_file, hash_tree
from levkas.core.disk import WriteRefused
from levkas.core.files import DROPPINGS, OURS
from levkas.core.problems import SCHEMES, Problem, Refused
from levkas.core.text import read_json, what_stands_at

Kind = Literal["database", "publication"]

IMPRINT = "database.toml"
"""Facts of a database as a whole; its first line is `MARK`."""
MARK = "# Written by Levkas. A build goes on only in a folder that bears this line.\n"
RECORD = "levkas-files.json"
"""Beside files that were written one by one: name → SHA-256, null while it is being written."""
LONGEST_MARK = 4096
"""Bytes of a file that a mark is looked for in."""
_MANIFEST = re.compile(rb"# levkas manifest 1: ")
_DATABASE = re.compile(re.escape(MARK.encode()))


def made(folder: str | Path) -> Kind | None:
    """Return what of ours a folder is, by its mark; None where it has none."""
    folder = Path(folder)
    if _MANIFEST.match(_head(folder / "manifest-sha256.txt")):
        return "publication" if (folder / "ro-crate-metadata.json").is_file() else "database"
    return "database" if _DATABASE.match(_head(folder / IMPRINT)) else None


def stands_in(folder: Path) -> str:
    """Return in words what exists at a folder's name; ``""`` for nothing, and for an empty folder.

    What a killed run of ours left in it counts for nothing, nor does what file browsers leave.
    """
    if not os.path.lexists(folder):
        return ""
    found = what_stands_at(folder)
    if found == "a folder" and all(
        DROPPINGS.fullmatch(path.name) or OURS.fullmatch(path.name) for path in folder.iterdir()
    ):
        return ""
    return found


def require_free(path: str | Path, *, overwrite: bool = False) -> Path:
    """Refuse to replace an existing file; with `overwrite`, only where the name is not a file's, or in a database."""
    path = Path(path)
    require_outside(path, fix="Give another name: a database holds only what a build writes.")
    found = what_stands_at(path) if os.path.lexists(path) else ""
    if found and not (overwrite and found == "a file"):
        fix = "Give another name" + (", or --overwrite." if found == "a file" else ".")
        raise refusal(f"{path.name} already exists", path, "new file", found, fix)
    return path


HOME = "~"


def require_outside(path: Path, *, fix: str) -> None:
    """Refuse what `require_path` does, and what would stand in a database, a publication or a bag; raises WriteRefused."""
    require_path(path)
    for folder in Path(path).resolve().parents:
        if ours := made(folder):
            what = f"a {ours}: {folder}"
            raise refusal(
                "this would be written into a folder of Levkas", path, "folder apart", what, fix
            )


def require_path(path: str | Path) -> None:
    """Refuse an address, and a new folder ``~``, which a shell that does not expand an option makes; raises WriteRefused."""
    if is_address(path := Path(path)):
        where = "a folder of this machine"
        raise refusal(
            "this is the address of a server, where nothing can be written",
            path,
            where.removeprefix("a "),
            "an address",
            f"Write to {where}, then copy that there; docs/howto/remote.md shows how.",
        )
    if HOME in path.parts and not os.path.lexists(path):
        fix = "Write the whole path; in an option, a blank in place of the = before ~."
        raise refusal("~ means a home to shells alone", path, "path", f"a folder {HOME!r}", fix)


def is_address(path: str | Path) -> bool:
    """Return whether a path was meant as an address; as a path it would make a folder ``s3:``.

    >>> is_address("s3://museum/icons"), is_address(Path("/home/https:/museum.org")), is_address("C:/icons")
    (True, True, False)
    """
    return any(re.fullmatch(f"({SCHEMES}):", part, re.IGNORECASE) for part in Path(path).parts)


class OwnFiles:
    """Files that are written into a folder one by one, beside other files.

    With `overwrite` files that are not ours, or were changed since, may be replaced.
    """

    def __init__(self, folder: str | Path, *, overwrite: bool = False) -> None:
        self.folder, self.overwrite = Path(folder), overwrite
        require_outside(self.folder / RECORD, fix="Give another folder with -o.")
        found = stands_in(self.folder)
        if found not in ("", "a folder"):
            raise refusal("the folder cannot be created", self.folder, "folder", found, "")
        self._files = _record(self.folder / RECORD)

    @contextlib.contextmanager
    def writing(self) -> Iterator[None]:
        """Let what this thread writes in the block replace only files of ours; raises WriteRefused before it replaces another."""
        from levkas.core.files import before_writing

        touched: list[Path] = []

        def claim_once(path: Path) -> None:
            if path.name != RECORD and path not in touched:
                self.claim(path)
                touched.append(path)

        try:
            with before_writing(claim_once):
                yield
        finally:
            self.keep(*touched)

    def claim(self, path: Path) -> None:
        """Take the name of a file that is about to be written; raises WriteRefused as `writing`."""
        name = self._name(path)
        self._require(path, name)
        self._files[name] = None
        self._save()

    def keep(self, *paths: Path) -> None:
        """Record files whose names were claimed as they are now; those that were not written go."""
        for path in paths:
            self._files.pop(name := self._name(path), None)
            if digest := _hash(path):
                self._files[name] = digest
        if paths:
            self._save()

    def _require(self, path: Path, name: str) -> None:
        if name.startswith("../") or Path(name).is_absolute():
            raise refusal("a name points outside the folder", self.folder, "file in it", name, "")
        if self.overwrite and name in self._files and path.is_dir():
            return
        if self.overwrite or not os.path.lexists(path):
            require_free(path, overwrite=True)
        elif name not in self._files or self._files[name] not in (None, _hash(path)):
            why = "was changed since" if name in self._files else "was not written by it"
            fix = "Give another folder with -o, or --overwrite."
            raise refusal(f"{name} {why}", path, "file that Levkas wrote", "another", fix)

    def _name(self, path: Path) -> str:
        return Path(os.path.relpath(path, self.folder)).as_posix()

    def _save(self) -> None:
        from levkas.core.files import write_json

        write_json(self.folder / RECORD, {"files": dict(sorted(self._files.items()))})


def _head(path: Path) -> bytes:
    try:
        if not path.is_file():
            return b""
        with path.open("rb") as file:
            return file.read(LONGEST_MARK)
    except OSError:
        return b""


def _record(path: Path) -> dict[str, str | None]:
    if not os.path.lexists(path):
        return {}
    try:
        return {str(name): digest for name, digest in dict(read_json(path)["files"]).items()}
    except (Refused, KeyError, TypeError, ValueError):
        what = "another file of that name"
        raise refusal(
            f"{RECORD} was not written by Levkas", path, "record by Levkas", what, ""
        ) from None


def _hash(path: Path) -> str:
    """Digest of a file, or of all that a folder holds; empty where nothing stands there."""
    if path.is_dir():
        return hashlib.sha256(json.dumps(hash_tree(path)).encode()).hexdigest()
    return hash_file(path) if path.is_file() else ""


def refusal(message: str, path: Path, expected: str, found: str, fix: str) -> WriteRefused:
    """Make the refusal of a place that is not ours to write."""
    return WriteRefused(
        Problem(
            "E_UNWRITABLE",
            message,
            file=str(path),
            found=found,
            expected=f"a {expected}",
            fix=fix or "Give another folder with -o.",
        )
    )
