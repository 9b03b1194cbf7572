"""IIIF: tiles of every layer (Image API 3.0, level 0), a Presentation 3 manifest an object, a collection.

An object is one canvas, its layers a Choice painted on it, the reference camera's first. Viewers need
whole addresses: they are below the publication's, or below `LOCAL` where none was given."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

import numpy as np

from levkas.colour.srgb import srgb_profile
from levkas.core.json_safe import to_json
from levkas.core.text import counted
from levkas.publish.citation import cite
from levkas.publish.publication import describe_dataset
from levkas.publish.viewer.pyramid import cut, encode_jpeg, fit_within, halve

if TYPE_CHECKING:
    from levkas.database.catalogue import Entry
    from levkas.publish.publication import Publication

FOLDER = "iiif"
LANGUAGE = "en"
CONTEXT = "http://iiif.io/api/presentation/3/context.json"


def write_iiif(publication: Publication) -> Iterator[str]:
    """Write iiif/: OBJECT/LAYER/ tiles, OBJECT/manifest.json, collection.json."""
    if not publication.iiif:
        return
    base = publication.base
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
        manifest = describe_object(publication, name, layers, shown)
        publication.write_text(f"{FOLDER}/{name}/manifest.json", to_json(manifest))
        manifests.append(manifest)
    yield "collection"
    collection = describe_collection(publication, base, manifests)
    publication.write_text(f"{FOLDER}/collection.json", to_json(collection))


def describe_object(
    publication: Publication,
    name: str,
    layers: list[Entry],
    shown: list[dict[str, Any]],
) -> dict[str, Any]:
    """Return the manifest of an object."""
    facts, base = publication.facts.objects.get(name, {}), publication.base
    here, title = address(base, FOLDER, name), facts.get("title") or name
    width, height = layers[0].width, layers[0].height
    body = shown[0] if len(shown) == 1 else {"type": "Choice", "items": shown}
    canvas = {
        "id": f"{here}/canvas",
        "type": "Canvas",
        "label": {"none": [title]},
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
    return {
        "@context": CONTEXT,
        "id": f"{here}/manifest.json",
        "type": "Manifest",
        "label": {"none": [title]},
        "metadata": _metadata(facts, layers),
        "thumbnail": [_thumbnail(shown[0])],
        "items": [canvas],
        **_page(address(base, "viewer", "objects", name, "index.html"), title),
        "seeAlso": _records(base),
        **_rights(publication),
    }


def describe_collection(
    publication: Publication, base: str, manifests: list[dict[str, Any]]
) -> dict[str, Any]:
    """Return the collection of all objects."""
    return {
        "@context": CONTEXT,
        "id": address(base, FOLDER, "collection.json"),
        "type": "Collection",
        "label": {"none": [publication.facts.title]},
        "summary": {LANGUAGE: [never_html(describe_dataset(publication))]},
        "items": [
            {"id": m["id"], "type": "Manifest", "label": m["label"], "thumbnail": m["thumbnail"]}
            for m in manifests
        ],
        **_page(address(base, "index.html"), publication.facts.title),
        "seeAlso": _records(base),
        **_rights(publication),
    }


def _page(place: str, words: str) -> dict[str, Any]:
    """Return a page of the viewer as the homepage, where this installation carries its pages."""
    from levkas.pages.screen import ScreenMissing, read_built

    try:
        read_built("viewer.js")
    except ScreenMissing:
        return {}
    page = {"id": place, "type": "Text", "label": {"none": [words]}, "format": "text/html"}
    return {"homepage": [page]}


def _records(base: str) -> list[dict[str, Any]]:
    """Return what programs read of the whole database."""
    crate = {
        "id": address(base, "ro-crate-metadata.json"),
        "type": "Dataset",
        "label": {LANGUAGE: ["RO-Crate: every file and how it came about"]},
        "format": "application/ld+json",
        "profile": "https://w3id.org/ro/crate/1.3",
    }
    catalogue = {
        "id": address(base, "catalogue.csv"),
        "type": "Dataset",
        "label": {LANGUAGE: ["Catalogue of all layers"]},
        "format": "text/csv",
    }
    return [catalogue, crate]


def never_html(text: str) -> str:
    """Return text that no viewer takes for HTML: that begins with ``<`` and ends with ``>``.

    >>> never_html("<b>x</b>")
    ' <b>x</b>'
    """
    return f" {text}" if text.startswith("<") else text


def _layers(publication: Publication, name: str) -> list[Entry]:
    """Layers of an object, the reference camera's first."""
    reference = publication.facts.reference.partition(":")[0]
    mine = [e for e in publication.entries() if e.object == name]
    return sorted(mine, key=lambda e: (e.camera != reference or bool(e.setup), e.camera, e.setup))


