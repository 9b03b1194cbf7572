"""Another painting by the same pattern, on the same panel, in the same place: never a layer that looks right.

    python benchmarks/replicas.py [--seeds 2] [--scale 0.2]

Simulates campaigns of two icons each: one panel, one pose, one pattern (halo, garments, folds, border, letters),
other colours, strokes, gold and craquelure. Every camera of either is registered to the reference camera of both.
Prints the verdict, the share of detail that the reference lacks (`strange`), the windows that are recognised.
"""

import argparse
import tempfile
from collections import Counter
from pathlib import Path

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


def main() -> None:
    """Print a line a sensor, and what was decided of right pairs and of copies."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--scale", type=float, default=0.2)
    arguments = parser.parse_args()
    said = {True: Counter(), False: Counter()}
    for seed in range(1, arguments.seeds + 1):
        with tempfile.TemporaryDirectory() as folder:
            database = simulated(Path(folder) / "campaign", seed, arguments.scale)
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
                told = [
                    f"{sensor} {n['borne_out']['strange']:.2f} of {n['borne_out']['found']}/{n['borne_out']['windows']}"
                    for sensor, n in found.verdict.numbers.items()
                ]
                print(line, found.verdict.decision, *told, flush=True)
    print("same painting:", dict(said[True]), " copies:", dict(said[False]))


if __name__ == "__main__":
    main()
