"""A chart in place of a white frame: found in its calibrated counts, its light fitted band by band."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.calibration.chart_light import ChartLight, Light, Patches, fit_light
from levkas.calibration.patterns import channel_table
from levkas.calibration.sensor import placed
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
DOUBTFUL = 0.05
"""Held-out error of a patch, reflectance, rms, from which the report warns."""


def lights_by_chart(
    capture: Capture, campaign: Campaign, native: CalibratedCapture
) -> dict[str, ChartLight]:
    """Fit the light of every sensor of a capture to the chart in its counts above dark.

    `native` are the frames of its `chart`, calibrated without a white.

    Raises ChartRefused, with the files in question: no chart in the frame, unknown spectra, saturated patches, too few grey ones.
    """
    white = campaign.cameras[capture.camera].white_chart
    assert white is not None
    chart, reference = spectra_of_chart(campaign, capture.camera)
    corners = None if white.corners is None else np.array(white.corners, float)
    target = white.chart if white.chart in campaign.targets.charts else capture.object
    lights: dict[str, ChartLight] = {}
    near: np.ndarray | None = None
    cubes = native.cubes
    for sensor in capture.sensors:
        cube = cubes[sensor.name]
        try:
            found = locate_in_cube(cube, chart, reference, corners=corners, near=near)
            near = found.corners if near is None else near
            known = known_reflectance(campaign, capture, sensor.bands, chart, reference)
            fitted = _fit_bands(sensor, cube, chart, found, known)
        except ChartRefused as refused:
            named = [_named(p, capture.camera, cube) for p in refused.problems]
            raise ChartRefused(*(placed(p, sensor.chart) for p in named)) from None
        times = native.measured[sensor.name].get("exposures_s", {})
        record = _record(fitted, target, reference, found)
        lights[sensor.name] = ChartLight(
            {label: one.light for label, one in fitted.items()},
            times,
            {label: one.unevenness for label, one in fitted.items()},
            sensor.pattern if _is_mosaic(sensor) else None,
            (cube.values.shape[0], cube.values.shape[1]),
            tuple(_notes(fitted, record, sensor, reference)),
            record | {"chart": chart.name, "left_out": list(sensor.without_reference)},
        )
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


def _named(problem: Problem, camera: str, cube: Cube) -> Problem:
    """Return a refusal of a chart with the camera whose white it is to be; of frames that are saturated it says so."""
    field = f"cameras.{camera}.white.chart"
    shares = is_flagged(cube.flags, Flag.SATURATED).mean((0, 1))
    i = int(np.argmax(shares))
    if problem.code in ("E_CHART_MISSING", "E_CHART_ORDER") and shares[i] >= HIDDEN:
        return Problem(
            "E_WHITE_SATURATED",
            f"{camera}: the chart declared as its white was not found, because the frame is saturated",
            field=field,
            found=f"{100 * shares[i]:.0f} % of the pixels in {cube.bands[i].label}",
            expected="the white patch at 85 % of saturation",
            fix="Capture the chart with a shorter exposure.",
        )
    fix = (problem.fix or "").replace("--corners x,y,x,y,x,y,x,y", "`corners` beside `chart`")
    message = f"{camera}: {problem.message}; this chart is declared as the white of the camera"
    return replace(problem, message=message, field=field, fix=fix or None)


class KnownReflectance(NamedTuple):
    """What a chart reflects in one band, (patches,), NaN where unknown; why only greys, or none, are known; by how much greys may differ."""

    reflectance: np.ndarray
    why: str = ""
    spread: float = 0.0


def known_reflectance(
    campaign: Campaign,
    capture: Capture,
    bands: Sequence[Band],
    chart: Chart,
    reference: ChartReference,
) -> list[KnownReflectance]:
    """Return what the patches reflect in each band: their spectra integrated over its sensitivity.

    The sensitivity is the declared table, times the spectrum of the setup's light where one is declared; else the band is taken
    as Gaussian of its width, or at its wavelength alone. Of a broad channel without a table only the grey patches are known,
    whose spectra are flat.
    """
    first, last = reference.wavelengths[0], reference.wavelengths[-1]
    grid = np.arange(first, last + 0.5, 1.0)
    spectra, greys = reference.at(grid), list(chart.greys)
    found = []
    for weights in weights_of_bands(campaign, capture, bands):
        reflectance = np.full(len(chart.patches), np.nan)
        if weights is None:
            published = reference.at(GREY_NM)[greys]
            reflectance[greys] = np.nanmean(published, axis=1)
            level = np.nanmean(published / reflectance[greys, None], axis=0)
            why = (
                "no sensitivity is known, so only the grey patches can be used; declare `sensitivity`, or "
                "`wavelengths` of narrow bands"
            )
            found.append(KnownReflectance(reflectance, why, float(np.nanstd(level))))
            continue
        inside = reference.covers(weights.wavelengths)
        if weights.weights[inside].sum() < COVERED * weights.weights.sum():
            why = f"the chart's spectra ({reference.source}) cover {first:g} to {last:g} nm alone"
            found.append(KnownReflectance(reflectance, why))
            continue
        within = BandWeights(weights.wavelengths[inside], weights.weights[inside])
        found.append(KnownReflectance(within.mean_of(grid, spectra)))
    return found


class FittedLight(NamedTuple):
    """The light of one band with the patches that it was fitted to, by name; how sure it is, relative; and of which band its shape is."""

    light: Light
    patches: dict[str, float]
    sigma: float
    unevenness: float
    why: str = ""
    light_of: str = ""


def _fit_bands(
    sensor: SensorFrames,
    cube: Cube,
    chart: Chart,
    found: Located,
    known: Sequence[KnownReflectance],
) -> dict[str, FittedLight]:
    """Fit the light in every band of a sensor; of those of which greys alone serve over the shape of the nearest other."""
    labels = [band.label for band in cube.bands]
    mosaic = sensor.pattern is not None and len(labels) > 1 and _is_mosaic(sensor)
    table = channel_table(sensor.pattern, labels) if mosaic and sensor.pattern else None
    patches = measure_patches(cube.values, cube.flags, found.areas, pattern=table)
    greys = np.isin(np.arange(len(chart.patches)), chart.greys)
    why = [one.why for one in known]
    for i in np.flatnonzero(found.unfit).tolist():
        why[i] = why[i] or (
            f"the order of its patches does not match its wavelength ({found.bands[i]:.2f}), as "
            "with a leaking filter; it is scaled by the grey patches alone"
        )
    usable = [_usable(patches, i) & np.isfinite(one.reflectance) for i, one in enumerate(known)]
    used = [there & (greys | (not text)) for there, text in zip(usable, why, strict=True)]
    few = [i for i, some in enumerate(used) if (some & greys).sum() < LEAST_GREYS]
    if few:
        raise ChartRefused(*(_too_few(chart, patches, i, cube.bands[i], known[i]) for i in few))
    table_of = [_of_band(found, patches, i, one.reflectance, greys) for i, one in enumerate(known)]
    whole = {i: fit_light(table_of[i].pick(used[i])) for i, text in enumerate(why) if not text}
    centres = np.array([band.wavelength for band in cube.bands])
    made: dict[str, FittedLight] = {}
    for i, label in enumerate(labels):
        part, light, light_of = table_of[i].pick(used[i]), whole.get(i), ""
        if light is None and whole:
            near = min(
                whole, key=lambda n: (np.nan_to_num(abs(centres[n] - centres[i]), nan=1e6), n)
            )
            light, light_of = fit_light(part, whole[near]), labels[near]
        light = light or fit_light(part)
        # Of a filter that leaks the greys give the level, and the coloured patches what the leak does to paints.
        others = table_of[i].pick(usable[i] & ~used[i])
        errors = others.levels / np.maximum(light(others.places), 1e-9) - others.reflectance
        every = np.concatenate([light.errors, errors])
        relative = np.sqrt(np.sum(every**2) / np.sum(table_of[i].reflectance[usable[i]] ** 2))
        sigma = float(np.sqrt(light.level_sigma**2 + relative**2 + known[i].spread ** 2))
        names = [chart.patches[n] for n in np.flatnonzero(used[i])]
        held_out = dict(zip(names, light.errors.tolist(), strict=True))
        uneven = _unevenness(cube, i, found, patches, table)
        made[label] = FittedLight(light, held_out, sigma, uneven, why[i], light_of)
    return made


def _is_mosaic(sensor: SensorFrames) -> bool:
    """Whether the bands are the channels of the sensor's mosaic, not filters before it."""
    names = {name for row in sensor.pattern or () for name in row}
    return names == {band.label for band in sensor.bands}


