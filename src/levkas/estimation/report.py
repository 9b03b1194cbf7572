"""What came of an experiment: records for programs, tables for people, CSV for spreadsheets."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from levkas.core.json_safe import rounded
from levkas.core.problems import Problem
from levkas.estimation.budget import CONDITIONS, Budget
from levkas.estimation.methods import METHODS
from levkas.estimation.plan import CRITERIA
from levkas.estimation.scores import DIGITS, MethodScore, noise_ceiling, rank
from levkas.estimation.splits import SPLITS, EstimationSplit
from levkas.estimation.stored import StoredModel

OPTIMISTIC = "optimistic"


@dataclass(frozen=True)
class SourceReport:
    """Scores of all methods from one group of layers.

    Parameters
    ----------
    sources : tuple of str
        Layers whose channels are the responses.
    channels : int
    split : EstimationSplit
    scores, random : tuple of MethodScore
        Under the split, and with random pixels held out.
    floor : dict or None
        As of `metamer_floor`.
    budget : Budget, optional
    step : int
        Spacing of the scored pixels, px of the grid.
    problems : tuple of Problem
        Methods that refused.
    models : tuple of StoredModel
        Fitted on all paintings, if requested.
    """

    sources: tuple[str, ...]
    channels: int
    split: EstimationSplit
    scores: tuple[MethodScore, ...]
    random: tuple[MethodScore, ...] = ()
    floor: dict[str, float] | None = None
    budget: Budget | None = None
    step: int = 1
    problems: tuple[Problem, ...] = ()
    models: tuple[StoredModel, ...] = ()

    @property
    def name(self) -> str:
        """Names of the layers, joined."""
        return "+".join(self.sources)

    @property
    def ceiling(self) -> float | None:
        """The reference's own sigma: no method is ranked below it."""
        return noise_ceiling(self.scores[0].errors) if self.scores else None

    def ranking(self, scores: Sequence[MethodScore]) -> dict[str, int]:
        """Return the rank of every method by RMSE, from 1; what is below the ceiling is alike."""
        ranks = rank([score.rmse for score in scores], self.ceiling or 0.0)
        return {score.method: place for score, place in zip(scores, ranks, strict=True)}

    @property
    def ranked(self) -> list[MethodScore]:
        """Scores, the best first."""
        places = self.ranking(self.scores)
        return sorted(self.scores, key=lambda score: (places[score.method], score.rmse))

    @property
    def gold_pixels(self) -> int:
        """Scored pixels of gold and gloss."""
        return sum(int(error.gold.sum()) for error in self.scores[0].errors) if self.scores else 0

    @property
    def pixels(self) -> int:
        """Scored pixels of paint."""
        return (
            sum(int((~error.gold).sum()) for error in self.scores[0].errors) if self.scores else 0
        )

    def to_dict(self, wavelengths: np.ndarray) -> dict[str, Any]:
        """Return the record for programs."""
        places, beside = self.ranking(self.scores), self.ranking(self.random)
        by_method = {score.method: score for score in self.random}
        return {
            "from": list(self.sources),
            "channels": self.channels,
            "split": self.split.kind,
            "optimistic": self.split.optimistic,
            "note": self.split.note,
            "folds": [
                {"name": fold.name, "train": names_of(fold.train), "test": names_of(fold.test)}
                for fold in self.split.folds
            ],
            "pixels": self.pixels,
            "gold_pixels": self.gold_pixels,
            "noise_ceiling": self.ceiling,
            "metamer_floor": self.floor,
            "methods": [
                _method_record(score, places[score.method], wavelengths) for score in self.ranked
            ],
            OPTIMISTIC: [
                {"method": m, "rmse": by_method[m].rmse, "rank": beside[m]} for m in by_method
            ],
            "budget": self.budget.to_dict() if self.budget else None,
            "refused": [problem.to_dict() for problem in self.problems],
        }


