"""The uncertainty budget of a layer as a table and a stacked plot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from levkas.calibration.error_sources import COVERAGE, ErrorSource, MeanSpectrum, uncertain_mean
from levkas.pages.page import Figure
from levkas.pages.plots import draw_legend, in_style, new_figure, to_svg

if TYPE_CHECKING:
    from levkas.core.cube import Band

UNITS = {"relative": "%", "reflectance": "", "counts": " counts", "nm": " nm", "px": " px"}
EXTENTS = {
    "pixel": "each pixel",
    "line": "a line",
    "frame": "this capture",
    "camera": "the camera",
    "campaign": "all cameras",
}
SHOWN = 8
"""Sources that a plot distinguishes; the others are summed."""
LEAST_BANDS = 6
"""Of fewer bands the table says as much as a plot."""


class BudgetRow(NamedTuple):
    """One source as a reader sees it: size at the middle band, what it gives to a value there, and what it is common to."""

    source: str
    size: str
    share: str
    common_to: str
    basis: str
    advice: str = ""


class UncertaintyBudget(NamedTuple):
    """What the page says of the uncertainty of a layer's values."""

    rows: tuple[BudgetRow, ...]
    unknown: tuple[BudgetRow, ...]
    figure: Figure | None
    short: str


def describe_budget(
    sources: Sequence[ErrorSource],
    bands: Sequence[Band],
    levels: Mapping[str, float],
    noise: Mapping[str, float],
) -> UncertaintyBudget | None:
    """Return table, plot and a sentence; None where nothing is known of a layer's values.

    Parameters
    ----------
    sources : sequence of ErrorSource
    bands : sequence of Band
    levels : mapping of str to float
        Value of the middling pixel of each band.
    noise : mapping of str to float
        Its published sigma.
    """
    labels = [band.label for band in bands if band.label in levels]
    if not sources or not labels:
        return None
    wavelengths = np.array([band.wavelength for band in bands if band.label in levels])
    mean = MeanSpectrum(
        labels,
        np.array([levels[label] for label in labels]),
        np.array([noise.get(label, 0.0) for label in labels]),
        wavelengths,
    )
    made = uncertain_mean(mean, sources, layer="this")
    shared = made.by_source()
    known = [row for row in sources if row.size]
    rows = [_row(row, mean, shared) for row in known]
    unknown = [
        BudgetRow(row.name, "not known", "–", EXTENTS[row.common_to], "", row.advice)
        for row in sources
        if row.basis == "unknown"
    ]
    short = _in_short(labels, mean, shared, [row.source for row in unknown])
    if any(row.unit == "counts" for row in sources):
        short = f"No white: values are relative counts. {short}"
    return UncertaintyBudget(
        tuple(rows), tuple(unknown), _figure(_with_parts(shared, known, mean), mean), short
    )


def _in_short(
    labels: Sequence[str],
    mean: MeanSpectrum,
    shared: Mapping[str, np.ndarray],
    unknown: Sequence[str],
) -> str:
    """Report the expanded uncertainty of one pixel and of many, in the middle band."""
    middle = len(labels) // 2
    common = float(np.sqrt(sum(v[middle] ** 2 for n, v in shared.items() if n != "noise")))
    one = COVERAGE * float(np.hypot(common, mean.random[middle]))
    many = (
        f"{describe_number(COVERAGE * common)} for the mean of many"
        if common
        else "that of a mean of many is not known"
    )
    short = f"In {labels[middle]}, of a value of {describe_number(mean.values[middle])}: U = {describe_number(one)} for one pixel, {many} (k = {COVERAGE:g})"
    return short + (f". Not contained, as not known: {', '.join(unknown)}." if unknown else ".")


def _with_parts(
    shared: Mapping[str, np.ndarray], known: Sequence[ErrorSource], mean: MeanSpectrum
) -> dict[str, np.ndarray]:
    """Return sources with noise in its parts, where these are known; what they leave of it is interpolation."""
    if not any(row.common_to == "pixel" for row in known):
        return dict(shared)
    parts = {
        row.name: np.array([row.size.get(label, 0.0) for label in mean.labels])
        for row in known
        if row.common_to == "pixel"
    }
    rest = mean.random**2 - sum((v**2 for v in parts.values()), np.zeros(len(mean.values)))
    parts["interpolation"] = np.sqrt(np.maximum(rest, 0))
    parts = {name: row for name, row in parts.items() if row.max() > 0.05 * mean.random.max()}
    return {n: v for n, v in shared.items() if n != "noise"} | parts


def describe_number(number: float) -> str:
    """Return a number with two digits, of counts all before the point.

    >>> describe_number(0.01234), describe_number(1234.5)
    ('0.012', '1234')
    """
    return f"{number:.0f}" if abs(number) >= 100 else f"{number:.2g}"


def _row(row: ErrorSource, mean: MeanSpectrum, shared: Mapping[str, np.ndarray]) -> BudgetRow:
    sizes = list(row.size.values())
    scale = 100.0 if row.unit == "relative" else 1.0
    least, most = (describe_number(scale * value) for value in (min(sizes), max(sizes)))
    size = (least if least == most else f"{least} to {most}") + UNITS[row.unit]
    share = "in sigma"
    if row.common_to != "pixel":
        found = shared.get(row.name)
        share = "–" if found is None else describe_number(found[len(found) // 2])
    common = EXTENTS[row.common_to] + (", all bands" if row.all_bands else ", each band")
    return BudgetRow(row.name, size, share, common, row.basis, row.advice)


def _figure(shared: Mapping[str, np.ndarray], mean: MeanSpectrum) -> Figure | None:
    """Draw by how much of its square each source widens a value's uncertainty, band by band."""
    if len(mean.values) < LEAST_BANDS or not shared:
        return None
    return Figure(
        _draw(shared, mean),
        "Standard uncertainty of a middling pixel, band by band: the heights are each source's share of the variance times the whole.",
    )


@in_style
def _draw(shared: Mapping[str, np.ndarray], mean: MeanSpectrum) -> str:
    squares = {name: np.square(row) for name, row in shared.items()}
    names = list(squares)[:SHOWN]
    rest: Any = sum((squares[name] for name in list(squares)[SHOWN:]), np.zeros(len(mean.values)))
    total = np.sqrt(sum(squares.values()))
    heights = [squares[name] / np.maximum(total, 1e-12) for name in names]
    if np.any(rest > 0):
        names, heights = [*names, "others"], [*heights, rest / np.maximum(total, 1e-12)]
    known = bool(np.isfinite(mean.wavelengths).all())
    at = mean.wavelengths if known else np.arange(len(mean.values), dtype=float)
    order = np.argsort(at, kind="stable")
    figure = new_figure()
    axes = figure.subplots()
    axes.stackplot(at[order], [h[order] for h in heights], labels=names)
    axes.set(
        xlabel="wavelength, nm" if known else "",
        ylabel="standard uncertainty",
        xlim=(at.min(), at.max()),
    )
    if not known:
        axes.set_xticks(at, list(mean.labels))
    axes.set_ylim(bottom=0)
    draw_legend(axes)
    return to_svg(figure, "Standard uncertainty by source over the bands")
