"""The report page of a camera: its sensors, the light on its white, its charts."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from levkas.pages.page import Figure, render_page

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from levkas.pages.charts import ChartSection

SOURCES = {
    "temporal": "repeated shots",
    "spatial": "single shots, an upper estimate",
}

ORDERS = ("even", "a plane", "quadratic", "cubic")
"""Light fields by their order."""


@dataclass(frozen=True)
class CameraReport:
    """Everything on the page of one camera, or of charts alone; texts are plain."""

    title: str
    subtitle: str = ""
    sensors: Sequence[Sequence[str]] = ()
    lights: Sequence[Sequence[str]] = ()
    light_notes: Sequence[str] = ()
    figures: Sequence[Figure] = ()
    whites: Sequence[Sequence[str]] = ()
    budgets: Sequence[tuple[str, Any]] = ()
    charts: Sequence[ChartSection] = ()
    problems: Sequence[dict[str, str]] = ()
    radiometry: Sequence[Any] = ()
    footer: str = ""


def render_camera(page: CameraReport) -> str:
    """Return the page as HTML."""
    return render_page("camera.html", page=page)


def sensor_row(name: str, sensor: Mapping[str, Any]) -> list[str]:
    """Return a sensor's record as texts.

    >>> sensor_row("", {"full": 4030.0, "read_noise": 1.29, "gain": 0.16, "stops": 11.6, "source": "temporal"})
    ['the only one', '0.16', '1.29', '4030', '11.6', 'repeated shots']
    """
    return [
        name or "the only one",
        f"{sensor['gain']:.3g}",
        f"{sensor['read_noise']:.3g}",
        f"{sensor['full']:.0f}",
        f"{sensor['stops']:.1f}",
        SOURCES.get(sensor["source"], sensor["source"]),
    ]


def light_row(label: str, light: Mapping[str, Any]) -> list[str]:
    """Return a channel's light field as texts."""
    if "refused" in light:
        return [label, "–", "–", "–", "–"]
    x, y, width, height = light["rectangle"]
    return [
        label,
        f"{100 * light['uniformity']:.0f} %",
        f"{width} x {height} at ({x}, {y})",
        f"{100 * light['share']:.0f} %",
        "{:.1f}, {:.1f}".format(*light["bits"]) if "bits" in light else "–",
    ]


def chart_white_rows(name: str, record: Mapping[str, Any]) -> list[list[str]]:
    """Return how well a chart makes reflectance of the bands of a sensor, a row a band, as texts."""
    rows = []
    for label, band in record["bands"].items():
        worst = max(band["patches"], key=lambda patch: abs(band["patches"][patch]))
        field = f"of {band['light_of']}" if band["light_of"] else ORDERS[band["order"]]
        rows.append(
            [
                f"{name} {label}".strip(),
                f"{band['held_out']:.3f}",
                f"{band['held_out_even_light']:.3f}",
                f"{worst} {band['patches'][worst]:+.3f}",
                field,
                f"{100 * band['sigma_of_level']:.2g} %",
                f"{100 * band['sigma_at_edge_of_chart']:.2g} %",
                f"{100 * band['sigma_most']:.3g} %",
            ]
        )
    return rows
