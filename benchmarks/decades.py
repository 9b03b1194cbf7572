"""Bias and spread by decade of reflectance, from 0.002 to 1, through whole builds of every kind of camera.

    python benchmarks/decades.py [--seeds N] [KIND …]

The camera, its lamp and its truth are those of tests/promises, which share no line with the package: black level 0 (darks
clipped) and 60, lamp still and sinking by 2 % with whites before and after the object. 480 x 640 px, so that
the mean of a decade is known to some 0.1 %; of several seeds biases are averaged. Of a mosaic a second row has the sensels that measured
a band: what is interpolated between the steep edges of tiles has its own error.
"""

import argparse
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from levkas.building.run import build

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "promises"))
from camera import Habits, outcome_of, tones, write_campaign
from table import Decade, decades

SHAPE = (480, 640)
KINDS = ("bands", "mosaic", "sensors", "cube", "mirror")
CASES = {
    "black 60": {},
    "black 0": {"black": 0.0},
    "black 60, drift 2 %": {"drift": 0.02, "after": 3, "clock": 10.0},
    "black 0, drift 2 %": {"black": 0.0, "drift": 0.02, "after": 3, "clock": 10.0},
}
"""Of scans, whose white comes before them, drift is that of the lamp from its first line to the last of the object."""


RGGB = {(0, 0): 0, (0, 1): 1, (1, 0): 1, (1, 1): 2}
"""Band of the sensels of each phase."""


def masks(kind: str, inner: np.ndarray) -> Iterator[tuple[str, np.ndarray]]:
    """Yield names of rows, and which pixels count: all within tiles, and of a mosaic those of a band's own sensels."""
    yield kind, inner
    if kind == "mosaic":
        own = np.zeros((*inner.shape, 3), bool)
        for (y, x), band in RGGB.items():
            own[y::2, x::2, band] = True
        yield "mosaic, own sensels", own & inner[..., None]


def row(runs: list[list[Decade]]) -> str:
    """Return bias of the worst band of each decade, its standard error, and spreads, of runs that differ in their noise."""
    found = []
    for same in zip(*runs, strict=True):
        bias = float(np.mean([one.bias for one in same]))
        error = float(np.sqrt(np.mean([one.error**2 for one in same]) / len(same)))
        spread = float(np.sqrt(np.mean([one.spread**2 for one in same])))
        found.append(same[0]._replace(bias=bias, error=error, spread=spread))
    lows = sorted({one.low for one in found})
    worst = [
        max((one for one in found if one.low == low), key=lambda one: abs(one.bias)) for low in lows
    ]
    biases = ", ".join(f"{100 * w.bias:+.2f} ± {100 * w.error:.2f}" for w in worst)
    spreads = [one.spread for one in found]
    return f"{biases} | {min(spreads):.3f}–{max(spreads):.3f}"


def main(kinds: list[str], seeds: int) -> None:
    """Print a row for every kind and case."""
    print("| camera | case | bias by decade, worst band, % | spread, least–most | says |")
    print("|---|---|---|---|---|")
    tone, inner = tones(SHAPE)
    for kind in kinds:
        for name, habits in CASES.items():
            runs: dict[str, list[list[Decade]]] = {}
            for seed in range(1, seeds + 1):
                with tempfile.TemporaryDirectory() as folder:
                    chosen = Habits(**habits, seed=seed)
                    made = outcome_of(
                        write_campaign(Path(folder) / "c", kind, chosen, SHAPE), build
                    )
                if made.refused:
                    break
                for label, mask in masks(kind, inner):
                    runs.setdefault(label, []).append(decades(made, tone, mask))
            if made.refused:
                print(f"| {kind} | {name} | refused | – | {made.words} |", flush=True)
                continue
            said = made.words.split("\n", 1)[-1] if "\n" in made.words else ""
            for label, found in runs.items():
                print(f"| {label} | {name} | {row(found)} | {said[:160]} |", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("kinds", nargs="*", default=list(KINDS))
    parser.add_argument("--seeds", type=int, default=1, help="campaigns of each case")
    options = parser.parse_args()
    main(options.kinds, options.seeds)
