"""Figures of the house: how large it is, what it leans on, and through how many modules a frame goes.

    python benchmarks/house.py [--column NAME]

Prints the table; with ``--column`` the figures become that column of docs/development/house.md, beside those
that stand there. Counted are the files that git knows, by lines as they stand (docstrings, comments and blank
lines too). Words of the documentation are pieces between spaces with a letter or digit, of docs/**/*.md.
The closure of dependencies is what an installation without extras brings on this machine.

A frame's way is traced at run time: a campaign of one object by a filter camera and a mosaic, simulated small,
is built in this process with every module loaded before; a module counts once one of its Python functions has
run on any thread, so imports and compiled kernels do not count. The first pixel is there when a function of `levkas.readers` has returned an array
of two or more dimensions for the first time. "Lines that stand twice" are those of `WINDOW` or more lines in a row,
imports, docstrings and blank lines left out, that stand word by word at another place of the same folder too.

Where `make coverage` has left its coverage.json, the share of lines and branches that the fast tests run is shown too, per cent.
Compiled kernels and processes of their own do not count as run.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import inspect
import json
import pkgutil
import re
import subprocess
import sys
import tempfile
import threading
import tomllib
from collections import Counter
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from types import FrameType
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "levkas"
PAGE = ROOT / "docs" / "development" / "house.md"
CAMERAS = ("lctf-vis", "d80")
KINDS = {"mosaic", "bands", "sensors", "cube", "image"}
WINDOW = 6
"""Lines in a row."""
WORDS = ("told", "seen", "asked", "believe")
"""Verbs that docs and code do not use of data."""


# --- size


def tracked(*patterns: str) -> list[Path]:
    """Return the files that git knows under glob patterns."""
    done = subprocess.run(
        ["git", "ls-files", "-z", "--", *patterns],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return [ROOT / name for name in done.stdout.split("\0") if name and (ROOT / name).is_file()]


def lines_of(paths: list[Path]) -> int:
    return sum(len(path.read_text(encoding="utf-8").splitlines()) for path in paths)


def sizes() -> Iterator[tuple[str, int]]:
    """Yield lines and files of the package, of each part of it, and of what stands beside it."""
    package = tracked("src/levkas/*.py")
    yield "Lines of the package", lines_of(package)
    yield "Files of the package", len(package)
    parts: dict[str, list[Path]] = {}
    for path in package:
        parts.setdefault((*path.relative_to(SOURCE).parts[:-1], "root")[0], []).append(path)
    for name, paths in sorted(parts.items()):
        yield f"{name}: lines", lines_of(paths)
        yield f"{name}: files", len(paths)
    for name, patterns in (
        ("tests", ("tests/*.py", "conftest.py")),
        ("benchmarks", ("benchmarks/*.py",)),
        ("frontend, TypeScript", ("frontend/*.ts",)),
        ("frontend, CSS and HTML", ("frontend/*.css", "frontend/*.html")),
    ):
        yield f"Lines of {name}", lines_of(paths := tracked(*patterns))
        yield f"Files of {name}", len(paths)
    pages = tracked("docs/*.md")
    words = sum(
        bool(re.search(r"\w", word)) for p in pages for word in p.read_text("utf-8").split()
    )
    yield "Words of the documentation", words
    yield "Pages of the documentation", len(pages)


# --- what it leans on


def dependencies() -> Iterator[tuple[str, int]]:
    """Yield how many packages are declared, and how many they bring."""
    with (ROOT / "pyproject.toml").open("rb") as file:
        declared = tomllib.load(file)["project"]["dependencies"]
    yield "Runtime dependencies, declared", len(declared)
    yield "Runtime dependencies, installed", len(closure(declared))


def closure(requirements: list[str]) -> set[str]:
    """Return the names of packages that requirements bring on this machine, themselves among them."""
    from packaging.requirements import Requirement
    from packaging.utils import canonicalize_name

    found: set[str] = set()
    done: set[tuple[str, str]] = set()
    waiting = [(Requirement(text), "") for text in requirements]
    while waiting:
        one, extra = waiting.pop()
        if one.marker and not one.marker.evaluate({"extra": extra}):
            continue
        name = canonicalize_name(one.name)
        found.add(name)
        for wanted in ("", *one.extras):
            if (name, wanted) not in done:
                done.add((name, wanted))
                try:
                    waiting += [(Requirement(text), wanted) for text in requires(name) or ()]
                except PackageNotFoundError:
                    print(f"{name} is not installed: what it brings is not counted")
    return found


# --- what is written twice, what is compared as text


def habits() -> Iterator[tuple[str, int]]:
    """Yield lines that stand twice, comparisons of a camera's kind with strings, words of speech."""
    package = tracked("src/levkas/*.py")
    yield "Lines that stand twice in the package", lines_twice(package)
    yield "Lines that stand twice in the tests", lines_twice(tracked("tests/*.py", "conftest.py"))
    texts = [path.read_text(encoding="utf-8") for path in package]
    yield (
        "Comparisons of a camera's kind with a string",
        sum(is_of_kind(node) for text in texts for node in ast.walk(ast.parse(text))),
    )
    pattern = rf"\b(?:{'|'.join(WORDS)})\b"
    yield f"Occurrences of {', '.join(WORDS)}", sum(len(re.findall(pattern, t)) for t in texts)


