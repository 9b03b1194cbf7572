"""What each class of verdict is worth: right maps and wrong ones by class, on simulated and real pictures.

    python benchmarks/verdict_classes.py [--pairs 200] [--real 160] [--impostors 100] [--json OUT] [--results FILE]
    python benchmarks/verdict_classes.py --again OUT

Pairs of the battery (`benchmarks/pairs.py`), also of bent surfaces of which a part lost its detail, and real captures: two channels of one photograph, or a band twice, of which one is cut, turned, scaled, bent, partly covered
by another picture or blanked. So the truth is exact. A map is right where it is at most 0.5 px wrong in the
mean over what both show of the object (the part of the reference that a database publishes), and at most 2 % of
that is off by more than 1 px; px are of the reference, or of the target where that is coarser. `--json` keeps the numbers of all verdicts, and `--again` judges those with the
rules of today, without registering anything.
"""

from __future__ import annotations

import argparse
import json
import os
import time
from collections import Counter
from pathlib import Path

import cv2
import numpy as np
from pairs import Studio, bent, bent_pair, impostor, right_pair, view
from results import add_option, record
from scipy import ndimage

from levkas.geometry.transforms import Affine, Composed
from levkas.readers.frames import read_frame
from levkas.registration import BandImage, RegistrationRefused, register
from levkas.registration.uncertainty import NINE_OF_TEN
from levkas.registration.verdict import judge_windows

DATA = Path(
    os.environ.get("LEVKAS_REAL_DATA", Path(__file__).resolve().parents[2] / "shared" / "data")
)
SIZE = (400, 300)
RIGHT_PX, OFF_PX, OFF_SHARE = 0.5, 1.0, 0.02


