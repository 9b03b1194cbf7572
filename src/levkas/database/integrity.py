"""Whether one file is whole, by its own bytes: every strip, chunk, checksum and line of it."""

from __future__ import annotations

import csv
import logging
import struct
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.campaign.schema.toml import read_toml
from levkas.core.problems import Problem, Refused
from levkas.core.text import parse_bounded, parse_json
from levkas.database.lazy_array import read_description
from levkas.database.tiff_pages import DAMAGE, FIRST_PRIVATE, opening_tiff
from levkas.readers.facts import check_expansion, check_memory

PNG = b"\x89PNG\r\n\x1a\n"
FIX = "Copy it again, or build the database again."
CRATE = "ro-crate-metadata.json"
"""Lists all files of a publication, and so has no bound of its own."""
LARGEST_TEXT = 256 << 20
"""Bytes of a text."""
MOST_GAPS = 10_000
"""Missing chunks that are named one by one."""
TEXTS = frozenset([".txt", ".md", ".html", ".htm", ".xml", ".svg", ".cff", ".css", ".js"])

# What tifffile logs about a damaged file is told as a problem; its lines on stderr help nobody.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


@dataclass(frozen=True)
class TiffFacts:
    """What a TIFF turned out to hold; `tags` are the private ones, of the first page that has them."""

    shape: tuple[int, int]
    bands: int
    dtype: str
    software: str = ""
    tags: dict[int, Any] = field(default_factory=dict)


def check_file(path: Path) -> list[Problem]:
    """Check any file but a TIFF or a Zarr chunk, by what its name says it is; [] where it is whole."""
    kind = path.suffix.lower()
    try:
        if kind == ".png":
            return [*_check_png(path)]
        if kind in (".jpg", ".jpeg"):
            return [*_check_jpeg(path)]
        if kind in (".json", ".toml", ".csv") or kind in TEXTS:
            return [*_check_text(path, kind)]
        _read_through(path)
    except OSError as error:
        return [damaged(path, f"it cannot be read: {error.strerror or error}")]
    return []


def damaged(path: Path, why: str, *, code: str = "E_DAMAGED", **more: Any) -> Problem:
    """Return the problem of a damaged file."""
    return Problem(code, f"{path.name}: {why}", file=str(path), fix=FIX, **more)


# --- TIFF -------------------------------------------------------------------------------------


def check_tiff(path: Path) -> tuple[TiffFacts | None, list[Problem]]:
    """Decode every strip and tile of every page.

    Returns
    -------
    facts : TiffFacts or None
        None where a directory or a strip is missing or cut off.
    problems : list of Problem
    """
    try:
        with opening_tiff(path) as pages:
            itemsize = np.dtype(pages[0].dtype).itemsize
            check_expansion(path, sum(p.size for p in pages), itemsize, path.stat().st_size)
            facts = _facts(pages)
            for index, page in enumerate(pages):
                try:
                    if any(decoded is None for decoded, _, _ in page.segments(maxworkers=2)):
                        raise ValueError("it lacks a strip")
                except DAMAGE as error:
                    return facts, [damaged(path, f"page {index}: {_reason(error)}")]
            return facts, []
    except Refused as refused:
        return None, list(refused.problems)


def _facts(pages: list[Any]) -> TiffFacts:
    bands = pages[1:] if len(pages) > 1 and pages[0].ndim == 3 else pages
    tags: dict[int, Any] = {}
    for page in bands:
        for tag in page.tags:
            if tag.code >= FIRST_PRIVATE:
                tags.setdefault(tag.code, tag.value)
    software = pages[0].tags.get("Software")
    height, width = (int(n) for n in bands[0].shape[:2])
    text = str(software.value) if software else ""
    return TiffFacts((height, width), len(bands), str(bands[0].dtype), text, tags)


# --- pictures and texts -----------------------------------------------------------------------


def _check_png(path: Path) -> Iterator[Problem]:
    data = path.read_bytes()
    if not data.startswith(PNG):
        yield damaged(path, "it does not begin like a PNG")
        return
    at, name = len(PNG), b""
    while at + 12 <= len(data) and name != b"IEND":
        length, name = struct.unpack(">I4s", data[at : at + 8])
        stored = data[at + 8 + length : at + 12 + length]
        if len(stored) < 4:
            break
        if zlib.crc32(data[at + 4 : at + 8 + length]) != int.from_bytes(stored, "big"):
            yield damaged(path, "a checksum is wrong", field=name.decode("ascii", "replace"))
            return
        at += 12 + length
    if name != b"IEND" or at > len(data):
        yield damaged(path, "it is truncated", code="E_TRUNCATED", found=f"{len(data)} bytes")
    elif at < len(data):
        yield damaged(
            path, "it has extra bytes after its end", code="E_SIZE", found=len(data), expected=at
        )


