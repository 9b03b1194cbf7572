"""How often the first verdict is right: pairs that can be registered, pairs that cannot, and impostors.

    python benchmarks/verdict.py --pairs 120 --impostors 300 [--method mirhashemi2019] [--json OUT]

Right pairs are one painted surface seen twice through known maps; an impostor has no true map. A
false accept is an impostor that is not refused, or a pair whose transform is more than 1 px wrong
in the mean over what both show and is not refused; a false refusal is a transform that is right to
0.5 px and refused.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from pathlib import Path

import numpy as np
from scipy import ndimage

from levkas.registration import METHODS, BandImage, RegistrationRefused, register
from levkas.transforms import Affine, Composed, Homography, Lens

SIZE = (400, 300)
OVERSAMPLED = 2
MARGIN = 0.35


class Painting:
    """A painted surface: patches of pigment, brush strokes, cracks; visible and near infrared."""

    def __init__(self, rng: np.random.Generator, size: tuple[int, int] = SIZE) -> None:
        w, h = (round(n * (1 + 2 * MARGIN) * OVERSAMPLED) for n in size)
        self.size = size
        patches = rng.uniform(0, 1, (150, 2)) * (h, w)
        rows, columns = np.mgrid[0:h:4, 0:w:4]
        from scipy.spatial import cKDTree

        near = cKDTree(patches).query(np.stack([rows.ravel(), columns.ravel()], 1), k=2)
        pigment = np.kron(near[1][:, 0].reshape(rows.shape) % 12, np.ones((4, 4), int))[:h, :w]
        wobble = [ndimage.gaussian_filter(rng.normal(0, 1, (h, w)), 12) * 90 for _ in "yx"]
        pigment = ndimage.map_coordinates(
            pigment, np.mgrid[0:h, 0:w] + np.stack(wobble), order=0, mode="nearest"
        )
        seeds = cKDTree(rng.uniform(0, 1, (900, 2)) * (h, w))
        d = seeds.query(np.stack([rows.ravel(), columns.ravel()], 1), k=2)[0]
        edge = ndimage.zoom((d[:, 1] - d[:, 0]).reshape(rows.shape), 4, order=1)[:h, :w]
        self.cracks = np.exp(-np.square(edge / (1.2 * OVERSAMPLED)))
        self.strokes = sum(
            a * _unit(ndimage.gaussian_filter(rng.normal(0, 1, (h, w)), (s, 3 * s)))
            for a, s in ((0.6, 1.0 * OVERSAMPLED), (0.8, 3.0 * OVERSAMPLED))
        )
        visible = rng.uniform(0.08, 0.75, 12)
        infrared = np.clip(0.5 + 0.2 * rng.normal(0, 1, 12), 0.1, 0.85)
        self.visible, self.infrared = visible[pigment], infrared[pigment]

    def layer(self, kind: str) -> np.ndarray:
        """Return reflectance as a camera of `kind` sees it, oversampled, margins included."""
        infrared = kind == "infrared"
        body = self.infrared if infrared else self.visible
        body = body * (1 + (0.05 if infrared else 0.1) * self.strokes)
        body = body * (1 - (0.15 if infrared else 0.4) * self.cracks)
        return 0.9 - body if kind == "inverted" else body

    def photograph(
        self, kind: str, mapping, size, rng: np.random.Generator, *, snr: float, blur: float
    ) -> np.ndarray:
        """Photograph the layer: `mapping` takes px of the photograph to px of the reference."""
        x, y = np.meshgrid(np.arange(size[0], dtype=float), np.arange(size[1], dtype=float))
        places = mapping(np.stack([x.ravel(), y.ravel()], 1))
        margin = np.array(self.size) * MARGIN
        surface = (places + margin + 0.5) * OVERSAMPLED - 0.5
        inside = np.all((places > -margin) & (places < np.array(self.size) + margin), 1)
        corners = mapping(np.array([[0.0, 0.0], [1.0, 0.0]]))
        spacing = np.hypot(*(corners[1] - corners[0])) * OVERSAMPLED
        layer = ndimage.gaussian_filter(self.layer(kind), 0.45 * max(spacing, 1) + blur)
        picture = ndimage.map_coordinates(layer, surface.T[::-1], order=3, mode="nearest")
        picture = np.where(inside, picture, 0.02).reshape(size[1], size[0])
        noise = rng.normal(0, 1, picture.shape) * np.sqrt(np.clip(picture, 0.01, None)) / snr
        return (picture + noise).astype(np.float32)


def _unit(image: np.ndarray) -> np.ndarray:
    return image / image.std()


def random_map(rng: np.random.Generator, size, scale: float, *, turn: float, shift: float, tilt):
    """Return reference px → target px: similarity about the centres, perspective, lens."""
    w, h = SIZE
    angle = np.deg2rad(turn)
    linear = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre, middle = np.array([w - 1, h - 1]) / 2, np.array(size, float) / 2 - 0.5
    move = middle - linear @ centre + scale * rng.uniform(-shift, shift, 2) * (w, h)
    matrix = np.eye(3)
    to_centre, back = np.eye(3), np.eye(3)
    to_centre[:2, 2], back[:2, 2] = -centre, centre
    matrix[2, :2] = rng.uniform(-tilt, tilt, 2) / w
    lens = Lens(middle, max(size) / 2, (rng.uniform(-0.02, 0.02), rng.uniform(-0.004, 0.004)))
    return Composed(
        Homography(back @ matrix @ to_centre), Affine(np.column_stack([linear, move])), lens
    )


def right_pair(rng: np.random.Generator, number: int):
    """Return (name, reference, target, true map) of a pair as a careful campaign has it, or harder."""
    kinds = ("visible", "visible", "infrared", "visible", "inverted", "infrared")
    hardness = ("mild", "mild", "coarse", "noisy", "turned", "shifted")
    kind, hard = kinds[number % 6], hardness[(number // 6) % 6]
    scale = rng.uniform(0.35, 0.6) if hard == "coarse" else rng.uniform(0.7, 2.2)
    turn = rng.uniform(5, 40) * rng.choice((-1, 1)) if hard == "turned" else rng.normal(0, 1.2)
    shift = 0.3 if hard == "shifted" else 0.02
    snr = rng.uniform(8, 20) if hard == "noisy" else rng.uniform(30, 100)
    size = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    truth = random_map(rng, size, scale, turn=turn, shift=shift, tilt=0.04)
    painting = Painting(rng)
    reference = painting.photograph("visible", Affine.identity(), SIZE, rng, snr=60, blur=0.0)
    target = painting.photograph(kind, truth.inverse, size, rng, snr=snr, blur=rng.uniform(0, 1.5))
    return f"{hard}/{kind}", reference, target, truth


def impostor(rng: np.random.Generator, number: int):
    """Return (name, reference, target) of a pair that has no true map."""
    name = ("other", "framed", "blank", "ornament", "elsewhere", "mirrored")[number % 6]
    still = Affine.identity()

    def shoot(painting: Painting, mapping=still) -> np.ndarray:
        return painting.photograph("visible", mapping, SIZE, rng, snr=60, blur=0.0)

    first = Painting(rng)
    a = shoot(first)
    if name == "blank":
        y, x = np.mgrid[: SIZE[1], : SIZE[0]]
        b = 0.5 + 1e-4 * x * rng.normal() + 1e-4 * y * rng.normal()
        b = (b + rng.normal(0, 0.01, b.shape)).astype(np.float32)
    elif name == "ornament":
        a, b = ornaments(rng)
    elif name == "elsewhere":
        b = shoot(first, Affine(np.array([[1, 0, 0.0], [0, 1, 0]])))
        half = SIZE[0] // 2
        a = np.repeat(np.repeat(a[:, :half], 2, 0), 2, 1)[: SIZE[1], : SIZE[0]]
        b = np.repeat(np.repeat(b[:, half:], 2, 0), 2, 1)[: SIZE[1], : SIZE[0]]
    elif name == "mirrored":
        b = a[:, ::-1] + rng.normal(0, 0.01, a.shape).astype(np.float32)
    else:
        b = shoot(Painting(rng))
        if name == "framed":
            # The same easel, frame and dust on the sensor around two different paintings.
            border = rng.uniform(0.1, 0.8, 30)
            for image in (a, b):
                image[:24] = image[-24:] = 0.15
                image[:, :24] = image[:, -24:] = 0.15
                for k, level in enumerate(border):
                    image[6:12, 12 * k + 14 : 12 * k + 20] = level
                image += rng.normal(0, 0.004, image.shape).astype(np.float32)
            for u, v in rng.integers(30, 270, (25, 2)):
                for image in (a, b):
                    image[u : u + 2, v : v + 2] *= 0.6
    return name, a, b


def ornaments(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Return two views of one repeated ornament, shifted by anything: no view tells which."""
    period = int(rng.integers(14, 60))
    tile = _unit(ndimage.gaussian_filter(rng.normal(0, 1, (period, period)), 1.6, mode="wrap"))
    rows, columns = np.mgrid[: SIZE[1], : SIZE[0]].astype(float)
    u, v = rng.uniform(0, period, 2)
    views = []
    for dy, dx in ((0.0, 0.0), (u, v)):
        places = np.stack([(rows + dy) % period, (columns + dx) % period])
        view = 0.5 + 0.1 * ndimage.map_coordinates(tile, places, order=1, mode="grid-wrap")
        views.append((view + rng.normal(0, 0.008, view.shape)).astype(np.float32))
    return views[0], views[1]


