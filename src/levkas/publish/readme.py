"""README.md of a published database, and README.html: what it is, how to cite it, how to read it."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.core.flags import MARKS
from levkas.database.catalogue import MEASURED
from levkas.database.registrations import describe_pairs, read_registration
from levkas.publish.citation import cite
from levkas.publish.publication import describe_dataset

if TYPE_CHECKING:
    from levkas.database.catalogue import Entry
    from levkas.publish.publication import Publication

NAME = "README.md"
PAGE = "README.html"
PARTS = {
    "catalogue.csv": "one row a layer: object, camera, setup, bands, size, sampling, quantity, verdict",
    "database.toml": "title, creators, licence, cameras and lightings",
    "splits.csv": "which objects to learn from, to choose with and to test on",
    "objects/": "one folder an object: spectral TIFFs with flags and sigma, previews, registration, report",
    "objects/OBJECT/analysis/": "pictures computed from layers, as float TIFFs; the JSON file beside each gives the "
    "method",
    "zarr/": "the same layers as Zarr v3, one store an object",
    "cameras/": "sensors, sensitivities, report of each camera",
    "setups/": "spectra of the light",
    "charts/": "calibrated colour charts",
    "declarations/": "what the campaign declared; put beside the raw frames, `levkas build` builds the database again",
    "colour/": "the CIELAB gamut of the database",
    "iiif/": "tiles and manifests for IIIF viewers",
    "viewer/": "open [index.html](index.html) in a browser: no server is needed",
    "ro-crate-metadata.json": "the same for programs, RO-Crate",
    "datacite.json": "DataCite metadata",
    "CITATION.cff": "how to cite",
    "manifest-sha256.txt": "SHA-256 of every file",
}


def write_readme(publication: Publication) -> Iterator[str]:
    """Write README.md and README.html."""
    yield NAME
    text = format_readme(publication)
    publication.write_text(NAME, text)
    publication.write_text(PAGE, render_readme(publication, text))


def render_readme(publication: Publication, text: str) -> str:
    """Return README.md as a page that needs no other file and no other host."""
    from markdown_it import MarkdownIt
    from markupsafe import Markup

    from levkas.pages.page import render_page

    # HTML in the text stays text; links lead to the web, to mail and to files, never to scripts.
    marked = MarkdownIt("js-default", {"html": False, "linkify": False})
    marked.add_render_rule("table_open", _open_table)
    marked.add_render_rule("table_close", lambda *_: "</tbody></table></div>\n")
    marked.add_render_rule("tbody_close", lambda *_: "")
    _, _, body = text.partition("\n\n")
    creators = "; ".join(person.name for person in publication.facts.creators)
    page = {
        "title": " ".join(publication.facts.title.split()),
        "subtitle": creators,
        "links": pages_beside(publication.folder),
        "body": Markup(marked.render(body)),
    }
    return render_page("readme.html", page=page)


def _open_table(*_: object) -> str:
    """A table that is wider than a phone is scrolled by itself, also with the keyboard."""
    return '<div class="scroll" role="group" tabindex="0" aria-label="Table"><table>\n'


def pages_beside(root: Path) -> list[tuple[str, str]]:
    """Return (words, address) of the pages and tables at the top of the folder."""
    known = {
        "Viewer": "index.html",
        "Read me": PAGE,
        "Catalogue": "catalogue.csv",
        "How to cite": "CITATION.cff",
    }
    later = (PAGE,)
    there = {name for name in known.values() if name in later or (root / name).is_file()}
    return [(words, name) for words, name in known.items() if name in there]


def format_readme(publication: Publication) -> str:
    """Return the text of README.md."""
    facts, entries, root = publication.facts, publication.entries(), publication.folder
    licence = facts.licence
    parts = [f"# {plain(facts.title)}", plain(describe_dataset(publication))]
    if licence:
        parts.append(
            f"Licence: {plain(licence.name)}" + (f", <{licence.url}>" if licence.url else "")
        )
    parts += ["Please cite:", f"> {plain(cite(facts))}"]
    parts += [f"See also <{address}>." for address in facts.related]
    if facts.contact:
        parts.append(f"Questions: {plain(facts.contact)}")
    parts += ["## Objects", _objects(publication), "## Layers", _layers(root, entries)]
    parts += ["## Files", _files(root), _reading(entries), _values(), _keeping()]
    return "\n\n".join(parts) + "\n"


def plain(text: str) -> str:
    """Spell text so that Markdown takes nothing in it for its own marks or for HTML.

    >>> plain("<b>*x*</b> | y")
    '&lt;b&gt;\\\\*x\\\\*&lt;/b&gt; \\\\| y'
    """
    text = re.sub(r"([\\`*_{}\[\]#|~])", r"\\\1", text)
    return text.replace("&", "&amp;").replace("<", "&lt;").replace(">", "&gt;")


def _objects(publication: Publication) -> str:
    rows = ["| object | title | by | date | medium | size, mm | owner |", "|---" * 7 + "|"]
    for name in dict.fromkeys(e.object for e in publication.entries()):
        facts = publication.facts.objects.get(name, {})
        size = " x ".join(f"{side:g}" for side in facts.get("size_mm", ()))
        cells = [facts.get(k, "") for k in ("title", "creator", "date", "medium")]
        cells += [size, facts.get("owner", "")]
        rows.append(
            "| " + " | ".join(plain(" ".join(str(c).split())) for c in [name, *cells]) + " |"
        )
    return "\n".join(rows)


def _layers(root: Path, entries: tuple[Entry, ...]) -> str:
    rows = ["| object | camera | setup | bands | width x height | px per mm | quantity | verdict |"]
    rows.append("|---" * 8 + "|")
    for e in entries:
        scale = "" if e.px_per_mm != e.px_per_mm else f"{e.px_per_mm:.3g}"
        cells = [e.object, e.camera, e.setup or "–", str(e.bands), f"{e.width} x {e.height}"]
        words = _by_hand(root, e)
        verdict = words if e.verdict == "by hand" else ", ".join(filter(None, (e.verdict, words)))
        rows.append("| " + " | ".join(map(plain, [*cells, scale, e.quantity, verdict])) + " |")
    return "\n".join(rows)


def _by_hand(root: Path, entry: Entry) -> str:
    path = root / "objects" / entry.object / "registration" / f"{entry.layer.name}.json"
    return describe_pairs(read_registration(path)) if path.is_file() else ""


def _files(root: Path) -> str:
    later = {"manifest-sha256.txt", "ro-crate-metadata.json"}
    if any(root.glob("objects/*/analysis")):
        later.add("objects/OBJECT/analysis/")
    here = [n for n in PARTS if (root / n).exists() or n in later]
    named = {name: f"`{name}`" if name.endswith("/") else f"[{name}]({name})" for name in here}
    return "\n".join(f"- {named[name]}: {PARTS[name]}" for name in here)


def _reading(entries: tuple[Entry, ...]) -> str:
    first = next((e for e in entries if e.kind == MEASURED), entries[0])
    row, column = first.height // 2, first.width // 2
    layer = first.layer.name
    key = f'"{first.camera}", "{first.setup}"' if first.setup else f'"{first.camera}"'
    return f"""## How to read it

