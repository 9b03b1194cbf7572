"""Tiles on the screen: each is a frame against the reference; one of the reference's own, beside one of its neighbours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.campaign.discovery.tiles import place_in_grid
from levkas.geometry import from_dict
from levkas.geometry.transforms import Composed, Inverse
from levkas.stages.spectra import middle_band

if TYPE_CHECKING:
    from collections.abc import Mapping
    from pathlib import Path

    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import Places
    from levkas.geometry.transforms import Transform
    from levkas.workbench.frame import SensorView

SET_PAIRS = "Set four pairs by hand and register again, or capture the tile again."


def is_placed(record: Mapping[str, Any], tile: str) -> bool:
    """Return whether the record of a layer has maps of a tile."""
    return bool(record.get("tiles", {}).get(tile, {}).get("bands"))


def neighbours(whole: Capture, tile: str, record: Mapping[str, Any]) -> list[int]:
    """Return the numbers of the other tiles of a layer, those first beside which a tile is best placed.

    That are those whose overlaps with it hold most windows; then those that are placed, the nearest first by rows and columns.
    """
    shared: dict[str, int] = {}
    for one in record.get("placement", {}).get("overlaps", ()):
        if tile in one["tiles"]:
            other = next((name for name in one["tiles"] if name != tile), tile)
            shared[other] = int(one["windows"])
    here = place_in_grid(tile)

    def rank(number: int) -> tuple[bool, int, float, int]:
        name = whole.tiles[number].tile
        there = place_in_grid(name)
        apart = 0.0 if here is None or there is None else float(np.hypot(*np.subtract(here, there)))
        return not is_placed(record, name), -shared.get(name, 0), apart, number

    return sorted((n for n, part in enumerate(whole.tiles) if part.tile != tile), key=rank)


def record_of_tile(
    record: Mapping[str, Any], view: SensorView, sizes: tuple[tuple[int, int], tuple[int, int]]
) -> dict[str, Any]:
    """Return the record of a tile as that of a camera, from the record of its layer.

    Parameters
    ----------
    sizes : (width, height) of the neighbour and of the tile, px
        Used of a tile that is seen beside a neighbour, whose px are then those of the reference.
    """
    layer = view.capture
    tile = record.get("tiles", {}).get(layer.tile) or {"verdict": record.get("verdict", {})}
    band = record.get("target", {}).get("band") or middle_band(layer.bands)
    verdict = dict(tile["verdict"])
    if verdict.get("decision") == "refuse" and not verdict.get("next_step"):
        verdict["next_step"] = SET_PAIRS
    found = {
        "object": layer.object, "camera": layer.camera, "setup": layer.setup,
        "method": record.get("method", ""), "model": {}, "trace": {},
        "target": {"camera": layer.camera, "setup": layer.setup, "band": band},
        "grid": record.get("grid", {}), "verdict": verdict, "errors": tile.get("errors", {}),
        "bands": tile.get("bands", {}),
    }  # fmt: skip
    if view.beside is None:
        return found | {"reference": record.get("reference", {})}
    here = record.get("tiles", {}).get(view.beside.tile, {}).get("bands", {})
    bands = {}
    if here and found["bands"]:
        back = Inverse(_map(here, band))
        for label in found["bands"]:
            onto = Composed(back, _map(found["bands"], label))
            bands[label] = {"size": list(sizes[1]), "transform": onto.to_dict()}
    reference = {"camera": layer.camera, "band": band, "size": list(sizes[0])}
    return found | {"reference": reference, "bands": bands}


def record_of_neighbour(record: Mapping[str, Any], view: SensorView) -> dict[str, Any]:
    """Return the part of a record that says how the bands of the neighbour lie to its reference band."""
    assert view.beside is not None
    here = record.get("tiles", {}).get(view.beside.tile, {}).get("bands", {})
    band = record.get("target", {}).get("band")
    if not here:
        return {}
    back = Inverse(_map(here, band))
    maps = {label: Composed(back, _map(here, label)) for label in here if label != band}
    return {"bands": {label: {"transform": one.to_dict()} for label, one in maps.items()}}


def _map(bands: Mapping[str, Any], label: str) -> Transform:
    return from_dict(bands[label]["transform"])


def joined(capture: Capture, campaign: Campaign, places: Places) -> Path:
    """Return the folder of the tiles of a layer joined in px of the reference, beside the database; join them where they are not there yet."""
    from levkas.building.build_records import BuildRecords, key_of
    from levkas.building.inputs import digest
    from levkas.stages.calibrate import load_calibrated, write_shown
    from levkas.stages.template_cache import TemplateCache

    records = BuildRecords(places.kept, places.output)
    made_of = {
        stage: records.fingerprint(key_of(capture, stage)) for stage in ("calibrate", "register")
    }
    folder = places.kept_native(capture.object, capture.layer, digest(made_of))
    if not folder.is_dir():
        templates = TemplateCache(places.kept / "templates", records.hashes.of_frame)
        notes = records.notes(key_of(capture, "calibrate"))
        made = load_calibrated(capture, campaign, places, notes, templates)
        write_shown(made, capture, campaign, places, folder)
    return folder