def error_of(transform, truth, size) -> float:
    """Return the mean error, reference px, over what both pictures show."""
    x, y = np.meshgrid(np.linspace(0, SIZE[0] - 1, 25), np.linspace(0, SIZE[1] - 1, 19))
    points = np.stack([x.ravel(), y.ravel()], 1)
    places = truth(points)
    both = np.all((places >= 0) & (places <= np.array(size) - 1), 1)
    miss = np.linalg.norm(transform.inverse(places[both]) - points[both], axis=1)
    return float(np.where(np.isfinite(miss), miss, 1e3).mean())


def judge_pair(name: str, reference, target, truth, method: str) -> dict:
    """Register one pair; return what was decided and how wrong the transform is."""
    start = time.perf_counter()
    bands = [[BandImage.of("grey", image)] for image in (reference, target)]
    try:
        result = register(*bands, reference_band="grey", method=method)
    except RegistrationRefused as refusal:
        row = {"decision": "refuse", "reasons": [str(refusal)], "numbers": {}, "error": np.inf}
    else:
        row = {
            "decision": result.verdict.decision,
            "reasons": list(result.verdict.reasons),
            "numbers": result.verdict.to_dict()["numbers"],
            "error": np.inf,
        }
        if truth is not None:
            size = target.shape[::-1]
            row["error"] = error_of(result.transforms["grey"], truth, size)
    return {"name": name, "seconds": time.perf_counter() - start, "true": truth is not None, **row}


