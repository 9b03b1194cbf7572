"""A chart in place of a white frame: found in its calibrated counts, its light fitted band by band."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.calibration.chart_light import (
    ChartLight,
    ChartOutline,
    LightFit,
    LightMap,
    Patches,
    PatchScatter,
    fit_light,
)
from levkas.calibration.patterns import channel_table
from levkas.calibration.sensor_context import placed
from levkas.core.cube import UNRELIABLE, Band, Cube, Flag, is_flagged
from levkas.core.problems import Problem
from levkas.core.text import read_text
from levkas.quality.targets.charts import (
    Chart,
    ChartReference,
    ChartRefused,
    chart_of,
    parse_reference,
    pixels_of,
    reference_of,
)
from levkas.quality.targets.locating import Located, locate_in_cube
from levkas.quality.targets.patches import SATURATED, PatchTable, measure_patches
from levkas.stages.spectra import COVERED, BandWeights, weights_of_bands

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture, SensorFrames
    from levkas.stages.parts import CalibratedCapture

LEAST_GREYS = 3
"""Grey patches that a level needs: two would hide a third that is dirty."""
ABOVE_DARK = 3.0
"""Standard deviations that the mean of a patch must lie above dark."""
GREY_NM = np.arange(420.0, 701.0, 10.0)
"""Where greys are averaged for a channel of which no sensitivity is known."""
HIDDEN = 0.2
"""Share of saturated pixels that explains why a chart is not recognised."""
NOT_FOUND = ("E_CHART_MISSING", "E_CHART_ORDER")
DOUBTFUL = 0.05
"""Held-out error of a patch, reflectance, rms, from which the report warns."""


class KnownReflectance(NamedTuple):
    """What a chart reflects in the bands of a sensor.

    Parameters
    ----------
    reflectance : ndarray, (patches, bands)
        NaN where unknown.
    why : dict of label to str
        Of bands in which only the grey patches, or none, are known: why.
    spread : dict of label to float
        By how much greys differ over the wavelengths that a band may see, relative, where these are unknown.
    """

    reflectance: np.ndarray
    why: dict[str, str]
    spread: dict[str, float]


def lights_by_chart(
    capture: Capture, campaign: Campaign, native: CalibratedCapture
) -> dict[str, ChartLight]:
    """Fit the light of every sensor of a capture to the chart in its counts above dark.

    Parameters
    ----------
    capture : Capture
        Whose sensors have frames of a `chart`.
    native : CalibratedCapture
        Those frames, calibrated without a white.

    Raises
    ------
    Refused
        ChartRefused, with the files in question: no chart in the frame, unknown spectra, saturated
        patches, too few grey ones.
    """
    white = campaign.cameras[capture.camera].white_chart
    assert white is not None
    chart, reference = spectra_of_chart(campaign, capture.camera)
    corners = None if white.corners is None else np.array(white.corners, float)
    lights: dict[str, ChartLight] = {}
    near: np.ndarray | None = None
    cubes = native.cubes
    for sensor in capture.sensors:
        cube = cubes[sensor.name]
        try:
            found = locate_in_cube(cube, chart, reference, corners=corners, near=near)
            near = found.corners if near is None else near
            known = known_reflectance(campaign, capture, sensor.bands, chart, reference)
            times = native.measured[sensor.name].get("exposures_s", {})
            fitted = _fit_bands(sensor, cube, chart, found, known)
        except ChartRefused as refused:
            named = [_named(p, capture.camera) for p in refused.problems]
            if named[0].code in NOT_FOUND and (full := _overexposed(cube, capture.camera)):
                named = [full]
            raise ChartRefused(*(placed(p, sensor.chart) for p in named)) from None
        lights[sensor.name] = _light(capture, campaign, sensor, fitted, times, reference, found)
    return lights


def spectra_of_chart(campaign: Campaign, camera: str) -> tuple[Chart, ChartReference]:
    """Return the chart that is a camera's white, and its spectra; raises Refused where there are none."""
    white = campaign.cameras[camera].white_chart
    assert white is not None
    chart = chart_of(campaign.targets.charts.get(white.chart, white.chart))
    if white.reference is not None:
        path = campaign.root / white.reference
        text = read_text(path, "a CSV of the chart's spectra")
        return chart, parse_reference(text, chart, file=str(path))
    reference = reference_of(chart)
    if reference is None:
        raise ChartRefused(
            Problem(
                "E_CHART_REFERENCE",
                f"{camera}: the spectra of its chart are unknown: none are published for the {chart.name}",
                str(campaign.path),
                f"cameras.{camera}.white.reference",
                "none",
                "a CSV with wavelength in nm and one column per patch",
                'Measure the chart, and write white = { chart = "…", reference = "chart.csv" }.',
            )
        )
    return chart, reference


