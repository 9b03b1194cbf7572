"""Write docs/benchmarks.md and the figures of README.md and paper/paper.md from benchmarks/results.json.

Tests hold the files to the results. In a text a figure has its name in a comment behind it,
``0.016<!-- comparison | Levkas | d80 -->`` (table, row, column if there are several), and a table the name of its own before it.
"""

import re
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "benchmarks"))

from results import Figure, Results, load  # noqa: E402

UNKNOWN = "not recorded"
NAMED = re.compile(r"[^\s<(]+<!-- ([^|>]+) \| ([^|>]+?)(?: \| ([^|>]+))? -->")
TABLE = re.compile(r"(<!-- table: (\S+) -->\n\n)(?:\|.*\n)+")


def page(results: Results) -> str:
    """Return docs/benchmarks.md."""
    goals = [f.met for f in results.figures if f.met is not None]
    parts = [
        "# Benchmarks",
        "",
        f"{sum(goals)} of {len(goals)} figures with a goal meet it; the others are marked **missed**."
        " Errors are against truth that was not fitted, in px of the reference band; a range is least to most."
        " Below *repeat with* an empty cell means the script above.",
        "",
    ]
    for one in results.tables:
        figures = results.of(one.id)
        parts += [f"## {one.title}", "", one.sentence, "", *table(figures), "", *origin(figures)]
    return "\n".join(parts).rstrip() + "\n"


def with_figures(paper: str, results: Results) -> str:
    """Return a text with every named figure and table as the results have it; KeyError for an unknown name."""
    figures = {figure.key: figure for figure in results.figures}

    def named(match: re.Match[str]) -> str:
        value = shown(figures[match[1], match[2], match[3] or ""], with_unit=False)
        return value + match[0][match[0].index("<!--") :]

    def laid_out(match: re.Match[str]) -> str:
        return match[1] + "\n".join(table(results.of(match[2]))) + "\n"

    return TABLE.sub(laid_out, NAMED.sub(named, paper))


def table(figures: list[Figure]) -> list[str]:
    """Return lines of one table: rows by `what`, columns by `aspect`, then goal and command."""
    rows = list(dict.fromkeys(f.what for f in figures))
    columns = list(dict.fromkeys(f.aspect for f in figures))
    found = {(f.what, f.aspect): f for f in figures}
    inside = {c: [f for f in figures if f.aspect == c] for c in columns}
    units = {c: {f.unit for f in inside[c]} for c in columns}
    shared = {c: len({f.goal for f in inside[c]}) == 1 for c in columns}
    several, goals = len({f.command for f in figures}) > 1, any(f.goal for f in figures)
    heads = [head(c, inside[c], units[c], shared=shared[c]) for c in columns]
    heads = ["", *heads, *(["goal"] if goals else []), *(["repeat with"] if several else [])]
    lines = [
        "| " + " | ".join(heads) + " |",
        "|---|" + "---:|" * len(columns) + "---|" * (len(heads) - len(columns) - 1),
    ]
    above = ""
    for what in rows:
        here = [found[what, c] for c in columns if (what, c) in found]
        cells = [shown(found.get((what, c)), with_unit=len(units[c]) > 1) for c in columns]
        if goals:
            cells.append(judged(here, shared))
        if several:
            command = here[0].command.removeprefix("python benchmarks/")
            cells.append(f"`{command}`" if command != above else "")
            above = command
        lines.append("| " + " | ".join([what, *cells]) + " |")
    return lines


def head(column: str, figures: list[Figure], units: set[str], *, shared: bool) -> str:
    """Return a column's heading, with unit and goal where all its figures share them."""
    goal = figures[0].goal if shared else None
    words = ", ".join([column or "value", *(u for u in units if u and len(units) == 1)])
    return f"{words} ({bounds(goal)})" if goal else words


def origin(figures: list[Figure]) -> list[str]:
    """Return the line below a table: command, dates, and the machine where it is one."""
    commands = list(dict.fromkeys(f.command for f in figures))
    first = [f"`{commands[0]}`"] if len(commands) == 1 else []
    days = sorted({f.date for f in figures})
    machines = sorted({f.machine for f in figures} - {UNKNOWN})
    last = machines if len(machines) == 1 else []
    return ["; ".join([*first, ", ".join(days), *last]) + ".", ""]


def number(value: float) -> str:
    """Return a number as it is in the file."""
    whole = int(value) if value == int(value) else value
    return (f"{whole:,}" if whole >= 10_000 else f"{whole}").replace("-", "−")


def shown(figure: Figure | None, *, with_unit: bool) -> str:
    """Return a cell."""
    if figure is None:
        return ""
    if figure.value is None:
        return "failed"
    pair = figure.value if isinstance(figure.value, tuple) else (figure.value,)
    text = ("…" if min(pair) < 0 else "–").join(number(v) for v in pair)
    return f"{text} {figure.unit}" if with_unit and figure.unit else text


def bounds(goal: tuple[float | None, float | None]) -> str:
    """Return a goal in words."""
    least, most = goal
    if least is None or most is None:
        return f"≤ {number(most)}" if least is None else f"≥ {number(least)}"
    return f"{number(least)}–{number(most)}"


def judged(figures: list[Figure], shared: dict[str, bool]) -> str:
    """Return whether a row meets its goals, with the goals that its columns' headings do not have."""
    aimed = [f for f in figures if f.goal]
    own = list(dict.fromkeys(bounds(f.goal) for f in aimed if not shared[f.aspect]))
    missed = [f.aspect for f in aimed if not f.met]
    if not missed:
        return " ".join([*own, "met"]) if aimed else ""
    which = ": " + ", ".join(missed) if len(missed) < len(aimed) else ""
    return " ".join([*own, f"**missed**{which}"])


if __name__ == "__main__":
    everything = load()
    (ROOT / "docs/benchmarks.md").write_text(page(everything), encoding="utf-8")
    for path in (ROOT / "README.md", ROOT / "paper/paper.md"):
        text = with_figures(path.read_text(encoding="utf-8"), everything)
        path.write_text(text, encoding="utf-8")
