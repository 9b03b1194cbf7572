"""The rules of IIIF Presentation 3 and Image 3 that a publication has to keep, checked on the disk."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import unquote

from levkas.core.problems import Problem
from levkas.core.text import read_json


def check_iiif(folder: str | Path, base: str) -> list[Problem]:
    """Check a folder of manifests and tiles.

    Parameters
    ----------
    folder : path
        ``iiif`` of a publication.
    base : str
        Address under which the folder will be found, without ``/`` at its end.

    Returns
    -------
    problems : list of Problem
        Of structure, of addresses that lead to no file, of tiles that are missing.
    """
    return [*_Check(Path(folder), base).run()]


class _Check:
    def __init__(self, folder: Path, base: str) -> None:
        self.folder, self.base = folder, base
        self.seen: set[str] = set()

    def run(self) -> Iterator[Problem]:
        collection = self._read(self.folder / "collection.json")
        yield from self._resource(collection, "Collection", "collection.json", self.base)
        listed = {item.get("id") for item in collection.get("items", ())}
        for path in sorted(self.folder.glob("*/manifest.json")):
            manifest, name = self._read(path), path.relative_to(self.folder).as_posix()
            yield from self._manifest(manifest, name)
            if manifest.get("id") not in listed:
                yield self._wrong(name, "id", "the collection does not list it")
        for address in sorted(a for a in listed if isinstance(a, str)):
            if not self._file(address).is_file():
                yield self._wrong("collection.json", "items", "it lists a file that is not there")
        for path in sorted(self.folder.glob("*/*/info.json")):
            yield from self._info(self._read(path), path)

    def _manifest(self, manifest: dict[str, Any], name: str) -> Iterator[Problem]:
        yield from self._resource(manifest, "Manifest", name, self.base)
        if not manifest.get("items"):
            yield self._wrong(name, "items", "a manifest needs a canvas")
        for canvas in manifest.get("items", ()):
            yield from self._resource(canvas, "Canvas", name, self.base)
            if not all(
                isinstance(canvas.get(k), int) and canvas[k] > 0 for k in ("width", "height")
            ):
                yield self._wrong(name, "width", "a canvas needs width and height above 0")
            for page in canvas.get("items", ()):
                yield from self._resource(page, "AnnotationPage", name, self.base)
                for annotation in page.get("items", ()):
                    yield from self._annotation(annotation, canvas, name)

    def _annotation(
        self, annotation: dict[str, Any], canvas: dict[str, Any], name: str
    ) -> Iterator[Problem]:
        yield from self._resource(annotation, "Annotation", name, self.base)
        if annotation.get("motivation") != "painting" or annotation.get("target") != canvas["id"]:
            yield self._wrong(name, "annotation", "it does not paint its canvas")
        body = annotation.get("body", {})
        images = body.get("items", ()) if body.get("type") == "Choice" else [body]
        if not images:
            yield self._wrong(name, "body", "a Choice of nothing")
        for image in images:
            address = str(image.get("id", ""))
            if image.get("type") != "Image" or not image.get("format"):
                yield self._wrong(name, "body", "what is painted is no Image with a format")
            if not address.startswith(self.base) or not self._file(address).is_file():
                yield self._wrong(name, "body.id", "the picture is not there", address)
            for service in image.get("service", ()):
                if not (self._file(service["id"]) / "info.json").is_file():
                    yield self._wrong(name, "service", "info.json is not there", service["id"])

    def _resource(
        self, record: dict[str, Any], kind: str, name: str, base: str
    ) -> Iterator[Problem]:
        """What all have: type, an address of its own below the base, and a label where it is wanted."""
        address = record.get("id")
        if record.get("type") != kind:
            yield self._wrong(name, "type", f"it is no {kind}", record.get("type"))
        if not isinstance(address, str) or not re.match(r"https?://[^\s<>]+$", address):
            yield self._wrong(name, "id", f"a {kind} needs an address", address)
            return
        if address in self.seen or not address.startswith(base):
            yield self._wrong(name, "id", "the address is another one's, or elsewhere", address)
        self.seen.add(address)
        label = record.get("label")
        if kind in ("Collection", "Manifest") and not (
            isinstance(label, dict) and label and all(isinstance(v, list) for v in label.values())
        ):
            yield self._wrong(name, "label", f"a {kind} needs a label by language")

    def _info(self, info: dict[str, Any], path: Path) -> Iterator[Problem]:
        name = path.relative_to(self.folder).as_posix()
        if self._file(str(info.get("id"))) != path.parent:
            yield self._wrong(name, "id", "the address is not that of the folder", info.get("id"))
        wanted = {"type": "ImageService3", "profile": "level0"}
        for key, value in wanted.items():
            if info.get(key) != value:
                yield self._wrong(name, key, f"it is not {value}", info.get(key))
        missing = [tile for tile in tile_names(info) if not (path.parent / tile).is_file()]
        if missing:
            yield self._wrong(name, "tiles", f"{len(missing)} tiles are not there", missing[0])
        for size in info.get("sizes", ()):
            file = f"full/{size['width']},{size['height']}/0/default.jpg"
            if not (path.parent / file).is_file():
                yield self._wrong(name, "sizes", "a size that is listed is not there", file)

    def _read(self, path: Path) -> dict[str, Any]:
        record = read_json(path)
        return record if isinstance(record, dict) else {}

    def _file(self, address: str) -> Path:
        return self.folder / unquote(address.removeprefix(self.base)).lstrip("/")

    def _wrong(self, name: str, field: str, why: str, found: Any = None) -> Problem:
        return Problem(
            "E_IIIF",
            f"{name} breaks a rule of IIIF: {why}",
            file=str(self.folder / name),
            field=field,
            found=found,
            fix="Publish again.",
        )


def tile_names(info: dict[str, Any]) -> Iterator[str]:
    """Yield every tile that a viewer may ask for, from info.json, as the specification lays them out."""
    width, height = info["width"], info["height"]
    for tiles in info["tiles"]:
        side, tall = tiles["width"], tiles.get("height", tiles["width"])
        for factor in tiles["scaleFactors"]:
            for y in range(0, height, tall * factor):
                for x in range(0, width, side * factor):
                    w, h = min(side * factor, width - x), min(tall * factor, height - y)
                    size = f"{-(-w // factor)},{-(-h // factor)}"
                    whole = (x, y, w, h) == (0, 0, width, height)
                    region = "full" if whole else f"{x},{y},{w},{h}"
                    yield f"{region}/{size}/0/default.jpg"