def _usable(patches: PatchTable, band: int) -> np.ndarray:
    mean, noise = patches.mean[:, band], patches.noise[:, band]
    above = mean > np.maximum(ABOVE_DARK * noise / np.sqrt(patches.pixels), 0)
    return np.asarray(np.isfinite(mean) & (patches.saturated[:, band] <= SATURATED) & above)


def _of_band(
    found: Located, patches: PatchTable, i: int, reflectance: np.ndarray, greys: np.ndarray
) -> Patches:
    variance = np.nan_to_num(patches.noise[:, i]) ** 2 / np.maximum(patches.pixels, 1)
    return Patches(found.areas.mean(1), patches.mean[:, i], variance, reflectance, greys)


def _too_few(
    chart: Chart, patches: PatchTable, i: int, band: Band, known: KnownReflectance
) -> Problem:
    """Return the refusal of a band in which too few grey patches can be used."""
    greys = list(chart.greys)
    full = [chart.patches[n] for n in greys if patches.saturated[n, i] > SATURATED]
    if np.isnan(known.reflectance).all():
        code, found = "E_CHART_REFERENCE", known.why
        fix = (
            "Measure the spectra of the chart over the whole range of the band and write `reference = "
            '"chart.csv"` beside `chart`, or capture a white.'
        )
    elif full:
        code, found = "E_WHITE_SATURATED", f"{', '.join(full)} saturated"
        fix = "Capture the chart with a shorter exposure: its white patch at 85 % of saturation."
    else:
        code, found = "E_CHART_GREYS", f"{int(_usable(patches, i)[greys].sum())} above dark"
        fix = "Capture the chart with a longer exposure; check dark and black level."
    message = f"{band.label}: too few grey patches of the chart are usable"
    expected = f"at least {LEAST_GREYS} of its {len(greys)} grey patches"
    return Problem(code, message, found=found, expected=expected, fix=fix)


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


