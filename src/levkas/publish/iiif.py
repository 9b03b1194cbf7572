"""IIIF: tiles of every layer, a Presentation 3 manifest an object, a collection of all.

An object is one canvas, its layers a Choice painted on it, the reference camera's first. Viewers want
whole addresses: they are below the publication's, or below `LOCAL` where none was given.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.json_safe import to_json
from levkas.core.problems import Problem
from levkas.core.text import parse_json
from levkas.publish.publication import PublishRefused, describe_dataset
from levkas.publish.tiles import address, cut_tiles, thumbnail_size

if TYPE_CHECKING:
    from levkas.database.catalogue import Entry
    from levkas.publish.publication import Publication

FOLDER = "iiif"
LOCAL = "http://localhost:8000/"
"""Where ``python -m http.server`` in the publication's folder gives it."""
LANGUAGE = "en"
CONTEXT = "http://iiif.io/api/presentation/3/context.json"


def write_iiif(publication: Publication) -> Iterator[str]:
    """Write iiif/: OBJECT/LAYER/ tiles, OBJECT/manifest.json, collection.json; and check them.

    Raises
    ------
    PublishRefused
        Where a rule of IIIF is not kept.
    """
    if not publication.iiif:
        return
    base = publication.url or LOCAL
    manifests = []
    for name in dict.fromkeys(entry.object for entry in publication.entries()):
        layers = _layers(publication, name)
        shown = []
        for entry in layers:
            layer = entry.layer.name
            yield f"{name}/{layer}"
            picture, rendering = _picture(publication, entry)
            service = address(base, FOLDER, name, layer)
            for file, data in cut_tiles(picture, service):
                publication.write_bytes(f"{FOLDER}/{name}/{layer}/{file}", data)
            shown.append(_image(entry, service, picture.shape[:2], rendering))
        manifest = describe_object(publication, base, name, layers, shown)
        publication.write_text(f"{FOLDER}/{name}/manifest.json", to_json(manifest))
        manifests.append(manifest)
    yield "collection"
    collection = describe_collection(publication, base, manifests)
    publication.write_text(f"{FOLDER}/collection.json", to_json(collection))


def describe_object(
    publication: Publication,
    base: str,
    name: str,
    layers: list[Entry],
    shown: list[dict[str, Any]],
) -> dict[str, Any]:
    """Return the manifest of an object, as `iiif_prezi3` spells it."""
    from iiif_prezi3 import Manifest

    facts = publication.facts.objects.get(name, {})
    here = address(base, FOLDER, name)
    width, height = layers[0].width, layers[0].height
    body = shown[0] if len(shown) == 1 else {"type": "Choice", "items": shown}
    canvas = {
        "id": f"{here}/canvas",
        "type": "Canvas",
        "label": {"none": [name]},
        "width": width,
        "height": height,
        "items": [
            {
                "id": f"{here}/canvas/page",
                "type": "AnnotationPage",
                "items": [
                    {
                        "id": f"{here}/canvas/page/painting",
                        "type": "Annotation",
                        "motivation": "painting",
                        "body": body,
                        "target": f"{here}/canvas",
                    }
                ],
            }
        ],
    }
    record = {
        "id": f"{here}/manifest.json",
        "type": "Manifest",
        "label": {"none": [facts.get("title") or name]},
        "metadata": _metadata(facts, layers),
        "thumbnail": [_thumbnail(shown[0])],
        "items": [canvas],
        **_rights(publication),
    }
    return _spelled(Manifest, record)


