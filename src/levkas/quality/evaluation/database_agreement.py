"""Do two databases of one object agree: two laboratories, two sessions, two dates? Registered, compared within their uncertainties."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.cube import Flag, is_flagged
from levkas.core.problems import Problem, unknown_name
from levkas.database.catalogue import DatabaseRefused
from levkas.database.described import LayerRows
from levkas.database.layout import LayerId
from levkas.database.opening import open_layer
from levkas.database.reader import Database
from levkas.database.region_uncertainty import LayerBudget, position_sigmas, read_budget
from levkas.geometry.resample import warp
from levkas.quality.evaluation.camera_agreement import (
    PairAgreement,
    PatchMeans,
    Sensitivities,
    choose_patches,
    compare_layers,
    measure_patches,
)
from levkas.quality.evaluation.change import Changes, apparent_place, find_changes
from levkas.readers.spectra import parse_spectra

if TYPE_CHECKING:
    import xarray

    from levkas.geometry.transforms import Transform

NEAR_NM = 1.0
"""Bands of two databases that lie so near are one band."""


@dataclass(frozen=True, eq=False)
class ObjectAgreement:
    """How two databases agree about one object."""

    name: str
    other: str
    pairs: tuple[PairAgreement, ...]
    changes: Changes | None = None
    compared: str = ""
    error_px: float | None = None

    @property
    def agrees(self) -> bool | None:
        """Whether no pair of layers under one lighting contradicts each other; None where there is no such pair."""
        alike = [pair for pair in self.pairs if not pair.other_light]
        return not any(pair.contradictions for pair in alike) if alike else None

    @property
    def problems(self) -> tuple[Problem, ...]:
        """That nothing was compared, which is no agreement; none else."""
        if self.agrees is not None:
            return ()
        why = f"{self.name}: nothing was compared, so whether the databases agree is not known"
        expected = "a layer of each under one lighting, with bands of one wavelength or known sensitivities"
        fix = "Declare `sensitivity` of a camera with broad bands, or `wavelengths`; build again."
        return (Problem("E_BAND_MISSING", why, field=self.other, expected=expected, fix=fix),)

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, JSON-ready."""
        found = self.changes
        return {
            "object": self.name,
            "other": self.other,
            "agrees": self.agrees,
            "registration_px": self.error_px,
            "pairs": [pair.to_dict() for pair in self.pairs],
            "changes": None
            if found is None
            else {
                "layers": self.compared,
                "share": round(found.share, 6),
                "false_alarm_rate": found.rate,
                "areas": [[*area[:4], round(area[4], 5)] for area in found.areas],
            },
        }


def compare_databases(
    first: Path, second: Path, objects: Sequence[str] = (), *, rate: float = 0.01
) -> list[ObjectAgreement]:
    """Compare the objects that two databases have in common.

    Parameters
    ----------
    objects : sequence of str
        Only these; of two databases with one object each these are compared, whatever their names.
    rate : float
        Of false alarms of the map of changes.

    Raises
    ------
    DatabaseRefused
        Where they have no object in common, or one has no layer of reflectance.
    RegistrationRefused
        Where two pictures cannot be registered.
    """
    mine, theirs = Database(first), Database(second)
    if unknown := [name for name in objects if name not in mine]:
        raise DatabaseRefused(
            *(
                unknown_name("no such object", n, mine, file=str(first), field="--object")
                for n in unknown
            )
        )
    pairs = [(name, name) for name in mine if name in theirs]
    if not pairs and len(mine) == len(theirs) == 1:
        pairs = [(next(iter(mine)), next(iter(theirs)))]
    pairs = [pair for pair in pairs if not objects or pair[0] in objects]
    if not pairs:
        raise DatabaseRefused(
            Problem(
                "E_KEY",
                "the databases have no object in common",
                str(second),
                found=", ".join(theirs) or "no object",
                expected=", ".join(objects or mine),
                fix="Give two databases of one painting, in which it has one name.",
            )
        )
    return [_compare(mine, theirs, *pair, rate) for pair in pairs]


