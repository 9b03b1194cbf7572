"""What came of an experiment: a record for programs, a table for people."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from levkas.core.json_safe import rounded
from levkas.core.problems import Problem
from levkas.estimation.methods import METHODS
from levkas.estimation.scores import DIGITS, MethodScore, noise_ceiling, rank
from levkas.estimation.splits import EstimationFold
from levkas.estimation.stored import StoredModel


@dataclass(frozen=True)
class SourceReport:
    """Scores of all methods from one group of layers.

    Parameters
    ----------
    sources : tuple of str
        Layers whose channels are the responses.
    problems : tuple of Problem
        Methods that refused.
    models : tuple of StoredModel
        Fitted on all paintings, if requested.
    """

    sources: tuple[str, ...]
    channels: int
    folds: tuple[EstimationFold, ...]
    scores: tuple[MethodScore, ...]
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
    def pixels(self) -> int:
        """Scored pixels of paint."""
        return sum(len(error.rows) for error in self.scores[0].errors) if self.scores else 0

    def to_dict(self, wavelengths: np.ndarray) -> dict[str, Any]:
        """Return the record for programs."""
        places = self.ranking(self.scores)
        return {
            "from": list(self.sources),
            "channels": self.channels,
            "folds": [fold._asdict() for fold in self.folds],
            "pixels": self.pixels,
            "noise_ceiling": self.ceiling,
            "methods": [
                _method_record(score, places[score.method], wavelengths) for score in self.ranked
            ],
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
    """

    database: str
    target: str
    wavelengths: np.ndarray
    sources: tuple[SourceReport, ...]

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
                "results": [source.to_dict(self.wavelengths) for source in self.sources],
            },
            DIGITS,
        )

    @property
    def text(self) -> str:
        """A table for people, a line a method."""
        return "\n\n".join(_text_of(source, self.target) for source in self.sources)


def title_of(method: str) -> str:
    """Return a method's title."""
    return METHODS[method].title


def _method_record(score: MethodScore, place: int, wavelengths: np.ndarray) -> dict[str, Any]:
    return {
        "method": score.method,
        "rank": place,
        "rmse": score.rmse,
        "metrics": score.summary(),
        "objects": {name: score.summary(name=name) for name in score.objects},
        "bands": [
            {"wavelength": float(w), "rmse": float(e)}
            for w, e in zip(wavelengths, score.by_band(), strict=True)
        ],
    }


def _text_of(source: SourceReport, target: str) -> str:
    head = f"{'':2} {'method':30} {'RMSE':>7} {'median':>7} {'p95':>7} {'ΔE00':>6}"
    places = source.ranking(source.scores)
    held = "each painting is estimated from the others"
    lines = [f"{target} from {source.name} ({source.channels} channels): {held}", head]
    for score in source.ranked:
        found = score.summary()
        cells = [
            f"{score.rmse:7.4f}",
            f"{found['rmse']['median']:7.4f}",
            f"{found['rmse']['p95']:7.4f}",
            f"{found['delta_e_d65']['mean']:6.2f}" if "delta_e_d65" in found else f"{'–':>6}",
        ]
        lines.append(f"{places[score.method]:2} {title_of(score.method):30} {' '.join(cells)}")
    if source.ceiling is not None:
        lines.append(
            f"   the reference's own sigma is {source.ceiling:.4f}: nothing is ranked below it"
        )
    return "\n".join(lines)
