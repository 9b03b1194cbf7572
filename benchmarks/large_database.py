"""A campaign of many objects whose build is finished: status, a build with nothing to do, opening.

    python benchmarks/large_database.py [OBJECTS] [--in FOLDER]

No pixel is computed: small frames, empty products, and records as a build keeps them. The hashes of
frames and products are real, so that all of it is fresh; the first `levkas build` writes the catalogue.
A finished FOLDER is measured again.
"""

import argparse
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from levkas.core.instructions import hold_instructions

hold_instructions()  # as the command line does, whose builds are measured: before NumPy is loaded

import cv2  # noqa: E402
import numpy as np  # noqa: E402

from levkas.building import fingerprints  # noqa: E402
from levkas.building.build_records import BuildRecords, Key  # noqa: E402
from levkas.building.claiming import claim  # noqa: E402
from levkas.building.fingerprints import Inputs  # noqa: E402
from levkas.building.plan import read_plan  # noqa: E402
from levkas.database.layout import Places  # noqa: E402

CAMPAIGN = """
[campaign]
title = "Large"
date = 2019-08-29
reference = { camera = "photo", band = "grey" }
[cameras.photo]
kind = "image"
files = "photo/{target}.png"
[cameras.xray]
kind = "image"
files = "xray/{target}.png"
"""
CAMERAS = ("photo", "xray")
FILES = 10
"""Products of a stage; 61 of an object of two cameras, with its page, beside seven records and two frames."""


def make(root: Path) -> None:
    """Write products and records of a build."""
    plan = read_plan(root)
    places = Places(plan.campaign.output)
    claim(plan.campaign, places, plan.captures, plan.names)
    records = BuildRecords(places.kept, places.output)
    inputs = Inputs(plan.campaign, records)
    layers: dict[str, str] = {}
    for task in plan.graph.values():
        key = task.key
        if task.capture is not None:
            _keep(places, records, key, inputs.of(task, {}), FILES)
            layers[f"{key.layer} {key.stage}"] = inputs.digests[key]
        elif key.stage == "report":
            captures = [one for one in plan.captures if one.object == key.object]
            prints = fingerprints.of_report(
                plan.campaign, key.object, layers, captures, records.hashes
            )
            _keep(places, records, key, prints, 1)
            layers = {}


def _keep(
    places: Places, records: BuildRecords, key: Key, prints: dict[str, object], count: int
) -> None:
    """Write the products of a stage and its record."""
    folder = places.folder(key.object) / f"{key.layer}_{key.stage}".strip("_")
    folder.mkdir(parents=True)
    made = [folder / f"{number}.bin" for number in range(count)]
    for path in made:
        path.touch()
    row = [key.object, key.camera, key.setup, 1, 8, 8, "", "counts", "accept", "0" * 64]
    notes = {"entry": [str(cell) for cell in row]} if key.stage == "resample" else {}
    records.keep(key, prints, made, **notes)


def write_frames(root: Path, count: int) -> None:
    """Write campaign.toml and two small pictures an object."""
    picture = cv2.imencode(".png", np.full((8, 8), 100, np.uint8))[1].tobytes()
    (root / "campaign.toml").write_text(CAMPAIGN)
    for camera in CAMERAS:
        (root / camera).mkdir()
        for number in range(count):
            (root / camera / f"o{number:06d}.png").write_bytes(picture)
    time.sleep(2.5)  # until their stamps are settled


CLI = "import sys; from levkas.cli import main; sys.argv = ['levkas', *{arguments!r}]; main()"
OPEN = "import levkas; db = levkas.open({root!r} + '/database'); list(db[next(iter(db))])"


def measure(what: str, code: str) -> None:
    """Print a row: seconds on the clock, of the processor, and the peak of resident memory, imports included."""
    before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    code = f"try:\n  {code}\nexcept SystemExit: pass\n"
    code += "print(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
    run = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True)
    seconds = time.perf_counter() - started
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    lines = run.stdout.splitlines()
    print(f"| {what} | {seconds:.1f} | {cpu:.1f} | {int(lines[-1]) / 1024:.0f} |", flush=True)
    states = [line for line in lines[:-1] if " fresh" in line or " stale" in line]
    print("\n".join(states[-3:]), file=sys.stderr, flush=True)


def measure_all(root: Path) -> None:
    """Print the table."""

    def command(*arguments: str) -> str:
        return CLI.format(arguments=[*arguments, str(root)])

    print("| what | s | CPU s | MB |\n|---|---:|---:|---:|")
    if not (root / "database" / "catalogue.csv").is_file():
        measure("`levkas build`, which writes the catalogue", command("build"))
    measure("`levkas status`", command("status"))
    measure("`levkas build`, nothing to do", command("build"))
    measure("`levkas.open`, the layers of one object", OPEN.format(root=str(root)))
    frame = root / "photo" / "o000017.png"
    data = frame.read_bytes()
    frame.write_bytes(data)
    measure("`levkas status`, one frame touched", command("status"))
    measure("`levkas build`, one frame touched", command("build"))


def main() -> None:
    """Make, measure, and remove what was made."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("objects", type=int, nargs="?", default=500)
    parser.add_argument("--in", dest="folder", type=Path)
    options = parser.parse_args()
    root = options.folder or Path(tempfile.mkdtemp())
    try:
        if not (root / "campaign.toml").is_file():
            write_frames(root, options.objects)
            make(root)
        measure_all(root)
    finally:
        if options.folder is None:
            shutil.rmtree(root)


if __name__ == "__main__":
    main()
