"""Listings of folders of raw frames: each read once, without hidden files and what levkas wrote."""

from __future__ import annotations

import os
import re
import unicodedata
from collections.abc import Iterable, Iterator
from pathlib import Path

from levkas.campaign.discovery.patterns import natural
from levkas.core.problems import Problem, Refused

PARTIAL = re.compile(r".*\.partial-[0-9a-f]{8}")
"""Names that an interrupted writer leaves behind."""
OWN_FILES = ("campaign.toml", "edits.toml")
DEEPEST = 64
"""Folders in one another below the one that is looked at; captures lie three or four deep."""


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


def too_deep(folder: Path) -> FolderUnreadable:
    """Return the refusal of a folder that lies deeper than `DEEPEST`."""
    return FolderUnreadable(
        Problem(
            "E_SIZE",
            "folders are nested too deeply",
            str(folder),
            found=f"over {DEEPEST} in one another",
            expected=f"at most {DEEPEST}",
            fix="Name the folder that holds the frames.",
        )
    )


def walk(root: Path, folders: Folders) -> Iterator[tuple[tuple[str, ...], tuple[str, ...] | None]]:
    """Yield (folders below the root, names of the files) of every folder, in natural order, from the top.

    No folder is entered twice, whatever links lead to it. For what is nested deeper than `DEEPEST`
    the names are None, and it is not entered.
    """
    visited: set[tuple[int, int]] = set()
    waiting: list[tuple[str, ...]] = [()]
    while waiting:
        above = waiting.pop()
        folder = root.joinpath(*above)
        found = folder.stat() if folder.is_dir() else None
        if found is None or (found.st_dev, found.st_ino) in visited:
            continue
        visited.add((found.st_dev, found.st_ino))
        if len(above) > DEEPEST:
            yield above, None
            continue
        yield above, tuple(_naturally(folders.files(folder)))
        waiting += [(*above, name) for name in reversed(_naturally(folders.folders(folder)))]


def _naturally(names: Iterable[str]) -> list[str]:
    return sorted(names, key=lambda name: (natural(name), name))


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
