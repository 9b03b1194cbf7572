"""A full-size campaign: simulated once, built, with its time and the peak of memory.

    python benchmarks/build.py [FOLDER] [--results FILE]

FOLDER keeps the simulated campaign (2.4 GB) for the next run; the database beside it is built anew.
"""

import resource
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from results import record, taken_option

from levkas.building import build
from levkas.quality.evaluation.layer_report import assess
from levkas.simulation import simulate_campaign


def main(folder: Path, results: Path | None) -> None:
    if not (folder / "campaign.toml").is_file():
        for _ in simulate_campaign(folder, preset="full"):
            pass
    output = folder.with_name(folder.name + ".database")
    for path in (output, output.with_name(output.name + ".kept")):
        shutil.rmtree(path, ignore_errors=True)
    raw = sum(p.stat().st_size for p in (folder / "raw").rglob("*") if p.is_file())
    start = time.perf_counter()
    for step in build(folder, output=output):
        if step.state in ("refused", "failed"):
            print(step.line)
    total = time.perf_counter() - start
    usage = resource.getrusage(resource.RUSAGE_SELF)
    print(
        f"raw {raw / 1e9:.2f} GB, total {total:.0f} s, {usage.ru_utime + usage.ru_stime:.0f} s of CPU, ",
        end="",
    )
    print(f"peak {usage.ru_maxrss / 1e6:.2f} GB")
    found = assess(output, truth=folder / "truth")
    print(found.text)
    record(results, "build", {"time": total, "memory, peak": usage.ru_maxrss / 1e6})
    record(results, "full-size", dict(errors(found.results)))


def errors(layers: list[dict]) -> Iterator[tuple[tuple[str, str], float]]:
    """Yield mean over all bands and largest error of any point of every camera, reference px."""
    for layer in layers:
        bands = [b for b in layer["bands"] if b["error_mean"] is not None]
        if bands:
            camera = layer["layer"].rpartition("/")[2]
            yield (camera, "mean"), float(np.mean([b["error_mean"] for b in bands]))
            yield (camera, "largest"), max(b["error_max"] for b in bands)


if __name__ == "__main__":
    results = taken_option()
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()) / "full", results)
