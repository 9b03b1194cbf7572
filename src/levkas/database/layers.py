"""Writing the files of one layer together: spectral TIFF, flags, sigma, preview, Zarr."""

from __future__ import annotations

import json
from dataclasses import dataclass, field, replace
from math import isnan, nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.colour.srgb import preview
from levkas.core.digests import hash_file
from levkas.core.files import remove, together
from levkas.core.rounding import SIGMA_DROP, is_rounded, round_sigma
from levkas.database.catalogue import ESTIMATED, MEASURED, Entry
from levkas.database.credits import Credits
from levkas.database.layout import SIGMA, LayerId, layer_name
from levkas.database.preview import write_preview
from levkas.database.spectral_tiff import TiffHeader, planes_of, write_spectral_tiff
from levkas.database.store import write_layer_store

if TYPE_CHECKING:
    from collections.abc import Callable, Mapping, Sequence

    from levkas.core.cube import Band, Cube


@dataclass(frozen=True)
class Layer:
    """What a layer's files say about it beside its pixels.

    Parameters
    ----------
    object, camera, setup : str
        `setup` is empty for the default one.
    px_per_mm : float
        NaN where the sampling is not known.
    credits : Credits
    centroids : mapping of label to float, nm
        Of the sensitivities of channels without a centre wavelength, for tag 65000.
    estimate : mapping, optional
        Of a layer that was estimated from others: its method, layers and training objects.
    """

    object: str
    camera: str
    setup: str = ""
    px_per_mm: float = nan
    credits: Credits = field(default_factory=Credits)
    centroids: Mapping[str, float] = field(default_factory=dict)
    estimate: Mapping[str, Any] | None = None

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
            "kind": ESTIMATED if self.estimate is not None else None,
            "estimate": self.estimate,
            "bad_bands": [band.label for band in bands if band.bad] or None,
        }
        return {key: value for key, value in facts.items() if value is not None}


def write_layer(
    database: str | Path,
    layer: Layer,
    cube: Cube,
    *,
    verdict: str = "accept",
    encoded: bool = False,
    zarr: bool = True,
    threads: int | None = None,
    before: Callable[[], object] | None = None,
) -> tuple[Entry, tuple[Path, ...]]:
    """Write all files of one registered layer.

    Parameters
    ----------
    database : path
    layer : Layer
    cube : Cube
        On the grid.
    verdict : str
        For the catalogue.
    encoded : bool
        Whether the values are encoded as sRGB, for the picture.
    zarr : bool
        Whether the Zarr layer is written too.
    threads : int, optional
        For compression; the bytes are the same for any number.
    before : callable, optional
        As of `levkas.core.files.together`.

    Returns
    -------
    entry : Entry
        The row of the catalogue.
    files : tuple of Path
        All that was written, files only.

    Raises
    ------
    WriteRefused
        Where the disk refuses; all files are then the old ones, unless it refuses a name.
    """
    database = Path(database)
    picture, description = preview(cube, encoded=encoded)
    cube = rounded(cube)
    base = database / "objects" / layer.object / layer.stem
    png = base.with_name(base.name + ".png")
    root = database / "zarr" / f"{layer.object}.zarr"
    scale = None if isnan(layer.px_per_mm) else layer.px_per_mm
    with together(before):
        written = write_tiffs(
            base, layer, cube, rgb=picture, rendering=description, threads=threads
        )
        write_preview(png, picture, description=description, px_per_mm=scale)
        written.append(png)
        if zarr:
            write_layer_store(
                root, layer.name, cube, attributes=layer.attributes(cube.quantity, cube.bands)
            )
    if zarr:
        written += sorted(p for p in (root / layer.name).rglob("*") if p.is_file())
    height, width, count = cube.values.shape
    entry = entry_of_layer(layer, (height, width, count), cube.quantity, verdict, written[0])
    return entry, tuple(written)


def entry_of_layer(
    layer: Layer, shape: tuple[int, int, int], quantity: str, verdict: str, tiff: Path
) -> Entry:
    """Return the layer's row of the catalogue."""
    height, width, count = shape
    return Entry(
        *(layer.object, layer.camera, layer.setup, count, width, height, layer.px_per_mm),
        *(quantity, verdict, hash_file(tiff), MEASURED if layer.estimate is None else ESTIMATED),
    )


def write_tiffs(
    base: Path,
    layer: Layer,
    cube: Cube,
    *,
    rgb: np.ndarray | None = None,
    rendering: str = "",
    threads: int | None = None,
) -> list[Path]:
    """Write `base`.tif, .flags.tif and, where the noise is known, .sigma.tif; raises WriteRefused.

    An older .sigma.tif goes where the noise is not known any more.
    Also for the native files of single sensors.
    """
    facts = layer.attributes(cube.quantity, cube.bands)
    of_values = facts_of_values(facts, rendering, sigma=cube.sigma is not None)
    parts: list[tuple[str, np.ndarray, dict[str, Any]]] = [
        (".tif", cube.values, of_values),
        (".flags.tif", cube.flags, {**facts, "quantity": "flags"}),
    ]
    if cube.sigma is not None:
        parts.append((".sigma.tif", cube.sigma, {**facts, "quantity": f"sigma of {cube.quantity}"}))
    elif (stale := base.with_name(base.name + ".sigma.tif")).is_file():
        remove(stale)
    written = []
    for suffix, values, more in parts:
        path = base.with_name(base.name + suffix)
        header = TiffHeader(
            (values.shape[0], values.shape[1]),
            centres_of(cube.bands, layer.centroids),
            describe_bands(cube.bands, more),
            dtype=values.dtype,
            rgb=rgb if suffix == ".tif" else None,
            px_per_mm=facts.get("px_per_mm"),
            credits=layer.credits,
        )
        write_spectral_tiff(path, planes_of(values), header, threads=threads)
        written.append(path)
    return written


def facts_of_values(facts: dict[str, Any], rendering: str, *, sigma: bool) -> dict[str, Any]:
    """Return what the values say of themselves beyond what flags and sigma say too."""
    more: dict[str, Any] = {"rendering": rendering} if rendering else {}
    return {**facts, **more, **({SIGMA: True} if sigma else {})}


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
