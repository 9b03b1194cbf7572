"""The bench to scale from above and from the side, with its bright and dark field (Figure 5b)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.planning.drawing import escape, polygon, svg, text
from levkas.planning.light import eye_of

if TYPE_CHECKING:
    from levkas.planning.light import BrightField, LightPlan
    from levkas.planning.setup import Setup

WIDTH, TOP = 400.0, 34.0


def draw_bench(setup: Setup, plan: LightPlan) -> str:
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
    setup: Setup, plan: LightPlan, axis: int, bright: BrightField, title: str
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


def _panel(setup: Setup, axis: int, at: object) -> list[str]:
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