@dataclass(frozen=True)
class EstimationReport:
    """All that an experiment found.

    Parameters
    ----------
    database : str
        Its title.
    target : str
        Layer whose spectra were estimated.
    wavelengths : ndarray, (bands,), nm
    split : str
        Key of `SPLITS`.
    sources : tuple of SourceReport
    notes : tuple of str
    choose_by : str
        Key of `plan.CRITERIA`: by what methods chose their parameters.
    """

    database: str
    target: str
    wavelengths: np.ndarray
    split: str
    sources: tuple[SourceReport, ...]
    notes: tuple[str, ...] = field(default=())
    choose_by: str = "rmse"

    @property
    def ok(self) -> bool:
        """Whether no method refused."""
        return not self.problems

    @property
    def problems(self) -> list[Problem]:
        """Refusals of methods, each once."""
        return list(dict.fromkeys(p for source in self.sources for p in source.problems))

    def to_dict(self) -> dict[str, Any]:
        """Return the report of ``levkas estimate --json``."""
        return rounded(
            {
                "target": self.target,
                "bands": len(self.wavelengths),
                "split": self.split,
                "choose_by": self.choose_by,
                "notes": list(self.notes),
                "results": [source.to_dict(self.wavelengths) for source in self.sources],
            },
            DIGITS,
        )

    @property
    def text(self) -> str:
        """A table for people, a line a method."""
        chosen = f"ridge, length and degree are chosen by {CRITERIA[self.choose_by]} of what was held out"
        return "\n\n".join([*(_text_of(s, self.target) for s in self.sources), chosen])

    def tables(self) -> dict[str, str]:
        """Return every table as CSV, by the name of its file."""
        return {
            "scores.csv": _csv(("from", "split", "method", "rank", "object", "pixels", "metric",
                                "mean", "median", "p95", "max"), self._score_rows()),
            "bands.csv": _csv(("from", "split", "method", "wavelength_nm", "rmse", "r2"), self._band_rows()),
            "curves.csv": _csv(("from", "method", "over", "at", "rmse"), self._curve_rows()),
            "budget.csv": _csv(("from", "tested", "method", "condition", "rmse", "interval_95", "difference_95"),
                               self._budget_rows()),
            "ranking.csv": _csv(("from", "method", "rmse", "rank", "random_rmse", "random_rank"),
                                self._rank_rows()),
        }  # fmt: skip

    def _score_rows(self) -> Iterable[Sequence[Any]]:
        for source in self.sources:
            places = source.ranking(source.scores)
            for score in source.ranked:
                for label, name, gold in _selections(score):
                    for metric, found in score.summary(gold=gold, name=name).items():
                        pixels = len(score.values(metric, gold=gold, name=name))
                        yield (source.name, source.split.kind, score.method, places[score.method], label,
                               pixels, metric, *found.values())  # fmt: skip

    def _band_rows(self) -> Iterable[Sequence[Any]]:
        for source in self.sources:
            for score in source.ranked:
                for row in zip(self.wavelengths.tolist(), *score.by_band(), strict=True):
                    yield source.name, source.split.kind, score.method, *row

    def _curve_rows(self) -> Iterable[Sequence[Any]]:
        for source in self.sources:
            for score in source.ranked:
                for what in ("distance", "sigma"):
                    for row in score.over(what):
                        yield source.name, score.method, what, row[what], row["rmse"]

    def _budget_rows(self) -> Iterable[Sequence[Any]]:
        for source in self.sources:
            if source.budget:
                budget = source.budget
                for method, row in budget.rmse.items():
                    for condition, value in row.items():
                        apart = (
                            ""
                            if condition == "real"
                            else budget.interval(method, condition, "real")
                        )
                        half = budget.interval(method, condition)
                        yield source.name, budget.fold, method, condition, value, half, apart

    def _rank_rows(self) -> Iterable[Sequence[Any]]:
        for source in self.sources:
            places, beside = source.ranking(source.scores), source.ranking(source.random)
            random = {score.method: score.rmse for score in source.random}
            for score in source.ranked:
                yield (source.name, score.method, score.rmse, places[score.method],
                       random.get(score.method, ""), beside.get(score.method, ""))  # fmt: skip


def title_of(method: str) -> str:
    """Return a method's title; a name that is none of ours, of predictions made elsewhere, as it is."""
    return METHODS[method].title if method in METHODS else method


def names_of(parts: Iterable[Any]) -> list[str]:
    """Return the paintings of one side of a fold."""
    return list(dict.fromkeys(part.object for part in parts))


