"""The files of a database about all its layers: catalogue, indices, imprint, manifest."""

from __future__ import annotations

import hashlib
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.building.build_records import CATALOGUE, BuildRecords, Key, key_of
from levkas.building.derived_layers import (
    Outdated,
    describe_outdated,
    outdated_layers,
    put_away_outdated,
)
from levkas.building.fingerprints import digest
from levkas.building.graph import Step
from levkas.campaign.campaign import Campaign
from levkas.campaign.discovery.captures import Capture
from levkas.core.ownership import IMPRINT, MARK
from levkas.database.layout import LayerId, Places
from levkas.stages.sources import made_with

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Sequence

    from levkas.campaign.campaign import Campaign
    from levkas.database.catalogue import Entry

_OF_ALL_LAYERS = re.compile(r"zarr/[^/]+\.zarr/zarr\.json|setups/[^/]+/spd\.csv")


def write_catalogue_of(
    campaign: Campaign,
    places: Places,
    records: BuildRecords,
    captures: list[Capture],
    names: list[str],
    *,
    whole: bool = True,
) -> Step:
    """Catalogue, indices and manifest, where a layer came, changed or went; else nothing.

    Where not the `whole` campaign is built, other objects keep their rows; so does what a campaign no
    longer has where it is kept. A build that runs beside this one ends before or
    after: the last to end has them all.
    """
    from levkas.building.claiming import in_turn
    from levkas.database.manifest import NAME as MANIFEST
    from levkas.database.manifest import write_manifest

    key = CATALOGUE
    with in_turn(places.kept):
        rows = _entries(places, records, captures, names, whole=whole)
        outdated = _outdated(places, records, rows, names, whole=whole)
        entries = [entry for entry in rows if entry.layer not in outdated]
        imprint = imprint_of(campaign, entries)
        spectra = spectra_of(campaign, imprint["setups"])
        others = by_others(places, records)
        prints = _prints(entries, records, imprint, spectra, others)
        why = describe_outdated(outdated) or records.why_stale(key, prints)
        if not why:
            return Step(key, "fresh", warnings=foreign_files(others))
        records.forget(key)
        warnings = put_away_outdated(places, records, outdated)
        paths = _published(places, entries, names, imprint, spectra)
        manifest = places.output / MANIFEST
        listed = [path.relative_to(places.output).as_posix() for path in (*paths, manifest)]
        records.put_away_left(key, listed)
        write_manifest(places.output, dict(records.products_that_stand()))
        records.keep(key, prints, [*paths, manifest])
    return Step(key, "done", why, warnings=(*warnings, *foreign_files(others)))


def _outdated(
    places: Places,
    records: BuildRecords,
    rows: Sequence[Entry],
    names: Collection[str],
    *,
    whole: bool,
) -> dict[LayerId, Outdated]:
    """Return the layers made from others that are not of the database's layers any more."""
    every = whole and not records.keep_removed
    return outdated_layers(places, rows, names if every else None)


def why_catalogue_is_stale(
    campaign: Campaign,
    places: Places,
    records: BuildRecords,
    captures: list[Capture],
    names: list[str],
    others: dict[str, str],
) -> str:
    """Report why the files about all layers are stale; `others` are those of `by_others`."""
    rows = _entries(places, records, captures, names, whole=True)
    if outdated := _outdated(places, records, rows, names, whole=True):
        return describe_outdated(outdated)
    imprint = imprint_of(campaign, rows)
    spectra = spectra_of(campaign, imprint["setups"])
    return records.why_stale(CATALOGUE, _prints(rows, records, imprint, spectra, others))


def by_others(places: Places, records: BuildRecords) -> dict[str, str]:
    """Return name → SHA-256 of the files in the database that there is no record of having made.

    Catalogue, indices and what else is written from all layers is ours by its name.
    """
    from levkas.database.catalogue import NAME as TABLE
    from levkas.database.manifest import NAME as MANIFEST
    from levkas.database.manifest import is_partial, walk_files

    keys = (*records.recorded(), CATALOGUE)
    paths = {name for key in keys for name in records.made_by(key)} | {TABLE, IMPRINT, MANIFEST}
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
        **made_with("catalogue"),
        "layers": digest({"rows": [e.to_row() for e in entries], "files": files}),
        "campaign": digest({"imprint": imprint, "mark": MARK}),
        "order of cameras and setups": [[*imprint["cameras"]], [*imprint["setups"]]],
        "spectra": digest(spectra),
        "files by others": digest(others),
    }


def _entries(
    places: Places, records: BuildRecords, captures: list[Capture], names: list[str], *, whole: bool
) -> list[Entry]:
    """One row a layer that stands in the database."""
    from levkas.database.catalogue import MEASURED, DatabaseRefused, entry_of, read_catalogue

    built = {(c.object, c.camera, c.setup) for c in captures}
    try:
        stood = list(read_catalogue(places.output))
    except DatabaseRefused:
        stood = []
    entries = [
        e
        for e in stood
        if e.kind != MEASURED
        or (not whole and e.object not in names)
        or (
            records.keep_removed
            and (e.object, e.camera, e.setup) not in built
            and records.notes(Key(e.object, e.camera, e.setup, "resample"))
        )
    ]
    for capture in captures:
        if row := records.notes(key_of(capture, "resample")).get("entry"):
            entries.append(entry_of(row))
    return sorted(entries, key=lambda entry: (entry.object, entry.camera, entry.setup))


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
    """Return what database.toml says, of what is in the database.

    Parameters
    ----------
    campaign : Campaign
    entries : iterable of Entry
        Rows of the catalogue.
    """
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
    holds stays where it is.

    Raises
    ------
    SpectrumRefused
        Where the file is no table of two columns.
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
