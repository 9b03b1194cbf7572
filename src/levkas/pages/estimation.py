"""The page of an estimation of spectra: a table and curves, with JSON and models beside it."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from levkas.core.text import counted
from levkas.estimation.report import title_of
from levkas.estimation.scores import METRICS
from levkas.pages.page import Figure, render_page
from levkas.pages.plots import Line, colour_of, plot

if TYPE_CHECKING:
    from levkas.estimation.report import EstimationReport, SourceReport

DIGITS = {"rmse": 4, "delta_e_d65": 2}


def write_page(report: EstimationReport, folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Write estimation.html, estimation.json and models; return all files.

    Raises
    ------
    WriteRefused
        Where a file of the name is there already.
    """
    from levkas.core.files import before_writing, write_json, write_text
    from levkas.core.ownership import new_files

    folder = Path(folder).resolve()
    models = {
        f"models/{source.name}_{model.method}.npz".replace("@", "-"): model
        for source in report.sources
        for model in source.models
    }
    names = ("estimation.html", "estimation.json", *models)
    with before_writing(new_files(folder, overwrite=overwrite)):
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
        "sources": [_section(source, report) for source in report.sources],
    }
    return render_page("estimation.html", page=page)


def _section(source: SourceReport, report: EstimationReport) -> dict[str, Any]:
    best, places = source.ranked[0], source.ranking(source.scores)
    metrics = [key for key in METRICS if key in best.summary()]
    facts = [
        f"{source.channels} channels",
        f"{source.pixels:,} pixels of paint scored",
        counted(len(source.folds), "fold"),
        f"{title_of(best.method)} comes nearest",
    ]
    if source.ceiling is not None:
        facts.append(f"noise ceiling {source.ceiling:.4f} (the reference’s own sigma)")
    rows, lines = [], []
    for i, score in enumerate(source.ranked):
        title, found = title_of(score.method), score.summary()
        cells = [[f"{v:.{DIGITS[key]}f}" for v in found[key].values()] for key in metrics]
        means = [score.summary(name=n).get("rmse", {}).get("mean") for n in best.objects]
        rows.append(
            {
                "rank": places[score.method],
                "title": title,
                "cells": [[_cell(score.rmse)], *cells],
                "means": [*map(_cell, means)],
            }
        )
        ink = colour_of("", i, len(source.scores))
        lines.append(Line(title, report.wavelengths, score.by_band(), ink))
    svg = plot(lines, x="wavelength, nm", y="RMSE", from_zero=True)
    return {
        "title": f"From {source.name}",
        "facts": " · ".join(facts),
        "heads": ["RMSE, all", *(METRICS[key] for key in metrics)],
        "rows": rows,
        "problems": source.problems,
        "figure": Figure(svg, "Error of every band over paint."),
        "paintings": best.objects,
    }


def _cell(value: float | None) -> str:
    return "–" if value is None or value != value else f"{value:.4f}"
