"""ro-crate-preview.html: the RO-Crate of a publication as a page for people.

The page needs no other file and no other host, and holds a copy of the record, as RO-Crate 1.3 has it.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from typing import TYPE_CHECKING, Any
from urllib.parse import unquote

from levkas import __version__
from levkas.core.text import counted
from levkas.pages.page import render_page
from levkas.publish.crate import NAME as RECORD
from levkas.publish.crate import PREVIEW
from levkas.publish.readme import pages_beside
from levkas.publish.viewer.pages import embed_json, format_bytes

if TYPE_CHECKING:
    from levkas.publish.publication import Publication

    Entities = Mapping[str, Mapping[str, Any]]

FACTS = {
    "author": "By",
    "publisher": "Publisher",
    "datePublished": "Published",
    "dateCreated": "Made",
    "version": "Version",
    "identifier": "Identifier",
    "license": "Licence",
    "keywords": "Keywords",
    "contactPoint": "Contact",
    "citation": "See also",
    "url": "Address",
}
"""Properties of the root that the page shows, and what it calls them."""


def write_preview(publication: Publication) -> Iterator[str]:
    """Write ro-crate-preview.html from ro-crate-metadata.json."""
    yield PREVIEW
    record = json.loads((publication.folder / RECORD).read_text(encoding="utf-8"))
    links = [link for link in pages_beside(publication.folder) if link[1] != PREVIEW]
    publication.write_text(PREVIEW, render_preview(record, links))


def render_preview(record: Mapping[str, Any], links: list[tuple[str, str]]) -> str:
    """Return the page of a metadata document; `links` are (words, address) of pages beside it."""
    from markupsafe import Markup

    entities: Entities = {entity["@id"]: entity for entity in record["@graph"]}
    root = entities["./"]
    count = sum("File" in _listed(e["@type"]) for e in entities.values())
    page = {
        "title": root["name"],
        "description": root["description"],
        "links": links,
        "facts": [
            (words, [_reference(entities, value) for value in _listed(root[key])])
            for key, words in FACTS.items()
            if root.get(key)
        ],
        "count": f"{counted(count, 'file')}, and folders of many small ones as a whole",
        "files": _parts(entities, root),
        "steps": _steps(entities, root),
        "record": Markup(embed_json(record)),
        "version": __version__,
    }
    return render_page("crate.html", page=page)


def _parts(entities: Entities, folder: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Files and folders of a folder, folders first."""
    found = [entities[part["@id"]] for part in _listed(folder.get("hasPart", []))]
    return [_part(entities, one) for one in sorted(found, key=lambda e: "File" in e["@type"])]


def _part(entities: Entities, entity: Mapping[str, Any]) -> dict[str, Any]:
    identifier, inner = entity["@id"], entity.get("hasPart")
    name = unquote(identifier.rstrip("/")).rpartition("/")[2]
    if "File" not in entity["@type"]:
        about = "" if inner else entity.get("name", "")
        return {"name": f"{name}/", "about": about, "parts": _parts(entities, entity)}
    size = format_bytes(int(entity["contentSize"]))
    return {"name": name, "href": identifier, "about": _joined(size, entity.get("description"))}


def _steps(entities: Entities, root: Mapping[str, Any]) -> list[tuple[str, list[dict[str, Any]]]]:
    """Steps of the making, by what they made: an object, or a part of the publication."""
    found: dict[str, list[dict[str, Any]]] = {}
    for mention in _listed(root.get("mentions", [])):
        action = entities[mention["@id"]]
        name, _, rest = action["name"].partition(", ")
        objects = [entities.get(o["@id"], {}) for o in _listed(action.get("object", []))]
        kinds = [one.get("@type") for one in objects]
        found.setdefault(name if rest else "The publication", []).append(
            {
                "name": rest or name,
                "about": action.get("description", ""),
                "program": _program(entities, action),
                "inputs": len(kinds) - kinds.count("PropertyValue"),
                "parameters": kinds.count("PropertyValue"),
                "results": [
                    {"name": unquote(r["@id"].rstrip("/")).rpartition("/")[2], "href": _file(r)}
                    for r in _listed(action.get("result", []))
                ],
            }
        )
    return list(found.items())


def _file(reference: Mapping[str, Any]) -> str:
    """Address of a file; a folder has none, for servers do not list them."""
    identifier: str = reference["@id"]
    return "" if identifier.endswith("/") else identifier


def _program(entities: Entities, action: Mapping[str, Any]) -> str:
    program = entities.get(action.get("instrument", {}).get("@id", ""), {})
    return _joined(program.get("name"), program.get("version"), by=" ")


def _reference(entities: Entities, value: Any) -> dict[str, Any]:
    """Words and address of a value: of an entity its name, and where it is known on the web."""
    if not isinstance(value, Mapping):
        text = str(value)
        return {"name": text, "href": _web(text), "away": True}
    entity = entities.get(value["@id"], {})
    words = entity.get("name") or entity.get("email") or value["@id"]
    home = entities.get(entity.get("affiliation", {}).get("@id", ""), {})
    return {"name": _joined(words, home.get("name")), "href": _web(value["@id"]), "away": True}


def _web(address: str) -> str:
    return address if address.startswith(("https://", "http://")) else ""


def _joined(*parts: str | None, by: str = ", ") -> str:
    return by.join(part for part in parts if part)


def _listed(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]
