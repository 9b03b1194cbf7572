"""Tiles of a layer on the report's page: where they lie, how they overlap, what they differ by at the seams."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from levkas.core.text import counted
from levkas.geometry import from_dict
from levkas.geometry.joining import MOST_STEP, mean_step
from levkas.pages.page import Figure
from levkas.pages.plots import in_style, new_figure, themed, to_svg

PANEL_PX = 330
SIDE_POINTS = 8
"""Places along each side of a tile by which its outline is drawn."""
LEAST_WITHIN = 0.95
"""Share of the pixels of a seam whose difference should be within two sigma: of noise alone 0.954."""


def draw_tiles(record: Mapping[str, Any], seams: Sequence[Mapping[str, Any]]) -> list[Figure]:
    """Return the map of a layer's tiles; nothing of a layer without.

    Parameters
    ----------
    record : mapping
        Of the layer's registration.
    seams : sequence of mapping
        As `levkas.geometry.joining.Seams.records` gives them.
    """
    placed = {n: one for n, one in record.get("tiles", {}).items() if one.get("bands")}
    if not placed:
        return []
    outlines = {name: _outline(one) for name, one in placed.items()}
    caption = " ".join(_describe(record, seams))
    return [Figure(_draw(outlines, record, seams), caption)]


def _outline(one: Mapping[str, Any]) -> np.ndarray:
    """Return the outline of a tile, (n, 2) reference px, closed."""
    band = next(iter(one["bands"].values()))
    along, nil = np.linspace(0, 1, SIDE_POINTS), np.zeros(SIDE_POINTS)
    sides = [(along, nil), (nil + 1, along), (along[::-1], nil + 1), (nil, along[::-1])]
    corners = np.concatenate([np.stack(side, 1) for side in sides]) * one["size"] - 0.5
    return np.asarray(from_dict(band["transform"]).inverse(corners))


def _describe(record: Mapping[str, Any], seams: Sequence[Mapping[str, Any]]) -> Iterator[str]:
    placed = [one for one in record["tiles"].values() if one.get("bands")]
    yield (
        f"Left: {counted(len(placed), 'tile')} of {len(record['tiles'])} in reference pixels; a number is how well a tile lies on what "
        f"is beside or beneath it, in hundredths of a pixel (one sigma). Lines are the overlaps that place them."
    )
    known = [one for one in seams if one["within"] is not None]
    if not known:
        return
    share = np.average([one["within"] for one in known], weights=[one["pixels"] for one in known])
    worst = max(known, key=lambda one: abs(mean_step(one)))
    yield (
        f"Right: {counted(len(known), 'seam')}; tiles differ there by less than two sigma at {100 * share:.1f} % of the pixels. The largest "
        f"step is that of {' and '.join(worst['tiles'])}: {100 * abs(mean_step(worst)):.1f} % of the value in the mean over the bands."
    )


@in_style
def _draw(
    outlines: Mapping[str, np.ndarray],
    record: Mapping[str, Any],
    seams: Sequence[Mapping[str, Any]],
) -> str:
    everything = np.concatenate([*outlines.values()])
    low, high = np.nanmin(everything, 0), np.nanmax(everything, 0)
    width, height = high - low
    panels = 2 if seams else 1
    tall = float(np.clip(PANEL_PX * height / width, 0.4 * PANEL_PX, 1.6 * PANEL_PX)) + 40
    figure = new_figure(panels * PANEL_PX, tall)
    axes = figure.subplots(1, panels, squeeze=False)[0]
    middles = {name: np.nanmean(outline, 0) for name, outline in outlines.items()}
    used = [one for one in (record.get("placement") or {}).get("overlaps", ()) if one["used"]]
    for number, panel in enumerate(axes):
        for name, outline in outlines.items():
            panel.plot(*outline.T, color=themed("soft"), linewidth=0.7)
            if number == 0:
                sigma = 100 * record["tiles"][name]["sigma_px"]
                panel.text(*middles[name], f"{name}\n{sigma:.1f}", ha="center", va="center")
        margin = 0.02 * max(width, height)
        panel.set(
            xlim=(low[0] - margin, high[0] + margin), ylim=(high[1] + margin, low[1] - margin)
        )
        panel.set_aspect("equal")
    for one in used:
        _connect(axes[0], one, middles, "soft", 0.5)
    for one in seams:
        good = one["within"] is None or one["within"] >= LEAST_WITHIN
        sound = good and abs(mean_step(one)) <= MOST_STEP
        _connect(axes[-1], one, middles, "ref" if not sound else "tgt", 1.6)
    return to_svg(figure, "tiles of the layer")


def _connect(
    panel: Any, pair: Mapping[str, Any], middles: Mapping[str, np.ndarray], ink: str, width: float
) -> None:
    if all(name in middles for name in pair["tiles"]):
        ends = np.array([middles[name] for name in pair["tiles"]])
        near = ends[0] + np.outer([0.25, 0.75], ends[1] - ends[0])
        panel.plot(*near.T, color=themed(ink), linewidth=width)
