"""What an experiment estimates from what: layers and methods, by default found in the database."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from levkas.core.problems import Problem, unknown_name
from levkas.database.layout import LayerId
from levkas.database.reader import Database
from levkas.database.registrations import read_registrations
from levkas.estimation.methods import METHODS, EstimationMethod
from levkas.estimation.samples import EstimationRefused, require_layers

LEAST_TARGET_BANDS = 8
"""Narrow bands of a layer whose spectra are worth estimating."""
MOST_BROAD = 16
"""Channels of a camera that is estimated from by default."""


@dataclass(frozen=True)
class ExperimentPlan:
    """What is estimated from what, by which methods, and how paintings are held out.

    Parameters
    ----------
    sources : sequence of str
        Layers of which spectra are estimated, ``d80`` or, joined, ``d80,msbs``; default each camera of few channels.
    target : str
        Layer whose spectra are estimated; default the reference camera where it is spectral.
    methods : sequence of str
        Names of methods, or ``all``.
    train, test : sequence of str
        Paintings, instead of each left out in turn.
    models : bool
        Whether models fitted on all paintings are part of the report.
    """

    database: str | Path
    sources: Sequence[str] = ()
    target: str = ""
    methods: Sequence[str] = ()
    train: Sequence[str] = ()
    test: Sequence[str] = ()
    models: bool = False
    seed: int = 1


def choose_methods(names: Sequence[str]) -> list[EstimationMethod]:
    """Return methods by their names; all without one or with ``all``; raises EstimationRefused."""
    unknown = [name for name in names if name not in (*METHODS, "all")]
    if unknown:
        what = f"unknown method of estimation {unknown[0]!r}"
        field = "--method"
        raise EstimationRefused(
            unknown_name(what, unknown[0], METHODS, code="E_METHOD", field=field)
        )
    if not names or "all" in names:
        return list(METHODS.values())
    return [METHODS[name] for name in dict.fromkeys(names)]


def choose_layers(database: Database, plan: ExperimentPlan) -> tuple[str, list[tuple[str, ...]]]:
    """Return the target and the groups of layers that it is estimated from, by default found."""
    layers = {
        LayerId(name, camera, setup).name: database[name][camera, setup]
        for name in database
        for camera, setup in database[name].layers
    }
    target = plan.target or _default_target(
        database, {n: a.wavelength.values for n, a in layers.items()}
    )
    require_layers(database, [target], "--to")
    if not np.isfinite(np.asarray(layers[target].wavelength.values, float)).all():
        raise EstimationRefused(
            Problem(
                "E_VALUE",
                f"{target!r} has broad channels, which have no spectrum to be estimated",
                str(database.path),
                "--to",
                found=", ".join(map(str, layers[target].band.values[:6])),
                expected="a layer of narrow bands",
            )
        )
    groups = [
        tuple(part.strip() for part in text.split(",") if part.strip()) for text in plan.sources
    ]
    if not groups:
        groups = [
            (name,)
            for name, array in layers.items()
            if "@" not in name and name != target and array.shape[2] <= MOST_BROAD
            and array.attrs.get("quantity") == "reflectance" and array.attrs.get("kind") != "estimated"
        ]  # fmt: skip
        broad = [g for g in groups if not np.isfinite(layers[g[0]].wavelength.values).all()]
        groups = broad or groups
    if not all(groups) or not groups or any(target in group for group in groups):
        raise EstimationRefused(
            Problem(
                "E_VALUE",
                "spectra are estimated from layers other than the one that is estimated",
                str(database.path),
                "--from",
                found=", ".join(plan.sources) or "no layer of few channels",
                expected=", ".join(name for name in layers if name != target),
            )
        )
    for group in groups:
        require_layers(database, [*group, target], "--from")
    return target, groups


def _default_target(database: Database, wavelengths: dict[str, np.ndarray]) -> str:
    """Return the reference camera's layer where it is spectral, else that of most narrow bands."""
    narrow = {
        name: len(values)
        for name, values in wavelengths.items()
        if np.isfinite(np.asarray(values, float)).all() and "@" not in name
    }
    for _, record in read_registrations(Path(database.path)):
        reference = record["reference"]["camera"] if isinstance(record["reference"], dict) else ""
        if narrow.get(reference, 0) >= LEAST_TARGET_BANDS:
            return str(reference)
    if not narrow:
        raise EstimationRefused(
            Problem(
                "E_VALUE",
                "the database has no layer of narrow bands whose spectra could be estimated",
                str(database.path),
                "--to",
                found=", ".join(wavelengths),
            )
        )
    return max(narrow, key=lambda name: (narrow[name], name))


def wavelengths_of(database: Database, layer: str) -> np.ndarray:
    """Return the wavelengths of a layer's bands, nm."""
    for name in database:
        key = LayerId.parse(name, layer)
        if (key.camera, key.setup) in database[name].layers:
            return np.asarray(database[name][key.camera, key.setup].wavelength.values, float)
    return np.zeros(0)
