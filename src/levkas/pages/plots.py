"""Small plots as SVG text: lines over a linear or logarithmic axis, and maps with contours."""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Sequence

WIDTH, HEIGHT = 560, 300
LEFT, RIGHT, TOP, BOTTOM = 52, 14, 14, 40
TICKS = 5
COLOURS = {"R": "#d4453b", "G": "#3a9a4b", "B": "#3b6fd4", "IR": "#8a5a3c"}


@dataclass(frozen=True)
class Line:
    """One line of a plot; points that are not finite are left out."""

    label: str
    x: Sequence[float]
    y: Sequence[float]
    colour: str = "var(--ref)"
    dashed: bool = False


def plot(
    lines: Sequence[Line],
    *,
    x: str,
    y: str,
    log: bool = False,
    log_y: bool = False,
    top_axis: tuple[str, Sequence[tuple[float, str]]] | None = None,
    from_zero: bool = False,
    legend: bool = True,
) -> str:
    """Return lines as SVG.

    Parameters
    ----------
    lines : sequence of Line
    x, y : str
        What stands at the axes.
    log, log_y : bool
        Logarithmic x, y; points at or below 0 are left out.
    top_axis : (title, [(x, label), …]), optional
        A second axis above.
    from_zero : bool
        y starts at 0.
    """
    drawn = [_sound(line, log, log_y) for line in lines]
    xs = np.concatenate([line[0] for line in drawn] or [np.zeros(0)])
    ys = np.concatenate([line[1] for line in drawn] or [np.zeros(0)])
    if not len(xs):
        return ""
    top = TOP + (26 if top_axis else 0)
    to_x, x_ticks = _axis(xs, LEFT, WIDTH - RIGHT, log=log)
    to_y, y_ticks = _axis(ys, HEIGHT - BOTTOM, top, log=log_y, from_zero=from_zero)
    parts = [
        f'<path d="M{LEFT} {to_y(v):.1f}H{WIDTH - RIGHT}" stroke="#8883"/>'
        f'<text x="{LEFT - 6}" y="{to_y(v) + 4:.1f}" text-anchor="end">{v + 0.0:g}</text>'
        for v in y_ticks
    ]
    parts += [
        f'<path d="M{to_x(v):.1f} {top}V{HEIGHT - BOTTOM}" stroke="#8883"/>'
        f'<text x="{to_x(v):.1f}" y="{HEIGHT - BOTTOM + 15}" text-anchor="middle">{v + 0.0:g}</text>'
        for v in x_ticks
    ]
    if top_axis:
        title, marks = top_axis
        parts += [
            f'<path d="M{to_x(v):.1f} {top}v-5" stroke="currentColor"/>'
            f'<text x="{to_x(v):.1f}" y="{top - 8}" text-anchor="middle">{escape(text)}</text>'
            for v, text in marks
        ]
        parts.append(f'<text x="{LEFT}" y="12">{escape(title)}</text>')
    for line, (px, py) in zip(lines, drawn, strict=True):
        parts.append(_line(to_x(px), to_y(py), line))
    if legend and len(lines) > 1:
        parts.append(_legend(lines, top))
    parts.append(
        f'<text x="{(LEFT + WIDTH - RIGHT) / 2}" y="{HEIGHT - 6}" text-anchor="middle">{escape(x)}</text>'
        f'<text transform="translate(12,{(top + HEIGHT - BOTTOM) / 2}) rotate(-90)" text-anchor="middle">{escape(y)}</text>'
    )
    return _svg("".join(parts), f"{y} over {x}")


def colour_of(label: str, index: int, count: int, wavelength: float = float("nan")) -> str:
    """Return a colour for a channel: its own where it is a letter, else along the spectrum."""
    letters = label.rstrip("0123456789")
    if letters in COLOURS:
        return COLOURS[letters]
    share = index / max(count - 1, 1)
    if np.isfinite(wavelength):
        share = float(np.clip((wavelength - 400) / 320, 0, 1))
    return f"hsl({275 * (1 - share):.0f} 65% 50%)"


def light_map(
    levels: np.ndarray,
    size: Sequence[int],
    rectangle: Sequence[int],
    *,
    contours: Sequence[float] = (0.5, 0.6, 0.7, 0.8, 0.85, 0.9, 0.95),
) -> str:
    """Return a light field with contours and its rectangle as SVG, as the paper's Figure 6b.

    Parameters
    ----------
    levels : ndarray, (rows, columns), 0 … 1
    size : (width, height) of the white, px
    rectangle : (x, y, width, height), px
    """
    rows, columns = levels.shape
    wide = 420.0
    tall = max(40.0, min(420.0, wide * size[1] / size[0]))
    across, down = wide / columns, tall / rows
    cells = "".join(
        f'<rect x="{c * across:.1f}" y="{r * down:.1f}" width="{across + 0.3:.1f}" '
        f'height="{down + 0.3:.1f}" fill="hsl(42 45% {8 + 84 * levels[r, c]:.0f}%)"/>'
        for r in range(rows)
        for c in range(columns)
    )
    lines = "" if min(rows, columns) < 3 else _contours(levels, across, down, contours)
    x, y, width, height = rectangle
    fx, fy = wide / size[0], tall / size[1]
    box = (
        f'<rect x="{x * fx:.1f}" y="{y * fy:.1f}" width="{width * fx:.1f}" height="{height * fy:.1f}" '
        'fill="none" stroke="#1f9d4c" stroke-width="2.5"/>'
    )
    middle = (
        f'<path d="M0 {tall / 2:.1f}H{wide}M{wide / 2} 0V{tall:.1f}" stroke="#c62828" '
        'stroke-width="1" stroke-dasharray="5 4"/>'
    )
    return _svg(cells + lines + middle + box, "light on the white", wide, tall)


