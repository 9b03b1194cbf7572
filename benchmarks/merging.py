"""Whole builds of merged exposures against truth and the Cramér–Rao bound, over three and a half decades.

    python benchmarks/merging.py [--side 256] [--read 2.0] [--whites 16] [--darks 8]

A sensor of 12 bits in 16-bit files (black 50, 2 electrons a count) takes one shot of twelve patches,
0.0003 to 0.95, at four exposures 4x apart, and a stack of a white at one of them. `levkas build` makes
reflectance of it: as a tunable filter and as a mosaic; with the black level in campaign.toml, in the
frames (TIFF's and DNG's tag 50714) or only in darks. In a corner of each patch the scene changes before
the longest exposure that does not saturate there.

For each patch: the mean of R over truth; variance of R over the Cramér–Rao bound of the unsaturated
exposures (with the white's and the darks' own noise, whose shots are what there is); spread of
(R − truth)/sigma; and what is flagged as moved where nothing moved, and where it did. Of a mosaic each channel's own sensels
are looked at, in native pixels: what demosaicing makes of the others is not the merge's.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
import tifffile
from results import add_option, record

from levkas.building import build
from levkas.core.cube import Flag

BLACK, GAIN, FULL = 50.0, 0.5, 4095
WHITE = 12_000.0  # counts a second of R = 1
TIMES, WHITE_TIME = (0.0625, 0.25, 1.0, 4.0), 0.25
PATCHES = np.array([0.0003, 0.001, 0.003, 0.005, 0.01, 0.03, 0.06, 0.12, 0.25, 0.4, 0.6, 0.95])
CHANGE = 0.75  # of the light where something moved
SUFFIX = {"dng": ".dng"}
KEYS = """
[campaign]
title = "merging"
reference = { camera = "cam" }
[cameras.cam]
KIND
bits = 12
exposures = "merge"
[targets]
DARK
white = { names = "white", reflectance = 1.0 }
objects = ["panel"]
"""
KINDS = {
    "bands": 'kind = "bands"\nfiles = "raw/{target}_{wavelength}nm_{exposure}ms_{shot}.tif"',
    "mosaic": 'kind = "mosaic"\npattern = [["A", "B"], ["C", "D"]]\nfiles = "raw/{target}_*_{exposure}ms_{shot}.tif"',
}


COLUMNS = ("bias", "variance / bound", "spread")


def scene(side: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the patches, and where something moves: in a square of an eighth of each patch's side."""
    panel = np.kron(PATCHES.reshape(3, 4), np.ones((side, side)))
    square = np.zeros((side, side), bool)
    square[: side // 8, : side // 8] = True
    return panel, np.kron(np.ones((3, 4)), square) > 0


def responses(shape: tuple[int, int]) -> np.ndarray:
    """Return what sensels make of the same light."""
    return 1 + 0.01 * np.random.default_rng(2).standard_normal(shape)


def longest(reflectance: np.ndarray) -> np.ndarray:
    """Return the index of the longest exposure that is not saturated."""
    full = [WHITE * reflectance * t + BLACK < 0.9 * FULL for t in TIMES]
    return np.sum(full, 0) - 1


def write(folder: Path, kind: str, black: str, options: argparse.Namespace) -> None:
    rng = np.random.default_rng([ord(letter) for letter in kind + black])
    panel, moving = scene(options.side)
    response = responses(panel.shape)
    (folder / "raw").mkdir()
    last = longest(panel)
    taken = [("panel", i, t, 1) for i, t in enumerate(TIMES)]
    taken.append(("white", -1, WHITE_TIME, options.whites))
    taken += [("dark", -1, t, options.darks) for t in TIMES] if black == "darks" else []
    tags = [(50714, "H", 1, int(BLACK), True)] if black in ("frames", "dng") else []
    dng = [
        (33421, "H", 2, (2, 2), True), (33422, "B", 4, bytes([0, 1, 1, 2]), True),
        (50706, "B", 4, bytes([1, 4, 0, 0]), True), (50708, "s", 0, "Levkas bench", True),
        (50717, "H", 1, FULL, True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        (50778, "H", 1, 21, True), (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
    ]  # fmt: skip
    for name, index, time, shots in taken:
        scene_in_shot = {"panel": panel, "white": 1 + 0 * panel, "dark": 0 * panel}[name]
        scene_in_shot = np.where(moving & (last == index), CHANGE * scene_in_shot, scene_in_shot)
        electrons = WHITE * time * scene_in_shot * response / GAIN
        for shot in range(shots):
            light = GAIN * rng.poisson(electrons)
            codes = np.rint(light + rng.normal(BLACK, options.read, panel.shape)).clip(0, FULL)
            path = (
                folder / "raw" / f"{name}_550nm_{1000 * time:g}ms_{shot}{SUFFIX.get(black, '.tif')}"
            )
            codes, more = codes.astype(np.uint16), {}
            if black == "dng":
                more = {"photometric": 32803}
            tifffile.imwrite(
                path,
                codes,
                extratags=tags + (dng if more else []),
                **more,
            )
    text = KINDS[kind] + (f"\nblack = {BLACK:g}" if black == "campaign" else "")
    if black == "dng":
        text = text.replace(".tif", ".dng").replace('pattern = [["A", "B"], ["C", "D"]]\n', "")
    keys = KEYS.replace("KIND", text).replace("DARK", 'dark = "dark"' if black == "darks" else "")
    (folder / "campaign.toml").write_text(keys + "\n[database]\nnative = true\n")


def bound(
    rate: np.ndarray, of_white: np.ndarray, black: str, options: argparse.Namespace
) -> np.ndarray:
    """Return the least variance of R that the frames allow, of counts a second."""
    read = options.read**2 + 1 / 12
    dark = read / options.darks if black == "darks" else 0.0
    weight = np.zeros(rate.shape)
    for t in TIMES:
        usable = rate * t + BLACK < 0.98 * FULL
        weight += usable * t**2 / (GAIN * rate * t + read + dark)
    white = of_white * WHITE_TIME
    of_own = (GAIN * white + read) / options.whites + dark
    reflectance = rate / of_white
    return 1 / weight / of_white**2 + reflectance**2 * of_own / white**2


def measured(folder: Path, kind: str, black: str, options: argparse.Namespace) -> np.ndarray:
    """Print a line a patch; return bias %, variance over the bound and spread of each, (patches, 3)."""
    write(folder, kind, black, options)
    for step in build(folder):
        if step.state in ("refused", "failed"):
            raise SystemExit(f"{kind}, black from {black}: {step}")
    stem = folder / "database/objects/panel/native/panel_cam"
    values, flags, sigma = (
        np.moveaxis(np.atleast_3d(tifffile.imread(f"{stem}{part}.tif").T), (0, 1), (1, 0))
        for part in ("", ".flags", ".sigma")
    )
    panel, moving = scene(options.side)
    y, x = np.indices(panel.shape)
    channel = (y % 2) * 2 + x % 2 if values.shape[2] > 1 else 0 * y
    if black == "dng":  # red, green, blue; green on two phases
        channel = np.array([0, 1, 1, 2])[channel]
    pick = lambda cube: np.take_along_axis(cube, channel[..., None], 2)[..., 0]  # noqa: E731
    value, flag, spread = pick(values), pick(flags), pick(sigma)
    response = responses(panel.shape)
    white, imaged = WHITE * response, WHITE * panel * response
    truth = imaged / white
    least = bound(imaged, white, black, options)
    edge = 3
    rim = np.pad(np.ones((options.side - 2 * edge,) * 2, bool), edge)
    corner = np.zeros((options.side,) * 2, bool)
    corner[: options.side // 8 + edge, : options.side // 8 + edge] = True
    inside, corner = (np.kron(np.ones((3, 4)), part) > 0 for part in (rim, corner))
    there = inside & moving & np.roll(moving, (-edge, -edge), (0, 1))
    usable = inside & ~corner
    print(f"\n{kind}, black from {black}")
    print(
        "      R   bias %  (± of it)   variance/bound   (R − truth)/sigma   moved where not %   and where %"
    )
    found = []
    for reflectance in PATCHES:
        part = panel == reflectance
        here = part & usable
        miss = value[here] - truth[here]
        ratio = 100 * miss / truth[here]
        bias, own = ratio.mean(), ratio.std() / np.sqrt(miss.size)
        over = ((miss - miss.mean()) ** 2 / least[here]).mean()
        z = (miss / spread[here]).std()
        false = 100 * np.mean(flag[here] & Flag.MOVED > 0)
        true = 100 * np.mean(flag[part & there] & Flag.MOVED > 0) if moving.any() else np.nan
        print(
            f"{reflectance:7.4f}  {bias:+7.2f}  {own:7.2f}  {over:12.3f} {z:16.3f} {false:20.2f} {true:15.0f}"
        )
        found.append((bias, over, z))
    return np.array(found)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--side", type=int, default=256, help="of a patch, px")
    parser.add_argument("--read", type=float, default=2.0, help="read noise, counts")
    parser.add_argument("--whites", type=int, default=16)
    parser.add_argument("--darks", type=int, default=8, help="of each exposure")
    parser.add_argument("--only", default="", help="for example bands:darks")
    add_option(parser)
    options = parser.parse_args()
    figures = {}
    for kind in KINDS:
        for black in ("campaign", "frames", "dng", "darks"):
            if (kind, black) == ("bands", "dng") or options.only not in f"{kind}:{black}":
                continue
            with tempfile.TemporaryDirectory() as folder:
                found = measured(Path(folder), kind, black, options)
            name = {"campaign": "campaign.toml", "dng": "DNG"}.get(black, black)
            for column, several in zip(COLUMNS, found.T, strict=True):
                figures[f"{kind}, {name}", column] = (several.min(), several.max())
    record(options.results, "merging", figures)


if __name__ == "__main__":
    main()
