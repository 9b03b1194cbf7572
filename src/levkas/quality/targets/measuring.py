"""Measurement of a chart: signal and noise of its patches, blur, colour, tone, white balance.

Indicators stand beside the levels of FADGI and ISO 19264-1. They are never a certification: those
standards require their own targets, densities and whole systems."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.colour.gamut import delta_e_2000, xyz_to_lab
from levkas.colour.srgb import observer_under, visible_coverage, xyz_weights
from levkas.core.cube import Band, Cube, Flag, is_flagged
from levkas.core.json_safe import rounded
from levkas.quality.targets.charts import Chart, ChartReference, pixels_of
from levkas.quality.targets.edges import EdgeFindings, EdgePlace, join_findings, measure_named
from levkas.quality.targets.indicators import (
    IndicatorRow,
    WhiteEvenness,
    indicator,
    lightness_slope,
)
from levkas.quality.targets.locating import Located
from levkas.quality.targets.patches import (
    SATURATED,
    PatchTable,
    measure_patches,
    noise_planes,
    spread_about_plane,
)
from levkas.quality.targets.stray_light import (
    StrayLight,
    describe_stray_light,
    light_of_view,
    measure_stray_light,
    of_view,
)

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.quality.targets.patches import Preblur

DIGITS = 5
"""Significant digits of numbers in records."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """A chart in the cube of one sensor; `shots` and what follows as in `patches.measure_patches`."""

    sensor: str
    located: Located
    cube: Cube
    shots: tuple[np.ndarray, np.ndarray] | None = None
    steps: np.ndarray | tuple[float, ...] | None = None
    count: int = 1
    pattern: np.ndarray | None = None
    edges: tuple[EdgePlace, ...] = ()
    """Slanted edges that were named."""
    common: np.ndarray | None = None


@dataclass(frozen=True, eq=False)
class ChartMeasure:
    """Measurement of a chart by one camera under one setup."""

    name: str
    chart: Chart
    sightings: tuple[Sighting, ...]
    bands: tuple[Band, ...]
    table: PatchTable
    preblurs: tuple[Preblur | None, ...]
    colours: Colours | None = None
    rows: tuple[IndicatorRow, ...] = ()
    notes: tuple[str, ...] = ()
    edges: EdgeFindings = field(default_factory=EdgeFindings)
    stray: StrayLight | None = None
    trapped: str = ""

    @property
    def stray_light(self) -> str:
        """A sentence on stray light; empty without any that is certain."""
        return self.trapped or describe_stray_light(self.stray, self.bands) if self.stray else ""

    @property
    def wavelengths(self) -> np.ndarray:
        """Of the bands, nm; NaN where a channel is broad."""
        return np.array([band.wavelength for band in self.bands], float)

    @property
    def snr_db(self) -> np.ndarray:
        """(patches, bands), dB of Eq. (1), what a camera's own blur hides taken off."""
        return self.table.corrected_db(list(self.preblurs))

    def to_dict(self) -> dict[str, Any]:
        """Return the record for `--json`."""
        snr, snr_db, corrected = self.table.snr, self.table.snr_db, self.snr_db
        patches = [
            {
                "patch": patch,
                "pixels": int(self.table.pixels[i]),
                "mean": rounded(self.table.mean[i], DIGITS),
                "noise": rounded(self.table.noise[i], DIGITS),
                "snr": rounded(snr[i], DIGITS),
                "snr_db": rounded(snr_db[i], DIGITS),
                "snr_db_corrected": rounded(corrected[i], DIGITS),
                "saturated": rounded(self.table.saturated[i], DIGITS),
                "limited_by_quantisation": self.table.quantised[i].tolist(),
                "delta_e_2000": None
                if self.colours is None
                else rounded(self.colours.difference[i], DIGITS),
            }
            for i, patch in enumerate(self.chart.patches)
        ]
        return {
            "name": self.name,
            "chart": self.chart.name,
            "bands": [band.label for band in self.bands],
            "sensors": [
                {
                    "sensor": s.sensor,
                    "corners": np.round(s.located.corners, 2).tolist(),
                    "agreement": float(s.located.agreement),
                    "band_agreements": [
                        rounded(a, DIGITS) if np.isfinite(a) else None for a in s.located.bands
                    ],
                }
                for s in self.sightings
            ],
            "noise_from": "difference of shots" if self.table.temporal else "spread in the patch",
            "preblurred": [
                {"band": b.label, "lag1": rounded(p.lag1, DIGITS), "factor": float(p.factor)}
                for b, p in zip(self.bands, self.preblurs, strict=True)
                if p is not None and p.found
            ],
            "colours": None if self.colours is None else self.colours.how,
            "indicators": [row.to_dict() for row in self.rows],
            "edges": [table.to_dict() for table in self.edges.tables],
            "stray_light": [] if self.stray is None else self.stray.to_dict(self.bands),
            "patches": patches,
            "notes": list(self.notes),
        }


