"""The files of a database about all its layers: catalogue, indices, imprint, manifest; and the layers that were made from others.

Of these, those that no longer fit their sources stay, marked.
"""

from __future__ import annotations

import hashlib
import re
from contextlib import nullcontext
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

from levkas.building.build_records import CATALOGUE, BuildRecords, Key
from levkas.building.claiming import in_turn
from levkas.building.graph import Step
from levkas.building.inputs import digest
from levkas.building.outcomes import Outcomes, is_named
from levkas.core.ownership import IMPRINT, MARK
from levkas.core.problems import Refused
from levkas.core.text import counted, read_json
from levkas.database.catalogue import MEASURED, DatabaseRefused, read_catalogue
from levkas.database.catalogue import NAME as TABLE
from levkas.database.layout import KINDS, MADE_OF, LayerId, Places
from levkas.database.manifest import NAME as MANIFEST
from levkas.database.manifest import is_partial, walk_files, write_manifest
from levkas.stages.sources import made_with

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.database.catalogue import Entry

_OF_ALL_LAYERS = re.compile(r"zarr/[^/]+\.zarr/zarr\.json|setups/[^/]+/spd\.csv")
AGAIN = "Make it again from its sources, an estimated one by `levkas estimate apply`"


def write_catalogue_of(outcomes: Outcomes, names: list[str], *, whole: bool = True) -> Step:
    """Write catalogue, indices and manifest, where a layer came, changed or went; else nothing.

    Where not the `whole` campaign is built, other objects keep their rows. A build that runs beside this one ends before or
    after: the last to end has them all. A dry one says whether they are stale.
    """
    key, campaign, places, records = CATALOGUE, outcomes.campaign, outcomes.places, outcomes.records
    with nullcontext() if outcomes.dry else in_turn(places.kept):
        stood = _stood(places)
        rows = _rows(records, campaign, stood, whole=whole)
        outdated = _outdated(campaign, places, rows, whole=whole)
        entries = _entries(
            outcomes, rows, outdated, {e.layer: e for e in stood if e.object not in names}
        )
        imprint = imprint_of(campaign, entries)
        spectra = spectra_of(campaign, imprint["setups"])
        others = _by_others(places, records, stood)
        foreign = _foreign_files(others)
        prints = _prints(entries, records, imprint, spectra, others)
        marked = {entry.layer: entry.earlier for entry in stood}
        new = {n: o for n, o in outdated.items() if o.goes or marked[n] != o.why}
        why = _describe(new) or records.why_stale(key, prints)
        stay = tuple(one.warning(layer) for layer, one in outdated.items() if not one.goes)
        if outcomes.dry or not why:
            return Step(key, "stale" if why else "fresh", why, warnings=(*stay, *foreign))
        gone = [_put_away(places, records, n, o.why) for n, o in outdated.items() if o.goes]
        paths = _published(places, entries, names, imprint, spectra)
        manifest = places.output / MANIFEST
        listed = [path.relative_to(places.output).as_posix() for path in (*paths, manifest)]
        records.put_away_left(key, listed)
        write_manifest(places.output, dict(records.products_that_stand()))
        records.keep(key, prints, [*paths, manifest])
    return Step(key, "done", why, warnings=(*stay, *gone, *foreign))


def _stood(places: Places) -> list[Entry]:
    """Return the rows of the catalogue that stands."""
    try:
        return list(read_catalogue(places.output))
    except DatabaseRefused:
        return []


def _rows(
    records: BuildRecords, campaign: Campaign, stood: Sequence[Entry], *, whole: bool
) -> list[Entry]:
    """Return the rows of the measured layers that are finished, and of those made from others that stood."""
    keys = (
        k for k in records.layers() if records.is_begun(k) or not whole or is_named(campaign, k)
    )
    measured = [row for key in keys if (row := records.finished(key))]
    return [*measured, *(entry for entry in stood if entry.kind != MEASURED)]


def _entries(
    outcomes: Outcomes,
    rows: Sequence[Entry],
    outdated: Mapping[LayerId, Outdated],
    others: Mapping[LayerId, Entry],
) -> list[Entry]:
    """Return the rows of the catalogue, each with why its layer is of an earlier build; `others` are of objects that are not built now."""
    why = {layer: entry.earlier for layer, entry in others.items()} | outcomes.earlier
    why |= {layer: one.why for layer, one in outdated.items() if not one.goes}
    return [
        replace(row, earlier=why.get(row.layer, ""))
        for row in sorted(rows, key=lambda row: (row.object, row.camera, row.setup))
        if row.kind == MEASURED or row.layer not in outdated or not outdated[row.layer].goes
    ]


