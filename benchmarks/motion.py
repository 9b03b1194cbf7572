"""Whole builds of merged exposures by cameras as they are: what is flagged as moved, and what moved.

    python benchmarks/motion.py [--size 480 360] [--only 2%] [--filter-wheel]

A painting of strokes, R = 0.005 to 0.95, is taken once at each of several exposures by a sensor of 12 bits in 16-bit
files (black 64, 2 electrons a count, read noise 2 counts, PRNU 1 %), with 16 whites. One thing at a time is not ideal: read noise,
codes at the upper end of 16 bits, darks with dark current and hot sensels, non-linearity of the response, a lamp that
flickers from exposure to exposure, a mosaic; then all at once. In each exposure a patch of the painting is shifted by four
pixels, a fly sits on it, and a shadow takes a fifth of the light from another place: nothing moves elsewhere.

False: share of pixels flagged MOVED more than three pixels from all that moved. Found: share flagged of the pixels whose
counts in one exposure changed by over 5 % and over 5 sigma, where neither state is saturated or
beside saturated sensels; sigma is that of the difference
between that exposure and what the others together say of it. `--filter-wheel`: the seven bands of
../shared/data/filterwheel-disks, in which nothing moved.
"""

import argparse
import os
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import tifffile
from results import add_option, record

from levkas.building import build
from levkas.core.cube import Flag

BLACK, GAIN, FULL = 64.0, 0.5, 4095
WHITE = 12_000.0  # counts a second of R = 1
WHITE_TIME = 0.25
KEYS = """
[campaign]
title = "motion"
reference = {{ camera = "cam" }}
[cameras.cam]
{kind}
files = "raw/{{target}}_550nm_{{exposure}}ms_{{shot}}.tif"
{scale}
exposures = "merge"
{black}
[targets]
{dark}
white = {{ names = "white", reflectance = 1.0 }}
objects = ["panel"]
"""


@dataclass(frozen=True)
class Taken:
    """One camera: how it is not ideal."""

    name: str
    read: float = 2.0
    shift: int = 0
    bent: float = 0.0
    flicker: float = 0.0
    hot: float = 0.0
    darks: bool = False
    mosaic: bool = False
    times: tuple[float, ...] = (0.0625, 0.25, 1.0, 4.0)


IDEAL = Taken("black level declared")
CAMERAS = [
    IDEAL,
    replace(IDEAL, name="read noise 0.3 counts", read=0.3),
    replace(IDEAL, name="12 bits at the upper end of 16", shift=4),
    replace(IDEAL, name="darks, dark current, hot sensels 0.1 %", darks=True, hot=1e-3),
    replace(IDEAL, name="hot sensels 0.1 %, no darks", hot=1e-3),
    replace(IDEAL, name="response bent by 1 %", bent=0.01),
    replace(IDEAL, name="response bent by 2 %", bent=0.02),
    replace(IDEAL, name="lamp flickers by 1 %", flicker=0.01),
    replace(IDEAL, name="seven exposures, bent 1 %", bent=0.01, times=tuple(0.0625 * 2.0**k for k in range(7))),
    replace(IDEAL, name="mosaic", mosaic=True),
    Taken("mosaic, all of it at 1 %", 2.0, 4, 0.01, 0.01, 1e-3, darks=True, mosaic=True),
    Taken("all of it at 2 %", 2.0, 4, 0.02, 0.01, 1e-3, darks=True),
]  # fmt: skip


