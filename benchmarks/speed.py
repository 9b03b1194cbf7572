"""Time of builds, starts, `look` and registrations beside the code before, in turns in one run, and where a build's time goes.

    python benchmarks/speed.py [FOLDER] [--before COMMIT] [--preset small] [--rounds 2] [--files 20000] [--pairs 8]
    python benchmarks/speed.py FOLDER --full [--results FILE]

FOLDER keeps the simulated campaign, the band files that `look` reads and the sources of COMMIT (default: the last but one) for the
next run. Both codes are measured in turns, each from an empty database; the least of the rounds counts, as nothing makes a
program faster than it is; the first one compiles. Where time goes is sampled every 10 ms over threads that do not wait, by the package whose code,
or library on its behalf, runs. The floor is to read every raw frame and to write every published layer once.
Ten minutes with the preset `small`; compare times within a run only. `--full` builds a full-size campaign (2.4 GB, simulated into FOLDER
where it is not there yet) once, with its time, the peak of memory and its errors.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from pathlib import Path

import numpy as np
from results import add_option, record
from unchanged import HERE, levkas, unpack

WAITING = ("threading.py", "queue.py", "selectors.py", "thread.py", "_base.py", "subprocess.py")
"""Files in which a thread waits for others."""
EVERY_S, LEAST_SHARE = 0.01, 0.01
KINDS = ("values", "flags", "sigma")


# --- in a process of the code that is measured


class Sampler(threading.Thread):
    """Counts packages of Levkas whose code runs, in all threads that do not wait."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.packages: Counter[str] = Counter()
        self._ended = threading.Event()

    def run(self) -> None:
        while not self._ended.wait(EVERY_S):
            for number, frame in sys._current_frames().items():
                if number != self.ident and Path(frame.f_code.co_filename).name not in WAITING:
                    self.packages[package_of(frame)] += 1

    def end(self) -> None:
        self._ended.set()


def package_of(frame) -> str:
    """Return the package of the innermost function of Levkas, ``other`` where there is none."""
    while frame is not None:
        _, found, inside = frame.f_code.co_filename.rpartition("/levkas/")
        if found and "/" in inside:
            return inside.partition("/")[0]
        frame = frame.f_back
    return "other"


def measure_build(campaign: Path, output: Path) -> dict:
    """Build anew; return seconds, processor seconds, memory, bytes written and shares of packages."""
    from levkas.building import build

    sampler, start = Sampler(), time.perf_counter()
    sampler.start()
    for _ in build(campaign, output=output):
        pass
    seconds = time.perf_counter() - start
    sampler.end()
    used, all_samples = resource.getrusage(resource.RUSAGE_SELF), sampler.packages.total()
    return {
        "build, time": seconds,
        "build, CPU": used.ru_utime + used.ru_stime,
        "build, memory": used.ru_maxrss / 1e6,
        "build, written": sum(p.stat().st_size for p in output.rglob("*") if p.is_file()) / 1e6,
        "packages": {name: n / all_samples for name, n in sampler.packages.items()},
    }


def measure_pairs(count: int) -> dict:
    """Return seconds of the clock to accept a right pair and to refuse an impostor, medians of those so decided."""
    from verdict import Studio, impostor, judged, right_pair

    studio, times = Studio(1), {"accept": [], "refuse": []}
    for number in range(count):
        for kind, make in enumerate((right_pair, impostor)):
            pair = make(studio, np.random.default_rng([1, kind, number]), number)
            if not number:
                judged(*pair)  # compiles
            row = judged(*pair)
            right = row["decision"] != "refuse"
            if right == row["true"]:
                times["accept" if right else "refuse"].append(row["seconds"])
    return {f"pair, {end}": float(np.median(some)) for end, some in times.items() if some}


def measure_command(*arguments: str | Path) -> float:
    """Return processor seconds of a command."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    code = "from levkas.cli import main; main()"
    command = [sys.executable, "-c", code, *map(str, arguments)]
    subprocess.run(command, check=True, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def measure_floor(campaign: Path, output: Path, room: Path) -> float:
    """Return the seconds that reading all raw frames and writing all published layers once take."""
    import levkas as package
    from levkas.core.cube import Cube
    from levkas.database.described import open_tiff
    from levkas.database.layers import Layer, write_layer
    from levkas.readers.frames import read_frame

    start = time.perf_counter()
    for path in sorted((campaign / "raw").rglob("*")):
        if path.suffix.lower() in (".tif", ".hdr"):
            read_frame(path)
    seconds = time.perf_counter() - start
    for name, painting in package.open(output).items():
        for camera, setup in painting.layers:
            arrays = painting.dataset(camera, setup).load()
            stem = "_".join(filter(None, (name, camera, setup)))
            described = open_tiff(output / "objects" / name / f"{stem}.tif")
            found = [arrays[kind].values if kind in arrays else None for kind in KINDS]
            cube = Cube(*found, described.bands, described.quantity)
            start = time.perf_counter()
            write_layer(room, Layer(name, camera, setup), cube)
            seconds += time.perf_counter() - start
    return seconds


def measure(folder: Path, pairs: int) -> dict:
    """Return all figures of the code at hand."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        campaign, output = folder / "campaign", Path(place) / "database"
        found = measure_build(campaign, output)
        found |= {
            "--help, CPU": min(measure_command("--help") for _ in range(3)),
            "status, CPU": measure_command("status", campaign, "-o", output),
            "look, CPU": measure_command("look", folder / "bands"),
            "floor": measure_floor(campaign, output, Path(place) / "written"),
        }
    return found | (measure_pairs(pairs) if pairs else {})


