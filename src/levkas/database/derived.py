"""Layers that are made from others: written into a database beside those that were measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.core.digests import hash_file
from levkas.core.files import write_json
from levkas.core.problems import Problem, closest_match
from levkas.database.catalogue import DatabaseRefused, read_catalogue, write_catalogue
from levkas.database.containment import check_plain_names
from levkas.database.layers import Layer, write_layer
from levkas.database.layout import MADE_OF, LayerId
from levkas.database.store import write_index

if TYPE_CHECKING:
    from levkas.core.cube import Cube, CubeRows


@dataclass(frozen=True)
class DerivedStep:
    """One object whose layer was written."""

    label: str
    done: int
    total: int
    files: tuple[Path, ...]
    finished: bool = True
    state: str = "done"

    @property
    def line(self) -> str:
        return f"{self.done}/{self.total} {self.label}"


def write_derived(
    root: Path,
    layer: Layer,
    rows: Cube | CubeRows,
    sources: Sequence[LayerId],
    record: Mapping[str, Any],
    *,
    verdict: str,
) -> tuple[Path, ...]:
    """Write a layer made from others, with the record of what it was made of, and list it; one of its name is replaced.

    The manifest is left to `database.manifest.write_manifest`, once for all layers.
    """
    entry, written = write_layer(root, layer, rows, verdict=verdict)
    path = root / f"{layer.id.path}{MADE_OF[layer.kind]}"
    hashes = {source.name: hash_file(root / f"{source.path}.tif") for source in sources}
    write_json(path, {"kind": layer.kind, **(layer.made_of or {}), "sources": hashes, **record})
    others = [e for e in read_catalogue(root) if e.layer != entry.layer]
    write_catalogue(root, [*others, entry])
    write_index((root / layer.id.group).parent)
    return (*written, path)


def check_new_layer(
    root: Path, layer: str, having: Sequence[str], objects: Sequence[str], *, kind: str, field: str
) -> None:
    """Refuse a name that a layer of another kind has, or that files cannot have, and objects that are not among those `having` the sources.

    `field` is the argument that names the layer. Raises DatabaseRefused.
    """
    try:
        check_plain_names(layer)
    except ValueError as error:
        raise DatabaseRefused(Problem("E_VALUE", str(error), field=field, found=layer)) from None
    if layer in {e.camera for e in read_catalogue(root) if e.kind != kind}:
        what = f"the database has another layer {layer!r}; one that is {kind} must not replace it"
        expected, fix = "a name that differs from all cameras", f"Name it {layer}-{kind}."
        raise DatabaseRefused(Problem("E_EXISTS", what, str(root), field, layer, expected, fix))
    if unknown := [name for name in objects if name not in having]:
        what, near = "this object lacks the layers", closest_match(unknown[0], having)
        facts = ("--object", unknown[0], ", ".join(having), near)
        raise DatabaseRefused(Problem("E_VALUE", what, str(root), *facts))
