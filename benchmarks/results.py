"""Measured figures: benchmarks/results.json, read, checked and brought up to date.

A table has an id, a title and a sentence; a figure is one measured number of a table:

    table    id of its table
    what     row, for example a camera or a method
    aspect   column; empty where the table has one
    value    number, [least, most] of several, or null where the method failed
    unit     of the value
    goal     [least, most], either may be null; null where there is none
    command  that repeats it, from the root of the repository
    machine  processors, and what else they did
    version  of Levkas, with the commit where it is known
    date     of the measurement

Scripts call `add_option` and `record`; docs/write_benchmarks.py makes docs/benchmarks.md of the file.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import re
import subprocess
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path

import levkas

FILE = Path(__file__).with_name("results.json")
Value = float | tuple[float, float] | None
Goal = tuple[float | None, float | None] | None


@dataclass(frozen=True)
class Figure:
    """One measured number; the module lists what the fields hold."""

    table: str
    what: str
    aspect: str
    value: Value
    unit: str
    goal: Goal
    command: str
    machine: str
    version: str
    date: str

    @property
    def key(self) -> tuple[str, str, str]:
        """Table, row and column: a figure's name."""
        return self.table, self.what, self.aspect

    @property
    def met(self) -> bool | None:
        """Whether every value lies within the goal; None where there is no goal."""
        if self.goal is None:
            return None
        least, most = self.goal
        values = self.value if isinstance(self.value, tuple) else (self.value,)
        return all(
            v is not None and (least is None or v >= least) and (most is None or v <= most)
            for v in values
        )


@dataclass(frozen=True)
class Table:
    """A table of the page: its heading and the sentence above it."""

    id: str
    title: str
    sentence: str


@dataclass(frozen=True)
class Results:
    """All tables in the order of the page, and their figures, table by table."""

    tables: tuple[Table, ...]
    figures: tuple[Figure, ...]

    def of(self, table: str) -> list[Figure]:
        """Return the figures of one table, in the order of the file."""
        return [f for f in self.figures if f.table == table]


def load(path: Path = FILE) -> Results:
    """Read a results file; raise ValueError with the figure's name where it is not sound."""
    content = json.loads(path.read_text(encoding="utf-8"))
    tables = tuple(Table(**one) for one in content["tables"])
    figures = tuple(_figure(one) for one in content["figures"])
    results = Results(tables, figures)
    _check(results)
    return results


def save(results: Results, path: Path = FILE) -> None:
    """Write a results file, a figure a line, aside and renamed; order: tables, then as given."""
    _check(results)
    order = [t.id for t in results.tables]
    figures = sorted(results.figures, key=lambda f: order.index(f.table))
    lines = [
        ",\n".join("  " + json.dumps(asdict(one), ensure_ascii=False) for one in several)
        for several in (results.tables, figures)
    ]
    text = f'{{\n "tables": [\n{lines[0]}\n ],\n "figures": [\n{lines[1]}\n ]\n}}\n'
    aside = path.with_name(f".{path.name}.{os.getpid()}")
    aside.write_text(text, encoding="utf-8")
    aside.replace(path)


def record(
    path: Path | None, table: str, values: Mapping[str, Value] | Mapping[tuple[str, str], Value]
) -> None:
    """Bring figures of one table up to date, with command, machine, version and date of this run.

    `values` by row, or by (row, column). The file has the figure already, with unit and goal: one
    that it lacks (of a shorter run, for example) raises ValueError, and nothing is written. Does
    nothing without a path.
    """
    if path is None:
        return
    results = load(path)
    known = {f.key: f for f in results.figures}
    for name, value in values.items():
        key = (table, name, "") if isinstance(name, str) else (table, *name)
        if key not in known:
            raise ValueError(f"{path.name} has no figure {key}: write its line there first")
        known[key] = replace(known[key], value=_rounded(value), **_run())
    save(Results(results.tables, tuple(known.values())), path)


def add_option(parser: argparse.ArgumentParser) -> None:
    """Give a script the option --results FILE."""
    parser.add_argument(
        "--results", type=Path, help="bring the figures of this file up to date: results.json"
    )


def taken_option() -> Path | None:
    """Take --results FILE off the arguments of a script that parses none."""
    if "--results" not in sys.argv:
        return None
    at = sys.argv.index("--results")
    path = Path(sys.argv[at + 1])
    del sys.argv[at : at + 2]
    return path


def _figure(one: dict) -> Figure:
    missing = {f.name for f in fields(Figure)} ^ one.keys()
    if missing:
        raise ValueError(f"{one.get('table')}, {one.get('what')}: fields {sorted(missing)}")
    pair = {k: tuple(one[k]) for k in ("value", "goal") if isinstance(one[k], list)}
    return Figure(**{**one, **pair})


def _check(results: Results) -> None:
    """Raise ValueError for a figure that is twice, has no table, no command, date or number."""
    tables, earlier = {t.id for t in results.tables}, set()
    for one in results.figures:
        values = one.value if isinstance(one.value, tuple) else (one.value,)
        sound = {
            "twice": one.key not in earlier,
            "table": one.table in tables,
            "what": bool(one.what),
            "unit": isinstance(one.unit, str),
            "value": len(values) == (2 if isinstance(one.value, tuple) else 1)
            and all(v is None or isinstance(v, (int, float)) for v in values)
            and (len(values) == 1 or (None not in values and values[0] <= values[1])),
            "goal": one.goal is None or (len(one.goal) == 2 and one.goal != (None, None)),
            "command": bool(one.command),
            "machine": bool(one.machine),
            "version": bool(one.version),
            "date": bool(re.fullmatch(r"\d{4}-\d\d-\d\d", one.date)),
        }
        if not all(sound.values()):
            wrong = [name for name, good in sound.items() if not good]
            raise ValueError(f"figure {one.key}: {', '.join(wrong)}")
        earlier.add(one.key)


def _rounded(value: Value) -> Value:
    """Return a value of four significant digits."""
    if value is None:
        return None
    if isinstance(value, tuple):
        return _rounded(value[0]), _rounded(value[1])
    return float(f"{float(value):.4g}")


def _run() -> dict[str, str]:
    """Return command, machine, version and date of this process."""
    script, *given = sys.argv
    words, skip = [f"benchmarks/{Path(script).name}"], False
    for word in given:
        if not skip and word != "--results":
            words.append(word if "/" not in word else "FOLDER")  # no paths of this machine
        skip = word == "--results"
    commit = subprocess.run(
        ["git", "describe", "--always", "--dirty"],
        cwd=FILE.parent,
        capture_output=True,
        text=True,
        check=False,
    ).stdout.strip()
    load = f", load {os.getloadavg()[0]:.1f}" if hasattr(os, "getloadavg") else ""
    return {
        "command": f"python {' '.join(words)}",
        "machine": f"{os.cpu_count()} cores{load}",
        "version": levkas.__version__ + (f" ({commit})" if commit else ""),
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
    }
