"""A full-size campaign: simulated once, built, with its time and the peak of memory.

    python benchmarks/build.py [FOLDER]

FOLDER keeps the simulated campaign (2.4 GB) for the next run; the database beside it is built anew.
"""

import resource
import shutil
import sys
import tempfile
import time
from pathlib import Path

from levkas.building import build
from levkas.quality.evaluation.layer_report import assess
from levkas.simulation import simulate_campaign


def main(folder: Path) -> None:
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
    print(assess(output, truth=folder / "truth").text)


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else Path(tempfile.mkdtemp()) / "full")
