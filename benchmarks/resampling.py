"""Resampling through real maps against OpenCV's remap, band by band, in one run.

    python benchmarks/resampling.py [--bands 33 121] [--repeats 7] [--size 1392 1040] [--json OUT] [--results FILE]

remap is given its float32 maps ready and writes to planes that are there; our time has the
evaluation of the maps in it (an affine grid, then the third-order polynomial of a registration),
footprint, flags and the check for holes, and is also written to arrays that are there: fresh memory
costs more than either. Repeats of all contestants take turns; medians are compared. Both use as
many threads as the process may have processors.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
from results import add_option, record

from levkas.geometry.grid import Grid
from levkas.geometry.pixel_maps import lay
from levkas.geometry.resample import Warped, warp
from levkas.geometry.transforms import Composed, Polynomial

CHROMATIC_PX = (0.4, 1.0)
"""How far the outermost bands are apart at the left and right edge of the frame."""


def composed(size: tuple[int, int], magnification: float = 0.0) -> Composed:
    """A grid of the reference's size, and a cubic fit of lens, tilt and magnification."""
    w, h = size
    points = np.stack(np.meshgrid(np.linspace(0, w - 1, 12), np.linspace(0, h - 1, 12)), -1)
    points = points.reshape(-1, 2)
    centre = np.array([(w - 1) / 2, (h - 1) / 2])
    p = (points - centre) / w
    bent = p * (1 + 0.02 * (p**2).sum(1, keepdims=True)) @ np.array([[0.97, 0.02], [-0.02, 0.98]])
    target = bent * w * (1 + magnification / w) + centre
    return Composed(Grid(size).transform, Polynomial.fit(points, target, order=3))


def remap_maps(transform: Composed, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    found = transform(np.stack([x.ravel(), y.ravel()], 1)).astype(np.float32)
    return found[:, 0].reshape(x.shape), found[:, 1].reshape(x.shape)


def medians(jobs: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    times: dict[str, list[float]] = {name: [] for name in jobs}
    for job in jobs.values():
        job()
    for _ in range(repeats):
        for name, job in jobs.items():
            start = time.perf_counter()
            job()
            times[name].append(time.perf_counter() - start)
    return {name: float(np.median(t)) for name, t in times.items()}


def compare(
    bands: int, size: tuple[int, int], dtype: type, repeats: int
) -> list[dict[str, object]]:
    w, h = size
    rng = np.random.default_rng(bands)
    source = (rng.random((h, w, bands), np.float32) * (4095 if dtype is np.uint16 else 1)).astype(
        dtype
    )
    planes = [np.ascontiguousarray(source[..., b]) for b in range(bands)]
    drawn = [np.empty((h, w), dtype) for _ in range(bands)]
    out = Warped(np.empty((h, w, bands), np.float32), np.zeros((h, w, bands), np.uint8), None)
    one = composed(size)
    fans = {
        f"{spread:.1f} px": [composed(size, m) for m in np.linspace(-spread, spread, bands)]
        for spread in CHROMATIC_PX
    }
    # remap reads two maps a band either way: the same ones for all do it no harm.
    maps = remap_maps(one, size)

    def remap() -> None:
        for plane, target in zip(planes, drawn, strict=True):
            cv2.remap(plane, *maps, cv2.INTER_CUBIC, dst=target)

    jobs: dict[str, Callable[[], object]] = {"remap": remap}
    jobs["one map"] = lambda: warp(source, one, (h, w), out=out)
    for name, fan in fans.items():
        jobs[f"own maps, {name}"] = lambda fan=fan: warp(source, fan, (h, w), out=out)
    jobs["copy"] = lambda: np.copyto(out.values, source)
    jobs["own maps, laid out"] = lambda: lay(fans["1.0 px"], (h, w))
    found = medians(jobs, repeats)
    return [
        {
            "bands": bands,
            "type": np.dtype(dtype).name,
            "job": name,
            "seconds": seconds,
            "rate": bands * w * h / seconds / 1e6,
            "ratio": found["remap"] / seconds,
        }
        for name, seconds in found.items()
    ]


def ramp_errors(size: tuple[int, int]) -> dict[str, float]:
    """Largest position error in x that a ramp of one a pixel shows, px, 4 px inside the edge."""
    w, h = size
    ramp = np.tile(np.arange(w, dtype=np.float32), (h, 1))
    transform = composed(size)
    x, y = remap_maps(transform, size)
    inside = (x > 4) & (x < w - 5) & (y > 4) & (y < h - 5)
    grid = np.stack(np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float)), -1)
    truth = transform(grid.reshape(-1, 2))[:, 0].reshape(h, w)
    errors = {
        f"remap {name}": cv2.remap(ramp, x, y, flag)
        for name, flag in (("cubic", cv2.INTER_CUBIC), ("Lanczos4", cv2.INTER_LANCZOS4))
    }
    errors["levkas"] = warp(ramp, transform, (h, w)).values
    return {name: float(np.abs(found - truth)[inside].max()) for name, found in errors.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--bands", type=int, nargs="+", default=[33, 121])
    parser.add_argument("--size", type=int, nargs=2, default=[1392, 1040])
    parser.add_argument("--repeats", type=int, default=7)
    parser.add_argument("--types", nargs="+", default=["float32", "uint16"])
    parser.add_argument("--json", type=Path)
    add_option(parser)
    options = parser.parse_args()
    size = (options.size[0], options.size[1])
    rows = []
    print(f"{'bands':>5} {'type':8} {'job':22} {'s':>8} {'Mpx·band/s':>11} {'× remap':>8}")
    for bands in options.bands:
        for name in options.types:
            for row in compare(bands, size, getattr(np, name), options.repeats):
                rows.append(row)
                print(
                    f"{row['bands']:5} {row['type']:8} {row['job']:22} {row['seconds']:8.3f} "
                    f"{row['rate']:11.0f} {row['ratio']:8.2f}"
                )
    errors = ramp_errors(size)
    for name, error in errors.items():
        print(f"position error on a ramp, {name}: {error:.1e} px")
    names = {"one map": "one map", "own maps, 1.0 px": "own maps"}
    ratios = {
        f"{row['bands']} bands, {names[row['job']]}": row["ratio"]
        for row in rows
        if row["type"] == "float32" and row["job"] in names
    }
    record(options.results, "speed", ratios)
    if options.json:
        report = {"size": size, "threads": cv2.getNumThreads(), "rows": rows, "ramp_px": errors}
        options.json.write_text(json.dumps(report, indent=1))


if __name__ == "__main__":
    main()
