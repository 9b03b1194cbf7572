"""Maps of light and glare over the object, with contours and profiles (Figure 6b), and curves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.criteria import MEANINGS
from levkas.planning.diagrams import PALETTE, PlotFrame, axes, contours, line, picture, svg, text

if TYPE_CHECKING:
    from levkas.planning.exposure_plan import CameraExposure
    from levkas.planning.filter_design import RegulatingFilter
    from levkas.planning.light import LightPlan
    from levkas.planning.optimisation import TradeOff

WARM = ("#3b2f63", "#7a3b74", "#c2556a", "#ee8f5b", "#f8d48a", "#fffbe8")
GLOW = ("#14120f", "#4a3410", "#96681a", "#dcae45", "#fff3c4")


def draw_evenness(plan: LightPlan) -> str:
    """Return the map of light over its greatest value, contours every 2 %, and two profiles."""
    surface = plan.surface
    share = 100 * plan.illuminance / plan.illuminance.max()
    width, height = (float(v[-1] - v[0]) for v in (surface.x, surface.y))
    across = 330.0
    scale = across / width
    down = height * scale
    frame = PlotFrame(
        52, 26, across, down, (surface.x[0], surface.x[-1]), (surface.y[-1], surface.y[0])
    )
    low = min(90.0, float(np.floor(share.min() / 2) * 2))
    parts = [_image(share, low, 100.0, WARM, frame)]
    parts += _level_lines(surface.x, surface.y, share, low, frame)
    middle = (share.shape[0] // 2, share.shape[1] // 2)
    y0, x0 = float(surface.y[middle[0]]), float(surface.x[middle[1]])
    parts += _cross(frame, x0, y0)
    parts.append(text(frame.left, 16, "light over its greatest value, %", css="head"))
    parts += _edges(frame)
    profile = PlotFrame(
        452, 40, 250, down - 14, (-max(width, height) / 2, max(width, height) / 2), (low, 101)
    )
    parts += axes(profile, "mm from the middle", "%", about=(4, 5))
    for values, at, colour, name in (
        (share[middle[0]], surface.x, "--c1", "along the width"),
        (share[:, middle[1]], surface.y, "--c2", "along the height"),
    ):
        parts.append(line(*profile.at(at, values), colour))
        row = 0 if colour == "--c1" else 1
        parts.append(text(profile.left + 84, 14 + 15 * row, name, fill=colour))
    label = f"map of light, drop {100 * plan.drop:.1f} per cent"
    return svg(730, down + 72, parts, label)


def _level_lines(
    x: np.ndarray, y: np.ndarray, share: np.ndarray, low: float, frame: PlotFrame
) -> list[str]:
    step = 2.0 if 100 - low <= 24 else 10.0
    parts = []
    for level in np.arange(low + step, 100, step):
        path, best = [], None
        for start, end in contours(x, y, share, float(level)):
            (a, c), (b, d) = frame.at(*np.array([start, end]).T)
            path.append(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}")
            if best is None or start[1] < best[1]:
                best = start
        if best is not None:
            parts.append(
                f'<path d="{"".join(path)}" stroke="#1d1b16" stroke-width="1.1" fill="none"/>'
            )
            a, b = frame.at(best[0], best[1])
            inside = (
                float(np.clip(a, frame.left + 14, frame.left + frame.width - 14)),
                float(np.clip(b + 12, frame.top + 12, frame.top + frame.height - 4)),
            )
            parts.append(text(*inside, f"{level:g}", anchor="middle", css="level"))
    return parts


def _cross(frame: PlotFrame, x0: float, y0: float) -> list[str]:
    x, y = (float(v) for v in frame.at(x0, y0))
    return [
        f'<path d="M{frame.left} {y:.1f}h{frame.width}" stroke="var(--c1)" stroke-dasharray="6 4"/>',
        f'<path d="M{x:.1f} {frame.top}v{frame.height}" stroke="var(--c2)" stroke-dasharray="6 4"/>',
    ]


def _edges(frame: PlotFrame) -> list[str]:
    w, h = frame.x[1] - frame.x[0], frame.y[0] - frame.y[1]
    return [
        f'<rect x="{frame.left}" y="{frame.top}" width="{frame.width}" height="{frame.height:.1f}" '
        'fill="none" stroke="var(--ink)"/>',
        text(
            frame.left + frame.width / 2,
            frame.top + frame.height + 18,
            f"{w:.0f} mm",
            anchor="middle",
        ),
        text(frame.left - 8, frame.top + frame.height / 2, f"{abs(h):.0f}", anchor="end"),
        text(frame.left - 8, frame.top + frame.height / 2 + 14, "mm", anchor="end"),
    ]


def _image(
    values: np.ndarray, low: float, high: float, stops: tuple[str, ...], frame: PlotFrame
) -> str:
    address = picture(values, low, high, stops)
    return (
        f'<image href="{address}" x="{frame.left}" y="{frame.top}" width="{frame.width}" '
        f'height="{frame.height:.1f}" preserveAspectRatio="none"/>'
    )


def draw_glare(plan: LightPlan, *, most: dict[str, float] | None = None) -> str:
    """Return maps of varnish and gold, in per cent of white, on one scale each."""
    maps = [(n, getattr(plan.glare, n)) for n in ("varnish", "gold")]
    maps = [(n, m) for n, m in maps if m is not None]
    if not maps:
        return ""
    parts, left = [], 12.0
    tall = 0.0
    for name, values in maps:
        high = 100 * float(values.max() if most is None else most[name])
        height = 300 * values.shape[0] / values.shape[1]
        frame = PlotFrame(left, 26, 300, height, (0, 1), (1, 0))
        parts.append(text(left, 16, f"{name}, % of white", css="head"))
        parts.append(_image(100 * values, 0.0, high, GLOW, frame))
        parts.append(
            f'<rect x="{left}" y="26" width="300" height="{height:.1f}" fill="none" stroke="var(--ink)"/>'
        )
        bar = PlotFrame(left, 26 + height + 12, 300, 10, (0, 1), (1, 0))
        parts.append(_image(np.linspace(0, high, 64)[None], 0.0, high, GLOW, bar))
        parts.append(text(left, bar.top + 25, "0"))
        parts.append(text(left + 300, bar.top + 25, f"{high:.2g} %", anchor="end"))
        tall = max(tall, bar.top + 34)
        left += 330
    return svg(left, tall, parts, f"glare maps of {plan.lighting.name}")


def draw_trade_off(curve: TradeOff, best_deg: float, current_deg: float | None = None) -> str:
    """Return each criterion over the lamps' angle; 1 is what is just tolerated."""
    frame = PlotFrame(52, 26, 440, 250, (30, 84), (0, 3))
    parts = axes(frame, "angle of the lamps from the object's normal, degrees", "over tolerance")
    y = float(frame.at(0, 1)[1])
    parts.append(
        f'<path d="M{frame.left} {y:.1f}h{frame.width}" stroke="var(--soft)" stroke-dasharray="5 4"/>'
    )
    parts.append('<clipPath id="trade"><rect x="52" y="20" width="440" height="256"/></clipPath>')
    row = 0
    for (name, values), colour in zip(curve.criteria.items(), PALETTE, strict=True):
        if values.max() < 1e-6:
            continue
        parts.append(
            f'<g clip-path="url(#trade)">{line(*frame.at(curve.angle_deg, values), colour)}</g>'
        )
        parts.append(
            f'<path d="M506 {40 + 21 * row}h18" stroke="var({colour})" stroke-width="2.4"/>'
        )
        parts.append(text(530, 44 + 21 * row, MEANINGS[name]))
        row += 1
    for degrees, colour, words in (
        (best_deg, "--ok", "best"), (current_deg, "--ink", "as planned"),
    ):  # fmt: skip
        if degrees is None or not 30 <= degrees <= 84:
            continue
        x = float(frame.at(degrees, 0)[0])
        parts.append(f'<path d="M{x:.1f} 26v250" stroke="var({colour})" stroke-width="1.4"/>')
        row += 1
        parts.append(
            f'<path d="M506 {40 + 21 * row}h18" stroke="var({colour})" stroke-width="1.4"/>'
        )
        parts.append(text(530, 44 + 21 * row, f"{words}: {degrees:.0f}°"))
    return svg(700, 326, parts, "trade-off over the lamps' angle")


