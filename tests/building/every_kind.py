"""A small campaign of every kind of camera, with two setups, a manifest, points and tables beside it."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np
import tifffile

BLACK, FULL = 60.0, 3400.0
CAMPAIGN = """
[campaign]
title = "Every kind"
creator = "A. Maker"
date = 2019-08-29
licence = "CC0-1.0"
reference = { camera = "photo", band = "G" }
"""
CAMERAS = {
    "photo": """
kind = "image"
files = "photo/{target}.png"
""",
    "xray": """
kind = "image"
files = "xray/{target}.png"
""",
    "filters": """
kind = "bands"
files = "filters/{target}_{wavelength}nm.tif"
manifest = "exposures.csv"
bits = 12
black = 60
""",
    "colour": """
kind = "mosaic"
files = "colour/{target}.tif"
pattern = "RGGB"
sensitivity = "colour.csv"
bits = 12
black = 60
""",
    "twin": """
kind = "sensors"
files = "twin/{target}_{sensor}.tif"
bits = 12
black = 60
[[cameras.twin.sensors]]
name = "near"
bands = ["N"]
[[cameras.twin.sensors]]
name = "far"
bands = ["F"]
""",
    "scan": """
kind = "cube"
files = "scan/{target}.hdr"
wavelengths = [500, 600]
bits = 12
black = 60
""",
}
TARGETS = """
[targets]
dark = "dark"
white = { names = "white", reflectance = "white.csv" }
objects = OBJECTS
"""
REST = """
[objects.one]
title = "The first"
size_mm = [120, 100]
[setups.raking]
title = "Raking light"
spectrum = "lamp.csv"
cameras = { filters = { files = "raking/{target}_{wavelength}nm.tif" } }
[registration]
points = "{object}_{camera}.csv"
"""
SIZE = (240, 200)


def view(
    number: int, inverted: bool = False, shift: float = 6.0, size: tuple[int, int] = SIZE
) -> np.ndarray:
    """A painting as a camera sees it, 0 to 1; every camera stands a little elsewhere."""
    rng = np.random.default_rng(number)
    big = np.full((400, 480), 90, np.float32)
    for _ in range(150):
        centre = rng.integers(0, [480, 400]).tolist()
        radius, grey = int(rng.integers(4, 40)), float(rng.integers(20, 235))
        cv2.circle(big, centre, radius, grey, -1, cv2.LINE_AA)
    grain = cv2.GaussianBlur(rng.standard_normal(big.shape).astype(np.float32), (0, 0), 2)
    big = np.clip(big + 60 * grain, 5, 250)
    matrix = np.array([[1.95, 0.02, shift], [-0.02, 1.95, 5.0]])
    how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    observed = cv2.warpAffine(big, matrix, size, flags=how, borderMode=cv2.BORDER_REFLECT) / 255
    return np.clip(1 - observed if inverted else observed, 0.02, 0.98)


def make(
    folder: Path,
    objects: tuple[str, ...] = ("one", "two"),
    cameras: Sequence[str] = tuple(CAMERAS),
    size: tuple[int, int] = SIZE,
) -> Path:
    """Write the campaign; only the first object was seen by other cameras than the photograph's."""
    folder.mkdir(parents=True)
    for number, name in enumerate(objects):
        observed = view(number, size=size)
        _write(folder / f"photo/{name}.png", np.dstack([255 * observed] * 3).astype(np.uint8))
        if number == 0:
            _write_others(folder, name, cameras, size)
    tables = "".join(f"[cameras.{name}]{CAMERAS[name]}" for name in cameras)
    names = ", ".join(f'"{name}"' for name in objects)
    rest = REST if "filters" in cameras else REST.replace("cameras = { filters", "# { filters")
    targets = TARGETS.replace("OBJECTS", f"[{names}]")
    if not {"filters", "colour", "scan", "twin"} & {*cameras}:
        targets = f"[targets]\nobjects = [{names}]\n"
        rest = '[objects.one]\ntitle = "The first"\nsize_mm = [120, 100]\n'
    (folder / "campaign.toml").write_text(CAMPAIGN + tables + targets + rest)
    return folder


def _write_others(folder: Path, name: str, cameras: Sequence[str], size: tuple[int, int]) -> None:
    rng = np.random.default_rng(9)

    def raw(scene: np.ndarray | float) -> np.ndarray:
        light = np.broadcast_to(scene, size[::-1]) * FULL + rng.normal(BLACK, 2, size[::-1])
        return np.rint(light).clip(0, 4095).astype(np.uint16)

    observed = {"dark": 0.0, "white": 1.0}
    _write(folder / f"xray/{name}.png", (255 * view(0, True, size=size)).astype(np.uint8))
    for number, camera in enumerate(("filters", "raking", "colour", "twin")):
        if camera not in (*cameras, "raking"):
            continue
        bands = {"filters": ["_500nm", "_600nm"], "colour": [""], "twin": ["_near", "_far"]}
        for target in ("dark", "white", name):
            for band in bands.get(camera, bands["filters"]):
                if camera == "raking" and target == "dark":
                    continue
                scene = observed.get(target, view(0, camera == "raking", 7.0 + number, size))
                _write(folder / f"{camera}/{target}{band}.tif", raw(scene))
    if "scan" in cameras:
        for target in ("dark", "white", name):
            cube = [raw(observed.get(target, view(0, False, 9.0 + n, size))) for n in range(2)]
            data = np.stack([plane[:1] if target in observed else plane for plane in cube], axis=1)
            _write_cube(folder / f"scan/{target}", data)
    (folder / "exposures.csv").write_text(
        "file,exposure_s\n"
        + "".join(f"{t}_{w}nm.tif,0.1\n" for t in ("dark", "white", name) for w in (500, 600))
    )
    rows = "".join(
        f"{w},{(w < 500):d},{500 <= w < 600:d},{(w >= 600):d}\n" for w in range(400, 710, 10)
    )
    (folder / "colour.csv").write_text("wavelength,R,G,B\n" + rows)
    (folder / "white.csv").write_text("wavelength,reflectance\n400,0.98\n800,0.97\n")
    (folder / "lamp.csv").write_text("wavelength,power\n400,1.0\n800,1.5\n")


def _write(path: Path, picture: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".tif":
        tifffile.imwrite(path, picture)
    else:
        path.write_bytes(cv2.imencode(path.suffix, picture)[1].tobytes())


def _write_cube(path: Path, lines: np.ndarray) -> None:
    """Write an ENVI cube (lines, bands, samples), interleaved by line."""
    path.parent.mkdir(parents=True, exist_ok=True)
    count, bands, samples = lines.shape
    path.with_suffix(".hdr").write_text(
        f"ENVI\nsamples = {samples}\nlines = {count}\nbands = {bands}\ndata type = 12\n"
        "interleave = bil\nbyte order = 0\nheader offset = 0\n"
    )
    path.with_suffix(".raw").write_bytes(lines.astype("<u2").tobytes())
