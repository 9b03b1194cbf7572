"""Tables beside the captures: what the white board reflects, what a camera's channels see."""

from __future__ import annotations

import csv
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from levkas.campaign.guess.proposal import CameraGuess, Said, SensorGuess

READ_BYTES = 20_000
ROWS = 8
WAVELENGTHS_NM = (200.0, 3000.0)


def find_white_table(root: Path, tables: Sequence[str]) -> str | None:
    """Return the table of a white board's reflectance: over wavelength, shares of one."""
    for table in tables:
        if re.search(r"white|reflect", Path(table).stem, re.IGNORECASE):
            _, rows = _read(root / table)
            if rows and all(len(r) == 2 and 0 < r[1] <= 1.5 for r in rows):
                return table
    return None


def with_sensitivity(camera: CameraGuess, root: Path, tables: Sequence[str]) -> CameraGuess:
    """Give a camera the table that bears its name, and its channels the names in it where they fit."""
    if camera.kind not in ("mosaic", "sensors", "image"):
        return camera
    for table in tables:
        if camera.name.casefold() not in Path(table).stem.casefold():
            continue
        names, rows = _read(root / table)
        if not rows or len(names) < 2:
            continue
        keys = {**camera.keys, "sensitivity": Said(table, "the table that bears its name")}
        sensors = _renamed(camera.sensors, names[1:])
        return replace(camera, keys=keys, sensors=sensors, unknown=_still(camera, sensors))
    return camera


def _renamed(sensors: tuple[SensorGuess, ...], names: Sequence[str]) -> tuple[SensorGuess, ...]:
    """Name the channels of sensors in the order of a table's columns, where there are as many."""
    counts = [len(s.keys["bands"].value) for s in sensors if "bands" in s.keys]
    if not sensors or len(counts) != len(sensors) or sum(counts) != len(set(names)):
        return sensors
    at, renamed = 0, []
    for sensor, count in zip(sensors, counts, strict=True):
        bands = Said(tuple(names[at : at + count]), "from the table of sensitivities")
        renamed.append(replace(sensor, keys={**sensor.keys, "bands": bands}))
        at += count
    return tuple(renamed)


def _still(camera: CameraGuess, sensors: tuple[SensorGuess, ...]) -> tuple[str, ...]:
    """What remains unknown when a table tells what the channels see."""
    told = sensors != camera.sensors
    return tuple(text for text in camera.unknown if not (told and "sees;" in text))


def _read(path: Path) -> tuple[list[str], list[list[float]]]:
    """Return the header and the first rows of a table over wavelength; no rows where it is none."""
    try:
        with path.open(encoding="utf-8-sig", newline="") as handle:
            lines = handle.read(READ_BYTES).splitlines()[: ROWS + 1]
        header, *cells = [row for row in csv.reader(lines) if row]
        rows = [[float(cell) for cell in row] for row in cells]
    except (OSError, ValueError, csv.Error):
        return [], []
    low, high = WAVELENGTHS_NM
    fits = all(len(r) == len(header) > 1 and low < r[0] < high for r in rows)
    return [name.strip() for name in header], rows if fits else []
