"""Zarr stores against their own index, and against the TIFFs that hold the same numbers."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.problems import Problem, Refused
from levkas.core.text import read_json
from levkas.database.file_inventory import TWINS, Holdings, base_of, record_of, same_numbers
from levkas.database.integrity import TiffFacts, damaged

ROWS = 64


def check_stores(root: Path, names: frozenset[str], *, ours: bool) -> list[Problem]:
    """Check the descriptions in every Zarr store: none missing, each as the store's index has it.

    Parameters
    ----------
    root : Path
    names : frozenset of str
        Files below it.
    ours : bool
        Whether groups must be described too; others may keep an array without any above it.
    """
    problems: list[Problem] = []
    for store in sorted({n.split(".zarr/")[0] + ".zarr" for n in names if ".zarr/" in n}):
        inside = [n for n in names if n.startswith(f"{store}/")]
        if not any(n.endswith("/zarr.json") for n in inside):
            continue  # another version of the format
        for folder in sorted({f for n in inside for f in _described(store, n, ours=ours)}):
            if f"{folder}/zarr.json" not in names:
                path = root / folder / "zarr.json"
                problems.append(damaged(path, "it is missing", code="E_MISSING"))
        problems += _check_index(root, store, names)
        plain = [
            n for n in inside if not n.endswith("/zarr.json") and "/c/" not in n and n[-2:] != "/c"
        ]
        for name in sorted(plain):
            problems.append(
                Problem("E_EXTRA", "this file is no part of the store", str(root / name))
            )
    return problems


def _described(store: str, name: str, *, ours: bool) -> list[str]:
    """Folders, from the store down to the array that a file belongs to, that need a description."""
    parts = name.removeprefix(f"{store}/").split("/")[:-1]
    array = parts[: parts.index("c")] if "c" in parts else None
    if not ours:
        return [] if array is None else ["/".join([store, *array])]
    above = parts if array is None else array
    return [store] + ["/".join([store, *above[: i + 1]]) for i in range(len(above))]


def _check_index(root: Path, store: str, names: frozenset[str]) -> Iterator[Problem]:
    """The store's index repeats the descriptions of its members."""
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
            continue  # told by others
        if not same:
            yield damaged(own, "it is not what the index of its store says")
    for name in sorted(names):
        member = name.removeprefix(f"{store}/").removesuffix("/zarr.json")
        inside = name.startswith(f"{store}/") and name.endswith("/zarr.json")
        if inside and member != "zarr.json" and member not in described:
            yield Problem("E_EXTRA", "the index of its store does not have it", str(root / name))


def check_group(holdings: Holdings, group: str) -> Iterator[Problem]:
    """Yield where a layer's arrays and its TIFFs differ: size, bands, and every number.

    Parameters
    ----------
    holdings : Holdings
    group : str
        As `Holdings.layers` has it.
    """
    if any(unsound.startswith(f"{group}/") for unsound in holdings.unsound):
        return
    base = base_of(group)
    facts = holdings.sound(f"{base}.tif")
    yield from _check_bands(holdings, group, record_of(facts))
    for kind, ending in TWINS.items():
        here = f"{group}/{kind}/zarr.json" in holdings.names
        twin = holdings.sound(base + ending)
        if here and twin is not None:
            tiff = holdings.root / (base + ending)
            yield from _check_numbers(holdings.root / group / kind, tiff, twin)
        elif here and base + ending not in holdings.names and facts is not None:
            yield damaged(holdings.root / (base + ending), "it is missing", code="E_MISSING")
        elif twin is not None and not here and f"{group}/values/zarr.json" in holdings.names:
            yield damaged(holdings.root / group / kind, "it is missing", code="E_MISSING")


def _check_bands(holdings: Holdings, group: str, record: dict[str, Any]) -> Iterator[Problem]:
    import zarr

    for name, key in (("band", "bands"), ("wavelength", "wavelength")):
        told = record.get(key)
        if not told or f"{group}/{name}/zarr.json" not in holdings.names:
            continue
        stored: Any = zarr.open_array(str(holdings.root / group / name), mode="r")[:]
        found = stored.tolist()
        same = found == told if name == "band" else same_numbers(found, told)
        if not same:
            path = holdings.root / group / name / "zarr.json"
            more = {"found": str(found)[:80], "expected": str(told)[:80]}
            yield damaged(path, f"its {key} are not the TIFF's", code="E_BAND_MISSING", **more)


def _check_numbers(array: Path, tiff: Path, facts: TiffFacts) -> Iterator[Problem]:
    """Compare the layer's numbers block by block; the shard that differs is named."""
    import zarr

    from levkas.database.tiff_pages import open_pages

    values: Any = zarr.open_array(str(array), mode="r")
    expected = (*facts.shape, facts.bands)
    if tuple(values.shape) != expected:
        told = {"found": str(values.shape), "expected": f"{expected} in {tiff.name}"}
        yield damaged(array / "zarr.json", "its size is not the TIFF's", code="E_SIZE", **told)
        return
    if str(values.dtype) != facts.dtype:
        return  # another store of the same layer, in other numbers: nothing to compare
    pages = open_pages(tiff)
    steps = values.shards or values.chunks
    for top in range(0, expected[0], steps[0]):
        for start in range(top, min(top + steps[0], expected[0]), ROWS):
            stop = min(start + ROWS, top + steps[0], expected[0])
            wrong = ~_equal(np.asarray(values[start:stop]), pages.read(start, stop))
            if wrong.any():
                place = np.argwhere(wrong)[0] + (start, 0, 0)
                key = values.metadata.encode_chunk_key(
                    tuple(int(p) // s for p, s in zip(place, steps, strict=True))
                )
                told = {"field": f"x {place[1]}, y {place[0]}, band {place[2]}"}
                yield damaged(array / key, f"its numbers are not those of {tiff.name}", **told)
                break


def _equal(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    return (one == other) | ((one != one) & (other != other))
