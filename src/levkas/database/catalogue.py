"""catalogue.csv: one row a layer, sorted, the same bytes for the same database."""

from __future__ import annotations

import csv
import io
import math
import tomllib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from sys import intern

from levkas.core.files import write_changed
from levkas.core.problems import Problem, Refused
from levkas.core.text import TextRefused, missing_path, read_text
from levkas.database.layout import LayerId
from levkas.database.manifest import check_inside, check_plain_names
from levkas.database.remote import is_remote, place

NAME = "catalogue.csv"
LARGEST = 64 << 20
"""Bytes of a catalogue that is still read, whose size on a server is the server's choice: half a million layers."""
MOST_PROBLEMS = 10
KINDS = MEASURED, ESTIMATED = "measured", "estimated"


class DatabaseRefused(Refused):
    """A folder is no database, or a part of it is missing or damaged."""


@dataclass(frozen=True, order=True, slots=True)
class Entry:
    """One layer: an object by a camera under a setup ("" for the default one).

    `bands` is their number, `width` and `height` are of the grid, `sha256` is of the layer's TIFF, `kind` is one of `KINDS`.
    `earlier` is empty, or why the last build could not make the layer anew: then it is of an earlier build.
    """

    object: str
    camera: str
    setup: str
    bands: int
    width: int
    height: int
    px_per_mm: float
    quantity: str
    verdict: str
    sha256: str
    kind: str = MEASURED
    earlier: str = ""

    @property
    def layer(self) -> LayerId:
        return LayerId(self.object, self.camera, self.setup)

    def to_row(self) -> list[str]:
        """Return the cells; an unknown sampling is empty, and the last ones are left out where they are as usual."""
        cells = [getattr(self, field.name) for field in fields(self)]
        cells = cells[: len(COLUMNS) + (2 if self.earlier else self.kind != MEASURED)]
        return ["" if isinstance(c, float) and math.isnan(c) else str(c) for c in cells]


ALL_COLUMNS = tuple(field.name for field in fields(Entry))
COLUMNS = ALL_COLUMNS[:-2]
"""Those of every catalogue; ``kind`` and ``earlier`` stand only where a layer is not measured, or not of the last build."""


def database_of(path: str | Path) -> Path:
    """Return the database that a path means: itself, or the output of a campaign where it is one's folder or campaign.toml.

    Raises DatabaseRefused where campaign.toml does not say it.
    """
    found = place(path)
    if is_remote(found) or (found / NAME).is_file():
        return found
    file = found if found.name == "campaign.toml" else found / "campaign.toml"
    if not file.is_file():
        return found
    try:
        keys = tomllib.loads(read_text(file, "a campaign in TOML")).get("campaign", {})
        return (file.parent / keys.get("output", "database")).resolve()
    except (TextRefused, tomllib.TOMLDecodeError, AttributeError, TypeError, ValueError) as error:
        raise no_database(file, f"output = a folder under [campaign] ({error})") from None


def no_database(path: Path, expected: str) -> DatabaseRefused:
    """Return the refusal of a path that is no database: of a folder that does not exist, or that is something else."""
    absent = None if is_remote(path) else missing_path(path)
    what, fix = "no database was found here", "Give the folder of a database, or build it first."
    found = Problem("E_UNREADABLE", what, str(path), expected=expected, fix=fix)
    return DatabaseRefused(absent or found)


def write_catalogue(database: str | Path, entries: Iterable[Entry]) -> Path:
    """Write the catalogue, rows sorted by object, camera and setup; raises WriteRefused.

    One that says the same already is left alone.
    """
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    ordered = sorted(entries, key=lambda entry: (entry.object, entry.camera, entry.setup))
    rows = [entry.to_row() for entry in ordered]
    width = max(map(len, rows), default=len(COLUMNS))
    table.writerow(ALL_COLUMNS[:width])
    table.writerows(_whole_row(row)[:width] for row in rows)
    path = Path(database) / NAME
    write_changed(path, text.getvalue().encode())
    return path


def read_catalogue(database: str | Path) -> tuple[Entry, ...]:
    """Read the catalogue of a database.

    Raises DatabaseRefused where there is none, it is too large, or rows cannot be understood (the first ten of them);
    LinkRefused where it is a link that leads out of the database.
    """
    path = place(database) / NAME
    check_inside(path.parent, path)
    entries, problems, fix = [], [], "Copy the database again, or give the folder of one."
    if is_remote(path) and path.is_file() and (size := path.stat().st_size) > LARGEST:
        what, expected = "the catalogue is too large", f"at most {LARGEST} bytes"
        raise DatabaseRefused(Problem("E_SIZE", what, str(path), None, size, expected, fix))
    try:
        text = read_text(path, "a CSV in UTF-8", most=LARGEST)
        rows = csv.reader(io.StringIO(text, newline=""))
        head = next(rows, [])
        if len(head) < len(COLUMNS) or tuple(head) != ALL_COLUMNS[: len(head)]:
            found, expected = ",".join(head)[:120] or "an empty file", ",".join(COLUMNS)
            what = "the catalogue has wrong columns"
            raise DatabaseRefused(Problem("E_KEY", what, str(path), "line 1", found, expected))
        for number, row in enumerate(rows, start=2):
            try:
                entries.append(entry_of(row))
            except ValueError as error:
                what, field = f"a row is damaged: {error}", f"line {number}"
                problems.append(Problem("E_VALUE", what, str(path), field, fix=fix))
            if len(problems) == MOST_PROBLEMS:
                break
    except csv.Error as error:
        what = f"the catalogue cannot be read: {error}"
        raise DatabaseRefused(Problem("E_UNREADABLE", what, str(path), fix=fix)) from error
    except TextRefused as error:
        raise DatabaseRefused(replace(error.problems[0], fix=fix)) from error
    if problems:
        raise DatabaseRefused(*problems)
    return tuple(entries)


def _whole_row(row: Sequence[str]) -> list[str]:
    """Return a row with the last cells that it leaves out."""
    return [*row, *(MEASURED, "")[len(row) - len(COLUMNS) :]]


def entry_of(row: list[str]) -> Entry:
    """Return the entry of one row of the catalogue; raises ValueError where it is none."""
    if not len(COLUMNS) <= len(row) <= len(ALL_COLUMNS):
        raise ValueError(f"{len(row)} cells of {len(COLUMNS)}")
    kind, earlier = _whole_row(row)[len(COLUMNS) :]
    if kind not in KINDS:
        raise ValueError(f"unknown kind of layer: {kind!r}")
    name, camera, setup, bands, width, height, px_per_mm, quantity, verdict, sha256 = row[:10]
    check_plain_names(name, camera, setup or "-", f"{LayerId(name, camera, setup).stem}.sigma.tif")
    size = int(bands), int(width), int(height), float(px_per_mm or math.nan)
    return Entry(
        name, intern(camera), setup, *size, intern(quantity), verdict, sha256, kind, earlier
    )