# --- what is measured, and what cannot be spared


def write_bands(folder: Path, count: int) -> None:
    """Write small frames of 32 bands: a dark, a white, and panels, each in a folder of its own."""
    import tifffile

    rng = np.random.default_rng(0)
    scene = rng.integers(200, 3200, (64, 80))
    for number in range(count):
        target = ["dark", "white"][number // 32] if number < 64 else f"panel{number // 32:03d}"
        codes = {"dark": scene // 20, "white": np.full_like(scene, 3500)}.get(target, scene)
        path = folder / target / f"{target}_{400 + 10 * (number % 32)}nm.tif"
        path.parent.mkdir(parents=True, exist_ok=True)
        noisy = codes + rng.integers(0, 20, codes.shape)
        tifffile.imwrite(path, noisy.astype(np.uint16))


def measured_by(code: Path, folder: Path, pairs: int) -> dict:
    """Return what a process that imports `code` measures."""
    with tempfile.NamedTemporaryFile(suffix=".json") as result:
        command = [sys.executable, __file__, str(folder), "--measure", result.name]
        where = {**os.environ, "PYTHONPATH": str(code)}
        where.pop("PYTHONDONTWRITEBYTECODE", None)  # a program that starts compiles once
        subprocess.run([*command, "--pairs", str(pairs)], env=where, check=True)
        return json.loads(Path(result.name).read_text())


def least(rounds: list[dict]) -> dict:
    """Return the least of each figure, and the mean share of each package."""
    names = {name for one in rounds for name in one["packages"]}
    shares = {n: float(np.mean([one["packages"].get(n, 0) for one in rounds])) for n in names}
    numbers = {n: min(one[n] for one in rounds if n in one) for n in rounds[0] if n != "packages"}
    return {**numbers, "packages": shares}


def tell(before: dict, after: dict) -> None:
    """Print both, their ratios, and where time goes."""
    print(f"{'':20s} {'before':>9s} {'now':>9s} {'ratio':>6s}")
    for name in (n for n in after if n != "packages"):
        ratio = before[name] / after[name]
        print(f"{name:20s} {before[name]:9.2f} {after[name]:9.2f} {ratio:6.2f}")
    print(f"\nprocessor seconds of the build\n{'package':20s} {'before':>9s} {'now':>9s}")
    for name, share in sorted(after["packages"].items(), key=lambda item: -item[1]):
        parts = [one["packages"].get(name, 0) * one["build, CPU"] for one in (before, after)]
        if share >= LEAST_SHARE:
            print(f"{name:20s} {parts[0]:9.1f} {parts[1]:9.1f}")
    over = after["build, time"] / after["floor"]
    print(f"\nthe build takes {over:.1f} times the floor")


def build_full(folder: Path, results: Path | None) -> None:
    """Build a full-size campaign; print and record time, memory, and errors of every camera in reference px."""
    import shutil

    from levkas.building import build
    from levkas.quality.evaluation.layer_report import assess
    from levkas.simulation import simulate_campaign

    if not (folder / "campaign.toml").is_file():
        for _ in simulate_campaign(folder, preset="full"):
            pass
    output = folder.with_name(folder.name + ".database")
    for path in (output, output.with_name(output.name + ".kept")):
        shutil.rmtree(path, ignore_errors=True)
    start = time.perf_counter()
    for step in build(folder, output=output):
        if step.state in ("refused", "failed"):
            print(step.line)
    total, usage = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_SELF)
    memory = usage.ru_maxrss / 1e6
    print(f"{total:.0f} s, {usage.ru_utime + usage.ru_stime:.0f} s of CPU, peak {memory:.2f} GB")
    found = assess(output, truth=folder / "truth")
    print(found.text)
    record(results, "build", {"time": total, "memory, peak": memory})
    errors = {}
    for layer in found.results:
        bands = [b for b in layer["bands"] if b["error_mean"] is not None]
        if bands:
            camera = layer["layer"].rpartition("/")[2]
            errors[camera, "mean"] = float(np.mean([b["error_mean"] for b in bands]))
            errors[camera, "largest"] = max(b["error_max"] for b in bands)
    record(results, "full-size", errors)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--before", default="HEAD~1", help="commit whose code is compared")
    parser.add_argument("--preset", default="small", help="of levkas simulate")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--files", type=int, default=20_000, help="that `look` reads")
    parser.add_argument("--pairs", type=int, default=8, help="right pairs, and as many impostors")
    parser.add_argument("--full", action="store_true", help="build a full-size campaign once")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    add_option(parser)
    given = parser.parse_args()
    if given.rounds < 2:
        parser.error("--rounds: 2 at least, as the first one compiles")
    folder = (given.folder or Path(tempfile.mkdtemp())).resolve()
    if given.full:
        return build_full(folder, given.results)
    if given.measure:
        given.measure.write_text(json.dumps(measure(folder, given.pairs)))
        return
    if not (folder / "campaign").is_dir():
        levkas("simulate", folder / "campaign", "--preset", given.preset)
    if not (folder / "bands").is_dir():
        write_bands(folder / "bands", given.files)
    codes = {"before": unpack(given.before, folder), "now": HERE / "src"}
    found: dict[str, list[dict]] = {name: [] for name in codes}
    for _ in range(given.rounds):
        for name, code in codes.items():
            found[name].append(measured_by(code, folder, given.pairs))
            print(f"{name}: built in {found[name][-1]['build, time']:.1f} s", flush=True)
    tell(*(least(found[name]) for name in ("before", "now")))


if __name__ == "__main__":
    main()
