"""Real captures with points that are known: disks, a chessboard, five lenses, stained tissue.

    python benchmarks/real_pairs.py [--results FILE]

Reads ../shared/data beside the checkout, or `$LEVKAS_REAL_DATA`; builds the examples of this
repository in a temporary folder. Errors in px of the reference of each.
"""

from __future__ import annotations

import csv
import os
import tempfile
from pathlib import Path

import numpy as np
from results import record, taken_option

import levkas
from levkas.building import build
from levkas.quality.evaluation.loop_closure import LoopView, close_loops, points_on
from levkas.readers.frames import read_frame
from levkas.registration import BandImage, RegistrationRefused, register

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
        views = []
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
                views.append(LoopView(name, images[name], name, found.transforms[name]))
        means, largest = [], []
        for loop in close_loops(views, points_on(images["Red"][0])):
            row = loop.to_dict()
            name = f"{scene}, loop Red, {loop.first}, {loop.second}"
            if row["mean"] is None:
                print(f"{name:44s} not closed: {loop.refused}")
            else:
                means.append(row["mean"])
                largest.append(row["max"])
                print(
                    f"{name:44s} {row['points']:4d} {row['mean']:7.3f} {row['max']:7.3f}  "
                    f"median {np.median(loop.error):.3f}, {loop.verdict}"
                )
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
