"""What differs between two databases: file by file, and inside a file number by number.

Needs only the layout of a database and the libraries that read its formats. Bytes are compared first;
what is inside a file is looked at where they differ.
"""

from __future__ import annotations

import csv
import io
import json
import math
import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
import zarr
from PIL import Image

LIMITS = {"values": 1e-5, "sigma": 1e-3, "flags": 0, "preview": 1, "map": 1e-3, "error": 2.0}
"""Largest difference: of values beyond one step of the 16 bits that are stored, where values exceed 1 in
parts of the largest; of sigma, relative (12 bits are stored); pixels; grey levels; px; per cent."""
UNITS = {"sigma": "relative", "flags": "px", "preview": "levels", "numbers": "relative"}
FAILING = {"missing", "record", "unreadable"}
"""Kinds that fail whatever their size; "new", "text" and "numbers" are only listed."""
EXCLUDED = {"fingerprint", "levkas", "libraries", "seconds", "sha256"}
"""Keys of records that are passed over; so are `code` and fingerprints of stages in provenance.json."""
LAYOUT = {"codecs", "chunk_grid", "chunk_key_encoding"}
LAYOUT_TAGS = {254, 259, 273, 278, 279, 305, 317, 322, 323, 324, 325}
STORED_STEP = 2.0**-15
NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|\b(?:nan|inf)\b")
HASH = re.compile(r"\b[0-9a-f]{64}\b")
FINGERPRINT = re.compile(r'"[0-9a-f]{16}"')
"""Of an earlier stage, in provenance.json; it hangs on the code, too."""
CLOSE = 1e-9

Found = tuple[str, str, float, float]
"""Kind, detail, size, size in sigma; nan where there is none."""


@dataclass(frozen=True)
class Difference:
    """One thing that differs; `size` in `unit`, nan where it has none."""

    campaign: str
    file: str
    kind: str
    detail: str
    size: float = math.nan
    unit: str = ""
    sigmas: float = math.nan

    @property
    def fails(self) -> bool:
        return self.kind in FAILING or self.size > LIMITS.get(self.kind, math.inf)

    @property
    def line(self) -> str:
        size = "" if math.isnan(self.size) else f" {self.size:.3g} {self.unit}".rstrip()
        size += "" if math.isnan(self.sigmas) else f", {self.sigmas:.3g} sigma"
        return f"{self.kind}{size}: {self.file}: {self.detail}"


def compare_databases(campaign: str, old: Path, new: Path, *, exact: bool) -> Iterator[Difference]:
    """Yield what differs between the files of two databases; arrays of Zarr count as one file."""
    first, second = list_units(old), list_units(new)
    for name in sorted(first.keys() | second.keys()):
        if name not in second or name not in first:
            kind = "missing" if name not in second else "new"
            yield Difference(campaign, name, kind, "not in the new database" * (kind == "missing"))
            continue
        files = [{p.relative_to(root / name): p.read_bytes() for p in unit[name]}
                 for root, unit in ((old, first), (new, second))]  # fmt: skip
        if files[0] == files[1]:
            continue
        differences = describe(campaign, name, compare_unit(old / name, new / name, exact=exact))
        if exact and not differences and not explained(name):
            differences = [Difference(campaign, name, "bytes", "contents are the same")]
        yield from differences


def list_units(root: Path) -> dict[str, list[Path]]:
    """Return the files of a database by name; those of one Zarr array together."""
    units: dict[str, list[Path]] = {}
    arrays = {p.parent for p in root.rglob("zarr.json") if b'"array"' in p.read_bytes()}
    for path in sorted(p for p in root.rglob("*") if p.is_file()):
        home = next((p for p in path.parents if p in arrays), path)
        units.setdefault(home.relative_to(root).as_posix(), []).append(path)
    return units


def explained(name: str) -> bool:
    """Tell whether bytes of a file may differ for what is excluded."""
    return name.endswith("provenance.json") or name.startswith("manifest-")


