"""A database without a manifest: every file decoded, and what several say of a layer compared.

Every strip, chunk, picture and text is read by the library that reads it elsewhere. The catalogue, the
TIFFs and the Zarr stores then have to agree on sizes, hashes and numbers.
"""

from __future__ import annotations

import csv
import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.campaign.schema.toml import read_toml
from levkas.core.digests import hash_file
from levkas.core.problems import Problem, Refused
from levkas.core.text import parse_bounded, parse_json, read_json
from levkas.database.catalogue import NAME, DatabaseRefused, Entry, read_catalogue
from levkas.database.layout import KINDS, SIGMA, LayerId
from levkas.database.lazy_array import read_description
from levkas.database.manifest import is_partial, unfinished
from levkas.database.spectral_tiff import METADATA, decode_text
from levkas.database.tiff_pages import DAMAGE, FIRST_PRIVATE, open_pages, opening_tiff
from levkas.readers.facts import check_expansion, check_memory

FIX = "Copy it again, or build the database again."
CRATE = "ro-crate-metadata.json"
"""Lists all files of a publication, and so has no bound of its own."""
LARGEST_TEXT = 256 << 20
"""Bytes of a text."""
MOST_GAPS = 10_000
"""Missing chunks that are named one by one."""
TEXTS = frozenset([".txt", ".md", ".html", ".htm", ".xml", ".svg", ".cff", ".css", ".js"])
PICTURES = frozenset([".png", ".jpg", ".jpeg"])
ROWS = 64
"""Rows of a layer that are compared at a time."""

# What tifffile logs about a damaged file is reported as a problem.
logging.getLogger("tifffile").addHandler(logging.NullHandler())


@dataclass(frozen=True)
class FileCheck:
    """One file that was decoded, or "" for what several say of one another.

    `ours` says that Levkas wrote the database, so that more can be expected of it.
    """

    name: str
    problems: tuple[Problem, ...] = ()
    ours: bool = False


@dataclass(frozen=True)
class TiffFacts:
    """What a TIFF turned out to hold; `record` is its tag 65111."""

    shape: tuple[int, int]
    bands: int
    dtype: str
    software: str
    record: Mapping[str, Any]


def check_structure(root: Path, names: frozenset[str]) -> Iterator[FileCheck]:
    """Yield every file as it is decoded, then where the files disagree.

    Parameters
    ----------
    root : Path
    names : frozenset of str
        Files below it, relative with ``/``.
    """
    arrays = _arrays(root, names)
    tiffs: dict[str, TiffFacts] = {}
    unsound: set[str] = set()
    for name in sorted(names - {f"{a}/{n}" for a, inside in arrays.items() for n in inside}):
        found = _decode(root, name, tiffs)
        unsound |= {name} if found else set()
        yield FileCheck(name, tuple(found))
    ours = any(facts.software.startswith("levkas") for facts in tiffs.values())
    yield FileCheck("", tuple(_undescribed(root, names, arrays) if ours else ()), ours)
    gaps: list[Problem] = []
    for array, inside in arrays.items():
        problems = check_array(root / array, inside)
        # Others may leave empty chunks out: what the TIFF beside has there decides.
        gaps += [p for p in problems if p.code == "E_MISSING" and not ours]
        problems = [p for p in problems if p not in gaps]
        unsound |= {array} if problems else set()
        for name in inside:
            path = str(root / array / name)
            yield FileCheck(f"{array}/{name}", tuple(p for p in problems if p.file == path))
        here = {str(root / array / name) for name in inside}
        yield FileCheck("", tuple(p for p in problems if p.file not in here))
    sound = {name: facts for name, facts in tiffs.items() if name not in unsound}
    differing = [*_check_catalogue(root, names, sound)]
    for group in sorted({a.rpartition("/")[0] for a in arrays}):
        differing += _check_group(root, names, sound, {*arrays} - unsound, group)
    named = {p.file for p in differing}
    differing += [p for p in gaps if p.file in named or not _has_tiff(p, root, names)]
    yield FileCheck("", tuple(differing))


def damaged(path: Path, why: str, *, code: str = "E_DAMAGED", **more: Any) -> Problem:
    """Return the problem of a damaged file."""
    return Problem(code, f"{path.name}: {why}", file=str(path), fix=FIX, **more)


# --- one file ---------------------------------------------------------------------------------


