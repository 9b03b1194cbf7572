"""What one registration rests on, and the paper's Figures 9 and 10 of its own method, as SVG text."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.pages.page import Figure
from levkas.registration.outliers import frame_corners
from levkas.registration.window_matching import CheckWindows

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from levkas.registration.record import Matches, Trace

LONG_PX = 12.0
"""Of a panel: shifts are drawn about so long, and never longer than twice that."""
MOST_PAIRS = 400
"""Pairs drawn in a panel; more only blacken it."""
PANEL_PX = 260


def draw_trace(matches: Matches, trace: Trace | None) -> list[Figure]:
    """Return Figures 9 and 10 of a registration, or one panel of its pairs where it left no trace."""
    if len(matches) == 0:
        return []
    if trace is None:
        height = _placing(matches.reference).height
        return [Figure(_panels([_pairs_only(matches)], height), _PAIRS)]
    middle = trace.rounds // 2
    rounds = sorted({0, middle, trace.rounds - 1})
    panels = [_panel(matches, trace, -1, "start: scale alone")]
    panels += [_panel(matches, trace, r, f"round {r + 1} of {trace.rounds}") for r in rounds]
    height = _placing(_both_frames(trace)).height
    return [Figure(_panels(panels, height), _COURSE), Figure(_curve(trace), _LARGEST)]


def draw_basis(trace: Mapping[str, Any], size: Sequence[int]) -> list[Figure]:
    """Return a figure a sensor of what a dense map rests on, as `describe_basis` tells it; none of other traces."""
    if trace.get("kind") != "windows":
        return []
    return [
        Figure(_basis(sensor, size), _said_of_basis(sensor))
        for sensor in trace["sensors"]
        if "windows" in sensor
    ]


def _said_of_basis(sensor: Mapping[str, Any]) -> str:
    windows, count = sensor["windows"], sensor["count"]
    shown = len(windows["x"])
    some = f" ({shown} of them drawn)" if shown < count else ""
    whose = "all bands together" if sensor["source"] == "fused" else sensor["source"]
    told = (
        f"What the map{' of sensor ' + sensor['sensor'] if sensor['sensor'] else ''} rests on, in reference "
        f"pixels. Left: {count} windows{some} of {whose} that it was fitted to, the fainter the less they weigh; lines lead "
        f"from where the map puts each to where it is seen, {_enlargement(sensor):g} times as long, the longest cut."
    )
    if sensor["checks"] is None:
        return told
    return (
        f"{told} Right: windows of {sensor['band']} that were free to be found 12 px around: blue ones lie where "
        "the map puts them, red ones elsewhere, hollow ones were not recognised. Where there are no blue ones "
        "nothing confirms the map."
    )


def _enlargement(sensor: Mapping[str, Any]) -> float:
    """Return the round number by which three of four shifts become shorter than some ten pixels."""
    windows = sensor["windows"]
    length = np.hypot(windows["shift_x"], windows["shift_y"])
    most = max(float(np.percentile(length, 75)) if len(length) else 0.0, 1e-4)
    return max(_rounded_down(LONG_PX / most), 1.0)


def _rounded_down(value: float) -> float:
    """Return the largest of 1, 2, 5, 10 … and their tenths that is not above `value`.

    >>> _rounded_down(4.9), _rounded_down(0.021), _rounded_down(170.0)
    (2.0, 0.02, 100.0)
    """
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step <= value / power * (1 + 1e-9)) * power)


def _basis(sensor: Mapping[str, Any], size: Sequence[int]) -> str:
    """Two panels: the windows of the fit with their shifts, and those that check it."""
    corners = frame_corners((int(size[0]), int(size[1])))
    place, windows = _placing(corners), sensor["windows"]
    points = np.stack([windows["x"], windows["y"]], 1)
    shift = np.stack([windows["shift_x"], windows["shift_y"]], 1) * _enlargement(sensor)
    longest = LONG_PX * 2 / place.scale
    shift *= np.minimum(1.0, longest / np.maximum(np.hypot(*shift.T), 1e-9))[:, None]
    parts = [_outline(place(corners), "currentColor")]
    for low, high, opacity in ((0.0, 0.5, 0.25), (0.5, 2.0, 1.0)):
        weight = np.array(windows["weight"])
        here = (weight >= low) & (weight < high)
        ends = _lines(place(points[here]), place(points[here] + shift[here]))
        dots = _dots(place(points[here]), "var(--ref)")
        parts.append(f'<g opacity="{opacity}">{ends}{dots}</g>')
    held = [v for v in windows["held_out"] if v is not None]
    scatter = f", single ones scatter by {np.median(held):.2g} px" if held else ""
    parts.append(f'<text x="8" y="16">{sensor["count"]} windows{scatter}</text>')
    parts.append(_scale_bar(place, _enlargement(sensor)))
    panels = ["".join(parts)]
    if sensor["checks"] is not None:
        panels.append(_checks(CheckWindows.from_dict(sensor["checks"]), corners, place))
    return _panels(panels, place.height, "what the map rests on")


def _scale_bar(place: _placing, enlargement: float) -> str:
    """A bar as long as a shift of a round number of reference px is drawn, with that number."""
    unit = place.scale * enlargement
    length = _rounded_down(60.0 / unit)
    x, y = 20.0, place.height - 8
    bar = f'<path d="M{x} {y:.1f}h{length * unit:.1f}" stroke="#999" stroke-width="1.5"/>'
    return f'{bar}<text x="{x + length * unit + 6:.1f}" y="{y + 4:.1f}">{length:g} px</text>'


def _checks(checks: CheckWindows, corners: np.ndarray, place: _placing) -> str:
    good = checks.confirmed
    parts = [_outline(place(corners), "currentColor")]
    for mask, style in (
        (good, 'fill="var(--tgt)"'),
        (checks.found & ~good, 'fill="var(--ref)"'),
        (~checks.found, 'fill="none" stroke="#999" stroke-width="0.8"'),
    ):
        spots = "".join(
            f'<circle cx="{x:.1f}" cy="{y:.1f}" r="2.4"/>' for x, y in place(checks.centres[mask])
        )
        parts.append(f"<g {style}>{spots}</g>")
    parts.append(f'<text x="8" y="16">{int(good.sum())} of {len(good)} confirm the map</text>')
    return "".join(parts)


_COURSE = (
    "The course of the registration in reference pixels (the paper's Figure 9): black the reference "
    "frame, red the target's frame under scale alone, magenta under the fit; dots are pairs, red in "
    "the reference, blue mapped from the target, gray lines the errors."
)
_LARGEST = (
    "The largest error at each round as the worst pair leaves (the paper's Figure 10); the first "
    "point is the cut under scale alone at `reject`, the dashed line is `stop`."
)
_PAIRS = "Pairs of control points in reference pixels: kept ones red, removed ones gray."


def _panels(panels: Sequence[str], height: float, label: str = "course of the registration") -> str:
    columns = 2 if len(panels) > 1 else 1
    rows = -(-len(panels) // columns)
    placed = [
        f'<g transform="translate({(i % columns) * PANEL_PX},{(i // columns) * height:.0f})">{p}</g>'
        for i, p in enumerate(panels)
    ]
    size = f"0 0 {columns * PANEL_PX} {rows * height:.0f}"
    return f'<svg viewBox="{size}" role="img" aria-label="{label}">{"".join(placed)}</svg>'


def _panel(matches: Matches, trace: Trace, number: int, title: str) -> str:
    """One state of the removal: frames, and the pairs under the map of that state."""
    place, frame = _placing(_both_frames(trace)), _both_frames(trace)[:4]
    kept = np.ones(len(matches), bool) if number < 0 else trace.kept_at(number)
    chosen = np.flatnonzero(kept)[:: max(1, int(kept.sum()) // MOST_PAIRS)]
    mapped = trace.scale(matches.target[chosen])
    if number >= 0:
        mapped = _under_corners(trace, number, mapped)
    reference = matches.reference[chosen]
    parts = [_outline(place(frame), "currentColor"), _outline(place(trace.frame), "var(--ref)")]
    if number >= 0:
        parts.append(_outline(place(trace.corners[number]), "var(--fit)"))
    parts += [_lines(place(reference), place(mapped)), _dots(place(reference), "var(--ref)")]
    parts.append(_dots(place(mapped), "var(--tgt)"))
    parts.append(f'<text x="8" y="16">{title}: {int(kept.sum())} pairs</text>')
    return "".join(parts)


def _both_frames(trace: Trace) -> np.ndarray:
    return np.vstack([frame_corners(trace.size), trace.frame])


def _under_corners(trace: Trace, number: int, mapped: np.ndarray) -> np.ndarray:
    """Move points from the scale-only frame to the fitted one by its corners, enough for a drawing."""
    a, b = trace.frame, trace.corners[number]
    span = a[2] - a[0]
    u, v = ((mapped - a[0]) / span).T[:, :, None]
    return b[0] * (1 - u) * (1 - v) + b[1] * u * (1 - v) + b[2] * u * v + b[3] * (1 - u) * v


def _pairs_only(matches: Matches) -> str:
    place = _placing(matches.reference)
    kept = matches.kept
    return _dots(place(matches.reference[~kept][:MOST_PAIRS]), "currentColor") + _dots(
        place(matches.reference[kept][:: max(1, int(kept.sum()) // MOST_PAIRS)]), "var(--ref)"
    )


class _placing:
    """Bring reference pixels into a panel, margins for the title left free."""

    def __init__(self, points: np.ndarray) -> None:
        self.low, high = points.min(0), points.max(0)
        self.scale = (PANEL_PX - 40) / max(float((high - self.low).max()), 1.0)
        self.height = 48 + self.scale * float(high[1] - self.low[1])

    def __call__(self, points: np.ndarray) -> np.ndarray:
        return (np.asarray(points) - self.low) * self.scale + [20, 28]


def _outline(points: np.ndarray, colour: str) -> str:
    path = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
    return f'<polygon points="{path}" fill="none" stroke="{colour}" stroke-width="1.2"/>'


def _dots(points: np.ndarray, colour: str) -> str:
    path = "".join(f"M{x:.1f} {y:.1f}h0" for x, y in points if np.isfinite(x + y))
    return f'<path d="{path}" stroke="{colour}" stroke-width="2" stroke-linecap="round" opacity="0.7"/>'


def _lines(start: np.ndarray, end: np.ndarray) -> str:
    ends = np.hstack([start, end])
    path = "".join(
        f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for a, b, c, d in ends if np.isfinite(a + b + c + d)
    )
    return f'<path d="{path}" stroke="#999" stroke-width="0.6" fill="none"/>'


def _curve(trace: Trace) -> str:
    """Largest error by round, logarithmic, with the cut and `stop` marked."""
    width, height, left, bottom = 2 * PANEL_PX, PANEL_PX, 52, 34
    cut = trace.scale_errors[np.isfinite(trace.scale_errors)]
    errors = np.concatenate([[cut.max() if len(cut) else trace.reject], trace.largest])
    errors = np.maximum(errors, 1e-3)
    low, high = (
        np.log10(min(errors.min(), trace.stop)) - 0.1,
        np.log10(max(errors.max(), trace.reject)) + 0.1,
    )
    chosen = np.unique(np.linspace(0, len(errors) - 1, min(len(errors), 500)).astype(int))
    x = left + (width - left - 12) * chosen / max(len(errors) - 1, 1)

    def y_of(value: np.ndarray | float) -> np.ndarray:
        return 12 + (height - bottom - 12) * (high - np.log10(value)) / (high - low)

    path = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y_of(errors[chosen]), strict=True))
    parts = [f'<polyline points="{path}" fill="none" stroke="var(--ref)" stroke-width="1.5"/>']
    for power in range(int(np.ceil(low)), int(np.floor(high)) + 1):
        y = float(y_of(10.0**power))
        parts.append(f'<path d="M{left} {y:.1f}H{width - 12}" stroke="#8884"/>')
        parts.append(
            f'<text x="{left - 6}" y="{y + 4:.1f}" text-anchor="end">{10.0**power:g}</text>'
        )
    stop = float(y_of(trace.stop))
    parts.append(
        f'<path d="M{left} {stop:.1f}H{width - 12}" stroke="var(--tgt)" stroke-dasharray="5 4"/>'
    )
    parts.append(
        f'<text x="{width - 14}" y="{stop - 5:.1f}" text-anchor="end">stop {trace.stop:g} px</text>'
    )
    middle = (left + width) / 2
    parts.append(
        f'<text x="{middle}" y="{height - 8}" text-anchor="middle">round (of {trace.rounds})</text>'
    )
    parts.append(f'<text x="{left}" y="{height - 8}">largest error, px</text>')
    return f'<svg viewBox="0 0 {width} {height}" role="img" aria-label="largest error by round">{"".join(parts)}</svg>'
