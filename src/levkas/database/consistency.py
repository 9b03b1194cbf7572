"""A database without a manifest: every file decoded, and all of them held against one another.

The catalogue, the TIFFs, the Zarr stores and their indices say the same things of a layer several
times over; where two differ, the one that is alone is named.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.digests import hash_file
from levkas.core.problems import Problem, Refused
from levkas.core.text import parse_bounded, read_json
from levkas.database.catalogue import NAME, DatabaseRefused, Entry, read_catalogue
from levkas.database.integrity import TiffFacts, check_array, check_file, check_tiff, damaged
from levkas.database.layout import KINDS, SIGMA, LayerId
from levkas.database.manifest import is_partial, unfinished
from levkas.database.spectral_tiff import METADATA, WAVELENGTHS, decode_text
from levkas.database.tiff_pages import open_pages

BESIDE = (KINDS["flags"], KINDS["sigma"])
OWN = ("quantity", "rendering", SIGMA)
"""Facts that flags and sigma do not share with their values."""
ALIKE = 32
"""Hashes that share more of their 64 digits are one, damaged: by chance they share four."""
ROWS = 64
"""Rows of a layer that are compared at a time."""


@dataclass(frozen=True)
class FileCheck:
    """One file that was decoded, or "" for what several say of one another.

    `ours` says that Levkas wrote the database, so that more can be expected of it.
    """

    name: str
    problems: tuple[Problem, ...] = ()
    ours: bool = False


@dataclass(frozen=True)
class Inventory:
    """Files of one database, and what each TIFF holds.

    Parameters
    ----------
    root : Path
    names : frozenset of str
        Of all files, relative to `root`, with ``/``.
    tiffs : mapping
        Name → facts of those that could be opened.
    unsound : frozenset of str
        Files that are already known to be damaged: nothing is concluded from them.
    """

    root: Path
    names: frozenset[str]
    tiffs: Mapping[str, TiffFacts]
    unsound: frozenset[str] = field(default=frozenset())

    def sound(self, name: str) -> TiffFacts | None:
        """Return the facts of a TIFF that is whole."""
        return None if name in self.unsound else self.tiffs.get(name)

    def groups(self) -> dict[str, LayerId]:
        """Return the layers that have a Zarr group, by its path."""
        found = {tuple(name.split("/")[:3]) for name in self.names if name.count("/") > 2}
        return {
            "/".join(parts): LayerId.parse(parts[1].removesuffix(".zarr"), parts[2])
            for parts in sorted(found)
            if parts[0] == "zarr"
        }


def check_structure(root: Path, names: frozenset[str]) -> Iterator[FileCheck]:
    """Yield every file as it is decoded, then where the files disagree.

    Parameters
    ----------
    root : Path
    names : frozenset of str
        Files below it, relative with ``/``.
    """
    folders = {n.rpartition("/")[0] for n in names if n.endswith(("/.zarray", "/zarr.json"))}
    arrays: dict[str, list[str]] = {
        folder: [] for folder in sorted(folders) if _is_array(root / folder)
    }
    tiffs: dict[str, TiffFacts] = {}
    problems: list[Problem] = []
    for name in sorted(names):
        array = next((a for a in arrays if name.startswith(f"{a}/")), None)
        if array is not None:
            arrays[array].append(name)
            continue
        found = _decode(root, name, tiffs)
        problems += found
        yield FileCheck(name, tuple(found))
    ours = any(facts.software.startswith("levkas") for facts in tiffs.values())
    described = [p for s in sorted(_stores(names)) for p in _check_store(root, s, names, ours=ours)]
    yield FileCheck("", tuple(described), ours)
    problems += described
    gaps: list[Problem] = []
    undescribed = {str(Path(p.file or "").parent) for p in described}
    for array, inside in arrays.items():
        files = [name.removeprefix(f"{array}/") for name in inside]
        whole = str(root / array) not in undescribed
        found = check_array(root / array, files) if whole else []
        # Others may leave empty chunks out: what the TIFF beside has there decides.
        gaps += [p for p in found if p.code == "E_MISSING" and not ours]
        problems += (found := [p for p in found if p not in gaps])
        for name in inside:
            yield FileCheck(name, tuple(p for p in found if p.file == str(root / name)))
        here = {str(root / name) for name in inside}
        yield FileCheck("", tuple(p for p in found if p.file not in here))
    unsound = frozenset(Path(p.file or "").relative_to(root).as_posix() for p in problems)
    differing = list(check_agreement(Inventory(root, names, tiffs, unsound)))
    named = {p.file for p in differing}
    differing += [p for p in gaps if p.file in named or not _has_tiff(p, root, names)]
    yield FileCheck("", tuple(differing))


def _decode(root: Path, name: str, tiffs: dict[str, TiffFacts]) -> list[Problem]:
    if is_partial(name):
        return [unfinished(root / name)]
    if not name.lower().endswith((".tif", ".tiff")):
        return check_file(root / name)
    facts, problems = check_tiff(root / name)
    if facts is not None:
        tiffs[name] = facts
    return problems


def _is_array(folder: Path) -> bool:
    """Whether a folder is a Zarr array; also one whose description is damaged."""
    if (folder / ".zarray").is_file():
        return True
    try:
        return bool(read_json(folder / "zarr.json").get("node_type") != "group")
    except Refused:
        return (folder / "c").is_dir()


def _has_tiff(gap: Problem, root: Path, names: frozenset[str]) -> bool:
    """Whether a TIFF holds the numbers of an array of which a chunk is missing."""
    parts = Path(gap.file or "").relative_to(root).parts
    if len(parts) < 5 or parts[0] != "zarr" or parts[3] not in KINDS:
        return False
    layer = LayerId.parse(parts[1].removesuffix(".zarr"), parts[2])
    return layer.path + KINDS[parts[3]] in names


# --- Zarr stores and their indices ------------------------------------------------------------


def _stores(names: frozenset[str]) -> set[str]:
    """Stores of Zarr 3; those of other versions have no index."""
    found = (n.split(".zarr/")[0] for n in names if ".zarr/" in n and n.endswith("/zarr.json"))
    return {f"{store}.zarr" for store in found}


def _check_store(root: Path, store: str, names: frozenset[str], *, ours: bool) -> Iterator[Problem]:
    """Check that all descriptions of a store are there, each as the store's index has it."""
    inside = [n for n in names if n.startswith(f"{store}/")]
    for folder in sorted({f for n in inside for f in _described(store, n, ours=ours)}):
        if f"{folder}/zarr.json" not in names:
            path = root / folder / "zarr.json"
            yield damaged(path, "it is missing", code="E_MISSING")
    yield from _check_index(root, store, inside)
    for name in sorted(inside):
        if not name.endswith(("/zarr.json", "/c")) and "/c/" not in name:
            yield Problem("E_EXTRA", "this file is not part of the store", str(root / name))


