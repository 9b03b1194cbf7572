"""Whether the files of a database agree with one another, where no manifest says what they were."""

from __future__ import annotations

from collections.abc import Iterator
from math import nan
from pathlib import Path

from levkas.core.digests import hash_file
from levkas.core.problems import Problem
from levkas.database.catalogue import NAME, DatabaseRefused, Entry, read_catalogue
from levkas.database.file_inventory import Holdings, record_of, same_numbers
from levkas.database.integrity import TiffFacts, damaged
from levkas.database.layout import layer_name
from levkas.database.spectral_tiff import METADATA, WAVELENGTHS
from levkas.database.twins import check_group

BESIDE = (".flags.tif", ".sigma.tif")
OWN = ("quantity", "rendering")
"""Facts that flags and sigma do not share with their values."""
ALIKE = 32
"""Hashes that share more of their 64 digits are one, damaged: by chance they share four."""


def check_agreement(holdings: Holdings) -> Iterator[Problem]:
    """Yield what the catalogue, the TIFFs and the Zarr stores say against one another.

    Parameters
    ----------
    holdings : Holdings
    """
    entries: tuple[Entry, ...] = ()
    if NAME in holdings.names:
        try:
            entries = read_catalogue(holdings.root)
        except DatabaseRefused as refused:
            yield from refused.problems
            return
    for entry in entries:
        yield from _check_entry(holdings, entry)
    for name, facts in sorted(holdings.tiffs.items()):
        if name not in holdings.unsound:
            yield from _check_names(holdings, name, facts)
            yield from _check_beside(holdings, name, facts)
    for group in holdings.layers():
        yield from check_group(holdings, group)
    if entries:
        yield from _check_listed(holdings, entries)


def stem_of(entry: Entry) -> str:
    """Return the path of a layer's files without their endings."""
    parts = [part for part in (entry.object, entry.camera, entry.setup) if part]
    return f"objects/{entry.object}/{'_'.join(parts)}"


def _check_entry(holdings: Holdings, entry: Entry) -> Iterator[Problem]:
    """One row of the catalogue against the layer's TIFF."""
    name = f"{stem_of(entry)}.tif"
    path = holdings.root / name
    if name not in holdings.names:
        yield damaged(path, f"it is missing, {NAME} lists it", code="E_MISSING")
        return
    facts = holdings.sound(name)
    if facts is None:
        return
    found = (facts.bands, facts.shape[1], facts.shape[0])
    if found != (entry.bands, entry.width, entry.height):
        told = {
            "found": str(found),
            "expected": f"{(entry.bands, entry.width, entry.height)} in {NAME}",
        }
        yield damaged(path, "bands, width and height are others", code="E_SIZE", **told)
    elif (digest := hash_file(path)) != entry.sha256.lower():
        # A digit of the catalogue that flipped leaves the others as they are; nothing else does.
        alike = (
            len(entry.sha256) == 64 and sum(map(str.__eq__, digest, entry.sha256.lower())) > ALIKE
        )
        guilty = holdings.root / NAME if alike else path
        yield damaged(
            guilty, f"the sha256 of {path.name} does not fit", found=digest, expected=entry.sha256
        )
    yield from _check_facts(holdings, entry, name)


def _check_facts(holdings: Holdings, entry: Entry, name: str) -> Iterator[Problem]:
    record = record_of(holdings.tiffs[name])
    for key in ("object", "camera", "setup", "quantity"):
        if key in record and record[key] != getattr(entry, key):
            told = {"found": record[key], "expected": getattr(entry, key)}
            yield damaged(
                holdings.root / name, f"it is of another {key}", field=f"tag {METADATA}", **told
            )
    scale = record.get("px_per_mm")
    scale = float(scale) if isinstance(scale, int | float) else nan
    if abs(scale - entry.px_per_mm) > 1e-6 * abs(scale):
        told = {"found": entry.px_per_mm, "expected": scale}
        yield damaged(
            holdings.root / NAME, "px_per_mm is not the TIFF's", field=stem_of(entry), **told
        )