def _named(problem: Problem, camera: str) -> Problem:
    """Return a refusal of a chart with the camera whose white it is to be."""
    field = f"cameras.{camera}.white.chart"
    fix = (problem.fix or "").replace("--corners x,y,x,y,x,y,x,y", "`corners` beside `chart`")
    message = f"{camera}: {problem.message}; this chart is declared as the white of the camera"
    return replace(problem, message=message, field=field, fix=fix or None)


def _overexposed(cube: Cube, camera: str) -> Problem | None:
    """Return the refusal of frames in which a chart cannot be found because so much of them is saturated."""
    shares = is_flagged(cube.flags, Flag.SATURATED).mean((0, 1))
    i = int(np.argmax(shares))
    if shares[i] < HIDDEN:
        return None
    return Problem(
        "E_WHITE_SATURATED",
        f"{camera}: the chart declared as its white was not found, because the frame is saturated",
        field=f"cameras.{camera}.white.chart",
        found=f"{100 * shares[i]:.0f} % of the pixels in {cube.bands[i].label}",
        expected="the white patch at 85 % of saturation",
        fix="Capture the chart with a shorter exposure.",
    )


# --- what the chart reflects --------------------------------------------------------------------


def known_reflectance(
    campaign: Campaign,
    capture: Capture,
    bands: Sequence[Band],
    chart: Chart,
    reference: ChartReference,
) -> KnownReflectance:
    """Return what the patches reflect in each band: their spectra integrated over its sensitivity.

    The sensitivity is the declared table, times the spectrum of the setup's light where one is declared;
    else the band is taken as Gaussian of its width, or at its wavelength alone. Of a broad channel without
    a table only the grey patches are known, whose spectra are flat.
    """
    grid = np.arange(reference.wavelengths[0], reference.wavelengths[-1] + 0.5, 1.0)
    spectra, greys = reference.at(grid), list(chart.greys)
    found = np.full((len(chart.patches), len(bands)), np.nan)
    why: dict[str, str] = {}
    spread: dict[str, float] = {}
    for i, (band, weights) in enumerate(
        zip(bands, weights_of_bands(campaign, capture, bands), strict=True)
    ):
        if weights is None:
            why[band.label] = (
                "no sensitivity is known, so only the grey patches can be used; declare `sensitivity`, or "
                "`wavelengths` of narrow bands"
            )
            published = reference.at(GREY_NM)[greys]
            found[greys, i] = np.nanmean(published, axis=1)
            level = np.nanmean(published / found[greys, i][:, None], axis=0)
            spread[band.label] = float(np.nanstd(level))
        elif weights.weights[reference.covers(weights.wavelengths)].sum() < (
            COVERED * weights.weights.sum()
        ):
            centre = float(np.average(weights.wavelengths, weights=weights.weights))
            why[band.label] = _beyond(reference, centre)
        else:
            inside = reference.covers(weights.wavelengths)
            within = BandWeights(weights.wavelengths[inside], weights.weights[inside])
            found[:, i] = within.mean_of(grid, spectra)
    return KnownReflectance(found, why, spread)


def _beyond(reference: ChartReference, nm: float) -> str:
    first, last = reference.wavelengths[0], reference.wavelengths[-1]
    where = "infrared" if nm > (first + last) / 2 else "ultraviolet"
    return f"no reference in the {where}: the chart's spectra ({reference.source}) cover {first:g} to {last:g} nm"


# --- the fit ------------------------------------------------------------------------------------


