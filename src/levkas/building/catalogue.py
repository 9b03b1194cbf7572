"""The files of a database about all its layers: catalogue, indices, imprint, manifest."""

from __future__ import annotations

import hashlib
import re
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.building.build_records import CATALOGUE, BuildRecords, Key
from levkas.building.derived_layers import (
    Outdated,
    describe_outdated,
    outdated_layers,
    put_away_outdated,
)
from levkas.building.graph import Step
from levkas.building.inputs import digest
from levkas.building.outcomes import Outcomes, is_named
from levkas.campaign.campaign import Campaign
from levkas.core.ownership import IMPRINT, MARK
from levkas.database.layout import LayerId, Places
from levkas.stages.sources import made_with

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable

    from levkas.campaign.campaign import Campaign
    from levkas.database.catalogue import Entry

_OF_ALL_LAYERS = re.compile(r"zarr/[^/]+\.zarr/zarr\.json|setups/[^/]+/spd\.csv")


def write_catalogue_of(outcomes: Outcomes, names: list[str], *, whole: bool = True) -> Step:
    """Catalogue, indices and manifest, where a layer came, changed or went; else nothing.

    Where not the `whole` campaign is built, other objects keep their rows. A build that runs beside this one ends before or
    after: the last to end has them all. A dry one says whether they are stale.
    """
    from levkas.building.claiming import in_turn
    from levkas.database.manifest import NAME as MANIFEST
    from levkas.database.manifest import write_manifest

    key = CATALOGUE
    campaign, places, records = outcomes.campaign, outcomes.places, outcomes.records
    with nullcontext() if outcomes.dry else in_turn(places.kept):
        entries, outdated, why = _entries(outcomes, names, whole=whole)
        imprint = imprint_of(campaign, entries)
        spectra = spectra_of(campaign, imprint["setups"])
        others = by_others(places, records)
        prints = _prints(entries, records, imprint, spectra, others)
        why = why or records.why_stale(key, prints)
        stay = tuple(one.describe(layer) for layer, one in outdated.items() if not one.goes)
        if outcomes.dry or not why:
            state = "stale" if why else "fresh"
            return Step(key, state, why, warnings=(*stay, *foreign_files(others)))
        go = {layer: one for layer, one in outdated.items() if one.goes}
        warnings = (*stay, *put_away_outdated(places, records, go))
        paths = _published(places, entries, names, imprint, spectra)
        manifest = places.output / MANIFEST
        listed = [path.relative_to(places.output).as_posix() for path in (*paths, manifest)]
        records.put_away_left(key, listed)
        write_manifest(places.output, dict(records.products_that_stand()))
        records.keep(key, prints, [*paths, manifest])
    return Step(key, "done", why, warnings=(*warnings, *foreign_files(others)))


def by_others(places: Places, records: BuildRecords) -> dict[str, str]:
    """Return name → SHA-256 of the files in the database that there is no record of having made.

    Catalogue, indices and what else is written from all layers is ours by its name.
    """
    from levkas.database.catalogue import NAME as TABLE
    from levkas.database.manifest import NAME as MANIFEST
    from levkas.database.manifest import is_partial, walk_files

    keys = (*records.recorded(), CATALOGUE)
    paths = {name for key in keys for name in records.products(key)} | {TABLE, IMPRINT, MANIFEST}
    derived = _derived_files(places)
    there = [
        name
        for name in sorted(set(walk_files(places.output)) - paths)
        if not (is_partial(name) or _OF_ALL_LAYERS.fullmatch(name) or name.startswith(derived))
    ]
    return {n: records.hashes(places.output / n) for n in there if (places.output / n).is_file()}


def _derived_files(places: Places) -> tuple[str, ...]:
    """Return how the names of files of layers begin that were made from others: no build makes them."""
    from levkas.database.catalogue import MEASURED, DatabaseRefused, read_catalogue

    try:
        entries = [e for e in read_catalogue(places.output) if e.kind != MEASURED]
    except DatabaseRefused:
        return ()
    layers = [LayerId(e.object, e.camera, e.setup) for e in entries]
    return tuple(
        beginning
        for layer in layers
        for beginning in (
            f"objects/{layer.object}/{layer.stem}.",
            f"zarr/{layer.object}.zarr/{layer.name}/",
        )
    )


