"""Do two cameras agree about a painting? Means of even patches, compared within their uncertainties, band by band.

A band of one camera is predicted from the spectrum of another that has bands on both sides of it, as its sensitivity weighs
them. The expected ratio Eₙ ([iso13528]_) of a difference is formed with what both share left out: the white of the campaign, the place on
the panel.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from itertools import combinations
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.interpolate import CubicSpline

from levkas.calibration.error_sources import COVERAGE, MeanSpectrum, Uncertain, join
from levkas.database.described import LayerRows
from levkas.database.pixel_frames import MappingRefused, Records
from levkas.database.region_uncertainty import (
    LayerBudget,
    mean_of_region,
    position_sigmas,
    uncertain_region,
    with_place,
)
from levkas.database.regions import TRUSTED, Region, RegionRefused

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.core.cube import Band
    from levkas.database.described import Pixels
    from levkas.database.layout import LayerId
    from levkas.geometry.transforms import Transform


Sensitivities = dict[str, tuple[np.ndarray, np.ndarray]]
"""Of the bands of a layer, by label: nm, and the response there."""


SIDE = 12
"""Px of a patch: 100 pixels and more make noise small beside what is common, 24 px hold few even patches of an icon."""
ROWS, COLUMNS = 6, 24
"""Most strips of the grid from which patches are taken, and most patches of each: what is read of a large layer."""
UNEVEN = 0.15
"""Standard deviation of a patch over its mean, from which it is no even one: there the place counts more than the light."""
LEAST = 8
"""Patches by which a pair of bands is judged."""
DARK = 0.02
"""Mean of a patch below which its ratio is one of noise."""
APART = 0.02
"""Relative difference below which no contradiction between cameras is reported: bands of other shapes differ by that much."""
REACH_NM = 40.0
"""How far a band of the first may lie from that of the second on either side."""
SAME_NM, SAME_WIDTH = 1.0, 0.2
"""By how much centres of bands, and widths relatively, may differ for the bands to be one."""


@dataclass(frozen=True, eq=False)
class PatchMeans:
    """What a layer has on some patches of the grid.

    Parameters
    ----------
    places : ndarray, (p, 2), px
        Corners of the patches, least x and y.
    means : tuple of MeanSpectrum, (p,)
    numbers : tuple of Uncertain, (p,)
        The same with their errors.
    fwhm : ndarray, (n,), nm
        Widths of the bands; NaN where they are not known.
    unknown : tuple of str
        Sources of error that nothing is known of.
    name : str
        Of the layer in the report; its own by default.
    """

    layer: LayerId
    places: np.ndarray
    means: tuple[MeanSpectrum, ...]
    numbers: tuple[Uncertain, ...]
    fwhm: np.ndarray
    unknown: tuple[str, ...] = ()
    name: str = ""

    @property
    def wavelengths(self) -> np.ndarray:
        """Centres of the bands, (n,), nm."""
        return self.means[0].wavelengths

    @property
    def labels(self) -> Sequence[str]:
        """Names of the bands."""
        return self.means[0].labels


@dataclass(frozen=True, eq=False)
class BandAgreement:
    """How one band of a layer agrees with another layer's spectrum."""

    band: str
    wavelength: float
    ratio: float
    spread: float
    expected_ratio: float
    values: np.ndarray
    expected: np.ndarray

    @property
    def contradicts(self) -> bool:
        """Whether the difference is more than both uncertainties allow, and than bands of other shapes differ by."""
        return self.expected_ratio > 1 and abs(self.ratio - 1) > APART