class SensorLight(NamedTuple):
    """The light of a sensor, band by band, with the patches that it was fitted to."""

    chart: Chart
    outline: ChartOutline
    fits: dict[str, LightFit]
    used: dict[str, np.ndarray]
    why: dict[str, str]
    light_of: dict[str, str]
    unevenness: dict[str, float]
    scatter: dict[str, PatchScatter]
    size: tuple[int, int]


def _fit_bands(
    sensor: SensorFrames, cube: Cube, chart: Chart, found: Located, known: KnownReflectance
) -> SensorLight:
    """Fit the light in every band of a sensor."""
    mosaic = sensor.pattern is not None and len(cube.bands) > 1 and _is_mosaic(sensor)
    labels = [band.label for band in cube.bands]
    table = channel_table(sensor.pattern, labels) if mosaic and sensor.pattern else None
    patches = measure_patches(cube.values, cube.flags, found.areas, pattern=table)
    outline = ChartOutline.around(found.areas.reshape(-1, 2))
    why, problems = dict(known.why), []
    full: dict[str, tuple[np.ndarray, Patches]] = {}
    greys: dict[str, tuple[np.ndarray, Patches]] = {}
    for i, band in enumerate(cube.bands):
        reflectance = known.reflectance[:, i].copy()
        if found.unfit[i] and band.label not in why:
            why[band.label] = (
                f"the order of its patches does not match its wavelength ({found.bands[i]:.2f}), as "
                "with a leaking filter; it is scaled by the grey patches alone"
            )
        if band.label in why:
            keep = np.isin(np.arange(len(reflectance)), chart.greys)
            reflectance[~keep] = np.nan
        used = _usable(patches, i) & np.isfinite(reflectance)
        if problem := _too_few(chart, patches, i, band, used, why.get(band.label, "")):
            problems.append(problem)
            continue
        (greys if band.label in why else full)[band.label] = (
            used,
            _of_band(found, patches, i, used, reflectance, chart),
        )
    if problems:
        raise ChartRefused(*problems)
    fits = {label: fit_light(part, outline) for label, (_, part) in full.items()}
    light_of = {label: _nearest(label, cube.bands, list(full)) for label in greys}
    for label, (_, part) in greys.items():
        fits[label] = fit_light(
            part, outline, fits[light_of[label]].shape if light_of[label] else None
        )
    used_patches = {label: used for label, (used, _) in (full | greys).items()}
    uneven = {
        b.label: _unevenness(cube, i, found, patches, table) for i, b in enumerate(cube.bands)
    }
    scatter = {}
    for i, (label, column) in enumerate(zip(labels, known.reflectance.T, strict=True)):
        one = _scatter(found, patches, i, column, fits[label], used_patches[label], chart)
        relative = float(np.hypot(one.relative, known.spread.get(label, 0.0)))
        scatter[label] = one._replace(relative=relative)
    size = (cube.values.shape[0], cube.values.shape[1])
    return SensorLight(chart, outline, fits, used_patches, why, light_of, uneven, scatter, size)


def _scatter(
    found: Located,
    patches: PatchTable,
    i: int,
    reflectance: np.ndarray,
    fit: LightFit,
    used: np.ndarray,
    chart: Chart,
) -> PatchScatter:
    """Return what patches of a band miss beyond light and noise, those too that its light is not fitted to.

    Of a filter that leaks the greys give the level, and the coloured patches what the leak does to paints.
    """
    there = _usable(patches, i) & np.isfinite(reflectance)
    part = _of_band(found, patches, i, there, reflectance, chart)
    light = np.maximum(fit(part.places), 1e-9)
    errors = part.levels / light - part.reflectance
    errors[np.isin(np.flatnonzero(there), np.flatnonzero(used))] = fit.errors
    expected = part.variance / light**2 + (part.reflectance * fit.sigma(part.places)) ** 2
    return PatchScatter.fit(errors, part.reflectance, expected)


def _is_mosaic(sensor: SensorFrames) -> bool:
    """Whether the bands are the channels of the sensor's mosaic, not filters before it."""
    names = {name for row in sensor.pattern or () for name in row}
    return names == {band.label for band in sensor.bands}


