"""A build of a hundred objects where nothing changed: its seconds, and whether anything was written.

    python benchmarks/second_build.py [FOLDER] [--profile]

FOLDER keeps the campaign and its database for the next run.
"""

import cProfile
import json
import pstats
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from levkas.building import build, status, summarise

OBJECTS = 100
KEYS = """
[campaign]
title = "A hundred plates"
date = 2019-08-29
reference = { camera = "photo", band = "G" }
[cameras.photo]
kind = "image"
files = "photo/{target}.png"
[cameras.infrared]
kind = "image"
files = "infrared/{target}.png"
[targets]
objects = OBJECTS
"""
FRESH = """
import sys, time
from levkas.building import build, status, summarise
start = time.perf_counter()
report = summarise({call}(sys.argv[1])) if {call} is build else status(sys.argv[1])
print(f"{{time.perf_counter() - start:.2f}}")
print(",".join(m for m in ("cv2", "numba", "rawpy", "tifffile", "zarr") if m in sys.modules) or "none")
"""


def make(folder: Path) -> None:
    """Write a photograph and an infrared picture of every plate."""
    names = [f"plate-{number:03d}" for number in range(OBJECTS)]
    for number, name in enumerate(names):
        rng = np.random.default_rng(number)
        big = np.full((400, 480), 90, np.float32)
        for _ in range(150):
            centre = rng.integers(0, [480, 400]).tolist()
            radius, grey = int(rng.integers(4, 40)), float(rng.integers(20, 235))
            cv2.circle(big, centre, radius, grey, -1, cv2.LINE_AA)
        grain = cv2.GaussianBlur(rng.standard_normal(big.shape).astype(np.float32), (0, 0), 2)
        big = np.clip(big + 60 * grain, 5, 250)
        photo = cv2.resize(big, (240, 200), interpolation=cv2.INTER_AREA).astype(np.uint8)
        matrix = np.array([[1.9, 0.04, 6.0], [-0.04, 1.9, 9.0]])
        flags = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
        infrared = cv2.warpAffine(big, matrix, (250, 210), flags=flags, borderValue=5)
        for part, picture in (("photo", np.dstack([photo] * 3)), ("infrared", 255 - infrared)):
            (folder / part).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / part / f"{name}.png"), picture.clip(0, 255).astype(np.uint8))
    (folder / "campaign.toml").write_text(KEYS.replace("OBJECTS", json.dumps(names)))


def standing(folder: Path) -> dict[str, tuple[int, int, int]]:
    """Return inode, size and modification time of the database, of what is kept, and of their folders."""
    found = {}
    for part in ("database", "database.kept"):
        for path in (folder / part, *(folder / part).rglob("*")):
            told = path.stat()
            found[str(path)] = (told.st_ino, told.st_size, told.st_mtime_ns)
    return found


def main(folder: Path, *, profile: bool) -> None:
    if not (folder / "campaign.toml").is_file():
        make(folder)
    start = time.perf_counter()
    report = summarise(build(folder))
    seconds = time.perf_counter() - start
    states = {
        s: sum(step.state == s for step in report.stages) for s in ("done", "fresh", "refused")
    }
    files = sum(p.is_file() for p in (folder / "database").rglob("*"))
    print(f"first build {seconds:.0f} s, {states}, {files} files")
    before = standing(folder)
    for call in ("build", "status"):
        command = [sys.executable, "-c", FRESH.format(call=call), str(folder)]
        told = subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
        print(f"{call} where all is fresh: {told[0]} s after imports; heavy modules: {told[1]}")
    after = standing(folder)
    changed = [p for p in before.keys() | after.keys() if before.get(p) != after.get(p)]
    print(f"written by these two: {', '.join(sorted(changed)[:5]) or 'nothing'}")
    if profile:
        for name, call in (
            ("build", lambda: summarise(build(folder))),
            ("status", lambda: status(folder)),
        ):
            with cProfile.Profile() as profiler:
                call()
            print(f"-- {name}")
            pstats.Stats(profiler).sort_stats("cumulative").print_stats(30)


if __name__ == "__main__":
    places = [a for a in sys.argv[1:] if not a.startswith("-")]
    where = Path(places[0]) if places else Path(tempfile.mkdtemp()) / "plates"
    main(where, profile="--profile" in sys.argv)
