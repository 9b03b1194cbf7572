"""Plots of all pages, drawn by matplotlib as SVG in one style that follows the page's colours.

Colours of a page's theme, such as ``var(--ref)``, stand in the SVG as they are, so that a plot is
light or dark with its page. The same data give the same bytes.
"""

from __future__ import annotations

import colorsys
import hashlib
import io
import re
import threading
from dataclasses import dataclass
from functools import wraps
from html import escape
from typing import TYPE_CHECKING, Any, ParamSpec

import numpy as np

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

P = ParamSpec("P")
WIDTH, HEIGHT = 560, 300
"""Of a plot, in units of its view box."""
THEME = (
    *("currentColor", "ink", "soft", "line", "card", "ok", "warn", "bad", "ref", "tgt", "fit"),
    *("lamp", "bright", "wall", "c1", "c2", "c3", "c4", "c5", "c6"),
)
"""Colours of pages: custom properties of CSS, and the colour of the text around."""
MOST_MARKS = 60
"""Points of a line that are marked; more would be a band."""
MOST_NAMES = 8
FEW_NAMES, MOST_LETTERS = 4, 56
"""Of a legend above the axes instead of beside them."""
HUES = (
    *((400, 275), (450, 240), (490, 190), (520, 130), (560, 85), (580, 58)),
    *((600, 35), (620, 15), (640, 0), (1000, 0)),
)
"""Wavelength, nm, and the hue as which the eye sees it, degrees."""
COLOURS = {"R": "#d4453b", "G": "#3a9a4b", "B": "#3b6fd4", "IR": "#8a5a3c"}
STYLE: dict[Any, Any] = {
    "svg.hashsalt": "levkas",
    "svg.fonttype": "none",
    "font.size": 11,
    "axes.linewidth": 0.6,
    "axes.grid": True,
    "grid.linewidth": 0.5,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "legend.fontsize": 10,
}
_PLACES = {name: f"#0101{i:02x}" for i, name in enumerate(THEME)}
"""Colours that stand for a theme's while matplotlib draws."""


def themed(name: str) -> str:
    """Return what matplotlib is given for ``var(--name)`` of the page, or for ``currentColor``."""
    return _PLACES[name]


_alone = threading.RLock()
"""Settings of matplotlib are those of the whole process."""


def in_style(draw: Callable[P, str]) -> Callable[P, str]:
    """Let a function draw in the style of all pages."""

    @wraps(draw)
    def styled(*args: P.args, **options: P.kwargs) -> str:
        import matplotlib

        soft = ("text.color", "axes.labelcolor", "axes.edgecolor", "xtick.color", "ytick.color")
        theme: Any = {**dict.fromkeys(soft, themed("soft")), "grid.color": themed("line")}
        with _alone, matplotlib.rc_context(theme | STYLE):
            return draw(*args, **options)

    return styled


def new_figure(width: float = WIDTH, height: float = HEIGHT, **layout: Any) -> Figure:
    """Return an empty figure of a size in units of the view box."""
    from matplotlib.figure import Figure

    return Figure((width / 72, height / 72), dpi=72, **{"layout": "constrained", **layout})


def to_svg(figure: Figure, label: str) -> str:
    """Return a figure as an SVG element; `label` is for screen readers."""
    from matplotlib.backends.backend_svg import FigureCanvasSVG

    FigureCanvasSVG(figure)  # by which text is measured
    if (layout := figure.get_layout_engine()) is not None:
        # `savefig` would draw the whole figure twice to have it laid out once.
        layout.execute(figure)
        figure.set_layout_engine(None)
    target = io.StringIO()
    nothing = dict.fromkeys(("Date", "Creator", "Format", "Type"))
    figure.savefig(target, format="svg", transparent=True, metadata=nothing)
    text = target.getvalue()
    text = re.sub(
        r"<metadata>.*?</metadata>|<!--.*?-->", "", text[text.index("<svg") :], flags=re.S
    )
    box = re.search(r'viewBox="[^"]*"', text)
    assert box is not None
    body = text[text.index(">") + 1 :]
    body = re.sub(r' id="[a-z0-9.]+_[a-z0-9_]+"', "", body)
    body = re.sub(r"font: ([\d.]+px)[^;\"]*", r"font-size: \1", body)
    for name, place in _PLACES.items():
        body = body.replace(place, name if name == "currentColor" else f"var(--{name})")
    body = _number_ids(re.sub(r"\s*\n\s*", "\n", body).strip())
    return (
        f'<svg {box[0]} role="img" aria-label="{escape(label)}">'
        f"{body.replace('xlink:href', 'href')}"
    )