def _decode(root: Path, name: str, tiffs: dict[str, TiffFacts]) -> list[Problem]:
    path, kind = root / name, Path(name).suffix.lower()
    if is_partial(name):
        return [unfinished(path)]
    try:
        if kind in (".tif", ".tiff"):
            tiffs[name] = _decode_tiff(path)
        elif kind in PICTURES:
            _decode_picture(path)
        elif kind in (".json", ".toml", ".csv") or kind in TEXTS:
            _decode_text(path, kind)
        else:
            hash_file(path)
    except Refused as refused:
        return [p if p.file else damaged(path, p.message) for p in refused.problems]
    except (*DAMAGE, OSError, ValueError, RecursionError, csv.Error) as error:
        return [damaged(path, _reason(error))]
    return []


def _decode_tiff(path: Path) -> TiffFacts:
    """Decode every strip and tile of every page; raises Refused, or what tifffile raises."""
    with opening_tiff(path) as pages:
        itemsize = np.dtype(pages[0].dtype).itemsize
        check_expansion(path, sum(p.size for p in pages), itemsize, path.stat().st_size)
        for index, page in enumerate(pages):
            if any(decoded is None for decoded, _, _ in page.segments(maxworkers=2)):
                raise ValueError(f"page {index} lacks a strip")
        bands = pages[1:] if len(pages) > 1 and pages[0].ndim == 3 else pages
        tags = {t.code: t.value for p in bands[::-1] for t in p.tags if t.code >= FIRST_PRIVATE}
        software = pages[0].tags.get("Software")
        height, width = (int(n) for n in bands[0].shape[:2])
        text = str(software.value) if software else ""
        return TiffFacts((height, width), len(bands), str(bands[0].dtype), text, _record(tags))


def _record(tags: dict[int, Any]) -> dict[str, Any]:
    """Return what a TIFF says of itself in tag 65111; {} where it says nothing of the kind."""
    try:
        record = parse_bounded(decode_text(str(tags.get(METADATA, ""))))
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}


def _decode_picture(path: Path) -> None:
    from PIL import Image

    with Image.open(path, formats=("PNG", "JPEG")) as picture:
        check_expansion(path, prod(picture.size), 4, path.stat().st_size)
        picture.load()


def _decode_text(path: Path, kind: str) -> None:
    if (size := path.stat().st_size) > LARGEST_TEXT:
        raise ValueError(f"it is far too large: {size >> 20} MiB")
    data = path.read_bytes()
    if not data.strip() or b"\0" in data:
        raise ValueError("it is empty, or holds a zero byte")
    text = data.decode("utf-8-sig")
    if kind == ".json":
        (parse_json if path.name == CRATE else parse_bounded)(text)
    elif kind == ".toml":
        read_toml(path)
    elif kind == ".csv":
        _check_rows(text)
    elif kind in (".html", ".htm") and not text.rstrip().lower().endswith("</html>"):
        raise ValueError("it is truncated")


def _check_rows(text: str) -> None:
    """Refuse a table of which a row has other cells than the first."""
    rows = [row for row in csv.reader(text.splitlines()) if row]
    for number, row in enumerate(rows, 1):
        if len(row) != len(rows[0]):
            raise ValueError(f"row {number} has {len(row)} cells, the first {len(rows[0])}")


def _reason(error: BaseException) -> str:
    return " ".join(str(error).split())[:200] or type(error).__name__


# --- Zarr -------------------------------------------------------------------------------------


def _arrays(root: Path, names: frozenset[str]) -> dict[str, list[str]]:
    """Return the files of every Zarr array, by its folder, relative to it."""
    folders = {n.rpartition("/")[0] for n in names if n.endswith(("/.zarray", "/zarr.json"))}
    found: dict[str, list[str]] = {f: [] for f in sorted(folders) if _is_array(root / f)}
    for name in sorted(names):
        parts = name.split("/")
        above = ("/".join(parts[:i]) for i in range(len(parts) - 1, 0, -1))
        if (array := next((a for a in above if a in found), None)) is not None:
            found[array].append(name.removeprefix(f"{array}/"))
    return found


def _is_array(folder: Path) -> bool:
    """Whether a folder is a Zarr array; also one whose description is damaged."""
    if (folder / ".zarray").is_file():
        return True
    try:
        return bool(read_json(folder / "zarr.json").get("node_type") != "group")
    except Refused:
        return (folder / "c").is_dir()


