"""Tiles joined: real ones, tiles cut from paintings by known maps, and a mosaic of tens of thousands of simulated observations.

    python benchmarks/tiles.py --data FOLDER [--seeds 2] [--results results.json]
    python benchmarks/tiles.py --tiles 30000 [--results results.json]
    python benchmarks/tiles.py --surfaces [--results results.json]
    python benchmarks/tiles.py --build FOLDER [--columns 6] [--rows 4] [--size 4000 3000] [--others-in 2x2 4x3]

The first form takes the tiles of a polished section (`tiles-section`, grey JPEG files named by row and column) and paintings (`paintings`)
in the folder. Of the real tiles there is no truth: how well windows agree after one adjustment, and how well loops close, with the lens and
as plain homographies. The paintings are cut into tiles of 360 x 300 px, turned, tilted and scaled at random, seen through a lens of 1 %, with
noise, and joined again; the error of all px, against the cut and after one homography of the whole, stands beside that of a chain of key
points from tile to tile, of whole-tile correlation at given positions (as ashlar and MIST work) and of OpenCV's bundle adjustment.
The second form adjusts observations alone: time, memory, and errors over the sigma that the adjustment promises.
The third photographs panels that are not flat: nine tiles of 600 x 500 px by a pinhole camera, 1,500 px away, that a stage moves, every ray traced to
the surface; by how much two tiles put one place of the panel apart where both see it, placed as on one plane and as Levkas places them.
The fourth builds a database from tiles of a photograph (by default of 12 Mpx) and from tiles of one or two other cameras that lie on all of it, in a new
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
from levkas.registration.tiles import adjustment, place_tiles
from levkas.registration.tiles.adjustment import Windows, adjust
from levkas.registration.tiles.tile_maps import SHARED, TileFrame, TileMaps
from levkas.stages.tile_placement import OVERLAP_UNKNOWNS

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
        loops = [loop["closure"] for loop in placed.loops]
        print(
            f"{way:28} rms {placed.rms:.3f} px  loops {max(loops):.3f} px  left-out windows {placed.errors}"
        )
        values[way, "real tiles, rms"], values[way, "real tiles, loops"] = placed.rms, max(loops)
    return values


# --- panels that are not flat

SEEN, AWAY, PITCH = np.array([600, 500]), 1500.0, 0.75
PANEL = SEEN * (1 + 2 * PITCH)
#: Of its width; bent as a cylinder, recessed smoothly over half of the panel, stepped over 5 % of its width.
SURFACES = {
    "flat": lambda x, y: 0 * x,
    "bent 1 %": lambda x, y: PANEL[0] * 0.04 * x**2,
    "recessed 0.3 %": lambda x, y: -PANEL[0] * 0.003 * np.exp(-(x**2 + y**2) / 0.18),
    "recessed 1 %": lambda x, y: -PANEL[0] * 0.01 * np.exp(-(x**2 + y**2) / 0.18),
    "stepped 0.5 %": lambda x, y: (
        PANEL[0] * 0.0025 * np.tanh((np.maximum(abs(x), abs(y)) - 0.3) / 0.025)
    ),
}  # fmt: skip


class Pinhole:
    """A camera above the panel: px to rays, rays to the surface, and back."""

    def __init__(self, middle, rng):
        lean, turn = rng.normal(size=2) * 1e-3, rng.normal() * 5e-3
        turned, _ = cv2.Rodrigues(np.array([*lean, turn]))
        self.axes = turned
        self.place = np.append(middle + rng.normal(size=2) * 4, AWAY * (1 + rng.normal() * 1e-3))
        self.middle = (SEEN - 1) / 2

    def hit(self, points, surface):
        flat = (points - self.middle) / (SEEN[0] / 2)
        for _ in range(8):  # its lens: 0.6 % at the rim
            flat = (points - self.middle) / (SEEN[0] / 2) / (1 + 0.006 * (flat**2).sum(1)[:, None])
        rays = np.column_stack([flat * SEEN[0] / 2, np.full(len(flat), -AWAY)]) @ self.axes.T
        along = np.full(len(rays), 1.0)
        for _ in range(60):
            place = self.place + along[:, None] * rays
            height = surface(*((place[:, :2] - PANEL / 2) / PANEL[0]).T)
            along += (place[:, 2] - height) / -rays[:, 2]
        return self.place + along[:, None] * rays

    def see(self, places):
        seen = (places - self.place) @ self.axes
        flat = seen[:, :2] / -seen[:, 2:] * AWAY / (SEEN[0] / 2)
        return flat * (1 + 0.006 * (flat**2).sum(1)[:, None]) * SEEN[0] / 2 + self.middle


def photographed(surface, seed):
    """Return pictures of nine tiles, and their cameras."""
    rng = np.random.default_rng(seed)
    shape = tuple((PANEL[::-1] + 200).astype(int))
    total = np.zeros(shape)
    for blur in (1.3, 2.5, 6.0, 15.0):
        layer = cv2.GaussianBlur(rng.standard_normal(shape), (0, 0), blur)
        total += layer / layer.std()
    paint = spline_filter(0.5 + 0.08 * total)
    x, y = np.meshgrid(np.arange(SEEN[0]), np.arange(SEEN[1]))
    points = np.stack([x.ravel(), y.ravel()], 1).astype(float)
    tiles, cameras = {}, {}
    for row, column in np.ndindex(3, 3):
        camera = Pinhole(np.array([column, row]) * PITCH * SEEN + SEEN / 2, rng)
        places = camera.hit(points, surface)[:, 1::-1].T + 100
        seen = map_coordinates(paint, places, order=3, prefilter=False, mode="nearest")
        seen = seen.reshape(SEEN[::-1]) + rng.normal(size=SEEN[::-1]) * 0.008
        name = f"r{row}c{column}"
        tiles[name], cameras[name] = BandImage.of("1", seen.astype(np.float32)), camera
    return tiles, cameras


def apart(transforms, cameras, surface):
    """Return by how much neighbours put places apart that both see, mosaic px."""
    x, y = (np.linspace(0, side - 1, 41) for side in SEEN)
    points, found = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2), []
    for one, other in combinations(sorted(transforms), 2):
        there = cameras[other].see(cameras[one].hit(points, surface))
        both = ((there >= 0) & (there <= SEEN - 1)).all(1)
        if both.sum() > 50:
            off = transforms[one](points[both]) - transforms[other](there[both])
            found.append(np.linalg.norm(off, axis=1))
    return np.concatenate(found)


def surfaces():
    values = {}
    least = adjustment.LEAST_TILES
    for name, surface in SURFACES.items():
        tiles, cameras = photographed(surface, 0)
        for way, tried in (("one plane", 10**9), ("Levkas", least)):
            adjustment.LEAST_TILES = tried
            placed = place_tiles(tiles)
            off = apart(placed.transforms, cameras, surface)
            values[name, f"{way}, mean"] = float(off.mean())
            values[name, way] = float(off.max())
        beside = [
            (OVERLAP_UNKNOWNS * o["sigma"] ** 2 + max(o["off"], o["misfit"]) ** 2)
            for o in placed.overlaps
            if o["used"]
        ]
        values[name, "error over sigma"] = float(np.sqrt((off**2).mean() / 2 / np.mean(beside)))
        print(
            f"{name:42}",
            {w: round(v, 3) for (n, w), v in values.items() if n == name},
            f"parallax {placed.surface:.1f} px",
            {k: round(v, 3) for k, v in placed.errors.items()},
            flush=True,
        )
    return values


# --- very many tiles, observations alone


def simulate(rows, columns, rng, *, noise=0.03):
    """Return windows of a mosaic, where to begin, and the planted maps: tiles of 4000 x 3000 px that overlap by 12 %."""
    size = (4000, 3000)
    frame = TileFrame.of_size(size)
    step = np.array(size) * 0.88
    index = np.arange(rows * columns).reshape(rows, columns)
    across = np.stack([index[:, :-1].ravel(), index[:, 1:].ravel()], 1)
    down = np.stack([index[:-1].ravel(), index[1:].ravel()], 1)
    pairs = np.concatenate([across, down])
    pairs = pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))]
    count = rows * columns
    own = np.zeros((count, 8))
    nominal = np.stack([index.ravel() % columns, index.ravel() // columns], 1) * step
    angle, scale = rng.normal(size=count) * 2e-3, 1 + rng.normal(size=count) * 3e-5
    own[:, 0], own[:, 1] = (
        frame.spread * scale * np.cos(angle),
        frame.spread * scale * np.sin(angle),
    )
    own[:, 2:4] = nominal + rng.normal(size=(count, 2)) * 20
    own[:, 6:] = rng.normal(size=(count, 2)) * 1e-4 * frame.spread
    shared = np.zeros(SHARED)
    shared[:4] = np.array([0.008, -0.001, 2e-4, -1e-4]) * frame.spread
    truth = TileMaps(frame, own, shared)
    first, second = [], []
    u, v = np.meshgrid([-0.055, 0.0, 0.055], np.linspace(-0.42, 0.42, 4))
    for side in (0, 1):
        cross = np.stack([u.ravel(), v.ravel()], 1)[:, :: 1 if side == 0 else -1] * size
        first.append(cross + frame.centre + 0.44 * step_along(side, size))
    which = (pairs[:, 1] - pairs[:, 0] != 1).astype(int)
    points = np.array(first)[which]
    overlap = np.repeat(np.arange(len(pairs)), points.shape[1])
    points = points.reshape(-1, 2)
    tile = pairs[overlap]
    place = truth(tile[:, 0], points)
    partner = points - np.array([step_along(0, size), step_along(1, size)])[which[overlap]] * 0.88
    for _ in range(6):
        there, by_px, _, _ = truth.linearised(tile[:, 1], partner)
        partner = partner + np.linalg.solve(by_px, (place - there)[..., None])[..., 0]
    second = partner + rng.normal(size=points.shape) * noise
    information = np.broadcast_to(np.eye(2) / noise**2, (len(points), 2, 2)).copy()
    begin = np.zeros((count, 8))
    begin[:, 0], begin[:, 2:4] = frame.spread, nominal
    windows = Windows(pairs, overlap, points, second, information)
    return windows, TileMaps(frame, begin, np.zeros(SHARED)), truth


def step_along(side, size):
    return np.array([size[0], 0.0]) if side == 0 else np.array([0.0, size[1]])


def many(count):
    rows = max(2, round(np.sqrt(count * 0.75)))
    columns = max(2, round(count / rows))
    windows, begin, truth = simulate(rows, columns, np.random.default_rng(0))
    clock = time.process_time()
    adjusted = adjust(windows, begin)
    minutes = (time.process_time() - clock) / 60
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    tiles = np.arange(rows * columns)
    middle = np.tile(begin.frame.centre, (len(tiles), 1))
    ours, theirs = adjusted.maps(tiles, middle), truth(tiles, middle)
    some = slice(None, None, 1 + len(tiles) // 500)
    off = Homography.fit(ours[some], theirs[some])(ours) - theirs
    variance = np.array([np.trace(adjusted.place_covariance(k, middle[:1])[0]) / 2 for k in tiles])
    away = np.linalg.norm(
        (theirs - theirs.mean(0)) / (np.ptp(theirs, axis=0) / 2), axis=1, ord=np.inf
    )
    print(
        f"{rows} x {columns} tiles, {len(windows.pairs)} overlaps, {len(windows.overlap)} windows: {minutes:.1f} min, {memory:.2f} GB, rms {adjusted.rms:.4f} px"
    )
    for low, high in ((0, 0.25), (0.25, 0.5), (0.5, 0.75), (0.75, 0.95), (0.95, 1.1)):
        here = (away >= low) & (away < high)
        print(
            f"  {low:.2f}–{high:.2f} of the way out: error {np.sqrt((off[here] ** 2).mean()):.3f} px, promised {np.sqrt(variance[here].mean()):.3f}"
        )
    near = windows.pairs
    relative = np.sqrt(((off[near[:, 0]] - off[near[:, 1]]) ** 2).mean())
    error, promised = np.sqrt((off**2).mean()), np.sqrt(variance.mean())
    print(
        f"  all: error {error:.3f} px along an axis, promised {promised:.3f}; of neighbours to one another {relative:.3f}; deviations {adjusted.deviations}"
    )
    return {
        "30,000 tiles, time": minutes,
        "30,000 tiles, memory": memory,
        "30,000 tiles, error": float(error),
        "30,000 tiles, error of neighbours to one another": float(relative),
        "30,000 tiles, error over sigma": float(error / promised),
    }


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
    parser.add_argument("--tiles", type=int)
    parser.add_argument("--surfaces", action="store_true")
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
    if given.surfaces:
        record(given.results, TABLE + "-surfaces", surfaces())
    if given.tiles:
        record(given.results, TABLE + "-many", many(given.tiles))
    if given.data:
        values = real(given.data / "tiles-section")
        values |= paintings(given.data / "paintings", given.seeds)
        record(given.results, TABLE, values)


if __name__ == "__main__":
    main()
