"""The files of a database that speak of all its layers: catalogue, indices, imprint, manifest."""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.building import fingerprints
from levkas.building.fingerprints import digest
from levkas.building.imprint import NAME as IMPRINT
from levkas.building.imprint import imprint_of, spectra_of
from levkas.building.ledger import Key, Ledger
from levkas.building.sources import code_version
from levkas.building.steps import Step
from levkas.building.withdrawing import CATALOGUE
from levkas.campaign.campaign import Campaign
from levkas.campaign.discovery.captures import Capture
from levkas.core.ownership import MARK
from levkas.database.layout import Places

_OF_ALL_LAYERS = re.compile(r"zarr/[^/]+\.zarr/zarr\.json|setups/[^/]+/spd\.csv")

if TYPE_CHECKING:
    from levkas.database.catalogue import Entry


def write_catalogue_of(
    campaign: Campaign,
    places: Places,
    ledger: Ledger,
    captures: list[Capture],
    names: list[str],
    *,
    whole: bool = True,
) -> Step:
    """Catalogue, indices and manifest, where a layer came, changed or went; else nothing.

    Where not the `whole` campaign is built, other objects keep their rows; so does what a campaign no
    longer has where it is kept. A build that runs beside this one ends before or
    after: the last to end has seen all.
    """
    from levkas.building.turns import in_turn
    from levkas.database.manifest import NAME as MANIFEST
    from levkas.database.manifest import write_manifest

    key = CATALOGUE
    with in_turn(places.kept):
        entries = _entries(places, ledger, captures, names, whole=whole)
        products = ledger.hashes_of_products()
        imprint = imprint_of(campaign, entries)
        spectra = spectra_of(campaign, imprint["setups"])
        others = by_others(places, ledger)
        prints = _prints(entries, products, imprint, spectra, others)
        why = ledger.why_stale(key, prints)
        if not why:
            return Step(key, "fresh", warnings=foreign_files(others))
        ledger.forget(key)
        made = _published(places, entries, names, imprint, spectra)
        manifest = places.output / MANIFEST
        listed = [path.relative_to(places.output).as_posix() for path in (*made, manifest)]
        ledger.put_away_left(key, listed)
        write_manifest(places.output, products)
        ledger.keep(key, prints, [*made, manifest])
    return Step(key, "done", why, warnings=foreign_files(others))


def prints_of_catalogue(
    campaign: Campaign, places: Places, ledger: Ledger, captures: list[Capture], names: list[str]
) -> dict[str, Any]:
    """Return what the files that speak of all layers hang on."""
    entries = _entries(places, ledger, captures, names, whole=True)
    imprint = imprint_of(campaign, entries)
    spectra = spectra_of(campaign, imprint["setups"])
    products = ledger.hashes_of_products()
    return _prints(entries, products, imprint, spectra, by_others(places, ledger))


def by_others(places: Places, ledger: Ledger) -> dict[str, str]:
    """Return name → SHA-256 of the files in the database that there is no record of having made.

    Catalogue, indices and what else is written from all layers is ours by its name.
    """
    from levkas.database.catalogue import NAME as TABLE
    from levkas.database.manifest import NAME as MANIFEST
    from levkas.database.manifest import is_partial, list_files

    ours = {name for key in (*ledger.recorded(), CATALOGUE) for name in ledger.made_by(key)}
    ours |= {TABLE, IMPRINT, MANIFEST}
    there = [n for n in list_files(places.output) if n not in ours and not is_partial(n)]
    there = [n for n in there if not _OF_ALL_LAYERS.fullmatch(n)]
    return {n: ledger.hashes(places.output / n) for n in there if (places.output / n).is_file()}


def foreign_files(others: dict[str, str]) -> tuple[str, ...]:
    """Return the warning of files in the database that Levkas did not make; none where there are none."""
    if not others:
        return ()
    first, more = next(iter(others)), len(others) - 1
    named = f"{first} and {more} more" if more else first
    them = "them" if more else "it"
    return (
        f"{named} in the database: Levkas has no record of having made {them}; the manifest lists "
        f"{them}, and a publication would hold {them}. Take out what is private, then build again",
    )


def _prints(
    entries: list[Entry],
    products: dict[str, str],
    imprint: dict[str, Any],
    spectra: dict[str, str],
    others: dict[str, str],
) -> dict[str, Any]:
    return {
        "code": code_version("catalogue"),
        "layers": digest({"rows": [e.to_row() for e in entries], "files": products}),
        "campaign": digest({"imprint": imprint, "mark": MARK}),
        "spectra": digest(spectra),
        "files by others": digest(others),
    }


def _entries(
    places: Places, ledger: Ledger, captures: list[Capture], names: list[str], *, whole: bool
) -> list[Entry]:
    """One row a layer that stands in the database."""
    from levkas.database.catalogue import DatabaseRefused, entry_of, read_catalogue

    built = {(c.object, c.camera, c.setup) for c in captures}
    try:
        stood = list(read_catalogue(places.output))
    except DatabaseRefused:
        stood = []
    entries = [
        e
        for e in stood
        if (not whole and e.object not in names)
        or (
            ledger.keep_removed
            and (e.object, e.camera, e.setup) not in built
            and ledger.told(Key(e.object, e.camera, e.setup, "resample"))
        )
    ]
    for capture in captures:
        if row := ledger.told(fingerprints.keys_of(capture)["resample"]).get("entry"):
            entries.append(entry_of(row))
    return sorted(entries, key=lambda entry: (entry.object, entry.camera, entry.setup))


def _published(
    places: Places,
    entries: list[Entry],
    names: list[str],
    imprint: dict[str, Any],
    spectra: dict[str, str],
) -> list[Path]:
    """Write the files that speak of all layers; those that would say the same are left alone."""
    from levkas.campaign.schema.toml import to_toml
    from levkas.core.files import write_changed
    from levkas.database.catalogue import write_catalogue
    from levkas.database.store import write_index

    made = [write_catalogue(places.output, entries), places.output / IMPRINT]
    write_changed(made[-1], (MARK + to_toml(imprint)).encode())
    for setup, table in spectra.items():
        made.append(places.output / "setups" / setup / "spd.csv")
        write_changed(made[-1], table.encode())
    for name in sorted({*names, *(entry.object for entry in entries)}):
        store = places.store(name)
        if store.is_dir() and any(path.is_dir() for path in store.iterdir()):
            made.append(write_index(store))
    return made
