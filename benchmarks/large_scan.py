"""A line scan far larger than memory: calibrated, resampled and written within 2 GB.

    python benchmarks/large_scan.py [--gigabytes 64] [--memory 2] [--folder FOLDER] [--mirror]

The scan is a sparse file, 2048 samples of 256 bands a line, so that any size costs no disk; a child
process whose private memory (RLIMIT_DATA) is limited calibrates it with dark and white, resamples
every band through one map on a grid of half the scan's sampling, and writes the layer: values, flags
and sigma as spectral TIFF and Zarr. With ``--mirror`` it is a mirror scanner's: dark and white, which take
the disk space, are as large as the scan.
"""

import argparse
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from results import add_option, record

SAMPLES, BANDS = 2048, 256
CAMPAIGN = """
[campaign]
title = "A large scan"
reference = { camera = "photo" }
[cameras.photo]
kind = "image"
files = "photo/{target}.png"
[cameras.scan]
kind = "cube"
files = "scan/{target}.hdr"
bits = 12
[targets]
dark = "dark"
white = { names = ["white"], reflectance = 0.98 }
objects = ["panel"]
"""


def write_envi(path: Path, lines: int, values: np.ndarray | None) -> None:
    """Write lines of `values`, over and over, or a hole of as many lines."""
    path.with_suffix(".hdr").write_text(
        f"ENVI\nsamples = {SAMPLES}\nlines = {lines}\nbands = {BANDS}\ndata type = 12\n"
        f"interleave = bil\nbyte order = 0\nwavelength units = nm\n"
        f"wavelength = {{{', '.join(str(400 + 2.4 * b) for b in range(BANDS))}}}\n"
    )
    with path.with_suffix(".raw").open("wb") as handle:
        if values is None:
            handle.truncate(lines * SAMPLES * BANDS * 2)
        else:
            some = values.astype("<u2")
            for y in range(0, lines, len(some)):
                handle.write(some[: lines - y].tobytes())


def make(folder: Path, gigabytes: float, mirror: bool) -> int:
    import cv2

    rng = np.random.default_rng(1)
    for part in ("photo", "scan"):
        (folder / part).mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(folder / "photo/panel.png"), rng.integers(0, 255, (60, 80)).astype(np.uint8))
    lines = round(gigabytes * 1e9 / (2 * SAMPLES * BANDS))
    for name, level in (("dark", 100), ("white", 3000)):
        some = level + rng.normal(0, 3 + level / 300, (40, BANDS, SAMPLES))
        write_envi(folder / "scan" / name, lines if mirror else 40, np.clip(some, 0, 4095))
    write_envi(folder / "scan/panel", lines, None)
    text = CAMPAIGN.replace("bits = 12", 'bits = 12\nscan = "mirror"') if mirror else CAMPAIGN
    (folder / "campaign.toml").write_text(text)
    return lines


def work(folder: Path, memory: float) -> None:
    """Do the work in this process, its memory limited."""
    import resource
    import threading

    from levkas.campaign.campaign import load_campaign
    from levkas.campaign.discovery.find_captures import find_captures
    from levkas.database.layers import Layer, write_layer
    from levkas.geometry.transforms import Affine, Composed, Lens
    from levkas.stages.parts import on_grid
    from levkas.stages.scans import open_scan
    from levkas.stages.template_cache import TemplateCache

    limit = int(memory * 1e9)
    resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    peak = [0]

    def watch() -> None:
        while True:
            status = Path("/proc/self/status").read_text()
            peak[0] = max(peak[0], int(status.split("RssAnon:")[1].split()[0]))
            time.sleep(0.2)

    threading.Thread(target=watch, daemon=True).start()
    campaign = load_campaign(folder)
    capture = next(c for c in find_captures(campaign)[0] if c.camera == "scan")
    scan = open_scan(capture, campaign, TemplateCache(folder))
    lines, samples, _ = scan.parts[0].shape
    size = (samples // 2, lines // 2)
    lens = Lens(np.array([samples / 2, lines / 2]), lines / 2.0, (1e-4, 0.0))
    one = Composed(Affine(np.array([[2.0, 0.002, 0.5], [0.0001, 2.0, 0.5]])), lens)
    start = time.perf_counter()
    maps = dict.fromkeys([band.label for band in scan.bands], one)
    rows = on_grid(scan, maps, size, spool=folder).cube()
    _, files = write_layer(folder / "database", Layer("panel", "scan"), rows)
    seconds = time.perf_counter() - start
    written = sum(path.stat().st_size for path in files)
    print(json.dumps({"seconds": seconds, "peak": peak[0] * 1024, "written": written}))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--gigabytes", type=float, default=64)
    parser.add_argument("--memory", type=float, default=2)
    parser.add_argument("--folder", type=Path)
    parser.add_argument("--mirror", action="store_true")
    parser.add_argument("--work", action="store_true", help=argparse.SUPPRESS)
    add_option(parser)
    options = parser.parse_args()
    if options.work:
        work(options.folder, options.memory)
        return
    folder = options.folder or Path(tempfile.mkdtemp())
    lines = make(folder, options.gigabytes, options.mirror)
    command = [sys.executable, __file__, "--work", "--folder", folder, "--memory", options.memory]
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, check=False)
    if done.returncode:
        sys.exit(done.stderr)
    report = json.loads(done.stdout.splitlines()[-1])
    raw = lines * SAMPLES * BANDS * 2
    print(
        f"{raw / 1e9:.1f} GB of {lines} lines: {report['seconds']:.0f} s, "
        f"{raw / 1e6 / report['seconds']:.0f} MB/s of raw, {report['peak'] / 1e9:.2f} GB of private "
        f"memory at its peak of {options.memory:g}, {report['written'] / 1e6:.0f} MB written"
    )
    name = f"{raw / 1e9:.0f} GB scan"
    record(options.results, "speed", {name: raw / 1e6 / report["seconds"]})
    record(options.results, "speed", {f"{name}, private memory": report["peak"] / 1e9})
    if options.folder is None:
        shutil.rmtree(folder)


if __name__ == "__main__":
    main()