def _record(
    fitted: Mapping[str, FittedLight], target: str, reference: ChartReference, found: Located
) -> dict[str, Any]:
    """Return how good the light of a sensor is: held-out errors are reflectances, sigma is relative."""
    bands = {
        label: {
            "order": one.light.order,
            "held_out": _digits(one.light.rmse),
            "held_out_even_light": _digits(float(np.sqrt(np.mean(one.light.even_errors**2)))),
            "patches": {name: _digits(error) for name, error in one.patches.items()},
            "sigma": _digits(one.sigma),
            "light_of": one.light_of,
        }
        for label, one in fitted.items()
    }
    return {
        "target": target,
        "reference": reference.source,
        "corners": np.round(found.corners, 2).tolist(),
        **{
            key: max(float(band[key]) for band in bands.values())  # type: ignore[arg-type]
            for key in ("held_out", "held_out_even_light")
        },
        "bands": bands,
    }


def _digits(value: float) -> float:
    return float(f"{value:.3g}")


def _notes(
    fitted: Mapping[str, FittedLight],
    record: Mapping[str, Any],
    sensor: SensorFrames,
    reference: ChartReference,
) -> list[str]:
    """Report by which chart the values are reflectance and how well, and what is in doubt."""
    bands = record["bands"]
    worst = max(bands, key=lambda label: bands[label]["held_out"])
    held, even = bands[worst]["held_out"], bands[worst]["held_out_even_light"]
    notes = [
        f"reflectance by the chart {record['target']} ({reference.source}): the held-out error of a patch is {held:.2g} rms in "
        f"{worst}, the worst band; {even:.2g} for uniform light. Beyond the chart the light is extrapolated, which no "
        "uncertainty states"
    ]
    if held > DOUBTFUL:
        notes.append(
            f"the chart differs from its spectra by {held:.2g} rms in {worst}: check for glare, "
            "another chart, or a wrong wavelength"
        )
    for label, one in fitted.items():
        shape = f"; the light field is that of {one.light_of}" if one.light_of else ""
        notes += [f"{label}: {one.why}{shape}"] if one.why else []
    if sensor.without_reference:
        first, last = reference.wavelengths[0], reference.wavelengths[-1]
        notes.append(
            f"{', '.join(sensor.without_reference)}: no reference in the infrared or ultraviolet. The chart's spectra cover "
            f"{first:g} to {last:g} nm, so these bands are left out; give `reference`, a CSV that covers them"
        )
    return notes