@dataclass(frozen=True, eq=False)
class PairAgreement:
    """How two layers agree, the bands of the second against the spectrum of the first."""

    first: LayerId
    second: LayerId
    places: np.ndarray
    bands: tuple[BandAgreement, ...]
    unknown: tuple[str, ...] = ()
    names: tuple[str, str] = ("", "")

    @property
    def other_light(self) -> bool:
        """Whether they were captured under two lightings, so that they need not agree."""
        return self.first.setup != self.second.setup

    @property
    def contradictions(self) -> tuple[BandAgreement, ...]:
        """Bands that contradict each other."""
        return tuple(band for band in self.bands if band.contradicts)

    @property
    def worst(self) -> BandAgreement:
        """The band that differs most for its uncertainty."""
        return max(self.bands, key=lambda band: (band.contradicts, band.expected_ratio))

    def to_dict(self) -> dict[str, Any]:
        """Return the numbers, JSON-ready."""
        return {
            "layers": [*self.names],
            "patches": len(self.places),
            "other_light": self.other_light,
            "not_known": [*self.unknown],
            "bands": [
                {
                    "band": band.band,
                    "wavelength_nm": round(band.wavelength, 2),
                    "ratio": round(band.ratio, 4),
                    "spread": round(band.spread, 4),
                    "expected_ratio": round(band.expected_ratio, 3),
                    "contradicts": band.contradicts,
                }
                for band in self.bands
            ],
        }


def choose_patches(rows: LayerRows) -> np.ndarray:
    """Return the corners of even patches of a layer, (p, 2) px, some strips of the grid over."""
    (height, width, _), side = rows.shape, SIDE
    tops = np.unique(np.linspace(side, height - 2 * side, ROWS).astype(int))
    starts = np.unique(np.linspace(side, width - 2 * side, COLUMNS).astype(int))
    found = []
    for top in tops[tops >= 0].tolist():
        values, flags, _ = rows.read(top, top + side)
        sound = ((flags & ~TRUSTED) == 0).all((0, 2))
        for start in starts[starts >= 0].tolist():
            patch = values[:, start : start + side].mean(-1)
            even = patch.std() < UNEVEN * max(float(patch.mean()), DARK)
            if even and sound[start : start + side].all():
                found.append((start, top))
    return np.array(found, int).reshape(-1, 2)


def measure_patches(
    rows: LayerRows,
    places: np.ndarray,
    budget: LayerBudget,
    *,
    at: Transform | None = None,
    owner: str = "",
    records: Records | None = None,
) -> PatchMeans:
    """Return what a layer has on patches.

    Parameters
    ----------
    places : ndarray, (p, 2)
        Corners of the patches, px.
    at : Transform, optional
        Pixels of the patches → pixels of the layer, where these are others.
    owner : str
        Of what errors of a camera belong to, where several databases are compared.
    records : Records, optional
        Of the layer's object, as of `position_sigmas`.
    """
    labels = [band.label for band in rows.bands]
    places = places[np.lexsort((places[:, 0], places[:, 1]))]
    corners = places[:, None] + SIDE * CORNERS - 0.5
    if at is not None:
        corners = at(corners.reshape(-1, 2)).reshape(corners.shape)
    known = position_sigmas(rows.root, rows.layer, labels, corners.mean(1), records)
    means, numbers = [], []
    for some in (places[:, 1] == top for top in np.unique(places[:, 1])):
        height = rows.shape[0]
        low, high = (int(np.clip(f(corners[some, :, 1]), 0, height)) for f in (np.min, np.max))
        low = max(0, low - 1)
        strip = rows.read(low, min(high + 2, height)) if low < height else None
        for place, outline, sigmas in zip(
            places[some].tolist(), corners[some], known[some], strict=True
        ):
            mean = _mean_of(strip, outline - (0, low), budget, rows.bands)
            here = with_place(budget, labels, sigmas)
            means.append(mean)
            numbers.append(uncertain_region(mean, here, rows.layer, place, owner=owner))
    fwhm = np.array([band.fwhm for band in rows.bands])
    unknown = tuple(row.name for row in budget.sources if row.basis == "unknown")
    return PatchMeans(rows.layer, places, tuple(means), tuple(numbers), fwhm, unknown)


CORNERS = np.array([(0.0, 0.0), (1, 0), (1, 1), (0, 1)])


def _mean_of(
    strip: Pixels | None, outline: np.ndarray, budget: LayerBudget, bands: Sequence[Band]
) -> MeanSpectrum:
    """Return the mean of a patch; NaN in every band where it lies outside."""
    if strip is not None:
        with suppress(RegionRefused):
            return mean_of_region(strip, bands, Region(outline), budget.correlation)
    none = np.full(len(bands), np.nan)
    nm = np.array([band.wavelength for band in bands])
    return MeanSpectrum([band.label for band in bands], none, np.zeros(len(bands)), nm)


