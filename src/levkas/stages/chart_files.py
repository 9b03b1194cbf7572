"""Where charts are in files: kept by a database, in its layers, in cubes and in finished photographs."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from glob import escape
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from levkas.core.cube import Band, Cube, Flag
from levkas.core.problems import Problem, unknown_name
from levkas.database.manifest import check_inside
from levkas.quality.targets.charts import Chart, ChartRefused, kind_of
from levkas.quality.targets.edges import EdgePlace
from levkas.readers.frames import read_facts, read_frame

if TYPE_CHECKING:
    from levkas.readers.facts import Facts

ON_GRID = (
    "measured on the grid: charts that a campaign declares are kept and measured in native pixels"
)
NOTE = "one cube: the noise is the spread within each patch, including its texture"


class ChartFiles(NamedTuple):
    """Where a chart is: its name for people, the chart (None where only its slanted edges are measured), cubes by sensor."""

    name: str
    chart: Chart | None
    files: dict[str, Path]
    quantity: str = "reflectance"
    edges: Mapping[str, tuple[EdgePlace, ...]] = MappingProxyType({})
    notes: tuple[str, ...] = ()


def is_database(path: Path) -> bool:
    """Whether a folder is a published database, not a campaign."""
    return (path / "catalogue.csv").is_file() and not (path / "campaign.toml").is_file()


def charts_in(
    database: Path,
    kind: str,
    *,
    cameras: Sequence[str] = (),
    objects: Sequence[str] = (),
) -> Iterator[ChartFiles]:
    """Yield the charts that a database keeps in charts/, or the layers of the objects that are a chart of this kind.

    Layers are looked at on the grid; `cameras` are the only ones.

    Raises ChartRefused: E_VALUE where there is no such camera or object, E_CHART_MISSING where there is no chart;
    DatabaseRefused where the catalogue cannot be read.
    """
    from levkas.database.catalogue import read_catalogue

    entries, kept = read_catalogue(database), [*_kept(database)]
    known = {"--camera": {e.camera for e in entries} | {camera for camera, _ in kept}}
    known["--object"] = {e.object for e in entries}
    problems = [
        unknown_name(f"the database has no {option[2:]} of this name", name, sorted(known[option]),
                     file=str(database), field=option)
        for option, wanted in (("--camera", cameras), ("--object", objects))
        for name in wanted
        if name not in known[option]
    ]  # fmt: skip
    if not kept and not objects:
        fix = "Name the object that is a chart with --object."
        problems.append(
            Problem("E_CHART_MISSING", "the database keeps no chart", str(database), fix=fix)
        )
    if problems:
        raise ChartRefused(*problems)
    if not objects:
        yield from (one for camera, one in kept if not cameras or camera in cameras)
        return
    for entry in entries:
        if entry.object not in objects or (cameras and entry.camera not in cameras):
            continue
        file = database / f"{entry.layer.path}.tif"
        check_inside(database, file, database / f"{entry.layer.path}.flags.tif")
        name = f"{entry.object}/{entry.layer.name}"
        yield ChartFiles(name, kind_of(kind), {"": file}, entry.quantity, notes=(ON_GRID,))


def _cubes(folder: Path, stem: str) -> list[Path]:
    """Return the TIFFs of a beginning, without those of sigma and flags."""
    found = sorted(folder.glob(f"{escape(stem)}*.tif"))
    return [path for path in found if "." not in path.stem[len(stem) :]]


def _kept(database: Path) -> Iterator[tuple[str, ChartFiles]]:
    """Yield (camera, files) of every chart in charts/, by the records that stand there."""
    from levkas.core.text import read_json

    for record in sorted(database.glob("charts/*/*.json")):
        check_inside(database, *record.parent.glob(f"{escape(record.stem)}*"))
        notes, folder = read_json(record), record.parent
        files = {p.stem[len(record.stem) :].lstrip("_"): p for p in _cubes(folder, record.stem)}
        if not isinstance(notes, dict) or "chart" not in notes or not files:
            continue
        camera = record.stem[len(folder.name) + 1 :]
        edges = {
            str(sensor): tuple(
                EdgePlace(str(label), (int(x), int(y), int(w), int(h)))
                for label, (x, y, w, h) in dict(places).items()
            )
            for sensor, places in dict(notes.get("named_edges", {})).items()
        }
        chart, quantity = kind_of(str(notes["chart"])), str(notes.get("quantity", "reflectance"))
        yield camera, ChartFiles(f"{folder.name}/{camera}", chart, files, quantity, edges)


class CubeFile(NamedTuple):
    """A cube from a file, and its notes."""

    cube: Cube
    notes: tuple[str, ...]


def read_cube_file(path: Path) -> CubeFile:
    """Read a calibrated cube from a TIFF of this package or an ENVI file, or a finished photograph, in counts.

    Flags are read where they stand beside it.
    """
    facts = read_facts(path)
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
    whole = np.issubdtype(np.dtype(facts.dtype), np.integer) and facts.wavelengths is None
    channels = (facts.shape[2:] or (1,))[0]
    is_photograph = whole and channels in (1, 3) and facts.pages == 1
    if facts.kind == "tiff" and not is_photograph:
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
    if is_photograph:
        flags[values >= greatest_code(facts)] |= np.uint8(Flag.SATURATED)
    quantity = "counts" if is_photograph else "reflectance"
    return CubeFile(Cube(values, flags, None, bands, quantity), (NOTE,))


def greatest_code(facts: Facts) -> float:
    """Return the greatest code of a frame: 255 of 8 bits."""
    return 2.0 ** (facts.bits or 8 * np.dtype(facts.dtype).itemsize) - 1


def _read_tiff(path: Path) -> tuple[np.ndarray, tuple[Band, ...]]:
    from levkas.database.described import describe_pages
    from levkas.database.spectral_tiff import open_pages
    from levkas.readers.facts import check_expansion, check_memory

    pages = open_pages(path)
    samples, itemsize = int(np.prod(pages.shape)), pages.dtype.itemsize
    check_expansion(path, samples, itemsize, path.stat().st_size)
    check_memory(path, samples, itemsize)
    bands = describe_pages(pages).bands
    if any(not b.wavelength >= 200 for b in bands) and all(b.label.endswith(" nm") for b in bands):
        bands = _named([np.nan] * len(bands))  # 0, 1, 2 …: numbers of channels
    return pages.read(), bands


def _named(wavelengths: Sequence[float] | None) -> tuple[Band, ...]:
    known = [float(w) for w in (wavelengths if wavelengths is not None else [])]
    return tuple(
        Band(f"{w:g} nm" if np.isfinite(w) else f"channel {i + 1}", w) for i, w in enumerate(known)
    )
