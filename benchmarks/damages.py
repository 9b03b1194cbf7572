"""Damage a small database again and again: how many damages `levkas validate` finds, and whom it names.

    python benchmarks/damages.py [COUNT] [CLEAN]

A flipped bit, a zeroed block, a truncation, a swap, a missing and an extra file, each in any file of
the database, the manifest included; then as many checks of the whole one as CLEAN says.
"""

import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from results import record, taken_option

from levkas.core.cube import Band, Cube
from levkas.core.files import write_json, write_text
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.manifest import write_manifest
from levkas.database.store import write_index
from levkas.database.validation import validate

KINDS = ("bit", "block", "cut", "swap", "missing", "extra")
BLOCK = 512


def publish(root):
    """Write a database of two objects by two cameras."""
    entries = []
    for seed, (name, camera, count) in enumerate(
        [("icon1", "vis", 9), ("icon1", "d80", 3), ("icon2", "vis", 9), ("icon2", "d80", 3)]
    ):
        rng = np.random.default_rng(seed)
        values = rng.normal(0.5, 0.2, (60, 80, count)).astype(np.float32)
        flags = rng.integers(0, 128, values.shape, dtype=np.uint8)
        bands = tuple(Band(f"{400 + 40 * i} nm", 400.0 + 40 * i) for i in range(count))
        layer = Layer(name, camera, px_per_mm=2.5)
        entries.append(write_layer(root, layer, Cube(values, flags, 0.01 * values, bands))[0])
        write_json(root / "objects" / name / "registration" / f"{camera}.json", {"seed": seed})
        write_text(root / "objects" / name / "report.html", f"<html>{name}</html>\n")
    for name in ("icon1", "icon2"):
        write_index(root / "zarr" / f"{name}.zarr")
    write_catalogue(root, entries)
    write_manifest(root)


def damaged(kind, path, other, contents, rng):
    """Return what files hold after one damage: path → bytes, None where there is no file then."""
    data = contents[path]
    start = int(rng.integers(len(data)))
    if kind == "bit":
        return {path: data[:start] + bytes([data[start] ^ 1 << start % 8]) + data[start + 1 :]}
    if kind == "block":
        zeroed = data[:start] + bytes(min(BLOCK, len(data) - start)) + data[start + BLOCK :]
        return {path: zeroed} if zeroed != data else {}
    if kind == "cut":
        return {path: data[:start]}
    if kind == "swap":
        return {path: contents[other], other: data} if contents[other] != data else {}
    return {path: None} if kind == "missing" else {path.with_name(f"extra-{path.name}"): data}


def put(contents):
    """Make files hold what they should."""
    for path, data in contents.items():
        path.unlink(missing_ok=True)
        if data is not None:
            path.write_bytes(data)


def main(count, clean, results):
    """Print how many damages of each kind were found, with exactly the damaged files named."""
    rng, started = np.random.default_rng(0), time.perf_counter()
    done, right = Counter(), Counter()
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "db"
        publish(root)
        contents = {p: p.read_bytes() for p in sorted(root.rglob("*")) if p.is_file()}
        files = list(contents)
        while done.total() < count:
            kind = KINDS[done.total() % len(KINDS)]
            path, other = (files[int(i)] for i in rng.integers(len(files), size=2))
            change = damaged(kind, path, other, contents, rng)
            if not change:
                continue
            put(change)
            named = {p.file for p in validate(root).problems}
            put({p: contents.get(p) for p in change})
            done[kind] += 1
            right[kind] += named == {str(p) for p in change}
        alarms = sum(not validate(root).ok for _ in range(clean))
    for kind in KINDS:
        print(f"{kind:8} {done[kind]:6} damages, {right[kind]:6} found and named exactly")
    print(f"{clean} clean checks, {alarms} false alarms; {time.perf_counter() - started:.0f} s")
    figures = {
        f"{count:,} damages: found and named": right.total(),
        f"{clean:,} clean checks: false alarms": alarms,
    }
    record(results, "robustness", figures)


if __name__ == "__main__":
    results = taken_option()
    main(*(int(n) for n in (sys.argv[1:] + ["10000", "1000"][len(sys.argv) - 1 :])[:2]), results)