def describe(campaign: str, file: str, found: Iterable[Found]) -> list[Difference]:
    """Return findings of one file: the largest of each kind that has a size, all others."""
    result: dict[Any, Difference] = {}
    for kind, detail, size, sigmas in found:
        key = detail if math.isnan(size) else kind
        if key not in result or size > result[key].size:
            result[key] = Difference(
                campaign, file, kind, detail, size, UNITS.get(kind, ""), sigmas
            )
    return list(result.values())


def compare_unit(old: Path, new: Path, *, exact: bool) -> Iterator[Found]:
    """Yield what differs inside two files, or two Zarr arrays, of other bytes."""
    try:
        if old.is_dir():
            yield from compare_zarr(old, new)
        elif old.suffix == ".tif":
            yield from compare_tiff(old, new)
        elif old.suffix == ".png":
            pictures = [np.asarray(Image.open(p)).astype(int) for p in (old, new)]
            yield from compare_arrays("preview", *pictures)
        else:
            texts = [p.read_text(encoding="utf-8") for p in (old, new)]
            if old.suffix == ".json":
                left_out = EXCLUDED - {"sha256"} if exact else EXCLUDED | LAYOUT
                if old.name == "provenance.json":
                    left_out = left_out | {"code"}
                    texts = [FINGERPRINT.sub('""', text) for text in texts]
                yield from compare_records(*map(json.loads, texts), left_out)
            elif old.name == "catalogue.csv":
                rows = [list(csv.DictReader(io.StringIO(text))) for text in texts]
                yield from compare_records(*rows, EXCLUDED)
            else:
                if old.name.startswith("manifest-"):
                    texts = [re.sub(r"\d+ (bytes|files)", r"\1", text) for text in texts]
                for kind, *rest in compare_words(*(HASH.sub("", text) for text in texts)):
                    yield ("text" if kind == "record" else kind), *rest
    except Exception as error:  # whatever a reader of a damaged file raises
        yield "unreadable", f"{type(error).__name__}: {error}", math.nan, math.nan


def compare_zarr(old: Path, new: Path) -> Iterator[Found]:
    records = [json.loads((p / "zarr.json").read_text(encoding="utf-8")) for p in (old, new)]
    yield from compare_records(*records, EXCLUDED | LAYOUT)
    arrays = [zarr.open_array(p, mode="r")[...] for p in (old, new)]
    sigma = old.with_name("sigma")
    known = old.name == "values" and sigma.is_dir()
    yield from compare_arrays(
        old.name if old.name in ("flags", "sigma") else "values", *arrays,
        zarr.open_array(sigma, mode="r")[...] if known else None,
    )  # fmt: skip


def compare_tiff(old: Path, new: Path) -> Iterator[Found]:
    kind = next((k for k in ("flags", "sigma") if old.name.endswith(f".{k}.tif")), "values")
    with tifffile.TiffFile(old) as first, tifffile.TiffFile(new) as second:
        if len(first.series) != len(second.series):
            yield "record", "other pictures in the file", math.nan, math.nan
            return
        for one, other in zip(first.series, second.series, strict=True):
            tags = [read_tags(s.pages[0]) for s in (one, other)]
            for name, detail, *rest in compare_records(*tags, EXCLUDED):
                yield name, f"tag {detail}", *rest
            shown = "preview" if kind == "values" and one.dtype == np.uint8 else kind
            sigma, arrays = old.with_suffix(".sigma.tif"), [one.asarray(), other.asarray()]
            known = shown == "values" and sigma.is_file()
            yield from compare_arrays(shown, *arrays, tifffile.imread(sigma) if known else None)


def read_tags(page: tifffile.TiffPage) -> dict[str, list[str]]:
    """Return the tags of a page by code, but for layout and software; a code may come twice."""
    tags: dict[str, list[str]] = {}
    for tag in page.tags.values():
        if tag.code not in LAYOUT_TAGS:
            tags.setdefault(str(tag.code), []).append(str(tag.value))
    return tags


