"""The table of a comparison, for people and for programs."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.problems import Problem
from levkas.quality.comparison.methods import COMPARED
from levkas.quality.comparison.running import ComparedRow


@dataclass(frozen=True)
class KnownPositions:
    """Positions that errors are measured at.

    Parameters
    ----------
    truth : path, optional
        Folder `truth` of a simulated campaign; without it the one beside the campaign.
    points, frame : optional
        Check points, as `levkas.quality.evaluation.layer_report.assess` takes them; used where there is no truth.
    """

    truth: Path | None = None
    points: Path | None = None
    frame: str | None = None


@dataclass(frozen=True)
class Comparison:
    """Rows of every method and layer.

    Parameters
    ----------
    rows : sequence of Row
    problems : sequence of Problem
        Methods that could not run.
    """

    rows: Sequence[ComparedRow]
    problems: Sequence[Problem] = field(default=())

    @property
    def methods(self) -> list[str]:
        """Methods that ran, in the order of `COMPARED`."""
        ran = {row.method for row in self.rows}
        return [name for name in COMPARED if name in ran]

    @property
    def layers(self) -> list[str]:
        """Layers in order."""
        return list(dict.fromkeys(str(row.layer) for row in self.rows))

    def row(self, layer: str, method: str) -> ComparedRow | None:
        """Return the row of a layer and method."""
        return next((r for r in self.rows if (str(r.layer), r.method) == (layer, method)), None)

    def summary(self) -> list[dict[str, Any]]:
        """Return a record a method: over the layers that it registered.

        Errors are means over layers of the means over bands; the worst is of any point of any band.
        """
        told = []
        for name in self.methods:
            rows = [r for r in self.rows if r.method == name]
            good = [r for r in rows if not r.facts.get("failure")]
            records = [r.to_dict() for r in good]
            told.append(
                {
                    "method": name,
                    "title": COMPARED[name].title,
                    "version": COMPARED[name].version,
                    "layers": len(rows),
                    "failures": len(rows) - len(good),
                    "error_mean": _mean(r["error_mean"] for r in records),
                    "error_worst_band": _most(r["error_worst_band"] for r in records),
                    "error_max": _most(r["error_max"] for r in records),
                    "ssim": _mean(r["ssim"] for r in records),
                    "seconds": _mean(r.facts.get("seconds") for r in rows),
                    "cpu_seconds": _mean(r.facts.get("cpu_seconds") for r in rows),
                    "peak_mib": _most(r.facts.get("peak_mib") for r in rows),
                }
            )
        return told

    @property
    def text(self) -> str:
        """A table for people, a line a method."""
        head = f"{'method':32} {'failed':>7} {'mean px':>8} {'worst band':>11} {'max px':>8} {'SSIM':>6} {'s':>7} {'CPU s':>7} {'MiB':>6}"
        lines = [head]
        for one in self.summary():
            lines.append(
                f"{one['title']:32} {one['failures']:>3}/{one['layers']:<3} {_said(one['error_mean'], 3):>8} "
                f"{_said(one['error_worst_band'], 3):>11} {_said(one['error_max'], 2):>8} "
                f"{_said(one['ssim'], 3):>6} {_said(one['seconds'], 1):>7} {_said(one['cpu_seconds'], 1):>7} {_said(one['peak_mib'], 0):>6}"
            )
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return the report of `evaluate --compare --json`."""
        return {"methods": self.summary(), "comparison": [row.to_dict() for row in self.rows]}


def _numbers(values: Iterable[Any]) -> list[float]:
    return [float(v) for v in values if v is not None and np.isfinite(v)]


def _mean(values: Iterable[Any]) -> float | None:
    known = _numbers(values)
    return sum(known) / len(known) if known else None


def _most(values: Iterable[Any]) -> float | None:
    return max(_numbers(values), default=None)


def _said(value: float | None, digits: int) -> str:
    return "–" if value is None else f"{value:.{digits}f}"


def compare(
    database: str | Path,
    *,
    methods: Sequence[str] = (),
    known: KnownPositions = KnownPositions(),
    objects: Sequence[str] = (),
    output: str | Path | None = None,
    overwrite: bool = False,
    time_limit_s: float | None = None,
    draw: Callable[[Iterable[ComparedRow]], list[ComparedRow]] = list,
) -> Comparison:
    """Compare methods of registration on the layers of a database.

    Parameters
    ----------
    database : path
        A database, or the campaign that it was built from.
    methods : sequence of str
        Keys of `COMPARED`; all without.
    known : KnownPositions, optional
        Truth or check points.
    objects : sequence of str
        Only these; all without.
    output : path, optional
        Folder for the SSIM maps. Other files in it stay. `levkas.pages.comparison.write_page`
        writes the page beside them.
    overwrite : bool
        Whether files may be replaced there that no comparison wrote, or that were changed since.
    time_limit_s : float, optional
        For one method on one layer; 600 without.
    draw : callable
        Consumes the rows as they come, for a terminal.

    Raises
    ------
    ComparisonRefused, EvaluationRefused
    WriteRefused
        Where a file of somebody else's stands in the way.
    """
    from levkas.core.ownership import OwnFiles
    from levkas.quality.comparison.running import TIME_LIMIT_S, chosen_methods, run_rows
    from levkas.quality.evaluation.layer_report import locate, read_check_points

    found, beside = (path.resolve() for path in locate(Path(database)))
    wanted, problems = chosen_methods(methods)
    truth = Path(known.truth).resolve() if known.truth else beside / "truth"
    where = OwnFiles(Path(output).resolve(), overwrite=overwrite) if output else None
    rows = run_rows(
        found,
        wanted,
        truth=truth if (truth / "truth.json").is_file() else None,
        checks=read_check_points(known.points, found, known.frame) if known.points else {},
        objects=objects,
        output=where,
        time_limit_s=time_limit_s or TIME_LIMIT_S,
    )
    return Comparison(draw(rows), problems)
