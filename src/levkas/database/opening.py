"""The arrays of a layer, opened as labelled ones: from its Zarr group, else from its spectral TIFFs."""

from __future__ import annotations

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


def open_layer(root: Path, layer: LayerId, kind: str = "values") -> xarray.DataArray:
    """Open the ``"values"``, ``"flags"`` or ``"sigma"`` of a layer, lazily.

    Returns
    -------
    array : xarray.DataArray, (y, x, band)
        `x` and `y` are pixels of the grid; the coordinates `database` and `layer` say where the pixels come from,
        and are lost where pixels of several layers are joined. The encoding `source` goes with the values, and is
        lost where they are computed anew.

    Raises DatabaseRefused, TiffRefused.
    """
    group = root / layer.group
    if is_described(group):
        array = _from_zarr(group, kind, root)
    else:
        check_inside(root, tiff := root / (layer.path + KINDS[kind]))
        array = open_pixels(tiff)
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


_ROOTS: dict[str, Path] = {}
"""Databases by their paths as text: those on servers keep what was read of them."""


def has_sigma(root: Path, layer: LayerId) -> bool:
    """Whether the values of a layer state that they have a sigma, or something of one is there."""
    group, tiff = root / layer.group, root / (layer.path + KINDS["sigma"])
    if open_layer(root, layer).attrs.get(SIGMA):
        return True
    return is_described(group / "sigma") or tiff.is_file() or (group / "sigma").is_dir()


def _with_published_widths(array: xarray.DataArray, root: Path, layer: LayerId) -> xarray.DataArray:
    """Give channels without a width that of their sensitivity, where the database has it."""
    if is_remote(root) or not (root / "cameras" / layer.camera / "sensitivity.csv").is_file():
        return array
    stated = np.asarray(array.fwhm.values, float)
    if np.isfinite(stated).all():
        return array
    shapes = channel_shapes(root, layer.camera, [str(label) for label in array.band.values])
    widths = np.where(np.isfinite(stated), stated, [width for _, width in shapes])
    return array.assign_coords(fwhm=("band", widths, array.fwhm.attrs))


def _from_zarr(group: Path, kind: str, root: Path) -> xarray.DataArray:
    if not is_remote(group):
        check_inside(root, *group.glob("*/zarr.json"), *group.glob("*/c/0"))
    if not is_described(group / kind):
        raise _missing(group / kind, kind)
    pixels = ZarrArray(group / kind, root)
    labels, centres, widths = (ZarrArray(group / k, root) for k in ("band", "wavelength", "fwhm"))
    facts = {key: fact for key, fact in pixels.attributes.items() if key != "coordinates"}
    columns = (
        [str(label) for label in np.asarray(labels)],
        indexing.LazilyIndexedArray(centres),
        indexing.LazilyIndexedArray(widths),
    )
    return _labelled(pixels, columns, facts, kind)


def open_pixels(path: Path) -> xarray.DataArray:
    """Open one spectral TIFF, lazily, (y, x, band)."""
    if not path.is_file():
        raise _missing(path, path.name)
    pages = open_pages(path)
    described = describe_pages(pages)
    kind = described.quantity.split(" ")[0]
    name = kind if kind in KINDS else "values"
    bands = described.bands
    columns = [b.label for b in bands], [b.wavelength for b in bands], [b.fwhm for b in bands]
    return _labelled(TiffPixels(pages), columns, described.facts, name)


def _labelled(
    pixels: LazyArray, columns: tuple[Any, Any, Any], attributes: dict[str, Any], name: str
) -> xarray.DataArray:
    """Return pixels with the labels, centres and widths of their bands."""
    labels, centres, widths = columns
    if len(pixels.shape) != 3 or {len(c) for c in columns} != {pixels.shape[2]}:
        raise DatabaseRefused(
            Problem(
                "E_SIZE",
                f"the {name} and the layer differ in the number of bands",
                str(pixels.path),
                found=" x ".join(map(str, pixels.shape)),
                expected=f"rows, columns and {len(labels)} bands",
                fix="Copy the database again, or build it again.",
            )
        )
    height, width, _ = pixels.shape
    coordinates = {
        "y": ("y", np.arange(height), {"long_name": "row of the grid", "units": "1"}),
        "x": ("x", np.arange(width), {"long_name": "column of the grid", "units": "1"}),
        "band": labels,
        "wavelength": ("band", centres, WAVELENGTH),
        "fwhm": ("band", widths, {"long_name": "full width at half maximum", "units": "nm"}),
    }
    attributes = {**attributes, **_described(name, str(attributes.get("quantity", "")))}
    lazy = indexing.LazilyIndexedArray(pixels)
    return xarray.DataArray(lazy, coordinates, DIMENSIONS, name=name, attrs=attributes)


WAVELENGTH = {
    "standard_name": "sensor_band_central_radiation_wavelength",
    "long_name": "centre of the band",
    "units": "nm",
}
"""Attributes of the coordinate, by the CF conventions."""


UNITS = {"reflectance": "1", "counts": "count"}
"""Of values and their sigma, by their quantity."""


def _described(kind: str, quantity: str) -> dict[str, Any]:
    """Return units and meaning of values, flags or sigma, by the CF conventions."""
    if kind == "flags":
        return {"long_name": "what is wrong with a pixel", **flag_attributes()}
    known = UNITS.get(quantity.removeprefix("sigma of "))
    units = {"units": known} if known else {}
    if kind == "sigma":
        return {"long_name": "one standard deviation of the random part", **units}
    return {"long_name": quantity, "ancillary_variables": "flags sigma", **units} if known else {}


def _missing(path: Path, what: str) -> DatabaseRefused:
    return DatabaseRefused(
        Problem("E_UNREADABLE", f"the database has no {what}", str(path), fix="Build it again.")
    )
