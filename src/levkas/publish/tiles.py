"""Image tiles for IIIF viewers (Image API 3.0, level 0)."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Iterator
from typing import Any
from urllib.parse import quote

import numpy as np

from levkas.colour.srgb import srgb_profile

TILE = 512
QUALITY = 90
THUMBNAIL = 200
"""Px of the longer side."""
CONTEXT = "http://iiif.io/api/image/3/context.json"


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
    import pyvips

    height, width, bands = picture.shape
    image = pyvips.Image.new_from_memory(
        np.ascontiguousarray(picture, np.uint8).data, width, height, bands, "uchar"
    ).copy(interpretation="srgb")
    image.set_type(pyvips.GValue.blob_type, "icc-profile-data", srgb_profile())
    suffix = f".jpg[Q={QUALITY}]"  # sRGB is what browsers take an untagged tile for
    packed = image.dzsave_buffer(
        basename="image", layout="iiif3", id="", suffix=suffix, container="zip", tile_size=TILE
    )
    names: dict[str, bytes] = {}
    with zipfile.ZipFile(io.BytesIO(packed)) as archive:
        for entry in archive.infolist():
            folder, _, name = entry.filename.partition("/")
            if name and folder == "image":  # beside it stands a file with the time
                names[name] = archive.read(entry)
    record = json.loads(names.pop("info.json"))
    sizes = [thumbnail_size(width, height), (width, height)]
    small = image.thumbnail_image(sizes[0][0], height=sizes[0][1], size="force")
    names[f"full/{sizes[0][0]},{sizes[0][1]}/0/default.jpg"] = _jpeg(small)
    whole = _jpeg(image)
    names["full/max/0/default.jpg"] = whole
    names[f"full/{width},{height}/0/default.jpg"] = whole
    yield "info.json", (json.dumps(_info(record, identifier, sizes), indent=1) + "\n").encode()
    yield from sorted(names.items())


def thumbnail_size(width: int, height: int) -> tuple[int, int]:
    """Return a size whose longer side is at most 200 px.

    >>> thumbnail_size(1392, 1040), thumbnail_size(90, 60)
    ((200, 149), (90, 60))
    """
    scale = min(1.0, THUMBNAIL / max(width, height))
    return max(1, round(width * scale)), max(1, round(height * scale))


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


def address(base: str, *parts: str) -> str:
    """Return an address below `base`, every part encoded.

    >>> address("https://example.org/", "iiif", "icon 1")
    'https://example.org/iiif/icon%201'
    """
    return base + "/".join(quote(part, safe="@") for part in parts)


def _info(record: dict[str, Any], identifier: str, sizes: list[tuple[int, int]]) -> dict[str, Any]:
    """What a viewer must know, in a fixed order; libvips tells the tiles that it made."""
    return {
        "@context": CONTEXT,
        "id": identifier,
        "type": "ImageService3",
        "protocol": "http://iiif.io/api/image",
        "profile": "level0",
        "width": record["width"],
        "height": record["height"],
        "sizes": [{"width": w, "height": h} for w, h in dict.fromkeys(sizes)],
        "tiles": record["tiles"],
    }


def _jpeg(image: Any) -> bytes:
    data: bytes = image.jpegsave_buffer(Q=QUALITY, keep="icc")
    return data
