"""Analyses of layers, made while a database is published: band ratios, infrared minus visible.

Each is computed from the values as they are published, row by row, and written beside them as
``objects/OBJECT/analysis/OBJECT_CAMERA.NAME.tif``, a float32 page a picture, with a JSON record of what it is made
of. A pixel that a flag makes unusable in a band that is needed has no value (NaN).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas import __version__
from levkas.core.digests import hash_file
from levkas.core.json_safe import to_json
from levkas.core.problems import Problem
from levkas.database.catalogue import Entry, read_catalogue
from levkas.database.described import open_tiff
from levkas.database.regions import TRUSTED
from levkas.database.spectral_tiff import TiffHeader, write_pages
from levkas.database.tiff_pages import open_pages
from levkas.publish.analysis_names import INFRARED, Analysis, find_band
from levkas.publish.publication import PublishRefused
from levkas.publish.viewer.pictures import ANALYSES

if TYPE_CHECKING:
    from levkas.core.cube import Band
    from levkas.publish.publication import Publication

VISIBLE_NM, INFRARED_NM = (400.0, 700.0), (780.0, 1100.0)
SHOWN_PERCENTILES = (0.5, 99.5)
"""Of the values of a picture, shown as black and as white."""
SAMPLE_PX = 1_000_000
BLOCK_ROWS = 64


@dataclass(frozen=True)
class LayerBands:
    """Bands of one layer that an analysis needs."""

    root: Path
    entry: Entry
    numbers: tuple[int, ...]

    @property
    def tiff(self) -> Path:
        """The layer's TIFF."""
        return self.root / f"{self.entry.layer.path}.tif"

    @cached_property
    def bands(self) -> tuple[Band, ...]:
        """The bands, in the order of `numbers`."""
        every = open_tiff(self.tiff).bands
        return tuple(every[i] for i in self.numbers)

    def beside(self, kind: str) -> Path:
        """Return the path of the layer's ``flags`` or ``sigma``."""
        return self.tiff.with_name(f"{self.tiff.stem}.{kind}.tif")

    def mean_rows(self, rows: slice) -> np.ndarray:
        """Return the mean of the bands in some rows, float64; NaN where one of them is unusable."""
        values = open_pages(self.tiff).read(rows.start, rows.stop, self.numbers).astype(np.float64)
        if (flags := self.beside("flags")).is_file():
            marks = open_pages(flags).read(rows.start, rows.stop, self.numbers)
            values[(marks & ~TRUSTED) != 0] = np.nan
        return np.asarray(values.mean(axis=2))

    def describe(self) -> dict[str, Any]:
        """Return what a record says of it."""
        return {
            "layer": self.entry.layer.name,
            "kind": self.entry.kind,
            "file": f"../{self.tiff.name}",
            "bands": [band.label for band in self.bands],
            "wavelengths": [None if np.isnan(b.wavelength) else b.wavelength for b in self.bands],
        }


@dataclass(frozen=True)
class LayerAnalysis:
    """One analysis of one layer."""

    analysis: Analysis
    entry: Entry
    sources: tuple[LayerBands, ...]

    @property
    def title(self) -> str:
        """What it is called."""
        if self.analysis.kind == INFRARED:
            return "Infrared minus visible"
        return " / ".join(source.bands[0].label for source in self.sources)


def check_analyses(database: Path, analyses: Iterable[Analysis]) -> None:
    """Refuse an analysis that no layer of a database has the bands for; raises PublishRefused."""
    wanted = [*analyses]
    made = {work.analysis for work in find_work(database, wanted)} if wanted else set()
    impossible = [analysis for analysis in wanted if analysis not in made]
    if not impossible:
        return
    tiffs = [database / f"{entry.layer.path}.tif" for entry in read_catalogue(database)]
    labels = dict.fromkeys(band.label for tiff in tiffs for band in open_tiff(tiff).bands)
    problems = [
        Problem(
            *("E_VALUE", f"no layer has the bands for the analysis {analysis.text!r}"),
            *(str(database), "--analyse", ", ".join(labels)[:400], analysis.needs),
            "Remove it, or give bands of a layer: `ratio:700/1000`, `ratio:R/IR`.",
        )
        for analysis in impossible
    ]
    raise PublishRefused(*problems)


def write_analyses(publication: Publication) -> Iterator[str]:
    """Write the analyses that are wanted."""
    if not publication.analyses:
        return
    for work in find_work(publication.folder, publication.analyses):
        layer = f"{work.entry.object}/{work.entry.layer.name}"
        yield f"{layer}: {work.title}"
        _write(publication, work)


def find_work(root: Path, analyses: Sequence[Analysis]) -> list[LayerAnalysis]:
    """Find which layers of a database can be analysed how, by object and by layer."""
    entries = read_catalogue(root)
    every = {e: LayerBands(root, e, tuple(range(e.bands))) for e in entries}
    found = []
    for entry in entries:
        for analysis in analyses:
            first = _chosen(every[entry], analysis, 0)
            # The layer itself first, then what stands beside it under the same light.
            beside = [e for e in entries if e != entry and _fits(e, entry)]
            others = (_chosen(every[e], analysis, 1) for e in [entry, *beside])
            second = next((other for other in others if other), None) if first else None
            if first and second:
                found.append(LayerAnalysis(analysis, entry, (first, second)))
    return found


