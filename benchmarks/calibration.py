"""Raw frames to reflectance with sigma: MB of raw a second, demosaicing apart, and the memory of a template.

    python benchmarks/calibration.py [--megapixels 10] [--whites 50]

Frames are written as uncompressed TIFF to a temporary folder, and read from there: 10 darks, 10 whites
and 5 shots of the object of a Bayer camera are averaged, the noise is fitted, and the flat field gives
reflectance, flags and variance on the mosaic. The memory of a template of many whites is that of a
process of its own, less what it had before.
"""

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import tifffile
from results import add_option, record

from levkas.calibration.flatfield import flat_field
from levkas.calibration.mosaic import demosaic
from levkas.calibration.noise_fit import fit_noise
from levkas.calibration.templates import Template, average
from levkas.calibration.whites import WhiteBoard
from levkas.core.machine import steady_libraries
from levkas.readers.frames import read_frame

SATURATION = 4095
COUNTS = {"dark": (10, 60.0), "white": (10, 3200.0), "object": (5, 1400.0)}


def write(folder: Path, shape: tuple[int, int]) -> int:
    rng = np.random.default_rng(1)
    size = 0
    for name, (count, level) in COUNTS.items():
        for shot in range(count):
            noise = rng.normal(0, np.sqrt(level / 8 + 4), shape).astype(np.float32)
            frame = np.clip(np.rint(level + noise), 0, SATURATION).astype(np.uint16)
            tifffile.imwrite(folder / f"{name}_{shot:02d}.tif", frame)
            size += frame.nbytes
    return size


def template(folder: Path, name: str) -> Template:
    paths = sorted(folder.glob(f"{name}_*.tif"))
    return average((read_frame(path) for path in paths), saturation=SATURATION, exposure_s=1.0)


def calibrate(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    dark, white, shot = (template(folder, name) for name in COUNTS)
    noise = fit_noise([white, shot], dark)
    made = flat_field(shot, dark, white, board=WhiteBoard(0.98, "RGGB"), noise=noise)
    return made.values, made.flags, made.variance


def whites_alone(count: int, shape: tuple[int, int], results: Path | None) -> None:
    """In a process of its own: the peak of memory that averaging many whites adds."""
    frame = np.resize(np.arange(4000, dtype=np.uint16), shape)
    average(iter([frame[:64, :64]] * 3), saturation=SATURATION)  # compiled
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    average((np.roll(frame, shot) for shot in range(count)), saturation=SATURATION)
    after = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    print(f"{count} whites of {frame.size / 1e6:.0f} Mpx: {(after - before) / 1e3:.0f} MB", end="")
    print(f" more than before, {after / 1e3:.0f} MB in all")
    name = f"{count} whites of {round(frame.size / 1e6)} Mpx"
    record(results, "speed", {name: after / 1e3})


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--megapixels", type=float, default=10)
    parser.add_argument("--whites", type=int, default=50)
    parser.add_argument("--alone", action="store_true", help=argparse.SUPPRESS)
    add_option(parser)
    told = parser.parse_args()
    height = int(np.sqrt(told.megapixels * 1e6 / 1.5)) // 2 * 2
    shape = (height, height * 3 // 2 // 2 * 2)
    if told.alone:
        sys.argv.remove("--alone")  # not part of the command that repeats it
        whites_alone(told.whites, shape, told.results)
        return
    # First, for a process begins with the peak of memory of the one that started it.
    command = [sys.executable, __file__, "--alone", "--whites", str(told.whites)]
    command += ["--results", str(told.results)] if told.results else []
    subprocess.run([*command, "--megapixels", str(told.megapixels)], check=True)
    with tempfile.TemporaryDirectory() as folder, steady_libraries():
        size = write(Path(folder), shape)
        calibrate(Path(folder))
        best, made = np.inf, None
        for _ in range(3):
            start = time.perf_counter()
            made = calibrate(Path(folder))
            best = min(best, time.perf_counter() - start)
        print(f"{size / 1e6:.0f} MB of raw to reflectance with sigma: {best:.2f} s, ", end="")
        print(f"{size / 1e6 / best:.0f} MB/s")
        record(told.results, "speed", {"raw to reflectance": size / 1e6 / best})
        for method in ("malvar", "bilinear"):
            demosaic(*made, "RGGB", method=method)
            start = time.perf_counter()
            demosaic(*made, "RGGB", method=method)
            took = time.perf_counter() - start
            print(f"demosaicing {method}, values, flags and variance: {took:.2f} s, ", end="")
            print(f"{made[0].size / 1e6 / took:.0f} Mpx/s")


if __name__ == "__main__":
    main()
