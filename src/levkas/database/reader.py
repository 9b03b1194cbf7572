"""A database opened: objects, their layers as lazy labelled arrays, and the files beside them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import islice
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray
from xarray.core import indexing

from levkas.core.cube import Band, band_labels
from levkas.core.problems import Problem
from levkas.core.text import parse_bounded
from levkas.database.catalogue import NAME, DatabaseRefused, Entry, read_catalogue
from levkas.database.containment import check_inside, check_plain_names
from levkas.database.layout import KINDS, SIGMA, LayerId, layer_name
from levkas.database.lazy_array import LazyArray, TiffPixels, ZarrArray, is_described
from levkas.database.remote import is_remote, place
from levkas.database.spectral_tiff import METADATA, WAVELENGTHS, decode_text
from levkas.database.store import DIMENSIONS
from levkas.database.tiff_pages import TiffPages, open_pages

if TYPE_CHECKING:
    from levkas.database.components import Components, Method
    from levkas.database.pixel_frames import FrameMap


class Database(Mapping[str, "Object"]):
    """A published database, object by object.

    Parameters
    ----------
    path : path

    Attributes
    ----------
    path : Path
    catalogue : tuple of Entry
        Empty where the folder has none; the layers are then found by their files.

    Raises
    ------
    DatabaseRefused
        Where the folder holds no database.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = place(path)
        listed = (self.path / NAME).is_file()
        if not listed and not (self.path / "objects").is_dir():
            raise DatabaseRefused(
                Problem(
                    "E_UNREADABLE",
                    "no database was found here",
                    file=str(path),
                    expected=f"a folder with {NAME} and objects/",
                    fix="Give the folder or the address of a database, or build the campaign first.",
                )
            )
        self.catalogue: tuple[Entry, ...] = read_catalogue(self.path) if listed else ()

    def __getitem__(self, name: str) -> Object:
        layers = self._layers.get(name)
        if layers is None:
            raise KeyError(f"no object {name!r}; there are: {_first_of(self) or 'none'}")
        return Object(self.path, name, tuple(layers) or _layers_found(self.path, name))

    def __iter__(self) -> Iterator[str]:
        return iter(self._layers)

    def __len__(self) -> int:
        return len(self._layers)

    def __repr__(self) -> str:
        return f"<levkas database {self.path}: {_first_of(self) or 'empty'}>"

    @cached_property
    def _layers(self) -> dict[str, list[tuple[str, str]]]:
        """Camera and setup of every layer by object; no layers where there is no catalogue."""
        if not self.catalogue:
            folders = (self.path / "objects").iterdir()
            return {name: [] for name in sorted(p.name for p in folders if p.is_dir())}
        found: dict[str, list[tuple[str, str]]] = {}
        for entry in self.catalogue:
            found.setdefault(entry.object, []).append((entry.camera, entry.setup))
        return found


