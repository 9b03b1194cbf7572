"""Plots of a lighting plan: the bench to scale, maps of light and glare, spectra, SNR."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.pages.plots import draw_legend, in_style, new_figure, themed, to_svg
from levkas.planning.light import eye_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from levkas.planning.exposure_plan import CameraExposure
    from levkas.planning.light import BrightField, LightPlan
    from levkas.planning.setup import StudioLamp, StudioSetup

INKS = ("c1", "c2", "c3", "c4", "c5", "c6")
DASHES = ("-", "-", "--", ":", "-.", "-")


@in_style
def draw_bench(setup: StudioSetup, plan: LightPlan) -> str:
    """Return a lighting to scale, along the object's width and along its height (Figure 5b).

    Wedges show from where a lamp would be mirrored into the camera: full colour the panel's
    mirror, pale what varnish facets add, and thin the walls of the recess.
    """
    lamps = plan.lighting.lamps
    eye = eye_of(setup)
    reach = max(float(np.abs(lamp.place[:2]).max()) for lamp in lamps)
    reach = 1.08 * max(reach, 0.8 * float(eye[2]), *setup.object.size_mm)
    tall = 1.08 * max(float(p[2]) for p in [*(lamp.place for lamp in lamps), eye])
    figure = new_figure(820, 60 + 400 * tall / (2 * reach))
    titles = ("From above: along the width", "From the side: along the height")
    for axis, (axes, name) in enumerate(
        zip(figure.subplots(1, 2), ("width", "height"), strict=True)
    ):
        axes.set(
            title=titles[axis], xlim=(-reach, reach), ylim=(-0.08 * tall, tall), aspect="equal"
        )
        axes.set_axis_off()
        _draw_wedges(axes, plan.fields[name], min(1.02 * tall, reach))
        _draw_panel(axes, setup, axis)
        _draw_camera(axes, eye[[axis, 2]])
        drawn = set()
        for lamp in lamps:
            where = tuple(lamp.place[[axis, 2]].round().tolist())
            if where not in drawn:
                drawn.add(where)
                _draw_lamp(axes, lamp, axis)
        axes.plot([-reach, -reach + 500], [-0.06 * tall] * 2, color=themed("soft"))
        axes.annotate("50 cm", (-reach + 500, -0.06 * tall), (4, -3), textcoords="offset points")
    return to_svg(figure, f"the bench of {plan.lighting.name}, to scale")


def _draw_wedges(axes: Axes, bright: BrightField, radius: float) -> None:
    def wedge(low: float, high: float, ink: str, opacity: float) -> None:
        angles = np.radians(np.linspace(low, high, 24))
        x, z = radius * np.sin(angles), radius * np.cos(angles)
        axes.fill([0.0, *x], [0.0, *z], color=themed(ink), alpha=opacity, linewidth=0)

    wedge(*bright.facets, "bright", 0.28)
    wedge(*bright.mirror, "bright", 0.9)
    if bright.walls is not None:
        low, high = bright.walls
        for side in (1, -1):
            first, last = sorted((side * low, side * min(high, 89.0)))
            wedge(first, last, "wall", 0.16)


def _draw_panel(axes: Axes, setup: StudioSetup, axis: int) -> None:
    thing = setup.object
    half = thing.size_mm[axis] / 2
    s = np.linspace(-half, half, 41)
    axes.plot(s, np.zeros(41), color=themed("ink"), linewidth=5, solid_capstyle="butt")


def _draw_camera(axes: Axes, eye: np.ndarray) -> None:
    axes.plot([eye[0], 0], [eye[1], 0], ":", color=themed("soft"), linewidth=1)
    axes.plot(*eye, "s", color=themed("ink"), markersize=12)
    words = f"camera, {eye[1] / 10:.0f} cm"
    axes.annotate(words, tuple(eye), (12, 4), textcoords="offset points")


def _draw_lamp(axes: Axes, lamp: StudioLamp, axis: int) -> None:
    """Draw a lamp with its ray, or hollow where it stands before or behind the drawing's plane."""
    x, z = lamp.place[[axis, 2]]
    if abs(lamp.place[1 - axis]) > 2 * abs(lamp.place[axis]):
        words, ray = f"lamps to the sides, {z / 10:.0f} cm out", False
    else:
        angle = np.degrees(np.arctan2(x, z))
        words, ray = f"{abs(angle):.0f}°, {lamp.distance_mm / 10:.0f} cm", True
        target = lamp.place + lamp.axis * lamp.place[2] / max(-lamp.axis[2], 1e-6)
        axes.plot([x, target[axis]], [z, target[2]], color=themed("lamp"))
    face = themed("lamp" if ray else "card")
    axes.plot(x, z, "o", markersize=12, markeredgecolor=themed("lamp"), markerfacecolor=face)
    side, shift = ("left", 10) if x < 0 or not ray else ("right", -10)
    axes.annotate(words, (x, z), (shift, 10), textcoords="offset points", horizontalalignment=side)