def _contours(levels: np.ndarray, across: float, down: float, contours: Sequence[float]) -> str:
    from skimage.measure import find_contours

    parts = []
    for level in contours:
        for path in sorted(find_contours(levels, level), key=len, reverse=True):
            if len(path) < 5:
                continue
            points = " ".join(f"{(c + 0.5) * across:.1f},{(r + 0.5) * down:.1f}" for r, c in path)
            parts.append(
                f'<polyline points="{points}" fill="none" stroke="#1d1b16" stroke-width="1"/>'
            )
            r, c = path[len(path) // 2]
            parts.append(
                f'<text x="{(c + 0.5) * across:.1f}" y="{(r + 0.5) * down:.1f}" '
                f'style="fill:#1d1b16;paint-order:stroke;stroke:#fff8;stroke-width:3px">{100 * level:g} %</text>'
            )
    return "".join(parts)


def picture_with_areas(
    src: str, size: tuple[int, int], areas: np.ndarray, names: Sequence[str]
) -> str:
    """Return a picture (a data address) with areas, (n, 4, 2) px, drawn over it."""
    width, height = size
    unit = max(width, height) / 420
    parts = [f'<image href="{src}" width="{width}" height="{height}"/>']
    for area, name in zip(areas, names, strict=True):
        points = " ".join(f"{x + 0.5:.1f},{y + 0.5:.1f}" for x, y in area)
        x, y = area.min(0)
        parts.append(
            f'<polygon points="{points}" fill="none" stroke="#00e5ff" stroke-width="{unit:.2f}"/>'
            f'<text x="{x:.1f}" y="{y - 1.5 * unit:.1f}" style="font-size:{8 * unit:.1f}px;fill:#00e5ff">{escape(name)}</text>'
        )
    return _svg("".join(parts), "sampled areas", width, height)


def _svg(body: str, label: str, width: float = WIDTH, height: float = HEIGHT) -> str:
    return f'<svg viewBox="0 0 {width:g} {height:.0f}" role="img" aria-label="{escape(label)}">{body}</svg>'


def _sound(line: Line, log: bool, log_y: bool) -> tuple[np.ndarray, np.ndarray]:
    x = np.array([np.nan if v is None else v for v in line.x], float)
    y = np.array([np.nan if v is None else v for v in line.y], float)
    good = np.isfinite(x) & np.isfinite(y)
    if log:
        good &= x > 0
    if log_y:
        good &= y > 0
    return x[good], y[good]


def _line(x: np.ndarray, y: np.ndarray, line: Line) -> str:
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, y, strict=True))
    dash = ' stroke-dasharray="5 4"' if line.dashed else ""
    dots = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x, y, strict=True))
    return (
        f'<polyline points="{points}" fill="none" stroke="{line.colour}" stroke-width="1.4"{dash}/>'
        f'<path d="{dots}" stroke="{line.colour}" stroke-width="4" stroke-linecap="round"/>'
    )


def _legend(lines: Sequence[Line], top: float) -> str:
    """At most eight names: the first, the last, and some between."""
    places = sorted({round(i * (len(lines) - 1) / min(7, len(lines) - 1)) for i in range(8)})
    chosen = [lines[p] for p in places if p < len(lines)]
    return "".join(
        f'<path d="M{LEFT + 10} {top + 14 + 15 * k}h14" stroke="{line.colour}" stroke-width="2"/>'
        f'<text x="{LEFT + 28}" y="{top + 18 + 15 * k}">{escape(line.label)}</text>'
        for k, line in enumerate(chosen)
    )


class _axis_scale:
    """Values to places of an axis."""

    def __init__(self, low: float, high: float, start: float, end: float, log: bool) -> None:
        self.log, self.start, self.end = log, start, end
        self.low = float(np.log10(low)) if log else low
        self.high = float(np.log10(high)) if log else high

    def __call__(self, value: np.ndarray | float) -> np.ndarray:
        v = np.log10(value) if self.log else np.asarray(value, float)
        share = (v - self.low) / max(self.high - self.low, 1e-12)
        return np.asarray(self.start + share * (self.end - self.start))


def _axis(
    values: np.ndarray, start: float, end: float, *, log: bool = False, from_zero: bool = False
) -> tuple[_axis_scale, list[float]]:
    low, high = float(values.min()), float(values.max())
    if log:
        low, high = low / 1.15, high * 1.15
        powers = range(int(np.floor(np.log10(low))), int(np.ceil(np.log10(high))) + 1)
        ticks = [m * 10.0**p for p in powers for m in (1, 2, 5) if low <= m * 10.0**p <= high]
        return _axis_scale(low, high, start, end, True), ticks
    low = 0.0 if from_zero else low
    room = max(high - low, 1e-9 + 0.02 * abs(high))
    low, high = (0.0 if from_zero else low - 0.05 * room), high + 0.08 * room
    step = _step((high - low) / TICKS)
    first = np.ceil(low / step)
    ticks = [float(f"{k * step:.10g}") for k in np.arange(first, np.floor(high / step) + 1)]
    return _axis_scale(low, high, start, end, False), ticks


def _step(width: float) -> float:
    power = 10.0 ** np.floor(np.log10(width))
    return float(power * next((m for m in (1, 2, 5) if width <= m * power), 10))
