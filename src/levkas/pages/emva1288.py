"""The page of the cameras: tables, photon transfer curves and SNR over exposure."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.noise_model import Sensor, snr_db
from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.pages.page import render_page
from levkas.pages.plots import draw_legend, in_style, new_figure, themed, to_svg
from levkas.quality.emva1288.facts import describe_levels
from levkas.quality.emva1288.photon_transfer import PhotonTransfer

if TYPE_CHECKING:
    from levkas.quality.emva1288.report import Examination, SensorReport

INKS = ("a", "b", "c", "d")
MARKS = ("o", "^", "s", "D")
"""Of channels, whose points often lie on one another."""
OWN_INK = {"R": "b", "G": "c", "B": "a"}


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
    def share(value: float) -> str:
        return "–" if value != value else f"{round(100 * value, 2) + 0.0:+.2f} %"

    return {
        "name": sensor.name,
        "facts": sensor.facts,
        "codes": describe_levels(sensor.levels, sensor.facts.full),
        "rows": sensor.rows() if sensor.channels else [],
        "problems": sensor.problems,
        "notes": sensor.notes,
        "transfer": draw_transfer(sensor.channels),
        "snr": draw_snr(sensor.channels),
        "light": [
            (n, len(d.scales), share(d.drift), share(d.flicker).lstrip("+"))
            for n, d in sensor.light
        ],
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
        ink = themed(_ink(i, name))
        quiet = found.dark_noise or 0.0
        axes.axline((0.0, (quiet * found.gain.value) ** 2), slope=found.gain.value, color=ink)
        signal, variance = np.array(found.points).T[:2]
        mark = MARKS[i % len(MARKS)]
        axes.scatter(signal, variance, s=14, color=ink, marker=mark, label=name or None)
    axes.set(xlabel="signal, DN", ylabel="variance, DN²", xlim=(0, right), ylim=(0, high))
    if any(drawn):
        draw_legend(axes)
    return to_svg(figure, "photon transfer curve")


@in_style
def draw_snr(channels: dict[str, PhotonTransfer]) -> str:
    """Return SNR over exposure as SVG: solid as raw frames have it, dashed after the flat field."""
    drawn = {
        name: (f, f.full_well)
        for name, f in channels.items()
        if f.dark_noise is not None and f.full_well is not None
    }
    if not drawn:
        return ""
    figure = new_figure()
    axes = figure.subplots()
    for i, (name, (found, well)) in enumerate(drawn.items()):
        read = found.dark_noise or 0.0
        exposure = np.geomspace(1, well, 80)
        for prnu, dash in ((found.prnu or 0.0, "-"), (0.0, "--")):
            snr = snr_db(exposure, Sensor(dark=0, read=read, prnu=prnu, dsnu=0))
            label = name if dash == "-" and name else None
            axes.plot(exposure, snr, dash, color=themed(_ink(i, name)), label=label)
    axes.set(xlabel="exposure, photo-electrons", ylabel="SNR, dB (10 log₁₀)", xscale="log")
    axes.set_ylim(bottom=0)
    axes.xaxis.set_major_formatter("{x:,g}")
    if any(drawn):
        draw_legend(axes)
    return to_svg(figure, "signal-to-noise ratio over exposure")


def _ink(i: int, name: str) -> str:
    """Return the theme's colour of a channel: red, green and blue ones have their own."""
    return OWN_INK.get(name.rstrip("0123456789").upper(), INKS[i % len(INKS)])
