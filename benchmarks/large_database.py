"""A campaign of many objects whose build is finished: status, a build with nothing to do, opening.

    python benchmarks/large_database.py [OBJECTS]

No pixel is computed: small frames, made-up products, and records as a build keeps them. The hashes of
the frames and products are real, so that all of it is fresh.
"""

import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import cv2
import numpy as np

from levkas.building import sources
from levkas.building.build_records import BuildRecords
from levkas.building.catalogue import write_catalogue_of
from levkas.building.claiming import claim
from levkas.building.fingerprints import Inputs
from levkas.building.plan import read_plan
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
FILES = 10
"""Products of a stage; 63 of an object of two cameras."""


def make(root: Path, count: int) -> None:
    """Write frames, products and records of a finished build, but for the pages."""
    picture = cv2.imencode(".png", np.full((8, 8), 100, np.uint8))[1].tobytes()
    (root / "campaign.toml").write_text(CAMPAIGN)
    for camera in ("photo", "xray"):
        (root / camera).mkdir()
        for number in range(count):
            (root / camera / f"o{number:06d}.png").write_bytes(picture)
    time.sleep(0.2)  # until their stamps are settled
    plan = read_plan(root)
    places = Places(plan.campaign.output)
    claim(plan.campaign, places, plan.captures, plan.names)
    sources.remember(places.kept / sources.CODE)
    records = BuildRecords(places.kept, places.output)
    inputs = Inputs(plan.campaign, records)
    for task in plan.graph.values():
        if task.capture is None:
            continue
        key = task.key
        folder = places.folder(key.object) / f"{key.layer}_{key.stage}"
        folder.mkdir(parents=True)
        made = [folder / f"{number}.bin" for number in range(FILES)]
        for path in made:
            path.write_bytes(b"x")
        row = [key.object, key.camera, key.setup, 1, 8, 8, "", "counts", "accept", "0" * 64]
        notes = {"entry": [str(cell) for cell in row]} if key.stage == "resample" else {}
        records.keep(key, inputs.of(task, {}), made, **notes)
    write_catalogue_of(plan.campaign, places, records, plan.captures, plan.names)
    records.hashes.save()
    sources.keep(places.kept / sources.CODE)


WORK = {
    "plan": "from levkas.building.plan import read_plan; read_plan({root!r})",
    "status": "from levkas.building import status; status({root!r})",
    "open": "import levkas; levkas.open({root!r} + '/database')",
}


def main() -> None:
    """Print the table."""
    count = int(sys.argv[1]) if len(sys.argv) > 1 else 500
    root = Path(tempfile.mkdtemp())
    try:
        make(root, count)
        files = sum(p.is_file() for p in root.rglob("*"))
        print(f"{count} objects, {files} files\n\n| what | s | CPU s | MB |\n|---|---:|---:|---:|")
        for what, code in WORK.items():
            before, started = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
            code += "; print(open('/proc/self/status').read().split('VmHWM:')[1].split()[0])"
            command = [sys.executable, "-c", code.format(root=str(root))]
            run = subprocess.run(command, check=True, capture_output=True, text=True)
            seconds = time.perf_counter() - started
            after = resource.getrusage(resource.RUSAGE_CHILDREN)
            cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
            print(f"| {what} | {seconds:.1f} | {cpu:.1f} | {int(run.stdout) / 1024:.0f} |")
    finally:
        shutil.rmtree(root)


if __name__ == "__main__":
    main()