def _undescribed(
    root: Path, names: frozenset[str], arrays: Mapping[str, Sequence[str]]
) -> Iterator[Problem]:
    """Yield the descriptions that a store of ours lacks, and the files that are in none of its arrays."""
    inside = {f"{a}/{name}" for a, files in arrays.items() for name in files}
    folders: set[str] = set()
    for name in sorted(n for n in names if ".zarr/" in n):
        parts = name.split("/")
        stop = parts.index("c") if "c" in parts else len(parts) - 1
        folders |= {"/".join(parts[: i + 1]) for i in range(1, stop)}
        if name not in inside and parts[-1] != "zarr.json" and "c" not in parts:
            yield Problem("E_EXTRA", "this file is not part of the store", str(root / name))
    for folder in sorted(folders):
        if f"{folder}/zarr.json" not in names:
            yield damaged(root / folder / "zarr.json", "it is missing", code="E_MISSING")


def check_array(path: Path, names: Sequence[str]) -> list[Problem]:
    """Check one Zarr array: its description, that every shard or chunk is there and decodes, no more.

    `names` are its files, relative with ``/``. A chunk that is not there reads as the fill value, so it is
    a problem unless the array is declared to leave empty ones out, which no store of Levkas does.
    """
    import zarr

    description = path / ("zarr.json" if (path / "zarr.json").exists() else ".zarray")
    try:
        if description.name == "zarr.json":
            read_description(path)
        array = zarr.open_array(str(path), mode="r")
        steps = array.shards or array.chunks
        grid = [range(-(-size // step)) for size, step in zip(array.shape, steps, strict=True)]
        if (count := prod(len(side) for side in grid)) > MOST_GAPS + 2 * len(names):
            found = {"found": f"{len(names)} files", "expected": f"{count} chunks"}
            return [damaged(description, "nearly all of its chunks are missing", **found)]
        check_memory(path, prod(steps), array.dtype.itemsize)
        keys = {array.metadata.encode_chunk_key(place): place for place in product(*grid)}
    except (*DAMAGE, Refused) as error:
        return [damaged(description, _reason(error))]
    problems: list[Problem] = []
    for key, place in keys.items():
        if not (path / key).is_file():
            problems.append(damaged(path / key, "it is missing", code="E_MISSING"))
            continue
        try:
            array[tuple(slice(i * s, (i + 1) * s) for i, s in zip(place, steps, strict=True))]
        except DAMAGE as error:
            problems.append(damaged(path / key, _reason(error)))
    for name in {*names} - {*keys, "zarr.json", ".zarray", ".zattrs"}:
        problems.append(
            Problem("E_EXTRA", "the array has no such chunk", str(path / name), fix="Take it away.")
        )
    return problems


def _has_tiff(gap: Problem, root: Path, names: frozenset[str]) -> bool:
    """Whether a TIFF holds the numbers of an array of which a chunk is missing."""
    parts = Path(gap.file or "").relative_to(root).parts
    if len(parts) < 5 or parts[0] != "zarr" or parts[3] not in KINDS:
        return False
    layer = LayerId.parse(parts[1].removesuffix(".zarr"), parts[2])
    return layer.path + KINDS[parts[3]] in names


# --- layers -----------------------------------------------------------------------------------


def _check_catalogue(
    root: Path, names: frozenset[str], tiffs: Mapping[str, TiffFacts]
) -> Iterator[Problem]:
    """Compare the catalogue with the TIFFs: what it lists is there, of its size and hash, with flags and sigma."""
    try:
        entries: tuple[Entry, ...] = read_catalogue(root) if NAME in names else ()
    except DatabaseRefused as refused:
        yield from refused.problems
        return
    flagged = any(entry.layer.path + KINDS["flags"] in names for entry in entries)
    for entry in entries:
        path = entry.layer.path
        name = f"{path}.tif"
        if name not in names:
            why = f"it is missing, {NAME} lists it"
            yield damaged(root / name, why, code="E_MISSING")
        elif (facts := tiffs.get(name)) is not None:
            yield from _check_entry(root / name, facts, entry)
            wanted = [("flags", flagged), ("sigma", bool(facts.record.get(SIGMA)))]
            for kind, there in wanted:
                if there and path + KINDS[kind] not in names:
                    yield damaged(root / (path + KINDS[kind]), "it is missing", code="E_MISSING")
            yield from _check_beside(root, path, tiffs)
    listed = {entry.layer.path for entry in entries}
    for name in sorted(names) if listed else ():
        of_layer = name.startswith("objects/") and name.count("/") == 2 and name.endswith(".tif")
        if of_layer and name.removesuffix(_ending(name)) not in listed:
            fix = f"Remove it, or build the database again: {NAME} does not list it."
            yield Problem("E_EXTRA", "this file belongs to no layer", str(root / name), fix=fix)


def _check_entry(path: Path, facts: TiffFacts, entry: Entry) -> Iterator[Problem]:
    found = (facts.bands, facts.shape[1], facts.shape[0])
    expected = (entry.bands, entry.width, entry.height)
    if found != expected:
        more = {"found": str(found), "expected": f"{expected} in {NAME}"}
        yield damaged(path, "bands, width or height differ", code="E_SIZE", **more)
    elif (digest := hash_file(path)) != entry.sha256.lower():
        more = {"found": digest, "expected": entry.sha256}
        yield damaged(path, f"its sha256 differs from that in {NAME}", **more)


def _check_beside(root: Path, path: str, tiffs: Mapping[str, TiffFacts]) -> Iterator[Problem]:
    """Yield flags and sigma of another size than their values, or of another layer."""
    values = tiffs[f"{path}.tif"]
    for kind in ("flags", "sigma"):
        if (facts := tiffs.get(path + KINDS[kind])) is None:
            continue
        if (facts.shape, facts.bands) != (values.shape, values.bands):
            more = {"found": f"{facts.shape}, {facts.bands} bands"}
            more["expected"] = f"{values.shape}, {values.bands} bands"
            why = "its size differs from that of the values"
            yield damaged(root / (path + KINDS[kind]), why, code="E_SIZE", **more)
        elif any(
            facts.record.get(k) != values.record.get(k) for k in ("object", "camera", "setup")
        ):
            why = "it holds another layer"
            yield damaged(root / (path + KINDS[kind]), why, code="E_SWAPPED")


def _check_group(
    root: Path, names: frozenset[str], tiffs: Mapping[str, TiffFacts], arrays: set[str], group: str
) -> Iterator[Problem]:
    """Yield where a layer's arrays and its TIFFs differ in size or in a number."""
    parts = group.split("/")
    if len(parts) != 3 or parts[0] != "zarr":
        return
    layer = LayerId.parse(parts[1].removesuffix(".zarr"), parts[2])
    for kind, ending in KINDS.items():
        name, array = layer.path + ending, f"{group}/{kind}"
        here = f"{array}/zarr.json" in names
        if array in arrays and here and name in tiffs:
            yield from _check_numbers(root / array, root / name, tiffs[name])
        elif here and name not in names and f"{layer.path}.tif" in names:
            yield damaged(root / name, "it is missing", code="E_MISSING")
        elif not here and name in tiffs and f"{group}/values/zarr.json" in names:
            yield damaged(root / array, "it is missing", code="E_MISSING")


def _check_numbers(array: Path, tiff: Path, facts: TiffFacts) -> Iterator[Problem]:
    """Compare the layer's numbers block by block; the shard that differs is named."""
    import zarr

    values: Any = zarr.open_array(str(array), mode="r")
    shape = (*facts.shape, facts.bands)
    if tuple(values.shape) != shape:
        more = {"found": str(values.shape), "expected": f"{shape} in {tiff.name}"}
        yield damaged(array / "zarr.json", "its size differs from the TIFF", code="E_SIZE", **more)
        return
    if str(values.dtype) != facts.dtype:
        return  # another store of the same layer, in other numbers: nothing to compare
    pages = open_pages(tiff)
    steps = values.shards or values.chunks
    for top in range(0, shape[0], steps[0]):
        for start in range(top, min(top + steps[0], shape[0]), ROWS):
            stop = min(start + ROWS, top + steps[0], shape[0])
            one, other = np.asarray(values[start:stop]), pages.read(start, stop)
            wrong = ~((one == other) | ((one != one) & (other != other)))
            if wrong.any():
                place = np.argwhere(wrong)[0] + (start, 0, 0)
                chunk = tuple(int(p) // s for p, s in zip(place, steps, strict=True))
                shard = array / values.metadata.encode_chunk_key(chunk)
                where = f"x {place[1]}, y {place[0]}, band {place[2]}"
                yield damaged(shard, f"its numbers differ from those of {tiff.name}", field=where)
                break


def _ending(name: str) -> str:
    return next((e for e in (KINDS["flags"], KINDS["sigma"]) if name.endswith(e)), ".tif")