def measure(
    name: str,
    chart: Chart,
    sightings: Sequence[Sighting],
    reference: ChartReference | None,
    *,
    evenness: WhiteEvenness | None = None,
    notes: Sequence[str] = (),
) -> ChartMeasure:
    """Measure a chart where it was found."""
    table = _join_tables(sightings)
    bands = tuple(band for s in sightings for band in s.cube.bands)
    preblurs = [p for s in sightings for p in _preblurs(s)]
    wavelengths = np.array([band.wavelength for band in bands], float)
    unfit = np.concatenate([s.located.unfit for s in sightings])
    remarks = [*notes, *_warnings(table, bands, sightings), *_misfits(bands, sightings)]
    remarks += _unknown_bands(bands, reference)
    colours, rows = None, []
    reflective = all(s.cube.quantity == "reflectance" for s in sightings)
    visible = ~np.isfinite(wavelengths) | ((wavelengths > 380) & (wavelengths < 740))
    visible &= ~unfit
    if reference is not None:  # a channel in the infrared has no colour
        unfit = unfit | (np.isfinite(wavelengths) & ~reference.covers(wavelengths))
    clean = table.saturated.max() <= SATURATED
    if reference is None:
        remarks.append("no reference spectra: give --reference for colour differences")
    elif not reflective:
        remarks.append(
            "the cube is in counts: colours need a white, and a rendered photograph has signal and noise of its encoded values"
        )
    elif visible.sum() >= 3 and clean:
        means = table.mean[:, ~unfit]
        colours = compare_colours(means, wavelengths[~unfit], reference)
        weights = np.zeros(len(bands))
        weights[~unfit] = colours.weights
        noise = rate_noise(sightings, weights, table.mean @ weights, chart)
        rows = [*rate(colours, chart, evenness=evenness), *noise]
    elif not clean:
        remarks.append("colours are not compared where patches saturate")
    edges = join_findings([_edges(one) for one in sightings])
    stray = None
    if reference is not None and reflective and clean:
        means = np.where(unfit, np.nan, table.mean)
        stray = measure_stray_light(means, wavelengths, chart, reference)
        light = np.concatenate([light_of_view(one.cube) for one in sightings])
        stray = stray._replace(of_view=of_view(stray.shares, stray.errors, light))
        rows += _stray_row(stray, bands)
        remarks += filter(None, [describe_stray_light(stray, bands)])
    return ChartMeasure(
        name,
        chart,
        tuple(sightings),
        bands,
        table,
        tuple(preblurs),
        colours,
        (*rows, *edges.rows),
        (*remarks, *edges.notes),
        edges,
        stray,
    )


def _join_tables(sightings: Sequence[Sighting]) -> PatchTable:
    """Measure the patches in the cube of every sensor; return them over all bands."""
    tables = [_patches_of(one) for one in sightings]
    mean, noise, saturated, quantised = (
        np.concatenate([getattr(t, part) for t in tables], 1)
        for part in ("mean", "noise", "saturated", "quantised")
    )
    temporal = all(t.temporal for t in tables)
    return PatchTable(mean, noise, saturated, tables[0].pixels, temporal, quantised)


def _stray_row(stray: StrayLight, bands: Sequence[Band]) -> list[IndicatorRow]:
    """Return the row of the band with most stray light; none where no band's patches are published."""
    if not np.isfinite(stray.shares).any():
        return []
    most = int(np.nanargmax(np.abs(stray.shares)))
    name = f"stray light, of the white, most of all bands ({bands[most].label}), ± {100 * stray.errors[most]:.2f}"
    return [IndicatorRow(name, 100 * float(stray.shares[most]), "%", "0", "–", "–")]


def _edges(sighting: Sighting) -> EdgeFindings:
    period = 1 if sighting.pattern is None else max(sighting.pattern.shape)
    return measure_named(sighting.cube, sighting.edges, period=period)


def _misfits(bands: Sequence[Band], sightings: Sequence[Sighting]) -> list[str]:
    """Report which bands rank the patches otherwise than their wavelength should."""
    fit = np.concatenate([s.located.bands for s in sightings])
    unfit = np.concatenate([s.located.unfit for s in sightings])
    return [
        f"the signal of {bands[i].label} does not match its wavelength: rank correlation {fit[i]:.2f}. It is left out of the colours"
        for i in map(int, np.flatnonzero(unfit))
    ]


