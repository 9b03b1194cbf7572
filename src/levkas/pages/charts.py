"""The report section of a colour chart: sampled areas, SNR (Figure 15 of the paper), colours."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.text import counted
from levkas.pages.page import Figure
from levkas.pages.plots import Line, picture_with_areas, plot
from levkas.pages.radiometry import channel_colours
from levkas.quality.targets.edges import EdgeTargetMeasure

if TYPE_CHECKING:
    from collections.abc import Sequence

    from levkas.core.cube import Cube
    from levkas.quality.targets.edges import EdgeTable
    from levkas.quality.targets.measuring import ChartMeasure, Sighting

LONGEST = 640
MOST_LINES = 33


def describe_chart(measure: ChartMeasure | EdgeTargetMeasure) -> dict[str, Any]:
    """Return the section of a chart that was measured, or of a target of slanted edges."""
    tables = measure.edges.tables
    section: dict[str, Any] = {
        "name": measure.name,
        "notes": measure.notes,
        "indicators": measure.rows,
        "figures": draw_responses(tables),
        "edges": tables,
    }
    if isinstance(measure, EdgeTargetMeasure):
        names = {
            s: [t.label for t in tables if t.bands == c.bands] for s, c in measure.cubes.items()
        }
        return section | {
            "summary": counted(len(tables), "slanted edge") + ".",
            "pictures": [
                _picture(sensor, cube, _boxes(tables, cube), names[sensor])
                for sensor, cube in measure.cubes.items()
            ],
        }
    agreement = min(s.located.agreement for s in measure.sightings)
    noise = "the difference of two shots" if measure.table.temporal else "the spread in each patch"
    summary = (
        f"{measure.chart.name}, rank correlation with the published patches {agreement:.3f}; "
        f"noise from {noise}, {int(measure.table.pixels.min())} pixels a patch or more."
    )
    if measure.colours is not None:
        summary += f" Colours (D65, 2°) {measure.colours.how}."
    curves = [f for f in (_over_signal(measure), _over_wavelength(measure)) if f is not None]
    return section | {
        "summary": summary,
        "notes": [*_blur_notes(measure), *measure.notes],
        "pictures": [_sampled(measured, measure) for measured in measure.sightings],
        "figures": [*curves, *section["figures"]],
        "patches": _patch_rows(measure),
    }


def draw_responses(tables: Sequence[EdgeTable]) -> list[Figure]:
    """Return the spatial frequency response of every band, a plot an edge."""
    figures = []
    for table in tables:
        labels = [band.label for band in table.bands]
        colours = channel_colours(labels)
        step = max(1, -(-len(labels) // MOST_LINES))
        shown = slice(0, 3 * table.response.shape[1] // 4, 8)  # to 3/4 cycles/px: noise beyond
        lines = [
            Line(labels[i], table.frequencies[shown], table.response[i, shown], colours[i])
            for i in range(0, len(labels), step)
        ]
        half = Line("half the sampling frequency", [0.5, 0.5], [0.0, 1.0], "soft", dashed=True)
        if svg := plot([*lines, half], x="cycles/px", y="modulation", from_zero=True):
            caption = (
                f"Spatial frequency response, {table.label}, {abs(table.angle_deg):.1f} degrees, along "
                f"{table.axis} (ISO 12233, e-SFR; the pixel's aperture included)."
            )
            figures.append(Figure(svg, caption))
    return figures


def _boxes(tables: Sequence[EdgeTable], cube: Cube) -> np.ndarray:
    """Return the rectangles of the edges in one sensor's cube, (n, 4, 2) px."""
    boxes = np.array([t.box for t in tables if t.bands == cube.bands], float)
    low, size = boxes.reshape(-1, 4)[:, :2], boxes.reshape(-1, 4)[:, 2:]
    turns = np.array([[0, 0], [1, 0], [1, 1], [0, 1]])
    return low[:, None] - 0.5 + turns * size[:, None]


def _blur_notes(measure: ChartMeasure) -> list[str]:
    found = [
        f"{band.label} (lag-1 correlation {max(p.lag1):.2f}, σ times {p.factor:.2f})"
        for band, p in zip(measure.bands, measure.preblurs, strict=True)
        if p is not None and p.found
    ]
    if not found:
        return []
    return [
        "Neighbouring pixels share their noise, for the camera blurs or a mosaic was interpolated: "
        + ", ".join(found[:8])
        + (f" and {len(found) - 8} more" if len(found) > 8 else "")
        + ". Its SNR is corrected for that."
    ]