def tell(rows: list[dict]) -> None:
    """Print what came of each kind of pair and the rates over all."""
    print(f"{'pairs':22s} {'n':>4s} {'accept':>7s} {'warn':>5s} {'refuse':>7s} {'right':>6s}")
    for name in sorted({r["name"] for r in rows}):
        group = [r for r in rows if r["name"] == name]
        said = Counter(r["decision"] for r in group)
        right = sum(r["error"] <= 0.5 for r in group)
        print(
            f"{name:22s} {len(group):4d} {said['accept']:7d} {said['warn']:5d} "
            f"{said['refuse']:7d} {right:6d}"
        )
    right = [r for r in rows if r["error"] <= 0.5]
    wrong = [r for r in rows if r["error"] > 1.0]
    false_accepts = [r for r in wrong if r["decision"] != "refuse"]
    false_refusals = [r for r in right if r["decision"] == "refuse"]
    print(f"right transforms {len(right)}, refused {len(false_refusals)}")
    print(f"wrong transforms and impostors {len(wrong)}, not refused {len(false_accepts)}")
    for r in false_accepts + false_refusals:
        print("  ", r["name"], r["decision"], round(r["error"], 2), *r["reasons"])


def main() -> None:
    """Run the battery."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--pairs", type=int, default=120)
    parser.add_argument("--impostors", type=int, default=300)
    parser.add_argument("--method", default="mirhashemi2019", choices=sorted(METHODS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    rows = []
    for number in range(arguments.pairs):
        rng = np.random.default_rng([arguments.seed, 0, number])
        rows.append(judge_pair(*right_pair(rng, number), arguments.method))
    for number in range(arguments.impostors):
        rng = np.random.default_rng([arguments.seed, 1, number])
        rows.append(judge_pair(*impostor(rng, number), None, arguments.method))
    tell(rows)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
