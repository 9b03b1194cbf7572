"""One small world: five cameras before one panel, a scan in two strips, a picture in two tiles, a chart; all its maps are known.

`world` of `tests/conftest.py` is this campaign, built once a run. Nothing in it may be changed: take `World.copy`.
"""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import tifffile

CAMPAIGN = """
[campaign]
title = "A small world"
creator = "Doe, Jane"
licence = "CC-BY-4.0"
date = 2019-08-29
reference = { camera = "photo", band = "G" }
[cameras.photo]
kind = "image"
files = "photo/{target}.png"
[cameras.filters]
kind = "bands"
files = "filters/{target}_{wavelength}nm_{shot}.tif"
bits = 12
[cameras.colour]
kind = "mosaic"
pattern = "RGGB"
files = "colour/{target}_{shot}.tif"
bits = 12
[cameras.scan]
kind = "cube"
files = "scan/{target}_*.hdr"
bits = 12
[cameras.xray]
kind = "image"
files = "xray/{target}_{tile}.png"
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.98 }
charts = { macbeth = "ColorChecker24" }
objects = ["panel"]
[objects.panel]
title = "A panel"
size_mm = [180, 150]
outline = [[0, 0], [359, 0], [359, 299], [0, 299]]
"""
SIZE = (360, 300)
"""Of the photograph, px."""
BLACK, LIGHT, GAIN, READ, WHITE = 60.0, 3200.0, 0.2, 2.0, 0.98
BANDS = {"filters": (500, 600), "colour": (550,), "scan": (450, 550, 650)}
LEAN = {"photo": 1.0, "filters": 0.97, "colour": 1.04, "scan": 0.93, "xray": 0.9}
STRIP, OVERLAP, TILE = 200, 60, 230
"""Samples of a strip of the scan and those that two share; columns of a tile of the X-ray, of 340."""
VIEWS = {
    "filters": (350, 290),
    "colour": (364, 304),
    "scan": (2 * STRIP - OVERLAP, 290),
    "xray": (340, 280),
}


def affine(camera: str) -> np.ndarray:
    """Return the map of a camera, px of the photograph → px of its own frame, (2, 3)."""
    turn, scale = (
        np.deg2rad({"filters": 0.8, "scan": -0.5, "xray": 1.2}.get(camera, 0.0)),
        LEAN[camera],
    )
    shift = {"filters": (3.0, 2.0), "colour": (-4.5, -3.25), "scan": (2.0, 4.0), "xray": (6.0, 3.0)}
    c, s = scale * np.cos(turn), scale * np.sin(turn)
    return np.array([[c, -s, 0], [s, c, 0]]) + np.c_[np.zeros((2, 2)), shift.get(camera, (0, 0))]


def painting() -> np.ndarray:
    """Return patches and grain at twice the photograph's size, 0.03 to 0.95, (600, 720)."""
    rng = np.random.default_rng(3)
    made = np.full((600, 720), 90, np.float32)
    for _ in range(260):
        centre, radius = rng.integers(0, [720, 600]).tolist(), int(rng.integers(4, 44))
        cv2.circle(made, centre, radius, float(rng.integers(20, 235)), -1, cv2.LINE_AA)
    grain = cv2.GaussianBlur(rng.standard_normal(made.shape).astype(np.float32), (0, 0), 2)
    return np.clip(made + 60 * grain, 8, 243) / 256


def reflectance(camera: str) -> np.ndarray:
    """Return what a camera sees of the panel, (h, w)."""
    big = painting()
    if camera == "photo":
        return cv2.resize(big, SIZE, interpolation=cv2.INTER_AREA)
    there = np.vstack([affine(camera), [0, 0, 1]])
    # px of the camera → px of the photograph → px of the painting, which is twice as fine.
    back = np.array([[2, 0, 0.5], [0, 2, 0.5], [0, 0, 1]]) @ np.linalg.inv(there)
    how = cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP
    soft = cv2.GaussianBlur(big, (0, 0), 0.7)
    return cv2.warpAffine(soft, back[:2], VIEWS[camera], flags=how, borderMode=cv2.BORDER_REFLECT)


def _codes(
    scene: np.ndarray | float, size: tuple[int, int], rng: np.random.Generator
) -> np.ndarray:
    light = LIGHT * np.broadcast_to(np.asarray(scene, float), size[::-1])
    counts = GAIN * rng.poisson(light / GAIN) + rng.normal(BLACK, READ, size[::-1])
    return np.rint(counts).clip(0, 4095).astype(np.uint16)