def _fits(one: Entry, other: Entry) -> bool:
    keys = ("object", "setup", "width", "height", "quantity", "kind")
    return all(getattr(one, key) == getattr(other, key) for key in keys)


def _chosen(source: LayerBands, analysis: Analysis, side: int) -> LayerBands | None:
    """The bands of a layer for one side of a ratio or a difference; None where it has none."""
    if analysis.kind == "ratio":
        number = find_band(source.bands, analysis.bands[side])
        return None if number is None else LayerBands(source.root, source.entry, (number,))
    low, high = (INFRARED_NM, VISIBLE_NM)[side]
    inside = tuple(i for i, b in enumerate(source.bands) if low <= b.wavelength <= high)
    return LayerBands(source.root, source.entry, inside) if inside else None


def _write(publication: Publication, work: LayerAnalysis) -> None:
    """Write the pictures of one analysis and its record."""
    entry, name = work.entry, work.analysis.name
    base = publication.folder / "objects" / entry.object / ANALYSES / f"{entry.layer.stem}.{name}"
    tiff, record = base.with_name(f"{base.name}.tif"), base.with_name(f"{base.name}.json")
    facts, labels, rows = _pairs(work)
    _write_pages(tiff, (entry.height, entry.width, len(labels)), labels, rows, work)
    inputs = dict.fromkeys(source.tiff for source in work.sources)
    shown = [_shown(tiff, i, label, facts) for i, label in enumerate(labels)]
    fields = {
        "levkas": __version__,
        "analysis": work.analysis.text,
        "title": work.title,
        **{"object": entry.object, "layer": entry.layer.name, "file": tiff.name},
        "sha256": hash_file(tiff),
        "sources": [source.describe() for source in work.sources],
        "inputs": {f"../{path.name}": hash_file(path) for path in inputs},
        **facts,
        "pictures": shown,
    }
    place = tiff.relative_to(publication.folder).as_posix()
    publication.hashes[place] = fields["sha256"]
    publication.write_text(record.relative_to(publication.folder).as_posix(), to_json(fields))


def _number(value: float, sign: str = "") -> str:
    """Return three digits, without an exponent where that is as short.

    >>> _number(1628.19), _number(-0.0655), _number(0.41, "+")
    ('1628', '−0.0655', '+0.41')
    """
    text = f"{value:{sign}.0f}" if 1000 <= abs(value) < 1e6 else f"{value:{sign}.3g}"
    return text.replace("-", "−")


def _pairs(work: LayerAnalysis) -> tuple[dict[str, Any], list[str], Iterator[np.ndarray]]:
    """A ratio of two bands, or the difference of the means of two groups."""
    first, second = work.sources
    ratio = work.analysis.kind == "ratio"
    named = [_group(source) for source in work.sources]
    note = f"{named[0]}, {'over' if ratio else 'minus'} {named[1]}."
    note = note[0].upper() + note[1:]

    def rows() -> Iterator[np.ndarray]:
        for start in range(0, work.entry.height, BLOCK_ROWS):
            part = slice(start, min(start + BLOCK_ROWS, work.entry.height))
            one, other = first.mean_rows(part), second.mean_rows(part)
            with np.errstate(divide="ignore", invalid="ignore"):
                made = np.where(other > 0, one / other, np.nan) if ratio else one - other
            yield made[..., None].astype(np.float32)

    return {"notes": [note]}, [work.title], rows()


def _group(source: LayerBands) -> str:
    labels = [band.label for band in source.bands]
    name = source.entry.layer.name
    if len(labels) == 1:
        return f"{labels[0]} of {name}"
    return f"mean of {len(labels)} bands, {labels[0]} to {labels[-1]}, of {name}"


def _write_pages(
    path: Path,
    shape: tuple[int, int, int],
    labels: list[str],
    rows: Iterable[np.ndarray],
    work: LayerAnalysis,
) -> None:
    """Write one float page a picture; the same bytes for any number of threads."""
    facts = {"bands": labels, "quantity": work.title, "object": work.entry.object}
    header = TiffHeader(shape[:2], list(range(shape[2])), to_json(facts))
    write_pages(path, rows, header)


def _shown(path: Path, number: int, label: str, facts: dict[str, Any]) -> dict[str, Any]:
    """Which values are shown as black and white, and what that means."""
    plane = open_pages(path).read_page(number)
    step = max(1, int((plane.size / SAMPLE_PX) ** 0.5))
    sample = plane[::step, ::step]
    finite = sample[np.isfinite(sample)]
    low, high = np.percentile(finite, SHOWN_PERCENTILES) if finite.size else (0.0, 1.0)
    black, white = (float(f"{value:.3g}") for value in (low, high))
    ends = f"Black is {_number(black)}, white {_number(white)}."
    note = f"{facts['notes'][number]} {ends}"
    return {"label": label, "black": black, "white": white, "note": note}
