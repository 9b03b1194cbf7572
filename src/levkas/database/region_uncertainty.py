"""The uncertainty of what is read from a region of a layer: of means, and of differences, ratios and colours made of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from levkas.calibration.error_sources import (
    COVERAGE,
    ErrorSource,
    MeanSpectrum,
    Uncertain,
    join,
    uncertain_mean,
)
from levkas.core.cube import Band
from levkas.core.problems import Problem
from levkas.core.text import read_json
from levkas.database.catalogue import DatabaseRefused
from levkas.database.described import Pixels
from levkas.database.layout import MADE_OF, LayerId
from levkas.database.pixel_frames import Frame, MappingRefused, Records, position_sigma_at
from levkas.database.regions import Region, is_sound, refused

if TYPE_CHECKING:
    import xarray

Of = Literal["mean", "difference", "ratio", "delta_e"]
PROVENANCE = "provenance.json"
PLACE = "place"
NO_BUDGET = "all that pixels share: the layer has no budget"
OTHER_BUDGET = "all that pixels share: the layer's budget is of another version; build it again"
NONE = np.ones((1, 1))
"""Correlation of noise that no neighbours share."""


@dataclass(frozen=True, eq=False)
class LayerBudget:
    """What a database says of the errors of a layer.

    `correlation`, (2r + 1, 2r + 1), is of the noise of a pixel with that of its neighbours on the grid, 1 in the middle:
    they were interpolated from the same pixels.
    """

    sources: tuple[ErrorSource, ...] = ()
    correlation: np.ndarray = field(default_factory=lambda: NONE)


def read_budget(root: Path, layer: LayerId) -> LayerBudget:
    """Return the budget of a layer by its object's provenance, or by the record of what it was made of; an empty one where none says anything.

    Raises DatabaseRefused: ``E_DAMAGED`` where that is none.
    """
    made_of = _record_of(root, layer)
    path = made_of or root / "objects" / layer.object / PROVENANCE
    if not path.is_file():
        return LayerBudget()
    try:
        record = json.loads(path.read_bytes())
        if made_of:
            rows, correlation = record.get("uncertainty", []), record.get("noise_correlation")
        else:
            key = (layer.camera, layer.setup)
            mine = {s["stage"]: s for s in record["steps"] if (s["camera"], s["setup"]) == key}
            rows = mine["calibrate"]["uncertainty"] if "calibrate" in mine else []
            correlation = mine.get("resample", {}).get("noise_correlation")
        known = tuple(ErrorSource.from_dict(row) for row in rows)
        return LayerBudget(known, NONE if correlation is None else np.array(correlation, float))
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        what = "the uncertainties of this object cannot be read, or are of another version"
        found = f"{type(error).__name__}: {error}"
        expected = "steps with uncertainties, as a build writes them"
        facts = (str(path), None, found, expected, "Build it again.")
        raise DatabaseRefused(Problem("E_DAMAGED", what, *facts)) from error


def _record_of(root: Path, layer: LayerId) -> Path | None:
    """Return the record of what a layer was made of; None of one that was measured."""
    path = root / f"{layer.path}{MADE_OF}"
    return path if path.is_file() else None


def mean_correlation(several: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean of correlations of neighbours, (2r + 1, 2r + 1) each, of the widest reach among them.

    >>> mean_correlation([NONE, np.full((3, 3), 0.5)])[1].tolist()
    [0.25, 0.75, 0.25]
    """
    reach = max(len(one) // 2 for one in several)
    wide = [np.pad(one, reach - len(one) // 2) for one in several]
    return np.asarray(np.mean(wide, axis=0))


def position_sigmas(
    root: Path,
    layer: LayerId,
    labels: Sequence[str],
    places: np.ndarray,
    records: Records | None = None,
) -> np.ndarray:
    """Return how well the place of each band is known at (p, 2) px of the grid, by the layer's registration, (p, n) px; NaN where it is not.

    Of a layer that was made from others it is that of the least known of its sources, in its reference channel. `records`: those
    of its object, where they are read for several layers.
    """
    found = np.full((len(places), len(labels)), np.nan)
    if record := _record_of(root, layer):
        for source in read_json(record).get("from", ()):
            one = LayerId.parse(layer.object, str(source))
            found = np.fmax(found, position_sigmas(root, one, [""], places))
        return found
    try:
        records = records or Records(root, layer.object)
        corners = records.pixels(Frame()).from_reference.inverse(np.array([[0.0, 0], [1, 0]]))
        for k, label in enumerate(labels):
            frame = Frame(layer.camera, layer.setup, label)
            found[:, k] = position_sigma_at(records, frame, places)
    except MappingRefused:
        return found
    return found / float(np.hypot(*(corners[1] - corners[0])))


def with_place(budget: LayerBudget, labels: Sequence[str], sigmas_px: np.ndarray) -> LayerBudget:
    """Add how well the place of each band is known, (n,) px of the grid."""
    known = zip(labels, np.asarray(sigmas_px, float).tolist(), strict=True)
    size = {band: one for band, one in known if np.isfinite(one)}
    row = ErrorSource(PLACE, "px", size, "frame", all_bands=True)
    return replace(budget, sources=(*budget.sources, row)) if size else budget


def mean_of_region(
    pixels: Pixels, bands: Sequence[Band], region: Region, correlation: np.ndarray = NONE
) -> MeanSpectrum:
    """Return the mean of a region's sound pixels, its random uncertainty and its slopes, band by band.

    `region` is in px of `pixels`, (h, w, bands); `correlation`, (2r + 1, 2r + 1), is of the noise of neighbours. The variance
    of the mean of n pixels is Σₚ Σₗ ρ(l) σₚ σₚ₊ₗ / n²: with σ of 0.01, ρ of 0.5 to the four nearest and many pixels it is
    three times σ²/n. Raises RegionRefused: ``E_REGION`` where no pixel lies within.
    """
    height, width, _ = pixels.values.shape
    x0, y0, x1, y1 = region.bounds
    # One pixel around, so that the picture has a slope at the rim too.
    rows = np.arange(max(0, int(np.ceil(y0)) - 1), min(height, int(np.floor(y1)) + 2))
    columns = np.arange(max(0, int(np.ceil(x0)) - 1), min(width, int(np.floor(x1)) + 2))
    inside = region.contains(columns[None], rows[:, None])
    if not inside.any():
        raise refused("no pixel within", "the centre of a pixel of the array, by its x and y")
    values, marks, noise = pixels.part(
        slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    )
    good = is_sound(values, marks)
    sound = inside[..., None] & good
    count = sound.sum((0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, *slopes = (
            np.where(sound, part, 0.0).sum((0, 1), dtype=float) / count
            for part in (values, *_slopes(values, good))
        )
    random, sigma = np.zeros((2, len(count)))
    if noise is not None:
        from scipy.ndimage import correlate

        spread = np.where(sound, noise, 0.0).astype(float)
        sigma = np.sqrt(np.square(spread).sum((0, 1)) / np.maximum(count, 1))
        shared = correlate(spread, correlation[..., None], mode="constant")
        total = np.maximum((spread * shared).sum((0, 1)), 0.0)
        random = np.sqrt(total) / np.maximum(np.count_nonzero(spread, (0, 1)), 1)
    return MeanSpectrum(
        *([band.label for band in bands], mean, random),
        np.array([band.wavelength for band in bands]),
        gradient=np.nan_to_num(slopes),
        lines=int(inside.any(1).sum()),
        sigma=sigma,
    )


def _slopes(values: np.ndarray, sound: np.ndarray) -> list[np.ndarray]:
    """Return the slopes of a picture, (h, w, bands), in x and in y, per px; 0 beside what is not sound."""
    picture = np.where(sound, values, np.nan)
    return [
        np.nan_to_num(np.gradient(picture, axis=a)) if picture.shape[a] > 1 else 0 * values
        for a in (1, 0)
    ]


def uncertain_region(
    mean: MeanSpectrum, budget: LayerBudget, layer: LayerId, region: object, *, owner: str = ""
) -> Uncertain:
    """Return a mean with all that makes it uncertain; `region` names the pixels, `owner` one of several databases."""
    place, camera = (f"{owner}:{one}" for one in (f"{layer.object}/{layer.name}", layer.camera))
    return uncertain_mean(mean, budget.sources, layer=place, camera=camera, region=str(region))


def uncertain_means(
    root: Path,
    layer: LayerId,
    arrays: tuple[xarray.DataArray, xarray.DataArray, xarray.DataArray | None],
    regions: Sequence[Region],
) -> tuple[list[Uncertain], LayerBudget]:
    """Return the means of regions with their errors, and the budget that they are of.

    `arrays` are values, flags and sigma of neighbouring pixels of the grid; regions are by their x and y.
    """
    budget, values = read_budget(root, layer), arrays[0]
    nm = np.atleast_1d(values.wavelength.values).astype(float)
    labels = [str(label) for label in values.band.values]
    bands = [Band(label, float(at)) for label, at in zip(labels, nm, strict=True)]
    first, last = (np.array([values.x.values[k], values.y.values[k]]) for k in (0, -1))
    middles = [np.reshape(region.bounds, (2, 2)).mean(0) for region in regions]
    known = position_sigmas(root, layer, labels, np.clip(middles, first, last))
    means = []
    for region, sigmas in zip(regions, known, strict=True):
        around = np.reshape(region.bounds, (2, 2)) + np.array([[-2.0], [2.0]])
        low, high = np.clip(around, first, last)
        part = {axis: slice(a, b) for axis, a, b in zip("xy", low, high, strict=True)}
        cut = [None if a is None else a.sel(part).transpose("y", "x", "band") for a in arrays]
        assert cut[0] is not None
        corner = [float(cut[0][axis].values[0]) if cut[0][axis].size else 0.0 for axis in "xy"]
        pixels = Pixels(*(None if one is None else one.values for one in cut))  # type: ignore[arg-type]
        moved = replace(region, vertices=region.vertices - corner)
        mean = mean_of_region(pixels, bands, moved, budget.correlation)
        here = with_place(budget, labels, sigmas)
        means.append(uncertain_region(mean, here, layer, region.vertices.tolist()))
    return means, budget


def combine(
    of: Of,
    labels: Sequence[str],
    wavelengths: np.ndarray,
    first: Uncertain,
    second: Uncertain | None = None,
) -> tuple[Uncertain, list[str]]:
    """Return what is made of the means of one region or of two, (n,) each, and names of the numbers.

    Means; difference or ratio of the first two bands of one region, or of two regions, band by band; ΔE2000 of two regions
    under D65. Raises RegionRefused: ``E_VALUE`` where it cannot be made of them.
    """
    n = len(labels)
    if of == "mean" and second is None:
        return first, [*labels]
    if of == "delta_e" and second is not None:
        if n < 3 or not np.isfinite(wavelengths).all():
            expected = "three bands or more, each with a wavelength"
            raise refused(f"{n} bands", expected, "E_VALUE")
        both = join([first, second])
        return both.through(lambda v: _delta_e(v[:n], v[n:], wavelengths)), ["ΔE2000"]
    if of not in ("difference", "ratio"):
        expected = f"one of {', '.join(get_args(Of))}; delta_e of two regions, mean of one"
        raise refused(f"of = {of!r}", expected, "E_VALUE")
    make = np.subtract if of == "difference" else np.divide
    if second is not None:
        return join([first, second]).through(lambda v: make(v[:n], v[n:])), [*labels]
    if n != 2:
        raise refused(f"{n} bands", "two bands, or a second region", "E_VALUE")
    sign = "−" if of == "difference" else "/"
    return first.through(lambda v: make(v[:1], v[1:])), [f"{labels[0]} {sign} {labels[1]}"]


def _delta_e(first: np.ndarray, second: np.ndarray, wavelengths: np.ndarray) -> np.ndarray:
    from levkas.colour.gamut import delta_e_2000, lab_of

    return delta_e_2000(lab_of(first[None], wavelengths), lab_of(second[None], wavelengths))


def to_dataset(made: Uncertain, names: Sequence[str], unknown: Sequence[str]) -> xarray.Dataset:
    """Return numbers with their uncertainties, as `LayerAccessor.uncertainty` describes them."""
    import xarray

    rows = made.by_source()
    random = rows.get("noise", np.zeros(len(made.values)))
    expanded = {"long_name": f"expanded uncertainty, k = {COVERAGE:g}"}
    variables = {
        "value": ("band", made.values),
        "u": ("band", made.sigma, {"long_name": "standard uncertainty"}),
        "U": ("band", COVERAGE * made.sigma, expanded),
        "u_random": ("band", random),
        "u_common": ("band", np.sqrt(np.maximum(made.sigma**2 - random**2, 0))),
        "u_by_source": (("source", "band"), np.array([*rows.values()]).reshape(-1, len(names))),
    }
    coords = {"band": [*names], "source": [*rows]}
    return xarray.Dataset(variables, coords=coords, attrs={"not_known": [*unknown]})