def _prints(
    entries: Sequence[Entry],
    records: BuildRecords,
    imprint: dict[str, Any],
    spectra: dict[str, str],
    others: dict[str, str],
) -> dict[str, Any]:
    products = hashlib.sha256()
    for name, sha in records.products_that_stand():
        products.update(f"{sha} {name}\n".encode("utf-8", "surrogateescape"))
    return {
        **made_with(),
        "layers": digest({"rows": [e.to_row() for e in entries], "files": products.hexdigest()}),
        "campaign": digest({"imprint": imprint, "mark": MARK}),
        "order of cameras and setups": [[*imprint["cameras"]], [*imprint["setups"]]],
        "spectra": digest({"spectra": spectra}),
        "files by others": digest({"files": others}),
    }


def _published(
    places: Places,
    entries: Sequence[Entry],
    names: Sequence[str],
    imprint: dict[str, Any],
    spectra: dict[str, str],
) -> list[Path]:
    """Write the files about all layers; those whose content is the same are left alone."""
    from levkas.campaign.schema.toml import to_toml
    from levkas.core.files import write_changed
    from levkas.database.catalogue import write_catalogue
    from levkas.database.store import write_index

    paths = [write_catalogue(places.output, entries), places.output / IMPRINT]
    write_changed(paths[-1], (MARK + to_toml(imprint)).encode())
    for setup, table in spectra.items():
        paths.append(places.output / "setups" / setup / "spd.csv")
        write_changed(paths[-1], table.encode())
    for name in sorted({*names, *(entry.object for entry in entries)}):
        store = places.store(name)
        if store.is_dir() and any(path.is_dir() for path in store.iterdir()):
            paths.append(write_index(store))
    return paths


# --- files that no build wrote ------------------------------------------------------------------


def _by_others(places: Places, records: BuildRecords, stood: Sequence[Entry]) -> dict[str, str]:
    """Return name → SHA-256 of the files in the database that there is no record of having made.

    Catalogue, indices and what else is written from all layers is ours by its name; so are layers made from others.
    """
    paths = {name for key in (*records.recorded(), CATALOGUE) for name in records.products(key)}
    paths |= {TABLE, IMPRINT, MANIFEST}
    layers = [entry.layer for entry in stood if entry.kind != MEASURED]
    derived = tuple(start for layer in layers for start in (f"{layer.path}.", f"{layer.group}/"))
    there = [
        name
        for name in sorted(set(walk_files(places.output)) - paths)
        if not (is_partial(name) or _OF_ALL_LAYERS.fullmatch(name) or name.startswith(derived))
    ]
    return {n: records.hashes(places.output / n) for n in there if (places.output / n).is_file()}


def _foreign_files(others: Mapping[str, str]) -> tuple[str, ...]:
    """Return the warning of files in the database that Levkas did not make; none where there are none."""
    if not others:
        return ()
    more = len(others) - 1
    return (
        f"{next(iter(others))}{f' and {more} more' if more else ''} in the database: Levkas has no record of writing this. The "
        "manifest lists it, and a publication would contain it. Remove private files, then build again",
    )


# --- layers that were made from others ----------------------------------------------------------


class Outdated(NamedTuple):
    """Why a layer made from others is not of what the database holds now, and whether it goes."""

    why: str
    goes: bool = False

    def warning(self, layer: LayerId) -> str:
        """Return the warning of one that stays."""
        return f"{layer.object}/{layer.name}: of an earlier build: {self.why}. {AGAIN}"


def _outdated(
    campaign: Campaign, places: Places, rows: Sequence[Entry], *, whole: bool
) -> dict[LayerId, Outdated]:
    """Return the layers made from others that are not of what the database holds now: one whose object or name has gone goes."""
    measured = {row.layer: row.sha256 for row in rows if row.kind == MEASURED}
    found = {}
    for layer in (row.layer for row in rows if row.kind != MEASURED):
        if whole and not is_named(campaign, Key(layer.object)):
            found[layer] = Outdated(f"{layer.object} is no longer in the campaign", goes=True)
        elif layer in measured:
            found[layer] = Outdated("a camera of the campaign has its name", goes=True)
        elif why := _why_outdated(places, layer, measured):
            found[layer] = Outdated(why)
    return found


