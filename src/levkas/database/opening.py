"""The arrays of a layer, opened as labelled ones: from its Zarr group, else from its spectral TIFFs."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import xarray
from xarray.core import indexing

from levkas.core.problems import Problem
from levkas.database.catalogue import DatabaseRefused
from levkas.database.containment import check_inside
from levkas.database.described import channel_shapes, describe_pages
from levkas.database.layout import KINDS, SIGMA, LayerId
from levkas.database.lazy_array import LazyArray, TiffPixels, ZarrArray, is_described
from levkas.database.remote import is_remote, place
from levkas.database.store import DIMENSIONS, flag_attributes
from levkas.database.tiff_pages import open_pages

WAVELENGTH = {
    "standard_name": "sensor_band_central_radiation_wavelength",
    "long_name": "centre of the band",
    "units": "nm",
}
"""Attributes of the coordinate, by the CF conventions."""
UNITS = {"reflectance": "1", "counts": "count"}
"""Of values and their sigma, by their quantity."""
_ROOTS: dict[str, Path] = {}
"""Databases by their paths as text: those on servers keep what was read of them."""


def open_layer(root: Path, layer: LayerId, kind: str = "values") -> xarray.DataArray:
    """Open the ``"values"``, ``"flags"`` or ``"sigma"`` of a layer, (y, x, band), lazily.

    `x` and `y` are pixels of the grid; the coordinates `database` and `layer` say where the pixels come from,
    and are lost where pixels of several layers are joined. The encoding `source` goes with the values, and is
    lost where they are computed anew. Raises DatabaseRefused, TiffRefused.
    """
    if is_described(root / layer.group):
        array = _from_zarr(root, layer, kind)
    else:
        check_inside(root, tiff := root / (layer.path + KINDS[kind]))
        array = open_pixels(tiff)
    if not is_remote(root) and (root / "cameras" / layer.camera / "sensitivity.csv").is_file():
        array = _with_published_widths(array, root, layer)
    text = str(root)
    _ROOTS[text] = root
    array.encoding["source"] = f"{text}/{layer.object}/{layer.name}"
    return array.assign_coords(database=text, layer=f"{layer.object}/{layer.name}")


def place_of(array: xarray.DataArray) -> tuple[Path, LayerId] | None:
    """Return database and layer that an array's pixels come from; None where that is lost or there are several."""
    known = [array.coords[name] for name in ("database", "layer") if name in array.coords]
    if len(known) < 2 or any(one.dims for one in known):
        return None
    root, layer = (str(one.values) for one in known)
    return _ROOTS.get(root) or place(root), LayerId.parse(*layer.split("/", 1))


def has_sigma(root: Path, layer: LayerId) -> bool:
    """Whether the values of a layer state that they have a sigma, or something of one is there."""
    group, tiff = root / layer.group / "sigma", root / (layer.path + KINDS["sigma"])
    stated = bool(open_layer(root, layer).attrs.get(SIGMA))
    return stated or is_described(group) or tiff.is_file() or group.is_dir()


def _with_published_widths(array: xarray.DataArray, root: Path, layer: LayerId) -> xarray.DataArray:
    """Give channels without a width that of their published sensitivity."""
    stated = np.asarray(array.fwhm.values, float)
    shapes = channel_shapes(root, layer.camera, [str(label) for label in array.band.values])
    widths = np.where(np.isfinite(stated), stated, [width for _, width in shapes])
    return array.assign_coords(fwhm=("band", widths, array.fwhm.attrs))


def _from_zarr(root: Path, layer: LayerId, kind: str) -> xarray.DataArray:
    group = root / layer.group
    if not is_described(group / kind):
        raise _missing(group / kind, kind)
    pixels, labels, *numbers = (
        ZarrArray(group / name, root) for name in (kind, "band", "wavelength", "fwhm")
    )
    facts = {key: fact for key, fact in pixels.attributes.items() if key != "coordinates"}
    names = [str(label) for label in np.asarray(labels)]
    centres, widths = (indexing.LazilyIndexedArray(one) for one in numbers)
    return _labelled(pixels, names, centres, widths, facts, kind)


def open_pixels(path: Path) -> xarray.DataArray:
    """Open one spectral TIFF, lazily, (y, x, band)."""
    if not path.is_file():
        raise _missing(path, path.name)
    pages = open_pages(path)
    described = describe_pages(pages)
    kind = described.quantity.split(" ")[0]
    columns = zip(*((b.label, b.wavelength, b.fwhm) for b in described.bands), strict=True)
    labels, centres, widths = (list(column) for column in columns)
    name = kind if kind in KINDS else "values"
    return _labelled(TiffPixels(pages), labels, centres, widths, described.facts, name)


def _labelled(
    pixels: LazyArray,
    labels: Sequence[str],
    centres: Any,
    widths: Any,
    facts: dict[str, Any],
    name: str,
) -> xarray.DataArray:
    """Return pixels with the labels, centres and widths of their bands, described by the CF conventions."""
    if len(pixels.shape) != 3 or {len(c) for c in (labels, centres, widths)} != {pixels.shape[2]}:
        what = f"the {name} and the layer differ in the number of bands"
        found = " x ".join(map(str, pixels.shape))
        expected, fix = f"rows, columns and {len(labels)} bands", "Copy the database again."
        raise DatabaseRefused(Problem("E_SIZE", what, str(pixels.path), None, found, expected, fix))
    height, width, _ = pixels.shape
    coordinates = {
        "y": ("y", np.arange(height), {"long_name": "row of the grid", "units": "1"}),
        "x": ("x", np.arange(width), {"long_name": "column of the grid", "units": "1"}),
        "band": labels,
        "wavelength": ("band", centres, WAVELENGTH),
        "fwhm": ("band", widths, {"long_name": "full width at half maximum", "units": "nm"}),
    }
    quantity = str(facts.get("quantity", ""))
    known = UNITS.get(quantity.removeprefix("sigma of "))
    units = {"units": known} if known else {}
    if name == "flags":
        meaning = {"long_name": "what is wrong with a pixel", **flag_attributes()}
    elif name == "sigma":
        meaning = {"long_name": "one standard deviation of the random part", **units}
    else:
        beside = {"long_name": quantity, "ancillary_variables": "flags sigma", **units}
        meaning = beside if known else {}
    lazy = indexing.LazilyIndexedArray(pixels)
    return xarray.DataArray(lazy, coordinates, DIMENSIONS, name=name, attrs={**facts, **meaning})


def _missing(path: Path, what: str) -> DatabaseRefused:
    what, fix = f"the database has no {what}", "Build it again."
    return DatabaseRefused(Problem("E_UNREADABLE", what, str(path), fix=fix))
