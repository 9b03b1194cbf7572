"""Where charts are in files: kept by a database, in its layers, in cubes and in finished photographs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from glob import escape
from math import prod
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.core.cube import Band, Cube, Flag
from levkas.core.problems import Problem, unknown_name
from levkas.database.containment import check_inside
from levkas.quality.targets.charts import Chart, ChartRefused, kind_of
from levkas.quality.targets.edges import EdgePlace
from levkas.readers.frames import read_facts, read_frame

if TYPE_CHECKING:
    from levkas.database.catalogue import Entry
    from levkas.readers.facts import Facts

NO_NATIVE = (
    "measured on the grid alone: the database holds no native pixels, which a build keeps "
    "with native = true under [database] in campaign.toml"
)
NOTE = "one cube: the noise is the spread within each patch, including its texture"


class Subject(NamedTuple):
    """Where a chart may be.

    A name for people, the chart (None where only its slanted edges are measured), cubes sensor by sensor,
    whether it must be there, the quantity of the cubes, slanted edges by sensor, and what is to be known of it.
    """

    name: str
    chart: Chart | None
    files: dict[str, Path]
    certain: bool
    quantity: str = "reflectance"
    edges: Mapping[str, tuple[EdgePlace, ...]] = MappingProxyType({})
    note: str = ""

    def read(self, path: Path) -> CubeFile:
        """Read one of its cubes."""
        cube, notes = read_cube_file(path)
        notes = (*notes, self.note) if self.note else notes
        if self.quantity != "reflectance":
            cube = replace(cube, quantity=self.quantity)
        return CubeFile(cube, notes)


def is_database(path: Path) -> bool:
    """Whether a folder is a published database, not a campaign."""
    return (path / "catalogue.csv").is_file() and not (path / "campaign.toml").is_file()


def subjects_of(
    database: Path,
    kind: str,
    *,
    cameras: Sequence[str] = (),
    objects: Sequence[str] = (),
    corners: bool = False,
) -> Iterator[Subject]:
    """Yield the charts that a database keeps in charts/, and the layers of the requested objects.

    Parameters
    ----------
    kind : str
        Chart that is looked for in layers; charts/ says its own.
    cameras : sequence of str
        Only these.
    objects : sequence of str
        Their layers are looked at, on the grid and in native pixels; where charts/ is empty and none
        is named, those of all, on the grid.
    corners : bool
        Whether the chart's corners are given: they are places on the grid.

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
        file = database / f"{entry.layer.path}.tif"
        check_inside(database, file, database / f"{entry.layer.path}.flags.tif")
        name = f"{entry.object}/{entry.layer.name}"
        chart = kind_of(kind)
        both = bool(objects) and not corners
        native = _native_files(database, entry) if both else {}
        note = NO_NATIVE if both and not native else ""
        facts = bool(objects), entry.quantity
        yield Subject(name, chart, {"": file}, *facts, note=note)
        if native:
            name = f"{name}, native pixels"
            yield Subject(name, chart, native, True, entry.quantity)


def _native_files(database: Path, entry: Entry) -> dict[str, Path]:
    """Return the native cubes of a layer, sensor by sensor; none where they are not kept."""
    from levkas.database.layout import Places
    from levkas.database.opening import open_pixels

    def cubes(path: Path) -> list[Path]:
        found = sorted(path.parent.glob(f"{escape(path.stem)}*.tif"))
        return [p for p in found if "." not in p.stem[len(path.stem) :]]

    layer = entry.layer
    first = Places(database).native(layer.object, layer.camera, layer.setup, "")
    if first.is_file():  # one sensor: other files of that beginning are other layers'
        check_inside(database, first)
        return {"": first}
    found = [path for path in cubes(first) if not Path(path).is_symlink()]
    check_inside(database, *found)
    labels = {path: open_pixels(path).attrs for path in found}
    return {
        path.stem[len(first.stem) :].lstrip("_"): path
        for path, attrs in labels.items()
        if (attrs.get("camera"), attrs.get("setup") or "") == (layer.camera, layer.setup)
    }