def painting(size: tuple[int, int]) -> np.ndarray:
    """Return strokes, blurred as by a lens, R."""
    rng, (width, height) = np.random.default_rng(3), size
    picture = np.full((height, width), 0.2, np.float32)
    for _ in range(width * height // 120):
        x, y = (int(v) for v in rng.integers(0, (width, height)))
        end = x + int(rng.integers(-40, 40)), y + int(rng.integers(-40, 40))
        level = float(np.exp(rng.uniform(np.log(0.005), np.log(0.95))))
        cv2.line(picture, (x, y), end, level, int(rng.integers(1, 7)))
    return np.asarray(cv2.GaussianBlur(picture, (0, 0), 0.8), np.float64)


def moved_scene(still: np.ndarray, index: int, count: int) -> np.ndarray:
    """Return the scene of one exposure: a patch shifted, a fly, a shadow, in a column of its own."""
    scene, (height, width) = still.copy(), still.shape
    side = min(height // 12, width // (2 * count))
    x = int((index + 0.5) * width / count)
    top = slice(height // 8, height // 8 + side), slice(x - side // 2, x - side // 2 + side)
    scene[top] = np.roll(still, (4, 4), (0, 1))[top]
    cv2.circle(scene, (x, height // 2), side // 4, 0.02, -1)
    low = slice(3 * height // 4, 3 * height // 4 + side), top[1]
    scene[low] *= 0.8
    return scene


def write(folder: Path, camera: Taken, size: tuple[int, int]) -> tuple[np.ndarray, np.ndarray]:
    """Write the frames; return what moved anywhere, and what of it must be found."""
    rng = np.random.default_rng(11)
    (folder / "raw").mkdir(parents=True)
    still = painting(size)
    response = 1 + 0.01 * rng.standard_normal(still.shape)
    if camera.mosaic:
        response *= np.tile([[0.6, 1.0], [1.0, 0.5]], (still.shape[0] // 2, still.shape[1] // 2))
    hot = np.where(rng.random(still.shape) < camera.hot, rng.uniform(100, 2000, still.shape), 0)
    hot += 8.0 if camera.darks else 0.0  # counts a second
    lamp = {t: 1 + camera.flicker * rng.standard_normal() for t in camera.times}
    level = {t: WHITE * t * lamp[t] * response for t in camera.times}  # counts of R = 1
    scenes = [moved_scene(still, i, len(camera.times)) for i in range(len(camera.times))]
    frames = [("panel", s, t, 0) for s, t in zip(scenes, camera.times, strict=True)]
    frames += [("white", 1 + 0 * still, WHITE_TIME, k) for k in range(16)]
    if camera.darks:
        frames += [("dark", 0 * still, t, k) for t in camera.times for k in range(8)]
    for name, scene, t, shot in frames:
        light = scene * (level[t] if name == "panel" else WHITE * t * response)
        electrons = (light + hot * t) / GAIN
        signal = GAIN * rng.poisson(electrons)
        signal = signal * (1 - camera.bent * signal / FULL)
        codes = np.rint(signal + rng.normal(BLACK, camera.read, still.shape)).clip(0, FULL)
        path = folder / "raw" / f"{name}_550nm_{1000 * t:g}ms_{shot}.tif"
        tifffile.imwrite(path, codes.astype(np.uint16) << camera.shift, metadata=None)
    kind = (
        'kind = "mosaic"\npattern = "RGGB"'
        if camera.mosaic
        else 'kind = "bands"\nwavelengths = [550]'
    )
    text = KEYS.format(
        kind=kind,
        scale=f"saturation = {FULL << camera.shift}" if camera.shift else "bits = 12",
        black="" if camera.darks else f"black = {BLACK * 2**camera.shift:g}",
        dark='dark = "dark"' if camera.darks else "",
    )
    if camera.mosaic:
        text = text.replace("_550nm_", "_*_")
    (folder / "campaign.toml").write_text(text)
    anywhere = np.any([s != still for s in scenes], axis=0)
    return anywhere, wanted(still, scenes, level, camera)


def wanted(
    still: np.ndarray, scenes: list[np.ndarray], level: dict[float, np.ndarray], camera: Taken
) -> np.ndarray:
    """Return where one exposure changed by over 5 % and five sigma of its difference to the others."""
    rates = [1 / level[t] for t in camera.times]
    full = [np.maximum(still, s) * level[t] + BLACK > 0.95 * FULL
            for s, t in zip(scenes, camera.times, strict=True)]  # fmt: skip
    usable = [cv2.dilate(f.astype(np.uint8), np.ones((3, 3), np.uint8)) == 0 for f in full]
    variance = [r**2 * (camera.read**2 + GAIN * still / r) for r in rates]  # of R
    found = np.zeros(still.shape, bool)
    for i, scene in enumerate(scenes):
        others = sum(u / v for k, (u, v) in enumerate(zip(usable, variance, strict=True)) if k != i)
        sigma = np.sqrt(variance[i] + 1 / np.maximum(others, 1e-12))
        change = np.abs(scene - still)
        found |= usable[i] & (others > 0) & (change > 5 * sigma) & (change > 0.05 * still)
    return found


def flags_of(folder: Path) -> np.ndarray:
    """Build, and return where any band is flagged MOVED, (h, w)."""
    warnings = []
    for step in build(folder):
        if step.state in ("refused", "failed"):
            raise SystemExit(f"{folder.name}: {step}")
        warnings += [w for w in map(str, step.warnings) if "scale" in w]
    (path,) = (folder / "database/objects").rglob("native/*.flags.tif")
    flags = tifffile.imread(path)
    bands = (
        flags
        if flags.ndim == 3 and flags.shape[0] < 16
        else np.atleast_3d(flags).transpose(2, 0, 1)
    )
    for warning in dict.fromkeys(warnings):
        print(f"      {warning}")
    return (bands & int(Flag.MOVED)) > 0


def trial(camera: Taken, size: tuple[int, int]) -> tuple[float, float]:
    """Print and return percent flagged where nothing moved, and of what must be found."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "trial"
        moved, must = write(folder, camera, size)
        found = flags_of(folder)
        if camera.mosaic:  # each band at the sensels that measured it
            y, x = np.indices(moved.shape)
            channel = np.array([[0, 1], [1, 2]])[y % 2, x % 2]
            found = np.take_along_axis(found, channel[None], 0)
        flagged = found[0]
        reach = 3 * (2 if camera.mosaic else 1)
        near = cv2.dilate(moved.astype(np.uint8), np.ones((2 * reach + 1,) * 2, np.uint8)) > 0
        false, true = 100 * flagged[~near].mean(), 100 * flagged[must].mean()
        print(f"{camera.name:42} {false:8.3f} {true:8.1f}   ({must.sum()} px)", flush=True)
        return false, true


def filter_wheel() -> None:
    data = (
        Path(os.environ.get("LEVKAS_REAL_DATA", "../shared/data")).resolve() / "filterwheel-disks"
    )
    text = (Path(__file__).parents[1] / "examples/filterwheel-disks/campaign.toml").read_text()
    text = text.replace('exposures = "best"', 'exposures = "merge"')
    text = text.replace("../../../shared/data/filterwheel-disks", str(data))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name) / "wheel"
        folder.mkdir()
        output = 'output = "../../build/filterwheel-disks"\n'
        (folder / "campaign.toml").write_text(text.replace(output, ""))
        shares = [f"{100 * band.mean():.3f}" for band in flags_of(folder)]
        print(f"filter wheel, flagged where nothing moved, %, band by band: {', '.join(shares)}")


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--size", type=int, nargs=2, default=(480, 360), help="px")
    parser.add_argument("--only", default="", help="part of a row's name")
    parser.add_argument("--filter-wheel", action="store_true")
    add_option(parser)
    given = parser.parse_args()
    if given.filter_wheel:
        filter_wheel()
        return
    print(f"{'camera':42} {'false %':>8} {'found %':>8}")
    found = [trial(c, tuple(given.size)) for c in CAMERAS if given.only in c.name]
    if len(found) == len(CAMERAS):
        false, true = ((min(several), max(several)) for several in zip(*found, strict=True))
        figures = {"flagged where nothing moved": false, "flagged of what changed": true}
        record(given.results, "motion", figures)


if __name__ == "__main__":
    main()
