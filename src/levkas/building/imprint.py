"""database.toml: what is said of a database as a whole, so that it can be published without its campaign."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from collections.abc import Iterable

    from levkas.campaign.campaign import Campaign
    from levkas.database.catalogue import Entry

NAME = "database.toml"
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
    from levkas.building.whiteboard import read_table

    declared = {name: keys.spectrum for name, keys in setups_of(campaign).items()}
    tables = {n: read_table(campaign.root / path) for n in setups if (path := declared[n])}
    return {
        name: "wavelength,power\n" + "".join(f"{w:.9g},{v:.9g}\n" for w, v in table)
        for name, table in tables.items()
    }


def _camera(keys: dict[str, Any]) -> dict[str, Any]:
    told = ("kind", "bits", "black", "saturation", "scan", "denoise", "demosaic")
    return {key: keys[key] for key in told if key in keys}


def _under(campaign: Campaign, entries: list[Entry], name: str) -> list[str]:
    """Cameras that have layers under a lighting."""
    setup = "" if name == default_setup(campaign) else name
    return sorted({e.camera for e in entries if e.setup == setup})
