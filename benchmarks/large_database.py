"""A campaign of many objects whose build is finished: status, a build with nothing to do, opening, the index made again.

    python benchmarks/large_database.py [OBJECTS] [--full | --index [--flat]] [--in FOLDER]

No pixel is computed: small frames, empty products, and records as a build keeps them. The hashes of
frames and products are real, so that all of it is fresh; the first `levkas build` writes the catalogue and the
index. `--full` also compares every stage, with and without a frame that was changed. A finished FOLDER is measured again.

`--index` is for 100,000 objects: real frames, a real catalogue, the folders of a database and of its records with an empty file in
the lowest, and the index of a build of them; `--flat` leaves out those of Zarr, nine tenths. What reads the index alone sees no difference.
"""

import argparse
import math
import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from collections import Counter
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np

from levkas.building import build_records, fingerprints, sources
from levkas.building.build_index import INDEX, StageCounts, read_inputs, write_index
from levkas.building.build_records import BuildRecords, Key
from levkas.building.claiming import claim
from levkas.building.fingerprints import Inputs
from levkas.building.plan import Plan, read_plan
from levkas.campaign.campaign import load_campaign
from levkas.core.json_safe import to_json
from levkas.database.catalogue import Entry, write_catalogue
from levkas.database.layout import Places

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
ARRAYS = ("values/c/0/0", "flags/c/0/0", "band/c", "wavelength/c", "fwhm/c")
FILES = 10
"""Products of a stage; 61 of an object of two cameras, with its page, beside seven records and two frames."""


def make(root: Path) -> None:
    """Write products and records of a build."""
    plan = read_plan(root)
    places = Places(plan.campaign.output)
    claim(plan.campaign, places, plan.captures, plan.names)
    sources.remember(places.kept / sources.CODE)
    # Without a sync a record: 700,000 of them.
    build_records.write_json = lambda path, record: path.write_text(to_json(record))
    records = BuildRecords(places.kept, places.output)
    save, records.hashes.save = records.hashes.save, lambda: None
    inputs = Inputs(plan.campaign, records)
    layers: dict[str, str] = {}
    done = 0
    for task in plan.graph.values():
        key = task.key
        if task.capture is not None:
            _keep(places, records, key, inputs.of(task, {}), FILES)
            layers[f"{key.layer} {key.stage}"] = inputs.digests[key]
        elif key.stage == "report":
            prints = fingerprints.of_report(
                plan.campaign, key.object, layers, plan.layers[key.object]
            )
            _keep(places, records, key, prints, 1)
            layers, done = {}, done + 1
            if done % 1000 == 0:
                save()
    save()
    sources.keep(places.kept / sources.CODE)


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


def make_index(root: Path, *, flat: bool) -> None:
    """Write catalogue and folders, and the index that a build of them would end with."""
    started = time.time_ns()
    campaign = load_campaign(root)
    places = Places(campaign.output)
    plan = Plan(campaign, [], {}, {}, {}, tuple(str(root / camera) for camera in CAMERAS))
    before = read_inputs(plan, places, started)
    names = sorted(path.stem for path in (root / CAMERAS[0]).iterdir())
    claim(campaign, places, [], names)
    for name in names:
        make_folders(places, name, flat=flat)
    row = ("", 1, 8, 8, math.nan, "counts", "accept", "0" * 64)
    write_catalogue(places.output, [Entry(n, camera, *row) for n in names for camera in CAMERAS])
    counts = StageCounts(frozenset(), states=Counter(fresh=7 * len(names) + 1))
    write_index(plan, places, before, counts, writes=True)


def make_folders(places: Places, name: str, *, flat: bool) -> None:
    """Make the folders of an object of two cameras, as many as a build does unless they are to be few."""
    layers = [] if flat else [f"zarr/{name}.zarr/{camera}" for camera in CAMERAS]
    arrays = [f"{layer}/{array}" for layer in layers for array in ARRAYS]
    folders = [f"objects/{name}", *([] if flat else [f"objects/{name}/registration"]), *arrays]
    made = [f"{places.output}/{folder}" for folder in folders]
    for path in (*made, *(f"{places.kept}/{name}/{camera}" for camera in CAMERAS)):
        with suppress(FileExistsError):
            os.makedirs(path)  # noqa: PTH103 -- millions
            os.close(os.open(f"{path}/0", os.O_CREAT | os.O_WRONLY))


def write_frames(root: Path, count: int) -> None:
    """Write campaign.toml and two small pictures an object."""
    picture = cv2.imencode(".png", np.full((8, 8), 100, np.uint8))[1].tobytes()
    (root / "campaign.toml").write_text(CAMPAIGN)
    for camera in CAMERAS:
        (root / camera).mkdir()
        for number in range(count):
            (root / camera / f"o{number:06d}.png").write_bytes(picture)
    time.sleep(2.5)  # until their stamps are settled


CLI = "from levkas.cli import app; app({arguments!r}, standalone_mode=False)"
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
    told = [line for line in lines[:-1] if " fresh" in line or " stale" in line]
    print("\n".join(told[-3:]), file=sys.stderr, flush=True)


def measure_all(root: Path, *, full: bool) -> None:
    """Print the table."""

    def command(*arguments: str) -> str:
        return CLI.format(arguments=[*arguments, str(root)])

    index = root / "database.kept" / INDEX
    print("| what | s | CPU s | MB |\n|---|---:|---:|---:|")
    if not index.is_file():
        measure("`levkas build`, which writes catalogue and index", command("build"))
    measure("`levkas status`", command("status"))
    measure("`levkas build`, nothing to do", command("build"))
    measure("`levkas.open`, the layers of one object", OPEN.format(root=str(root)))
    frame = root / "photo" / "o000017.png"
    data = frame.read_bytes()
    frame.write_bytes(data)
    measure("`levkas status`, one frame touched", command("status"))
    if full:
        measure("`levkas build`, one frame touched", command("build"))
        measure("`levkas status --full`", command("status", "--full"))
        index.unlink()
        measure("`levkas status`, the index missing", command("status"))


def main() -> None:
    """Make, measure, and remove what was made."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("objects", type=int, nargs="?", default=500)
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--index", action="store_true")
    parser.add_argument("--flat", action="store_true")
    parser.add_argument("--in", dest="folder", type=Path)
    told = parser.parse_args()
    root = told.folder or Path(tempfile.mkdtemp())
    try:
        if not (root / "campaign.toml").is_file():
            write_frames(root, told.objects)
            make_index(root, flat=told.flat) if told.index else make(root)
        measure_all(root, full=told.full)
    finally:
        if told.folder is None:
            shutil.rmtree(root)


if __name__ == "__main__":
    main()