def draw_spectra(wavelengths: np.ndarray, curves: dict[str, np.ndarray], label: str) -> str:
    """Return spectra over their greatest value in sight (Figure 6a); names beside them."""
    inside = (wavelengths >= 380) & (wavelengths <= 780)
    frame = PlotFrame(52, 26, 440, 230, (380, 780), (0, 1.05))
    parts = axes(frame, "wavelength, nm", "relative power")
    dashes = {2: "7 4", 3: "2 4", 4: "9 3 2 3"}
    for i, (name, values) in enumerate(curves.items()):
        shown = values[inside] / values[inside].max()
        parts.append(
            line(*frame.at(wavelengths[inside], shown), PALETTE[i], dash=dashes.get(i, ""))
        )
        y = 40 + 21 * i
        dash = f' stroke-dasharray="{dashes[i]}"' if i in dashes else ""
        parts.append(f'<path d="M506 {y}h24" stroke="var({PALETTE[i]})" stroke-width="2.2"{dash}/>')
        parts.append(text(536, y + 4, name))
    return svg(720, 306, parts, label)


def draw_snr(exposures: list[CameraExposure]) -> str:
    """Return the SNR of every channel on white over its wavelength, a colour a camera."""
    low = min(c.wavelength for e in exposures for c in e.channels)
    high = max(c.wavelength for e in exposures for c in e.channels)
    most = max(c.snr for e in exposures for c in e.channels)
    frame = PlotFrame(52, 26, 440, 230, (10 * np.floor(low / 10) - 20, high + 20), (0, 1.1 * most))
    parts = axes(frame, "wavelength, nm", "signal over noise on white")
    for i, exposure in enumerate(exposures):
        colour = PALETTE[i % len(PALETTE)]
        x, y = frame.at(
            np.array([c.wavelength for c in exposure.channels]),
            np.array([c.snr for c in exposure.channels]),
        )
        if len(exposure.channels) > 8:
            parts.append(line(x, y, colour))
        else:
            for a, b, c in zip(x, y, exposure.channels, strict=True):
                parts.append(f'<circle cx="{a:.1f}" cy="{b:.1f}" r="5" fill="var({colour})"/>')
                parts.append(text(float(a) + 7, float(b) - 6, c.name, fill=colour))
        parts.append(f'<path d="M506 {40 + 21 * i}h18" stroke="var({colour})" stroke-width="3"/>')
        parts.append(text(530, 44 + 21 * i, f"{exposure.camera}; weakest {exposure.limiting}"))
    return svg(720, 306, parts, "signal over noise by wavelength")


