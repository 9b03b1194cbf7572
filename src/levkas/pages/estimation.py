"""The page of an estimation of spectra: a table and curves, with JSON and models beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.core.text import counted
from levkas.estimation.report import title_of
from levkas.estimation.scores import METRICS
from levkas.pages.page import Figure, render_page
from levkas.pages.plots import Line, plot

if TYPE_CHECKING:
    from levkas.estimation.report import EstimationReport, SourceReport
    from levkas.estimation.scores import MethodScore

INKS = (
    *("#c62828", "#3b6fd4", "#3a9a4b", "#c77f1a", "#7a4fbf", "#2b8c8c"),
    *("#a0527a", "#6f7d2c", "#8a5a3c", "#5b6b8c", "#777777"),
)
DIGITS = {"rmse": 4, "delta_e_d65": 2}


def write_page(report: EstimationReport, folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Write estimation.html, estimation.json and models; return all files.

    Raises
    ------
    WriteRefused
        Where a file that Levkas did not write has the name.
    """
    from levkas.core.files import write_json, write_text
    from levkas.core.ownership import OwnFiles

    folder = Path(folder).resolve()
    models = {
        f"models/{source.name}_{model.method}.npz".replace("@", "-"): model
        for source in report.sources
        for model in source.models
    }
    names = ("estimation.html", "estimation.json", *models)
    with OwnFiles(folder, overwrite=overwrite).writing():
        write_json(folder / "estimation.json", report.to_dict())
        for name, model in models.items():
            model.save(folder / name)
        write_text(folder / "estimation.html", render_estimation(report))
    return [folder / name for name in names]


def render_estimation(report: EstimationReport) -> str:
    """Return the page as HTML."""
    page = {
        "title": f"Spectra of {report.target}, estimated",
        "subtitle": f"{report.database}: each painting is estimated from the others",
        "short": [_in_short(source, report.target) for source in report.sources],
        "sources": [_section(source, report) for source in report.sources],
    }
    return render_page("estimation.html", page=page)


def _in_short(source: SourceReport, target: str) -> str:
    best, found = source.ranked[0], source.ranked[0].summary()
    parts = [
        f"From {source.name} ({source.channels} channels) {title_of(best.method)} comes nearest to {target}: "
        f"RMSE {best.rmse:.4f}"
    ]
    if "delta_e_d65" in found:
        parts.append(f"ΔE₀₀ {found['delta_e_d65']['mean']:.2f} under D65")
    if source.ceiling is not None:
        parts.append(f"the reference’s own sigma is {source.ceiling:.4f}")
    return "; ".join(parts) + "."


def _section(source: SourceReport, report: EstimationReport) -> dict[str, Any]:
    inks = {score.method: INKS[i % len(INKS)] for i, score in enumerate(_in_order(source))}
    metrics = [key for key in METRICS if key in source.ranked[0].summary()]
    return {
        "title": f"From {source.name}",
        "anchor": "from-" + "".join(c if c.isalnum() else "-" for c in source.name),
        "facts": _facts(source),
        "heads": ["RMSE, all", *(METRICS[key] for key in metrics)],
        "rows": _rows(source, metrics, inks),
        "problems": [str(problem) for problem in source.problems],
        "figures": _figures(source, report, inks),
        "paintings": source.ranked[0].objects,
        "by_painting": _by_painting(source),
    }


def _in_order(source: SourceReport) -> list[MethodScore]:
    return sorted(source.scores, key=lambda score: title_of(score.method))


def _facts(source: SourceReport) -> str:
    folds = len(source.folds)
    parts = [
        f"{source.channels} channels",
        f"{source.pixels:,} pixels of paint scored",
        counted(folds, "fold"),
    ]
    if source.ceiling is not None:
        parts.append(f"noise ceiling {source.ceiling:.4f} (the reference’s own sigma)")
    return " · ".join(parts)


def _rows(
    source: SourceReport, metrics: Sequence[str], inks: dict[str, str]
) -> list[dict[str, Any]]:
    places = source.ranking(source.scores)
    rows = []
    for score in source.ranked:
        found = score.summary()
        cells = [[f"{v:.{DIGITS[key]}f}" for v in found[key].values()] for key in metrics]
        cells.insert(0, [_cell(score.rmse)])
        rows.append(
            {
                "rank": places[score.method],
                "title": title_of(score.method),
                "ink": inks[score.method],
                "cells": cells,
            }
        )
    return rows


# --- figures --------------------------------------------------------------------------------------


def _figures(source: SourceReport, report: EstimationReport, inks: dict[str, str]) -> list[Figure]:
    waves = report.wavelengths.tolist()
    bands = [
        Line(title_of(s.method), waves, s.by_band(), inks[s.method]) for s in _in_order(source)
    ]
    return [
        Figure(
            plot(bands, x="wavelength, nm", y="RMSE", from_zero=True, legend=False),
            "Error of every band over paint; colours are those of the methods in the table.",
        ),
    ]


def _by_painting(source: SourceReport) -> list[list[str]]:
    """Return the mean RMSE of every method for every painting, a row a method."""
    names = source.ranked[0].objects
    rows = []
    for score in source.ranked:
        means = [score.summary(name=name).get("rmse", {}).get("mean") for name in names]
        rows.append([title_of(score.method), *map(_cell, means)])
    return rows


def _cell(value: float | None) -> str:
    return "–" if value is None or value != value else f"{value:.4f}"
