"""The page of an estimation of spectra: tables, curves and error maps, with JSON and CSV beside it."""

from __future__ import annotations

import io
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.text import counted
from levkas.estimation.budget import CONDITIONS, DRAWS, SHIFTS_PX
from levkas.estimation.report import title_of, with_interval
from levkas.estimation.scores import METRICS
from levkas.estimation.splits import SPLITS
from levkas.pages.page import Figure, render_page
from levkas.pages.plots import Line, plot

if TYPE_CHECKING:
    from levkas.estimation.budget import Budget
    from levkas.estimation.report import EstimationReport, SourceReport
    from levkas.estimation.scores import MethodScore, PixelErrors

INKS = (
    *("#c62828", "#3b6fd4", "#3a9a4b", "#c77f1a", "#7a4fbf", "#2b8c8c"),
    *("#a0527a", "#6f7d2c", "#8a5a3c", "#5b6b8c", "#777777"),
)
DIGITS = {"rmse": 4, "gfc": 4, "angle_deg": 2, "delta_e_d65": 2, "delta_e_a": 2, "mrae": 3}
COLOUR_MAP, STOPS = "inferno", 9
UNSCORED = (128, 128, 128)
MOST_SHOWN = 99.0
"""Percentile of the errors with the brightest colour."""


@dataclass(frozen=True)
class NumberTable:
    """A table of a section: the first column is of words."""

    title: str
    caption: str
    heads: Sequence[str]
    rows: Sequence[Sequence[str]]