def _unknown_bands(bands: Sequence[Band], reference: ChartReference | None) -> list[str]:
    """Report of which bands nothing is published; they are compared with nothing."""
    if reference is None:
        return []
    nm = np.array([band.wavelength for band in bands], float)
    labels = [
        bands[i].label for i in np.flatnonzero(np.isfinite(nm) & ~reference.covers(nm)).tolist()
    ]
    if not labels:
        return []
    return [
        f"no reference for {_named(labels)}: the spectra ({reference.source}) cover {reference.wavelengths[0]:g} to "
        f"{reference.wavelengths[-1]:g} nm. Signal and noise are reported there without a comparison"
    ]


def _named(labels: Sequence[str]) -> str:
    more = f" and {len(labels) - 6} more" if len(labels) > 6 else ""
    return ", ".join(labels[:6]) + more


def _patches_of(sighting: Sighting) -> PatchTable:
    return measure_patches(
        *(sighting.cube.values, sighting.cube.flags, sighting.located.areas),
        shots=sighting.shots,
        steps=sighting.steps,
        count=sighting.count,
        pattern=sighting.pattern,
        common=sighting.common,
    )


def _preblurs(sighting: Sighting) -> list[Preblur | None]:
    """Find the blur of every band from its noise; None for demosaiced ones, whose neighbours are correlated."""
    from levkas.quality.targets.patches import find_preblur

    if sighting.pattern is not None:
        return [None] * len(sighting.cube.bands)
    found: list[Preblur | None] = []
    for planes in noise_planes(sighting.cube.values, sighting.located.areas, shots=sighting.shots):
        try:
            found.append(find_preblur(planes, fitted=3))
        except ValueError:  # patches too small for that
            found.append(None)
    return found


def _warnings(table: PatchTable, bands: Sequence[Band], sightings: Sequence[Sighting]) -> list[str]:
    doubts = []
    full = table.saturated.max(0)
    if full.max() > SATURATED:
        where = [b.label for b, share in zip(bands, full, strict=True) if share > SATURATED]
        doubts.append(
            f"patches saturate in {_named(where)}: no SNR there; capture the chart with less exposure"
        )
    coarse = table.quantised.sum(0)
    if coarse.any():
        where = [f"{b.label} ({n})" for b, n in zip(bands, coarse, strict=True) if n]
        doubts.append(
            "the signal-to-noise is limited by quantisation, the rounding to codes, in patches of "
            f"{_named(where)}: expose longer, or save more bits"
        )
    glared = any(is_flagged(s.cube.flags, Flag.GLARE).any() for s in sightings)
    if glared:
        doubts.append("there is glare on the chart")
    if not table.temporal:
        doubts.append("one shot: the noise holds the chart's own texture; two shots would not")
    if int(table.pixels.min()) < 100:
        doubts.append(f"only {int(table.pixels.min())} pixels a patch: SNR within 10 % at best")
    return doubts


LEAST_COVERAGE = 0.9


class Colours(NamedTuple):
    """CIELAB (D65, 2°) of every patch as measured and as referred to, ΔE2000, and the bands' weights in luminance Y."""

    measured: np.ndarray
    wanted: np.ndarray
    difference: np.ndarray
    how: str
    weights: np.ndarray


def compare_colours(
    means: np.ndarray, wavelengths: np.ndarray, reference: ChartReference
) -> Colours:
    """Compare the patches' colours with those of the reference spectra.

    Parameters
    ----------
    means : ndarray, (patches, bands)
        Reflectance.
    wavelengths : ndarray, (bands,), nm
        NaN for broad channels.

    Notes
    -----
    Bands that cover the visible range are integrated. From others a linear matrix to XYZ is fitted
    to the chart itself, each patch by the matrix of all the others: an upper bound of what a
    profile would leave, and no measure of the camera's lighting.
    """
    grid, _ = observer_under()
    spectra = reference.at(np.clip(grid, reference.wavelengths[0], reference.wavelengths[-1]))
    wanted = spectra @ observer_under()[1]
    narrow = np.isfinite(wavelengths)
    covered = narrow.sum() >= 8 and visible_coverage(wavelengths[narrow]) >= LEAST_COVERAGE
    weights = np.zeros(means.shape[1])
    if covered:
        measured = means[:, narrow] @ xyz_weights(wavelengths[narrow])
        weights[narrow] = xyz_weights(wavelengths[narrow])[:, 1]
        how = f"integrated over {int(narrow.sum())} bands"
    else:
        measured = _left_out(means, wanted)
        weights = np.linalg.lstsq(means, wanted[:, 1], rcond=1e-6)[0]
        how = f"by a matrix from {means.shape[1]} channels, each patch left out in turn"
    a, b = lab_of(measured), lab_of(wanted)
    return Colours(a, b, delta_e_2000(a, b), how, weights)


