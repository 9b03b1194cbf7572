"""The parts of a published folder, in the order in which they are written.

A part is a function ``write(publication)`` that yields a few words before each thing it does. It
writes below `Publication.folder` with `levkas.core.files`, reads the database that is published from
there too (the first part has copied it), and takes no time, path or name of this machine into what it
writes. A part that another one describes stands before it; ``crate`` describes all files and is last,
and behind it only the manifest is written.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from levkas.publish.publication import Publication

    Part = Callable[[Publication], Iterator[str]]

PARTS = {
    "content": "levkas.publish.content:write_content",
    "medium": "levkas.publish.editions:write_medium",
    "colour": "levkas.publish.colours:write_gamut",
    "iiif": "levkas.publish.iiif:write_iiif",
    "splits": "levkas.database.splits:write_splits",
    "citation": "levkas.publish.citation:write_citation",
    "datacite": "levkas.publish.datacite:write_datacite",
    "viewer": "levkas.viewer.run:write_part",
    "readme": "levkas.publish.readme:write_readme",
    "sealing": "levkas.publish.editions:seal_medium",
    "crate": "levkas.publish.crate:write_crate",
}
"""Name of a part → where its function is; imported when it is run."""


def load_part(name: str) -> Part:
    """Return the function of a part."""
    module, _, function = PARTS[name].partition(":")
    part: Part = getattr(import_module(module), function)
    return part