def _kept(database: Path) -> Iterator[tuple[str, Subject]]:
    """Yield (camera, subject) of every chart in charts/, by the records that stand there."""
    from levkas.core.text import read_json

    for record in sorted(database.glob("charts/*/*.json")):
        check_inside(database, *record.parent.glob(f"{escape(record.stem)}*"))
        notes = read_json(record)
        files = {
            path.stem[len(record.stem) :].lstrip("_"): path
            for path in sorted(record.parent.glob(f"{record.stem}*.tif"))
            if "." not in path.stem
        }
        if isinstance(notes, dict) and "chart" in notes and files:
            camera = record.stem[len(record.parent.name) + 1 :]
            name = f"{record.parent.name}/{camera}"
            was = "counts" if "greatest_code" in notes else "reflectance"  # of earlier databases
            yield (
                camera,
                Subject(
                    name,
                    kind_of(str(notes["chart"])),
                    files,
                    True,
                    str(notes.get("quantity", was)),
                    _kept_edges(notes),
                ),
            )


def _kept_edges(notes: Mapping[str, Any]) -> dict[str, tuple[EdgePlace, ...]]:
    """Return the slanted edges that the campaign of a kept chart named, by sensor."""
    named: dict[str, tuple[EdgePlace, ...]] = {}
    for sensor, places in dict(notes.get("named_edges", {})).items():
        named[str(sensor)] = tuple(
            EdgePlace(str(label), (int(x), int(y), int(w), int(h)))
            for label, (x, y, w, h) in dict(places).items()
        )
    return named


def _check(database: Path, option: str, wanted: Sequence[str], known: set[str]) -> None:
    what = f"the database has no {option.removeprefix('--')} of this name"
    names, file = sorted(known), str(database)
    unknown = [name for name in wanted if name not in known]
    if problems := [unknown_name(what, n, names, file=file, field=option) for n in unknown]:
        raise ChartRefused(*problems)


class CubeFile(NamedTuple):
    """A cube from a file, and its notes."""

    cube: Cube
    notes: tuple[str, ...]


def read_cube_file(path: Path) -> CubeFile:
    """Read a calibrated cube from a TIFF of this package or an ENVI file, or a finished photograph, in counts.

    Flags are read where they stand beside it.
    """
    top = None
    facts = read_facts(path)
    plain = np.issubdtype(np.dtype(facts.dtype), np.integer) and facts.wavelengths is None
    if facts.pattern is not None or facts.kind == "raw":
        raise ChartRefused(
            Problem(
                "E_VALUE",
                "a raw mosaic file must be developed first",
                str(path),
                found=facts.kind,
                expected="a photograph, a calibrated TIFF, ENVI, a database or a campaign",
                fix="Declare it in a campaign and build that: `levkas look FOLDER --write`.",
            )
        )
    if plain and (len(facts.shape) == 2 or facts.shape[2] in (1, 3)) and facts.pages == 1:
        top = greatest_code(facts)
        values, bands = read_frame(path), _named([np.nan] * (facts.shape[2:] or (1,))[0])
    elif facts.kind == "tiff":
        values, bands = _read_tiff(path)
    else:
        values, bands = read_frame(path), _named(facts.wavelengths)
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
                    "the flags and the cube differ in size",
                    str(beside),
                    found=" x ".join(map(str, pages.shape)),
                    expected=" x ".join(map(str, values.shape)),
                    fix="Replace the flags by those of the cube, or remove them.",
                )
            )
        flags = pages.read()
    if top is not None:
        flags[values >= top] |= np.uint8(Flag.SATURATED)
    quantity = "reflectance" if top is None else "counts"
    return CubeFile(Cube(values, flags, None, bands, quantity), (NOTE,))


def greatest_code(facts: Facts) -> float:
    """Return the greatest code of a frame: 255 of 8 bits."""
    return 2.0 ** (facts.bits or 8 * np.dtype(facts.dtype).itemsize) - 1


def _read_tiff(path: Path) -> tuple[np.ndarray, tuple[Band, ...]]:
    from levkas.database.described import describe_pages
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
