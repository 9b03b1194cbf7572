"""Real captures with points that are known: disks, a chessboard, five lenses, stained tissue.

    python benchmarks/real_pairs.py [--results FILE]

Reads ../shared/data beside the checkout, or `$LEVKAS_REAL_DATA`; builds the examples of this
repository in a temporary folder. Errors in px of the reference of each.
"""

from __future__ import annotations

import csv
import os
import tempfile
from collections.abc import Iterator
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from results import record, taken_option

import levkas
from levkas.building import build
from levkas.readers.frames import read_frame
from levkas.registration import BandImage, RegistrationRefused, register
from levkas.registration.bands import sqrt_images
from levkas.registration.foreground import ObjectArea

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("LEVKAS_REAL_DATA", ROOT.parent / "shared" / "data"))
COLUMNS = ("mean", "largest")
LENSES = {1: "Blue", 2: "Green", 3: "Red", 4: "NIR", 5: "Red edge"}


def built(name: str, folder: Path) -> Path:
    """Build an example of this repository; return its database."""
    home = folder / name
    home.mkdir()
    text = (ROOT / "examples" / name / "campaign.toml").read_text(encoding="utf-8")
    (home / "campaign.toml").write_text(text.replace("../../../shared/data", str(DATA)))
    for step in build(home, output=folder / f"{name}.database"):
        if step.state in ("refused", "failed"):
            print("   ", step.line)
    return folder / f"{name}.database"


def table(path: Path) -> np.ndarray:
    with path.open(encoding="utf-8") as file:
        rows = [row for row in csv.reader(file) if row and not row[0].startswith("#")]
    return np.array([[float(v) for v in row] for row in rows])


Figures = dict[tuple[str, str], float | tuple[float, float]]


def say(name: str, found: np.ndarray, known: np.ndarray, verdict: str = "") -> tuple[float, float]:
    """Print and return mean and largest error."""
    miss = np.linalg.norm(found - known, axis=1)
    print(f"{name:44s} {len(known):4d} {miss.mean():7.3f} {miss.max():7.3f}  {verdict}")
    return float(miss.mean()), float(miss.max())


def disks(folder: Path) -> Figures:
    database = built("filterwheel-disks", folder)
    (name,) = levkas.open(database)
    (camera,) = levkas.open(database)[name]
    points = table(DATA / "filterwheel-disks/disk_centroids_per_band.csv").reshape(-1, 7, 2)
    figures = {}
    for i, nm in enumerate(range(400, 701, 50)):
        if nm != 550:
            ends = {"source": f"{camera}:{nm} nm", "target": f"{camera}:550 nm"}
            found = levkas.map_points(database, name, points[:, i], **ends)
            errors = say(f"disks, {nm} nm to 550 nm", found, points[:, 3])
            figures |= zip(((f"disks, {nm} nm", c) for c in COLUMNS), errors, strict=True)
    return figures


def board(folder: Path) -> Figures:
    database = built("silios-kinect", folder)
    points = table(DATA / "silios-kinect/sim3_chessboard_corners.csv")
    found = levkas.map_points(
        database, "board", points[:, 2:4], source="kinect", target="silios:B5"
    )
    name = "chessboard, Kinect to SILIOS"
    errors = say(name, found, points[:, :2])
    return dict(zip(((name, c) for c in COLUMNS), errors, strict=True))


def close_loops(
    views: dict[str, tuple[BandImage, Any]], red: BandImage
) -> Iterator[tuple[str, str, np.ndarray]]:
    """Yield two lenses and how far points come back, px of the red one, by red → first → second → red.

    The two are registered to each other both ways, without the red one, and the way with the smaller predicted
    sigma closes the loop; no error where both are refused. Points are 25 x 19 of the object.
    """
    x, y = (np.linspace(0.02, 0.98, k) * (n - 1) for k, n in zip((25, 19), red.size, strict=True))
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    points = points[_on(ObjectArea.of(sqrt_images([red])[red.label]).compared, points)]
    for one, other in combinations(views, 2):
        ways = {}
        for leader, led in ((one, other), (other, one)):
            image, start = views[leader]
            try:
                found = register([image], [views[led][0]], reference_band=leader)
            except RegistrationRefused:
                continue
            if found.verdict.decision == "refuse":
                continue
            at = start(points)
            slope = np.sqrt(np.abs(np.linalg.det(start.jacobian(points))))
            sigma = float(np.nanmedian(found.sigma[led](at) / slope))
            ways[sigma] = leader == one, found.transforms[led]
        if not ways:
            yield one, other, np.empty(0)
            continue
        forth, between = ways[min(ways)]
        (image, map_), (end_image, end_map) = views[one], views[other]
        start = map_(points)
        end = between(start) if forth else between.inverse(start)
        seen = _on(image.valid, start) & _on(end_image.valid, end)
        miss = np.linalg.norm(end_map.inverse(end[seen]) - points[seen], axis=1)
        yield one, other, miss[np.isfinite(miss)]