def _compare(
    first: Database, second: Database, name: str, other: str, rate: float
) -> ObjectAgreement:
    from levkas.registration import RegistrationRefused, register

    sides = [_layers_of(database, n) for database, n in ((first, name), (second, other))]
    leads = [_lead(layers) for layers in sides]
    pictures = [_picture(layers[lead]) for layers, lead in zip(sides, leads, strict=True)]
    found = register(*pictures, region=None)
    if found.verdict.decision == "refuse":
        raise RegistrationRefused(
            Problem(
                "E_VERDICT",
                f"{name}: the pictures of the two databases cannot be registered",
                str(second.path),
                found="; ".join(found.verdict.reasons),
                fix=found.verdict.next_step or "Are they of one painting?",
            )
        )
    (move,) = found.transforms.values()
    places = choose_patches(LayerRows.open(first.path, leads[0]))
    measured = [
        [_measured(database, layer, places, at) for layer in layers]
        for database, layers, at in zip((first, second), sides, (None, move), strict=True)
    ]
    pairs = [
        made
        for mine, theirs in _to_compare(*measured)
        if (made := _pair(mine, theirs, first.path, second.path)) is not None
    ]
    shared = _same_bands(sides[0], sides[1], leads)
    changes, compared = None, ""
    if shared is not None:
        changes = _changes(sides[0][shared[0]], sides[1][shared[1]], move, rate)
        compared = f"{shared[0].name} and {shared[1].name}"
    error = found.verdict.numbers["sensor"]["held_out_px"]
    return ObjectAgreement(name, other, tuple(pairs), changes, compared, error)


Layers = Mapping[LayerId, "xarray.DataArray"]


def _layers_of(database: Database, name: str) -> Layers:
    """Return the layers of an object that hold reflectance, the reference first."""
    found = database[name]
    ids = [LayerId(name, camera, setup) for camera, setup in found.layers]
    arrays = {layer: open_layer(database.path, layer) for layer in ids}
    arrays = {k: a for k, a in arrays.items() if a.attrs.get("quantity") == "reflectance"}
    if not arrays:
        raise DatabaseRefused(
            Problem(
                "E_KEY",
                f"{name} has no layer of reflectance",
                str(database.path),
                fix="Calibrate its cameras by a white or a chart.",
            )
        )
    return arrays


def _lead(layers: Layers) -> LayerId:
    """Return the layer that others are compared by: under the default setup, with the most bands in the visible."""

    def rank(layer: LayerId) -> tuple[bool, int]:
        nm = np.atleast_1d(layers[layer].wavelength.values)
        return not layer.setup, int(((nm > 400) & (nm < 700)).sum())

    return max(layers, key=rank)


def _picture(array: xarray.DataArray) -> np.ndarray:
    """Return the mean of some bands of a layer, (h, w) float32, NaN where one is not sound."""
    nm = np.nan_to_num(np.atleast_1d(array.wavelength.values), nan=550.0)
    some = np.argsort(np.abs(nm - 550), kind="stable")[:3]
    part = array.isel(band=np.sort(some))
    values, flags = (
        part.transpose("y", "x", "band").values,
        part.levkas.flags.transpose("y", "x", "band"),
    )
    picture = values.mean(-1, dtype=np.float32)
    picture[is_flagged(flags.values, Flag.OUTSIDE).any(-1)] = np.nan
    return np.ascontiguousarray(picture)


def _measured(
    database: Database, layer: LayerId, places: np.ndarray, at: Transform | None
) -> PatchMeans:
    """Measure the patches of a layer, with errors that are this database's own."""
    budget = read_budget(database.path, layer)
    own = str(database.path)
    rows = tuple(
        replace(row, owner=f"{own}: {row.owner}") if row.common_to == "campaign" else row
        for row in budget.sources
    )
    budget = LayerBudget(rows, budget.correlation)
    return measure_patches(LayerRows.open(database.path, layer), places, budget, at=at, owner=own)


def _pair(mine: PatchMeans, theirs: PatchMeans, first: Path, second: Path) -> PairAgreement | None:
    """Compare two layers, that of fewer bands by the spectrum of the other; layers of the second database are named so."""
    theirs = replace(theirs, name=f"{theirs.layer.name} of the second")
    sides = [(mine, first), (theirs, second)]
    (wide, a), (narrow, b) = sorted(sides, key=lambda side: -len(side[0].labels))
    of_wide, of_narrow = sensitivities_in(a, wide), sensitivities_in(b, narrow)
    made = compare_layers(wide, narrow, of_narrow, of_first=of_wide)
    return made or compare_layers(narrow, wide, of_wide, of_first=of_narrow)


def _to_compare(
    mine: Sequence[PatchMeans], theirs: Sequence[PatchMeans]
) -> list[tuple[PatchMeans, PatchMeans]]:
    """Return layers of one name, where both have some; else all pairs."""
    pairs = [(one, other) for one in mine for other in theirs]
    alike = [(one, other) for one, other in pairs if one.layer.name == other.layer.name]
    return alike or pairs