def compare_arrays(
    kind: str, old: np.ndarray, new: np.ndarray, sigma: np.ndarray | None = None
) -> Iterator[Found]:
    """Yield how far two arrays of values, flags, sigma or grey levels are apart."""
    if old.shape != new.shape or old.dtype != new.dtype:
        text = f"{old.shape} {old.dtype} -> {new.shape} {new.dtype}"
        yield "record", text, math.nan, math.nan
    elif kind == "flags" or old.dtype.kind not in "fiu":
        if count := int((old != new).sum()):
            yield "flags" if kind == "flags" else "record", f"{count} differ", count, math.nan
    else:
        old, new = old.astype(np.float64), new.astype(np.float64)
        difference = np.abs(old - new)
        size = largest(difference, old, new)
        if not size:
            return
        sigmas = math.nan
        text = f"{np.count_nonzero((old != new) & (np.isfinite(old) | np.isfinite(new)))} pixels"
        with np.errstate(all="ignore"):
            if kind == "sigma":
                size = largest(difference / np.abs(old), old, new)
            elif kind == "values":
                if sigma is not None and sigma.shape == old.shape:
                    sigmas = largest(difference / sigma, old, new)
                text += f", largest {size:.3g}"
                steps = STORED_STEP * np.fmax(np.abs(old), np.abs(new))
                scale = np.max(np.abs(old), initial=1, where=np.isfinite(old))
                size = largest(np.maximum(difference - steps, 0), old, new) / float(scale)
        yield kind, text, size, sigmas


def largest(difference: np.ndarray, old: np.ndarray, new: np.ndarray) -> float:
    """Return the largest difference; inf where only one of the two is finite, or infinities differ."""
    with np.errstate(all="ignore"):
        same = (old == new) | (np.isnan(old) & np.isnan(new))
    if same.all():
        return 0.0
    if (~same & ~(np.isfinite(old) & np.isfinite(new))).any():
        return math.inf
    return float(np.nanmax(np.where(same.reshape((*difference.shape, -1)).all(-1), 0, difference)))


def compare_records(old: Any, new: Any, excluded: set[str], at: str = "") -> Iterator[Found]:
    """Yield what differs between two JSON records; keys that are excluded are passed over."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in [*old, *(k for k in new if k not in old)]:
            place = f"{at}.{key}" if at else str(key)
            if key in excluded:
                continue
            if key not in new or key not in old:
                yield "new" if key in new else "missing", place, math.nan, math.nan
            else:
                yield from compare_records(old[key], new[key], excluded, place)
    elif isinstance(old, list) and isinstance(new, list):
        if len(old) != len(new):
            yield "record", f"{at}: {len(old)} -> {len(new)} items", math.nan, math.nan
        for number, (one, other) in enumerate(zip(old, new, strict=False)):
            yield from compare_records(one, other, excluded, f"{at}[{number}]")
    elif is_number(old) and is_number(new):
        both_nan = math.isnan(old) and math.isnan(new)
        if not both_nan and not math.isclose(old, new, rel_tol=CLOSE, abs_tol=CLOSE):
            yield "numbers", f"{at}: {old} -> {new}", relative(old, new), math.nan
    elif isinstance(old, str) and isinstance(new, str):
        yield from compare_words(old, new, at)
    elif old != new or type(old) is not type(new):
        yield "record", f"{at}: {old!r} -> {new!r}"[:200], math.nan, math.nan


def compare_words(old: str, new: str, at: str = "") -> Iterator[Found]:
    """Yield whether two texts differ in words, else how far their numbers are apart."""
    if old == new:
        return
    if NUMBER.sub("#", old) != NUMBER.sub("#", new):
        start = next((n for n, (a, b) in enumerate(zip(old, new, strict=False)) if a != b), 0)
        text = f"{at}: …{old[max(0, start - 20) :][:80]!r} -> …{new[max(0, start - 20) :][:80]!r}"
        yield "record", text, math.nan, math.nan
        return
    pairs = zip(NUMBER.findall(old), NUMBER.findall(new), strict=True)
    sizes = [(relative(float(a), float(b)), a, b) for a, b in pairs if a != b]
    size, first, second = max(sizes)
    yield "numbers", f"{at}: {first} -> {second}", size, math.nan


def is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def relative(old: float, new: float) -> float:
    size = abs(old - new) / max(abs(old), abs(new), 1e-300)
    return size if math.isfinite(size) else math.inf
