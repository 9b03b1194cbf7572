"""Tiles joined: real ones, and tiles cut from paintings by known maps.

    python benchmarks/tiles.py --data FOLDER [--seeds 2] [--results results.json]
    python benchmarks/tiles.py --build FOLDER [--columns 6] [--rows 4] [--size 4000 3000] [--others-in 2x2 4x3]

The first form takes the tiles of a polished section (`tiles-section`, grey JPEG files named by row and column) and paintings (`paintings`)
in the folder. Of the real tiles there is no truth: how well windows agree after one adjustment, with the lens and
as plain homographies. The paintings are cut into tiles of 360 x 300 px, turned, tilted and scaled at random, seen through a lens of 1 %, with
noise, and joined again; the error of all px, against the cut and after one homography of the whole, stands beside that of a chain of key
points from tile to tile, of whole-tile correlation at given positions (as ashlar and MIST work) and of OpenCV's bundle adjustment.
The second form builds a database from tiles of a photograph (by default of 12 Mpx) and from tiles of one or two other cameras that lie on all of it, in a new
folder of some 0.7 GB a tile: time, memory, and the errors of both cameras against the planted maps.
"""

from __future__ import annotations

import argparse
import re
import resource
import subprocess
import sys
import time
from itertools import combinations
from pathlib import Path

import cv2
import numpy as np
import tifffile
from results import add_option, record
from scipy.ndimage import map_coordinates, spline_filter

from levkas.core.problems import Refused
from levkas.database.pixel_frames import map_points
from levkas.geometry.resample import warp
from levkas.geometry.transforms import Affine, Composed, Homography, Inverse, Lens
from levkas.registration import BandImage
from levkas.registration.tiles import place_tiles

TABLE = "tiles"
SIZE = (360, 300)
PAINTINGS = ("starry_night_google.jpg", "the_scream.jpg", "shipwreck.jpg")


# --- tiles cut from a painting


def cut_tiles(image, overlap, rng, *, turn=0.01, rows=3, columns=3, snr=40):
    """Return name → BandImage, name → map of tile px to px of the painting, and name → corner as a stage would have it."""
    (w, h), middle = SIZE, (np.array(SIZE) - 1) / 2
    lens = Lens(middle, max(SIZE) / 2, (0.01, -0.002), (0.0005, -0.0003))
    smooth = spline_filter(image.astype(float))
    x, y = np.meshgrid(np.arange(w), np.arange(h))
    points = np.stack([x.ravel(), y.ravel()], 1).astype(float)
    tiles, truth, starts = {}, {}, {}
    for row in range(rows):
        for column in range(columns):
            corner = 25 + np.array([column * w, row * h]) * (1 - overlap)
            angle, size = rng.normal() * turn, 1 + rng.normal() * 1e-3
            matrix, away, tilt = np.eye(3), np.eye(3), np.eye(3)
            matrix[:2, :2] = size * np.array(
                [[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]]
            )
            matrix[:2, 2] = corner + middle + rng.normal(size=2) * 6
            away[:2, 2] = -middle
            tilt[2, :2] = rng.normal(size=2) * 1e-5
            onto = Composed(Inverse(lens), Homography(matrix @ tilt @ away))
            places = onto(points).T[::-1]
            seen = map_coordinates(smooth, places, order=3, prefilter=False, mode="reflect")
            seen = np.clip(seen.reshape(h, w), 1, None)
            seen += rng.normal(size=seen.shape) * np.sqrt(seen / 255) * 255 / snr
            name = f"r{row}c{column}"
            tiles[name] = BandImage.of("1", seen.astype(np.float32))
            truth[name], starts[name] = onto, tuple(corner)
    return tiles, truth, starts


def lattice():
    return np.stack(
        np.meshgrid(np.linspace(0, SIZE[0] - 1, 11), np.linspace(0, SIZE[1] - 1, 11)), -1
    ).reshape(-1, 2)


def errors_of(transforms, truth):
    """Return errors of a lattice of px of every tile, px of the painting, after one homography of all."""
    names, points = sorted(transforms), lattice()
    ours = np.concatenate([transforms[name](points) for name in names])
    theirs = np.concatenate([truth[name](points) for name in names])
    return np.linalg.norm(Homography.fit(ours, theirs)(ours) - theirs, axis=1)


# --- other ways