def _on(valid: np.ndarray, places: np.ndarray) -> np.ndarray:
    """Return which places, (n, 2) px, lie on valid pixels."""
    x, y = np.rint(np.where(np.isfinite(places), places, -9)).astype(int).T
    inside = (x >= 0) & (y >= 0) & (x < valid.shape[1]) & (y < valid.shape[0])
    inside[inside] &= valid[y[inside], x[inside]]
    return inside


def lenses() -> Figures:
    """Five lenses of one camera: every pair registered by itself, loops through the red one."""
    figures = {}
    for number, scene in (("0000", "panel"), ("0001", "orchard")):
        images = {}
        for lens, name in LENSES.items():
            values = np.asarray(
                read_frame(DATA / f"rededge-5lens/IMG_{number}_{lens}.tif"), np.float32
            ).squeeze()
            images[name] = [BandImage.of(name, values)]
        views = {}
        for name in images:
            if name == "Red":
                continue
            try:
                found = register(images["Red"], images[name], reference_band="Red")
            except RegistrationRefused as refused:
                print(f"{scene}, {name} to Red: refused, {refused}")
                continue
            print(f"{scene}, {name} to Red: {found.verdict.decision} {found.verdict.reasons[0]}")
            if found.verdict.decision != "refuse":
                views[name] = images[name][0], found.transforms[name]
        means, largest = [], []
        for first, second, error in close_loops(views, images["Red"][0]):
            name = f"{scene}, loop Red, {first}, {second}"
            if not len(error):
                print(f"{name:44s} not closed")
                continue
            means.append(float(error.mean()))
            largest.append(float(error.max()))
            print(f"{name:44s} {len(error):4d} {means[-1]:7.3f} {largest[-1]:7.3f}")
        if len(means) == 6:
            for column, several in zip(COLUMNS, (means, largest), strict=True):
                figures[f"RedEdge {scene}, six loops", column] = (min(several), max(several))
    return figures


def tissue() -> None:
    """Stained sections: landmarks that no global model fits, and artificial pairs that one does."""
    home = DATA / "stain-landmarks"
    pairs = [("images/artificial_reference", f"images/artificial_moving-{k}") for k in ("affine", "rigid", "elastic")]  # fmt: skip
    pairs += [
        ("rat-kidney_/scale-5pc/Rat-Kidney_HE", "rat-kidney_/scale-5pc/Rat-Kidney_PanCytokeratin"),
        ("lesions_/scale-5pc/Izd2-29-041-w35_HE", "lesions_/scale-5pc/Izd2-29-041-w35_proSPC"),
    ]
    for first, second in pairs:
        grey, points = [], []
        for stem in (first, second):
            values = np.asarray(read_frame(home / f"{stem}.jpg"), np.float32)
            grey.append([BandImage.of("grey", values.reshape(*values.shape[:2], -1).mean(2))])
            marks = home / f"{stem.replace('images/', 'landmarks/')}.csv"
            with marks.open(encoding="utf-8") as file:
                rows = list(csv.reader(file))[1:]
            points.append(np.array([[float(v) for v in row[-2:]] for row in rows]))
        name = Path(second).name
        try:
            found = register(*grey, reference_band="grey")
        except RegistrationRefused as refused:
            print(f"{name}: refused, {refused}")
            continue
        n = min(map(len, points))
        verdict = f"{found.verdict.decision}: {found.verdict.reasons[0]}"
        back = found.transforms["grey"].inverse(points[1][:n])
        say(name, back, points[0][:n], verdict if len(points[0]) == len(points[1]) else "rows differ; " + verdict)  # fmt: skip


def main() -> None:
    """Print a line a pair: points, mean and largest error."""
    results = taken_option()
    print(f"{'pair':44s} {'n':>4s} {'mean':>7s} {'max':>7s}")
    with tempfile.TemporaryDirectory() as folder:
        figures = disks(Path(folder)) | board(Path(folder))
    figures |= lenses()
    tissue()
    record(results, "real", figures)


if __name__ == "__main__":
    main()