def _picture(publication: Publication, entry: Entry) -> tuple[np.ndarray, str]:
    """The layer's picture, and what it shows."""
    from levkas.database.described import describe_pages
    from levkas.database.tiff_pages import open_pages

    pages = open_pages(publication.folder / f"{entry.layer.path}.tif")
    picture = pages.read_render()
    if picture is None:
        picture = np.zeros((entry.height, entry.width, 3), np.uint8)
    return picture, str(describe_pages(pages).facts.get("rendering", ""))


def _image(entry: Entry, service: str, shape: tuple[int, ...], rendering: str) -> dict[str, Any]:
    label = f"{entry.layer.name}: {counted(entry.bands, 'band')}"
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
    pairs = {
        "By": facts.get("creator"),
        "Date": facts.get("date"),
        "Medium": facts.get("medium"),
        "Size": " x ".join(f"{s:g}" for s in facts.get("size_mm", ())) + " mm",
        "Owner": facts.get("owner"),
        "Inventory number": facts.get("inventory"),
        "Layers": ", ".join(e.layer.name for e in layers),
    }
    if not facts.get("size_mm"):
        pairs.pop("Size")
    return [
        {"label": {LANGUAGE: [label]}, "value": {"none": [never_html(str(value))]}}
        for label, value in pairs.items()
        if value
    ]


def _rights(publication: Publication) -> dict[str, Any]:
    """What a viewer has to show: whom to name, under which licence; Creative Commons' by its address, without its s."""
    facts = publication.facts
    licence = facts.licence
    if licence is None:
        return {}
    terms = f"{licence.name} <{licence.url}>" if licence.url else licence.name
    lines = [never_html(line) for line in (cite(facts), f"Licence: {terms}")]
    stated = {
        "requiredStatement": {
            "label": {LANGUAGE: ["Attribution and licence"]},
            "value": {"none": lines},
        }
    }
    rights = {"rights": licence.url.replace("https://", "http://")} if licence.spdx else {}
    return {**rights, **stated}


TILE = 512
QUALITY = 90
THUMBNAIL = 200
"""Px of the longer side."""
IMAGE_CONTEXT = "http://iiif.io/api/image/3/context.json"


def cut_tiles(picture: np.ndarray, identifier: str) -> Iterator[tuple[str, bytes]]:
    """Yield the files of an image service.

    Parameters
    ----------
    picture : ndarray, (height, width, 3), uint8
        sRGB.
    identifier : str
        Address of the service: where the folder with these files will be found.

    Yields
    ------
    name : str
        Relative path: ``info.json``, ``full/max/0/default.jpg``, ``0,0,512,512/512,512/0/default.jpg`` …
    data : bytes
        The same at any time and for any number of threads.
    """
    height, width = picture.shape[:2]
    files: dict[str, bytes] = {}
    factors, level = [1], picture
    while True:
        reach = TILE * factors[-1]
        for column, row, tile in cut(level, TILE, overlap=0):
            x, y = column * reach, row * reach
            wide, high = min(reach, width - x), min(reach, height - y)
            region = "full" if (wide, high) == (width, height) else f"{x},{y},{wide},{high}"
            size = f"{tile.shape[1]},{tile.shape[0]}"
            # Untagged: sRGB is what browsers take a tile for.
            files[f"{region}/{size}/0/default.jpg"] = encode_jpeg(tile, quality=QUALITY)
        if max(level.shape[:2]) <= TILE:
            break
        level = halve(level)
        factors.append(2 * factors[-1])
    small = fit_within(picture, THUMBNAIL)
    sizes = [(small.shape[1], small.shape[0]), (width, height)]
    for (w, h), image in zip(sizes, (small, picture), strict=True):
        whole = encode_jpeg(image, quality=QUALITY, profile=srgb_profile())
        files[f"full/{w},{h}/0/default.jpg"] = files["full/max/0/default.jpg"] = whole
    info = {
        "@context": IMAGE_CONTEXT,
        "id": identifier,
        "type": "ImageService3",
        "protocol": "http://iiif.io/api/image",
        "profile": "level0",
        "width": width,
        "height": height,
        "sizes": [{"width": w, "height": h} for w, h in dict.fromkeys(sizes)],
        "tiles": [{"scaleFactors": factors, "width": TILE}],
    }
    yield "info.json", (json.dumps(info, indent=1) + "\n").encode()
    yield from sorted(files.items())


def thumbnail_size(width: int, height: int) -> tuple[int, int]:
    """Return a size whose longer side is at most 200 px.

    >>> thumbnail_size(1392, 1040), thumbnail_size(90, 60)
    ((200, 149), (90, 60))
    """
    scale = min(1.0, THUMBNAIL / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


def address(base: str, *parts: str) -> str:
    """Return an address below `base`, every part encoded.

    >>> address("https://example.org/", "iiif", "icon 1")
    'https://example.org/iiif/icon%201'
    """
    return base + "/".join(quote(part, safe="@") for part in parts)