def _usable(patches: PatchTable, band: int) -> np.ndarray:
    mean, noise = patches.mean[:, band], patches.noise[:, band]
    above = mean > np.maximum(ABOVE_DARK * noise / np.sqrt(patches.pixels), 0)
    return np.asarray(np.isfinite(mean) & (patches.saturated[:, band] <= SATURATED) & above)


def _too_few(
    chart: Chart, patches: PatchTable, i: int, band: Band, used: np.ndarray, why: str
) -> Problem | None:
    """Return the refusal of a band in which too few grey patches can be used."""
    greys = list(chart.greys)
    count = int(used[greys].sum())
    if count >= LEAST_GREYS:
        return None
    expected = f"at least {LEAST_GREYS} grey patches"
    if why.startswith("no reference"):
        return Problem(
            "E_CHART_REFERENCE",
            f"{band.label}: {why}",
            found="nothing there",
            expected="spectra over the whole range of the band",
            fix="Measure the spectra of the chart over this range and write `reference = "
            '"chart.csv"` beside `chart`, or capture a white.',
        )
    full = [chart.patches[n] for n in greys if patches.saturated[n, i] > SATURATED]
    if full:
        return Problem(
            "E_WHITE_SATURATED",
            f"{band.label}: grey patches of the chart are saturated",
            found=f"{', '.join(full)} saturated, {count} of {len(greys)} usable",
            expected=expected,
            fix="Capture the chart with a shorter exposure: its white patch at 85 % of saturation.",
        )
    return Problem(
        "E_CHART_GREYS",
        f"{band.label}: too few grey patches of the chart are usable",
        found=f"{count} of {len(greys)} above dark",
        expected=expected,
        fix="Capture the chart with a longer exposure; check dark and black level.",
    )


def _of_band(
    found: Located,
    patches: PatchTable,
    i: int,
    used: np.ndarray,
    reflectance: np.ndarray,
    chart: Chart,
) -> Patches:
    noise = np.nan_to_num(patches.noise[:, i])
    return Patches(
        found.areas.mean(1)[used],
        patches.mean[used, i],
        (noise**2 / np.maximum(patches.pixels, 1))[used],
        reflectance[used],
        np.isin(np.arange(len(used)), chart.greys)[used],
    )


def _nearest(label: str, bands: Sequence[Band], others: Sequence[str]) -> str:
    """Return the band whose light is nearest in wavelength; "" where there is none."""
    if not others:
        return ""
    centres = {band.label: band.wavelength for band in bands}
    apart = {n: abs(centres[n] - centres[label]) for n in others}
    return min(others, key=lambda n: (np.nan_to_num(apart[n], nan=1e6), others.index(n)))


def _unevenness(
    cube: Cube, i: int, found: Located, patches: PatchTable, table: np.ndarray | None
) -> float:
    """Return what sensels differ by beyond their noise over time, relative: the median of bright patches."""
    if cube.sigma is None:
        return 0.0
    bright = patches.mean[:, i] >= np.nanmedian(patches.mean[:, i])
    ratios = []
    for n in np.flatnonzero(bright & _usable(patches, i)):
        rows, columns = pixels_of(found.areas[n])
        if table is not None:
            own = table[rows % table.shape[0], columns % table.shape[1]] == i
            rows, columns = rows[own], columns[own]
        good = ~is_flagged(cube.flags[rows, columns, i], UNRELIABLE | Flag.DEFECT)
        noise = float(np.mean(cube.sigma[rows, columns, i][good].astype(float) ** 2))
        ratios.append((patches.noise[n, i] ** 2 - noise) / patches.mean[n, i] ** 2)
    return float(np.sqrt(max(np.median(ratios), 0.0))) if ratios else 0.0


# --- what is reported of it -------------------------------------------------------------------------