def _described(store: str, name: str, *, ours: bool) -> list[str]:
    """Return the folders, from the store down to the array of a file, that need a description.

    Others than Levkas may keep an array without any group above it.
    """
    parts = name.removeprefix(f"{store}/").split("/")[:-1]
    array = parts[: parts.index("c")] if "c" in parts else None
    if not ours:
        return [] if array is None else ["/".join([store, *array])]
    above = parts if array is None else array
    return [store] + ["/".join([store, *above[: i + 1]]) for i in range(len(above))]


def _check_index(root: Path, store: str, inside: list[str]) -> Iterator[Problem]:
    """Hold the store's index against the descriptions of its members, which it repeats."""
    try:
        index = read_json(root / store / "zarr.json")["consolidated_metadata"]
        described = dict(index["metadata"])
    except (Refused, ValueError, KeyError, TypeError):
        return
    for member, facts in described.items():
        own = root / store / member / "zarr.json"
        try:
            same = read_json(own) == facts
        except Refused:
            continue  # said by others
        if not same:
            yield damaged(own, "it differs from the index of its store")
    for name in sorted(inside):
        member = name.removeprefix(f"{store}/").removesuffix("/zarr.json")
        if name.endswith("/zarr.json") and member != "zarr.json" and member not in described:
            yield Problem("E_EXTRA", "it is not in the index of its store", str(root / name))


# --- the catalogue, the TIFFs and the Zarr groups of layers -----------------------------------


def check_agreement(inventory: Inventory) -> Iterator[Problem]:
    """Yield what the catalogue, the TIFFs and the Zarr stores say against one another."""
    entries: tuple[Entry, ...] = ()
    if NAME in inventory.names:
        try:
            entries = read_catalogue(inventory.root)
        except DatabaseRefused as refused:
            yield from refused.problems
            return
    for entry in entries:
        yield from _check_entry(inventory, entry)
    for name, facts in sorted(inventory.tiffs.items()):
        if name not in inventory.unsound:
            yield from _check_names(inventory, name, facts)
            yield from _check_beside(inventory, name, facts)
    for group, layer in inventory.groups().items():
        if not any(unsound.startswith(f"{group}/") for unsound in inventory.unsound):
            yield from _check_group(inventory, group, layer)
    if entries:
        layers = [entry.layer for entry in entries]
        yield from _check_listed(inventory, layers)
        yield from _check_records(inventory, [layer.record for layer in layers])


