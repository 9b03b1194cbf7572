"""The page of a comparison: table, errors and SSIM by layer (Figure 14a of the paper), SSIM maps (14b–e)."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.pages.page import render_page
from levkas.pages.plots import Line, plot
from levkas.quality.comparison.methods import COMPARED

if TYPE_CHECKING:
    from levkas.quality.comparison.table import Comparison

INKS = {
    "levkas": "#b3261e", "mirhashemi2019": "var(--ink)", "surf-projective": "#3b6fd4",
    "gdbicp-quadratic": "#3a9a4b", "gdbicp-radial": "#c77f1a", "opencv-sift-magsac": "#7a4fbf",
    "opencv-ecc": "#5b8c99", "elastix": "#a0527a", "simpleitk": "#6f7d2c", "ants": "#8a5a3c",
}  # fmt: skip
OTHER_INK = "#777777"


def write_page(comparison: Comparison, folder: Path, *, overwrite: bool = False) -> Path:
    """Write comparison.html and comparison.json into a folder; return the page.

    Raises
    ------
    WriteRefused
        Where a file that Levkas did not write has the name.
    """
    from levkas.core.files import write_json, write_text
    from levkas.core.ownership import OwnFiles

    folder = folder.resolve()
    path = folder / "comparison.html"
    with OwnFiles(folder, overwrite=overwrite).writing():
        write_json(folder / "comparison.json", comparison.to_dict())
        write_text(path, render_comparison(comparison))
    return path


def render_comparison(comparison: Comparison) -> str:
    """Return the page as HTML; the maps are pictures beside it."""
    return render_page(
        "comparison.html",
        page={
            "title": "Methods of registration compared",
            "summary": [_summary_cells(one) for one in comparison.summary()],
            "failures": comparison.problems,
            "methods": [(COMPARED[m].title, INKS.get(m, OTHER_INK)) for m in comparison.methods],
            "layers": [_layer(comparison, name) for name in comparison.layers],
            "errors": _chart(comparison, "error_mean", "mean error, px", log="y"),
            "chart": _chart(comparison, "ssim", "SSIM"),
        },
    )


def _summary_cells(one: dict[str, Any]) -> list[str]:
    return [
        f"{one['title']} {one['version']}".strip(),
        f"{one['failures']} of {one['layers']}",
        number(one["error_mean"], 3),
        number(one["error_worst_band"], 3),
        number(one["error_max"], 2),
        number(one["ssim"], 3),
        number(one["seconds"], 1),
        number(one["cpu_seconds"], 1),
        number(one["peak_mib"], 0),
    ]


def _layer(comparison: Comparison, layer: str) -> dict[str, Any]:
    cells = []
    for method in comparison.methods:
        row = comparison.row(layer, method)
        if row is None:
            continue
        record = row.to_dict()
        cells.append(
            {
                "title": COMPARED[method].title,
                "map": row.map,
                "mean": number(record["error_mean"], 3),
                "max": number(record["error_max"], 2),
                "ssim": number(record.get("ssim"), 3),
                "seconds": number(record.get("seconds"), 1),
                "note": record.get("failure") or record.get("note", ""),
                "failed": bool(record.get("failure")),
            }
        )
    return {"name": layer, "cells": cells}


def _chart(comparison: Comparison, fact: str, y: str, *, log: str = "") -> str:
    lines = []
    for place, method in enumerate(comparison.methods):
        scores = [
            (i, row.to_dict().get(fact))
            for i, layer in enumerate(comparison.layers, start=1)
            if (row := comparison.row(layer, method))
        ]
        known = [(i, s) for i, s in scores if s is not None]
        if known:
            across, up = zip(*known, strict=True)
            ink = INKS.get(method, OTHER_INK)
            # Layers have no order: points beside one another, and no line between them.
            apart = 0.5 * (place / max(len(comparison.methods) - 1, 1) - 0.5)
            lines.append(
                Line(COMPARED[method].title, [i + apart for i in across], up, ink, joined=False)
            )
    if not lines:
        return ""
    return plot(lines, x="", y=y, log=log, legend=False, names=comparison.layers)


def number(value: float | None, digits: int) -> str:
    """Return a number for a cell; a dash where there is none.

    >>> number(0.1234, 2), number(None, 2)
    ('0.12', '–')
    """
    return "–" if value is None or value - value != 0 else f"{value:.{digits}f}"