def draw_filter(found: RegulatingFilter, camera: str) -> str:
    """Return a regulating filter and the channels before and after it."""
    frame = PlotFrame(52, 26, 300, 200, (found.wavelengths[0], found.wavelengths[-1]), (0, 1.02))
    parts = axes(frame, "wavelength, nm", f"transmittance of a filter for {camera}", about=(4, 5))
    parts.append(line(*frame.at(found.wavelengths, found.transmittance), "--c1"))
    bars = PlotFrame(420, 26, 280, 200, (0, len(found.channels)), (0, 1.02))
    for share in (0, 0.5, 1.0):
        y = float(bars.at(0, share)[1])
        parts.append(f'<path d="M{bars.left} {y:.1f}h280" stroke="var(--line)"/>')
        parts.append(text(bars.left - 7, y + 4, f"{share:g}", anchor="end"))
    width = 280 / len(found.channels)
    for i, name in enumerate(found.channels):
        x = bars.left + i * width
        for values, colour, shift in ((found.before, "--c2", 0.12), (found.after, "--c1", 0.5)):
            height = 200 * float(values[i]) / 1.02
            parts.append(
                f'<rect x="{x + shift * width:.1f}" y="{226 - height:.1f}" width="{0.36 * width:.1f}" '
                f'height="{height:.1f}" fill="var({colour})"/>'
            )
        parts.append(text(x + width / 2, 244, name, anchor="middle"))
    parts.append(text(420, 16, "exposure over the fullest:"))
    parts.append(text(614, 16, "without", fill="--c2"))
    parts.append(text(664, 16, "with", fill="--c1"))
    return svg(720, 270, parts, f"regulating filter of {camera}")
