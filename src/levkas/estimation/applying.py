"""Estimated spectral layers: a stored model applied to the paintings of a database.

An estimated layer has kind ``estimated`` in the catalogue and in its own files, a sigma, and a record of its
model, source layers and training paintings; it is never called a measurement, and never replaces one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from math import nan, sqrt
from pathlib import Path

import numpy as np

from levkas.core.cube import Cube, Flag
from levkas.core.digests import hash_file
from levkas.core.files import write_json
from levkas.core.machine import steady_libraries
from levkas.core.problems import Problem, unknown_name
from levkas.database.catalogue import (
    ESTIMATED,
    DatabaseRefused,
    read_catalogue,
    write_catalogue,
)
from levkas.database.credits import Credits
from levkas.database.layers import Layer, write_layer
from levkas.database.layout import MADE_OF, LayerId
from levkas.database.manifest import check_plain_names, write_manifest
from levkas.database.reader import Database
from levkas.database.region_uncertainty import mean_correlation, read_budget
from levkas.database.store import write_index
from levkas.estimation.methods import find_method
from levkas.estimation.samples import read_lattice, require_layers, side_by_side
from levkas.estimation.stored import StoredModel, read_model
from levkas.estimation.uncertainty import SAMPLES, Estimate, channels_of

BLOCK_ROWS = 64
SAMPLED = 4 * SAMPLES
"""Pixels of a lattice among which those are chosen at which slopes are taken."""


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


def apply_model(
    database: str | Path, model: str | Path, layer: str, *, objects: Sequence[str] = ()
) -> Iterator[DerivedStep]:
    """Write an estimated layer for every painting that has the model's source layers.

    Parameters
    ----------
    model : path
        ``NAME.npz`` as ``levkas estimate -o`` wrote it, its facts beside it.
    layer : str
        Name of the new layer; an estimated one of this name is replaced.
    objects : sequence of str
        Only these; default all.

    Raises
    ------
    DatabaseRefused
        Where the name is that of another layer, or the database lacks an object.
    EstimationRefused
        Where it lacks a source layer.
    Refused
        Where the model cannot be read, or was fitted with other channels.
    """
    root = Path(database)
    opened, stored = Database(root), read_model(Path(model))
    names = require_layers(opened, stored.sources, "MODEL")
    _check(root, layer, names, objects)
    chosen = [name for name in names if not objects or name in objects]
    first = (LayerId.parse(names[0], source) for source in stored.sources)
    channels = sum(opened[key.object][key.camera, key.setup].shape[2] for key in first)
    stored.require_channels(channels, Path(model))
    for done, name in enumerate(chosen, 1):
        files = _apply_to(opened, name, layer, stored, Path(model))
        yield DerivedStep(
            f"{name}/{layer} estimated from {'+'.join(stored.sources)}", done, len(chosen), files
        )
    write_manifest(root)


def _check(root: Path, layer: str, having: Sequence[str], objects: Sequence[str]) -> None:
    """Refuse a name that a measured layer has, or that files cannot have, and objects that are not among those `having` the sources."""
    try:
        check_plain_names(layer)
    except ValueError as error:
        raise DatabaseRefused(Problem("E_VALUE", str(error), field="-o", found=layer)) from None
    if layer in {e.camera for e in read_catalogue(root) if e.kind != ESTIMATED}:
        what, expected = "a measured layer has this name", "a name that differs from all cameras"
        fix = f"Name it {layer}-estimated."
        raise DatabaseRefused(Problem("E_EXISTS", what, str(root), "-o", layer, expected, fix))
    if unknown := [name for name in objects if name not in having]:
        what, more = "this object lacks the layers", {"file": str(root), "field": "--object"}
        raise DatabaseRefused(unknown_name(what, unknown[0], having, **more))


def _apply_to(
    database: Database, name: str, layer: str, stored: StoredModel, model: Path
) -> tuple[Path, ...]:
    keys = [LayerId.parse(name, source) for source in stored.sources]
    first = database[name][keys[0].camera, keys[0].setup]
    scale = first.attrs.get("px_per_mm")
    facts = {
        "method": stored.method,
        "from": list(stored.sources),
        "fitted to": stored.target,
        "training": list(stored.training),
        "in training": name in stored.training,
    }
    described = Layer(
        name, layer, px_per_mm=nan if scale is None else float(scale),
        credits=Credits(
            title=f"{name}, spectra estimated",
            description=f"Estimated from {', '.join(stored.sources)} by {find_method(stored.method).title}; not a measurement.",
        ),
        kind=ESTIMATED,
        made_of=facts,
    )  # fmt: skip
    estimate = sample_estimate(database, name, stored)
    cube = estimate_cube(database, name, stored, estimate)
    here = all(painting in database for painting in stored.training)
    rows = [row.to_dict() for row in estimate.rows(same_cameras=here)] if estimate else []
    budgets = [read_budget(database.path, key) for key in keys]
    shared = mean_correlation([budget.correlation for budget in budgets])
    root = database.path
    record = {
        "kind": ESTIMATED,
        **facts,
        "sources": {key.name: hash_file(root / f"{key.path}.tif") for key in keys},
        "model": {"file": model.name, "sha256": hash_file(model)},
        "held_out_rmse": list(stored.sigma),
        "uncertainty": rows,
        "noise_correlation": shared.round(4).tolist(),
    }
    entry, written = write_layer(root, described, cube, verdict=ESTIMATED)
    write_json(path := root / f"{described.id.path}{MADE_OF}", record)
    others = [e for e in read_catalogue(root) if e.layer != entry.layer]
    write_catalogue(root, [*others, entry])
    write_index((root / described.id.group).parent)
    return (*written, path)


def sample_estimate(database: Database, name: str, stored: StoredModel) -> Estimate | None:
    """Return some sound pixels of a painting with what makes their estimates uncertain; None where it has none."""
    keys = [LayerId.parse(name, source) for source in stored.sources]
    layers = [database[name][key.camera, key.setup] for key in keys]
    height, width = layers[0].shape[:2]
    lattice = [read_lattice(layer, max(1, int(sqrt(height * width / SAMPLED)))) for layer in layers]
    known = np.logical_and.reduce([np.isfinite(values).all(2) for values, _, _ in lattice])
    good = np.logical_and.reduce([known, *(sound for _, sound, _ in lattice)])
    good = good if good.any() else known
    if not good.any():
        return None
    some = np.linspace(0, np.count_nonzero(good) - 1, SAMPLES).astype(int)
    responses, noise = (side_by_side(lattice, part, good) for part in (0, 2))
    assert responses is not None
    channels = [
        channels_of(layer, source, read_budget(database.path, key).sources)
        for layer, source, key in zip(layers, stored.sources, keys, strict=True)
    ]
    labels = [band.label for band in stored.bands]
    return Estimate(
        *(stored.model, stored.errors, responses[some]),
        *(None if noise is None else noise[some], channels, labels),
    )


def estimate_cube(
    database: Database, name: str, stored: StoredModel, estimate: Estimate | None
) -> Cube:
    """Estimate the spectra of a painting, with sigma; a flag of any source channel is one of every band.

    Sigma is the method's own where it has one, else that of the prediction on held-out paintings and of the responses' noise.
    """
    keys = [LayerId.parse(name, source) for source in stored.sources]
    layers = [database[name][key.camera, key.setup] for key in keys]
    height, width = layers[0].shape[:2]
    shape = (height, width, len(stored.bands))
    values, sigma = np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32)
    flags = np.zeros(shape, np.uint8)
    noises, marked = ([getattr(a.levkas, part) for a in layers] for part in ("sigma", "flags"))
    for start in range(0, height, BLOCK_ROWS):
        rows = slice(start, start + BLOCK_ROWS)
        responses = np.concatenate([a.isel(y=rows).values for a in layers], axis=2).astype(float)
        marks = np.concatenate([a.isel(y=rows).values for a in marked], axis=2)
        valid = np.isfinite(responses).all(2)
        with steady_libraries():
            spectra, spread = stored.model(responses[valid])
        values[rows][valid] = spectra
        if spread is None and estimate is not None:
            noise = [(None if s is None else s.isel(y=rows).values,) for s in noises]
            spread = estimate.sigma(side_by_side(noise, 0, valid))
        sigma[rows][valid] = spread
        joined = np.bitwise_or.reduce(marks, axis=2)
        flags[rows] = np.where(valid, joined & ~np.uint8(Flag.OUTSIDE), joined | Flag.OUTSIDE)[
            ..., None
        ]
    return Cube(values, flags, sigma, stored.bands)