def _check_names(holdings: Holdings, name: str, facts: TiffFacts) -> Iterator[Problem]:
    """A TIFF that says whose it is must stand under that name."""
    record, path = record_of(facts), holdings.root / name
    if record.get("object") and name.startswith("objects/"):
        folder = name.split("/")[1]
        start = "_".join(str(record[k]) for k in ("object", "camera", "setup") if record.get(k))
        if record["object"] != folder or not path.name.startswith(start):
            told = {"found": start, "expected": path.name}
            yield damaged(path, "it holds another layer", code="E_SWAPPED", **told)
    kind = str(record.get("quantity", "")).split(" ")[0]
    expected = {"flags": ".flags.tif", "sigma": ".sigma.tif"}.get(kind, ".tif")
    if kind and _ending(name) != expected:
        yield damaged(path, f"it holds {kind}", code="E_SWAPPED", expected=_ending(name))


def _check_beside(holdings: Holdings, name: str, facts: TiffFacts) -> Iterator[Problem]:
    """Flags and sigma have the shape and the wavelengths of their values."""
    if _ending(name) != ".tif":
        return
    for ending in BESIDE:
        other = name.removesuffix(".tif") + ending
        beside = holdings.sound(other)
        if beside is None:
            continue
        path = holdings.root / other
        if (beside.shape, beside.bands) != (facts.shape, facts.bands):
            told = {"found": f"{beside.shape}, {beside.bands} bands"}
            told["expected"] = f"{facts.shape}, {facts.bands} bands in {Path(name).name}"
            yield damaged(path, "its size is not that of the values", code="E_SIZE", **told)
            continue
        if not same_numbers(beside.tags.get(WAVELENGTHS), facts.tags.get(WAVELENGTHS)):
            told = {"found": str(beside.tags.get(WAVELENGTHS))[:60]}
            told["expected"] = str(facts.tags.get(WAVELENGTHS))[:60]
            yield damaged(
                path, "its wavelengths are not those of the values", code="E_BAND_MISSING", **told
            )
        own, theirs = record_of(beside), record_of(facts)
        differ = [k for k in theirs if k not in OWN and own and own.get(k) != theirs[k]]
        if differ or (theirs and not own):
            told = {
                "field": f"tag {METADATA}",
                "found": str(own.get(differ[0]) if differ else None),
            }
            yield damaged(path, "it does not say of itself what the values do", **told)


def _check_listed(holdings: Holdings, entries: tuple[Entry, ...]) -> Iterator[Problem]:
    """What stands in the database and is in no row, and what other layers have and one has not."""
    stems = {stem_of(entry) for entry in entries}
    for name in sorted(holdings.names):
        parts = name.split("/")
        known = name.removesuffix(_ending(name)) in stems
        if (
            parts[0] == "objects"
            and len(parts) == 3
            and name.endswith((".tif", ".png"))
            and not known
        ):
            fix = f"Take it away, or build the database again: {NAME} does not list it."
            yield Problem(
                "E_EXTRA", "this file belongs to no layer", str(holdings.root / name), fix=fix
            )
    for ending in (".flags.tif", ".png"):
        have = {stem for stem in stems if stem + ending in holdings.names}
        for stem in sorted(stems - have) if have else ():
            yield damaged(holdings.root / (stem + ending), "it is missing", code="E_MISSING")
    groups = {f"zarr/{e.object}.zarr/{layer_name(e.camera, e.setup)}" for e in entries}
    here = set(holdings.layers())
    for group in sorted(groups - here) if here & groups else ():
        yield damaged(holdings.root / group, "it is missing", code="E_MISSING")
    for group in sorted(here - groups):
        yield Problem(
            "E_EXTRA", "this layer is in no row of the catalogue", str(holdings.root / group)
        )
    layers = [f"objects/{e.object}/registration/{layer_name(e.camera, e.setup)}" for e in entries]
    for ending in (".json", ".matches.csv"):
        have = {layer for layer in layers if layer + ending in holdings.names}
        for layer in sorted(set(layers) - have) if have else ():
            yield damaged(holdings.root / (layer + ending), "it is missing", code="E_MISSING")
        for name in sorted(holdings.names) if have else ():
            stem, end = name.removesuffix(ending), name.endswith(ending)
            # Another sensor than a layer's first has its matches in LAYER.SENSOR.matches.csv.
            ours = stem in have or (ending != ".json" and stem.rpartition(".")[0] in have)
            if end and Path(name).parent.name == "registration" and not ours:
                fix = f"Take it away: {NAME} lists no such layer."
                yield Problem(
                    "E_EXTRA", "this file belongs to no layer", str(holdings.root / name), fix=fix
                )


def _ending(name: str) -> str:
    return next((e for e in BESIDE if name.endswith(e)), Path(name).suffix)
