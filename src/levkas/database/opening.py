"""The arrays of a layer, opened as labelled ones, lazily: from its Zarr group, else from its spectral TIFFs; never zeros for gaps."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import nullcontext
from functools import cached_property
from math import prod
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import xarray
from xarray.backends import BackendArray
from xarray.core import indexing

from levkas.core.problems import Problem, Refused
from levkas.core.text import read_json
from levkas.database.catalogue import DatabaseRefused
from levkas.database.described import channel_shapes, describe_pages
from levkas.database.layout import KINDS, SIGMA, LayerId
from levkas.database.manifest import check_inside
from levkas.database.remote import RemotePath, is_remote, place
from levkas.database.store import DIMENSIONS, flag_attributes
from levkas.database.tiff_pages import DAMAGE, TiffPages, open_pages

if TYPE_CHECKING:
    import zarr

WAVELENGTH = {
    "standard_name": "sensor_band_central_radiation_wavelength",
    "long_name": "centre of the band",
    "units": "nm",
}
"""Attributes of the coordinate, by the CF conventions."""
UNITS = {"reflectance": "1", "counts": "count"}
"""Of values and their sigma, by their quantity."""
MOST_SAMPLES = 1 << 26
"""Of a chunk, which is decoded as a whole."""
CODECS = frozenset(
    ["bytes", "vlen-utf8", "transpose", "blosc", "zstd", "gzip", "crc32c", "sharding_indexed"]
)
"""Of Zarr arrays that are read; Levkas writes five of them. Plug-ins of other packages may do anything."""
MOST_CODECS = 32
_ROOTS: dict[str, Path] = {}
"""Databases by their paths as text: those on servers keep what was read of them."""


def open_layer(root: Path, layer: LayerId, kind: str = "values") -> xarray.DataArray:
    """Open the ``"values"``, ``"flags"`` or ``"sigma"`` of a layer, (y, x, band), lazily.

    `x` and `y` are pixels of the grid; the coordinates `database` and `layer` say where the pixels come from, and are lost where
    several layers are joined; the encoding `source` is lost where values are computed. Raises DatabaseRefused, TiffRefused.
    """
    if _is_described(root / layer.group):
        array = _from_zarr(root, layer, kind)
    else:
        check_inside(root, tiff := root / (layer.path + KINDS[kind]))
        array = open_pixels(tiff)
    if not is_remote(root) and (root / "cameras" / layer.camera / "sensitivity.csv").is_file():
        # Channels without a width have that of their published sensitivity.
        stated = np.asarray(array.fwhm.values, float)
        shapes = channel_shapes(root, layer.camera, [str(label) for label in array.band.values])
        widths = np.where(np.isfinite(stated), stated, [width for _, width in shapes])
        array = array.assign_coords(fwhm=("band", widths, array.fwhm.attrs))
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
    return bool(open_layer(root, layer).attrs.get(SIGMA)) or tiff.is_file() or group.is_dir()


def _is_described(path: Path) -> bool:
    """Whether a folder is a group or an array of Zarr 3."""
    return (path / "zarr.json").is_file()


def _from_zarr(root: Path, layer: LayerId, kind: str) -> xarray.DataArray:
    group = root / layer.group
    if not _is_described(group / kind):
        raise _missing(group / kind, kind)
    pixels, labels, *numbers = (
        _ZarrArray(group / name, root) for name in (kind, "band", "wavelength", "fwhm")
    )
    facts = {key: fact for key, fact in pixels.attributes.items() if key != "coordinates"}
    names = [str(label) for label in np.asarray(labels)]
    centres, widths = (indexing.LazilyIndexedArray(one) for one in numbers)
    return _labelled(pixels, (names, centres, widths), facts, kind)


def open_pixels(path: Path) -> xarray.DataArray:
    """Open one spectral TIFF, lazily, (y, x, band)."""
    if not path.is_file():
        raise _missing(path, path.name)
    pages = open_pages(path)
    described = describe_pages(pages)
    kind, bands = described.quantity.split(" ")[0], described.bands
    columns = [b.label for b in bands], [b.wavelength for b in bands], [b.fwhm for b in bands]
    name = kind if kind in KINDS else "values"
    return _labelled(_TiffPixels(path, pages), columns, described.facts, name)


def _labelled(
    pixels: _LazyArray, columns: tuple[Sequence[str], Any, Any], facts: dict[str, Any], name: str
) -> xarray.DataArray:
    """Return pixels with the labels, centres and widths of their bands, described by the CF conventions."""
    labels, centres, widths = columns
    if len(pixels.shape) != 3 or {len(column) for column in columns} != {pixels.shape[2]}:
        what = f"the {name} and the layer differ in the number of bands"
        found, expected = " x ".join(map(str, pixels.shape)), f"{len(labels)} bands"
        fix = "Copy the database again."
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
    meanings = {
        "flags": {"long_name": "what is wrong with a pixel", **flag_attributes()},
        "sigma": {"long_name": "one standard deviation of the random part", **units},
    }
    of_values = {"long_name": quantity, "ancillary_variables": "flags sigma", **units}
    meaning = meanings.get(name, of_values if known else {})
    lazy = indexing.LazilyIndexedArray(pixels)
    return xarray.DataArray(lazy, coordinates, DIMENSIONS, name=name, attrs={**facts, **meaning})


class _LazyArray(BackendArray):
    """An array of one file or group, for `xarray.core.indexing.LazilyIndexedArray`."""

    path: Path
    shape: tuple[int, ...]
    dtype: np.dtype

    def __getitem__(self, key: indexing.ExplicitIndexer) -> Any:
        support = indexing.IndexingSupport.OUTER
        return indexing.explicit_indexing_adapter(key, self.shape, support, self._read)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        """Read the outer product of integers, slices of positive step and rising arrays."""
        raise NotImplementedError


class _TiffPixels(_LazyArray):
    """The band pages of a spectral TIFF; of each band only the strips that are needed are read."""

    def __init__(self, path: Path, pages: TiffPages | None = None) -> None:
        self._pages, self.path = pages or open_pages(path), path
        self.shape, self.dtype = self._pages.shape, self._pages.dtype

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path,)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        rows, columns, bands = (
            np.atleast_1d(np.arange(n)[k]) for n, k in zip(self.shape, key, strict=True)
        )
        start, stop = (int(rows[0]), int(rows[-1]) + 1) if len(rows) else (0, 0)
        block = self._pages.read(start, stop, bands.tolist())[np.ix_(rows - start, columns)]
        return block[tuple(0 if isinstance(k, int | np.integer) else slice(None) for k in key)]


class _ZarrArray(_LazyArray):
    """An array of a layer's group; raises DatabaseRefused where its description is damaged, or declares chunks that no memory holds."""

    def __init__(self, path: Path, root: Path) -> None:
        self.path, self._root = path, root
        check_inside(root, path / "zarr.json")
        facts = _read_description(path / "zarr.json")
        self.dtype, self.shape = facts["data_type"], tuple(facts["shape"])
        self.attributes = dict(facts.get("attributes", {}))

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.path, self._root)

    @cached_property
    def _array(self) -> zarr.Array[Any]:
        import zarr

        name = self.path.relative_to(self._root).as_posix()
        return zarr.open_array(_store(self._root), path=name, mode="r", zarr_format=3)

    def _read(self, key: tuple[Any, ...]) -> np.ndarray:
        try:
            return np.asarray(self._array.oindex[key])
        except DAMAGE as error:
            raise DatabaseRefused(_damaged(self.path, error)) from error


