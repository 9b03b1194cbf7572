"""Bias and spread by decade of reflectance, from 0.002 to 1, through whole builds of every kind of camera.

    python benchmarks/decades.py [KIND …]

The camera, its lamp and its truth are those of tests/promises, which share no line with the package: black level 0 (darks
clipped) and 60, lamp still and sinking by 2 % with whites before and after the object. 480 x 640 px, so that
the mean of a decade is known to some 0.1 %.
"""

import sys
import tempfile
from pathlib import Path

from levkas.building.run import build

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "promises"))
from camera import Habits, outcome_of, tones, write_campaign
from table import decades

SHAPE = (480, 640)
KINDS = ("bands", "mosaic", "sensors", "cube", "mirror")
CASES = {
    "black 60": {},
    "black 0": {"black": 0.0},
    "black 60, drift 2 %": {"drift": 0.02, "after": 3, "clock": 10.0},
    "black 0, drift 2 %": {"black": 0.0, "drift": 0.02, "after": 3, "clock": 10.0},
}
"""Of scans, whose white comes before them, drift is that of the lamp from its first line to the last of the object."""


def main(kinds: list[str]) -> None:
    """Print a row for every kind and case."""
    print("| camera | case | bias by decade, worst band, % | spread, least–most | says |")
    print("|---|---|---|---|---|")
    tone, inner = tones(SHAPE)
    for kind in kinds:
        for name, habits in CASES.items():
            with tempfile.TemporaryDirectory() as folder:
                campaign = write_campaign(Path(folder) / "c", kind, Habits(**habits), SHAPE)
                made = outcome_of(campaign, build)
            if made.refused:
                print(f"| {kind} | {name} | refused | – | {made.words} |", flush=True)
                continue
            found = decades(made, tone, inner)
            lows = sorted({one.low for one in found})
            worst = [
                max((one for one in found if one.low == low), key=lambda one: abs(one.bias))
                for low in lows
            ]
            biases = ", ".join(f"{100 * w.bias:+.2f} ± {100 * w.error:.2f}" for w in worst)
            spreads = [one.spread for one in found]
            said = made.words.split("\n", 1)[-1] if "\n" in made.words else ""
            print(
                f"| {kind} | {name} | {biases} | {min(spreads):.3f}–{max(spreads):.3f} | {said[:160]} |",
                flush=True,
            )


if __name__ == "__main__":
    main(sys.argv[1:] or list(KINDS))