def _left_out(means: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    guessed = np.empty_like(wanted)
    for i in range(len(means)):
        others = np.arange(len(means)) != i
        guessed[i] = means[i] @ np.linalg.lstsq(means[others], wanted[others], rcond=1e-6)[0]
    return guessed


def lab_of(xyz: np.ndarray) -> np.ndarray:
    """Return CIELAB of XYZ under D65, white Y = 1; what is below black is black.

    >>> [round(float(v)) for v in lab_of(np.array([0.9505, 1.0, 1.089]) / 2)]
    [76, 0, 0]
    """
    return xyz_to_lab(np.maximum(xyz, 0), observer_under()[1].sum(0))


def rate(
    colours: Colours, chart: Chart, *, evenness: WhiteEvenness | None = None
) -> list[IndicatorRow]:
    """Return the rows of colour, tone, white balance and light of a chart."""
    greys = list(chart.greys)
    measured, wanted = colours.measured[greys], colours.wanted[greys]
    tone = measured[:, 0] - wanted[:, 0]
    # White balance: what grey gained in colour, over what the reference's own grey has.
    cast = np.linalg.norm(measured[:, 1:] - wanted[:, 1:], axis=1)
    gains = np.diff(measured[:, 0]) / np.diff(wanted[:, 0])
    farthest = gains[1:][np.argmax(np.abs(gains[1:] - 1))]
    off, unit = colours.difference, "ΔE2000"
    rows = [
        indicator("colour", "ΔE2000, mean over patches", float(np.mean(off)), unit),
        indicator(
            "colour 90", "ΔE2000, 90th percentile of patches", float(np.quantile(off, 0.9)), unit
        ),
        indicator("worst", "ΔE2000, worst patch", float(np.max(off)), unit),
        indicator("tone", "tone, worst grey", float(np.abs(tone).max()), "ΔL*"),
        indicator("gain bright", "gain modulation, brightest step of grey", float(gains[0]), ""),
        indicator("gain", "gain modulation, other step of grey farthest from 1", float(farthest), ""),
        indicator("white", "white balance, worst grey", float(cast.max()), "Δ(a*, b*)"),
    ]  # fmt: skip
    if evenness is not None:
        name = "uniformity of the light, least over greatest"
        rows.append(IndicatorRow(name, 100 * evenness.least, "%", "100", "–", "–"))
        name = "lightness non-uniformity of the white before its flat field"
        rows.append(indicator("light", name, 100 * evenness.spread, "%"))
    return rows


def noise_of_lightness(
    sightings: Sequence[Sighting],
    weights: np.ndarray,
    luminances: np.ndarray,
    patches: Sequence[int],
) -> np.ndarray:
    """Return the standard deviation of L* in patches about a fitted plane, (patches,), NaN where one saturates.

    Of the values as they are delivered: mean of shots, demosaiced, the chart's texture included. `weights` are those of luminance Y,
    (bands,), over the bands of all sensors, whose noise is independent; `luminances` Y of the patches, (patches,), white 1.
    Sensors see the patch on pixels of their own, so that σ(Y) is propagated: σ(L*) = σ(Y)·dL*/dY.
    """
    variance, first = np.zeros(len(patches)), 0
    for one in sightings:
        part = weights[first : first + one.cube.values.shape[2]]
        first += len(part)
        for i, patch in enumerate(patches):
            rows, columns = pixels_of(one.located.areas[patch])
            full = is_flagged(one.cube.flags[rows, columns], Flag.SATURATED)
            light = one.cube.values[rows, columns].astype(float) @ part
            if full.mean(0).max() > SATURATED or not np.isfinite(light).all():
                variance[i] = np.nan
                continue
            variance[i] += spread_about_plane(light, rows, columns) ** 2
    return np.sqrt(variance) * lightness_slope(luminances)


def rate_noise(
    sightings: Sequence[Sighting], weights: np.ndarray, luminances: np.ndarray, chart: Chart
) -> list[IndicatorRow]:
    """Return the row of the noise of L* in the grey patches, none where they saturate."""
    greys = list(chart.greys)
    noise = noise_of_lightness(sightings, weights, luminances[greys], greys)
    if not np.isfinite(noise).any():
        return []
    worst = int(np.nanargmax(noise))
    name = f"noise of L*, worst grey ({chart.patches[greys[worst]]})"
    return [indicator("noise", name, float(noise[worst]), "L*")]
