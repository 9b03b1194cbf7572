"""Comparison of methods: each on every layer of a database, in a process of its own with a time limit."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.machine import count_threads
from levkas.core.ownership import OwnFiles
from levkas.core.problems import Problem, unknown_name
from levkas.database.registrations import read_registration, read_registrations
from levkas.quality.comparison.methods import COMPARED, find_peers
from levkas.quality.comparison.trial import Trial
from levkas.quality.evaluation.layer_report import (
    checks_by_band,
    find_truth,
    locate,
    read_check_points,
)
from levkas.quality.evaluation.native_layers import ComparisonRefused, no_native

Checks = Mapping[tuple[str, str, str], np.ndarray]


TIME_LIMIT_S = 600.0


THREADS_OF = (
    "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "LEVKAS_THREADS",
    "ITK_GLOBAL_DEFAULT_NUMBER_OF_THREADS",
)  # fmt: skip


@dataclass(frozen=True)
class ComparedLayer:
    """One camera under one setup of one object.

    Parameters
    ----------
    object, name : str
        `name` is CAMERA or CAMERA@SETUP.
    """

    object: str
    name: str

    def __str__(self) -> str:
        return f"{self.object}/{self.name}"


@dataclass(frozen=True)
class ComparedRow:
    """Result of one method on one layer; `facts` as `levkas.quality.comparison.trial.run_trial` returns them."""

    layer: ComparedLayer
    method: str
    facts: dict[str, Any]
    map: str = ""
    done: int = 0
    total: int = 0

    @property
    def label(self) -> str:
        """What is running, for a terminal."""
        return f"{self.layer} {self.method}"

    @property
    def finished(self) -> bool:
        """True: a row is yielded when its method has ended."""
        return True

    @property
    def line(self) -> str:
        """One line for a terminal."""
        result = self.facts.get("failure") or f"{self.facts.get('seconds', 0):.1f} s"
        return f"{self.layer} {self.method}: {result[:100]}"

    @property
    def errors(self) -> list[float]:
        """Mean errors of the bands that have points, reference px."""
        return [b["error_mean"] for b in self.facts.get("bands", []) if b["points"]]

    def to_dict(self) -> dict[str, Any]:
        """Return the row as `--json` gives it."""
        errors = self.errors
        most = [b["error_max"] for b in self.facts.get("bands", []) if b["points"]]
        return {
            "object": self.layer.object,
            "layer": self.layer.name,
            "method": self.method,
            "error_mean": sum(errors) / len(errors) if errors else None,
            "error_worst_band": max(errors, default=None),
            "error_max": max(most, default=None),
            **self.facts,
            "map": self.map,
        }


def layers_of(database: Path) -> list[ComparedLayer]:
    """Return the layers that were registered to another camera."""
    layers = []
    for path, record in read_registrations(database):
        if record["camera"] != record["reference"]["camera"] or record.get("setup"):
            layers.append(ComparedLayer(path.parents[1].name, path.stem))
    if not layers:
        raise ComparisonRefused(
            Problem(
                "E_UNREADABLE",
                "no layer of this database was registered to another camera",
                file=str(database),
            )
        )
    return layers


def require_native(database: Path, layers: Sequence[ComparedLayer]) -> None:
    """Raise ComparisonRefused where the database has no native pixels, by which layers are registered again."""
    first = database / "objects" / layers[0].object / "native"
    if not any(first.glob("*.tif")):
        raise no_native(layers[0].object, first)


def chosen_methods(names: Sequence[str]) -> tuple[list[str], list[Problem]]:
    """Return the methods that can run, all without names, and a problem for each that cannot.

    Raises
    ------
    ComparisonRefused
        Where a name is not known.
    """
    unknown = [name for name in names if name not in COMPARED]
    if unknown:
        what = f"there is no method {unknown[0]!r} to compare"
        raise ComparisonRefused(unknown_name(what, unknown[0], COMPARED, field="--method"))
    find_peers()
    wanted = list(names) or list(COMPARED)
    lacking = {name: COMPARED[name].missing for name in wanted}
    problems = [
        Problem(
            "E_MISSING",
            f"{COMPARED[name].title} is left out: {why}",
            field=name,
            fix="Run `make compare` in a checkout of the repository: it installs what is compared.",
        )
        for name, why in lacking.items()
        if why
    ]
    return [name for name in wanted if not lacking[name]], problems


def run_rows(
    database: Path,
    methods: Sequence[str],
    *,
    truth: Path | None,
    checks: Checks,
    objects: Sequence[str] = (),
    output: OwnFiles | None,
    time_limit_s: float = TIME_LIMIT_S,
) -> Iterator[ComparedRow]:
    """Yield a row a layer and method, in that order; SSIM maps are drawn into `output`."""
    layers = [one for one in layers_of(database) if not objects or one.object in objects]
    done, total = 0, len(layers) * len(methods)
    for layer in layers:
        path = database / "objects" / layer.object / "registration" / f"{layer.name}.json"
        points = checks_by_band(checks, read_registration(path), layer.name)
        own = {band: pairs.tolist() for band, pairs in points.items()}
        for method in methods:
            name = f"{layer.object}_{layer.name.replace('@', '_')}_{method}_ssim.png"
            page = output.folder / name if output else None
            if output and page:
                output.claim(page)
            trial = Trial(
                str(database), layer.object, layer.name, method,
                str(truth or ""), own, str(page or ""),
            )  # fmt: skip
            facts = _in_a_child(trial, time_limit_s)
            if output and page:
                output.keep(page)
            drawn = name if page and page.is_file() and not facts.get("failure") else ""
            done += 1
            yield ComparedRow(layer, method, facts, drawn, done, total)


def _in_a_child(trial: Trial, limit_s: float) -> dict[str, Any]:
    settings = dict.fromkeys(THREADS_OF, str(count_threads()))
    settings["PYTHONPATH"] = os.pathsep.join(str(Path(p).resolve()) for p in sys.path if p)
    # Some peers leave files where they run: that place is thrown away.
    try:
        with tempfile.TemporaryDirectory() as scratch:
            done = subprocess.run(
                [sys.executable, "-m", "levkas.quality.comparison.trial"],
                input=json.dumps(asdict(trial)), text=True, capture_output=True, cwd=scratch,
                timeout=limit_s, env={**os.environ, **settings}, check=False,
            )  # fmt: skip
    except subprocess.TimeoutExpired:
        return {"failure": f"stopped after {limit_s:g} s", "seconds": limit_s}
    try:
        facts: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    except (ValueError, IndexError):
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        return {"failure": f"ended with status {done.returncode}: {last[-160:]}"}
    return facts


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
        summaries = []
        for name in self.methods:
            rows = [r for r in self.rows if r.method == name]
            good = [r for r in rows if not r.facts.get("failure")]
            records = [r.to_dict() for r in good]
            summaries.append(
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
        return summaries

    @property
    def text(self) -> str:
        """A table for people, a line a method."""
        head = f"{'method':32} {'failed':>7} {'mean px':>8} {'worst band':>11} {'max px':>8} {'SSIM':>6} {'s':>7} {'CPU s':>7} {'MiB':>6}"
        lines = [head]
        for one in self.summary():
            lines.append(
                f"{one['title']:32} {one['failures']:>3}/{one['layers']:<3} {_formatted(one['error_mean'], 3):>8} "
                f"{_formatted(one['error_worst_band'], 3):>11} {_formatted(one['error_max'], 2):>8} "
                f"{_formatted(one['ssim'], 3):>6} {_formatted(one['seconds'], 1):>7} {_formatted(one['cpu_seconds'], 1):>7} {_formatted(one['peak_mib'], 0):>6}"
            )
        return "\n".join(lines)

    def to_dict(self) -> dict[str, Any]:
        """Return the report of `levkas methods --json`."""
        return {"methods": self.summary(), "comparison": [row.to_dict() for row in self.rows]}


def _numbers(values: Iterable[Any]) -> list[float]:
    return [float(v) for v in values if v is not None and np.isfinite(v)]


def _mean(values: Iterable[Any]) -> float | None:
    known = _numbers(values)
    return sum(known) / len(known) if known else None


def _most(values: Iterable[Any]) -> float | None:
    return max(_numbers(values), default=None)


def _formatted(value: float | None, digits: int) -> str:
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
        Where a file that Levkas did not write would be replaced.
    """

    found, beside = (path.resolve() for path in locate(Path(database)))
    wanted, problems = chosen_methods(methods)
    layers = layers_of(found)
    there = sorted({layer.object for layer in layers})
    if unknown := [name for name in objects if name not in there]:
        what, file = "no object of this name has a registered layer", str(found)
        raise ComparisonRefused(
            *(unknown_name(what, n, there, file=file, field="--object") for n in unknown)
        )
    truth = find_truth(known.truth, beside)
    checks, unmatched = (
        read_check_points(known.points, found, known.frame) if known.points else ({}, [])
    )
    require_native(found, layers)
    where = OwnFiles(Path(output).resolve(), overwrite=overwrite) if output else None
    rows = run_rows(
        found,
        wanted,
        truth=truth,
        checks=checks,
        objects=objects,
        output=where,
        time_limit_s=time_limit_s or TIME_LIMIT_S,
    )
    return Comparison(draw(rows), [*problems, *unmatched])
