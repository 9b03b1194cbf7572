"""Figures of one registration: its windows and checks, or the paper's removal of outliers (Figures 9, 10)."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import Polynomial
from levkas.pages.page import Figure
from levkas.pages.plots import in_style, new_figure, themed, to_svg
from levkas.registration.outliers import frame_corners
from levkas.registration.window_matching import CheckWindows

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence

    from matplotlib.axes import Axes

    from levkas.registration.record import Matches, Trace

LONG_PX = 12.0
"""Of a panel: shifts are drawn about so long, and never longer than twice that."""
MOST_PAIRS = 400
"""Pairs drawn in a panel; more only blacken it."""
PANEL_PX = 280


def draw_trace(matches: Matches, trace: Trace) -> list[Figure]:
    """Return Figures 9 and 10 of a registration by the paper's method; none without matches."""
    if len(matches) == 0:
        return []
    return [Figure(_draw_course(matches, trace), _COURSE), Figure(_draw_largest(trace), _LARGEST)]


def draw_basis(
    trace: Mapping[str, Any], size: Sequence[int], *, sound: bool = True
) -> list[Figure]:
    """Return a figure a sensor of what a dense map rests on, of `levkas.registration.record.describe_windows`; none of other traces.

    One more shows lines that are displaced against one another. The caption quotes errors only where the map is
    `sound`, not refused.
    """
    figures = []
    for sensor in trace["sensors"] if trace.get("kind") == "windows" else ():
        if "windows" in sensor:
            figures.append(Figure(_basis(sensor, size), _basis_caption(sensor, sound)))
        if sensor.get("lines"):
            figures.append(Figure(_draw_lines(sensor["lines"]), _lines_caption(sensor)))
    return figures


def _lines_caption(sensor: Mapping[str, Any]) -> str:
    whose = f" of sensor {sensor['sensor']}" if sensor["sensor"] else ""
    name = "line" if sensor["lines"]["lines"] == "rows" else "column"
    return (
        f"Displacement of single {name}s{whose} against the map, in reference pixels, as measured. Red: along the {name}. "
        f"Blue: across. One {name} as a whole lies elsewhere than its neighbours: no map follows that."
    )


@in_style
def _draw_lines(lines: Mapping[str, Any]) -> str:
    """Draw the displacement of lines along the scan."""
    figure = new_figure(2 * PANEL_PX, PANEL_PX * 2 / 3)
    axes = figure.subplots()
    place = lines["first"] + np.arange(len(lines["along"]))
    for name, ink in (("along", "ref"), ("across", "tgt")):
        axes.plot(place, np.array(lines[name], float), color=themed(ink), linewidth=0.8)
    known = np.abs(np.array([lines["along"], lines["across"]], float))
    most = 1.1 * float(np.nanpercentile(known, 99.5))
    axes.set(xlabel="line" if lines["lines"] == "rows" else "column", ylabel="displacement, px")
    axes.set_ylim(-most, most)
    return to_svg(figure, "displacement of lines")


def _basis_caption(sensor: Mapping[str, Any], sound: bool) -> str:
    windows, count = sensor["windows"], sensor["count"]
    shown = len(windows["x"])
    some = f" ({shown} of them drawn)" if shown < count else ""
    whose = "all bands together" if sensor["source"] == "fused" else sensor["source"]
    caption = (
        f"Evidence for the map{' of sensor ' + sensor['sensor'] if sensor['sensor'] else ''}, in reference pixels. "
        f"Left: the {count} windows{some} of {whose} to which the map was fitted; faint ones have a low weight. Each line "
        f"is the residual of a window, drawn {_enlargement(sensor):g} times as long; the longest are cut."
    )
    sigma, held = (_median(windows[name]) for name in ("sigma", "held_out"))
    if sound and sigma is not None and held is not None:
        caption += (
            f" The median uncertainty of their shifts is {sigma:.2g} px (one sigma); the median held-out error is "
            f"{held:.2g} px."
        )
    if sensor["checks"] is None:
        return caption
    return (
        f"{caption} Right: check windows of {sensor['band']}, searched up to 12 px around. Blue: they agree with the "
        "map. Red: they fit elsewhere, better than noise explains. Hollow: they say neither. Parts without blue windows are not confirmed."
    )