def _check_entry(inventory: Inventory, entry: Entry) -> Iterator[Problem]:
    """Hold one row of the catalogue against the layer's TIFF."""
    name = f"{entry.layer.path}.tif"
    path = inventory.root / name
    if name not in inventory.names:
        yield damaged(path, f"it is missing, {NAME} lists it", code="E_MISSING")
        return
    facts = inventory.sound(name)
    if facts is None:
        return
    found = (facts.bands, facts.shape[1], facts.shape[0])
    expected = (entry.bands, entry.width, entry.height)
    if found != expected:
        more = {"found": str(found), "expected": f"{expected} in {NAME}"}
        yield damaged(path, "bands, width or height differ", code="E_SIZE", **more)
    elif (digest := hash_file(path)) != entry.sha256.lower():
        # A digit of the catalogue that flipped leaves the others as they are; nothing else does.
        alike = len(entry.sha256) == 64 and is_alike(digest, entry.sha256.lower())
        guilty, more = inventory.root / NAME if alike else path, {"found": digest}
        why = f"the sha256 of {path.name} does not match"
        yield damaged(guilty, why, expected=entry.sha256, **more)
    yield from _check_facts(inventory, entry, name)


def is_alike(one: str, other: str) -> bool:
    """Tell whether two hashes are one, of which a digit or two are damaged."""
    return sum(map(str.__eq__, one, other)) > ALIKE


def _check_facts(inventory: Inventory, entry: Entry, name: str) -> Iterator[Problem]:
    record = _record(inventory.tiffs[name])
    for key in ("object", "camera", "setup", "quantity"):
        if key in record and record[key] != getattr(entry, key):
            more = {"found": record[key], "expected": getattr(entry, key)}
            path, field = inventory.root / name, f"tag {METADATA}"
            yield damaged(path, f"it is of another {key}", field=field, **more)
    scale = record.get("px_per_mm")
    scale = float(scale) if isinstance(scale, int | float) else nan
    if abs(scale - entry.px_per_mm) > 1e-6 * abs(scale):
        more = {"found": entry.px_per_mm, "expected": scale, "field": entry.layer.path}
        yield damaged(inventory.root / NAME, "px_per_mm differs from the TIFF", **more)


def _check_names(inventory: Inventory, name: str, facts: TiffFacts) -> Iterator[Problem]:
    """Check that a TIFF that says whose it is stands under that name."""
    record, path = _record(facts), inventory.root / name
    if record.get("object") and name.startswith("objects/"):
        folder = name.split("/")[1]
        start = LayerId(*(str(record.get(k) or "") for k in ("object", "camera", "setup"))).stem
        if record["object"] != folder or not path.name.startswith(start):
            more = {"found": start, "expected": path.name}
            yield damaged(path, "it holds another layer", code="E_SWAPPED", **more)
    kind = str(record.get("quantity", "")).split(" ")[0]
    if kind and _ending(name) != KINDS.get(kind, ".tif"):
        yield damaged(path, f"it holds {kind}", code="E_SWAPPED", expected=_ending(name))


def _check_beside(inventory: Inventory, name: str, facts: TiffFacts) -> Iterator[Problem]:
    """Check that flags and sigma have the shape, the wavelengths and the facts of their values."""
    if _ending(name) != ".tif":
        return
    sigma = name.removesuffix(".tif") + KINDS["sigma"]
    if _record(facts).get(SIGMA) and sigma not in inventory.names:
        yield damaged(inventory.root / sigma, "it is missing", code="E_MISSING")
    for ending in BESIDE:
        other = name.removesuffix(".tif") + ending
        beside = inventory.sound(other)
        if beside is None:
            continue
        path = inventory.root / other
        if (beside.shape, beside.bands) != (facts.shape, facts.bands):
            more = {"found": f"{beside.shape}, {beside.bands} bands"}
            more["expected"] = f"{facts.shape}, {facts.bands} bands in {Path(name).name}"
            yield damaged(path, "its size differs from that of the values", code="E_SIZE", **more)
            continue
        found, expected = beside.tags.get(WAVELENGTHS), facts.tags.get(WAVELENGTHS)
        if not same_numbers(found, expected):
            why = "its wavelengths differ from those of the values"
            more = {"found": str(found)[:60], "expected": str(expected)[:60]}
            yield damaged(path, why, code="E_BAND_MISSING", **more)
        own, theirs = _record(beside), _record(facts)
        differ = [k for k in theirs if k not in OWN and own and own.get(k) != theirs[k]]
        if differ or (theirs and not own):
            found = str(own.get(differ[0]) if differ else None)
            why = "its metadata differ from those of the values"
            yield damaged(path, why, field=f"tag {METADATA}", found=found)


