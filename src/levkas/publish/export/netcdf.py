"""netCDF-4 with CF attributes: values, flags and sigma of a layer in one file, upright in GDAL and QGIS."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.files import replacing
from levkas.publish.export.layer import ExportLayer, missing_library

DIMENSIONS = ("band", "y", "x")
"""In the order of CF, which all readers know."""


def write_netcdf(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write STEM.nc, a band at a time: dims band, y, x; y and x in mm where the sampling is known.

    As of the world files for QGIS, y points up and the centre of the top left pixel is at (0, 0): GDAL turns pictures whose
    y grows with the row. The coordinate ``band`` is a number, for GDAL passes over names: the wavelength where all bands have
    one, else 1 … n, with the labels as `flag_meanings`. The labels are in ``label``.

    Raises
    ------
    ExportRefused
        Where h5netcdf or h5py is not installed (extra ``export``).
    """
    from levkas.database.store import flag_attributes

    try:
        import h5netcdf
        import h5py  # noqa: F401 -- h5netcdf needs it when it opens a file
    except ImportError as error:
        raise missing_library(str(error.name)) from None
    attributes: dict[str, dict[str, Any]] = {
        "values": {"long_name": layer.quantity},
        "flags": {**flag_attributes()},
        "sigma": {"long_name": "one standard deviation of the random part"},
    }
    path = folder / f"{layer.stem}.nc"
    height, width, count = layer.shape
    with replacing(path) as handle, h5netcdf.File(handle, "w") as dataset:
        dataset.dimensions = dict(zip(DIMENSIONS, (count, height, width), strict=True))
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
            none = None if kind == "flags" else np.nan
            dtype = np.uint8 if kind == "flags" else np.float32
            variable = dataset.create_variable(kind, DIMENSIONS, dtype, fillvalue=none)
            variable.attrs.update({**attributes[kind], "coordinates": "wavelength fwhm label"})
            for k, plane in enumerate(layer.planes(kind)):
                variable[k] = plane
    return [path]


def _write_coordinates(dataset: Any, layer: ExportLayer) -> None:
    height, width, count = layer.shape
    unit = "mm" if layer.px_per_mm else "px"
    step = 1 / (layer.px_per_mm or 1.0)
    band: dict[str, Any] = {"units": "nm", "standard_name": "radiation_wavelength"}
    if not layer.wavelengths:
        names = " ".join("_".join(label.split()) for label in layer.labels)
        band = {"long_name": "number of the band", "flag_meanings": names}
        band["flag_values"] = np.arange(1.0, count + 1)
    columns: dict[str, tuple[str, Any, dict[str, Any]]] = {
        "y": (
            "y",
            np.arange(0, -height, -1) * step,
            {"units": unit, "long_name": "up", "axis": "Y"},
        ),
        "x": ("x", np.arange(width) * step, {"units": unit, "long_name": "right", "axis": "X"}),
        "band": ("band", layer.wavelengths or np.arange(1.0, count + 1), band),
        "wavelength": ("band", [b.wavelength for b in layer.bands], {"units": "nm"}),
        "fwhm": ("band", [b.fwhm for b in layer.bands], {"units": "nm"}),
    }
    for name, (dimension, numbers, attributes) in columns.items():
        variable = dataset.create_variable(name, (dimension,), np.float64, data=np.asarray(numbers))
        variable.attrs.update(attributes)
    import h5py

    labels = np.array(layer.labels, dtype=object)
    dataset.create_variable("label", ("band",), h5py.string_dtype(), data=labels)