def _first_of(names: Collection[str], most: int = 100) -> str:
    """Return names in a line, and how many more there are.

    >>> _first_of(["a", "b", "c"], 2)
    'a, b and 1 more'
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return ", ".join(islice(names, most)) + more


@dataclass(frozen=True, repr=False)
class Object(Mapping[Any, "LayerArray"]):
    """One object: ``object["lctf-vis"]``, and under another setup ``object["d80", "45-degree"]``."""

    path: Path
    name: str
    layers: tuple[tuple[str, str], ...]

    def __getitem__(self, key: str | tuple[str, str]) -> LayerArray:
        return self._layer(key, "values")

    def __iter__(self) -> Iterator[Any]:
        return iter([(camera, setup) if setup else camera for camera, setup in self.layers])

    def __len__(self) -> int:
        return len(self.layers)

    def __repr__(self) -> str:
        layers = ", ".join(layer_name(*layer) for layer in self.layers)
        return f"<levkas object {self.name}: {layers or 'no layers'}>"

    def flags(self, camera: str, setup: str = "") -> LayerArray:
        """Return the flags of a layer, uint8 (y, x, band)."""
        return self._layer((camera, setup), "flags")

    def sigma(self, camera: str, setup: str = "") -> LayerArray | None:
        """Return sigma of a layer, float32 (y, x, band), or None where it is not known."""
        return self._layer((camera, setup), "values").sigma

    def position_sigma(
        self, camera: str, band: str | None = None, setup: str = ""
    ) -> xarray.DataArray | None:
        """Return how well the position of a band is known in every pixel of the grid, (y, x).

        Parameters
        ----------
        camera, setup : str
        band : str, optional
            The camera's reference channel without it.

        Returns
        -------
        sigma : xarray.DataArray, (y, x), float32, or None
            One standard deviation of either axis, reference px: nine of ten positions lie within
            2.146 of them. None where the method of registration does not know.
        """
        from levkas.database.pixel_frames import find_position_sigma

        values = find_position_sigma(self.path, self.name, camera, setup, band)
        if values is None:
            return None
        facts = {"units": "reference px", "long_name": "one standard deviation of the position"}
        places = {k: np.arange(n) for k, n in zip(("y", "x"), values.shape, strict=True)}
        return xarray.DataArray(values, places, ("y", "x"), "position_sigma", facts)

    def transform(self, source: str, target: str) -> FrameMap:
        """Return the map between two frames of pixels, as `levkas.database.pixel_frames.find_map` does."""
        from levkas.database.pixel_frames import find_map

        return find_map(self.path, self.name, source, target)

    def _layer(self, key: str | tuple[str, str], kind: str) -> LayerArray:
        camera, setup = (key, "") if isinstance(key, str) else key
        if (camera, setup) not in self.layers:
            there = ", ".join(layer_name(*layer) for layer in self.layers)
            raise KeyError(
                f"{self.name} has no layer {layer_name(camera, setup)!r}; it has: {there}"
            )
        return Origin(self.path, LayerId(self.name, camera, setup)).open(kind)


@dataclass(frozen=True)
class Origin:
    """Where a layer's array comes from, and what has been selected of it since."""

    path: Path
    layer: LayerId
    selections: tuple[tuple[str, dict[str, Any]], ...] = field(default=())

    @property
    def has_sigma(self) -> bool:
        """Whether the values state that they have a sigma, or something of one is there."""
        group, tiff = self.path / self.layer.group, self.path / (self.layer.path + KINDS["sigma"])
        if replace(self, selections=()).open("values").attrs.get(SIGMA):
            return True
        return is_described(group / "sigma") or tiff.is_file() or (group / "sigma").is_dir()

    def open(self, kind: str) -> LayerArray:
        """Open the values, flags or sigma of the layer, selected as the array was."""
        group = self.path / self.layer.group
        if is_described(group):
            array = _from_zarr(group, kind, self.path)
        else:
            check_inside(self.path, tiff := self.path / (self.layer.path + KINDS[kind]))
            array = open_pixels(tiff)
        array._origin = Origin(self.path, self.layer)
        for method, arguments in self.selections:
            array = getattr(array, method)(**arguments)
        return array


class LayerArray(xarray.DataArray):
    """A `xarray.DataArray` (y, x, band), read on request, with access to the files beside it.

    Coordinates ``x`` and ``y`` are pixels of the grid. `flags`, `sigma`, `transform` and `region` follow selections
    (`isel`, `sel`, ``[…]``), the latter two in pixels of the array, from its own corner; the result of
    arithmetic is an array like any other and has them no more.
    """

    __slots__ = ("_origin",)

    @property
    def flags(self) -> LayerArray:
        """The flags of these pixels, uint8: bits of `levkas.core.cube.Flag`."""
        return self._beside.open("flags")

    @property
    def sigma(self) -> LayerArray | None:
        """One standard deviation of these pixels' random part; None where it is not known.

        Raises DatabaseRefused or TiffRefused where the layer has one that is damaged or missing.
        """
        return self._beside.open("sigma") if self._beside.has_sigma else None

    def transform(self, source: str, target: str) -> FrameMap:
        """Return the map between two frames of pixels of the object; ``grid`` means the pixels of this array.

        Raises
        ------
        MappingRefused
            Where a frame is not there, its registration was refused, or the pixels of this array are not known to
            lie at even steps in the grid.
        """
        from levkas.database.pixel_frames import find_map, part_of

        place, part = self._beside, part_of(self)
        return find_map(place.path, place.layer.object, source, target, part=part)

    def region(
        self,
        polygon: Sequence[tuple[float, float]] | None = None,
        *,
        rectangle: tuple[float, float, float, float] | None = None,
        circle: tuple[float, float, float] | None = None,
        bins: int = 0,
    ) -> xarray.Dataset:
        """Return mean, standard deviation and number of sound pixels of a region, band by band.

        Parameters
        ----------
        polygon : sequence of (x, y), px
            Corners, in pixels of this array; a pixel belongs to it where its centre lies within.
        rectangle : (x0, y0, x1, y1), px
            From pixel to pixel, both included.
        circle : (x, y, radius), px
        bins : int
            Of a histogram of each band; 0: none.

        Returns
        -------
        statistics : xarray.Dataset
            As of `levkas.database.regions.region_statistics`.

        Raises
        ------
        RegionRefused
            ``E_REGION`` where the region is none, or no pixel lies within.
        """
        from levkas.database.regions import make_region, region_statistics

        region = make_region(polygon, rectangle, circle)
        layer, flags = (
            array if "band" in array.dims else array.expand_dims("band", -1)
            for array in (self, self.flags)
        )
        return region_statistics(layer, flags, region, bins=bins)

    def components(self, method: Method = "pca") -> Components:
        """Find the principal components (``"pca"``) or minimum-noise fractions (``"mnf"``) of these pixels.

        Noise is taken from `sigma` where that is known, as `levkas.database.components.find_components` has it.

        Raises
        ------
        ComponentsRefused
            ``E_SIZE`` with too few bands or sound pixels; ``E_VALUE`` where the noise of a band is nil, or there is no
            such method.
        """
        from levkas.database.components import find_components

        sigma = self.sigma if method == "mnf" else None
        return find_components(self, self.flags, sigma, method=method)

    def isel(self, *args: Any, **kwargs: Any) -> LayerArray:
        """Select by position, as xarray does."""
        return self._followed(super().isel(*args, **kwargs), "isel", args, kwargs)

    def sel(self, *args: Any, **kwargs: Any) -> LayerArray:
        """Select by label, as xarray does."""
        return self._followed(super().sel(*args, **kwargs), "sel", args, kwargs)

    @property
    def _beside(self) -> Origin:
        origin: Origin | None = getattr(self, "_origin", None)
        if origin is None:
            raise ValueError(  # an AttributeError would send xarray looking for a coordinate
                "this array was computed; take flags, sigma and transform of the layer as it was opened"
            )
        return origin

    def _followed(
        self, result: LayerArray, method: str, args: tuple[Any, ...], kwargs: dict[str, Any]
    ) -> LayerArray:
        origin: Origin | None = getattr(self, "_origin", None)
        if origin is not None and isinstance(result, LayerArray):
            arguments = {**({"indexers": args[0]} if args else {}), **kwargs}
            result._origin = replace(origin, selections=(*origin.selections, (method, arguments)))
        return result


