"""The bench to scale from above and from the side, with its bright and dark field (Figure 5b)."""

from __future__ import annotations

import base64
import io
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.light import eye_of

if TYPE_CHECKING:
    from levkas.planning.light import BrightField, LightPlan
    from levkas.planning.setup import StudioSetup

WIDTH, TOP = 400.0, 34.0


def draw_bench(setup: StudioSetup, plan: LightPlan) -> str:
    """Return both views of a lighting: along the object's width, and along its height.

    Wedges show from where a lamp would be mirrored into the camera: full colour the bent panel's
    mirror, pale what varnish facets add, and thin the walls of the recess.
    """
    panels, tallest = [], 0.0
    for axis, name, title in (
        (0, "width", "From above: along the width"),
        (1, "height", "From the side: along the height"),
    ):
        part, height = _view(setup, plan, axis, plan.fields[name], title)
        panels.append(f'<g transform="translate({axis * (WIDTH + 20):.0f},0)">{part}</g>')
        tallest = max(tallest, height)
    label = f"the bench of {plan.lighting.name}, to scale"
    return svg(2 * WIDTH + 20, tallest, panels, label)


def _view(
    setup: StudioSetup, plan: LightPlan, axis: int, bright: BrightField, title: str
) -> tuple[str, float]:
    places = [lamp.place[[axis, 2]] for lamp in plan.lighting.lamps]
    eye = eye_of(setup)[[axis, 2]]
    # Both views have one scale.
    reach = max(float(np.abs(lamp.place[:2]).max()) for lamp in plan.lighting.lamps)
    reach = max(reach, 0.8 * float(eye[1]), setup.object.size_mm[axis]) * 1.08
    tall = max(float(p[1]) for p in [*places, eye]) * 1.08
    scale = min((WIDTH - 20) / 2 / reach, 330 / tall)
    ground = TOP + tall * scale + 6

    def at(x: float, z: float) -> tuple[float, float]:
        return WIDTH / 2 + x * scale, ground - z * scale

    radius = min(1.02 * tall, reach)
    parts = [text(10, 18, title, css="head")]
    parts += _wedges(at, bright, radius)
    parts += _panel(setup, axis, at)
    parts += _camera(at, eye)
    seen: list[tuple[float, float]] = []
    for lamp, place in zip(plan.lighting.lamps, places, strict=True):
        where = (round(float(place[0])), round(float(place[1])))
        if where in seen:
            continue
        seen.append(where)
        if abs(lamp.place[1 - axis]) > 2 * abs(lamp.place[axis]):
            parts += _aside(at, place)
            continue
        target = lamp.place + lamp.axis * lamp.place[2] / max(-lamp.axis[2], 1e-6)
        parts += _lamp(at, place, target[[axis, 2]], lamp)
    parts.append(_scale_bar(scale, ground + 26))
    return "".join(parts), ground + 44


def _wedges(at: object, bright: BrightField, radius: float) -> list[str]:
    def wedge(low: float, high: float, fill: str, opacity: float) -> str:
        angles = np.radians(np.linspace(low, high, 24))
        rim = [at(radius * np.sin(a), radius * np.cos(a)) for a in angles]  # type: ignore[operator]
        return polygon(np.array([at(0, 0), *rim]), fill, opacity=opacity)  # type: ignore[operator]

    parts = [wedge(*bright.facets, "--bright", 0.28), wedge(*bright.mirror, "--bright", 0.9)]
    if bright.walls is not None:
        low, high = bright.walls
        for side in (1, -1):
            a, b = sorted((side * low, side * min(high, 89.0)))
            parts.append(wedge(a, b, "--wall", 0.16))
    return parts


def _panel(setup: StudioSetup, axis: int, at: object) -> list[str]:
    thing = setup.object
    half = thing.size_mm[axis] / 2
    s = np.linspace(-half, half, 41)
    bent = thing.bend is not None and (thing.bend.straight == "width") == (axis == 1)
    up = np.zeros(41)
    if bent and thing.bend is not None:
        up = thing.bend.radius_mm * (np.cos(s / thing.bend.radius_mm) - 1)
    top = np.array([at(a, b) for a, b in zip(s, up, strict=True)])  # type: ignore[operator]
    under = top[::-1] + np.array([0.0, 7.0])
    return [polygon(np.vstack([top, under]), "--ink", opacity=0.85)]