def describe_collection(
    publication: Publication, base: str, manifests: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return the collection of all objects."""
    from iiif_prezi3 import Collection

    record = {
        "id": address(base, FOLDER, "collection.json"),
        "type": "Collection",
        "label": {"none": [publication.facts.title]},
        "summary": {LANGUAGE: [never_html(describe_dataset(publication))]},
        "items": [
            {"id": m["id"], "type": "Manifest", "label": m["label"], "thumbnail": m["thumbnail"]}
            for m in manifests
        ],
        **_rights(publication),
    }
    return _spelled(Collection, record)


def never_html(text: str) -> str:
    """Return text that no viewer takes for HTML: that begins with ``<`` and ends with ``>``.

    >>> never_html("<b>x</b>")
    ' <b>x</b>'
    """
    return f" {text}" if text.startswith("<") else text


def _spelled(kind: Any, record: dict[str, Any]) -> dict[str, Any]:
    """Let the library take the record, refuse what is not IIIF, and spell it."""
    from pydantic import ValidationError

    try:
        made: dict[str, Any] = parse_json(kind(**record).json())
    except ValidationError as error:
        first = error.errors()[0]
        field = ".".join(map(str, first["loc"]))
        raise PublishRefused(
            Problem("E_IIIF", f"IIIF takes no such value: {first['msg']}", None, field)
        ) from error
    made.pop("@context", None)
    return {"@context": CONTEXT, **made}


def _layers(publication: Publication, name: str) -> list[Entry]:
    """Layers of an object, the reference camera's first."""
    reference = publication.facts.reference.partition(":")[0]
    mine = [e for e in publication.entries() if e.object == name]
    return sorted(mine, key=lambda e: (e.camera != reference or bool(e.setup), e.camera, e.setup))


def _picture(publication: Publication, entry: Entry) -> tuple[np.ndarray, str]:
    """The layer's picture, and what it shows."""
    from levkas.database.reader import describe_pages
    from levkas.database.tiff_pages import open_pages

    pages = open_pages(publication.root / f"{entry.layer.path}.tif")
    picture = pages.read_render()
    if picture is None:
        picture = np.zeros((entry.height, entry.width, 3), np.uint8)
    return picture, str(describe_pages(pages).facts.get("rendering", ""))


def _image(entry: Entry, service: str, shape: tuple[int, ...], rendering: str) -> dict[str, Any]:
    label = f"{entry.layer.name}: {entry.bands} bands"
    return {
        "id": f"{service}/full/max/0/default.jpg",
        "type": "Image",
        "format": "image/jpeg",
        "width": shape[1],
        "height": shape[0],
        "label": {LANGUAGE: [f"{label}, {rendering}" if rendering else label]},
        "service": [{"id": service, "type": "ImageService3", "profile": "level0"}],
    }


def _thumbnail(image: dict[str, Any]) -> dict[str, Any]:
    width, height = thumbnail_size(image["width"], image["height"])
    service = image["service"][0]["id"]
    return {
        "id": f"{service}/full/{width},{height}/0/default.jpg",
        "type": "Image",
        "format": "image/jpeg",
        "width": width,
        "height": height,
    }


def _metadata(facts: dict[str, Any], layers: list[Entry]) -> list[dict[str, Any]]:
    told = {
        "By": facts.get("creator"),
        "Date": facts.get("date"),
        "Medium": facts.get("medium"),
        "Size": " x ".join(f"{s:g}" for s in facts.get("size_mm", ())) + " mm",
        "Owner": facts.get("owner"),
        "Inventory number": facts.get("inventory"),
        "Layers": ", ".join(e.layer.name for e in layers),
    }
    if not facts.get("size_mm"):
        told.pop("Size")
    return [
        {"label": {LANGUAGE: [label]}, "value": {"none": [never_html(str(value))]}}
        for label, value in told.items()
        if value
    ]


def _rights(publication: Publication) -> dict[str, Any]:
    """The licence: Creative Commons' by its address, which IIIF wants without its s."""
    licence = publication.facts.licence
    if licence is None:
        return {}
    if licence.spdx:
        return {"rights": licence.url.replace("https://", "http://")}
    told = {"label": {LANGUAGE: ["Licence"]}, "value": {"none": [never_html(licence.name)]}}
    return {"requiredStatement": told}