def chain(tiles):
    """Key points (SIFT, RANSAC homographies) from tile to tile along the rows, down the first column."""
    sift = cv2.SIFT_create()
    found = {}
    for name, tile in tiles.items():
        found[name] = sift.detectAndCompute(np.clip(tile.values, 0, 255).astype(np.uint8), None)
    laid = {}
    for name in sorted(tiles):
        row, column = map(int, re.findall(r"\d+", name))
        if row == column == 0:
            laid[name] = np.eye(3)
            continue
        before = f"r{row}c{column - 1}" if column else f"r{row - 1}c0"
        (a, ours), (b, theirs) = found[name], found[before]
        pairs = [
            m for m, n in cv2.BFMatcher().knnMatch(ours, theirs, 2) if m.distance < 0.8 * n.distance
        ]
        if before not in laid or len(pairs) < 4:
            continue
        p, q = (
            np.array([k[i].pt for i in of])
            for k, of in ((a, [m.queryIdx for m in pairs]), (b, [m.trainIdx for m in pairs]))
        )
        matrix, _ = cv2.findHomography(p, q, cv2.RANSAC, 2.0)
        if matrix is not None:
            laid[name] = laid[before] @ matrix
    return {name: Homography(matrix) for name, matrix in laid.items()}


def by_shifts(tiles, starts, overlap):
    """Shifts of neighbours by phase correlation of the overlap that positions give, and the least squares of all shifts."""
    names = sorted(tiles)
    number, rows, goals = {name: k for k, name in enumerate(names)}, [], []
    for name in names:
        row, column = map(int, re.findall(r"\d+", name))
        for other, axis in ((f"r{row}c{column + 1}", 0), (f"r{row + 1}c{column}", 1)):
            if other not in tiles:
                continue
            step = round(SIZE[axis] * (1 - overlap))
            a, b = tiles[name].values, tiles[other].values
            a, b = (
                (a[:, step:], b[:, : SIZE[0] - step])
                if axis == 0
                else (a[step:], b[: SIZE[1] - step])
            )
            window = cv2.createHanningWindow(a.shape[::-1], cv2.CV_32F)
            (dx, dy), _ = cv2.phaseCorrelate(a, np.ascontiguousarray(b), window)
            shift = np.array([-dx, -dy])
            shift[axis] += step
            line = np.zeros(len(names))
            line[number[other]], line[number[name]] = 1, -1
            rows.append(line)
            goals.append(shift)
    rows.append(np.eye(len(names))[0])
    goals.append(np.zeros(2))
    places = np.linalg.lstsq(np.array(rows), np.array(goals), rcond=None)[0]
    return {
        name: Homography(np.array([[1.0, 0, x], [0, 1, y], [0, 0, 1]]))
        for name, (x, y) in zip(names, places, strict=True)
    }


def opencv_bundle(tiles):
    """OpenCV's stitching pipeline as its scans mode has it: SIFT, partial affine matches and bundle adjustment."""
    names = sorted(tiles)
    pictures = [
        cv2.cvtColor(np.clip(tiles[n].values, 0, 255).astype(np.uint8), cv2.COLOR_GRAY2BGR)
        for n in names
    ]
    finder = cv2.SIFT_create()
    features = [cv2.detail.computeImageFeatures2(finder, picture) for picture in pictures]
    matches = cv2.detail_AffineBestOf2NearestMatcher(False, False, 0.3).apply2(features)
    ok, cameras = cv2.detail_AffineBasedEstimator().apply(features, matches, None)
    if not ok:
        return {}
    for camera in cameras:
        camera.R = camera.R.astype(np.float32)
    adjuster = cv2.detail_BundleAdjusterAffinePartial()
    adjuster.setConfThresh(1.0)
    ok, cameras = adjuster.apply(features, matches, cameras)
    return (
        {
            n: Homography(np.linalg.inv(c.R.astype(float)))
            for n, c in zip(names, cameras, strict=True)
        }
        if ok
        else {}
    )


def attempt(work, *arguments):
    try:
        return work(*arguments)
    except (cv2.error, AttributeError, np.linalg.LinAlgError) as error:
        print("   ", work.__name__, "failed:", str(error).splitlines()[0][:100])
        return {}


