"""What Levkas may write over: a folder that bears its mark, and files only where that is asked for.

A database bears `MARK` in the first line of its database.toml, which a build writes before anything else; a finished one
also in its manifest, as a publication does.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from levkas.core.disk import WriteRefused
from levkas.core.files import DROPPINGS, OURS
from levkas.core.problems import SCHEMES, Problem
from levkas.core.text import what_stands_at

Kind = Literal["database", "publication"]

IMPRINT = "database.toml"
"""Facts of a database as a whole; its first line is `MARK`."""
MARK = "# Written by Levkas. A build goes on only in a folder that bears this line.\n"
MANIFEST = b"# levkas manifest 1: "
HOME = "~"


def made(folder: str | Path) -> Kind | None:
    """Return what of ours a folder is, by its mark; None where it has none."""
    folder = Path(folder)
    if _begins(folder / "manifest-sha256.txt", MANIFEST):
        return "publication" if (folder / "ro-crate-metadata.json").is_file() else "database"
    return "database" if _begins(folder / IMPRINT, MARK.encode()) else None


def _begins(path: Path, mark: bytes) -> bool:
    try:
        if not path.is_file():
            return False
        with path.open("rb") as file:
            return file.read(len(mark)) == mark
    except OSError:
        return False


def stands_in(folder: Path) -> str:
    """Return in words what exists at a folder's name; ``""`` for nothing, and for an empty folder.

    What a killed run of ours left in it counts for nothing, nor does what file browsers leave.
    """
    if not os.path.lexists(folder):
        return ""
    found = what_stands_at(folder)
    names = (path.name for path in folder.iterdir()) if found == "a folder" else [folder.name]
    left = all(DROPPINGS.fullmatch(name) or OURS.fullmatch(name) for name in names)
    return "" if found == "a folder" and left else found


def require_free(path: str | Path, *, overwrite: bool = False) -> Path:
    """Refuse to replace an existing file; with `overwrite`, only where the name is not a file's, or in a database."""
    path = Path(path)
    require_outside(path, fix="Give another name: a database holds only what a build writes.")
    found = what_stands_at(path) if os.path.lexists(path) else ""
    zarr = found == "a folder" and path.suffix == ".zarr"  # one picture to its readers
    if found and not (overwrite and (found == "a file" or zarr)):
        fix = "Give another name" + (", or --overwrite." if found == "a file" or zarr else ".")
        raise refusal(f"{path.name} already exists", path, "new file", found, fix)
    return path


def new_files(folder: Path, *, overwrite: bool = False) -> Callable[[Path], None]:
    """Return a check for `before_writing`: `require_free` of whatever is written below a folder, once each."""
    require_outside(folder / "x", fix="Give another folder with -o.")
    found = stands_in(folder)
    if found not in ("", "a folder"):
        raise refusal("the folder cannot be created", folder, "folder", found, "")
    passed: set[Path] = set()

    def check(path: Path) -> None:
        if not path.resolve().is_relative_to(folder.resolve()):
            raise refusal("a name points outside the folder", folder, "file in it", str(path), "")
        if path not in passed:
            require_free(path, overwrite=overwrite)
            passed.add(path)

    return check


def require_outside(path: Path, *, fix: str) -> None:
    """Refuse what `require_path` does, and what would stand in a database or a publication; raises WriteRefused."""
    require_path(path)
    for folder in Path(path).resolve().parents:
        if ours := made(folder):
            what = f"a {ours}: {folder}"
            message = "this would be written into a folder of Levkas"
            raise refusal(message, path, "folder apart", what, fix)


def require_path(path: str | Path) -> None:
    """Refuse an address, and a new folder ``~``, which a shell that does not expand an option makes; raises WriteRefused."""
    if is_address(path := Path(path)):
        fix = "Write to a folder of this machine, then copy that there; docs/howto/remote.md shows how."
        message = "this is the address of a server, where nothing can be written"
        raise refusal(message, path, "folder of this machine", "an address", fix)
    if HOME in path.parts and not os.path.lexists(path):
        fix = "Write the whole path; in an option, a blank in place of the = before ~."
        raise refusal("~ means a home to shells alone", path, "path", f"a folder {HOME!r}", fix)


def is_address(path: str | Path) -> bool:
    """Return whether a path was meant as an address; as a path it would make a folder ``s3:``.

    >>> is_address("s3://museum/icons"), is_address(Path("/home/https:/museum.org")), is_address("C:/icons")
    (True, True, False)
    """
    return any(re.fullmatch(f"({SCHEMES}):", part, re.IGNORECASE) for part in Path(path).parts)


def refusal(message: str, path: Path, expected: str, found: str, fix: str) -> WriteRefused:
    """Make the refusal of a place that is not ours to write."""
    fix = fix or "Give another folder with -o."
    return WriteRefused(
        Problem("E_UNWRITABLE", message, str(path), found=found, expected=f"a {expected}", fix=fix)
    )
