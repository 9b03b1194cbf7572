"""netCDF-4 with CF attributes: values, flags and sigma of a layer in one file."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.files import replacing
from levkas.publish.export.layer import ExportLayer, missing_library

BLOCK_BYTES = 1 << 26


def write_netcdf(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write STEM.nc, some rows at a time: dims y, x, band; y and x in mm where the sampling is known.

    Raises
    ------
    ExportRefused
        Where h5netcdf is not installed (extra ``export``).
    """
    from levkas.database.store import DIMENSIONS, flag_attributes

    try:
        import h5netcdf
    except ImportError:
        raise missing_library("h5netcdf") from None
    attributes: dict[str, dict[str, Any]] = {
        "values": {"long_name": layer.quantity},
        "flags": {**flag_attributes()},
        "sigma": {"long_name": "one standard deviation of the random part"},
    }
    path = folder / f"{layer.stem}.nc"
    with replacing(path) as handle, h5netcdf.File(handle, "w") as dataset:
        dataset.dimensions = dict(zip(DIMENSIONS, layer.shape, strict=True))
        facts = {
            k: v
            for k, v in layer.facts.items()
            if isinstance(v, str | float | int) and not isinstance(v, bool)
        }
        dataset.attrs.update(
            {"Conventions": "CF-1.8", **{k: v for k, v in facts.items() if v != ""}}
        )
        _write_coordinates(dataset, layer)
        for kind in layer.kinds:
            _write_cube(dataset, layer, kind, attributes[kind])
    return [path]


def _write_coordinates(dataset: Any, layer: ExportLayer) -> None:
    height, width, _ = layer.shape
    unit = "mm" if layer.px_per_mm else "px"
    step = 1 / (layer.px_per_mm or 1.0)
    columns: dict[str, tuple[str, Any, dict[str, str]]] = {
        "y": ("y", np.arange(height) * step, {"units": unit, "long_name": "down"}),
        "x": ("x", np.arange(width) * step, {"units": unit, "long_name": "to the right"}),
        "wavelength": ("band", [b.wavelength for b in layer.bands], {"units": "nm"}),
        "fwhm": ("band", [b.fwhm for b in layer.bands], {"units": "nm"}),
    }
    for name, (dimension, numbers, attributes) in columns.items():
        variable = dataset.create_variable(name, (dimension,), np.float64, data=np.asarray(numbers))
        variable.attrs.update(attributes)
    import h5py

    labels = np.array(layer.labels, dtype=object)
    dataset.create_variable("band", ("band",), h5py.string_dtype(), data=labels)


def _write_cube(dataset: Any, layer: ExportLayer, kind: str, attributes: dict[str, Any]) -> None:
    from levkas.database.store import DIMENSIONS

    dtype = np.uint8 if kind == "flags" else np.float32
    variable = dataset.create_variable(kind, DIMENSIONS, dtype)
    variable.attrs.update({**attributes, "coordinates": "wavelength fwhm"})
    start = 0
    for rows in layer.rows(kind, BLOCK_BYTES):
        variable[start : start + len(rows)] = rows
        start += len(rows)
