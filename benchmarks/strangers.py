"""Different real and simulated paintings offered as one object: none may be accepted.

    python benchmarks/strangers.py [DATABASE …]

Every camera of every object of a database is registered to the reference camera of every other object,
with all bands, as a build would. Photographs of paintings in ../shared/data (or `$LEVKAS_REAL_DATA`) are
registered to one another, colour by colour. Prints what was accepted, and why the rest was not.
"""

from __future__ import annotations

import json
import os
import sys
from collections import Counter
from collections.abc import Iterator
from itertools import permutations
from pathlib import Path

import numpy as np

import levkas
from levkas.quality.evaluation.native_layers import read_native_layer
from levkas.readers.frames import read_frame
from levkas.registration import BandImage, RegistrationRefused, register

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("LEVKAS_REAL_DATA", ROOT.parent / "shared" / "data"))

Pair = tuple[str, list[BandImage], list[BandImage], str]


def of_database(path: Path) -> Iterator[Pair]:
    """Yield (name, reference, target, reference band) of all cameras across objects."""
    database = levkas.open(path)
    for first, second in permutations(list(database), 2):
        record = next((path / "objects" / first / "registration").glob("*.json"))
        reference = json.loads(record.read_text(encoding="utf-8"))["reference"]
        ours = read_native_layer(path, first, reference["camera"], "").images()
        for layer in database[second]:
            camera, setup = layer if isinstance(layer, tuple) else (layer, "")
            theirs = read_native_layer(path, second, camera, setup).images()
            yield f"{first}, {second}/{camera} {setup}".rstrip(), ours, theirs, reference["band"]


def of_photographs() -> Iterator[Pair]:
    """Yield pairs of photographs of different paintings, a quarter of their size and as they are."""
    pictures = {}
    for path in sorted((DATA / "paintings").glob("*.jpg")):
        values = np.asarray(read_frame(path), np.float32)
        pictures[path.stem] = values.reshape(*values.shape[:2], -1)
    for (first, ours), (second, theirs) in permutations(pictures.items(), 2):
        for step in (1, 2):
            a, b = (
                [
                    BandImage.of("RGB"[i], np.ascontiguousarray(v[::step, ::step, i]))
                    for i in range(3)
                ]
                for v in (ours, theirs)
            )
            yield f"{first}, {second} 1:{step}", a, b, "G"


def main(databases: list[str]) -> None:
    """Print a line a pair that was not refused, and what was said of the others."""
    pairs = [pair for path in databases for pair in of_database(Path(path))]
    said: Counter[str] = Counter()
    for name, ours, theirs, band in [*pairs, *of_photographs()]:
        try:
            verdict = register(ours, theirs, reference_band=band).verdict
            decision, why = verdict.decision, verdict.reasons[0]
        except RegistrationRefused as refused:
            decision, why = "refuse", str(refused)
        said[decision] += 1
        print(f"{decision:7s} {name:44s} {why[:110]}", flush=True)
    print(dict(said))


if __name__ == "__main__":
    main(sys.argv[1:])
