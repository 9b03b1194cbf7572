"""Tiles: frames that show parts of an object which is larger than one of them."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING

from levkas.campaign.discovery.captures import Capture, CaptureRefused, SensorFrames
from levkas.campaign.discovery.patterns import natural
from levkas.campaign.schema.names import EXPECTED, why_unsafe
from levkas.core.problems import Problem
from levkas.core.text import TextRefused, read_text

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera
    from levkas.campaign.discovery.file_index import FoundFile

IN_GRID = re.compile(r"(?:r(\d+))?(?:c(\d+))?")
MOST_NAMED = 6
"""Tiles that a message names."""
POSITIONS = "a table with the columns tile, x and y, a row a tile"


def tiles_of(found: Sequence[FoundFile], camera: Camera) -> list[str]:
    """Return the names of the tiles that the frames of an object show, in natural order; none where they show all of it.

    Raises
    ------
    CaptureRefused
        ``E_TILE`` for frames without a tile among others, and for a name that no file can have; ``E_TILE_TWICE``
        for a tile that several files show which are no declared shots.
    """
    tiles = sorted({f.tile for f in found} - {""}, key=lambda tile: (natural(tile), tile))
    if not tiles:
        return []
    problems: list[Problem] = []
    if whole := [f for f in found if not f.tile]:
        problems.append(
            _problem(
                "E_TILE",
                camera,
                f"some frames of {whole[0].target!r} are tiles, and others have no tile in their names",
                whole[0].path,
                whole[0].path.name,
                "{tile}, or {row} and {column}, in the pattern of every frame of an object",
                "Give frames of the whole object to another camera of campaign.toml.",
            )
        )
    for tile in tiles:
        if why := why_unsafe(tile) or ("it contains '#'" if "#" in tile else ""):
            path = next(f.path for f in found if f.tile == tile)
            what = f"{tile!r} cannot be the name of a tile: {why}"
            fix = "Rename the frames, or name their {row} and {column}."
            problems.append(_problem("E_TILE", camera, what, path, tile, EXPECTED, fix))
    problems += _shown_twice(found, camera)
    if problems:
        raise CaptureRefused(*problems)
    return tiles


def _shown_twice(found: Sequence[FoundFile], camera: Camera) -> Iterator[Problem]:
    alike: dict[tuple[object, ...], list[FoundFile]] = {}
    for f in found:
        key = f.tile, f.sensor, f.band, f.wavelength, f.exposure_s
        alike.setdefault(key, []).append(f)
    for (tile, *_), files in alike.items():
        if len(files) > 1 and not all("shot" in f.pattern.fields for f in files):
            yield _problem(
                "E_TILE_TWICE",
                camera,
                f"two files show tile {tile}",
                files[1].path,
                ", ".join(f.path.name for f in files[:3]),
                "one file",
                "Remove one. If they are shots to average, write {shot} where the names differ.",
            )


def joined_tiles(parts: Sequence[Capture], camera: Camera) -> Capture:
    """Return a capture of some tiles.

    Raises
    ------
    CaptureRefused
        Where tiles differ in their bands.
    """
    first, problems = parts[0], []
    for part in parts[1:]:
        ours, theirs = ([band.label for band in one.bands] for one in (first, part))
        if ours != theirs:
            problems.append(
                _problem(
                    "E_TILE",
                    camera,
                    f"tiles {first.tile} and {part.tile} differ in their bands",
                    part.sensors[0].object[0].path,
                    ", ".join(theirs),
                    ", ".join(ours),
                    "Add the missing frames, or leave the tile out.",
                )
            )
    if problems:
        raise CaptureRefused(*problems)
    sensors = tuple(
        _joined([part.sensors[number] for part in parts]) for number in range(len(first.sensors))
    )
    if missing := holes([part.tile for part in parts]):
        more = f" and {len(missing) - MOST_NAMED} more" if len(missing) > MOST_NAMED else ""
        note = (
            f"no frame shows {', '.join(missing[:MOST_NAMED])}{more} of the grid of tiles: "
            "where no other tile reaches, the layer has a hole"
        )
        sensors = (replace(sensors[0], remarks=(*sensors[0].remarks, note)), *sensors[1:])
    return replace(first, sensors=sensors, tiles=tuple(parts), tile="")


def _joined(sensors: Sequence[SensorFrames]) -> SensorFrames:
    """Return one sensor with the frames of all tiles, each once."""
    return replace(
        sensors[0],
        object=tuple(frame for one in sensors for frame in one.object),
        dark=tuple(dict.fromkeys(frame for one in sensors for frame in one.dark)),
        white=tuple(dict.fromkeys(frame for one in sensors for frame in one.white)),
        chart=tuple(dict.fromkeys(frame for one in sensors for frame in one.chart)),
        remarks=tuple(dict.fromkeys(remark for one in sensors for remark in one.remarks)),
    )


def holes(tiles: Iterable[str]) -> list[str]:
    """Return the places of a grid of rows and columns that have no tile; none where names are not places.

    >>> holes(["r1c1", "r1c2", "r2c2"]), holes(["c1", "c2", "c4"]), holes(["left", "right"])
    (['r2c1'], ['c3'], [])
    """
    names = set(tiles)
    places = [IN_GRID.fullmatch(name) for name in sorted(names)]
    if not all(place and place.group(0) for place in places):
        return []
    axes = []
    for letter, group in (("r", 1), ("c", 2)):
        there = [int(p.group(group)) for p in places if p and p.group(group) is not None]
        span = range(min(there), max(there) + 1) if there else ()
        axes.append([f"{letter}{n}" for n in span] or [""])
    return [row + column for row in axes[0] for column in axes[1] if row + column not in names]


def place_in_grid(tile: str) -> tuple[float, float] | None:
    """Return column and row of a tile by its name, 0 for one that it does not have; None where it is no place.

    >>> place_in_grid("r2c3"), place_in_grid("c4"), place_in_grid("left")
    ((3.0, 2.0), (4.0, 0.0), None)
    """
    found = IN_GRID.fullmatch(tile)
    if not (found and found.group(0)):
        return None
    row, column = (float(n or 0) for n in found.groups())
    return column, row


def read_positions(path: Path) -> dict[str, tuple[float, float]]:
    """Return where the middles of tiles stood by the stage, by the tile's name, (x, y) in the table's unit.

    Raises
    ------
    CaptureRefused
        For a table that cannot be read, a row without two numbers, a tile twice.

    Examples
    --------
    >>> _ = (folder / "stage.csv").write_text("tile,x,y\\nr1c1,0,0\\nr1c2,80.5,0\\n")
    >>> read_positions(folder / "stage.csv")
    {'r1c1': (0.0, 0.0), 'r1c2': (80.5, 0.0)}
    """
    positions: dict[str, tuple[float, float]] = {}
    problems: list[Problem] = []
    try:
        rows = csv.DictReader(io.StringIO(read_text(path, POSITIONS)), skipinitialspace=True)
        for number, row in enumerate(rows, 2):
            try:
                tile, x, y = str(row["tile"]).strip(), float(row["x"]), float(row["y"])
            except (KeyError, TypeError, ValueError):
                tile, x, y = "", 0.0, 0.0
            if not tile or tile in positions or not (isfinite(x) and isfinite(y)):
                what = f"line {number} of the positions " + (
                    f"has tile {tile} again" if tile in positions else "has no place of a tile"
                )
                found = ", ".join(str(value) for value in row.values())[:80]
                problems.append(Problem("E_VALUE", what, str(path), "tile", found, POSITIONS))
            positions[tile] = x, y
    except TextRefused as refused:
        problems = list(refused.problems)
    except csv.Error as error:
        problems = [
            Problem("E_UNREADABLE", "the positions cannot be read", str(path), None, str(error))
        ]
    if problems:
        raise CaptureRefused(*problems[:10])
    return positions


def _problem(
    code: str, camera: Camera, message: str, path: Path, found: str, expected: str, fix: str
) -> Problem:
    field = f"cameras.{camera.name}.files"
    return Problem(code, f"{camera.name}: {message}", str(path), field, found, expected, fix)
