"""Flame graph of a build, drawn from the samples of a profiler.

    py-spy record -F --format raw -o FILE -- python -m levkas build CAMPAIGN
    python benchmarks/flame_graph.py FILE PICTURE

FILE has a line a stack, frames joined by ";", and its count, as py-spy and perf write them. Only functions of Levkas are
drawn; what they call counts as theirs. Threads that wait are left out.
"""

import re
import sys
from collections import Counter
from pathlib import Path

IDLE = ("_worker (", "wait (threading", "select (selectors", "result (concurrent")
LEAST, LETTERS = 0.004, 240
"""Narrower functions are not drawn, share of the whole; letters that fit across."""
ON_THE_WAY = ("run", "executor", "stages", "threads")
"""Modules that only call others."""


def read(path: Path) -> Counter:
    """Return the samples of every stack of Levkas's functions, outermost first."""
    stacks: Counter = Counter()
    for line in path.read_text().splitlines():
        stack, _, count = line.rpartition(" ")
        frames = stack.split(";")
        if any(one in frames[-1] for one in IDLE):
            continue
        ours = [re.search(r"^(\S+).*levkas/(\S+?)\.py", frame) for frame in frames]
        names = [(m[2].rsplit("/", 1)[-1], m[1].rsplit(".", 1)[-1]) for m in ours if m]
        stacks[tuple(one for one in names if one[0] not in ON_THE_WAY)] += int(count)
    stacks.pop((), None)
    return stacks


def draw(stacks: Counter, picture: Path) -> None:
    """Draw a bar a function, as wide as its share of the samples, its callers below it."""
    from matplotlib.figure import Figure

    whole = sum(stacks.values())
    figure = Figure(figsize=(14, 9), layout="constrained")
    axes = figure.subplots()
    places, deepest = [((), 0.0)], 0
    while places:
        stem, left = places.pop()
        depth, parts = len(stem), Counter()
        for stack, count in stacks.items():
            if stack[:depth] == stem and len(stack) > depth:
                parts[stack[depth]] += count / whole
        for name, share in sorted(parts.items(), key=lambda part: -part[1]):
            if share >= LEAST:
                color = f"C{sum(map(ord, name[0])) % 10}"
                axes.barh(depth, share, 0.95, left, color=color, alpha=0.55)
                text = name[1][: int(share * LETTERS)]
                axes.text(left + share / 2, depth, text, ha="center", va="center", fontsize=7)
                places.append(((*stem, name), left))
                deepest = max(deepest, depth)
            left += share
    axes.set(
        xlim=(0, 1),
        ylim=(-0.6, deepest + 0.6),
        yticks=[],
        xlabel="share of the samples of all threads",
    )
    figure.savefig(picture, dpi=100)


if __name__ == "__main__":
    draw(read(Path(sys.argv[1])), Path(sys.argv[2]))