def foreign_files(others: dict[str, str]) -> tuple[str, ...]:
    """Return the warning of files in the database that Levkas did not make; none where there are none."""
    if not others:
        return ()
    first, more = next(iter(others)), len(others) - 1
    named = f"{first} and {more} more" if more else first
    them = "them" if more else "it"
    return (
        f"{named} in the database: Levkas has no record of writing {them}. The manifest lists "
        f"{them}, and a publication would contain {them}. Remove private files, then build "
        "again",
    )


def _prints(
    entries: list[Entry],
    records: BuildRecords,
    imprint: dict[str, Any],
    spectra: dict[str, str],
    others: dict[str, str],
) -> dict[str, Any]:
    products = hashlib.sha256()
    for name, sha in records.products_that_stand():
        products.update(f"{sha} {name}\n".encode("utf-8", "surrogateescape"))
    files = products.hexdigest()
    return {
        **made_with(),
        "layers": digest({"rows": [e.to_row() for e in entries], "files": files}),
        "campaign": digest({"imprint": imprint, "mark": MARK}),
        "order of cameras and setups": [[*imprint["cameras"]], [*imprint["setups"]]],
        "spectra": digest({"spectra": spectra}),
        "files by others": digest({"files": others}),
    }


def _entries(
    outcomes: Outcomes, names: Collection[str], *, whole: bool
) -> tuple[list[Entry], dict[LayerId, Outdated], str]:
    """Return one row a layer that stands, the layers made from others that do not fit any more, and what of these is new."""
    from levkas.database.catalogue import MEASURED, DatabaseRefused, read_catalogue

    campaign, places, records = outcomes.campaign, outcomes.places, outcomes.records
    try:
        stood = {entry.layer: entry for entry in read_catalogue(places.output)}
    except DatabaseRefused:
        stood = {}
    derived = [entry for entry in stood.values() if entry.kind != MEASURED]
    keys = (
        k for k in records.layers() if records.is_begun(k) or not whole or is_named(campaign, k)
    )
    rows = [row for key in keys if (row := records.finished(key))] + derived

    def has_left(name: str) -> bool:
        return whole and not is_named(campaign, Key(name))

    outdated = outdated_layers(places, rows, has_left)
    go = {layer for layer, one in outdated.items() if one.goes}
    why = {layer: entry.earlier for layer, entry in stood.items() if entry.object not in names}
    why |= {
        **outcomes.earlier,
        **{layer: one.why for layer, one in outdated.items() if layer not in go},
    }
    entries = [
        replace(row, earlier=why.get(row.layer, ""))
        for row in sorted(rows, key=lambda row: (row.object, row.camera, row.setup))
        if row.kind == MEASURED or row.layer not in go
    ]
    new = {n: one for n, one in outdated.items() if n in go or stood[n].earlier != one.why}
    return entries, outdated, describe_outdated(new)


def _published(
    places: Places,
    entries: list[Entry],
    names: list[str],
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


DEFAULT = "default"
SPARE = "main"
"""Name of the default lighting where another one is called ``default``."""


def imprint_of(campaign: Campaign, entries: Iterable[Entry]) -> dict[str, Any]:
    """Return what database.toml says, of what is in the database: `entries` are the rows of its catalogue."""
    entries = list(entries)
    described = campaign.campaign
    cameras = {e.camera for e in entries}
    return {
        "title": described.title,
        "creator": described.creator,
        "date": described.date,
        "licence": described.licence,
        "reference": described.reference.model_dump(exclude_none=True),
        "setup": default_setup(campaign),
        "publication": campaign.publication.model_dump(exclude_none=True),
        "cameras": {
            name: _camera(keys.model_dump(exclude_none=True))
            for name, keys in campaign.cameras.items()
            if name in cameras
        },
        "setups": {
            name: {"title": keys.title, "description": keys.description, "cameras": here}
            for name, keys in setups_of(campaign).items()
            if (here := _under(campaign, entries, name))
        },
    }


def default_setup(campaign: Campaign) -> str:
    """Return the name under which the default lighting is described."""
    named = campaign.setups.get(DEFAULT)
    return campaign.campaign.setup or (SPARE if named and named.cameras else DEFAULT)


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


def _camera(keys: dict[str, Any]) -> dict[str, Any]:
    listed = ("kind", "bits", "black", "saturation", "scan", "denoise", "demosaic")
    return {key: keys[key] for key in listed if key in keys}


def _under(campaign: Campaign, entries: list[Entry], name: str) -> list[str]:
    """Cameras that have layers under a lighting."""
    setup = "" if name == default_setup(campaign) else name
    return sorted({e.camera for e in entries if e.setup == setup})