def _why_outdated(places: Places, layer: LayerId, measured: Mapping[LayerId, str]) -> str:
    try:
        sources = dict(read_json(places.output / f"{layer.path}{MADE_OF}")["sources"])
    except (Refused, OSError, KeyError, TypeError, ValueError):
        return "its record cannot be read"
    for name, sha256 in sources.items():
        now = measured.get(LayerId.parse(layer.object, name))
        if now != sha256:
            gone = "is not in the database any more" if now is None else "was built again"
            return f"its source {name} {gone}"
    return ""


def _describe(outdated: Mapping[LayerId, Outdated]) -> str:
    """Report in a line what is outdated; empty for nothing."""
    if not outdated:
        return ""
    (first, one), *others = outdated.items()
    more = f" and {len(others)} more" if others else ""
    made = counted(len(outdated), "layer")
    return f"{made} made from others: {first.object}/{first.name}{more}, {one.why}"


def _put_away(places: Places, records: BuildRecords, layer: LayerId, why: str) -> str:
    """Move a layer made from others out of the database; return the warning."""
    names = [f"{layer.path}{end}" for end in (*KINDS.values(), ".png", MADE_OF)]
    group = places.output / layer.group
    names += [f"{layer.group}/{name}" for name in walk_files(group)] if group.is_dir() else []
    where = records.put_away(names) or "nowhere: its files are gone"
    return f"{layer.object}/{layer.name}: made from others, and {why}; it was moved to {where}. {AGAIN}"


# --- what a database says of its campaign -------------------------------------------------------

LISTED = {"kind", "bits", "black", "saturation", "scan", "denoise", "demosaic"}
"""Keys of a camera that database.toml holds."""


def imprint_of(campaign: Campaign, entries: Iterable[Entry]) -> dict[str, Any]:
    """Return what database.toml says, of what is in the database: `entries` are the rows of its catalogue."""
    described, default = campaign.campaign, default_setup(campaign)
    pairs = {(e.camera, e.setup or default) for e in entries}
    cameras = {camera for camera, _ in pairs}
    under = {name: sorted(c for c, setup in pairs if setup == name) for name in setups_of(campaign)}
    return {
        **described.model_dump(include={"title", "creator", "date", "licence"}),
        "reference": described.reference.model_dump(exclude_none=True),
        "setup": default,
        "publication": campaign.publication.model_dump(exclude_none=True),
        "cameras": {
            name: keys.model_dump(include=LISTED, exclude_none=True)
            for name, keys in campaign.cameras.items()
            if name in cameras
        },
        "setups": {
            name: {"title": keys.title, "description": keys.description, "cameras": under[name]}
            for name, keys in setups_of(campaign).items()
            if under[name]
        },
    }


def default_setup(campaign: Campaign) -> str:
    """Return the name under which the default lighting is described: ``main`` where another one is called ``default``."""
    named = campaign.setups.get("default")
    return campaign.campaign.setup or ("main" if named and named.cameras else "default")


def setups_of(campaign: Campaign) -> dict[str, Any]:
    """Return the tables of all lightings by name, the default one first."""
    from levkas.campaign.schema.tables import Setup

    first = default_setup(campaign)
    return {first: campaign.setups.get(first, Setup()), **campaign.setups}


def spectra_of(campaign: Campaign, setups: Iterable[str]) -> dict[str, str]:
    """Return the spectrum of each lighting that declares one, as setups/SETUP/spd.csv has it.

    Only numbers that were read are written again, nm and relative power: whatever else a file
    holds stays where it is. Raises SpectrumRefused where it is no table of two columns.
    """
    from levkas.stages.spectra import read_table

    declared = {name: keys.spectrum for name, keys in setups_of(campaign).items()}
    tables = {n: read_table(campaign.root / path) for n in setups if (path := declared[n])}
    return {
        name: "wavelength,power\n" + "".join(f"{w:.9g},{v:.9g}\n" for w, v in table)
        for name, table in tables.items()
    }
