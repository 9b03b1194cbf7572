"""Tile pyramids of pictures as static files, readable from file://.

Level n of a picture halves level n + 1; the highest is the picture itself, the lowest fits one tile.
A tile overlaps its neighbours by one pixel. It is a lossless WebP or a PNG, in base64 in a script file,
``LEVEL/COLUMN_ROW.js``: a page from file:// may show a picture file, but may not save what it has drawn with it.
"""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

TILE_PX = 510
OVERLAP_PX = 1
THUMBNAIL_QUALITY = 82
WEBP_EFFORT = 20
WEBP_METHODS = {2: 1, 3: 0}
"""By the dimensions of a picture: grey shrinks by a third more with method 1, colour hardly."""
PNG_LEVEL = 6

Write = Callable[[str, bytes], None]
"""Writes the bytes of a file by its name below the published folder."""


def write_pyramid(
    write: Write,
    folder: str,
    image: np.ndarray,
    *,
    key: str,
    palette: np.ndarray | None = None,
) -> dict[str, Any]:
    """Write a picture's tiles.

    Parameters
    ----------
    write : callable
        ``write(name, data)``.
    folder : str
        Where the levels stand, with ``/``.
    image : ndarray, (height, width) or (height, width, 3), uint8
    key : str
        Under which a tile announces itself, with ``/LEVEL/COLUMN_ROW``.
    palette : ndarray, (n, 3), uint8, optional
        Colours of the numbers in `image`: tiles are then PNGs with these colours, and a
        smaller level shows the largest number of four. Else tiles are lossless WebP.

    Returns
    -------
    record : dict
        width, height, tile, overlap, format, least and most level: what a page needs.
    """
    height, width = image.shape[:2]
    most = level = count_levels(width, height) - 1
    suffix = "webp" if palette is None else "png"
    while True:
        for column, row, tile in cut(image):
            data = encode_webp(tile) if palette is None else encode_indexed(tile, palette)
            tile_name = f"{level}/{column}_{row}"
            text = base64.b64encode(data).decode("ascii")
            call = f'levkasTile({json.dumps(f"{key}/{tile_name}")},"{text}");\n'
            write(f"{folder}/{tile_name}.js", call.encode("ascii"))
        if max(image.shape[:2]) <= TILE_PX:
            break
        image, level = halve(image, categories=palette is not None), level - 1
    return {
        **{"width": width, "height": height, "tile": TILE_PX, "overlap": OVERLAP_PX},
        **{"format": suffix, "least": level, "most": most},
    }


def count_levels(width: int, height: int) -> int:
    """Return how often a picture is halved to a single pixel, and the picture itself.

    >>> count_levels(1, 1), count_levels(640, 480)
    (1, 11)
    """
    return 1 + max(width - 1, height - 1).bit_length()


def cut(
    image: np.ndarray, side: int = TILE_PX, overlap: int = OVERLAP_PX
) -> Iterator[tuple[int, int, np.ndarray]]:
    """Yield (column, row, tile) of one level; a tile has its neighbours' nearest `overlap` pixels too."""
    height, width = image.shape[:2]
    for row in range(-(-height // side)):
        for column in range(-(-width // side)):
            top, left = row * side, column * side
            rows = slice(max(0, top - overlap), top + side + overlap)
            yield column, row, image[rows, max(0, left - overlap) : left + side + overlap]


def halve(image: np.ndarray, *, categories: bool = False) -> np.ndarray:
    """Return the picture at half its size, rounded up: the mean of four pixels, or their largest; of bytes the nearest byte.

    >>> halve(np.array([[0, 4, 9], [4, 8, 9]], np.uint8)).tolist()
    [[4, 9]]
    """
    height, width = image.shape[:2]
    edges = [(0, height % 2), (0, width % 2)] + [(0, 0)] * (image.ndim - 2)
    even = np.pad(image, edges, mode="edge")
    four = [even[y::2, x::2] for y in (0, 1) for x in (0, 1)]
    if categories:
        return np.maximum(np.maximum(four[0], four[1]), np.maximum(four[2], four[3]))
    if image.dtype.kind == "f":
        return np.asarray((four[0] + four[2] + four[1] + four[3]) / 4, image.dtype)
    total = np.sum(four, axis=0, dtype=np.uint16)
    return np.asarray((total + 2) // 4, np.uint8)


def fit_within(image: np.ndarray, longest: int) -> np.ndarray:
    """Return the picture with its longer side at most `longest` px, for thumbnails."""
    from PIL import Image

    height, width = image.shape[:2]
    if max(height, width) <= longest:
        return image
    scale = longest / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    return np.asarray(Image.fromarray(image).resize(size, Image.Resampling.LANCZOS))


def encode_webp(image: np.ndarray) -> bytes:
    """Encode (height, width) or (height, width, 3) uint8 without loss."""
    from PIL import Image

    target = io.BytesIO()
    picture = Image.fromarray(np.ascontiguousarray(image))
    method = WEBP_METHODS[image.ndim]
    picture.save(target, "WEBP", lossless=True, quality=WEBP_EFFORT, method=method)
    return target.getvalue()


def encode_jpeg(
    image: np.ndarray, *, quality: int = THUMBNAIL_QUALITY, profile: bytes | None = None
) -> bytes:
    """Encode (height, width) or (height, width, 3) uint8 as JPEG, colours as fine as lightness."""
    from PIL import Image

    target = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(image)).save(
        target, "JPEG", quality=quality, subsampling=0, optimize=False, icc_profile=profile
    )
    return target.getvalue()


def encode_indexed(image: np.ndarray, palette: np.ndarray) -> bytes:
    """Encode (height, width) uint8 as PNG whose colours are rows of `palette`."""
    from PIL import Image

    target = io.BytesIO()
    picture = Image.fromarray(np.ascontiguousarray(image), "P")
    picture.putpalette(np.ascontiguousarray(palette, np.uint8).tobytes())
    picture.save(target, "PNG", compress_level=PNG_LEVEL)
    return target.getvalue()