def _chart(size: tuple[int, int], nm: float) -> np.ndarray:
    """Return a chart on black card in a grey room, its patches as they are published."""
    from levkas.quality.targets.charts import CHARTS, reference_of

    chart = CHARTS["ColorChecker24"]
    made = np.full(size[::-1], 0.2)
    made[60:230, 45:305] = 0.03
    patches = reference_of(chart).at(np.array([nm]))
    for patch, (column, row) in zip(patches[:, 0], chart.centres.astype(int), strict=True):
        made[66 + 41 * row : 101 + 41 * row, 55 + 41 * column : 90 + 41 * column] = patch
    return made


def write_campaign(folder: Path) -> Path:
    """Write the campaign; return its folder."""
    rng = np.random.default_rng(7)
    for camera in LEAN:
        (folder / camera).mkdir(parents=True)
    photo, xray = 255 * reflectance("photo"), 255 * (1 - reflectance("xray"))
    _write_png(folder / "photo/panel.png", np.dstack([0.9 * photo, photo, 0.8 * photo]))
    for name, first in (("left", 0), ("right", VIEWS["xray"][0] - TILE)):
        _write_png(folder / f"xray/panel_{name}.png", xray[:, first : first + TILE])
    for camera in ("filters", "colour"):
        panel = reflectance(camera)
        for nm in BANDS[camera]:
            scenes = {"dark": 0.0, "white": WHITE, "panel": panel}
            scenes |= {"macbeth": _chart(VIEWS[camera], nm)} if camera == "filters" else {}
            for (target, scene), shot in ((item, n) for item in scenes.items() for n in range(2)):
                middle = f"_{nm}nm" if camera == "filters" else ""
                path = folder / camera / f"{target}{middle}_{shot}.tif"
                tifffile.imwrite(path, _codes(scene, VIEWS[camera], rng))
    panel = reflectance("scan")
    strips = {"panel_1": panel[:, :STRIP], "panel_2": panel[:, -STRIP:]}
    strips |= {"dark_1": 0 * panel[:60, :STRIP], "white_1": WHITE + 0 * panel[:60, :STRIP]}
    for name, scene in strips.items():
        size = (STRIP, len(scene))
        cube = np.stack([_codes(scene, size, rng) for _ in BANDS["scan"]], 1)
        (folder / f"scan/{name}.raw").write_bytes(cube.astype("<u2").tobytes())
        (folder / f"scan/{name}.hdr").write_text(
            f"ENVI\nsamples = {STRIP}\nlines = {len(scene)}\nbands = 3\ninterleave = bil\n"
            f"data type = 12\nbyte order = 0\nwavelength = {{{', '.join(map(str, BANDS['scan']))}}}\n"
        )
    (folder / "campaign.toml").write_text(CAMPAIGN)
    return folder


def _write_png(path: Path, picture: np.ndarray) -> None:
    codes = np.rint(picture).clip(0, 255).astype(np.uint8)
    path.write_bytes(cv2.imencode(path.suffix, codes)[1].tobytes())


@dataclass(frozen=True)
class World:
    """The campaign in its folder, built; object "panel", cameras photo (the reference), filters, colour, scan, xray."""

    folder: Path

    @property
    def database(self) -> Path:
        """Folder of the database."""
        return self.folder / "database"

    def truth(self, points: object, frame: str) -> np.ndarray:
        """Return where points of the photograph, (n, 2), lie in the frame of a camera, or in the tile "xray#right"."""
        matrix = affine(frame.partition("#")[0])
        there = np.asarray(points, float) @ matrix[:, :2].T + matrix[:, 2]
        return there - ((VIEWS["xray"][0] - TILE, 0) if frame.endswith("#right") else (0, 0))

    def reflectance(self, camera: str) -> np.ndarray:
        """Return what a camera sees of the panel, (h, w): native pixels, alike in all its bands."""
        return reflectance(camera)

    def copy(self, to: Path) -> World:
        """Return a world of one's own, to be changed and built again."""
        shutil.copytree(self.folder, to, copy_function=shutil.copy2)
        return World(to)


def build_world(shared: Path) -> World:
    """Return the world in a folder that processes of a run share: the first one builds it, the others wait."""
    from filelock import FileLock

    from levkas.building import build

    folder, done = shared / "world", shared / "world.done"
    with FileLock(shared / "world.lock"):
        if not done.exists():
            shutil.rmtree(folder, ignore_errors=True)
            steps = [*build(write_campaign(folder))]
            assert [step.line for step in steps if step.state in ("refused", "failed")] == []
            done.touch()
    return World(folder)