def _from_zarr(group: Path, kind: str, root: Path) -> LayerArray:
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


@dataclass(frozen=True)
class Described:
    """What a layer's TIFF says of itself: its bands, and its other facts."""

    bands: tuple[Band, ...]
    facts: dict[str, Any]

    @property
    def quantity(self) -> str:
        """``"reflectance"``, ``"counts"``, ``"flags"`` …; ``"values"`` where it is not stated."""
        return str(self.facts.get("quantity", "values"))


def open_tiff(path: Path) -> Described:
    """Read what the spectral TIFF of a layer says of its bands; raises TiffRefused."""
    return describe_pages(open_pages(path))


def open_pixels(path: Path) -> LayerArray:
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


def describe_pages(pages: TiffPages) -> Described:
    """Return what the pages' tags say."""
    text = next((t for t in pages.tags(METADATA) if t), "")
    centres = next((t for t in pages.tags(WAVELENGTHS) if t is not None), None)
    record = _json(decode_text(str(text)))
    labels, widths = record.pop("bands", None), record.pop("fwhm", None) or [None] * len(pages)
    known = record.pop("wavelength", None)
    bad = record.get("bad_bands") or ()
    if not labels or len(labels) != len(pages):
        values = [centres] if isinstance(centres, float) else list(centres or range(len(pages)))
        labels, known = band_labels(values), values
    bands = [
        Band(str(label), nan if nm is None else nm, nan if width is None else width, label in bad)
        for label, nm, width in zip(labels, known, widths, strict=True)
    ]
    return Described(tuple(bands), record)


def _labelled(
    pixels: LazyArray, columns: tuple[Any, Any, Any], attributes: dict[str, Any], name: str
) -> LayerArray:
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
        "y": np.arange(height),
        "x": np.arange(width),
        "band": labels,
        "wavelength": ("band", centres, {"units": "nm"}),
        "fwhm": ("band", widths, {"units": "nm"}),
    }
    lazy = indexing.LazilyIndexedArray(pixels)
    return LayerArray(lazy, coordinates, DIMENSIONS, name=name, attrs=attributes)


def _layers_found(path: Path, name: str) -> tuple[tuple[str, str], ...]:
    """Find the layers of an object in a database without a catalogue, by its TIFFs."""
    found = []
    for tiff in sorted((path / "objects" / name).glob("*.tif")):
        if tiff.name.endswith((".flags.tif", ".sigma.tif")):
            continue
        check_inside(path, tiff)
        text = next((t for t in open_pages(tiff).tags(METADATA) if t), "")
        record = _json(decode_text(str(text)))
        camera = str(record.get("camera") or tiff.stem.removeprefix(f"{name}_"))
        setup = str(record.get("setup", ""))
        try:
            check_plain_names(camera, setup or "-")
        except ValueError as error:
            raise DatabaseRefused(
                Problem("E_VALUE", str(error), str(tiff), f"tag {METADATA}")
            ) from None
        found.append((camera, setup))
    return tuple(found)


def _json(text: str) -> dict[str, Any]:
    try:
        record = parse_bounded(text)
    except ValueError:
        return {"metadata": text} if text else {}
    return record if isinstance(record, dict) else {"metadata": text}


def _missing(path: Path, what: str) -> DatabaseRefused:
    return DatabaseRefused(
        Problem("E_UNREADABLE", f"the database has no {what}", str(path), fix="Build it again.")
    )