def real_bands() -> dict[str, list[np.ndarray]]:
    """Return bands of one exposure each that lie on one another, (h, w) float32, by the picture's name."""
    found = {}
    for path in sorted((DATA / "paintings").glob("*.jpg")):
        image = cv2.imread(str(path)).astype(np.float32)
        found[path.stem] = [image[..., c] for c in range(3)]
    for folder in ("board", "scene1", "scene2"):
        kinect = cv2.imread(str(DATA / f"silios-kinect/{folder}/2020511_kinect_hd_rgb.png"))
        half = cv2.resize(kinect, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        found[f"kinect {folder}"] = [half[..., c].astype(np.float32) for c in range(3)]
        path = DATA / f"silios-kinect/{folder}/2020511_multispectral_camera.png"
        mosaic = np.asarray(read_frame(path), np.float32).squeeze()
        h, w = (n // 3 * 3 for n in mosaic.shape)
        found[f"silios {folder}"] = [mosaic[1:h:3, 1:w:3]]  # its bands lie up to 0.4 px apart
    for number in ("0000", "0001"):
        for lens in range(1, 6):
            path = DATA / f"rededge-5lens/IMG_{number}_{lens}.tif"
            band = np.asarray(read_frame(path), np.float32).squeeze()
            half = cv2.resize(band, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
            found[f"rededge {number} {lens}"] = [half]
    for path in sorted((DATA / "stain-landmarks").rglob("*.jpg")):
        image = cv2.imread(str(path)).astype(np.float32)
        if min(image.shape[:2]) >= SIZE[1]:
            found[f"tissue {path.stem}"] = [image[..., c] for c in range(3)]
    return found


def real_pair(pictures: dict[str, list[np.ndarray]], rng: np.random.Generator):
    """Return (name, reference, target, true map, what of the target shows the object)."""
    names = list(pictures)
    name, other = (names[k] for k in rng.permutation(len(names))[:2])
    first, second = (pictures[name][k] for k in rng.integers(len(pictures[name]), size=2))
    inverted = rng.uniform() < 0.15
    h, w = first.shape
    ratio = min(0.9 * w / SIZE[0], 0.9 * h / SIZE[1], float(rng.uniform(1.0, 1.6)))
    corner = rng.uniform(0, [w - 1 - ratio * SIZE[0], h - 1 - ratio * SIZE[1]])
    home = Affine(np.column_stack([ratio * np.eye(2), corner]))
    scale = float(np.exp(rng.uniform(np.log(0.5), np.log(2.0))))
    size = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    turn = rng.uniform(-180, 180) if rng.uniform() < 0.3 else rng.normal(0, 2)
    shift = rng.uniform(-0.35, 0.35, 2) if rng.uniform() < 0.3 else rng.normal(0, 0.03, 2)
    truth = view(rng, SIZE, size, scale, turn=turn, shift=shift)
    kind = "plain"
    if rng.uniform() < 0.3:
        truth, kind = Composed(bent(rng, SIZE), truth), "bent"
    reference = sample(first, home, SIZE)
    target = sample(second, Composed(truth.inverse, home), size)
    target = target.max() - target if inverted else target
    shown = np.ones(target.shape, bool)
    part = rng.uniform()
    if part < 0.4:
        rows, columns = np.mgrid[: size[1], : size[0]] / np.array(size[::-1])[:, None, None] - 0.5
        angle = rng.uniform(0, 2 * np.pi)
        shown = columns * np.cos(angle) + rows * np.sin(angle) < rng.uniform(-0.1, 0.3)
        if part < 0.2:
            over = cv2.resize(pictures[other][0], size, interpolation=cv2.INTER_AREA)
            kind += ", covered"
        else:
            over = cv2.GaussianBlur(target, (0, 0), 30.0)
            kind += ", blank"
        target = np.where(shown, target, over)
        if "blank" in kind:
            shown = np.ones(target.shape, bool)  # the object is there, if without detail
    for image in (reference, target):
        image += rng.normal(0, image.std() / rng.uniform(10, 60), image.shape).astype(np.float32)
    return f"real, {kind}", reference, target, truth, shown, name


def sample(picture: np.ndarray, to_picture, size) -> np.ndarray:
    """Return a picture at places of another, (h, w) float32, 0.02 of its range outside of it."""
    x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
    places = to_picture(np.stack([x.ravel(), y.ravel()], 1))
    step = to_picture(np.add([size[0] / 2, size[1] / 2], [[0, 0], [1, 0], [0, 1]]))
    spacing = np.sqrt(abs(np.linalg.det(step[1:] - step[0])))
    soft = cv2.GaussianBlur(picture, (0, 0), 0.45 * max(spacing, 1.0))
    inside = np.all((places >= 0) & (places <= np.array(picture.shape[::-1]) - 1), 1)
    found = ndimage.map_coordinates(soft, places.T[::-1], order=3, mode="nearest")
    return (
        np.where(inside, found, 0.02 * picture.max()).reshape(size[1], size[0]).astype(np.float32)
    )


def judged(name, reference, target, truth=None, shown=None, picture="") -> dict:
    """Register a pair; return the numbers of its verdict and how wrong its map is, in px."""
    start = time.perf_counter()
    bands = [[BandImage.of("grey", image)] for image in (reference, target)]
    row = {
        "name": name,
        "picture": picture,
        "true": truth is not None,
        "decision": "refuse",
        "reasons": [],
    }
    try:
        found = register(*bands, reference_band="grey")
    except RegistrationRefused as refused:
        return row | {"reasons": [str(refused)], "seconds": time.perf_counter() - start}
    row |= found.verdict.to_dict()
    if truth is not None:
        numbers = row["numbers"].get("sensor", row["numbers"])
        box = numbers.get("verification", numbers).get("box") or [0, 0, *reference.shape[::-1]]
        row |= errors(found, truth, box, shown)
    return row | {"seconds": time.perf_counter() - start}


def errors(found, truth, box, shown) -> dict[str, float]:
    """Return mean error, share that is off, and share within nine-of-ten circles, of what both show of the object.

    `box` is where the registration sees the object: a database publishes that part of the reference.
    """
    x, y = (np.linspace(box[k] + 2, box[k] + box[2 + k] - 3, n) for k, n in ((0, 41), (1, 31)))
    points = np.stack([v.ravel() for v in np.meshgrid(x, y)], 1)
    places = truth(points)
    both = np.all((places >= 0) & (places <= np.array(shown.shape[::-1]) - 1), 1)
    column, row = np.rint(places[both]).astype(int).T
    both[both] = shown[row, column]
    middle = np.array([x.mean(), y.mean()])
    spread = truth(middle + np.array([[0, 0], [1, 0], [0, 1]]))
    scale = min(1.0, float(np.sqrt(abs(np.linalg.det(spread[1:] - spread[0])))))
    points = points[both]
    miss = np.linalg.norm(truth.inverse(found.transforms["grey"](points)) - points, axis=1)
    miss = np.where(np.isfinite(miss), miss, 1e3)
    held = miss <= NINE_OF_TEN * found.sigma["grey"](points)
    return {
        "error": float(miss.mean() * scale),
        "off": float((miss * scale > OFF_PX).mean()),
        "held": float(held.mean()),
    }


def is_right(row: dict) -> bool:
    """Whether a map is right everywhere that both pictures show."""
    return row["true"] and row.get("error", 1e3) <= RIGHT_PX and row["off"] <= OFF_SHARE


def tell(rows: list[dict]) -> dict[str, float]:
    """Print right and wrong maps by class; return the shares that the classes promise, percent."""
    print(f"{'pairs':28s} {'n':>4s}  right: accept doubtful refuse  wrong: accept doubtful refuse")
    counts = {}
    for name in [*sorted({r["name"] for r in rows}), "all"]:
        group = [r for r in rows if name in ("all", r["name"])]
        said = Counter((is_right(r), r["decision"]) for r in group)
        counts[name] = said
        cells = [
            said[right, one] for right in (True, False) for one in ("accept", "warn", "refuse")
        ]
        print(f"{name:28s} {len(group):4d} ", *(f"{n:8d}" for n in cells))
    said = counts["all"]
    accepted = said[True, "accept"] + said[False, "accept"]
    right = sum(n for (good, _), n in said.items() if good)
    doubtful = said[True, "warn"] + said[False, "warn"]
    shares = {
        "accepted maps that are right": 100 * said[True, "accept"] / max(accepted, 1),
        "right maps that are accepted": 100 * said[True, "accept"] / max(right, 1),
        "doubtful maps that are wrong somewhere": 100 * said[False, "warn"] / max(doubtful, 1),
    }
    for (name, share), goal in zip(shares.items(), (99, 80, 50), strict=True):
        print(f"{name}: {share:.1f} % (goal {goal})")
    for r in rows:
        if not is_right(r) and r["decision"] == "accept":
            print(
                "  accepted and wrong:",
                r["name"],
                f"{r.get('error', 1e3):.2f} px, {r.get('off', 1):.2f} off",
            )
    return shares


def main() -> None:
    """Collect pairs, or judge those of an earlier run again."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pairs", type=int, default=200)
    parser.add_argument("--real", type=int, default=160)
    parser.add_argument("--bent", type=int, default=40)
    parser.add_argument("--impostors", type=int, default=100)
    parser.add_argument("--seed", type=int, default=31)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--again", type=Path)
    add_option(parser)
    arguments = parser.parse_args()
    if arguments.again:
        rows = json.loads(arguments.again.read_text(encoding="utf-8"))
        for row in rows:
            if row.get("numbers"):
                row |= judge_windows(row["numbers"]).to_dict()
        record(arguments.results, "verdict", tell(rows))
        return
    rows, studio, pictures = [], Studio(arguments.seed), real_bands()

    def draw(kind: int, number: int) -> np.random.Generator:
        return np.random.default_rng([arguments.seed, kind, number])

    makers = [
        (arguments.real, lambda k: real_pair(pictures, draw(0, k))),
        (arguments.pairs, lambda k: right_pair(studio, draw(1, k), k)),
        (arguments.bent, lambda k: ("bent, part blank", *bent_pair(studio, draw(2, k))[:3], None)),
        (arguments.impostors, lambda k: ("impostor", *impostor(studio, draw(3, k), k)[1:])),
    ]
    for count, make in makers:
        for number in range(count):
            name, reference, target, *known = make(number)
            if known and known[1] is None:
                known[1] = np.ones(target.shape, bool)
            rows.append(judged(name, reference, target, *known))
            if arguments.json:
                arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    record(arguments.results, "verdict", tell(rows))


if __name__ == "__main__":
    main()