def _number_ids(body: str) -> str:
    """Name clip paths and markers by order and content; matplotlib names some by memory addresses."""
    names = dict.fromkeys(re.findall(r' id="([^"]+)"', body))
    for number, name in enumerate(names):
        body = re.sub(rf'(?<=["#]){re.escape(name)}(?=[")])', f"@{number}", body)
    digest = hashlib.sha256(body.encode()).hexdigest()[:8]
    return re.sub(r'(?<=["#])@(\d+)(?=[")])', rf"p{digest}-\1", body)


@dataclass(frozen=True)
class Line:
    """One line of a plot; points that are not finite are left out.

    Parameters
    ----------
    label : str
    x, y : sequence of float
    colour : str
        ``#rrggbb``, or a name of `THEME`.
    dashed : bool
    """

    label: str
    x: Sequence[float | None] | np.ndarray
    y: Sequence[float | None] | np.ndarray
    colour: str = "ref"
    dashed: bool = False


@in_style
def plot(
    lines: Sequence[Line],
    *,
    x: str,
    y: str,
    log_x: bool = False,
    top_axis: tuple[str, Sequence[tuple[float, str]]] | None = None,
    from_zero: bool = False,
) -> str:
    """Return lines as SVG, "" where there is nothing to draw.

    Parameters
    ----------
    lines : sequence of Line
    x, y : str
        Titles of the axes.
    log_x : bool
        Whether x is logarithmic; points at or below 0 are left out then.
    top_axis : (title, [(x, label), …]), optional
        A second axis above.
    from_zero : bool
        y starts at 0.
    """
    drawn = [(line, *_sound(line, log_x)) for line in lines]
    if not any(len(xs) for _, xs, _ in drawn):
        return ""
    figure = new_figure()
    axes = figure.subplots()
    for line, xs, ys in drawn:
        axes.plot(
            xs, ys, label=line.label, color=_PLACES.get(line.colour, line.colour),
            linestyle="--" if line.dashed else "-", marker="o" if len(xs) <= MOST_MARKS else "", markersize=3,
        )  # fmt: skip
    axes.set(xlabel=x, ylabel=y, xscale="log" if log_x else "linear")
    if log_x:
        axes.xaxis.set_major_formatter("{x:g}")
        axes.xaxis.set_minor_formatter("")
    if from_zero:
        axes.set_ylim(bottom=0)
    if top_axis is not None:
        title, marks = top_axis
        above = axes.secondary_xaxis("top")
        above.set_xticks([at for at, _ in marks], [text for _, text in marks], minor=False)
        above.set_xticks([], minor=True)
        above.set_xlabel(title)
    if len(lines) > 1:
        draw_legend(axes)
    return to_svg(figure, f"{y} over {x}" if x else y)


def draw_legend(axes: Axes) -> None:
    """Name at most eight lines beside the axes, where no line runs: the first, the last, and some between."""
    handles, names = axes.get_legend_handles_labels()
    count = len(names)
    chosen = sorted({round(i * (count - 1) / (MOST_NAMES - 1)) for i in range(MOST_NAMES)})
    chosen = chosen if count > MOST_NAMES else list(range(count))
    short = len(chosen) <= FEW_NAMES and sum(len(names[i]) for i in chosen) <= MOST_LETTERS
    place: dict[str, Any] = (
        {"loc": "outside upper center", "ncols": len(chosen)}
        if short
        else {"loc": "outside right center"}
    )
    figure = axes.get_figure(root=True)
    assert figure is not None
    figure.legend([handles[i] for i in chosen], [names[i] for i in chosen], **place)


