"""The files of a database that speak of all its layers: catalogue, indices, imprint, manifest."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.building import fingerprints
from levkas.building.fingerprints import digest
from levkas.building.imprint import NAME as IMPRINT
from levkas.building.imprint import imprint_of, spectra_of
from levkas.building.ledger import Ledger
from levkas.building.places import Places
from levkas.building.steps import Step
from levkas.building.withdrawing import CATALOGUE
from levkas.campaign import Campaign
from levkas.discovery import Capture

if TYPE_CHECKING:
    from levkas.database.catalogue import Entry


def write_catalogue_of(
    campaign: Campaign, places: Places, ledger: Ledger, captures: list[Capture], names: list[str]
) -> Step:
    """Catalogue, indices and manifest, where a layer came, changed or went; else nothing.

    Objects of earlier builds keep their rows. A build that runs beside this one ends before or
    after: the last to end has seen all.
    """
    from levkas.building.turns import in_turn

    key = CATALOGUE
    with in_turn(places.kept):
        entries = _entries(places, ledger, captures, names)
        products = ledger.hashes_of_products()
        imprint = imprint_of(campaign, entries)
        spectra = spectra_of(campaign, imprint["setups"])
        prints = {
            "layers": digest({"rows": [e.to_row() for e in entries], "files": products}),
            "campaign": digest(imprint),
            "spectra": digest({name: ledger.hashes(path) for name, path in spectra.items()}),
        }
        why = ledger.why_stale(key, prints)
        if not why:
            return Step(key, "fresh")
        ledger.forget(key)
        made = _published(places, products, entries, names, imprint, spectra)
        ledger.keep(key, prints, made)
    return Step(key, "done", why)


def _entries(
    places: Places, ledger: Ledger, captures: list[Capture], names: list[str]
) -> list[Entry]:
    """One row a layer that stands in the database."""
    from levkas.database.catalogue import DatabaseRefused, entry_of, read_catalogue

    try:
        entries = [e for e in read_catalogue(places.output) if e.object not in names]
    except DatabaseRefused:
        entries = []
    for capture in captures:
        if row := ledger.told(fingerprints.keys_of(capture)["resample"]).get("entry"):
            entries.append(entry_of(row))
    return sorted(entries, key=lambda entry: (entry.object, entry.camera, entry.setup))


def _published(
    places: Places,
    products: dict[str, str],
    entries: list[Entry],
    names: list[str],
    imprint: dict[str, Any],
    spectra: dict[str, Path],
) -> list[Path]:
    """Write the files that speak of all layers; those that would say the same are left alone."""
    from levkas.database.catalogue import write_catalogue
    from levkas.database.manifest import write_manifest
    from levkas.database.store import write_index
    from levkas.declaring.toml import to_toml
    from levkas.files import write_changed

    made = [write_catalogue(places.output, entries), places.output / IMPRINT]
    write_changed(made[-1], to_toml(imprint).encode())
    for setup, path in spectra.items():
        made.append(places.output / "setups" / setup / "spd.csv")
        write_changed(made[-1], path.read_bytes())
    for name in sorted({*names, *(entry.object for entry in entries)}):
        if places.store(name).is_dir():
            made.append(write_index(places.store(name)))
    made.append(write_manifest(places.output, products).path)
    return made