def _check_group(inventory: Inventory, group: str, layer: LayerId) -> Iterator[Problem]:
    """Yield where a layer's arrays and its TIFFs differ: size, bands, and every number."""
    facts = inventory.sound(f"{layer.path}.tif")
    yield from _check_bands(inventory, group, _record(facts))
    for kind, ending in KINDS.items():
        name, array = layer.path + ending, inventory.root / group / kind
        here = f"{group}/{kind}/zarr.json" in inventory.names
        tiff = inventory.sound(name)
        if here and tiff is not None:
            yield from _check_numbers(array, inventory.root / name, tiff)
        elif here and name not in inventory.names and facts is not None:
            yield damaged(inventory.root / name, "it is missing", code="E_MISSING")
        elif tiff is not None and not here and f"{group}/values/zarr.json" in inventory.names:
            yield damaged(array, "it is missing", code="E_MISSING")


def _check_bands(inventory: Inventory, group: str, record: dict[str, Any]) -> Iterator[Problem]:
    import zarr

    for name, key in (("band", "bands"), ("wavelength", "wavelength")):
        expected = record.get(key)
        if not expected or f"{group}/{name}/zarr.json" not in inventory.names:
            continue
        stored: Any = zarr.open_array(str(inventory.root / group / name), mode="r")[:]
        found = stored.tolist()
        if not (found == expected if name == "band" else same_numbers(found, expected)):
            path = inventory.root / group / name / "zarr.json"
            more = {"found": str(found)[:80], "expected": str(expected)[:80]}
            yield damaged(path, f"its {key} differ from the TIFF", code="E_BAND_MISSING", **more)


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


def _check_listed(inventory: Inventory, layers: list[LayerId]) -> Iterator[Problem]:
    """Check that each file and group is of a layer of the catalogue, and that none lacks its own."""
    root, paths = inventory.root, {layer.path for layer in layers}
    for name in sorted(inventory.names):
        image = name.count("/") == 2 and name.endswith((".tif", ".png"))
        if image and name.startswith("objects/") and name.removesuffix(_ending(name)) not in paths:
            fix = f"Remove it, or build the database again: {NAME} does not list it."
            yield Problem("E_EXTRA", "this file belongs to no layer", str(root / name), fix=fix)
    for ending in (KINDS["flags"], ".png"):
        yield from _check_each(inventory, sorted(paths), ending)
    groups, here = {layer.group for layer in layers}, set(inventory.groups())
    for group in sorted(groups - here) if here & groups else ():
        yield damaged(root / group, "it is missing", code="E_MISSING")
    for group in sorted(here - groups):
        yield Problem("E_EXTRA", "the catalogue does not list this layer", str(root / group))


def _check_records(inventory: Inventory, records: list[str]) -> Iterator[Problem]:
    """Check that all layers have a registration record and matches, where any has, and no others do."""
    for ending in (".json", ".matches.csv"):
        yield from _check_each(inventory, sorted(set(records)), ending)
        have = {record for record in records if record + ending in inventory.names}
        for name in sorted(inventory.names) if have else ():
            if not name.endswith(ending) or Path(name).parent.name != "registration":
                continue
            stem = name.removesuffix(ending)
            # Another sensor than a layer's first has its matches in LAYER.SENSOR.matches.csv.
            if stem not in have and (ending == ".json" or stem.rpartition(".")[0] not in have):
                what, fix = (
                    "this file belongs to no layer",
                    f"Remove it: {NAME} does not list this layer.",
                )
                yield Problem("E_EXTRA", what, str(inventory.root / name), fix=fix)


def _check_each(inventory: Inventory, paths: list[str], ending: str) -> Iterator[Problem]:
    """Yield the files of an ending that are missing, where some are there."""
    missing = [path for path in paths if path + ending not in inventory.names]
    for path in missing if len(missing) < len(paths) else ():
        yield damaged(inventory.root / (path + ending), "it is missing", code="E_MISSING")


def _ending(name: str) -> str:
    return next((e for e in BESIDE if name.endswith(e)), Path(name).suffix)


def _record(facts: TiffFacts | None) -> dict[str, Any]:
    """Return what a TIFF says of itself in tag 65111; {} where it says nothing of the kind."""
    try:
        record = parse_bounded(decode_text(str(facts.tags.get(METADATA, "")))) if facts else {}
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}


def same_numbers(one: Any, other: Any) -> bool:
    """Whether two lists of wavelengths, nm, are the same; what one does not say cannot differ.

    >>> same_numbers([400.0, None], (400.0, float("nan"))), same_numbers(None, [1.0])
    (True, True)
    """
    if one is None or other is None:
        return True
    a, b = (
        np.array([np.nan if v is None else v for v in np.atleast_1d(x)], float)
        for x in (one, other)
    )
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=1e-5, equal_nan=True))