def _sound(line: Line, log_x: bool) -> tuple[np.ndarray, np.ndarray]:
    x, y = (np.array(values, float) for values in (line.x, line.y))  # None is NaN
    good = np.isfinite(x) & np.isfinite(y) & ((x > 0) | (not log_x))
    return x[good], y[good]


def colour_of(label: str, index: int, count: int, wavelength: float = float("nan")) -> str:
    """Return a colour for a channel: its own where it is a letter, that of its light, else along a rainbow.

    >>> colour_of("640 nm", 0, 1, 640.0), colour_of("530 nm", 0, 1, 530.0)
    ('#d22d2d', '#30d22d')
    """
    letters = label.rstrip("0123456789")
    if letters in COLOURS:
        return COLOURS[letters]
    if np.isfinite(wavelength):
        hue = float(np.interp(wavelength, *np.array(HUES, float).T))
        # What the eye sees no more grows dark, so that bands beyond 700 nm are distinguished.
        lightness = float(np.interp(wavelength, (700, 1000), (0.5, 0.25)))
        return hls_colour(hue / 360, lightness, 0.65)
    share = index / max(count - 1, 1)
    return hls_colour(275 * (1 - share) / 360, 0.5, 0.65)


def hls_colour(hue: float, lightness: float, saturation: float) -> str:
    """Return a colour, all three from 0 to 1, as ``#rrggbb``.

    >>> hls_colour(0.0, 0.5, 1.0)
    '#ff0000'
    """
    return "#" + "".join(
        f"{round(255 * v):02x}" for v in colorsys.hls_to_rgb(hue, lightness, saturation)
    )


@in_style
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
    from matplotlib.patches import Rectangle

    rows, columns = levels.shape
    width, height = size
    figure = new_figure(420, max(40.0, min(420.0, 420.0 * height / width)), layout=None)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.imshow(
        levels, cmap="cividis", vmin=0, vmax=1, extent=(0, width, height, 0), aspect="auto",
        interpolation="nearest",
    )  # fmt: skip
    if min(rows, columns) > 2:
        x = (np.arange(columns) + 0.5) * width / columns
        y = (np.arange(rows) + 0.5) * height / rows
        lines = axes.contour(x, y, levels, contours, colors="#1d1b16", linewidths=0.9)
        axes.clabel(lines, fmt=lambda level: f"{100 * level:g} %", fontsize=9)
    axes.axhline(height / 2, color="#c62828", linewidth=1, linestyle="--")
    axes.axvline(width / 2, color="#c62828", linewidth=1, linestyle="--")
    left, top, across, down = rectangle
    axes.add_patch(
        Rectangle((left, top), across, down, fill=False, edgecolor="#1f9d4c", linewidth=2.5)
    )
    return to_svg(figure, "light on the white")


@in_style
def picture_with_areas(picture: np.ndarray, areas: np.ndarray, names: Sequence[str]) -> str:
    """Return a picture, (height, width) 0 … 1, with areas, (n, 4, 2) px, drawn over it."""
    from matplotlib.collections import PolyCollection

    height, width = picture.shape
    figure = new_figure(WIDTH, WIDTH * height / width, layout=None)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.set_axis_off()
    axes.imshow(picture, cmap="gray", vmin=0, vmax=1, aspect="auto")
    axes.add_collection(
        PolyCollection(list(areas), facecolors="none", edgecolors="#00e5ff", linewidths=1)
    )
    for area, name in zip(areas, names, strict=True):
        x, y = area.min(0)
        axes.text(
            x, y, name, color="#ffffff", fontsize=8, verticalalignment="bottom",
            bbox={"facecolor": "#000000", "alpha": 0.6, "linewidth": 0, "pad": 1},
        )  # fmt: skip
    return to_svg(figure, "sampled areas")
