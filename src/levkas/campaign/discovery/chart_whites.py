"""Charts in place of white frames: the bands that they know, and what is refused where frames are missing."""

from __future__ import annotations

from collections.abc import Sequence
from math import isnan
from typing import TYPE_CHECKING

from levkas.campaign.chart_names import NEAR_NM, SPANS, kind_of_chart
from levkas.campaign.discovery.file_index import patterns_of
from levkas.campaign.discovery.patterns import natural
from levkas.core.problems import Problem, Refused, closest_match
from levkas.core.text import read_text
from levkas.readers.spectra import parse_spectra

if TYPE_CHECKING:
    from levkas.campaign.campaign import Camera, Campaign
    from levkas.campaign.discovery.file_index import FileIndex
    from levkas.core.cube import Band


def bands_beyond(campaign: Campaign, camera: Camera, bands: Sequence[Band]) -> tuple[str, ...]:
    """Return the labels of bands in which the spectra of a camera's chart say nothing."""
    span = span_of(campaign, camera)
    if span is None:
        return ()
    low, high = span[0] - NEAR_NM, span[1] + NEAR_NM
    return tuple(
        b.label for b in bands if not isnan(b.wavelength) and not low <= b.wavelength <= high
    )


def span_of(campaign: Campaign, camera: Camera) -> tuple[float, float] | None:
    """Return the first and last wavelength, nm, at which a camera's chart is known.

    None without such a chart, and where its spectra cannot be read: calibration says why.
    """
    white = camera.white_chart
    if white is None:
        return None
    if white.reference is None:
        return SPANS.get(kind_of_chart(campaign.targets.charts.get(white.chart, white.chart)) or "")
    try:
        table, _ = parse_spectra(read_text(campaign.root / white.reference, "a CSV"))
    except (Refused, ValueError):
        return None
    return (float(table[0, 0]), float(table[-1, 0])) if table.size else None


def nothing_known(campaign: Campaign, camera: Camera, labels: Sequence[str]) -> Problem:
    """Return the refusal of a camera of which no band lies where its chart is known."""
    first, last = span_of(campaign, camera) or (0.0, 0.0)
    return Problem(
        "E_CHART_REFERENCE",
        f"{camera.name}: no reference in the infrared or ultraviolet: the chart's spectra are known from "
        f"{first:g} to {last:g} nm",
        str(campaign.path),
        f"cameras.{camera.name}.white.reference",
        ", ".join(labels[:6]),
        f"bands from {first:g} to {last:g} nm, or spectra that reach further",
        "Measure the spectra of the chart over this range and name them in `reference` "
        "beside `chart`, or capture a white.",
    )


def no_chart_frames(index: FileIndex, camera: Camera, setup: str) -> Problem:
    """Return the refusal of a camera without a frame of the chart that is to be its white."""
    assert camera.white_chart is not None
    name, under = camera.white_chart.chart, f" under {setup}" if setup else ""
    known = sorted({f.target for f in index.frames[camera.name, setup]}, key=natural)
    patterns = dict.fromkeys(p.text for p in patterns_of(index, camera.name, setup))
    return Problem(
        "E_CHART_MISSING",
        f"{camera.name}{under}: no frame shows the chart {name!r}, which is declared as its white",
        str(index.campaign.path),
        f"cameras.{camera.name}.white.chart",
        ", ".join(known) or "no file",
        f"{{target}} = {name} in {' or '.join(patterns)}",
        closest_match(name, known) or "Capture the chart with this camera under the same light.",
    )


def other_chart_bands(
    index: FileIndex, camera: Camera, bands: Sequence[Band], of_chart: Sequence[Band]
) -> Problem:
    """Return the refusal of a chart that was not captured in the bands of the object."""
    assert camera.white_chart is not None
    return Problem(
        "E_TEMPLATE_MISSING",
        f"{camera.name}: the chart {camera.white_chart.chart!r} was not captured in the bands of the object",
        str(index.campaign.path),
        f"cameras.{camera.name}.white.chart",
        f"{len(of_chart)} bands: {', '.join(b.label for b in of_chart[:6])}",
        f"{len(bands)} bands: {', '.join(b.label for b in bands[:6])}",
        "Capture the chart in every band, or remove the other bands from `wavelengths`.",
    )
