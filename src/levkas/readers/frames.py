"""One frame of a capture, whatever file it stands in."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np

from levkas.readers.facts import Facts, UnreadableCapture, check_size, unreadable

__all__ = ["Facts", "UnreadableCapture", "read_facts", "read_frame"]

PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8\xff"
TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")


def kind_of(path: str | Path) -> str:
    """Return ``"tiff"``, ``"png"``, ``"jpeg"``, ``"raw"`` or ``"envi"`` from name and first bytes.

    Raises UnreadableCapture where there is no such file, or none of these.
    """
    from levkas.readers import envi, raw

    path = Path(path)
    if path.suffix.lower() == ".hdr":
        return "envi"
    try:
        with path.open("rb") as handle:
            head = handle.read(16)
    except OSError as error:
        raise unreadable(path, "the file cannot be opened", found=str(error)) from error
    if not head:
        raise unreadable(path, "the file is empty", code="E_TRUNCATED", found="0 bytes")
    if head.startswith(PNG):
        return "png"
    if head.startswith(JPEG):
        return "jpeg"
    if path.suffix.lower() in raw.SUFFIXES and not (
        path.suffix.lower() == ".raw" and envi.find_header(path)
    ):
        return "raw"
    if head[:4] in TIFF:
        return "tiff"
    if envi.find_header(path):
        return "envi"
    raise unreadable(
        path,
        "the file is of no known kind",
        found=f"first bytes {head[:8].hex(' ')}",
        expected="TIFF, PNG, JPEG, camera raw or ENVI with its header",
    )


def read_facts(path: str | Path) -> Facts:
    """Return what a capture's headers declare; no pixel is decoded.

    Raises
    ------
    UnreadableCapture
        With the file, what was found and what was expected.
    """
    path = Path(path)
    kind = kind_of(path)
    if kind == "tiff":
        from levkas.readers.tiff import read_tiff_facts

        return read_tiff_facts(path)
    if kind == "raw":
        from levkas.readers.raw import read_raw_facts

        return read_raw_facts(path)
    if kind == "envi":
        from levkas.readers.envi import open_envi

        return open_envi(path).facts
    if kind == "png":
        return _png_facts(path)
    return _jpeg_facts(path)


def read_frame(path: str | Path, *, page: int | None = None) -> np.ndarray:
    """Read one frame in its own dtype; EXIF orientation is ignored.

    Parameters
    ----------
    path : path
    page : int, optional
        Of a multi-page TIFF, from 0; the first by default.

    Returns
    -------
    values : ndarray, (h, w) or (h, w, samples)
        Colour samples in the order red, green, blue; for ENVI (lines, samples, bands).

    Raises
    ------
    UnreadableCapture
        Whatever is wrong with the file: what is missing never reads as zeros.
    """
    path = Path(path)
    kind = kind_of(path)
    if page not in (None, 0) and kind != "tiff":
        raise unreadable(path, f"only a TIFF has pages, this is {kind}", code="E_BAND_MISSING")
    if kind == "tiff":
        from levkas.readers.tiff import read_tiff_page

        return read_tiff_page(path, page)
    if kind == "raw":
        from levkas.readers.raw import read_raw_mosaic

        return read_raw_mosaic(path)
    if kind == "envi":
        from levkas.readers.envi import open_envi

        return open_envi(path).read()
    return _decode(path, _png_facts(path) if kind == "png" else _jpeg_facts(path))


def _decode(path: Path, facts: Facts) -> np.ndarray:
    """Decode PNG or JPEG, all its rows or an error."""
    import cv2

    _check_ending(path, facts.kind)
    data = np.frombuffer(path.read_bytes(), np.uint8)
    try:
        values = cv2.imdecode(data, cv2.IMREAD_UNCHANGED | cv2.IMREAD_IGNORE_ORIENTATION)
    except cv2.error as error:
        raise unreadable(
            path, f"the {facts.kind.upper()} cannot be decoded", found=str(error)
        ) from error
    if values is None or values.shape[:2] != facts.shape[:2]:
        raise unreadable(path, f"the {facts.kind.upper()} cannot be decoded", code="E_TRUNCATED")
    if values.ndim == 3:
        values = values[..., 2::-1]  # blue, green, red, perhaps alpha → red, green, blue
    return np.ascontiguousarray(values)


def _check_ending(path: Path, kind: str) -> None:
    """Refuse a file cut short: decoders fill the rest with gray and say nothing."""
    data_end = path.read_bytes()[-4096:].rstrip(b"\0\r\n ")
    complete = b"IEND" in data_end if kind == "png" else b"\xff\xd9" in data_end
    if not complete:
        raise unreadable(
            path,
            "the file ends before its image does",
            code="E_TRUNCATED",
            expected="IEND" if kind == "png" else "an end-of-image marker",
            fix="Copy the file again from the camera.",
        )


def _png_facts(path: Path) -> Facts:
    head = path.open("rb").read(64)
    if len(head) < 33 or head[12:16] != b"IHDR":
        raise unreadable(
            path, "the PNG has no header", code="E_TRUNCATED", found=f"{len(head)} bytes"
        )
    width, height, depth, colour = struct.unpack(">IIBB", head[16:26])
    samples = {0: 1, 2: 3, 3: 3, 4: 1, 6: 3}.get(colour)
    if samples is None or depth not in (1, 2, 4, 8, 16):
        raise unreadable(
            path, "the PNG header is damaged", field="IHDR", found=f"{depth} bits, type {colour}"
        )
    shape = (height, width) if samples == 1 else (height, width, samples)
    check_size(path, shape)
    return Facts(path, "png", shape, "uint16" if depth == 16 else "uint8", bits=max(depth, 8))


def _jpeg_facts(path: Path) -> Facts:
    from levkas.readers.raw import read_exif

    data = path.read_bytes()
    at = 2
    while at + 9 < len(data):
        if data[at] != 0xFF:
            break
        marker, length = data[at + 1], int.from_bytes(data[at + 2 : at + 4], "big")
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            height, width, samples = struct.unpack(">HHB", data[at + 5 : at + 10])
            shape = (height, width) if samples == 1 else (height, width, 3)
            check_size(path, shape)
            return Facts(path, "jpeg", shape, "uint8", bits=8, **read_exif(path))
        at += 2 + (length if not 0xD0 <= marker <= 0xD9 and marker != 0xFF else 0)
        at -= 1 if marker == 0xFF else 0
    raise unreadable(path, "the JPEG has no frame header", code="E_TRUNCATED")