def _check_jpeg(path: Path) -> Iterator[Problem]:
    data = path.read_bytes()
    if not data.startswith(b"\xff\xd8"):
        yield damaged(path, "it does not begin like a JPEG")
    elif not data.rstrip(b"\0\r\n ").endswith(b"\xff\xd9"):
        yield damaged(path, "it is truncated", code="E_TRUNCATED", found=f"{len(data)} bytes")


def _check_text(path: Path, kind: str) -> Iterator[Problem]:
    if (size := path.stat().st_size) > LARGEST_TEXT:
        yield damaged(path, "it is far too large", code="E_SIZE", found=f"{size >> 20} MiB")
        return
    data = path.read_bytes()
    if not data.strip():
        yield damaged(path, "it is empty", code="E_TRUNCATED", found=f"{len(data)} bytes")
        return
    if (zero := data.find(b"\0")) >= 0:
        yield damaged(path, "it holds a zero byte", field=f"byte {zero}")
        return
    try:
        text = data.decode("utf-8-sig")
        if kind == ".json":
            (parse_json if path.name == CRATE else parse_bounded)(text)
        elif kind == ".toml":
            read_toml(path)
        elif kind == ".csv":
            yield from _check_table(path, text)
        elif kind in (".html", ".htm") and not text.rstrip().lower().endswith("</html>"):
            yield damaged(
                path, "it is truncated", code="E_TRUNCATED", expected="</html> at the end"
            )
    except (ValueError, RecursionError, Refused) as error:
        yield damaged(path, _reason(error))


def _check_table(path: Path, text: str) -> Iterator[Problem]:
    try:
        lines = csv.reader(text.splitlines(), strict=True)
        rows = enumerate((len(row) for row in lines if row), 1)
        _, first = next(rows, (0, 0))
        ragged = next(((i, count) for i, count in rows if count != first), None)
    except csv.Error as error:
        yield damaged(path, str(error))
        return
    if ragged:
        yield damaged(
            path,
            "a row differs from the first in its number of cells",
            field=f"row {ragged[0]}",
            found=f"{ragged[1]} cells",
            expected=f"{first} cells",
        )


def _read_through(path: Path) -> None:
    block = bytearray(1 << 20)
    with path.open("rb", buffering=0) as handle:
        while handle.readinto(block):
            pass


# --- Zarr -------------------------------------------------------------------------------------


def check_array(path: Path, names: Iterable[str]) -> list[Problem]:
    """Check one Zarr array: its description, that every shard or chunk is there and decodes, no more.

    `names` are its files, relative with ``/``.

    A chunk that is not there reads as the fill value, so it is a problem unless the array is said
    to leave empty ones out, which no store of Levkas does.
    """
    import zarr

    problems: list[Problem] = []
    names = sorted(names)
    try:
        if (path / "zarr.json").exists():
            read_description(path)
        array = zarr.open_array(str(path), mode="r")
        steps = array.shards or array.chunks
        grid = [range(-(-size // step)) for size, step in zip(array.shape, steps, strict=True)]
        if (count := prod(len(side) for side in grid)) > MOST_GAPS + 2 * len(names):
            told = {"found": f"{len(names)} files", "expected": f"{count} chunks"}
            return [damaged(_description(path), "nearly all of its chunks are missing", **told)]
        check_memory(path, prod(steps), array.dtype.itemsize)
        keys = {array.metadata.encode_chunk_key(place): place for place in product(*grid)}
    except (*DAMAGE, Refused) as error:
        return [damaged(_description(path), _reason(error))]
    for key, place in keys.items():
        part = path / key
        if not part.is_file():
            problems.append(damaged(part, "it is missing", code="E_MISSING"))
            continue
        region = tuple(slice(i * s, (i + 1) * s) for i, s in zip(place, steps, strict=True))
        try:
            array[region]
        except DAMAGE as error:
            problems.append(damaged(part, _reason(error)))
    known = {*keys, "zarr.json", ".zarray", ".zattrs"}
    for name in names:
        if name not in known:
            problems.append(
                Problem(
                    "E_EXTRA", "the array has no such chunk", str(path / name), fix="Take it away."
                )
            )
    return problems


def _description(path: Path) -> Path:
    return path / ("zarr.json" if (path / "zarr.json").exists() else ".zarray")


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__