def _method_record(score: MethodScore, place: int, wavelengths: np.ndarray) -> dict[str, Any]:
    rmse, r2 = score.by_band()
    return {
        "method": score.method,
        "rank": place,
        "rmse": score.rmse,
        "coverage_95": score.coverage(),
        "metrics": score.summary(),
        "gold": score.summary(gold=True),
        "objects": {name: score.summary(name=name) for name in score.objects},
        "bands": [
            {"wavelength": float(w), "rmse": float(e), "r2": float(r)}
            for w, e, r in zip(wavelengths, rmse, r2, strict=True)
        ],
        "over_distance": score.over("distance"),
        "over_sigma": score.over("sigma"),
    }


def _selections(score: MethodScore) -> list[tuple[str, str, bool]]:
    """Rows of a method: all paint, each painting, gold."""
    return [
        ("all", "", False),
        *((name, name, False) for name in score.objects),
        ("gold", "", True),
    ]


def _csv(head: Sequence[str], rows: Iterable[Sequence[Any]]) -> str:
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(head)
    table.writerows(rounded(list(row), DIGITS) for row in rows)
    return text.getvalue()


def _text_of(source: SourceReport, target: str) -> str:
    head = f"{'':2} {'method':36} {'RMSE':>7} {'median':>7} {'p95':>7} {'GFC':>7} {'ΔE00':>6} {'95 %':>6} {'random':>7}"
    places = source.ranking(source.scores)
    random = {score.method: score.rmse for score in source.random}
    lines = [
        f"{target} from {source.name} ({source.channels} channels): {SPLITS.get(source.split.kind, source.split.kind)}",
        head,
    ]
    for score in source.ranked:
        found, covered = score.summary(), score.coverage()
        cells = [
            f"{score.rmse:7.4f}",
            f"{found['rmse']['median']:7.4f}",
            f"{found['rmse']['p95']:7.4f}",
            f"{found['gfc']['mean']:7.4f}",
            f"{found['delta_e_d65']['mean']:6.2f}" if "delta_e_d65" in found else f"{'–':>6}",
            f"{100 * covered:5.1f}%" if covered is not None else f"{'–':>6}",
            f"{random[score.method]:7.4f}" if score.method in random else f"{'–':>7}",
        ]
        lines.append(f"{places[score.method]:2} {title_of(score.method):36} {' '.join(cells)}")
    if source.ceiling is not None:
        lines.append(
            f"   the reference's own sigma is {source.ceiling:.4f}: nothing is ranked below it"
        )
    if source.floor is not None:
        pairs, floor = source.floor["pairs"], source.floor["rmse"]
        lines.append(
            f"   metamers: spectra of equal responses differ by {floor:.4f} ({pairs:.0f} pairs)"
        )
    if source.split.note:
        lines.append(f"   {source.split.note}")
    if source.budget:
        lines += ["", *_text_of_budget(source.budget)]
    return "\n".join(lines)


def with_interval(budget: Budget, method: str, condition: str) -> str:
    """Return an RMSE and the half-width of its 95 % interval: of the difference from `real`, and of `real` itself."""
    row = budget.rmse[method]
    if condition not in row:
        return "–"
    half = budget.interval(method, condition, "" if condition == "real" else "real")
    return f"{row[condition]:.4f} ± {half:.4f}"


def _text_of_budget(budget: Budget) -> list[str]:
    lines = [f"   error budget, RMSE on {budget.fold}; ± holds the difference from real in 95 % of draws",
             "   " + f"{'method':36}" + "".join(f"{c.replace('exposure', 'exp.'):>16}" for c in CONDITIONS) + f"{'per px':>9}"]  # fmt: skip
    for method in budget.rmse:
        cells = "".join(f"{with_interval(budget, method, c):>16}" for c in CONDITIONS)
        slope = budget.slope(method)
        lines.append(
            f"   {title_of(method):36}{cells}" + (f"{slope:9.4f}" if slope is not None else "")
        )
    shares = [s for m in budget.rmse if (s := budget.registration_share(m)) is not None]
    if shares and budget.position_sigma is not None:
        lines.append(
            f"   registration leaves {budget.position_sigma:.3f} px: {100 * max(shares):.2g} % of the squared error at most"
        )
    return lines