def _median(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return float(np.median(known)) if known else None


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


@in_style
def _basis(sensor: Mapping[str, Any], size: Sequence[int]) -> str:
    """Draw the windows of the fit with their shifts, and those that check it."""
    panels = 1 if sensor["checks"] is None else 2
    figure = _panel_figure(panels, 1, size)
    axes = figure.subplots(1, panels, squeeze=False)[0]
    windows, enlarged = sensor["windows"], _enlargement(sensor)
    points = np.stack([windows["x"], windows["y"]], 1)
    shift = np.stack([windows["shift_x"], windows["shift_y"]], 1) * enlarged
    longest = 2 * LONG_PX * max(size) / PANEL_PX
    shift *= np.minimum(1.0, longest / np.maximum(np.hypot(*shift.T), 1e-9))[:, None]
    weight = np.array(windows["weight"])
    for low, high, opacity in ((0.0, 0.5, 0.25), (0.5, 2.0, 1.0)):
        here = (weight >= low) & (weight < high)
        _draw_errors(axes[0], points[here], points[here] + shift[here], opacity)
        _draw_dots(axes[0], points[here], "ref", opacity)
    frame = frame_corners((int(size[0]), int(size[1])))
    _frame_panel(axes[0], frame, f"{sensor['count']} windows")
    length = _rounded_down(0.2 * size[0] / enlarged)
    axes[0].plot([0, length * enlarged], [1.06 * size[1]] * 2, color=themed("soft"))
    axes[0].annotate(
        f"{length:g} px", (length * enlarged, 1.06 * size[1]), (4, -4), textcoords="offset points"
    )
    if sensor["checks"] is not None:
        _draw_checks(axes[1], CheckWindows.from_dict(sensor["checks"]), size)
    return to_svg(figure, "evidence for the map")


def _draw_checks(axes: Axes, checks: CheckWindows, size: Sequence[int]) -> None:
    good, wrong = checks.confirmed, checks.contradicting
    for mask, face, edge in (
        (good, "tgt", "tgt"), (wrong, "ref", "ref"), (~(good | wrong), None, "soft"),
    ):  # fmt: skip
        axes.scatter(
            checks.centres[mask, 0], checks.centres[mask, 1], s=14, linewidths=0.8, edgecolors=themed(edge),
            facecolors="none" if face is None else themed(face),
        )  # fmt: skip
    title = f"{int(good.sum())} of {len(good)} check windows agree with the map"
    _frame_panel(axes, frame_corners((int(size[0]), int(size[1]))), title)


_COURSE = (
    "The course of the registration in reference pixels (the paper's Figure 9). Black: the frame of the reference. "
    "Red: the frame of the target under scale alone. Magenta: the same under the fit. Dots are pairs: red in "
    "the reference, blue mapped from the target. Grey lines are their errors."
)
_LARGEST = (
    "The largest error at each round of the removal of the worst pair (the paper's Figure 10). The first "
    "point is the cut under scale alone at `reject`; the dashed line is `stop`."
)


@in_style
def _draw_course(matches: Matches, trace: Trace) -> str:
    states = [(-1, "start: scale alone")]
    for number in sorted({0, trace.rounds // 2, trace.rounds - 1}):
        states.append((number, f"round {number + 1} of {trace.rounds}"))
    rows = -(-len(states) // 2)
    figure = _panel_figure(2, rows, np.ptp(_both_frames(trace), axis=0))
    panels = figure.subplots(rows, 2, squeeze=False).ravel()
    for axes in panels[len(states) :]:
        axes.set_axis_off()
    for axes, (number, title) in zip(panels, states, strict=False):
        _draw_state(axes, matches, trace, number, title)
    return to_svg(figure, "course of the registration")


def _draw_state(axes: Axes, matches: Matches, trace: Trace, number: int, title: str) -> None:
    """Draw the frames, and the pairs under the map of a round; -1 is scale alone."""
    kept = np.ones(len(matches), bool) if number < 0 else trace.kept_at(number)
    chosen = np.flatnonzero(kept)[:: max(1, int(kept.sum()) // MOST_PAIRS)]
    frame, shown = frame_corners(trace.size), trace.frame
    if number < 0:
        mapped = trace.scale(matches.target[chosen])
    else:
        model = Polynomial.fit(matches.target[kept], matches.reference[kept], order=trace.order)
        mapped, shown = model(matches.target[chosen]), trace.corners[number]
        _outline(axes, shown, "fit")
    _outline(axes, trace.frame, "ref")
    _draw_errors(axes, matches.reference[chosen], mapped)
    _draw_dots(axes, matches.reference[chosen], "ref")
    _draw_dots(axes, mapped, "tgt")
    _frame_panel(axes, frame, f"{title}: {int(kept.sum())} pairs")
    _clip_panel(axes, frame, shown)


def _clip_panel(axes: Axes, frame: np.ndarray, other: np.ndarray) -> None:
    """End the panel at both frames, of a wild one at half a frame beyond the reference; it cuts what lies outside."""
    low, high = frame.min(0), frame.max(0)
    reach = (high - low) / 2
    both = np.clip(np.vstack([frame, np.nan_to_num(other)]), low - reach, high + reach)
    margin = 0.02 * (high - low).max()
    (left, top), (right, bottom) = both.min(0) - margin, both.max(0) + margin
    axes.set(xlim=(left, right), ylim=(bottom, top))


def _both_frames(trace: Trace) -> np.ndarray:
    return np.vstack([frame_corners(trace.size), trace.frame])


@in_style
def _draw_largest(trace: Trace) -> str:
    """Draw the largest error by round, with the cut under scale alone and `stop`."""
    cut = trace.scale_errors[np.isfinite(trace.scale_errors)]
    errors = np.concatenate([[cut.max() if len(cut) else trace.reject], trace.largest])
    errors = np.maximum(errors, 1e-3)
    shown = np.unique(np.linspace(0, len(errors) - 1, min(len(errors), 500)).astype(int))
    figure = new_figure(2 * PANEL_PX, PANEL_PX)
    axes = figure.subplots()
    axes.semilogy(shown, errors[shown], color=themed("ref"))
    axes.axhline(trace.stop, color=themed("tgt"), linestyle="--")
    axes.annotate(f"stop {trace.stop:g} px", (1, trace.stop), (-4, 4), ha="right",
                  xycoords=("axes fraction", "data"), textcoords="offset points")  # fmt: skip
    axes.yaxis.set_major_formatter("{x:g}")
    axes.yaxis.set_minor_formatter("")
    axes.set(xlabel=f"round (of {trace.rounds})", ylabel="largest error, px")
    return to_svg(figure, "largest error by round")


def _panel_figure(columns: int, rows: int, size: Sequence[float] | np.ndarray) -> Any:
    height = PANEL_PX * min(2.0, float(size[1]) / max(float(size[0]), 1.0)) + 40
    return new_figure(columns * PANEL_PX, rows * height)


def _frame_panel(axes: Axes, corners: np.ndarray, title: str) -> None:
    """Outline the reference frame; y goes down, as in pictures."""
    _outline(axes, corners, "currentColor")
    axes.set_title(title, fontsize=10, loc="left")
    axes.set(aspect="equal")
    axes.invert_yaxis()
    axes.set_axis_off()


def _outline(axes: Axes, corners: np.ndarray, ink: str) -> None:
    axes.plot(*np.vstack([corners, corners[:1]]).T, color=themed(ink), linewidth=1.2)


def _draw_dots(axes: Axes, points: np.ndarray, ink: str, opacity: float = 0.7) -> None:
    axes.plot(*points.T, ".", markersize=2.5, color=themed(ink), alpha=opacity)


def _draw_errors(axes: Axes, start: np.ndarray, end: np.ndarray, opacity: float = 1.0) -> None:
    from matplotlib.collections import LineCollection

    lines = np.stack([start, end], 1)
    lines = lines[np.isfinite(lines).all((1, 2))]
    axes.add_collection(LineCollection(lines, colors="#999999", linewidths=0.6, alpha=opacity))