def weigh_bands(
    first: PatchMeans,
    second: PatchMeans,
    sensitivities: Sensitivities,
    *,
    of_first: Sensitivities | None = None,
) -> dict[int, np.ndarray]:
    """Return how the bands of the second are made of the first's, (2, n₁) each, by their number: by a cubic spline and by straight lines.

    A narrow band is interpolated between the nearest; a broad one is weighed by its sensitivity, (nm, response), where the first has bands
    over all that matters of it. Bands lie at the centroids of their sensitivities under their light: one filter under two lightings is two bands.
    """
    nm = np.array([_centroid(first, k, of_first or {}) for k in range(len(first.labels))])
    nm[~np.isfinite(first.wavelengths)] = np.nan  # broad channels are no samples of a spectrum
    known = np.flatnonzero(np.isfinite(nm))
    order = known[np.argsort(nm[known], kind="stable")]
    at, found = nm[order], {}
    if not len(at):
        return {}
    for k, label in enumerate(second.labels):
        centre = _centroid(second, k, sensitivities)
        if len(same := _same_band(nm, first.fwhm, centre, second.fwhm[k])):
            found[k] = np.tile(np.arange(len(nm)) == same[0], (2, 1)).astype(float)
            continue
        grid, weights = sensitivities.get(label, (np.array([centre]), np.ones(1)))
        if not np.isfinite(grid).all():
            continue
        weights = weights / weights.sum()
        if len(at) < 2:
            continue
        inside = (grid >= at[0]) & (grid <= at[-1])
        gaps = np.diff(at)[np.clip(np.searchsorted(at, grid) - 1, 0, len(at) - 2)]
        if weights[inside & (gaps <= 2 * REACH_NM)].sum() < 0.99:
            continue
        rows = np.zeros((2, len(nm)))
        within = np.clip(grid, at[0], at[-1])
        each = np.eye(len(at))
        rows[0, order] = weights @ CubicSpline(at, each, bc_type="natural")(within)
        rows[1, order] = [np.interp(within, at, one) @ weights for one in each]
        found[k] = rows
    return found


def _same_band(nm: np.ndarray, fwhm: np.ndarray, centre: float, width: float) -> np.ndarray:
    """Return the numbers of the bands that see what a band of some centre and width does."""
    with np.errstate(invalid="ignore"):
        near = np.abs(nm - centre) <= SAME_NM
        wider = np.abs(fwhm - width) > SAME_WIDTH * width
    return np.flatnonzero(near & ~wider)


def compare_layers(
    first: PatchMeans,
    second: PatchMeans,
    sensitivities: Sensitivities,
    *,
    of_first: Sensitivities | None = None,
) -> PairAgreement | None:
    """Compare the bands of the second, whose sensitivities they are, with what the first predicts; None where none can be."""
    rows = weigh_bands(first, second, sensitivities, of_first=of_first)
    if not rows:
        return None
    bands = np.array([*rows])
    weights, lines = np.array([*rows.values()]).swapaxes(0, 1)
    ratios, expected = np.full((2, len(first.places), len(bands)), np.nan)
    for p, (one, other) in enumerate(zip(first.numbers, second.numbers, strict=True)):
        predicted = _weighted(one, weights)
        between = np.nan_to_num(_weighted_values(one, lines) - predicted.values)
        for k, size in zip(bands.tolist(), np.diag(between), strict=True):
            predicted.parts["between bands", "", k] = size
        own = Uncertain(other.values[bands], {k: v[bands] for k, v in other.parts.items()})
        n = len(bands)
        apart = Uncertain(
            own.values - predicted.values,
            {k: v[n:] - v[:n] for k, v in join([predicted, own]).parts.items()},
        )
        sigma = apart.sigma
        good = (predicted.values > DARK) & np.isfinite(own.values) & (sigma > 0)
        ratios[p, good] = own.values[good] / predicted.values[good]
        expected[p, good] = np.abs(apart.values[good]) / (COVERAGE * sigma[good])
    centres = {k: _centre(second, k, sensitivities) for k in rows}
    made = tuple(
        _band(second.labels[k], centres[k], ratios[:, i], expected[:, i])
        for i, k in enumerate(bands.tolist())
        if np.isfinite(ratios[:, i]).sum() >= LEAST
    )
    if not made:
        return None
    unknown = tuple(dict.fromkeys((*first.unknown, *second.unknown)))
    names = first.name or first.layer.name, second.name or second.layer.name
    return PairAgreement(first.layer, second.layer, first.places, made, unknown, names)


