"""Checks that names, links and pipes of a database do not lead out of its folder."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from functools import lru_cache
from pathlib import Path, PurePath

from levkas.core.problems import Problem, Refused
from levkas.core.text import unusable_name, what_stands_at


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
            yield _problem("E_LINK", path, "a link points outside the database", outside)
        elif found not in ("a file", "a folder", "no such file") and not (link and "link" in found):
            yield _problem("E_UNREADABLE", path, "it is not a file", found)


def check_inside(root: Path, *paths: Path) -> None:
    """Refuse files of a database that lie, all links followed, outside it; those that are not there pass.

    Raises LinkRefused: ``E_LINK`` with every such file.
    """
    if isinstance(root, Path):
        places = [(path, _place_outside(root, path)) for path in paths]
        why = "a link points outside the database"
        if wrong := [_problem("E_LINK", path, why, place) for path, place in places if place]:
            raise LinkRefused(*wrong)


def _place_outside(root: Path, path: Path) -> str:
    """Return where a path leads, all links followed, if that is outside a folder; ``""`` where it is inside."""
    place = os.path.realpath(path)
    return "" if place.startswith(os.path.join(os.path.realpath(root), "")) else place  # noqa: PTH118 -- once a file that is opened


def _problem(code: str, path: Path, why: str, found: str) -> Problem:
    what, expected = f"{path.name}: {why}", "a file of the database itself"
    fix = "Replace the entry by the file itself, or remove it."
    return Problem(code, what, str(path), found=found, expected=expected, fix=fix)
