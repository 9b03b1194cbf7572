"""The page of the cameras: tables, photon transfer curves and SNR over exposure."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from importlib.resources import files as resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.noise_model import Sensor, snr_db
from levkas.quality.emva1288.facts import describe_levels
from levkas.quality.emva1288.photon_transfer import PhotonTransfer

if TYPE_CHECKING:
    from levkas.quality.emva1288.report import Examination, SensorReport

WIDTH, HEIGHT = 460, 300
LEFT, BOTTOM, TOP, RIGHT = 52, 40, 14, 12
INKS = ("var(--a)", "var(--b)", "var(--c)", "var(--d)")
OWN_INK = {"R": "var(--b)", "G": "var(--c)", "B": "var(--a)"}


def write_page(found: Examination, path: str | Path) -> Path:
    """Write the page of an examination as one HTML file that asks nothing of anywhere.

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
    write_text(path, render_page(found))
    return path


def render_page(found: Examination) -> str:
    """Return the page as HTML; every text from outside is escaped."""
    import jinja2

    environment = jinja2.Environment(autoescape=True, trim_blocks=True, lstrip_blocks=True)
    text = resources("levkas.pages").joinpath("emva1288.html").read_text(encoding="utf-8")
    root = found.root if found.root.is_dir() else found.root.parent
    sensors = [_section(sensor) for sensor in found.sensors]
    return environment.from_string(text).render(title=root.resolve().name, sensors=sensors)


def _section(sensor: SensorReport) -> dict[str, Any]:
    def share(value: float) -> str:
        return "–" if value != value else f"{100 * value:+.2f} %"

    return {
        "name": sensor.name,
        "facts": sensor.facts,
        "codes": describe_levels(sensor.levels, sensor.facts.full),
        "rows": sensor.rows() if sensor.channels else [],
        "problems": sensor.problems,
        "bounds": [
            (channel or "all", ", ".join(str(b) for b in found))
            for channel, found in sensor.bounds.items()
        ],
        "notes": sensor.notes,
        "transfer": draw_transfer(sensor.channels),
        "snr": draw_snr(sensor.channels),
        "light": [
            (n, len(d.scales), share(d.drift), share(d.flicker).lstrip("+"))
            for n, d in sensor.light
        ],
        "linearity": [
            (n, f"{100 * f.rms:.2f} %", share(f.worst), f"{f.offset:+.2f}" if f.offset else "–")
            for n, f in sensor.linearity
        ],
    }


def draw_transfer(channels: dict[str, PhotonTransfer]) -> str:
    """Return the photon transfer curve as SVG, a colour a channel; empty without a channel."""
    drawn = {name: found for name, found in channels.items() if found.points}
    if not drawn:
        return ""
    every = np.array([point for found in drawn.values() for point in found.points])
    right, high = float(every[:, 0].max()) * 1.05, float(every[:, 1].max()) * 1.1
    place = _place((0.0, right), (0.0, high))
    parts = [_frame(place, (0.0, right), (0.0, high), "signal, DN", "variance, DN²")]
    for i, (name, found) in enumerate(drawn.items()):
        ink = _ink(i, name)
        quiet = found.dark_noise.value if found.dark_noise else 0.0
        start = (quiet * found.gain.value) ** 2
        ends = [
            place(x, start + found.gain.value * x)
            for x in (0.0, min(right, (high - start) / found.gain.value))
        ]
        parts.append(_line(ends, ink))
        parts += [_dot(*place(*point), ink) for point in found.points]
        parts.append(_key(i, name, ink))
    return _svg(parts, "photon transfer curve")