def paintings(folder, seeds):
    values = {}
    for overlap in (0.25, 0.1):
        gathered: dict[str, list] = {}
        for name in PAINTINGS:
            image = cv2.imread(str(folder / name), cv2.IMREAD_GRAYSCALE)
            image = cv2.resize(image, (1180, 1000), interpolation=cv2.INTER_AREA)
            for seed in range(seeds):
                tiles, truth, starts = cut_tiles(image, overlap, np.random.default_rng(seed))
                placed = place_tiles(tiles, starts=starts)
                ways = {
                    "Levkas": placed.transforms,
                    "Levkas, plain homographies": place_tiles(tiles, starts=starts, lens=False).transforms,
                    "chain of key points": attempt(chain, tiles),
                    "shifts by phase correlation": attempt(by_shifts, tiles, starts, overlap),
                    "OpenCV's bundle adjustment": attempt(opencv_bundle, tiles),
                }  # fmt: skip
                for way, transforms in ways.items():
                    errors = errors_of(transforms, truth) if len(transforms) > 2 else [np.nan]
                    gathered.setdefault(way, []).append(
                        (np.mean(errors), np.max(errors), len(transforms))
                    )
                ratio = np.sqrt(np.mean(errors_of(placed.transforms, truth) ** 2) / 2) / np.sqrt(
                    np.mean(np.square(list(placed.sigma.values())))
                )
                gathered.setdefault("ratio", []).append(ratio)
                print(
                    f"{name} {overlap} seed {seed}:",
                    {w: np.round(v[-1], 3).tolist() for w, v in gathered.items()},
                    f"rms {placed.rms:.3f}",
                    placed.left_out,
                    flush=True,
                )
        column = f"overlap {round(100 * overlap)} %"
        ratio = gathered.pop("ratio")
        for way, found in gathered.items():
            mean, most, count = np.array(found).T
            print(
                f"{column:>12} {way:28} mean {np.nanmean(mean):7.3f}  largest {np.nanmax(most):7.2f} px   tiles {count.mean():.1f} of 9"
            )
            values[way, column] = float(np.nanmean(mean)) if np.isfinite(mean).any() else None
        values["error over sigma", column] = float(np.sqrt(np.mean(np.square(ratio))))
        print(f"{column:>12} error over sigma {values['error over sigma', column]:.2f}")
    return values


def real(folder):
    tiles = {}
    for path in sorted(folder.glob("*.jpg")):
        row, column = re.search(r"@(\d+) (\d+)", path.name).groups()
        tiles[f"r{row}c{column}"] = BandImage.of("1", cv2.imread(str(path), cv2.IMREAD_GRAYSCALE))
    values = {}
    for way, lens in (("Levkas", True), ("Levkas, plain homographies", False)):
        placed = place_tiles(tiles, lens=lens)
        print(f"{way:28} rms {placed.rms:.3f} px  left-out windows {placed.errors}")
        values[way, "real tiles, rms"] = placed.rms
    return values


# --- a whole build


BUILD_KEYS = """[campaign]
reference = { camera = "photo" }
[cameras.photo]
kind = "image"
files = "photo/{target}_r{row}c{column}.tif"
"""
OTHERS = ("infrared", "colour")
MOST_SOURCES = 40  # tiles from which maps are compared
BUILT_STEP, SPACINGS = 0.86, (3, 8, 30, 150)