def lines_twice(paths: list[Path]) -> int:
    """Return how many lines of code are in a row of `WINDOW` that stands elsewhere too."""
    places: dict[tuple[str, ...], list[tuple[Path, int]]] = {}
    for path in paths:
        lines = code_lines(path.read_text(encoding="utf-8"))
        for start in range(len(lines) - WINDOW + 1):
            places.setdefault(tuple(lines[start : start + WINDOW]), []).append((path, start))
    return len({
        (path, start + n) for rows in places.values() if len(rows) > 1
        for path, start in rows for n in range(WINDOW)
    })  # fmt: skip


def code_lines(text: str) -> list[str]:
    """Return the lines of a module without imports, docstrings, comments, blank lines and indentation."""
    left_out: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        is_docstring = isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
        if is_docstring or isinstance(node, ast.Import | ast.ImportFrom):
            left_out.update(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    rows = ((n, row.strip()) for n, row in enumerate(text.splitlines(), 1) if n not in left_out)
    return [row for _, row in rows if row and not row.startswith("#")]


def is_of_kind(node: ast.AST) -> bool:
    """Tell whether a comparison has something called kind and the name of a camera's kind."""
    if not isinstance(node, ast.Compare):
        return False
    sides = [node.left, *node.comparators]
    named = any(getattr(side, "attr", getattr(side, "id", "")) == "kind" for side in sides)
    constants = (
        part for side in sides for part in ast.walk(side) if isinstance(part, ast.Constant)
    )
    return named and any(part.value in KINDS for part in constants)


# --- the way of a frame


class Trace:
    """Modules of Levkas in the order in which one of their functions first ran, on any thread."""

    def __init__(self) -> None:
        self.modules: dict[str, None] = {}
        self.before_first_pixel = 0

    def __call__(self, frame: FrameType, event: str, value: Any) -> None:
        if event == "call":
            if (
                frame.f_code.co_flags & inspect.CO_OPTIMIZED
            ):  # a function, no body of module or class
                name = frame.f_globals.get("__name__", "")
                if name.startswith("levkas") and name not in self.modules:
                    self.modules[name] = None
        elif event == "return" and not self.before_first_pixel:
            name = frame.f_globals.get("__name__", "")
            if name.startswith("levkas.readers") and getattr(value, "ndim", 0) >= 2:
                self.before_first_pixel = len(self.modules)

    def __enter__(self) -> Trace:
        threading.setprofile(self)
        sys.setprofile(self)
        return self

    def __exit__(self, *_: object) -> None:
        sys.setprofile(None)
        threading.setprofile(None)


def simulate(folder: Path) -> None:
    """Simulate a campaign of one object, and leave two of its cameras."""
    import tomlkit

    from levkas.simulation.campaigns import simulate_campaign

    for _ in simulate_campaign(folder, preset="small", scale=0.15, objects=1):
        pass
    path = folder / "campaign.toml"
    campaign = tomllib.loads(path.read_text(encoding="utf-8"))
    campaign["cameras"] = {name: campaign["cameras"][name] for name in CAMERAS}
    path.write_text(tomlkit.dumps(campaign), encoding="utf-8")


def load_everything() -> None:
    """Import every module, so that none counts as entered for being imported."""
    import levkas

    for module in pkgutil.walk_packages(levkas.__path__, "levkas."):
        if not module.name.endswith("__main__"):
            try:
                importlib.import_module(module.name)
            except ImportError as error:
                print(f"{module.name} is not loaded: {error}")


def way_of_a_frame() -> Iterator[tuple[str, int]]:
    """Yield how many modules the build of a small campaign enters."""
    load_everything()
    from levkas.building import build

    with tempfile.TemporaryDirectory(prefix="house-") as room:
        simulate(Path(room))
        with Trace() as trace:
            bad = [step.line for step in build(Path(room)) if step.state in ("refused", "failed")]
    if bad:
        sys.exit("\n".join(bad))
    yield "Modules that a frame enters before its first pixel", trace.before_first_pixel
    yield "Modules that a frame enters in all", len(trace.modules)
    parts = Counter((*name.split("."), "root")[1] for name in trace.modules)
    for name, count in sorted(parts.items()):
        yield f"{name}: modules that a frame enters", count
    print("in order:", " ".join(name.removeprefix("levkas.") for name in trace.modules))


# --- the page


def write_column(name: str, figures: dict[str, int]) -> None:
    """Set a column of the table of the page; rows that are new come at its end."""
    text = PAGE.read_text(encoding="utf-8")
    head, table, tail = re.split(r"((?:^\|.*\|\n){2,})", text, maxsplit=1, flags=re.M)
    cells = [[cell.strip() for cell in row.strip("|\n ").split("|")] for row in table.splitlines()]
    titles, rows = cells[0], {row[0]: row[1:] for row in cells[2:]}
    if name not in titles:
        titles.append(name)
    place = titles.index(name) - 1
    for key in [*figures, *(key for key in rows if key not in figures)]:
        row = rows.setdefault(key, [])
        row += [""] * (len(titles) - 1 - len(row))
        row[place] = f"{figures[key]:,}" if key in figures else ""
    body = [titles, ["---", *["--:"] * (len(titles) - 1)], *([k, *row] for k, row in rows.items())]
    table = "".join(f"| {' | '.join(row)} |\n" for row in body)
    PAGE.write_text(head + table + tail, encoding="utf-8")


# --- tests


def coverage() -> Iterator[tuple[str, int]]:
    """Yield what of the package, and of each part of it, the fast tests run; nothing where they were not measured."""
    path = ROOT / "coverage.json"
    if not path.exists():
        return
    run, whole = Counter[str](), Counter[str]()
    for name, file in json.loads(path.read_text(encoding="utf-8"))["files"].items():
        inner = Path(name).relative_to("src/levkas").parts
        summary = file["summary"]
        for part in ("the package", inner[0] if len(inner) > 1 else "root"):
            run[part] += summary["covered_lines"] + summary["covered_branches"]
            whole[part] += summary["num_statements"] + summary["num_branches"]
    for part in sorted(whole, key=lambda part: (part != "the package", part)):
        yield (
            f"Lines and branches of {part} that fast tests run, %",
            round(100 * run[part] / whole[part]),
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--column", help="column of docs/development/house.md to set")
    given = parser.parse_args()
    parts = (sizes(), dependencies(), habits(), way_of_a_frame(), coverage())
    figures = {name: number for part in parts for name, number in part}
    for name, number in figures.items():
        print(f"{number:9,}  {name}")
    if given.column:
        write_column(given.column, figures)


if __name__ == "__main__":
    main()