def draw_snr(channels: dict[str, PhotonTransfer]) -> str:
    """Return SNR over exposure as SVG: solid as raw frames have it, dashed after the flat field."""
    drawn = {
        name: (f, f.full_well.value)
        for name, f in channels.items()
        if f.dark_noise is not None and f.full_well is not None
    }
    if not drawn:
        return ""
    full = max(well for _, well in drawn.values())
    decades = (0.0, float(np.log10(full)))
    high = 5 * float(np.ceil(10 * np.log10(np.sqrt(full)) / 5))
    place = _place(decades, (0.0, high))
    parts = [
        _frame(
            place, decades, (0.0, high), "exposure, log₁₀ of photo-electrons", "SNR, dB (10 log₁₀)"
        )
    ]
    for i, (name, (found, well)) in enumerate(drawn.items()):
        ink = _ink(i, name)
        read = found.dark_noise.value if found.dark_noise else 0.0
        exposure = np.geomspace(1, well, 80)
        for prnu, dashes in ((found.prnu.value if found.prnu else 0.0, ""), (0.0, "5 4")):
            snr = snr_db(exposure, Sensor(dark=0, read=read, prnu=prnu, dsnu=0))
            shown = snr >= 0
            points = zip(np.log10(exposure[shown]), snr[shown], strict=True)
            parts.append(_line([place(x, y) for x, y in points], ink, dashes))
        parts.append(_key(i, name, ink))
    return _svg(parts, "signal-to-noise ratio over exposure")


def _ink(i: int, name: str) -> str:
    """Red, green and blue channels are drawn in their colour."""
    return OWN_INK.get(name.rstrip("0123456789").upper(), INKS[i % len(INKS)])


Place = Callable[[float, float], tuple[float, float]]


def _place(across: tuple[float, float], up: tuple[float, float]) -> Place:
    wide, high = WIDTH - LEFT - RIGHT, HEIGHT - TOP - BOTTOM

    def place(x: float, y: float) -> tuple[float, float]:
        u = (x - across[0]) / (across[1] - across[0])
        v = (y - up[0]) / (up[1] - up[0])
        return LEFT + u * wide, TOP + (1 - v) * high

    return place


def _frame(
    place: Place, across: tuple[float, float], up: tuple[float, float], below: str, beside: str
) -> str:
    """Return axes with about five ticks each."""
    parts = []
    for tick in _ticks(*across):
        x, y = place(tick, up[0])
        parts.append(f'<path d="M{x:.1f} {y:.1f}v4" stroke="currentColor"/>')
        parts.append(f'<text x="{x:.1f}" y="{y + 16:.1f}" text-anchor="middle">{tick:g}</text>')
    for tick in _ticks(*up):
        x, y = place(across[0], tick)
        parts.append(f'<path d="M{x:.1f} {y:.1f}H{WIDTH - RIGHT}" stroke="var(--line)"/>')
        parts.append(f'<text x="{x - 5:.1f}" y="{y + 4:.1f}" text-anchor="end">{tick:g}</text>')
    middle = (LEFT + WIDTH - RIGHT) / 2
    parts.append(f'<text x="{middle}" y="{HEIGHT - 6}" text-anchor="middle">{below}</text>')
    parts.append(f'<text x="{LEFT + 6}" y="{TOP + 12}">{beside}</text>')
    return "".join(parts)


def _ticks(low: float, high: float) -> Sequence[float]:
    rough = (high - low) / 5
    step = 10 ** np.floor(np.log10(rough))
    step *= min((1, 2, 5, 10), key=lambda n: abs(n * step - rough))
    return [float(t) for t in np.arange(np.ceil(low / step) * step, high + step / 1e6, step)]


def _line(points: Sequence[tuple[float, float]], ink: str, dashes: str = "") -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    dash = f' stroke-dasharray="{dashes}"' if dashes else ""
    return f'<polyline points="{path}" fill="none" stroke="{ink}" stroke-width="1.4"{dash}/>'


def _dot(x: float, y: float, ink: str) -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.6" fill="{ink}"/>'


def _key(i: int, name: str, ink: str) -> str:
    from html import escape

    x, y = LEFT + 10, TOP + 30 + 15 * i
    if not name:
        return ""
    return f'<circle cx="{x}" cy="{y - 4}" r="3.5" fill="{ink}"/><text x="{x + 8}" y="{y}">{escape(name)}</text>'


def _svg(parts: Sequence[str], label: str) -> str:
    return f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" role="img" aria-label="{label}">{"".join(parts)}</svg>'
