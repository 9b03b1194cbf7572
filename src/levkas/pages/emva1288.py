"""The page of the cameras: tables, photon transfer curves and SNR over exposure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.pages.page import render_page
from levkas.pages.plots import colour_of, draw_legend, in_style, new_figure, to_svg
from levkas.quality.emva1288.facts import describe_levels
from levkas.quality.emva1288.photon_transfer import PhotonTransfer

if TYPE_CHECKING:
    from levkas.quality.emva1288.report import Examination, SensorReport

MARKS = ("o", "^", "s", "D")
"""Of channels, whose points often lie on one another."""


def write_page(found: Examination, path: str | Path) -> Path:
    """Write the page of an examination as one HTML file that loads nothing from anywhere.

    Parameters
    ----------
    found : Examination
        Of a campaign.
    path : path
        Of the file; its folder is made.

    Returns
    -------
    path : Path
    """
    from levkas.core.files import write_text

    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, render_examination(found))
    return path


def render_examination(found: Examination) -> str:
    """Return the page as HTML; every text from outside is escaped."""
    sensors = [_section(sensor) for sensor in found.sensors]
    return render_page("emva1288.html", page={"title": _title(found.root), "sensors": sensors})


def _title(root: Path) -> str:
    """Return the title of a campaign; the name of its folder where it has none, or is none."""
    try:
        title = load_campaign(root).campaign.title
    except CampaignInvalid:
        title = ""
    return title or (root if root.is_dir() else root.parent).resolve().name


def _section(sensor: SensorReport) -> dict[str, Any]:
    return {
        "name": sensor.name,
        "facts": sensor.facts,
        "codes": describe_levels(sensor.levels, sensor.facts.full),
        "rows": sensor.rows() if sensor.channels else [],
        "problems": sensor.problems,
        "notes": sensor.notes,
        "transfer": draw_transfer(sensor.channels),
        "light": sensor.light,
    }


@in_style
def draw_transfer(channels: dict[str, PhotonTransfer]) -> str:
    """Return the photon transfer curve as SVG, a colour a channel; empty without a channel."""
    drawn = {name: found for name, found in channels.items() if found.points}
    if not drawn:
        return ""
    every = np.array([point for found in drawn.values() for point in found.points])
    right, high = float(every[:, 0].max()) * 1.05, float(every[:, 1].max()) * 1.1
    figure = new_figure()
    axes = figure.subplots()
    for i, (name, found) in enumerate(drawn.items()):
        ink = colour_of(name, i, len(drawn))
        quiet = found.dark_noise or 0.0
        axes.axline((0.0, (quiet * found.gain.value) ** 2), slope=found.gain.value, color=ink)
        signal, variance = np.array(found.points).T[:2]
        mark = MARKS[i % len(MARKS)]
        axes.scatter(signal, variance, s=14, color=ink, marker=mark, label=name or None)
    axes.set(xlabel="signal, DN", ylabel="variance, DN²", xlim=(0, right), ylim=(0, high))
    if any(drawn):
        draw_legend(axes)
    return to_svg(figure, "photon transfer curve")