def write_panel(folder, rows, columns, tile_size, others, rng):
    """Write tiles of a panel of noise of four sizes; return the map of each, its px → px of the panel."""
    width, height = (
        round(side * (1 + BUILT_STEP * (n - 1)) + 400)
        for side, n in zip(tile_size, (columns, rows), strict=True)
    )
    grids = {
        s: rng.standard_normal((height // s + 4, width // s + 4), np.float32) for s in SPACINGS
    }
    frames, sizes, scales, keys = {}, {"photo": tile_size}, {"photo": 1.0}, BUILD_KEYS
    for row, column in np.ndindex(rows, columns):
        step = np.array([column, row]) * BUILT_STEP * tile_size + 200 + rng.uniform(-25, 25, 2)
        frames[f"photo#r{row + 1}c{column + 1}"] = laid(step, rng.normal(0, 2e-3), 1.0, rng)
    for camera, (down, across) in zip(OTHERS, others, strict=False):
        scale = (width + 200) / across / tile_size[0]
        size = (tile_size[0], round((height + 200) / down / scale))
        free = np.array([width - scale * size[0], height - scale * size[1]])
        for row, column in np.ndindex(down, across):
            step = free * (column / max(across - 1, 1), row / max(down - 1, 1))
            frames[f"{camera}#r{row + 1}c{column + 1}"] = laid(step, 0.004, scale, rng)
        sizes[camera], scales[camera] = size, scale
        keys += f'[cameras.{camera}]\nkind = "image"\nfiles = "{camera}/{{target}}_r{{row}}c{{column}}.tif"\n'
    for name, frame in frames.items():
        camera, _, tile = name.partition("#")
        shape = tuple(sizes[camera])[::-1]
        values = np.zeros(shape, np.float32)
        for spacing, grid in grids.items():
            inside = Affine(np.array([[1 / spacing, 0, 2], [0, 1 / spacing, 2]]))
            # A coarser camera does not see what is finer than its px.
            if spacing > 1.5 * scales[camera]:
                values += np.nan_to_num(warp(grid, Composed(frame, inside), shape).values)
        noise = rng.standard_normal(shape, np.float32)
        counts = np.clip(20000 + 5000 * values + 400 * noise, 0, 65535)
        path = folder / camera / f"panel_{tile}.tif"
        path.parent.mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(path, counts.astype(np.uint16), photometric="minisblack")
    (folder / "campaign.toml").write_text(keys)
    return frames


def laid(corner, turn, scale, rng):
    """Return a homography: a turn and a scale about a corner, and a tilt of some px."""
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    tilt = rng.normal(0, 2e-7, 2)
    return Homography(np.array([[c, -s, corner[0]], [s, c, corner[1]], [*tilt, 1.0]]))


def whole_build(folder, rows, columns, tile_size, others):
    frames = write_panel(folder, rows, columns, tile_size, others, np.random.default_rng(0))
    command = [Path(sys.executable).with_name("levkas"), "build", folder]
    clock = time.perf_counter()
    subprocess.run(command, check=False)
    minutes = (time.perf_counter() - clock) / 60
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    lattice = np.stack(np.meshgrid(*(np.linspace(20, side - 21, 15) for side in tile_size)), -1)
    points = lattice.reshape(-1, 2)
    errors = {name.partition("#")[0]: [] for name in frames}
    some = set(list(frames)[:: 1 + len(frames) // MOST_SOURCES])
    for source, target in combinations(frames, 2):
        if source not in some or not source.startswith("photo") or source == target:
            continue
        truth = frames[target].inverse(frames[source](points))
        seen = np.ones(len(points), bool)
        if target.startswith("photo"):
            seen = ((truth >= 0) & (truth < tile_size)).all(1)
        if not seen.any():
            continue
        try:
            found = map_points(folder / "database", "panel", points, source=source, target=target)
        except Refused:
            continue
        known = np.isfinite(found).all(1) & seen
        errors[target.partition("#")[0]] += np.linalg.norm(found - truth, axis=1)[known].tolist()
    mpx = rows * columns * tile_size[0] * tile_size[1] / 1e6
    values = {"Mpx of the reference": mpx, "minutes": minutes}
    values["GB of memory"] = after.ru_maxrss / 1e6
    for camera, found in errors.items():
        values[f"{camera}: mean, px of a tile"] = float(np.mean(found or [np.nan]))
        values[f"{camera}: largest, px of a tile"] = float(np.max(found or [np.nan]))
    for name, value in values.items():
        print(f"{name:34} {value:.3f}")
    return values


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--build", type=Path)
    parser.add_argument("--rows", type=int, default=4)
    parser.add_argument("--columns", type=int, default=6)
    parser.add_argument(
        "--size", type=int, nargs=2, default=(4000, 3000), help="width and height of a tile, px"
    )
    parser.add_argument(
        "--others-in", nargs="+", default=["2x2"], help="rows and columns of other cameras' tiles"
    )
    add_option(parser)
    given = parser.parse_args()
    if given.build:
        others = [tuple(map(int, one.split("x"))) for one in given.others_in]
        built = whole_build(given.build, given.rows, given.columns, given.size, others)
        record(given.results, TABLE + "-build", built)
    if given.data:
        values = real(given.data / "tiles-section")
        values |= paintings(given.data / "paintings", given.seeds)
        record(given.results, TABLE, values)


if __name__ == "__main__":
    main()