@in_style
def draw_evenness(plan: LightPlan) -> str:
    """Return the map of light over its greatest value, with level lines and two profiles (Figure 6b)."""
    x, y = plan.surface.x, plan.surface.y
    share = 100 * plan.illuminance / plan.illuminance.max()
    low = min(90.0, float(np.floor(share.min() / 2) * 2))
    ratio = float((y[-1] - y[0]) / (x[-1] - x[0]))
    figure = new_figure(730, 80 + 330 * ratio)
    left, right = figure.subplots(1, 2)
    left.pcolormesh(
        x, y, share, vmin=low, vmax=100, cmap="magma", shading="gouraud", rasterized=True
    )
    step = 2.0 if 100 - low <= 24 else 10.0
    lines = left.contour(
        x, y, share, np.arange(low + step, 100, step), colors="#1d1b16", linewidths=0.9
    )
    left.clabel(lines, fmt="%g", fontsize=9)
    row, column = share.shape[0] // 2, share.shape[1] // 2
    left.axhline(y[row], color=themed("c1"), linestyle="--")
    left.axvline(x[column], color=themed("c2"), linestyle="--")
    left.grid(visible=False)
    left.set(title="light over its greatest value, %", aspect="equal", xlabel="mm", ylabel="mm")
    right.plot(x, share[row], color=themed("c1"), label="along the width")
    right.plot(y, share[:, column], color=themed("c2"), label="along the height")
    right.set(xlabel="mm from the middle", ylabel="%", ylim=(low, 101))
    draw_legend(right)
    return to_svg(figure, f"map of light, drop {100 * plan.drop:.1f} per cent")


@in_style
def draw_glare(plan: LightPlan) -> str:
    """Return maps of varnish and gold, in per cent of white, on one scale each."""
    maps = [(n, getattr(plan.glare, n)) for n in ("varnish", "gold")]
    maps = [(n, 100 * m) for n, m in maps if m is not None]
    if not maps:
        return ""
    rows, columns = maps[0][1].shape
    figure = new_figure(340 * len(maps), 90 + 300 * rows / columns)
    for axes, (name, values) in zip(
        figure.subplots(1, len(maps), squeeze=False)[0], maps, strict=True
    ):
        shown = axes.imshow(values, cmap="inferno", vmin=0, vmax=max(float(values.max()), 1e-9))
        axes.set(title=f"{name}, % of white", xticks=[], yticks=[])
        figure.colorbar(shown, ax=axes, orientation="horizontal", fraction=0.06, pad=0.04)
    return to_svg(figure, f"glare maps of {plan.lighting.name}")


@in_style
def draw_spectra(wavelengths: np.ndarray, curves: dict[str, np.ndarray], label: str) -> str:
    """Return spectra over their greatest value in sight (Figure 6a)."""
    inside = (wavelengths >= 380) & (wavelengths <= 780)
    figure = new_figure(720, 300)
    axes = figure.subplots()
    for (name, values), ink, dash in zip(curves.items(), INKS, DASHES, strict=False):
        shown = values[inside] / values[inside].max()
        axes.plot(wavelengths[inside], shown, dash, color=themed(ink), label=name)
    axes.set(xlabel="wavelength, nm", ylabel="relative power", xlim=(380, 780), ylim=(0, 1.05))
    draw_legend(axes)
    return to_svg(figure, label)


@in_style
def draw_snr(exposures: list[CameraExposure]) -> str:
    """Return the SNR of every channel on white over its wavelength, a colour a camera."""
    figure = new_figure(720, 300)
    axes = figure.subplots()
    for i, exposure in enumerate(exposures):
        places = [c.wavelength for c in exposure.channels]
        snr = [c.snr for c in exposure.channels]
        many = len(places) > 8
        axes.plot(
            places, snr, "-" if many else "o", color=themed(INKS[i % len(INKS)]),
            label=f"{exposure.camera}; weakest {exposure.limiting}",
        )  # fmt: skip
        for channel in () if many else exposure.channels:
            place = (channel.wavelength, channel.snr)
            axes.annotate(channel.name, place, (6, 4), textcoords="offset points")
    axes.set(xlabel="wavelength, nm", ylabel="signal over noise on white")
    axes.set_ylim(bottom=0)
    draw_legend(axes)
    return to_svg(figure, "signal over noise by wavelength")