def _light(
    capture: Capture,
    campaign: Campaign,
    sensor: SensorFrames,
    fitted: SensorLight,
    times: Mapping[str, float | None],
    reference: ChartReference,
    found: Located,
) -> ChartLight:
    """Return the light of a sensor with its record."""
    white = campaign.cameras[capture.camera].white_chart
    assert white is not None
    maps = {
        label: LightMap.of(fit, fitted.outline, fitted.size) for label, fit in fitted.fits.items()
    }
    bands = {label: _record(fitted, label, maps[label]) for label in fitted.fits}
    record: dict[str, Any] = {
        "target": white.chart if white.chart in campaign.targets.charts else capture.object,
        "chart": fitted.chart.name,
        "reference": reference.source,
        "corners": np.round(found.corners, 2).tolist(),
        "agreement": round(float(found.agreement), 4),
        "held_out": max(band["held_out"] for band in bands.values()),
        "held_out_even_light": max(band["held_out_even_light"] for band in bands.values()),
        "beyond_the_chart": round(max(m.beyond for m in maps.values()), 4),
        "left_out": list(sensor.without_reference),
        "bands": bands,
    }
    notes = tuple(_notes(fitted, record, reference))
    pattern = sensor.pattern if _is_mosaic(sensor) else None
    return ChartLight(
        maps, times, fitted.unevenness, fitted.scatter, pattern, fitted.size, notes, record
    )


def _record(fitted: SensorLight, label: str, light: LightMap) -> dict[str, Any]:
    """Return how good the light of a band is: held-out errors are reflectances, sigma is relative."""
    fit, used, names = fitted.fits[label], fitted.used[label], fitted.chart.patches
    errors = dict(zip((names[n] for n in np.flatnonzero(used)), fit.errors.tolist(), strict=True))
    on_chart = fit.sigma(fitted.outline.corners)
    return {
        "order": fit.order,
        "held_out": _digits(fit.rmse),
        "held_out_even_light": _digits(fit.flat_rmse),
        "patches": {name: _digits(error) for name, error in errors.items()},
        "greys": len(fit.greys),
        "sigma_of_level": _digits(fit.level_sigma),
        "sigma_at_edge_of_chart": _digits(float(on_chart.max())),
        "sigma_most": _digits(float(light.sigma.values.max())),
        "sigma_in_frame": _digits(float(np.median(light.sigma.values))),
        "uneven_sensels": _digits(fitted.unevenness[label]),
        "sigma_of_patches": [_digits(part) for part in fitted.scatter[label]],
        "light_of": fitted.light_of.get(label, ""),
        "why": fitted.why.get(label, ""),
    }


def _digits(value: float) -> float:
    return float(f"{value:.3g}")


def _notes(fitted: SensorLight, record: Mapping[str, Any], reference: ChartReference) -> list[str]:
    """Report by which chart the values are reflectance and how well, and what is in doubt."""
    bands = record["bands"]
    worst = max(bands, key=lambda label: bands[label]["held_out"])
    held, even = bands[worst]["held_out"], bands[worst]["held_out_even_light"]
    notes = [
        f"reflectance by the chart {record['target']} ({record['chart']}, {reference.source}): the held-out "
        f"error of a patch is {held:.2g} rms in {worst}, the worst band; {even:.2g} for uniform light"
    ]
    if held > DOUBTFUL:
        notes.append(
            f"the chart differs from its spectra by {held:.2g} rms in {worst}: check for glare, "
            "another chart, or a wrong wavelength"
        )
    alike: dict[tuple[str, str], list[str]] = {}
    for label, why in fitted.why.items():
        alike.setdefault((why, fitted.light_of[label]), []).append(label)
    for (why, light_of), labels in alike.items():
        shape = f"; the light field is that of {light_of}" if light_of else ""
        notes.append(f"{', '.join(labels)}: {why}{shape}")
    if record["beyond_the_chart"] > 0:
        most = max(band["sigma_most"] for band in bands.values())
        known = "unknown in some places" if most >= 1 else f"known to {100 * most:.2g} % or better"
        notes.append(
            f"{100 * record['beyond_the_chart']:.0f} % of the frame is beyond the chart: the light is extrapolated "
            f"there, and {known}; the uncertainty budget has the median over the frame"
        )
    if left_out := record["left_out"]:
        first, last = reference.wavelengths[0], reference.wavelengths[-1]
        notes.append(
            f"{', '.join(left_out)}: no reference in the infrared or ultraviolet. The chart's spectra cover "
            f"{first:g} to {last:g} nm, so these bands are left out; give `reference`, a CSV that covers them"
        )
    return notes
