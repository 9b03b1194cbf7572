"""The uncertainty of what is read from a region of a layer: of means, and of differences, ratios and colours made of them."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np

from levkas.calibration.error_sources import (
    COVERAGE,
    ErrorSource,
    MeanSpectrum,
    Uncertain,
    join,
    uncertain_mean,
)
from levkas.core.problems import Problem
from levkas.core.text import read_json
from levkas.database.catalogue import DatabaseRefused
from levkas.database.layout import MADE_OF, LayerId
from levkas.database.regions import TRUSTED, Region, RegionRefused

if TYPE_CHECKING:
    import xarray

    from levkas.core.cube import Band
    from levkas.database.described import Pixels
    from levkas.database.pixel_frames import Records

Of = Literal["mean", "difference", "ratio", "delta_e"]
PROVENANCE = "provenance.json"
PLACE = "place"
LONG_NAMES = {"sigma": "part of sigma by {}, which a region of one paint has in common"}
NO_BUDGET = "all that pixels share: the layer has no budget"
OTHER_BUDGET = (
    "all that pixels share: the layer's budget is of another version of Levkas; build it again"
)
NONE = np.ones((1, 1))
"""Correlation of noise that no neighbours share."""


@dataclass(frozen=True, eq=False)
class LayerBudget:
    """What a database says of the errors of a layer.

    Parameters
    ----------
    correlation : ndarray, (2r + 1, 2r + 1)
        Of the noise of a pixel with that of its neighbours on the grid, 1 in the middle: they were interpolated from the same pixels.
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
        record = json.loads(path.read_text(encoding="utf-8"))
        return _budget_of_made(record) if made_of else _budget_in(record, layer)
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        problem = Problem(
            "E_DAMAGED",
            "what the layers of this object were made of cannot be read, or is of another version of Levkas",
            str(path),
            found=f"nothing under {error}"
            if isinstance(error, KeyError)
            else f"{type(error).__name__}: {error}",
            expected="steps with uncertainties, as a build writes them",
            fix="Build it again.",
        )
        raise DatabaseRefused(problem) from error


def _budget_in(record: Mapping[str, Any], layer: LayerId) -> LayerBudget:
    """Read the budget of a layer off its object's provenance."""
    steps: Sequence[Mapping[str, Any]] = record["steps"]
    mine = {
        s["stage"]: s for s in steps if (s["camera"], s["setup"]) == (layer.camera, layer.setup)
    }
    rows = mine["calibrate"]["uncertainty"] if "calibrate" in mine else []
    return _as_budget(rows, mine.get("resample", {}).get("noise_correlation"))


def _record_of(root: Path, layer: LayerId) -> Path | None:
    """Return the record of what a layer was made of; None of one that was measured."""
    paths = (root / f"{layer.path}{ending}" for ending in MADE_OF.values())
    return next((path for path in paths if path.is_file()), None)


def _budget_of_made(record: Mapping[str, Any]) -> LayerBudget:
    """Read the budget of a layer that was made from others off its record."""
    return _as_budget(record.get("uncertainty", []), record.get("noise_correlation"))


def _as_budget(rows: Sequence[Mapping[str, Any]], correlation: Any) -> LayerBudget:
    known = tuple(ErrorSource.from_dict(row) for row in rows)
    return LayerBudget(known, NONE if correlation is None else np.array(correlation, float))


