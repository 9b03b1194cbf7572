"""Planned exposure series as one HTML page: times, what each serves, and the signal-to-noise ratio over light."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from levkas.core.files import write_text
from levkas.pages.page import render_page
from levkas.pages.plots import draw_legend, in_style, new_figure, themed, to_svg

if TYPE_CHECKING:
    from levkas.planning.exposure_series import ExposureSeries


def write_series(
    path: str | Path, plans: Sequence[ExposureSeries], refused: Sequence[str] = ()
) -> Path:
    """Write the page of planned series, one section a band, and why some have none."""
    parts = [(plan, draw_series(plan)) for plan in plans]
    write_text(
        path,
        render_page(
            "series.html", page={"title": "Exposure series", "parts": parts, "refused": refused}
        ),
    )
    return Path(path)


@in_style
def draw_series(plan: ExposureSeries) -> str:
    """Return the SNR of one sensel over its light, of the shortest exposure and of the merge, above the histogram."""
    rates, single, merged = plan.curve
    figure = new_figure(720, 380)
    axes, below = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    several = len(plan.exposures) > 1
    if several:
        axes.plot(rates, merged, color=themed("c1"), label="merged")
    axes.plot(
        rates, single, "--" if several else "-", color=themed("c2"), label="the shortest alone"
    )
    axes.axhline(plan.wish.snr, color=themed("soft"), linestyle=":", label="wanted")
    axes.axvline(plan.darkest, color=themed("ink"), linewidth=1)
    axes.annotate("darkest paint", (plan.darkest, 0.02), (4, 2), xycoords=axes.get_xaxis_transform(),
                  textcoords="offset points")  # fmt: skip
    axes.set(xscale="log", yscale="log", ylabel="signal over noise")
    draw_legend(axes)
    width = np.diff(np.append(rates, rates[-1] ** 2 / rates[-2]))
    below.bar(rates, 100 * plan.histogram, width, color=themed("soft"))
    below.set(xlabel="light, counts a second above the dark", ylabel="% of sensels")
    return to_svg(figure, f"signal over noise of {plan.name} over light")
