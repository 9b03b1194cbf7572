"""Listings of folders of raw frames: each read once, without hidden files and what levkas wrote."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterable
from pathlib import Path

from levkas.problems import Problem, Refused

PARTIAL = re.compile(r".*\.partial-[0-9a-f]{8}")
"""Names that an interrupted writer leaves behind."""
OWN_FILES = ("campaign.toml", "edits.toml")


class FolderUnreadable(Refused):
    """A folder of raw frames that cannot be listed."""


class Folders:
    """Listings by folder, kept while a campaign's files are looked for.

    Parameters
    ----------
    never : iterable of Path
        Folders not to look into, such as the campaign's output.

    Examples
    --------
    >>> Folders().files(Path("/no/such/folder"))
    ()
    """

    def __init__(self, *, never: Iterable[Path] = ()) -> None:
        self._never = {os.path.normpath(folder) for folder in never}
        self._known: dict[str, tuple[tuple[str, ...], tuple[str, ...], frozenset[str]]] = {}

    def files(self, folder: Path) -> tuple[str, ...]:
        """Return the names of the files of a folder, sorted; none where there is no folder.

        Raises FolderUnreadable where it is there and cannot be listed.
        """
        return self._listed(folder)[0]

    def folders(self, folder: Path) -> tuple[str, ...]:
        """Return the names of the folders in a folder, sorted; raises as `files`."""
        return self._listed(folder)[1]

    def is_link(self, folder: Path, name: str) -> bool:
        """Whether an entry is a symbolic link, which may lead back to where one comes from."""
        return name in self._listed(folder)[2]

    def _listed(self, folder: Path) -> tuple[tuple[str, ...], tuple[str, ...], frozenset[str]]:
        key = os.path.normpath(folder)
        if key not in self._known:
            self._known[key] = ((), (), frozenset()) if key in self._never else _scan(folder)
        return self._known[key]


def _scan(folder: Path) -> tuple[tuple[str, ...], tuple[str, ...], frozenset[str]]:
    files, folders, links = [], [], set()
    try:
        with os.scandir(folder) as entries:
            for entry in entries:
                if entry.name.startswith(".") or PARTIAL.fullmatch(entry.name):
                    continue
                if entry.is_dir():
                    folders.append(entry.name)
                elif entry.is_file() and entry.name not in OWN_FILES:
                    files.append(entry.name)
                if entry.is_symlink():
                    links.add(entry.name)
    except (FileNotFoundError, NotADirectoryError):
        return (), (), frozenset()
    except OSError as error:
        raise FolderUnreadable(
            Problem(
                "E_UNREADABLE",
                "a folder of raw frames cannot be listed",
                str(folder),
                found=error.strerror,
                fix="Give yourself the right to read it.",
            )
        ) from error
    if "catalogue.csv" in files and "objects" in folders:
        return (), (), frozenset()  # a database of ours, wherever it was written to
    return tuple(sorted(files)), tuple(sorted(folders)), frozenset(links)


def composed(name: str) -> str:
    """Return a name with composed accents, as people type it; some file systems take them apart.

    >>> len("e\\u0301"), len(composed("e\\u0301"))
    (2, 1)
    """
    return unicodedata.normalize("NFC", name)