def _camera(at: object, eye: np.ndarray) -> list[str]:
    x, y = at(float(eye[0]), float(eye[1]))  # type: ignore[operator]
    return [
        f'<path d="M{x:.1f} {y:.1f}L{at(0, 0)[0]:.1f} {at(0, 0)[1]:.1f}" stroke="var(--soft)"'  # type: ignore[operator]
        ' stroke-dasharray="2 5"/>',
        f'<rect x="{x - 13:.1f}" y="{y - 17:.1f}" width="26" height="17" rx="3" fill="var(--ink)"/>',
        f'<rect x="{x - 6:.1f}" y="{y - 1:.1f}" width="12" height="8" fill="var(--ink)"/>',
        text(x + 20, y, f"camera, {eye[1] / 10:.0f} cm"),
    ]


def _lamp(at: object, place: np.ndarray, target: np.ndarray, lamp: object) -> list[str]:
    x, y = at(float(place[0]), float(place[1]))  # type: ignore[operator]
    a, b = at(float(target[0]), float(target[1]))  # type: ignore[operator]
    angle = np.degrees(np.arctan2(place[0], place[1]))
    anchor = "start" if x < WIDTH / 2 else "end"
    away = 10 if anchor == "start" else -10
    words = f"{abs(angle):.0f}°, {lamp.distance_mm / 10:.0f} cm"  # type: ignore[attr-defined]
    return [
        f'<path d="M{x:.1f} {y:.1f}L{a:.1f} {b:.1f}" stroke="var(--lamp)" stroke-width="1.6"/>',
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="9" fill="var(--lamp)"/>',
        f"<title>{escape(lamp.name)}</title>",  # type: ignore[attr-defined]
        text(x + away, y - 15, words, anchor=anchor),
    ]


def _aside(at: object, place: np.ndarray) -> list[str]:
    """A lamp that stands before or behind the drawing's plane."""
    x, y = at(float(place[0]), float(place[1]))  # type: ignore[operator]
    return [
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="8" fill="var(--card)" stroke="var(--lamp)" '
        'stroke-width="2.5"/>',
        text(x + 14, y + 4, f"lamps to the sides, {place[1] / 10:.0f} cm out"),
    ]


def _scale_bar(scale: float, y: float) -> str:
    length = 500 * scale
    return (
        f'<path d="M14 {y:.1f}h{length:.1f}m0 -4v8M14 {y - 4:.1f}v8" stroke="var(--soft)" fill="none"/>'
        + text(22 + length, y + 4, "50 cm")
    )


PALETTE = ("--c1", "--c2", "--c3", "--c4", "--c5", "--c6")


@dataclass(frozen=True)
class PlotFrame:
    """A plot's place on the page and the values at its edges."""

    left: float
    top: float
    width: float
    height: float
    x: tuple[float, float]
    y: tuple[float, float]

    def at(self, x: np.ndarray | float, y: np.ndarray | float) -> tuple[np.ndarray, np.ndarray]:
        """Bring values on to the page."""
        across = self.left + self.width * (np.asarray(x) - self.x[0]) / (self.x[1] - self.x[0])
        down = self.top + self.height * (self.y[1] - np.asarray(y)) / (self.y[1] - self.y[0])
        return across, down


def svg(width: float, height: float, parts: Sequence[str], label: str) -> str:
    """Return a drawing; `label` is what a screen reader says."""
    return (
        f'<svg viewBox="0 0 {width:.0f} {height:.0f}" role="img" aria-label="{escape(label)}">'
        f"{''.join(parts)}</svg>"
    )


def escape(text: str) -> str:
    """Return text that is safe between tags and in attributes.

    >>> escape('<"&')
    '&lt;&quot;&amp;'
    """
    from xml.sax.saxutils import escape as escaped

    return escaped(text, {'"': "&quot;"})


def text(
    x: float, y: float, words: str, *, anchor: str = "start", css: str = "", fill: str = ""
) -> str:
    """Return words at a place."""
    style = f' style="fill:var({fill})"' if fill else ""
    named = f' class="{css}"' if css else ""
    return (
        f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}"{named}{style}>{escape(words)}</text>'
    )


def line(x: np.ndarray, y: np.ndarray, colour: str, *, width: float = 1.8, dash: str = "") -> str:
    """Return a curve through points of the page."""
    pairs = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(np.ravel(x), np.ravel(y), strict=True))
    dashes = f' stroke-dasharray="{dash}"' if dash else ""
    return (
        f'<polyline points="{pairs}" fill="none" stroke="var({colour})" stroke-width="{width}"'
        f' stroke-linejoin="round"{dashes}/>'
    )


