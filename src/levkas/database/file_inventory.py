"""What was found of a database: its files, and what each TIFF turned out to hold."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.text import parse_bounded
from levkas.database.integrity import TiffFacts
from levkas.database.spectral_tiff import METADATA, decode_text

TWINS = {"values": ".tif", "flags": ".flags.tif", "sigma": ".sigma.tif"}
"""Arrays of a Zarr layer, and the endings of the files that hold the same numbers."""


@dataclass(frozen=True)
class Holdings:
    """Files of one database.

    Parameters
    ----------
    root : Path
    names : frozenset of str
        Of all files, relative to `root`, with ``/``.
    tiffs : mapping
        Name → facts of those that could be opened.
    unsound : frozenset of str
        Files that are already known to be damaged: nothing is concluded from them.
    """

    root: Path
    names: frozenset[str]
    tiffs: Mapping[str, TiffFacts]
    unsound: frozenset[str] = field(default=frozenset())

    def sound(self, name: str) -> TiffFacts | None:
        """Return the facts of a TIFF that is whole."""
        return None if name in self.unsound else self.tiffs.get(name)

    def layers(self) -> list[str]:
        """Return the Zarr groups of layers: ``zarr/OBJECT.zarr/LAYER``."""
        found = {tuple(name.split("/")[:3]) for name in self.names if name.count("/") > 2}
        return ["/".join(parts) for parts in sorted(found) if parts[0] == "zarr"]


def base_of(group: str) -> str:
    """Return the path of a Zarr layer's TIFFs without their endings.

    >>> base_of("zarr/icon1.zarr/d80@45-degree")
    'objects/icon1/icon1_d80_45-degree'
    """
    _, store, layer = group.split("/")
    name = store.removesuffix(".zarr")
    return f"objects/{name}/{'_'.join([name, *layer.split('@')])}"


def record_of(facts: TiffFacts | None) -> dict[str, Any]:
    """Return what a TIFF says of itself in tag 65111; {} where it says nothing of the kind."""
    try:
        record = parse_bounded(decode_text(str(facts.tags.get(METADATA, "")))) if facts else {}
    except ValueError:
        return {}
    return record if isinstance(record, dict) else {}


def same_numbers(one: Any, other: Any) -> bool:
    """Whether two lists of wavelengths, nm, are the same; what one does not say cannot differ.

    >>> same_numbers([400.0, None], (400.0, float("nan"))), same_numbers(None, [1.0])
    (True, True)
    """
    if one is None or other is None:
        return True
    a, b = (
        np.array([np.nan if v is None else v for v in np.atleast_1d(x)], float)
        for x in (one, other)
    )
    return a.shape == b.shape and bool(np.allclose(a, b, rtol=1e-5, equal_nan=True))
