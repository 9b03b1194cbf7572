"""NetCDF (classic, 64-bit offsets) with CF attributes: values, flags and sigma of a layer in one file.

The header says how long everything is, so that cubes follow a few rows at a time.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.files import replacing
from levkas.export.layer import ExportLayer

MOST_BYTES = 4_000_000_000
"""Of a variable, in classic NetCDF."""
MAGIC = b"CDF\x02"
DIMENSION, VARIABLE, ATTRIBUTE = 0x0A, 0x0B, 0x0C
TYPES = {"S1": 2, ">i2": 3, ">i4": 4, ">f4": 5, ">f8": 6}
"""numpy's names of the format's types, and its numbers for them."""
BLOCK_BYTES = 1 << 26


@dataclass(frozen=True)
class Variable:
    """One variable: its dimensions by name, its type, and what yields its bytes in order."""

    name: str
    dimensions: tuple[str, ...]
    kind: str
    blocks: Callable[[], Iterator[np.ndarray]]
    attributes: dict[str, Any] = field(default_factory=dict)


def write_netcdf(layer: ExportLayer, folder: Path) -> list[Path]:
    """Write STEM.nc, some rows at a time: dims y, x, band; y and x in mm where the sampling is known.

    Raises
    ------
    ExportRefused
        Beyond 4 GB.
    """
    layer.limit_bytes(MOST_BYTES, "NetCDF", "envi")
    path = folder / f"{layer.stem}.nc"
    height, width, count = layer.shape
    labels = np.array([label.encode() for label in layer.labels])
    text = labels.view("S1").reshape(count, -1)
    sizes = {"y": height, "x": width, "band": count, "letter": text.shape[1]}
    facts = {k: v for k, v in layer.facts.items() if isinstance(v, str | float | int) and v != ""}
    variables = [*_coordinates(layer, text), *_cubes(layer)]
    header, padding = encode_header(sizes, {"Conventions": "CF-1.8", **facts}, variables)
    with replacing(path) as handle:
        handle.write(header)
        for variable, pad in zip(variables, padding, strict=True):
            for block in variable.blocks():
                handle.write(np.ascontiguousarray(block, variable.kind).data)
            handle.write(bytes(pad))
    return [path]


def encode_header(
    sizes: dict[str, int], attributes: dict[str, Any], variables: list[Variable]
) -> tuple[bytes, list[int]]:
    """Return the header, and how many bytes of nothing follow each variable.

    Examples
    --------
    >>> one = Variable("v", ("x",), ">i2", lambda: iter(()))
    >>> header, padding = encode_header({"x": 3}, {}, [one])
    >>> len(header), padding
    (84, [2])
    """
    lengths = [
        int(np.prod([sizes[d] for d in v.dimensions], dtype=object)) * np.dtype(v.kind).itemsize
        for v in variables
    ]
    padding = [-length % 4 for length in lengths]
    dimensions = [_name(name) + struct.pack(">I", size) for name, size in sizes.items()]
    start = MAGIC + bytes(4) + _listed(DIMENSION, dimensions) + _attributes(attributes)
    numbers = {name: i for i, name in enumerate(sizes)}

    def told(begins: list[int]) -> bytes:
        parts = []
        for v, length, pad, begin in zip(variables, lengths, padding, begins, strict=True):
            places = [numbers[d] for d in v.dimensions]
            shape = struct.pack(f">{1 + len(places)}I", len(places), *places)
            tail = struct.pack(">IIQ", TYPES[v.kind], min(length + pad, 2**32 - 1), begin)
            parts.append(_name(v.name) + shape + _attributes(v.attributes) + tail)
        return start + _listed(VARIABLE, parts)

    begins = [len(told([0] * len(variables)))]
    for length, pad in zip(lengths[:-1], padding[:-1], strict=True):
        begins.append(begins[-1] + length + pad)
    return told(begins), padding


def _coordinates(layer: ExportLayer, text: np.ndarray) -> list[Variable]:
    height, width, _ = layer.shape
    unit = "mm" if layer.px_per_mm else "px"
    step = 1 / (layer.px_per_mm or 1.0)
    down, across = (
        {"units": unit, "long_name": "down"},
        {"units": unit, "long_name": "to the right"},
    )
    columns = {
        "wavelength": [b.wavelength for b in layer.bands],
        "fwhm": [b.fwhm for b in layer.bands],
    }
    return [
        Variable("y", ("y",), ">f8", partial(_once, np.arange(height) * step), down),
        Variable("x", ("x",), ">f8", partial(_once, np.arange(width) * step), across),
        Variable("band", ("band", "letter"), "S1", partial(_once, text)),
        *(
            Variable(name, ("band",), ">f8", partial(_once, numbers), {"units": "nm"})
            for name, numbers in columns.items()
        ),
    ]


def _once(values: Any) -> Iterator[np.ndarray]:
    yield np.asarray(values)


def _cubes(layer: ExportLayer) -> list[Variable]:
    from levkas.database.store import DIMENSIONS, flag_attributes

    told: dict[str, dict[str, Any]] = {
        "values": {"long_name": layer.quantity},
        # Classic NetCDF has no unsigned bytes.
        "flags": {
            k: np.array(v, ">i2") if k == "flag_masks" else v for k, v in flag_attributes().items()
        },
        "sigma": {"long_name": "one standard deviation of the random part"},
    }
    more = {"coordinates": "wavelength fwhm"}
    return [
        Variable(
            kind,
            DIMENSIONS,
            ">i2" if kind == "flags" else ">f4",
            partial(layer.rows, kind, BLOCK_BYTES),
            {**told[kind], **more},
        )
        for kind in layer.kinds
    ]


def _name(text: str) -> bytes:
    data = text.encode()
    return struct.pack(">I", len(data)) + data + bytes(-len(data) % 4)


def _listed(tag: int, parts: list[bytes]) -> bytes:
    return struct.pack(">II", tag if parts else 0, len(parts)) + b"".join(parts)


def _attributes(attributes: dict[str, Any]) -> bytes:
    parts = []
    for name, value in attributes.items():
        kind, data = _value(value)
        count = len(data) // np.dtype(kind).itemsize
        head = struct.pack(">II", TYPES[kind], count)
        parts.append(_name(name) + head + data + bytes(-len(data) % 4))
    return _listed(ATTRIBUTE, parts)


def _value(value: Any) -> tuple[str, bytes]:
    """Type and bytes of an attribute."""
    if isinstance(value, str):
        return "S1", value.encode()
    if isinstance(value, np.ndarray):
        return ">i2", value.astype(">i2").tobytes()
    kind = ">i4" if isinstance(value, int) else ">f8"
    return kind, np.array(value, kind).tobytes()
