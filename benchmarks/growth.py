"""How time and memory of a build grow with bands, pixels, objects and cameras: a factor of 16 each, with slopes.

    python benchmarks/growth.py [--only bands pixels objects cameras] [--results FILE]

Campaigns of textures with white and dark, built each in a process of its own. A slope is that of the logarithms
between the two largest sizes, of what a build takes beyond its start: 1 is linear.
"""

import argparse
import json
import math
import resource
import subprocess
import sys
import tempfile
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from results import add_option, record
from scipy import ndimage

from levkas.building import build

BLACK, FULL = 64, 4095


@dataclass(frozen=True)
class Size:
    """Size of a campaign: side of the frames, px, bands of each camera, cameras beside the reference, objects."""

    side: int = 256
    bands: int = 4
    cameras: int = 1
    objects: int = 1


#: What grows → sizes, the largest 16 times the smallest.
SERIES = {
    "bands": [Size(side=512, bands=n) for n in (8, 32, 128)],
    "pixels": [Size(side=n) for n in (192, 384, 768)],
    "objects": [Size(objects=n) for n in (1, 4, 16)],
    "cameras": [Size(cameras=n) for n in (1, 4, 16)],
}


def write_campaign(folder: Path, size: Size) -> None:
    """Write raw frames, a band a file, and campaign.toml: reference of four bands, other cameras shifted and turned."""
    rng = np.random.default_rng(1)
    height, width = size.side * 3 // 4, size.side
    names = [f"panel{n}" for n in range(size.objects)]
    cameras = {f"camera{n}": size.bands for n in range(size.cameras + 1)} | {"camera0": 4}
    text = ['[campaign]\ntitle = "Growth"\nreference = { camera = "camera0", band = "550 nm" }\n']
    for camera, bands in cameras.items():
        step = 300 // max(bands - 1, 1)
        nm = [400 + step * k for k in range(bands)] if camera != "camera0" else [450, 500, 550, 600]
        text.append(
            f'[cameras.{camera}]\nkind = "bands"\nfiles = "raw/{camera}/{{target}}/{{wavelength}}nm.tif"\n'
            f"wavelengths = {nm}\nblack = {BLACK}\nsaturation = {FULL}\nbits = 12\n"
        )
        for target in ("dark", "white", *names):
            scene = painted(sum(map(ord, target)), (height, width))
            turned = ndimage.rotate(
                scene, 0.5 * int(camera[6:]), (1, 2), reshape=False, order=1, mode="nearest"
            )
            place = folder / "raw" / camera / target
            place.mkdir(parents=True)
            for k, wavelength in enumerate(nm):
                share = np.array([1 - k / bands, k / bands, 0.3])
                light = {"dark": 0.0, "white": 0.9}.get(
                    target, np.tensordot(share, turned, 1) * 0.6
                )
                counts = BLACK + light * 3500 + rng.normal(0, 4, (height, width))
                write_tiff(place / f"{wavelength}nm.tif", counts)
    text.append(f'[targets]\ndark = "dark"\nwhite = "white"\nobjects = {json.dumps(names)}\n')
    (folder / "campaign.toml").write_text("\n".join(text))


def painted(seed: int, shape: tuple[int, int]) -> np.ndarray:
    """Return three layers of soft patches and fine strokes, (3, h, w), 0 to 1."""
    rng = np.random.default_rng(seed)
    layers = [ndimage.gaussian_filter(rng.standard_normal(shape), s) for s in (1.5, 3, 6)]
    return np.stack([1 / (1 + np.exp(-2 * one / one.std())) for one in layers])


def write_tiff(path: Path, counts: np.ndarray) -> None:
    """Write counts as 16 bits."""
    import tifffile

    tifffile.imwrite(path, np.clip(np.rint(counts), 0, FULL).astype(np.uint16))


def work(folder: Path) -> None:
    """Build in this process, and print what it took as JSON."""
    peak, done = [0], threading.Event()

    def watch() -> None:
        while not done.wait(0.05):
            status = Path("/proc/self/status").read_text()
            peak[0] = max(peak[0], int(status.split("RssAnon:")[1].split()[0]))

    watcher = threading.Thread(target=watch)
    watcher.start()
    start, before = time.perf_counter(), peak[0]
    states = [step.state for step in build(folder) if step.state in ("refused", "failed")]
    done.set()
    watcher.join()
    usage = resource.getrusage(resource.RUSAGE_SELF)
    used = {"cpu": usage.ru_utime + usage.ru_stime, "clock": time.perf_counter() - start}
    print(json.dumps({**used, "peak": (peak[0] - before) / 1e6, "refused": len(states)}))


def measure(size: Size) -> dict:
    """Return processor seconds, seconds on the clock and GB at the peak of one build, in a process of its own."""
    with tempfile.TemporaryDirectory() as folder:
        write_campaign(Path(folder), size)
        command = [sys.executable, __file__, "--work", folder]
        ran = subprocess.run(command, capture_output=True, text=True, check=True)
        return json.loads(ran.stdout.splitlines()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="*", choices=SERIES, default=list(SERIES))
    parser.add_argument("--work", type=Path, help=argparse.SUPPRESS)
    add_option(parser)
    options = parser.parse_args()
    if options.work:
        work(options.work)
        return
    measure(Size(side=96))  # compiled from here on
    start = measure(Size(side=96))
    print(f"least build: {start['cpu']:.1f} s of processor, {start['peak']:.2f} GB")
    slopes = {}
    for what in options.only:
        found = [measure(size) for size in SERIES[what]]
        for size, one in zip(SERIES[what], found, strict=True):
            print(f"{what:8} {size}: {one}")
        ratio = math.log(value_of(SERIES[what][-1], what) / value_of(SERIES[what][-2], what))
        for unit in ("cpu", "peak"):
            beyond = [max(one[unit] - 0.9 * start[unit], 1e-3) for one in found[-2:]]
            slopes[what, {"cpu": "time", "peak": "memory"}[unit]] = (
                math.log(beyond[1] / beyond[0]) / ratio
            )
        print(
            f"{what:8} slope of time {slopes[what, 'time']:.2f}, of memory {slopes[what, 'memory']:.2f}"
        )
    for name, unit in (("growth, slope of time", "time"), ("growth, of memory", "memory")):
        found = [slope for (_, of), slope in slopes.items() if of == unit]
        record(options.results, "speed", {name: (min(found), max(found))})


def value_of(size: Size, what: str) -> float:
    """Return what grows: bands, pixels, objects or cameras."""
    return float(size.side**2 if what == "pixels" else getattr(size, what))


if __name__ == "__main__":
    main()