def _store(root: Path) -> Any:
    """Return the store of a database as Zarr reads it, but a shard that is missing is refused: Zarr takes it for one never written."""
    from zarr.storage import LocalStore, ObjectStore, WrapperStore

    remote = root.store if isinstance(root, RemotePath) else None

    class WholeStore(WrapperStore[Any]):
        async def get(self, key: str, prototype: Any, byte_range: Any = None) -> Any:
            check_inside(root, root / key)
            try:
                with remote.requesting(key) if remote else nullcontext():
                    found = await super().get(key, prototype, byte_range)
            except FileNotFoundError:
                found = None
            if found is None and not key.endswith("zarr.json"):
                what, fix = "a part of the layer is missing", "Build it again."
                raise DatabaseRefused(Problem("E_TRUNCATED", what, str(root / key), fix=fix))
            return found

    if remote:
        return WholeStore(ObjectStore(remote.objects, read_only=True))
    return WholeStore(LocalStore(root, read_only=True))


def _read_description(path: Path) -> dict[str, Any]:
    """Read zarr.json of an array; refuses chunks that no memory holds, and codecs and extensions that no list here has."""
    try:
        record = read_json(path)
        kind = record["data_type"]
        record["data_type"] = np.dtype(object if kind == "string" else str(kind))
        codecs = list(record["codecs"])
        for codec in codecs:  # those within shards are added as they are met
            if codec["name"] not in CODECS or len(codecs) > MOST_CODECS:
                raise ValueError(f"its codec {str(codec['name'])[:80]!r} is not accepted")
            facts = codec.get("configuration") or {}
            codecs += [*facts.get("codecs", ()), *facts.get("index_codecs", ())]
        if record["chunk_grid"]["name"] != "regular" or record.get("storage_transformers"):
            raise ValueError("its chunks lie in no regular grid, or behind a transformer")
        shape, grid = record["shape"], record["chunk_grid"]["configuration"]["chunk_shape"]
        outer = [codec.get("configuration") or {} for codec in record["codecs"]]
        chunks = [facts.get("chunk_shape", grid) for facts in outer]
        for sides in (shape, grid, *chunks):
            if len(sides) != len(shape) or any(type(n) is not int or n < 0 for n in sides):
                raise ValueError("a shape is not numbers of pixels")
        largest = max(prod(sides) for sides in (*chunks, shape if len(shape) < 2 else ()))
        if largest > MOST_SAMPLES:
            raise ValueError(f"a chunk of {largest} samples; at most {MOST_SAMPLES}")
    except Refused as refused:
        raise DatabaseRefused(*refused.problems) from None
    except DAMAGE as error:
        raise DatabaseRefused(_damaged(path, error)) from error
    return record


def _damaged(path: Path, error: BaseException) -> Problem:
    reason = " ".join(str(error).split())[:200] or type(error).__name__
    what, fix = f"a part of the layer is damaged: {reason}", "Copy the database again."
    return Problem("E_UNREADABLE", what, str(path), fix=fix)


def _missing(path: Path, what: str) -> DatabaseRefused:
    what, fix = f"the database has no {what}", "Build it again."
    return DatabaseRefused(Problem("E_UNREADABLE", what, str(path), fix=fix))
