"""A small database with everything the viewer shows, written without a build."""

import csv
import shutil
from pathlib import Path

import numpy as np

from levkas.core.cube import Band, Cube, Flag
from levkas.core.files import write_json, write_text
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.geometry.transforms import Affine, Composed, Homography, Polynomial

SIZE = (150, 130)
"""Of the grid: (width, height)."""
GRID = Affine(np.array([[0.0, 1.0, 12.0], [-1.0, 0.0, 170.0]]))
"""Grid → reference: a quarter turn and a crop."""
BY_HAND = "rgb"
"""Camera that was aligned with four pairs by hand."""
CAMERAS = {
    "vis": [f"{w} nm" for w in range(420, 701, 40)],
    "rgb": ["R", "G", "B"],
    "nir": [f"{w} nm" for w in range(550, 951, 100)],
}


def bent(scale: float, offset: float, curve: float) -> Polynomial:
    """Return a cubic map that is far from affine."""
    points = np.random.default_rng(4).uniform(-20, 220, (200, 2))
    there = points * scale + offset + curve * (points - 90) ** 2 - 2e-6 * (points - 90) ** 3
    return Polynomial.fit(points, there, order=3)


MAPS = {
    "vis": Affine.identity(),
    "rgb": bent(2.1, 7.0, 4e-4),
    "nir": Composed(
        Homography(np.array([[0.8, 0.05, 3], [-0.02, 0.82, 20], [2e-4, 1e-4, 1]])),
        Affine(np.array([[1, 0, 0.3], [0, 1, -0.2]])),
    ),
}


def make_cube(
    rng: np.random.Generator, camera: str, size: tuple[int, int], labels: list[str]
) -> Cube:
    """Draw a panel with a grid of squares, noise and flags; NaN where the camera saw nothing."""
    width, height = size
    y, x = np.mgrid[0:height, 0:width]
    squares = ((x // 10 + y // 10) % 2) * 0.25 + 0.25 + 0.2 * x / width
    slopes = np.linspace(0.6, 1.4, len(labels))
    sigma = np.full((height, width, len(labels)), 0.004, np.float32) * slopes.astype(np.float32)
    values = squares[..., None] * slopes + rng.normal(0, 1, sigma.shape) * sigma
    flags = np.zeros(values.shape, np.uint8)
    flags[40:44, 60:70, 0] = Flag.SATURATED
    flags[100:106, 100:110] = Flag.VEILED
    flags[100:106, 112:116] = Flag.DEFECT
    flags[:, :3] = Flag.OUTSIDE
    values[:, :3] = np.nan
    bands = [Band(n, float(n.split()[0]), 10.0) if " nm" in n else Band(n) for n in labels]
    return Cube(values.astype(np.float32), flags, sigma, tuple(bands))


def write_record(
    root: Path,
    name: str,
    camera: str,
    labels: list[str],
    decision: str = "accept",
    reason: str = "",
) -> None:
    """Write a registration record as a build does."""
    middle = labels[len(labels) // 2]
    nodes = {"x": [0.0, 90.0, 180.0], "y": [0.0, 80.0, 160.0]}
    sigma = {**nodes, "sigma_px": [[0.3, 0.1, 0.2], [0.1, 0.02, 0.1], [0.2, 0.1, 0.4]]}
    record = {
        "reference": {"camera": "vis", "band": "580 nm", "size": [200, 180]},
        "target": {"camera": camera, "band": middle},
        "grid": {"size": list(SIZE), "transform": GRID.to_dict(), "px_per_mm": 1.25},
        "verdict": {
            "decision": decision,
            "reasons": [reason] if reason else [],
            "next_step": "Add pairs." if decision != "accept" else "",
        },
        "model": {"kind": "levkas", "sensors": [{"sensor": ""}]},
        "bands": {
            n: {"transform": MAPS[camera].to_dict(), "size": [480, 420], "sigma": sigma}
            for n in labels
        },
    }
    if decision == "refuse":
        record["bands"] = {}
    if camera == BY_HAND:
        record["pairs_by_hand"] = 4
    write_json(root / "objects" / name / "registration" / f"{camera}.json", record)


def write_database(root: Path, objects: dict[str, str]) -> Path:
    """Write a database; `objects` gives each one's title. The second has a refused camera."""
    rng, entries = np.random.default_rng(11), []
    for number, (name, title) in enumerate(objects.items()):
        for camera, labels in CAMERAS.items():
            refused = number == 1 and camera == "nir"
            reason = "7 of 10 matches lie in one corner." if refused else ""
            write_record(root, name, camera, labels, "refuse" if refused else "accept", reason)
            if refused:
                continue
            layer = Layer(name, camera, px_per_mm=1.25)
            cube = make_cube(rng, camera, SIZE, labels)
            entries.append(write_layer(root, layer, cube)[0])
        _write_rest(root, name, title)
    shutil.rmtree(root / "zarr")
    write_catalogue(root, entries)
    table = [["wavelength", "R", "G", "B"]]
    table += [[w, int(w > 580), int(480 < w <= 580), int(w <= 480)] for w in range(400, 701, 10)]
    path = root / "cameras/rgb/sensitivity.csv"
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="", encoding="utf-8") as handle:
        csv.writer(handle).writerows(table)
    return root


def write_hostile_database(root: Path, texts: list[str], names: list[str]) -> Path:
    """Write an object a text: it is its title, the label of a band, and why it was warned about."""
    rng, entries = np.random.default_rng(5), []
    for text, name in zip(texts, names, strict=True):
        labels = [text, "G", "B"]
        write_record(root, name, "rgb", labels, "warn", text)
        cube = make_cube(rng, "rgb", (24, 20), labels)
        entries.append(write_layer(root, Layer(name, "rgb"), cube)[0])
        _write_rest(root, name, text)
    shutil.rmtree(root / "zarr")
    write_catalogue(root, entries)
    return root


def _write_rest(root: Path, name: str, title: str) -> None:
    write_text(root / f"objects/{name}/object.toml", _toml(name, title))
    write_text(root / f"objects/{name}/report.html", "<!doctype html><title>report</title>")


def _toml(name: str, title: str) -> str:
    import json

    facts = {"name": name, "title": title, "creator": title, "medium": "egg tempera"}
    lines = [f"{key} = {json.dumps(value, ensure_ascii=True)}" for key, value in facts.items()]
    return "\n".join([*lines, "size_mm = [120, 104]"]) + "\n"