In Python with Levkas, which brings flags, sigma and maps between the pixels of all cameras:

```python
import levkas

cube = levkas.open(".")["{first.object}"][{key}]  # xarray.DataArray (y, x, band)
spectrum, flags = cube[{row}, {column}], cube.levkas.flags[{row}, {column}]
```

Without it:

```python
import xarray

layer = xarray.open_zarr("zarr/{first.object}.zarr", group="{layer}")
```

Or with any program that reads TIFF: page 0 is a picture in sRGB, each further page one band in 32-bit
floats. Tag 65000 holds the centre wavelengths in nm (for broad channels the centroids of their
sensitivities, or 0, 1, 2 …), tag 65111 a JSON text with labels and widths."""


def _values() -> str:
    rows = "\n".join(f"| {int(flag)} | {mark.meaning} |" for flag, mark in sorted(MARKS.items()))
    return f"""## What the numbers mean

Reflectance: 1.0 is a perfect diffuser; gold and gloss exceed it. `.sigma.tif` holds one standard deviation
of each value's random part. `.flags.tif` holds a sum of bits for every pixel and band:

| bit | meaning |
|---|---|
{rows}

All layers of an object lie on one pixel grid; `objects/OBJECT/registration/` says how well, and
`report.html` shows it."""


def _keeping() -> str:
    return """## Is it whole?

`sha256sum -c manifest-sha256.txt` (`shasum -a 256 -c` on a Mac), or `levkas validate .`, which also
names what happened to a file."""
