"""What `levkas publish` takes: time of every part, and how large what it writes is.

    python benchmarks/publishing.py DATABASE [--folder FOLDER]

Publishes a database, or a campaign's, elsewhere, with both editions, tiles, pages and a bag, and writes a
table in Markdown to standard output: seconds on the clock, seconds of the processor, and megabytes. The first
run, of all, also loads and compiles what is needed; a second one is of the full edition without tiles.
"""

from __future__ import annotations

import argparse
import shutil
import tempfile
import time
from pathlib import Path

from levkas.publish.bagging import write_bag
from levkas.publish.run import facts_of_subject, find_subject, publish

FOLDERS = {"medium": "medium", "colour": "colour", "iiif": "iiif", "viewer": "viewer"}
"""Part → the folder that it fills."""
END = {"publication": "reading all of it again"}


def weigh(folder: Path) -> tuple[int, float]:
    """Return how many files a folder holds, and how many MB."""
    sizes = [p.stat().st_size for p in folder.rglob("*") if p.is_file()]
    return len(sizes), sum(sizes) / 1e6


def take(database: Path, **options: object) -> dict[str, tuple[float, float]]:
    """Publish, and return the seconds of every part, on the clock and of the processor."""
    taken: dict[str, tuple[float, float]] = {}
    clock, work = time.perf_counter(), time.process_time()
    for step in publish(database, **options):  # type: ignore[arg-type]
        now, done = time.perf_counter(), time.process_time()
        before = taken.get(step.part, (0.0, 0.0))
        taken[step.part] = (before[0] + now - clock, before[1] + done - work)
        clock, work = now, done
    return taken


def row(name: str, times: tuple[float, float], size: tuple[int, float] | None = None) -> str:
    """Return a row of the table."""
    files, megabytes = (f"{size[0]:,}", f"{size[1]:.1f}") if size else ("", "")
    return f"| {name} | {times[0]:.1f} | {times[1]:.1f} | {files} | {megabytes} |"


def total(taken: dict[str, tuple[float, float]]) -> tuple[float, float]:
    """Return the sum of all parts."""
    clock, work = zip(*taken.values(), strict=True)
    return sum(clock), sum(work)


def main() -> None:
    """Print the table."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("database", type=Path)
    options.add_argument("--folder", type=Path)
    chosen = options.parse_args()
    folder = Path(tempfile.mkdtemp(prefix="levkas-bench-", dir=chosen.folder))
    try:
        database = chosen.database
        bare, out, bag = folder / "bare", folder / "published", folder / "bag"
        taken = take(database, output=out)
        little = take(database, output=bare, editions="full", iiif=False)
        clock, work = time.perf_counter(), time.process_time()
        for _ in write_bag(out, bag, facts_of_subject(find_subject(database))):
            pass
        packed = time.perf_counter() - clock, time.process_time() - work
        print("| part | s | processor, s | files | MB |\n|---|---:|---:|---:|---:|")
        print(row("the database itself", (0.0, 0.0), weigh(find_subject(database).database)))
        for name, times in taken.items():
            size = weigh(out / FOLDERS[name]) if name in FOLDERS else None
            print(row(END.get(name, name), times, size))
        print(row("**all**", total(taken), weigh(out)))
        print(row("full edition alone, no tiles", total(little), weigh(bare)))
        print(row("a bag of all", packed, weigh(bag)))
    finally:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