def write_page(report: EstimationReport, folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Write estimation.html, estimation.json, tables as CSV, error maps and models; return all files.

    Raises
    ------
    WriteRefused
        Where a file that Levkas did not write has the name.
    """
    from levkas.core.files import write_bytes, write_json, write_text
    from levkas.core.ownership import OwnFiles

    folder = Path(folder).resolve()
    tables = report.tables()
    maps = {name: data for source in report.sources for name, data in draw_maps(source).items()}
    models = {
        f"models/{source.name}_{model.method}.npz".replace("@", "-"): model
        for source in report.sources
        for model in source.models
    }
    names = ("estimation.html", "estimation.json", *tables, *maps, *models)
    with OwnFiles(folder, overwrite=overwrite).writing():
        write_json(folder / "estimation.json", report.to_dict())
        for name, text in tables.items():
            write_text(folder / name, text)
        for name, data in maps.items():
            write_bytes(folder / name, data)
        for name, model in models.items():
            model.save(folder / name)
        files = ["estimation.json", *tables]
        write_text(folder / "estimation.html", render_estimation(report, files))
    return [folder / name for name in names]


def render_estimation(report: EstimationReport, files: Sequence[str] = ()) -> str:
    """Return the page as HTML; error maps are pictures beside it."""
    page = {
        "title": f"Spectra of {report.target}, estimated",
        "subtitle": f"{report.database}: {SPLITS.get(report.split, report.split)}",
        "short": [_in_short(source, report.target) for source in report.sources],
        "notes": report.notes,
        "problems": [],
        "files": files,
        "sources": [_section(source, report) for source in report.sources],
    }
    return render_page("estimation.html", page=page)


def draw_maps(source: SourceReport) -> dict[str, bytes]:
    """Return the error map of every method and painting as PNG, by file name."""
    top = _top(source)
    drawn = {}
    for score in source.ranked:
        for name in score.objects:
            errors = [error for error in score.errors if error.object == name]
            drawn[_map_name(source, score.method, name)] = _draw_map(errors, source.step, top)
    return drawn


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
    if source.floor is not None:
        parts.append(f"spectra of equal responses differ by {source.floor['rmse']:.4f} (metamers)")
    return "; ".join(parts) + "."


def _section(source: SourceReport, report: EstimationReport) -> dict[str, Any]:
    inks = {score.method: INKS[i % len(INKS)] for i, score in enumerate(_in_order(source))}
    metrics = [key for key in METRICS if key in source.ranked[0].summary()]
    return {
        "title": f"From {source.name}",
        "anchor": "from-" + "".join(c if c.isalnum() else "-" for c in source.name),
        "facts": _facts(source),
        "warning": source.split.note,
        "warning_word": "Optimistic." if source.split.optimistic else "Note.",
        "heads": ["RMSE, all", *(METRICS[key] for key in metrics), "in 95 % interval"],
        "rows": _rows(source, metrics, inks),
        "problems": [str(problem) for problem in source.problems],
        "figures": [f for f in _figures(source, report, inks) if f.svg],
        "tables": _tables(source),
        **_maps(source),
    }


def _in_order(source: SourceReport) -> list[MethodScore]:
    return sorted(source.scores, key=lambda score: title_of(score.method))


def _facts(source: SourceReport) -> str:
    folds = len(source.split.folds)
    parts = [
        f"{source.channels} channels",
        f"{source.pixels:,} pixels of paint and {source.gold_pixels:,} of gold scored",
        counted(folds, "fold"),
    ]
    if source.ceiling is not None:
        parts.append(f"noise ceiling {source.ceiling:.4f} (the reference’s own sigma)")
    if source.floor is not None:
        parts.append(
            f"metamer floor {source.floor['rmse']:.4f} ({source.floor['pairs']:,.0f} pairs of equal responses)"
        )
    return " · ".join(parts)


def _rows(
    source: SourceReport, metrics: Sequence[str], inks: dict[str, str]
) -> list[dict[str, Any]]:
    places = source.ranking(source.scores)
    rows = []
    for score in source.ranked:
        found, covered = score.summary(), score.coverage()
        cells = [[f"{v:.{DIGITS[key]}f}" for v in found[key].values()] for key in metrics]
        cells.insert(0, [_cell(score.rmse)])
        cells.append(["–" if covered is None else f"{100 * covered:.1f} %"])
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
        Line(title_of(s.method), waves, s.by_band()[0], inks[s.method]) for s in _in_order(source)
    ]
    figures = [
        Figure(
            plot(bands, x="wavelength, nm", y="RMSE", from_zero=True, legend=False),
            "Error of every band over paint; colours are those of the methods in the table.",
        ),
        _spectra(source, waves),
    ]
    for what, words, caption in (
        ("distance", "distance to the training set, its standard deviations",
         "Error over the distance of a pixel’s responses to the nearest training sample: what a method makes of paint that it was not trained on."),
        ("sigma", "sigma of the reference",
         "Error over the reference’s own sigma; below the dashed line no method can be distinguished from a perfect one."),
    ):  # fmt: skip
        figures.append(Figure(_over(source, what, words, inks), caption))
    if source.budget:
        figures.append(_shifts(source.budget, inks))
    return figures


def _spectra(source: SourceReport, waves: Sequence[float]) -> Figure:
    """Measured and estimated spectra of pixels of median and of large error, by the best method."""
    best = source.ranked[0]
    lines = []
    for words, percentile, colour in (("median", 50, "tgt"), ("95th percentile", 95, "ref")):
        error, pixel = _pixel_at(best, percentile)
        measured = error.measured[pixel]
        lines += [
            Line(f"{words}, measured", waves, measured, colour),
            Line(
                f"{words}, estimated", waves, measured + error.residuals[pixel], colour, dashed=True
            ),
        ]
    svg = plot(lines, x="wavelength, nm", y="reflectance", from_zero=True)
    text = f"A pixel of median error and one at the 95th percentile, {title_of(best.method)}."
    return Figure(svg, text)


def _pixel_at(score: MethodScore, percentile: float) -> tuple[PixelErrors, int]:
    """Return where the pixel of paint is whose RMSE is nearest to a percentile."""
    wanted = float(np.percentile(score.values("rmse"), percentile))
    found = []
    for error in score.errors:
        off = np.where(error.gold, np.inf, np.abs(error.metrics["rmse"] - wanted))
        pixel = int(off.argmin())
        found.append((float(off[pixel]), error, pixel))
    _, error, pixel = min(found, key=lambda one: one[0])
    return error, pixel


def _over(source: SourceReport, what: str, words: str, inks: dict[str, str]) -> str:
    lines = []
    for score in _in_order(source):
        rows = score.over(what)
        if rows:
            x, y = [row[what] for row in rows], [row["rmse"] for row in rows]
            lines.append(Line(title_of(score.method), x, y, inks[score.method]))
    if lines and what == "sigma":
        ends = [min(lines[0].x), max(lines[0].x)]  # type: ignore[type-var]
        lines.append(Line("sigma itself", ends, ends, "soft", dashed=True))
    return plot(lines, x=words, y="RMSE", from_zero=True, legend=False) if lines else ""


def _shifts(budget: Budget, inks: dict[str, str]) -> Figure:
    lines = []
    for method, row in budget.rmse.items():
        known = [(0.0, row.get("real")), *((s, row.get(f"shift {s:g}")) for s in SHIFTS_PX)]
        lines.append(
            Line(
                title_of(method),
                [s for s, _ in known],
                [e for _, e in known],
                inks.get(method, INKS[-1]),
            )
        )
    svg = plot(lines, x="shift of the reference, px", y="RMSE", from_zero=True, legend=False)
    return Figure(svg, f"What geometry costs: the reference shifted, on {budget.fold}.")


# --- tables ---------------------------------------------------------------------------------------


def _tables(source: SourceReport) -> list[NumberTable]:
    tables = [_by_painting(source)]
    if source.random:
        tables.append(_beside_random(source))
    if source.budget:
        tables.append(_budget_table(source.budget))
    return tables


def _by_painting(source: SourceReport) -> NumberTable:
    names = source.ranked[0].objects
    rows = []
    for score in source.ranked:
        means = [score.summary(name=name).get("rmse", {}).get("mean") for name in names]
        gold = score.summary(gold=True).get("rmse", {}).get("mean")
        rows.append([title_of(score.method), *(_cell(v) for v in (*means, gold))])
    return NumberTable(
        "Painting by painting",
        "Mean RMSE over the pixels of paint of each painting while it was held out, and over gold.",
        ["method", *names, "gold"],
        rows,
    )


def _beside_random(source: SourceReport) -> NumberTable:
    places, beside = source.ranking(source.scores), source.ranking(source.random)
    random = {score.method: score.rmse for score in source.random}
    rows = [
        [
            title_of(score.method),
            _cell(score.rmse),
            str(places[score.method]),
            _cell(random.get(score.method)),
            str(beside.get(score.method, "–")),
            f"× {score.rmse / random[score.method]:.2f}" if random.get(score.method) else "–",
        ]
        for score in source.ranked
    ]
    return NumberTable(
        "Held-out paintings and random pixels side by side",
        "Optimistic: of random pixels, neighbours of the same paint are in the training set. The last column "
        "says how much larger the error is where the paint was not in the training.",
        [
            "method",
            f"RMSE, {source.split.kind}",
            "rank",
            "RMSE, random (optimistic)",
            "rank",
            "ratio",
        ],
        rows,
    )


def _budget_table(budget: Budget) -> NumberTable:
    rows = []
    for method in budget.rmse:
        share = budget.registration_share(method)
        rows.append(
            [
                title_of(method),
                *(with_interval(budget, method, condition) for condition in CONDITIONS),
                _cell(budget.slope(method)),
                "–" if share is None else f"{100 * share:.2g} %",
            ]
        )
    known = budget.position_sigma
    registered = "" if known is None else (
        f" Registration leaves {known:.3f} px between the layers; the last column is its share of the squared error."
    )  # fmt: skip
    meanings = "; ".join(f"{key}: {text}" for key, text in list(CONDITIONS.items())[:3])
    return NumberTable(
        "Error budget",
        f"RMSE on {budget.fold} of the same experiment under other conditions. {meanings}; then the reference "
        f"shifted by parts of a pixel, and the test exposed half and twice. ± is half of a 95 % interval over {DRAWS} draws of "
        f"training and test blocks, of real itself, else of the difference from it.{registered}",
        ["method", *CONDITIONS, "per px of shift", "registration"],
        rows,
    )


def _cell(value: float | None) -> str:
    return "–" if value is None or value != value else f"{value:.4f}"


# --- maps -----------------------------------------------------------------------------------------


def _maps(source: SourceReport) -> dict[str, Any]:
    import matplotlib

    colours = matplotlib.colormaps[COLOUR_MAP](np.linspace(0, 1, STOPS))
    rows = []
    for name in source.ranked[0].objects:
        cells = [
            {
                "file": _map_name(source, score.method, name),
                "title": title_of(score.method),
                "rmse": _cell(score.summary(name=name).get("rmse", {}).get("mean")),
            }
            for score in source.ranked
        ]
        rows.append({"object": name, "cells": cells})
    return {
        "maps": rows,
        "map_heads": [title_of(score.method) for score in source.ranked],
        "top": f"{_top(source):.3g}",
        "step": "" if source.step == 1 else f", one in {source.step} along each side of the grid",
        "gradient": ", ".join(matplotlib.colors.to_hex(colour) for colour in colours),
    }


def _map_name(source: SourceReport, method: str, name: str) -> str:
    stem = "_".join((source.name, method, name)).replace("@", "-")
    return f"maps/{stem}.png"


def _top(source: SourceReport) -> float:
    """Return the error of the brightest colour: the same for all methods, from the best one."""
    return max(float(np.percentile(source.ranked[0].values("rmse"), MOST_SHOWN)), 1e-6)


def _draw_map(errors: Sequence[PixelErrors], step: int, top: float) -> bytes:
    import matplotlib
    from PIL import Image

    rows = np.concatenate([error.rows for error in errors]) // step
    columns = np.concatenate([error.columns for error in errors]) // step
    values = np.concatenate([error.metrics["rmse"] for error in errors])
    shown = np.empty((int(rows.max()) + 1, int(columns.max()) + 1, 3), np.uint8)
    shown[:] = UNSCORED
    colours = matplotlib.colormaps[COLOUR_MAP](np.clip(values / top, 0, 1), bytes=True)
    shown[rows, columns] = colours[:, :3]
    target = io.BytesIO()
    Image.fromarray(shown).save(target, "PNG")
    return target.getvalue()
