"""How fast a database is written and opened, against tifffile and zarr with the same codecs.

    python benchmarks/database.py [--width 1392] [--height 1040] [--bands 33] [--rounds 3] [--json OUT]

Ratios are ours over the peer's, 1.0 being as fast; ours ends with everything synced to the disk,
the peers' without. Rounds alternate, the best of each counts.
"""

from __future__ import annotations

import argparse
import json
import os
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from results import add_option, record

from levkas import database as levkas_database
from levkas.core.cube import Band, Cube
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.spectral_tiff import LEVEL, TiffHeader, planes_of, write_spectral_tiff
from levkas.database.store import SQUEEZE, chunks_of, write_layer_store

ROUNDS = 3


def noisy_cube(height: int, width: int, bands: int) -> Cube:
    """Return reflectance with the noise of a 12-bit sensor, which is what makes floats hard to pack."""
    rng = np.random.default_rng(0)
    rows, columns = np.mgrid[0:height, 0:width]
    painting = 0.4 + 0.3 * np.sin(rows / 37) * np.cos(columns / 23)
    values = np.empty((height, width, bands), np.float32)
    for band in range(bands):
        electrons = painting * (0.5 + 0.5 * band / bands) * 3000
        counts = np.round(electrons + rng.normal(0, 1, electrons.shape) * np.sqrt(electrons))
        values[..., band] = counts / rng.normal(3000, 3, electrons.shape)
    labels = tuple(Band(f"{400 + 5 * i} nm", 400.0 + 5 * i) for i in range(bands))
    sigma = np.sqrt(np.maximum(values, 1e-4) / 3000).astype(np.float32)
    return Cube(values, np.zeros(values.shape, np.uint8), sigma, labels)


def our_tiff(cube: Cube, folder: Path) -> None:
    """Write the values as a spectral TIFF."""
    header = TiffHeader(cube.values.shape[:2], [band.wavelength for band in cube.bands])
    write_spectral_tiff(folder / "ours.tif", planes_of(cube.values), header)


def their_tiff(cube: Cube, folder: Path) -> None:
    """Write the values by tifffile alone, two workers."""
    from tifffile import TiffWriter

    with TiffWriter(folder / "theirs.tif") as tiff:
        for band in range(len(cube.bands)):
            tiff.write(
                np.ascontiguousarray(cube.values[..., band]),
                photometric="minisblack",
                compression="zlib",
                compressionargs={"level": LEVEL},
                predictor=3,
                metadata=None,
                contiguous=False,
                maxworkers=2,
            )


def our_zarr(cube: Cube, folder: Path) -> None:
    """Write values, flags and sigma as a layer."""
    write_layer_store(folder / "ours.zarr", "camera", cube)


def their_zarr(cube: Cube, folder: Path) -> None:
    """Write the same arrays by zarr alone, a row of shards at a time."""
    import zarr
    from zarr.codecs import BloscCodec, Crc32cCodec

    chunks, shards = chunks_of(cube.values.shape)
    group = zarr.create_group(folder / "theirs.zarr", overwrite=True, zarr_format=3)
    for name, values in (("values", cube.values), ("flags", cube.flags), ("sigma", cube.sigma)):
        array = group.create_array(
            name,
            shape=values.shape,
            dtype=values.dtype,
            chunks=chunks,
            shards=shards,
            filters=[],
            compressors=[BloscCodec(typesize=values.dtype.itemsize, **SQUEEZE), Crc32cCodec()],
            config={"write_empty_chunks": True},
        )
        for row in range(0, len(values), shards[0]):
            array[row : row + shards[0]] = values[row : row + shards[0]]


def seconds(action, *arguments) -> float:
    """Return how long one call takes.

    What others left in memory is on the disk before: ours waits for the disk and would wait for theirs.
    """
    os.sync()
    start = time.perf_counter()
    action(*arguments)
    return time.perf_counter() - start


def spectrum_ms(folder: Path) -> tuple[float, float]:
    """Return the median and the worst time of opening a layer and reading one pixel's spectrum, ms."""
    rng = np.random.default_rng(1)

    def once() -> None:
        cube = levkas_database.open(folder)["icon1"]["camera"]
        y, x = (int(rng.integers(size)) for size in cube.shape[:2])
        _ = cube[y, x].values

    once()
    taken = [1000 * seconds(once) for _ in range(25)]
    return float(np.median(taken)), max(taken)


def cold_ms(folder: Path) -> float:
    """Return the time of the same in a new process, imports and all, ms."""
    code = "import sys, levkas; levkas.open(sys.argv[1])['icon1']['camera'][3, 4].values"
    return 1000 * seconds(subprocess.run, [sys.executable, "-c", code, str(folder)])


def measure(height: int, width: int, bands: int, rounds: int = ROUNDS) -> dict[str, float]:
    """Return throughputs in MB/s, ratios, and the time of a spectrum."""
    cube = noisy_cube(height, width, bands)
    folder = Path(tempfile.mkdtemp(prefix="levkas-bench-"))
    try:
        pairs = {"tiff": (our_tiff, their_tiff), "zarr": (our_zarr, their_zarr)}
        sizes = {"tiff": cube.values.nbytes, "zarr": 2 * cube.values.nbytes + cube.flags.nbytes}
        report: dict[str, float] = {}
        for name, both in pairs.items():
            for write in both:  # the first call compiles and loads
                write(cube, folder)
            times = [[seconds(write, cube, folder) for write in both] for _ in range(rounds)]
            best = [min(each) for each in zip(*times, strict=True)]
            report[f"{name} MB/s"] = sizes[name] / best[0] / 1e6
            report[f"{name} ratio"] = best[1] / best[0]
        total = 2 * cube.values.nbytes + cube.flags.nbytes
        start = time.perf_counter()
        entry, _ = write_layer(folder / "db", Layer("icon1", "camera"), cube)
        report["layer MB/s"] = total / (time.perf_counter() - start) / 1e6
        write_catalogue(folder / "db", [entry])
        report["spectrum ms"], report["worst ms"] = spectrum_ms(folder / "db")
        report["first ms"] = cold_ms(folder / "db")
        return {name: round(value, 2) for name, value in report.items()}
    finally:
        shutil.rmtree(folder, ignore_errors=True)


def main() -> None:
    """Print the table."""
    options = argparse.ArgumentParser(description=__doc__)
    for name, value in (("height", 1040), ("width", 1392), ("bands", 33), ("rounds", ROUNDS)):
        options.add_argument(f"--{name}", type=int, default=value)
    options.add_argument("--json", type=Path)
    add_option(options)
    chosen = options.parse_args()
    report = measure(chosen.height, chosen.width, chosen.bands, chosen.rounds)
    for name, value in report.items():
        print(f"{name:16} {value:8.2f}")
    names = {"tiff ratio": "TIFF over tifffile", "zarr ratio": "Zarr over zarr"}
    names["spectrum ms"] = "one spectrum from Zarr"
    record(chosen.results, "speed", {text: report[name] for name, text in names.items()})
    if chosen.json:
        chosen.json.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