def mean_correlation(several: Sequence[np.ndarray]) -> np.ndarray:
    """Return the mean of correlations of neighbours, (2r + 1, 2r + 1) each, of the widest reach among them.

    >>> mean_correlation([NONE, np.full((3, 3), 0.5)])[1].tolist()
    [0.25, 0.75, 0.25]
    """
    reach = max(len(one) // 2 for one in several)
    wide = [np.pad(one, reach - len(one) // 2) for one in several]
    return np.asarray(np.mean(wide, axis=0))


def budget_variables(budget: LayerBudget, band: xarray.DataArray) -> dict[str, xarray.DataArray]:
    """Return the known rows of a budget as arrays over `band`, named and described after obsarray's conventions.

    ``err_corr_N_form`` says of each dimension whether one draw of the error holds along it ("systematic") or each place has its
    own ("random"). Rows of single pixels are what sigma is made of, and are left out.
    """
    import xarray

    found: dict[str, xarray.DataArray] = {}
    for row in budget.sources:
        if not row.size or row.common_to == "pixel":
            continue
        sizes = np.array([row.size.get(str(label), np.nan) for label in np.atleast_1d(band.values)])
        percent = row.unit == "relative"
        attributes: dict[str, Any] = {
            "long_name": LONG_NAMES.get(row.unit, "standard uncertainty by {}").format(row.name),
            "units": {"relative": "%", "reflectance": "1", "sigma": "1", "counts": "count"}.get(
                row.unit, row.unit
            ),
            "pdf_shape": "gaussian",
            "common_to": row.common_to,
            "basis": row.basis,
        }
        line = row.common_to == "line"
        forms = {"y": line, "x": False, "band": not row.all_bands}
        for n, (dim, random) in enumerate(forms.items(), 1):
            form = "random" if random else "systematic"
            attributes |= {f"err_corr_{n}_dim": dim, f"err_corr_{n}_form": form}
            attributes |= {f"err_corr_{n}_params": [], f"err_corr_{n}_units": []}
        if row.zero_at:
            attributes["zero_at"] = [
                row.zero_at.get(str(b), np.nan) for b in np.atleast_1d(band.values)
            ]
        name = "u_" + row.name.replace(" ", "_")
        if name in found:  # a second part of the same source, in another unit
            name += f"_{row.unit}"
        several = name
        while name in found:  # draws of their own
            name = f"{several}_{sum(other.startswith(several) for other in found) + 1}"
        found[name] = xarray.DataArray(
            100 * sizes if percent else sizes, {"band": band}, ("band",), attrs=attributes
        )
    return found


def position_sigmas(
    root: Path,
    layer: LayerId,
    labels: Sequence[str],
    places: np.ndarray,
    records: Records | None = None,
) -> np.ndarray:
    """Return how well the place of each band is known at (p, 2) px of the grid, by the layer's registration, (p, n) px; NaN where it is not.

    Of a layer that was made from others it is that of the least known of its sources, in its reference channel. `records` are those of
    its object, where they are read for several layers.
    """
    from levkas.database.pixel_frames import Frame, MappingRefused, Records, position_sigma_at

    if record := _record_of(root, layer):
        return _of_sources(root, layer, read_json(record).get("from", ()), labels, places)
    found = np.full((len(places), len(labels)), np.nan)
    try:
        records = records or Records(root, layer.object)
        corners = records.pixels(Frame()).from_reference.inverse(np.array([[0.0, 0], [1, 0]]))
        for k, label in enumerate(labels):
            frame = Frame(layer.camera, layer.setup, label)
            found[:, k] = position_sigma_at(records, frame, places)
    except MappingRefused:
        return found
    return found / float(np.hypot(*(corners[1] - corners[0])))


def _of_sources(
    root: Path, layer: LayerId, sources: Sequence[str], labels: Sequence[str], places: np.ndarray
) -> np.ndarray:
    """Return how well the places of an estimated layer are known, (p, n) px."""
    found = np.full((len(places), len(labels)), np.nan)
    for source in sources:
        key = LayerId.parse(layer.object, str(source))
        found = np.fmax(found, position_sigmas(root, key, [""], places))
    return found


def with_place(budget: LayerBudget, labels: Sequence[str], sigmas_px: np.ndarray) -> LayerBudget:
    """Add how well the place of each band is known, (n,) px of the grid."""
    size = {
        band: float(one) for band, one in zip(labels, sigmas_px, strict=True) if np.isfinite(one)
    }
    row = ErrorSource(PLACE, "px", size, "frame", all_bands=True)
    return replace(budget, sources=(*budget.sources, row)) if size else budget


def mean_of_region(
    pixels: Pixels, bands: Sequence[Band], region: Region, correlation: np.ndarray = NONE
) -> MeanSpectrum:
    """Return the mean of a region's sound pixels, its random uncertainty and its slopes, band by band.

    Parameters
    ----------
    pixels : Pixels, (h, w, bands)
    region : Region
        In px of `pixels`.
    correlation : ndarray, (2r + 1, 2r + 1)
        Of the noise of neighbours.

    Raises RegionRefused: ``E_REGION`` where no pixel lies within.

    Notes
    -----
    The variance of the mean of n pixels is Σₚ Σₗ ρ(l) σₚ σₚ₊ₗ / n². With σ of 0.01, ρ of 0.5 to the four nearest and many
    pixels it is three times σ²/n.
    """
    height, width, _ = pixels.values.shape
    x0, y0, x1, y1 = region.bounds
    rows = np.arange(max(0, int(np.ceil(y0))), min(height, int(np.floor(y1)) + 1))
    columns = np.arange(max(0, int(np.ceil(x0))), min(width, int(np.floor(x1)) + 1))
    inside = region.contains(columns[None], rows[:, None])
    if not inside.any():
        raise RegionRefused(
            Problem(
                "E_REGION",
                "this is not a region of the layer",
                found="no pixel within",
                expected="the centre of a pixel of the array, by its x and y",
            )
        )
    # One pixel around, so that the picture has a slope at the rim too.
    rows, columns, inside = _widened(rows, columns, inside, (height, width))
    within = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
    values, marks, noise = pixels.part(*within)
    good = ((marks & ~TRUSTED) == 0) & np.isfinite(values)
    sound = inside[..., None] & good
    count = sound.sum((0, 1))
    with np.errstate(invalid="ignore", divide="ignore"):
        mean, *slopes = (
            np.where(sound, part, 0.0).sum((0, 1), dtype=float) / count
            for part in (values, *_slopes(values, good))
        )
    random, sigma = np.zeros((2, len(count)))
    if noise is not None:
        spread = np.where(sound, noise, 0.0).astype(float)
        sigma = np.sqrt(np.square(spread).sum((0, 1)) / np.maximum(count, 1))
        random = _of_mean(spread, correlation)
    wavelengths = np.array([band.wavelength for band in bands])
    return MeanSpectrum(
        *([band.label for band in bands], mean, random, wavelengths),
        gradient=np.nan_to_num(slopes),
        lines=int(inside.any(1).sum()),
        sigma=sigma,
    )


def _widened(
    rows: np.ndarray, columns: np.ndarray, inside: np.ndarray, shape: tuple[int, int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return rows, columns and what lies inside with one pixel more on every side that the grid has."""
    wide = []
    for axis, (at, size) in enumerate(zip((rows, columns), shape, strict=True)):
        first, last = max(0, at[0] - 1), min(size - 1, at[-1] + 1)
        more = [(0, 0), (0, 0)]
        more[axis] = (int(at[0] - first), int(last - at[-1]))
        inside = np.pad(inside, more)
        wide.append(np.arange(first, last + 1))
    return wide[0], wide[1], inside


def _slopes(values: np.ndarray, sound: np.ndarray) -> list[np.ndarray]:
    """Return the slopes of a picture, (h, w, bands), in x and in y, per px; 0 beside what is not sound."""
    picture = np.where(sound, values, np.nan)
    return [
        np.nan_to_num(np.gradient(picture, axis=a)) if picture.shape[a] > 1 else 0 * values
        for a in (1, 0)
    ]


def _of_mean(sigma: np.ndarray, correlation: np.ndarray) -> np.ndarray:
    """Return the standard deviation of means of pixels, (h, w, n), 0 of those that do not count, (n,); neighbours share noise."""
    reach = len(correlation) // 2
    wide = np.pad(sigma, ((reach, reach), (reach, reach), (0, 0)))
    height, width, bands = sigma.shape
    total = np.zeros(bands)
    for dy, dx in _lags(reach):
        share = correlation[dy + reach, dx + reach]
        if share:
            moved = wide[reach + dy : reach + dy + height, reach + dx : reach + dx + width]
            total += share * np.einsum("yxk,yxk->k", sigma, moved)
    return np.sqrt(np.maximum(total, 0.0)) / np.maximum(np.count_nonzero(sigma, (0, 1)), 1)


def _lags(reach: int) -> Iterator[tuple[int, int]]:
    steps = range(-reach, reach + 1)
    return ((dy, dx) for dy in steps for dx in steps)


def uncertain_region(
    mean: MeanSpectrum, budget: LayerBudget, layer: LayerId, region: object, *, owner: str = ""
) -> Uncertain:
    """Return the mean of a region with all that makes it uncertain; `region` names the pixels, `owner` one of several databases."""
    place, camera = (f"{owner}:{one}" for one in (f"{layer.object}/{layer.name}", layer.camera))
    return uncertain_mean(mean, budget.sources, layer=place, camera=camera, region=str(region))


def combine(
    of: Of,
    labels: Sequence[str],
    wavelengths: np.ndarray,
    first: Uncertain,
    second: Uncertain | None,
) -> tuple[Uncertain, list[str]]:
    """Return what is made of the means of one region or of two, and names of the numbers.

    Parameters
    ----------
    of : {"mean", "difference", "ratio", "delta_e"}
        Means; difference or ratio of the first two bands of one region, or of two regions, band by band; ΔE2000 of two regions
        under D65.
    labels, wavelengths : (n,)
        Of the bands.
    first, second : Uncertain, (n,)

    Raises RegionRefused: ``E_VALUE`` where it cannot be made of them.
    """
    if of == "mean" and second is None:
        return first, [*labels]
    n = len(labels)
    if of == "delta_e" and second is not None:
        if n < 3 or not np.isfinite(wavelengths).all():
            raise _unfit(f"{n} bands", "three bands or more, each with a wavelength")
        return join([first, second]).through(lambda v: _delta_e(v[:n], v[n:], wavelengths)), [
            "ΔE2000"
        ]
    if of not in ("difference", "ratio"):
        raise _unfit(
            f"of = {of!r}", f"one of {', '.join(get_args(Of))}; delta_e of two regions, mean of one"
        )
    make = np.subtract if of == "difference" else np.divide
    if second is not None:
        return join([first, second]).through(lambda v: make(v[:n], v[n:])), [*labels]
    if n != 2:
        raise _unfit(f"{n} bands", "two bands, or a second region")
    sign = "−" if of == "difference" else "/"
    return first.through(lambda v: make(v[:1], v[1:])), [f"{labels[0]} {sign} {labels[1]}"]


def _delta_e(first: np.ndarray, second: np.ndarray, wavelengths: np.ndarray) -> np.ndarray:
    from levkas.colour.gamut import delta_e_2000, lab_of

    return delta_e_2000(lab_of(first[None], wavelengths), lab_of(second[None], wavelengths))


def _unfit(found: str, expected: str) -> RegionRefused:
    return RegionRefused(
        Problem("E_VALUE", "no uncertainty of this can be stated", found=found, expected=expected)
    )


def to_dataset(made: Uncertain, names: Sequence[str], unknown: Sequence[str]) -> xarray.Dataset:
    """Return numbers with their uncertainties: `u` standard, `U` expanded, its random and common part, and every source's."""
    import xarray

    rows = made.by_source()
    random = rows.get("noise", np.zeros(len(made.values)))
    common = np.sqrt(np.maximum(made.sigma**2 - random**2, 0))
    found = xarray.Dataset(
        {
            "value": ("band", made.values),
            "u": ("band", made.sigma),
            "U": (
                "band",
                COVERAGE * made.sigma,
                {"long_name": f"expanded uncertainty, k = {COVERAGE:g}"},
            ),
            "u_random": ("band", random),
            "u_common": ("band", common),
            "u_by_source": (("source", "band"), np.array([*rows.values()]).reshape(-1, len(names))),
        },
        coords={"band": [*names], "source": [*rows]},
    )
    found["u"].attrs["long_name"] = "standard uncertainty"
    found.attrs["not_known"] = [*unknown]
    return found
