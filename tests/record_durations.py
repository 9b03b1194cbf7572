"""Durations of all tests: a plugin that takes them, and a script that records them.

    rm -rf FOLDER; DURATIONS=FOLDER PYTHONPATH=tests python -m pytest -p record_durations -n 2 --dist loadfile
    python tests/record_durations.py FOLDER

The script writes tests/durations.json, seconds of the clock of each file, by which conftest.py starts the longest first so that
no process idles at the end (files below a second need no entry), and prints tables: a folder a row, then the longest tests. Their
seconds are those of the processor, of children that have ended too: those of the clock are longer on a machine that others use.
"""

from __future__ import annotations

import json
import os
import re
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

LONGEST = 40


# --- taken


def _spent() -> float:
    times = os.times()
    return times.user + times.system + times.children_user + times.children_system


def _note(item: pytest.Item) -> Iterator[None]:
    before, start = _spent(), time.perf_counter()
    yield
    took = time.perf_counter() - start
    folder = Path(os.environ["DURATIONS"])
    folder.mkdir(parents=True, exist_ok=True)
    slow = item.get_closest_marker("slow") is not None
    row = [item.nodeid, round(_spent() - before, 3), round(took, 3), slow]
    with (folder / f"{os.getpid()}.jsonl").open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_runtest_setup(item: pytest.Item) -> Iterator[None]:
    """Note what its fixtures take."""
    yield from _note(item)


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_runtest_call(item: pytest.Item) -> Iterator[None]:
    """Note what the test takes."""
    yield from _note(item)


@pytest.hookimpl(hookwrapper=True, tryfirst=True)
def pytest_runtest_teardown(item: pytest.Item) -> Iterator[None]:
    """Note what is taken down after it."""
    yield from _note(item)


# --- recorded


def by_folder(name: str) -> str:
    """Return the folder of a test, of the package's doctests ``src``."""
    parts = name.split("::")[0].split("/")
    return (
        "src (doctests)"
        if parts[0] == "src"
        else "/".join(parts[:2] if len(parts) > 2 else parts[:1])
    )


def tables(seconds: dict[bool, Counter[str]]) -> Iterator[str]:
    """Yield the lines of the tables: a folder a row, then the longest tests."""
    yield "| folder | fast tests | s | slow tests | s |"
    yield "|---|--:|--:|--:|--:|"
    counts, sums = (
        {slow: Counter() for slow in seconds},
        {slow: Counter() for slow in seconds},
    )
    for slow, found in seconds.items():
        for name, spent in found.items():
            for key in (by_folder(name), "all"):
                counts[slow][key] += 1
                sums[slow][key] += spent
    folders = sorted({*counts[False], *counts[True]}, key=lambda key: (key == "all", key))
    for key in folders:
        cells = (f"{counts[slow][key]} | {sums[slow][key]:.0f}" for slow in (False, True))
        yield f"| {key} | {' | '.join(cells)} |"
    yield ""
    yield "| s | | test |"
    yield "|--:|---|---|"
    every = {(name, slow): spent for slow in seconds for name, spent in seconds[slow].items()}
    for (name, slow), spent in Counter(every).most_common(LONGEST):
        shown = re.sub(r"\[.*", lambda found: found[0][:40], name.removeprefix("tests/"))
        yield f"| {spent:.1f} | {'slow' if slow else 'fast'} | `{shown}` |"


def main() -> None:
    """Add up what the plugin took, by test and by file."""
    seconds: dict[bool, Counter[str]] = {False: Counter(), True: Counter()}
    files: Counter[str] = Counter()
    for path in sorted(Path(sys.argv[1]).glob("*.jsonl")):
        for line in path.read_text(encoding="utf-8").splitlines():
            name, spent, took, slow = json.loads(line)
            seconds[slow][name] += spent
            files[name.split("::")[0]] += took
    kept = {name: round(spent) for name, spent in files.most_common() if spent >= 1}
    target = Path(__file__).with_name("durations.json")
    target.write_text(json.dumps(kept, indent=0) + "\n", encoding="utf-8")
    print("\n".join(tables(seconds)))


if __name__ == "__main__":
    main()