def _sampled(sighting: Sighting, measure: ChartMeasure) -> Figure:
    """Draw the sampled areas, and the rectangles of edges, which have no names where they are many."""
    boxes = _boxes(measure.edges.tables, sighting.cube)
    names = [*measure.chart.patches, *[""] * len(boxes)]
    return _picture(
        sighting.sensor, sighting.cube, np.concatenate([sighting.located.areas, boxes]), names
    )


def _picture(sensor: str, cube: Cube, areas: np.ndarray, names: Sequence[str]) -> Figure:
    from levkas.quality.targets.locating import pictures_of

    shown = pictures_of(cube.values)[-1][..., 0]
    step = max(1, -(-max(shown.shape) // LONGEST))
    svg = picture_with_areas(shown[::step, ::step] / 255, (areas + 0.5) / step - 0.5, names)
    where = f"sensor {sensor}: " if sensor else ""
    return Figure(svg, f"{where}the sampled areas, on the root of the mean of all bands.")


def _over_signal(measure: ChartMeasure) -> Figure | None:
    """SNR of the greys over the channel's own signal, with luminance as second axis (Figure 15a–c)."""
    greys = list(measure.chart.greys)
    snr = measure.snr_db[greys]
    signal = measure.table.mean[greys]
    labels = [band.label for band in measure.bands]
    step = max(1, -(-len(labels) // MOST_LINES))
    colours = channel_colours(labels)
    lines = [
        Line(labels[i], list(signal[:, i]), list(snr[:, i]), colours[i])
        for i in range(0, len(labels), step)
        if np.isfinite(snr[:, i]).any()
    ]
    middle = np.median(signal, axis=1)
    luminance = 100 * measure.chart.luminances[greys]
    order = np.argsort(middle)[:: max(1, len(greys) // 6)]
    marks = [(float(middle[i]), f"{luminance[i]:.0f}") for i in order if middle[i] > 0]
    svg = plot(
        lines, x="signal of the channel", y="SNR, dB (10·log10)", log_x=True,
        top_axis=("luminance Y, %", marks),
    )  # fmt: skip
    caption = (
        "SNR of the grey patches over each channel's own signal, logarithmic (the paper's Figure 15a–c), after "
        "flat-fielding. Above: luminance of the patches, at the median signal of the channels."
    )
    return Figure(svg, caption) if svg else None


def _over_wavelength(measure: ChartMeasure) -> Figure | None:
    """SNR of every grey patch over wavelength, measured and corrected (Figure 15d)."""
    wavelengths = measure.wavelengths
    if np.isfinite(wavelengths).sum() < 5:
        return None
    greys = list(measure.chart.greys)
    snr, corrected = measure.table.snr_db, measure.snr_db
    moved = any(p is not None and p.found for p in measure.preblurs)
    lines = []
    for place, patch in enumerate(greys):
        share = place / max(len(greys) - 1, 1)
        grey = f"{0.72 - 0.5 * share:.2f}"
        name = measure.chart.patches[patch]
        lines.append(Line(name, list(wavelengths), list(snr[patch]), grey))
        if moved:
            line = Line(
                f"{name}, corrected", list(wavelengths), list(corrected[patch]), "#c62828", True
            )
            lines.append(line)
    svg = plot(lines, x="wavelength, nm", y="SNR, dB (10·log10)")
    caption = "The same, patch by patch over wavelength (the paper's Figure 15d)."
    if moved:
        caption += " Red: without the camera's own blur."
    return Figure(svg, caption) if svg else None


def _patch_rows(measure: ChartMeasure) -> list[list[str]]:
    rows = []
    snr, snr_db = measure.table.snr, measure.snr_db
    for i, patch in enumerate(measure.chart.patches):
        good = np.isfinite(snr[i])
        middle = f"{np.median(snr[i][good]):.0f}" if good.any() else "–"
        decibels = f"{np.median(snr_db[i][good]):.1f}" if good.any() else "–"
        colour = "–" if measure.colours is None else f"{measure.colours.difference[i]:.2f}"
        rows.append([patch, f"{np.nanmean(measure.table.mean[i]):.3g}", middle, decibels, colour])
    return rows