def sensitivities_in(root: Path, layer: PatchMeans) -> Sensitivities:
    """Return what the bands of a layer see of every wavelength, (nm, response), as its database publishes it."""
    found: Sensitivities = {}
    table = root / "cameras" / layer.layer.camera / "sensitivity.csv"
    if table.is_file():
        numbers, head = parse_spectra(table.read_text(encoding="utf-8"))
        light = root / "setups" / (layer.layer.setup or "default") / "spd.csv"
        power = np.ones(len(numbers))
        if light.is_file():
            nm, watts = parse_spectra(light.read_text(encoding="utf-8"))[0][:, :2].T
            power = np.interp(numbers[:, 0], nm, watts)
        for k, label in enumerate(head[1:], 1):
            found[label] = numbers[:, 0], np.maximum(numbers[:, k], 0) * power
    for label, centre, width in zip(layer.labels, layer.wavelengths, layer.fwhm, strict=True):
        if label not in found and np.isfinite(centre) and np.isfinite(width):
            nm = centre + np.arange(-1.5, 1.51, 0.05) * width
            found[label] = nm, np.exp(-4 * np.log(2) * ((nm - centre) / width) ** 2)
    return {label: (nm, w) for label, (nm, w) in found.items() if w.sum() > 0}


def _same_bands(
    first: Layers, second: Layers, leads: Sequence[LayerId]
) -> tuple[LayerId, LayerId] | None:
    """Return two layers with the same bands under one setup, those that were registered before others."""
    mine, theirs = (
        sorted(layers, key=lambda one: one != lead)
        for layers, lead in zip((first, second), leads, strict=True)
    )
    for one in mine:
        for other in theirs:
            a, b = (np.atleast_1d(x.wavelength.values) for x in (first[one], second[other]))
            labels = [
                list(map(str, np.atleast_1d(x.band.values))) for x in (first[one], second[other])
            ]
            near = a.shape == b.shape and bool(np.all(np.abs(a - b) <= NEAR_NM))
            if one.setup == other.setup and (
                near or (labels[0] == labels[1] and one.camera == other.camera)
            ):
                return one, other
    return None


def _changes(
    first: xarray.DataArray, second: xarray.DataArray, move: Transform, rate: float
) -> Changes | None:
    """Find what changed from the first to the second, on the first's grid; None where the noise of one is not known."""
    from scipy.ndimage import gaussian_filter

    if first.levkas.sigma is None or second.levkas.sigma is None:
        return None
    (values, flags, sigma), (others, marks, spread) = (
        [_rows(part) for part in (array, array.levkas.flags, array.levkas.sigma)]
        for array in (first, second)
    )
    there = warp(
        others.astype(np.float32),
        move,
        values.shape[:2],
        flags=marks,
        variance=np.square(spread, dtype=np.float32),
    )
    assert there.variance is not None and there.flags is not None
    known = ((flags == 0) & (there.flags == 0)).all(-1) & np.isfinite(there.values).all(-1)
    if not known.any():
        return None
    sound = values[known], there.values[known]
    factor = np.median(sound[1], axis=0) / np.maximum(np.median(sound[0], axis=0), 1e-6)
    difference = np.where(known[..., None], there.values / factor - values, 0.0)
    slopes = sum(np.square(np.gradient(values, axis=axis)) for axis in (0, 1))
    # What interpolation makes of an edge lies a pixel beside it, too.
    steepness = gaussian_filter(np.nan_to_num(slopes), (1, 1, 0))
    variance = np.nan_to_num(np.square(sigma) + there.variance / factor**2, nan=1.0)
    place = max(_place_variance(first), apparent_place(difference, variance, steepness, known))
    return find_changes(difference, variance + place * steepness, known, rate=rate)


def _rows(part: Any) -> np.ndarray:
    return np.asarray(part.transpose("y", "x", "band").values)


def _place_variance(array: xarray.DataArray) -> float:
    """Return the variance of the place of a layer's middle, px², of either axis; a hundredth of a pixel at least."""
    root, layer = array.levkas.place
    middle = np.array([[array.sizes["x"] / 2, array.sizes["y"] / 2]])
    known = position_sigmas(root, layer, [str(array.band.values[0])], middle)[0, 0]
    return float(max(np.nan_to_num(known), 0.01) ** 2)
