"""Writing the files of one layer together, row by row: spectral TIFF, flags, sigma, preview, Zarr."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
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
from levkas.database.catalogue import ESTIMATED, MEASURED, SPLICED, Entry
from levkas.database.credits import Credits
from levkas.database.described import describe_pages
from levkas.database.layout import SIGMA, STEP, LayerId, layer_name
from levkas.database.preview import write_preview
from levkas.database.spectral_tiff import THREADS, PageSpool, TiffHeader, write_encoded_pages
from levkas.database.store import writing_layer
from levkas.database.tiff_pages import open_pages

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Mapping, Sequence

    from levkas.colour.srgb import Rendering
    from levkas.core.cube import Band, Cube, CubeRows

KINDS = {"values": "", "flags": ".flags", "sigma": ".sigma"}
MADE = {MEASURED: "made_of", ESTIMATED: "estimate", SPLICED: "splice"}
"""Attribute with what a layer was made of, by its kind."""
DTYPES = {"values": np.float32, "flags": np.uint8, "sigma": np.float32}


@dataclass(frozen=True)
class Layer:
    """What a layer's files say about it beside its pixels.

    Parameters
    ----------
    object, camera, setup : str
        `setup` is empty for the default one.
    px_per_mm : float
        NaN where the sampling is not known.
    centroids : mapping of label to float, nm
        Of the sensitivities of channels without a centre wavelength, for tag 65000.
    kind : str
        ``"measured"``, or how it was made from others: ``"estimated"``, ``"spliced"``.
    made_of : mapping, optional
        Of a layer made from others: which, and how.
    step_per_sigma : float
        Largest step of the values that `core.rounding.round_values` left, a share of their sigma; NaN where it took none.
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
    def name(self) -> str:
        """``CAMERA`` or ``CAMERA@SETUP``."""
        return layer_name(self.camera, self.setup)

    @property
    def stem(self) -> str:
        """``OBJECT_CAMERA`` or ``OBJECT_CAMERA_SETUP``."""
        return LayerId(self.object, self.camera, self.setup).stem

    def attributes(self, quantity: str, bands: Sequence[Band] = ()) -> dict[str, Any]:
        """Return what the arrays say of themselves; what is unknown is left out, `bad_bands` where none is bad."""
        facts = {
            "quantity": quantity,
            "object": self.object,
            "camera": self.camera,
            "setup": self.setup,
            "px_per_mm": None if isnan(self.px_per_mm) else float(self.px_per_mm),
            "kind": None if self.kind == MEASURED else self.kind,
            MADE[self.kind]: self.made_of,
            "bad_bands": [band.label for band in bands if band.bad] or None,
        }
        return {key: value for key, value in facts.items() if value is not None}


def write_layer(
    database: str | Path,
    layer: Layer,
    rows: Cube | CubeRows,
    *,
    verdict: str = "accept",
    encoded: bool = False,
    white: float | None = None,
    before: Callable[[], object] | None = None,
) -> tuple[Entry, tuple[Path, ...]]:
    """Write all files of one registered layer, its rows from top to bottom as they come.

    The bytes are the same for any number of rows at a time, and only a few are in memory.

    Parameters
    ----------
    rows : Cube or CubeRows
        On the grid.
    verdict : str
        For the catalogue.
    encoded : bool
        Whether the values are encoded as sRGB, for the picture.
    white : float, optional
        Count shown as white; default: by what is brightest in the first rows that come.
    before : callable, optional
        As of `levkas.core.files.together`.

    Returns
    -------
    entry : Entry
        The row of the catalogue.
    files : tuple of Path
        All that was written, files only.

    Raises WriteRefused where the disk refuses; all files are then the old ones, unless it refuses a name.
    """
    database = Path(database)
    base = database / "objects" / layer.object / layer.stem
    root = database / "zarr" / f"{layer.object}.zarr"
    picture = _Picture(rows, find_rendering(rows.bands, encoded=encoded), white)
    with (
        together(before),
        _SpooledTiffs(base, rows) as tiffs,
        writing_layer(
            root,
            layer.name,
            shape=rows.shape,
            bands=rows.bands,
            attributes={
                **layer.attributes(rows.quantity, rows.bands),
                **facts_of_values(layer, sigma=rows.has_sigma),
            },
            sigma=rows.has_sigma,
        ) as store,
        ThreadPoolExecutor(1, thread_name_prefix="store") as beside,
    ):
        for block in made_ahead(rows.blocks):
            part = rounded(block)
            stored = beside.submit(store.write_rows, part.values, part.flags, part.sigma)
            tiffs.write_rows(part)
            picture.paint(part.values)
            stored.result()
            del block, part  # before the rows after the next are made
        written = tiffs.finish(layer, rgb=picture.rgb, rendering=picture.description)
        png = base.with_name(base.name + ".png")
        scale = None if isnan(layer.px_per_mm) else layer.px_per_mm
        write_preview(png, picture.rgb, description=picture.description, px_per_mm=scale)
        written.append(png)
    written += sorted(p for p in (root / layer.name).rglob("*") if p.is_file())
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
    with _SpooledTiffs(base, rows) as tiffs:
        for block in made_ahead(rows.blocks):
            tiffs.write_rows(block)
            del block
        return tiffs.finish(layer)


