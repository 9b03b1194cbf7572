"""Calibrated cubes in which charts are looked for: single files, and those of a published database."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from glob import escape
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.core.cube import Band, Cube
from levkas.core.problems import Problem
from levkas.database.containment import check_inside
from levkas.quality.targets.charts import Chart, ChartRefused, chart_of

if TYPE_CHECKING:
    from levkas.database.catalogue import Entry

NOTE = "one cube: the noise is the spread in each patch, its texture included"


class Subject(NamedTuple):
    """Where a chart may be: a name for people, the chart, cubes sensor by sensor, whether it must be there."""

    name: str
    chart: Chart
    files: dict[str, Path]
    certain: bool


def is_database(path: Path) -> bool:
    """Whether a folder is a published database, not a campaign."""
    return (path / "catalogue.csv").is_file() and not (path / "campaign.toml").is_file()


def subjects_of(
    database: Path, kind: str, *, cameras: Sequence[str] = (), objects: Sequence[str] = ()
) -> Iterator[Subject]:
    """Yield the charts that a database keeps in charts/, and the layers of objects that are asked for.

    Parameters
    ----------
    database : path
    kind : str
        Chart that is looked for in layers; charts/ says its own.
    cameras : sequence of str
        Only these.
    objects : sequence of str
        Their layers are looked at; where charts/ is empty and none is named, those of all.

    Raises
    ------
    ChartRefused
        E_VALUE where there is no such camera or object.
    DatabaseRefused
        Where the catalogue cannot be read.
    """
    from levkas.database.catalogue import read_catalogue

    entries = read_catalogue(database)
    kept = list(_kept(database))
    known = {e.camera for e in entries} | {camera for camera, _ in kept}
    _check(database, "--camera", cameras, known)
    _check(database, "--object", objects, {e.object for e in entries})
    for camera, subject in kept:
        if not objects and (not cameras or camera in cameras):
            yield subject
    if kept and not objects:
        return
    for entry in entries:
        if (objects and entry.object not in objects) or (cameras and entry.camera not in cameras):
            continue
        layer = "_".join(part for part in (entry.object, entry.camera, entry.setup) if part)
        file = database / "objects" / entry.object / f"{layer}.tif"
        check_inside(database, file, file.with_name(f"{layer}.flags.tif"))
        yield Subject(_name(entry), chart_of(kind), {"": file}, bool(objects))


def _kept(database: Path) -> Iterator[tuple[str, Subject]]:
    """Yield (camera, subject) of every chart in charts/, by the records that stand there."""
    from levkas.readers.text import read_json

    for record in sorted(database.glob("charts/*/*.json")):
        check_inside(database, *record.parent.glob(f"{escape(record.stem)}*"))
        told = read_json(record)
        files = {
            path.stem[len(record.stem) :].lstrip("_"): path
            for path in sorted(record.parent.glob(f"{record.stem}*.tif"))
            if "." not in path.stem
        }
        if isinstance(told, dict) and "chart" in told and files:
            camera = record.stem[len(record.parent.name) + 1 :]
            name = f"{record.parent.name}/{camera}"
            yield camera, Subject(name, chart_of(str(told["chart"])), files, True)


def _name(entry: Entry) -> str:
    setup = f"@{entry.setup}" if entry.setup else ""
    return f"{entry.object}/{entry.camera}{setup}"


def _check(database: Path, option: str, wanted: Sequence[str], known: set[str]) -> None:
    if unknown := [name for name in wanted if name not in known]:
        raise ChartRefused(
            Problem(
                "E_VALUE",
                "the database has no such camera"
                if "camera" in option
                else "there is no such object",
                str(database),
                option,
                ", ".join(unknown),
                ", ".join(sorted(known)),
            )
        )


def read_cube_file(path: Path) -> tuple[Cube, tuple[str, ...]]:
    """Read a calibrated cube from a TIFF of this package, or an ENVI file; flags where they stand beside it."""
    if path.suffix.lower() in (".tif", ".tiff"):
        values, bands = _read_tiff(path)
    else:
        from levkas.readers.frames import read_facts, read_frame

        values, bands = read_frame(path), _named(read_facts(path).wavelengths)
    values = np.ascontiguousarray(values if values.ndim == 3 else values[..., None], np.float32)
    if len(bands) != values.shape[2]:
        bands = _named([np.nan] * values.shape[2])
    beside = path.with_name(path.stem + ".flags.tif")
    flags = np.zeros(values.shape, np.uint8)
    if beside.is_file():
        from levkas.database.spectral_tiff import open_pages

        pages = open_pages(beside)
        if pages.shape != values.shape:
            raise ChartRefused(
                Problem(
                    "E_SIZE",
                    "the flags are not of the cube's size",
                    str(beside),
                    found=" x ".join(map(str, pages.shape)),
                    expected=" x ".join(map(str, values.shape)),
                    fix="Put the flags there that belong to the cube, or take them away.",
                )
            )
        flags = pages.read()
    return Cube(values, flags, None, bands, "reflectance"), (NOTE,)


def _read_tiff(path: Path) -> tuple[np.ndarray, tuple[Band, ...]]:
    from levkas.database.reader import describe_pages
    from levkas.database.spectral_tiff import open_pages
    from levkas.readers.facts import check_expansion, check_memory

    pages = open_pages(path)
    samples, itemsize = prod(pages.shape), pages.dtype.itemsize
    check_expansion(path, samples, itemsize, path.stat().st_size)
    check_memory(path, samples, itemsize)
    bands = describe_pages(pages).bands
    if any(not b.wavelength >= 200 for b in bands) and all(b.label.endswith(" nm") for b in bands):
        bands = _named([np.nan] * len(bands))  # 0, 1, 2 …: numbers of channels
    return pages.read(), bands


def _named(wavelengths: Any) -> tuple[Band, ...]:
    known = [float(w) for w in (wavelengths if wavelengths is not None else [])]
    return tuple(
        Band(f"{w:g} nm" if np.isfinite(w) else f"channel {i + 1}", w) for i, w in enumerate(known)
    )
