"""Checks that names, links and pipes of a database do not lead out of its folder."""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path, PurePath

from levkas.core.problems import Problem, Refused
from levkas.core.text import unusable_name, what_stands_at

_ODD = re.compile(r"^/|[\\:\0]")
"""In names that may lead elsewhere, on some system."""
EXPECTED, FIX = (
    "a file of the database itself",
    "Replace the entry by the file itself, or remove it.",
)


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
    if ".." not in name and not _ODD.search(name):
        return bool(name)
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
    """Yield a problem for everything that cannot be read as a file of its own database.

    Parameters
    ----------
    names : iterable of str
        Files below it and links to folders, relative with ``/``, as `list_files` has them.

    Yields
    ------
    problem : Problem
        ``E_LINK`` for a link that leads out, ``E_UNREADABLE`` for a pipe, a socket or a device.
    """
    if not isinstance(root, Path):  # on a server, where there are no links
        return
    real = root.resolve()
    for name in names:
        if _is_plain_file(f"{root}{os.sep}{name}"):
            continue
        path = root / name
        if path.is_symlink() and not _leads_into(path, real):
            yield _problem(
                "E_LINK", path, "a link points outside the database", str(path.readlink())
            )
        elif (found := what_stands_at(path)) not in ("a file", "a folder", "no such file"):
            if path.is_symlink() and "link" in found:
                continue  # to nothing: what is missing is reported elsewhere
            yield _problem("E_UNREADABLE", path, "it is not a file", found)


def check_inside(root: Path, *paths: Path) -> None:
    """Refuse files of a database that lie, all links followed, outside it; those that are not there pass.

    Raises LinkRefused: ``E_LINK`` with every such file.
    """
    if not isinstance(root, Path):
        return
    real = os.path.join(os.path.realpath(root), "")  # noqa: PTH118 -- once a file that is opened
    places = ((path, os.path.realpath(path)) for path in paths)
    if wrong := [(path, place) for path, place in places if not place.startswith(real)]:
        why = "a link points outside the database"
        raise LinkRefused(*(_problem("E_LINK", path, why, place) for path, place in wrong))


def _is_plain_file(path: str) -> bool:
    try:
        return stat.S_ISREG(os.lstat(path).st_mode)
    except (OSError, ValueError):
        return False


def _problem(code: str, path: Path, why: str, found: str) -> Problem:
    what = f"{path.name}: {why}"
    return Problem(code, what, str(path), found=found, expected=EXPECTED, fix=FIX)


def _leads_into(path: Path, root: Path) -> bool:
    try:
        return path.resolve().is_relative_to(root)
    except (OSError, RuntimeError):  # a link that leads to itself
        return False