def _weighted(one: Uncertain, weights: np.ndarray) -> Uncertain:
    """Return weighted sums of bands; NaN where one that counts is."""
    parts = np.nan_to_num([*one.parts.values()]).reshape(-1, len(one.values)) @ weights.T
    return Uncertain(_weighted_values(one, weights), dict(zip(one.parts, parts, strict=True)))


def _weighted_values(one: Uncertain, weights: np.ndarray) -> np.ndarray:
    known = np.isfinite(one.values)
    made = weights @ np.where(known, one.values, 0.0)
    made[(weights[:, ~known] > 0).any(1)] = np.nan
    return made


def _centre(layer: PatchMeans, k: int, sensitivities: Sensitivities) -> float:
    """Return the wavelength by which a band is named, nm; of a broad one the centroid of its sensitivity."""
    if np.isfinite(layer.wavelengths[k]):
        return float(layer.wavelengths[k])
    return _centroid(layer, k, sensitivities)


def _centroid(layer: PatchMeans, k: int, sensitivities: Sensitivities) -> float:
    """Return where the light of a band lies, nm: at its stated wavelength where no sensitivity is known."""
    grid, weights = sensitivities.get(layer.labels[k], (np.full(1, np.nan), np.ones(1)))
    found = float(grid @ weights / weights.sum())
    return found if np.isfinite(found) else float(layer.wavelengths[k])


def _band(label: str, centre: float, ratios: np.ndarray, expected: np.ndarray) -> BandAgreement:
    ratio = float(np.nanmedian(ratios))
    spread = 1.4826 * float(np.nanmedian(np.abs(ratios - ratio)))
    return BandAgreement(
        label, centre, ratio, spread, float(np.nanmedian(expected)), ratios, expected
    )


def compare_all(
    layers: Sequence[PatchMeans], sensitivities: Mapping[str, Sensitivities]
) -> tuple[PairAgreement, ...]:
    """Compare all pairs of layers, the one with fewer bands against the spectrum of the other.

    `sensitivities` are those of the broad bands of each layer, by its name.
    """
    found = []
    for pair in combinations(layers, 2):
        first, second = sorted(pair, key=lambda one: -len(one.labels))
        of_first, of_second = (sensitivities.get(one.layer.name, {}) for one in (first, second))
        made = compare_layers(first, second, of_second, of_first=of_first)
        if made is None:
            made = compare_layers(second, first, of_first, of_first=of_second)
        if made is not None:
            found.append(made)
    return tuple(found)


def agreement_in(
    root: Path,
    layers: Sequence[LayerId],
    budgets: Mapping[str, LayerBudget],
    sensitivities: Mapping[str, Sensitivities],
    registrations: Mapping[str, dict[str, Any]] | None = None,
) -> tuple[PairAgreement, ...]:
    """Compare the layers of one object of a database that hold reflectance; the first says where it is even."""
    opened = [LayerRows.open(root, layer) for layer in layers]
    opened = [rows for rows in opened if rows.described.quantity == "reflectance"]
    if len(opened) < 2:
        return ()
    places = choose_patches(opened[0])
    if len(places) < LEAST:
        return ()
    records = None
    with suppress(MappingRefused):  # of a layer without a registration no place is known
        records = Records(root, opened[0].layer.object, registrations)
    measured = [
        measure_patches(rows, places, budgets.get(rows.layer.name, LayerBudget()), records=records)
        for rows in opened
    ]
    return compare_all(measured, sensitivities)
