"""declarations/: what a campaign declares, published, so that its database can be built again from the raw frames.

campaign.toml, edits.toml and every table that they name lie there under the campaign's own relative paths; they
are put beside the raw frames, and `levkas build` gives the database whose manifest is there too.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.campaign.edits import FILE_NAME as EDITS
from levkas.campaign.schema.toml import read_toml
from levkas.database.manifest import NAME as MANIFEST
from levkas.database.manifest import stays_inside

if TYPE_CHECKING:
    from levkas.publish.publication import Publication

FOLDER = "declarations"
CAMPAIGN = "campaign.toml"
BUILT = "database-sha256.txt"
"""Manifest of the database that was built from the declarations."""
TABLES = (
    *("sensitivity", "reflectance", "reference", "spectrum"),
    *("points", "positions", "manifest"),
)
"""Keys of campaign.toml whose text is the name of a file."""
PATTERNS = "files"
"""Key of the patterns that name raw frames."""


def write_declarations(publication: Publication) -> Iterator[str]:
    """Write campaign.toml, edits.toml and the tables that they name, where the campaign is known.

    campaign.toml is written anew: without its comments, which were not written for the public, and without
    `output`, which is whoever builds to choose. Where the campaign was not given, or names a file outside its folder,
    nothing is written, and `left_out` says so.
    """
    if publication.campaign is None:
        publication.left_out.append(
            f"{FOLDER}/: of a database alone it is not known what its campaign declared, from which it can be built "
            "again; publish the campaign's folder in place of the database's"
        )
        return
    import tomlkit

    root, record = publication.campaign.parent, read_toml(publication.campaign)
    record.get("campaign", {}).pop("output", None)
    if outside := [f"{key} = {text!r}" for key, text in _named(record) if not _is_inside(text)]:
        publication.left_out.append(
            f"{FOLDER}/: files outside the campaign's folder cannot be published ({outside[0]})"
        )
        return
    yield CAMPAIGN
    publication.write_text(f"{FOLDER}/{CAMPAIGN}", tomlkit.dumps(record))
    if (root / EDITS).is_file():
        publication.write_text(f"{FOLDER}/{EDITS}", tomlkit.dumps(read_toml(root / EDITS)))
    for name in find_tables(root, record):
        yield name
        publication.copy_file(root / name, f"{FOLDER}/{name}")
    publication.copy_file(publication.source / MANIFEST, f"{FOLDER}/{BUILT}")


def find_tables(root: Path, record: dict[str, Any]) -> tuple[str, ...]:
    """Return the files that a campaign.toml names beside its raw frames, relative with ``/``, sorted.

    Parameters
    ----------
    root : Path
        Folder of the campaign.
    record : dict
        Its campaign.toml. ``{object}``, ``{camera}`` and ``{setup}`` in a name stand for any text.
    """
    found: set[str] = set()
    for key, text in _named(record):
        if key != PATTERNS:
            pattern = re.sub(r"\{[^{}]*\}", "*", re.sub(r"([*?\[])", r"[\1]", text))
            paths = [path for path in root.glob(pattern) if path.is_file()]
            found.update(path.relative_to(root).as_posix() for path in paths)
    return tuple(sorted(found))


def _named(value: Any, key: str = "") -> Iterator[tuple[str, str]]:
    """Yield (key, text) of everything in a record that names files."""
    if isinstance(value, dict):
        for inner, entry in value.items():
            yield from _named(entry, inner)
    elif isinstance(value, list):
        for entry in value:
            yield from _named(entry, key)
    elif isinstance(value, str) and value and key in (*TABLES, PATTERNS):
        yield key, value


def _is_inside(name: str) -> bool:
    """Whether a name is relative, and stays in the folder of its campaign."""
    return stays_inside(name) and not re.match(r"[A-Za-z]:|[\\~]", name)
