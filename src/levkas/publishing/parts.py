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
    from levkas.publishing.publication import Publication

    Part = Callable[[Publication], Iterator[str]]

PARTS = {
    "content": "levkas.publishing.content:write_content",
    "medium": "levkas.publishing.editions:write_medium",
    "colour": "levkas.publishing.colours:write_gamut",
    "iiif": "levkas.publishing.iiif:write_iiif",
    "splits": "levkas.publishing.splits:write_splits",
    "citation": "levkas.publishing.citation:write_citation",
    "datacite": "levkas.publishing.datacite:write_datacite",
    "viewer": "levkas.viewing.run:write_part",
    "readme": "levkas.publishing.readme:write_readme",
    "sealing": "levkas.publishing.editions:seal_medium",
    "crate": "levkas.publishing.crate:write_crate",
}
"""Name of a part → where its function is; imported when it is run."""


def load_part(name: str) -> Part:
    """Return the function of a part."""
    module, _, function = PARTS[name].partition(":")
    part: Part = getattr(import_module(module), function)
    return part
