"""The viewer of a published folder, written object by object."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from importlib.resources import files as resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.pages.screen import ScreenMissing, read_built
from levkas.publish.viewer.objects import (
    UP,
    card_of,
    find_items,
    object_record,
    write_object,
    write_thumbnail,
)
from levkas.publish.viewer.pages import About, about_of, address, render_object, render_sheet

if TYPE_CHECKING:
    from levkas.publish.publication import Publication
    from levkas.publish.viewer.objects import Item
    from levkas.publish.viewer.pyramid import Write


HIDDEN_LINK = b'<a hidden href="../../viewer/'
"""Begins the report's link to the viewer: before a database is published there is none."""
SCRIPTS = ("sheet.js", "sheet.css", "viewer.js", "viewer.css")


def write_part(publication: Publication) -> Iterator[str]:
    """Write the viewer of a publication, as a part of it (`levkas.publish.run`).

    Where this installation carries no built pages the publication has none, with a note.
    """
    try:
        read_built(SCRIPTS[0])
    except ScreenMissing as missing:
        yield f"left out: {missing.problems[0]}"
        return

    def write(name: str, data: bytes) -> None:
        publication.write_bytes(name, data)

    about = about_of(publication.facts)
    beside = _beside(publication)
    yield from write_viewer(publication.folder, write, about, beside=beside)
    _link_reports(publication)


def _link_reports(publication: Publication) -> None:
    """Show the link to the viewer, which reports have in them, now that it leads somewhere."""
    for path in sorted(publication.folder.glob("objects/*/report.html")):
        page = path.read_bytes()
        if HIDDEN_LINK in page:
            name = path.relative_to(publication.folder).as_posix()
            shown = HIDDEN_LINK.replace(b" hidden", b"")
            publication.write_bytes(name, page.replace(HIDDEN_LINK, shown, 1))


def _beside(publication: Publication) -> list[tuple[str, str]]:
    """What the folder holds for other programs; some of it is written after the viewer."""
    found = [("IIIF manifest", "iiif/{object}/manifest.json")] if publication.iiif else []
    return [
        *found,
        ("Read me: what is in the folder", "README.html"),
        ("RO-Crate: how every file came about", "ro-crate-metadata.json"),
        ("DataCite metadata", "datacite.json"),
        ("Catalogue", "catalogue.csv"),
        ("Hashes", "manifest-sha256.txt"),
    ]


def write_viewer(
    database: Path,
    write: Write,
    about: About,
    *,
    beside: Sequence[tuple[str, str]] = (),
) -> Iterator[str]:
    """Write ``index.html`` and ``viewer/`` beside a database, reporting what is done.

    Parameters
    ----------
    database : Path
        Its files are read, and linked to from the pages as ``objects/…``.
    write : callable
        ``write(name, data)`` writes a file of the folder of the database.
    about : About
    beside : sequence of (words, name), optional
        Files of the folder that pages lead to; ``{object}`` in a name is the object's.

    Raises
    ------
    ScreenMissing
        Where this installation carries no built pages.
    TiffRefused
        Where a layer cannot be read.
    """
    built = {name: read_built(name) for name in SCRIPTS}
    for name, data in built.items():
        write(f"viewer/{name}", data)
    write("viewer/icon.svg", resources("levkas.publish.viewer").joinpath("icon.svg").read_bytes())
    items = find_items(database)
    cards = []
    for place, item in enumerate(items):
        layers = []
        for layer in write_object(write, item):
            yield f"{item.name}: {layer['name']}"
            layers.append(layer)
        links = {**_neighbours(items, place), "more": _links(beside, item)}
        record = object_record(item, layers, links)
        page = render_object(about, record)
        write(f"viewer/objects/{item.name}/index.html", page.encode("utf-8"))
        cards.append(card_of(item, layers, write_thumbnail(write, item)))
    yield "contact sheet"
    more = [
        {"label": words, "href": address(*name.split("/"))}
        for words, name in beside
        if "{object}" not in name
    ]
    write("index.html", render_sheet(about, cards, more).encode("utf-8"))


def _links(beside: Sequence[tuple[str, str]], item: Item) -> list[dict[str, str]]:
    """Links from an object's page to files of the folder."""
    parts = [(words, name.split("/")) for words, name in beside]
    return [
        {"label": words, "href": address(*UP, *(p.replace("{object}", item.name) for p in name))}
        for words, name in parts
    ]


def _neighbours(items: list[Item], place: int) -> dict[str, Any]:
    """Links to the objects before and after one."""
    beside = {"previous": place - 1, "next": place + 1}
    return {
        word: {"title": items[n].title, "href": address("..", items[n].name, "index.html")}
        if 0 <= n < len(items)
        else None
        for word, n in beside.items()
    }
