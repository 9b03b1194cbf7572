"""A database opened: objects, their layers as lazy labelled arrays, and the files beside them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import xarray

from levkas.database.accessor import LayerAccessor
from levkas.database.catalogue import NAME, Entry, database_of, no_database, read_catalogue
from levkas.database.layout import LayerId, layer_name
from levkas.database.opening import open_layer

xarray.register_dataarray_accessor("levkas")(LayerAccessor)

OBJECT_CRS = (
    'ENGCRS["grid of the object",EDATUM["middle of its first pixel"],CS[Cartesian,2],'
    'AXIS["x",displayRight,ORDER[1]],AXIS["y",displayDown,ORDER[2]],LENGTHUNIT["millimetre",0.001]]'
)
"""Of places on an object, mm, as OGC's well-known text (ISO 19162) spells a local system."""


class Database(Mapping[str, "Object"]):
    """A published database at `path`, object by object, as its `catalogue` lists it.

    Raises DatabaseRefused where there is none.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = database_of(path)
        if not (self.path / NAME).is_file():
            raise no_database(self.path, f"a folder with {NAME}")
        self.catalogue: tuple[Entry, ...] = read_catalogue(self.path)
        self._layers: dict[str, list[tuple[str, str]]] = {}
        for entry in self.catalogue:
            self._layers.setdefault(entry.object, []).append((entry.camera, entry.setup))

    def __getitem__(self, name: str) -> Object:
        if name not in self._layers:
            raise KeyError(f"no object {name!r}; there are: {self._first()}")
        return Object(self.path, name, tuple(self._layers[name]))

    def __iter__(self) -> Iterator[str]:
        return iter(self._layers)

    def __len__(self) -> int:
        return len(self._layers)

    def _ipython_key_completions_(self) -> list[str]:
        return list(self)

    def __repr__(self) -> str:
        return f"<levkas database {self.path}: {self._first()}>"

    def _first(self, most: int = 100) -> str:
        more = f" and {len(self) - most} more" if len(self) > most else ""
        return (", ".join(islice(self, most)) or "empty") + more


@dataclass(frozen=True, repr=False)
class Object(Mapping[Any, xarray.DataArray]):
    """One object: ``object["lctf-vis"]``, and under another setup ``object["d80", "45-degree"]``."""

    path: Path
    name: str
    layers: tuple[tuple[str, str], ...]

    def __getitem__(self, key: str | tuple[str, str]) -> xarray.DataArray:
        return open_layer(self.path, self._layer(key))

    def __iter__(self) -> Iterator[Any]:
        return iter([(camera, setup) if setup else camera for camera, setup in self.layers])

    def __len__(self) -> int:
        return len(self.layers)

    def _ipython_key_completions_(self) -> list[Any]:
        return list(self)

    def __repr__(self) -> str:
        layers = ", ".join(layer_name(*one) for one in self.layers)
        return f"<levkas object {self.name}: {layers or 'no layers'}>"

    def dataset(self, camera: str, setup: str = "") -> xarray.Dataset:
        """Return a layer as one `xarray.Dataset`, lazily: ``values``, ``flags`` and, where it is known, ``sigma``.

        Attributes are those of the CF conventions; where the sampling is known, ``x_mm`` and ``y_mm`` are places on the object in the
        coordinate system that the grid mapping ``grid`` describes.
        """
        values = self[camera, setup]
        parts = {"values": values, "flags": values.levkas.flags, "sigma": values.levkas.sigma}
        known = {name: part for name, part in parts.items() if part is not None}
        facts = {"Conventions": "CF-1.11", "title": f"{self.name}, {values.name}"}
        made = xarray.Dataset(known, attrs=facts)
        if scale := values.attrs.get("px_per_mm"):
            about = {"units": "mm", "long_name": "place on the object"}
            columns = {f"{axis}_mm": (axis, made[axis].values / scale, about) for axis in "xy"}
            made = made.assign_coords(columns)
            made["grid"] = ((), 0, {"crs_wkt": OBJECT_CRS})
            for name in known:
                made[name].attrs["grid_mapping"] = "grid: x_mm y_mm"
        return made

    def position_sigma(
        self, camera: str, band: str | None = None, setup: str = ""
    ) -> xarray.DataArray | None:
        """Return how well the position of a band (default: the camera's reference channel) is known in every pixel of the grid, (y, x).

        One standard deviation of either axis, reference px, float32: nine of ten positions lie within 2.146 of them. None
        where the method of registration does not know.
        """
        from levkas.database.pixel_frames import find_position_sigma

        values = find_position_sigma(self.path, self.name, camera, setup, band)
        if values is None:
            return None
        facts = {"units": "reference px", "long_name": "one standard deviation of the position"}
        places = {k: np.arange(n) for k, n in zip(("y", "x"), values.shape, strict=True)}
        return xarray.DataArray(values, places, ("y", "x"), "position_sigma", facts)

    def _layer(self, key: str | tuple[str, str]) -> LayerId:
        layer = LayerId(self.name, *((key,) if isinstance(key, str) else key))
        if (layer.camera, layer.setup) not in self.layers:
            there = ", ".join(layer_name(*one) for one in self.layers)
            raise KeyError(f"{self.name} has no layer {layer.name!r}; it has: {there}")
        return layer
