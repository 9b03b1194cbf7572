"""The database itself in the published folder: every file copied, and its hash compared on the way."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.core.problems import Problem
from levkas.publish.publication import PublishRefused

if TYPE_CHECKING:
    from levkas.publish.publication import Publication


def write_content(publication: Publication) -> Iterator[str]:
    """Copy every file that the database's manifest lists, where the full edition is wanted.

    Raises
    ------
    PublishRefused
        Where files are missing or are not what the manifest says: all of them, at most ten.
    """
    if publication.editions == "medium":
        return
    problems = []
    for name, listed in publication.manifest.files.items():
        yield name
        try:
            found = publication.copy_file(publication.source / name, name)
        except (FileNotFoundError, IsADirectoryError, NotADirectoryError):
            problems.append(not_whole(publication.source / name, "it is missing"))
            continue
        if found != listed.sha256:
            problems.append(not_whole(publication.source / name, "it is not what was built"))
    if problems:
        raise PublishRefused(*problems[:10])


def not_whole(path: Path, why: str) -> Problem:
    """Return the problem of a file that cannot be published."""
    return Problem(
        "E_DAMAGED",
        f"{path.name} cannot be published: {why}",
        file=str(path),
        fix="levkas validate names all that is damaged; build the database again.",
    )
