"""Writing the files of one layer together, row by row: spectral TIFF, flags, sigma, preview, Zarr."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.colour.srgb import counts_white, find_rendering
from levkas.core.digests import hash_file
from levkas.core.files import remove, spooling, together, write_bytes
from levkas.core.machine import count_threads
from levkas.core.rounding import SIGMA_DROP, is_rounded, round_sigma
from levkas.core.threads import made_ahead
from levkas.database.catalogue import MEASURED, Entry
from levkas.database.credits import Credits
from levkas.database.described import describe_pages
from levkas.database.layout import KINDS, SIGMA, STEP, LayerId
from levkas.database.preview import encode_png
from levkas.database.spectral_tiff import THREADS, PageSpool, TiffHeader, write_encoded_pages
from levkas.database.store import writing_layer
from levkas.database.tiff_pages import open_pages

if TYPE_CHECKING:
    from levkas.core.cube import Band, Cube, CubeRows

MADE = "estimate"
"""Attribute with what an estimated layer was made of."""
DTYPES = {"values": np.float32, "flags": np.uint8, "sigma": np.float32}


@dataclass(frozen=True)
class Layer:
    """What a layer's files say about it beside its pixels; `setup` is empty for the default one, `px_per_mm` NaN where it is not known.

    `centroids`: label → nm, of the sensitivities of channels without a centre wavelength, for tag 65000. `kind` is
    ``"measured"``, or ``"estimated"`` from the layers that `made_of` names. `step_per_sigma` is the largest step of the
    values that `core.rounding.round_values` left, a share of their sigma; NaN where it took none.
    """

    object: str
    camera: str
    setup: str = ""
    px_per_mm: float = nan
    credits: Credits = field(default_factory=Credits)
    centroids: Mapping[str, float] = field(default_factory=dict)
    kind: str = MEASURED
    made_of: Mapping[str, Any] | None = None
    step_per_sigma: float = nan

    @property
    def id(self) -> LayerId:
        return LayerId(self.object, self.camera, self.setup)

    def attributes(self, quantity: str, bands: Sequence[Band] = ()) -> dict[str, Any]:
        """Return what the arrays say of themselves; what is unknown is left out, `bad_bands` where none is bad."""
        facts = {
            "quantity": quantity,
            "object": self.object,
            "camera": self.camera,
            "setup": self.setup,
            "px_per_mm": None if isnan(self.px_per_mm) else float(self.px_per_mm),
            "kind": None if self.kind == MEASURED else self.kind,
            MADE: self.made_of,
            "bad_bands": [band.label for band in bands if band.bad] or None,
        }
        return {key: value for key, value in facts.items() if value is not None}

    def facts_of_values(self, *, sigma: bool) -> dict[str, Any]:
        """Return what the values say of themselves beyond what flags and sigma say too."""
        step = {} if isnan(self.step_per_sigma) else {STEP: self.step_per_sigma}
        return {**({SIGMA: True} if sigma else {}), **step}


def write_layer(
    database: str | Path,
    layer: Layer,
    rows: Cube | CubeRows,
    *,
    verdict: str = "accept",
    encoded: bool = False,
    white: float | None = None,
) -> tuple[Entry, tuple[Path, ...]]:
    """Write all files of one registered layer, its rows on the grid from top to bottom as they come.

    The bytes are the same for any number of rows at a time, and only a few are in memory. For the picture, `encoded` says
    that the values are sRGB, and `white` the count shown as white (default: by what is brightest in the first rows).
    Returns the row of the catalogue, and all files that were written.

    Raises WriteRefused where the disk refuses; all files are then the old ones, unless it refuses a name.
    """
    database = Path(database)
    base, group = database / layer.id.path, database / layer.id.group
    facts = layer.attributes(rows.quantity, rows.bands)
    facts |= layer.facts_of_values(sigma=rows.has_sigma)
    picture = _Picture(rows, find_rendering(rows.bands, encoded=encoded), white)
    with (
        together(),
        writing_layer(
            group.parent,
            group.name,
            shape=rows.shape,
            bands=rows.bands,
            attributes=facts,
            sigma=rows.has_sigma,
        ) as store,
        ThreadPoolExecutor(1, thread_name_prefix="store") as beside,
    ):

        def pass_on(part: Cube) -> Future[None]:
            stored = beside.submit(store.write_rows, part.values, part.flags, part.sigma)
            picture.paint(part.values)
            return stored

        blocks = (_rounded(block) for block in rows.blocks)
        written = _write_tiffs(base, layer, rows, blocks, pass_on, picture)
        png = base.with_name(base.name + ".png")
        _write_png(png, picture.rgb, picture.description, facts.get("px_per_mm"))
    written += [png, *sorted(p for p in group.rglob("*") if p.is_file())]
    height, width, count = rows.shape
    entry = Entry(
        *(layer.object, layer.camera, layer.setup, count, width, height, layer.px_per_mm),
        *(rows.quantity, verdict, hash_file(written[0]), layer.kind),
    )
    return entry, tuple(written)


def write_tiffs(base: Path, layer: Layer, rows: Cube | CubeRows) -> list[Path]:
    """Write `base`.tif, .flags.tif and, where the noise is known, .sigma.tif; raises WriteRefused.

    Also for the native files of single sensors.
    """
    return _write_tiffs(base, layer, rows, rows.blocks)


def _write_tiffs(
    base: Path,
    layer: Layer,
    rows: Cube | CubeRows,
    blocks: Iterable[Cube],
    pass_on: Callable[[Cube], Future[None]] | None = None,
    picture: _Picture | None = None,
) -> list[Path]:
    """Spool blocks of rows, pass them on to what is written beside, and write the TIFFs; an older .sigma.tif goes where the noise is not known any more."""
    paths = {kind: base.with_name(base.name + ending) for kind, ending in KINDS.items()}
    if not rows.has_sigma:
        stale = paths.pop("sigma")
    with ExitStack() as stack:
        pool = stack.enter_context(ThreadPoolExecutor(count_threads(THREADS)))
        spools = {}
        for kind, path in paths.items():
            handle = stack.enter_context(spooling(path.parent, path.name))
            spools[kind] = PageSpool(handle, rows.shape, DTYPES[kind], pool)
        for block in made_ahead(blocks):
            beside = pass_on(block) if pass_on else None
            for kind, spool in spools.items():
                spool.write_rows(getattr(block, kind))
            if beside:
                beside.result()
            del block, beside  # before the rows after the next are made
        facts = layer.attributes(rows.quantity, rows.bands)
        rendering = {"rendering": picture.description} if picture else {}
        more = {
            "values": {**rendering, **layer.facts_of_values(sigma=rows.has_sigma)},
            "flags": {"quantity": "flags"},
            "sigma": {"quantity": f"sigma of {rows.quantity}"},
        }
        for kind, spool in spools.items():
            header = TiffHeader(
                *(rows.shape[:2], centres_of(rows.bands, layer.centroids)),
                *(_describe_bands(rows.bands, {**facts, **more[kind]}), DTYPES[kind]),
                rgb=picture.rgb if picture and kind == "values" else None,
                px_per_mm=facts.get("px_per_mm"),
                credits=layer.credits,
            )
            write_encoded_pages(paths[kind], spool.pages(), header)
            spool.drop()  # the next pages may need its space
    if not rows.has_sigma and stale.is_file():
        remove(stale)
    return [*paths.values()]


def _rounded(cube: Cube) -> Cube:
    """Return the cube with sigma as it is stored."""
    if cube.sigma is None or is_rounded(cube.sigma, SIGMA_DROP):
        return cube
    return replace(cube, sigma=round_sigma(cube.sigma))


class _Picture:
    """The rows of a layer, painted in sRGB as they pass; `white` is the count shown as white."""

    def __init__(self, rows: Cube | CubeRows, rendering: Any, white: float | None) -> None:
        self.rgb = np.zeros((*rows.shape[:2], 3), np.uint8)
        self._rendering, self._row = rendering, 0
        self._counts = rows.quantity != "reflectance"
        self._white = white if self._counts else 1.0

    def paint(self, values: np.ndarray) -> None:
        if self._white is None:
            self._white = counts_white(values, self._rendering)
        end = self._row + len(values)
        self.rgb[self._row : end] = self._rendering(values, white=self._white)
        self._row = end

    @property
    def description(self) -> str:
        shown = f"; counts, {self._white:g} shown as white" if self._counts else ""
        return f"{self._rendering.description}{shown}"


def describe_files(
    paths: Iterable[Path], credits: Credits, px_per_mm: float | None, centroids: Mapping[str, float]
) -> None:
    """Write anew what the files of a layer say about its pixels; strips and chunks are copied as they are.

    The bytes are those that `write_layer` writes with these facts. Raises WriteRefused.
    """
    from PIL import Image

    for path in paths:
        if path.suffix == ".tif":
            pages = open_pages(path)
            described = describe_pages(pages)
            facts = _with_sampling(described.facts, px_per_mm)
            header = TiffHeader(
                *(pages.shape[:2], centres_of(described.bands, centroids)),
                *(_describe_bands(described.bands, facts), pages.dtype),
                pages.read_render(),
                px_per_mm,
                credits,
            )
            write_encoded_pages(path, pages.strips(), header)
        elif path.suffix == ".png":
            with Image.open(path) as image:
                text, pixels = image.info.get("Description", ""), np.asarray(image)
            _write_png(path, pixels, text, px_per_mm)
        elif path.parts[-2:] == ("values", "zarr.json"):
            record = json.loads(path.read_bytes())
            record["attributes"] = _with_sampling(record["attributes"], px_per_mm)
            write_bytes(path, json.dumps(record, indent=2).encode())  # as zarr spells it


def _write_png(path: Path, image: np.ndarray, text: str, px_per_mm: float | None) -> None:
    write_bytes(path, encode_png(image, description=text, px_per_mm=px_per_mm))


def _with_sampling(facts: Mapping[str, Any], px_per_mm: float | None) -> dict[str, Any]:
    """Return the attributes of a layer with another sampling, in the order of `Layer.attributes`."""
    first = {key: facts[key] for key in ("quantity", "object", "camera", "setup")}
    scale = {"px_per_mm": px_per_mm} if px_per_mm else {}
    return {**first, **scale, **{k: v for k, v in facts.items() if k not in {*first, "px_per_mm"}}}


def centres_of(bands: Sequence[Band], centroids: Mapping[str, float] | None = None) -> list[float]:
    """Return what tag 65000 holds: centres, else centroids of sensitivities; 0 … n−1 where one has neither.

    >>> from levkas.core.cube import Band
    >>> centres_of([Band("R1"), Band("G1")]), centres_of([Band("550 nm", 550.0)])
    ([0.0, 1.0], [550.0])
    """
    known = centroids or {}
    centres = [
        known.get(b.label, b.wavelength) if isnan(b.wavelength) else b.wavelength for b in bands
    ]
    if any(isnan(centre) for centre in centres):
        centres = [float(number) for number in range(len(bands))]
    return centres


def _describe_bands(bands: Sequence[Band], facts: Mapping[str, Any]) -> str:
    """Return tag 65111: a JSON object with the facts, the bands' labels, wavelengths and widths."""
    record = {
        **facts,
        "bands": [band.label for band in bands],
        "wavelength": [None if isnan(b.wavelength) else float(b.wavelength) for b in bands],
        "fwhm": [None if isnan(b.fwhm) else float(b.fwhm) for b in bands],
    }
    return json.dumps(record, ensure_ascii=False, allow_nan=False)
