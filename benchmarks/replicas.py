"""Another painting by the same pattern, in the same place: never a layer that looks right.

    python benchmarks/replicas.py [--pairs 120] [--first 0]
    python benchmarks/replicas.py --campaigns 2 [--scale 0.2]

Pairs are of `benchmarks/panels.py`: one panel seen twice, and two panels by one pattern, through a stencil or by a free
hand, with strokes, cracks, holes and weave of their own, in visible light, infrared and X-rays. Thresholds were set on
other panels than are drawn here. `--campaigns` simulates campaigns of two icons each: one panel, one pose, one pattern
(halo, garments, folds, border, letters), other colours, strokes, gold and craquelure; every camera of either is registered
to the reference camera of both. Prints the verdict, the correlation of marks, and by class what was decided.
"""

import argparse
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np
from panels import panels
from verdict_classes import judged

from levkas.building import build
from levkas.quality.evaluation.native_layers import read_native_layer
from levkas.registration import RegistrationRefused, register
from levkas.simulation import campaigns

CAMERAS = ("d80", "lctf-nir", "msbs", "v10")
NAMES = ("icon1", "icon2")


class Replicas(campaigns.SimulatedSession):
    """Every object on the first one's panel, laid as it was, painted by its pattern."""

    saints = 1

    def __init__(self, *arguments):
        super().__init__(*arguments)
        for name in self.names[1:]:
            self.panels[name] = self.panels[self.names[0]]
            self.views[name] = self.views[self.names[0]]

    def paint(self, name, index, library, photograph):
        """Paint as many saints on each."""
        return super().paint(name, self.saints - 1, library, photograph)


def simulated(folder: Path, seed: int, scale: float) -> Path:
    """Simulate and build a campaign of copies; return its database."""
    Replicas.saints = 1 + seed % 3
    plain, campaigns.SimulatedSession = campaigns.SimulatedSession, Replicas
    try:
        for _ in campaigns.simulate_campaign(
            folder, seed=seed, preset="small", scale=scale, objects=2
        ):
            pass
    finally:
        campaigns.SimulatedSession = plain
    for _ in build(folder):
        pass
    return folder / "database"


def describe_marks(numbers: dict) -> str:
    """Return the correlation of marks of each sensor."""
    found = [sensor["borne_out"].get("marks") for sensor in numbers.values()]
    return "; ".join(
        f"marks {m['correlation']:.2f}, at most {m['at_most']:.2f}, held {m['held']}"
        if m
        else "no marks"
        for m in found
    )


def of_campaigns(count: int, scale: float) -> None:
    """Print a line a sensor, and what was decided of right pairs and of copies."""
    said = {True: Counter(), False: Counter()}
    for seed in range(1, count + 1):
        with tempfile.TemporaryDirectory() as folder:
            database = simulated(Path(folder) / "campaign", seed, scale)
            images = {
                (name, camera): read_native_layer(database, name, camera, "").images()
                for name in NAMES
                for camera in (*CAMERAS, "lctf-vis")
            }
        for (name, camera), target in images.items():
            for ours in NAMES:
                same = name == ours
                if camera == "lctf-vis" and same:
                    continue
                line = f"seed {seed} {'same' if same else 'copy'} {camera}"
                try:
                    found = register(images[ours, "lctf-vis"], target, reference_band="550 nm")
                except RegistrationRefused as refused:
                    said[same]["refuse"] += 1
                    print(line, "refused", refused)
                    continue
                said[same][found.verdict.decision] += 1
                marks = describe_marks(found.verdict.numbers)
                print(line, found.verdict.decision, marks, flush=True)
    print("same painting:", dict(said[True]), " copies:", dict(said[False]))


def of_pairs(first: int, count: int) -> None:
    """Print a line a pair, and a table by class: accepted, doubtful, refused, and refused or doubted by marks."""
    said: dict[str, Counter] = {}
    for seed in range(first, first + count):
        name, reference, target, truth = panels(seed)
        row = judged(name, reference, target, truth, np.ones(target.shape, bool))
        group = said.setdefault(name, Counter())
        group[row["decision"]] += 1
        group["by marks"] += any("fine marks between them" in reason for reason in row["reasons"])
        marks = describe_marks(row.get("numbers") or {})
        error = f"{row['error']:.2f} px" if "error" in row else ""
        print(f"{seed:4d} {name:20s} {row['decision']:7s} {error} {marks}", flush=True)
    print(f"{'pairs':20s} accepted doubtful refused  by marks")
    for name, group in sorted(said.items()):
        print(f"{name:20s}", *(f"{group[k]:8d}" for k in ("accept", "warn", "refuse", "by marks")))


def main() -> None:
    """Register pairs of panels, or campaigns of icons."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pairs", type=int, default=120)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--campaigns", type=int, default=0)
    parser.add_argument("--scale", type=float, default=0.2)
    arguments = parser.parse_args()
    if arguments.campaigns:
        of_campaigns(arguments.campaigns, arguments.scale)
    else:
        of_pairs(arguments.first, arguments.pairs)


if __name__ == "__main__":
    main()