class _Picture:
    """The rows of a layer, painted in sRGB as they pass; `white` is the count shown as white."""

    def __init__(self, rows: Cube | CubeRows, rendering: Rendering, white: float | None) -> None:
        self.rgb = np.zeros((*rows.shape[:2], 3), np.uint8)
        self._rendering, self._row = rendering, 0
        self._white = 1.0 if rows.quantity == "reflectance" else white
        self._counts = rows.quantity != "reflectance"

    def paint(self, values: np.ndarray) -> None:
        if self._white is None:
            self._white = counts_white(values, self._rendering)
        end = self._row + len(values)
        self.rgb[self._row : end] = self._rendering(values, white=self._white)
        self._row = end

    @property
    def description(self) -> str:
        shown = f"; counts, {self._white:g} shown as white" if self._counts else ""
        return self._rendering.description + shown


class _SpooledTiffs:
    """Values, flags and, where it is known, sigma of one layer or sensor, written row by row.

    To be used as a context; `finish` writes the files.
    """

    def __init__(self, base: Path, rows: Cube | CubeRows) -> None:
        self._base, self._rows = base, rows
        self._spools: dict[str, PageSpool] = {}

    def __enter__(self) -> _SpooledTiffs:
        with ExitStack() as stack:
            pool = stack.enter_context(ThreadPoolExecutor(count_threads(THREADS)))
            for kind in KINDS:
                if kind != "sigma" or self._rows.has_sigma:
                    path = self._path(kind)
                    handle = stack.enter_context(spooling(path.parent, path.name))
                    self._spools[kind] = PageSpool(handle, self._rows.shape, DTYPES[kind], pool)
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def _path(self, kind: str) -> Path:
        return self._base.with_name(f"{self._base.name}{KINDS[kind]}.tif")

    def write_rows(self, block: Cube) -> None:
        """Take rows of all arrays."""
        for kind, spool in self._spools.items():
            spool.write_rows(getattr(block, kind))

    def finish(
        self, layer: Layer, *, rgb: np.ndarray | None = None, rendering: str = ""
    ) -> list[Path]:
        """Write the files and return them; raises WriteRefused.

        An older .sigma.tif goes where the noise is not known any more.
        """
        bands, quantity = self._rows.bands, self._rows.quantity
        facts = layer.attributes(quantity, bands)
        more = {
            "values": {
                **facts,
                **({"rendering": rendering} if rendering else {}),
                **facts_of_values(layer, sigma=self._rows.has_sigma),
            },
            "flags": {**facts, "quantity": "flags"},
            "sigma": {**facts, "quantity": f"sigma of {quantity}"},
        }
        written = []
        for kind, spool in self._spools.items():
            path = self._path(kind)
            header = TiffHeader(
                self._rows.shape[:2],
                centres_of(bands, layer.centroids),
                describe_bands(bands, more[kind]),
                dtype=DTYPES[kind],
                rgb=rgb if kind == "values" else None,
                px_per_mm=facts.get("px_per_mm"),
                credits=layer.credits,
            )
            write_encoded_pages(path, spool.pages(), header)
            spool.drop()  # the next pages may need its space
            written.append(path)
        if (stale := self._path("sigma")) not in written and stale.is_file():
            remove(stale)
        return written


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
            header = TiffHeader(
                pages.shape[:2],
                centres_of(described.bands, centroids),
                describe_bands(described.bands, _with_sampling(described.facts, px_per_mm)),
                dtype=pages.dtype,
                rgb=pages.read_render(),
                px_per_mm=px_per_mm,
                credits=credits,
            )
            write_encoded_pages(path, pages.strips(), header)
        elif path.suffix == ".png":
            with Image.open(path) as image:
                text, pixels = image.info.get("Description", ""), np.asarray(image)
            write_preview(path, pixels, description=text, px_per_mm=px_per_mm)
        elif path.parts[-2:] == ("values", "zarr.json"):
            record = json.loads(path.read_bytes())
            record["attributes"] = _with_sampling(record["attributes"], px_per_mm)
            write_bytes(path, json.dumps(record, indent=2).encode())  # as zarr spells it


def _with_sampling(facts: Mapping[str, Any], px_per_mm: float | None) -> dict[str, Any]:
    """Return the attributes of a layer with another sampling, in the order of `Layer.attributes`."""
    first = {key: facts[key] for key in ("quantity", "object", "camera", "setup")}
    scale = {"px_per_mm": px_per_mm} if px_per_mm else {}
    return {**first, **scale, **{k: v for k, v in facts.items() if k not in {*first, "px_per_mm"}}}


def facts_of_values(layer: Layer, *, sigma: bool) -> dict[str, Any]:
    """Return what the values say of themselves beyond what flags and sigma say too."""
    step = layer.step_per_sigma
    return {**({SIGMA: True} if sigma else {}), **({} if isnan(step) else {STEP: step})}


def centres_of(bands: Sequence[Band], centroids: Mapping[str, float] | None = None) -> list[float]:
    """Return what tag 65000 holds: centres, else centroids of sensitivities; 0 … n−1 where one has neither.

    Examples
    --------
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


def describe_bands(bands: Sequence[Band], facts: dict[str, Any]) -> str:
    """Return tag 65111: a JSON object with the facts, the bands' labels, wavelengths and widths."""
    record = {
        **facts,
        "bands": [band.label for band in bands],
        "wavelength": [None if isnan(b.wavelength) else float(b.wavelength) for b in bands],
        "fwhm": [None if isnan(b.fwhm) else float(b.fwhm) for b in bands],
    }
    return json.dumps(record, ensure_ascii=False, allow_nan=False)


def rounded(cube: Cube) -> Cube:
    """Return the cube with sigma as it is stored."""
    if cube.sigma is None or is_rounded(cube.sigma, SIGMA_DROP):
        return cube
    return replace(cube, sigma=round_sigma(cube.sigma))