def polygon(points: np.ndarray, fill: str, *, opacity: float = 1.0, stroke: str = "") -> str:
    """Return a filled outline; `points` (n, 2) of the page."""
    pairs = " ".join(f"{a:.1f},{b:.1f}" for a, b in points)
    edge = f' stroke="var({stroke})"' if stroke else ""
    return f'<polygon points="{pairs}" fill="var({fill})" fill-opacity="{opacity}"{edge}/>'


def nice_ticks(low: float, high: float, about: int = 5) -> list[float]:
    """Return round values between two.

    >>> nice_ticks(0.0, 1.0)
    [0.0, 0.2, 0.4, 0.6, 0.8, 1.0]
    """
    raw = (high - low) / max(about, 1)
    power = 10.0 ** np.floor(np.log10(raw))
    step = float(power * next(m for m in (1, 2, 2.5, 5, 10) if m * power >= raw * 0.999))
    first = int(np.ceil(low / step - 1e-9))
    return [round(i * step, 10) for i in range(first, int(np.floor(high / step + 1e-9)) + 1)]


def axes(
    frame: PlotFrame, x_label: str, y_label: str, *, about: tuple[int, int] = (6, 5)
) -> list[str]:
    """Return grid, numbers and labels of a plot."""
    bottom, right = frame.top + frame.height, frame.left + frame.width
    parts = []
    for value in nice_ticks(*frame.y, about[1]):
        y = float(frame.at(0, value)[1])
        parts.append(f'<path d="M{frame.left} {y:.1f}H{right}" stroke="var(--line)"/>')
        parts.append(text(frame.left - 7, y + 4, f"{value:g}", anchor="end"))
    for value in nice_ticks(*frame.x, about[0]):
        x = float(frame.at(value, 0)[0])
        parts.append(f'<path d="M{x:.1f} {bottom}v5" stroke="var(--soft)"/>')
        parts.append(text(x, bottom + 18, f"{value:g}", anchor="middle"))
    parts.append(f'<path d="M{frame.left} {bottom}H{right}" stroke="var(--soft)"/>')
    parts.append(text((frame.left + right) / 2, bottom + 36, x_label, anchor="middle"))
    parts.append(text(frame.left - 40, frame.top - 10, y_label))
    return parts


def contours(
    x: np.ndarray, y: np.ndarray, values: np.ndarray, level: float
) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the pieces of a level line: marching squares.

    Parameters
    ----------
    x, y : ndarray, (columns,), (rows,)
    values : ndarray, (rows, columns)
    level : float

    Returns
    -------
    pieces : list of (start, end)
        Each (2,) in the units of x and y; a saddle is joined by its mean.

    Examples
    --------
    >>> x = y = np.array([0.0, 1.0])
    >>> [[p.tolist() for p in piece] for piece in contours(x, y, np.array([[0, 1], [0, 1.0]]), 0.25)]
    [[[0.25, 0.0], [0.25, 1.0]]]
    """
    pieces = []
    above = values > level
    mixed = above[:-1, :-1].astype(int) + above[:-1, 1:] + above[1:, :-1] + above[1:, 1:]
    for i, j in np.argwhere((mixed > 0) & (mixed < 4)):
        corners = [(j, i), (j + 1, i), (j + 1, i + 1), (j, i + 1)]
        crossed = []
        for (a, b), (c, d) in zip(corners, corners[1:] + corners[:1], strict=True):
            one, other = values[b, a], values[d, c]
            if (one > level) != (other > level):
                t = (level - one) / (other - one)
                crossed.append(
                    np.array([x[a] + t * (x[c] - x[a]), y[b] + t * (y[d] - y[b])], float)
                )
        if len(crossed) == 4 and (values[i : i + 2, j : j + 2].mean() > level) == above[i, j]:
            crossed = crossed[1:] + crossed[:1]
        pieces += list(zip(crossed[::2], crossed[1::2], strict=True))
    return pieces


def picture(values: np.ndarray, low: float, high: float, stops: Sequence[str]) -> str:
    """Return a map as a PNG data address: values from `low` to `high` over colours ``#rrggbb``."""
    from PIL import Image

    share = np.clip((values - low) / max(high - low, 1e-12), 0, 1)
    table = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in stops], float)
    at = np.linspace(0, 1, len(table))
    rgb = np.stack([np.interp(share, at, table[:, k]) for k in range(3)], -1)
    stream = io.BytesIO()
    Image.fromarray(np.round(rgb).astype(np.uint8)).save(stream, "PNG")
    return "data:image/png;base64," + base64.b64encode(stream.getvalue()).decode("ascii")
