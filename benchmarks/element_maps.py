"""Stacks of element maps of one scan, registered to a photograph: right maps, refusals and impostors.

    python benchmarks/element_maps.py [--pairs 40] [--impostors 100] [--seed 61] [--json OUT]

A painting, real or simulated, is separated into pigments by its colours. Each pigment has elements (lead white Pb; vermilion
Hg and S; azurite Cu; earth Fe, Mn and K; lead-tin yellow Pb and Sn; malachite Cu; smalt Co, Ni, As and K; bone black Ca and P), its layer a
thickness that varies, and some elements lie in the ground, in a painting below that no photograph shows, or nowhere at all. A spot of one map
pixel scans it with Poisson noise, 6 to 20 maps of 90 to 260 px, each pixel 4 to 20 of the photograph; every other line, scanned
backwards, lies up to a third of a map pixel aside, and each line a little more. The map is right where it is at most 0.3 map pixels wrong in the mean
over what both show. An impostor is the scan of another painting.
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
from pairs import paint, view
from scipy import ndimage

from levkas.registration import BandImage, RegistrationRefused, register

RIGHT_PX = 0.3
PIGMENTS = ({"Pb": 1.0}, {"Hg": 1.0, "S": 0.4}, {"Cu": 0.8}, {"Fe": 0.9, "Mn": 0.2, "K": 0.1}, {"Pb": 0.6, "Sn": 0.5},
            {"Cu": 0.6, "Ca": 0.1}, {"Co": 0.4, "Ni": 0.2, "As": 0.2, "K": 0.5}, {"Ca": 0.5, "P": 0.2})  # fmt: skip
BRIGHTEST = ("Pb", "Hg", "Cu", "Fe", "Ca", "Sn", "Co", "K", "S", "Mn", "Ni", "As", "P")
EMPTY = ("Ti", "Cr", "Br", "Ar", "Cl", "Ag", "Zn")


def paintings() -> list[np.ndarray]:
    """Return linear colours, (h, w, 3) float32 of 0 to 1, of real paintings where there are any, and of simulated ones."""
    here = Path(os.environ.get("LEVKAS_REAL_DATA", Path(__file__).parents[2] / "shared" / "data"))
    found = [
        (cv2.imread(str(path)).astype(np.float32) / 255) ** 2.2
        for path in sorted((here / "paintings").glob("*.jpg"))
    ]
    for seed in range(4):
        one = paint(np.random.default_rng([61, 9, seed]))
        found.append(
            np.stack([0.6 * one.visible + 0.4 * one.infrared, one.visible, one.infrared], -1)
        )
    return [np.clip(one, 0.01, 1).astype(np.float32) for one in found]


def pigments(colours: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return the share of each of eight pigments, (h, w, 8) float32, by soft clusters of colours."""
    flat = np.log(colours.reshape(-1, 3))
    some = np.ascontiguousarray(flat[:: max(1, len(flat) // 20000)])
    cv2.setRNGSeed(int(rng.integers(1 << 30)))
    rule = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_MAX_ITER, 30, 1e-3)
    centres = cv2.kmeans(some, len(PIGMENTS), None, rule, 2, cv2.KMEANS_PP_CENTERS)[2]
    apart = np.stack([np.square(flat - centre).sum(1) for centre in centres], 1)
    weights = np.exp(-apart / (2 * 0.3**2) + apart.min(1, keepdims=True) / (2 * 0.3**2))
    weights /= weights.sum(1, keepdims=True)
    # The lightest is lead white, the darkest bone black, the others any.
    light = np.argsort(-centres.mean(1))
    order = [light[0], *rng.permutation(light[1:-1]), light[-1]]
    return weights[:, order].reshape(*colours.shape[:2], -1).astype(np.float32)


def field(rng: np.random.Generator, shape: tuple[int, int], sigma: float) -> np.ndarray:
    """Return a smooth field of unit variance."""
    soft = ndimage.gaussian_filter(rng.normal(size=[n // 8 + 4 for n in shape]), sigma / 8)
    out = cv2.resize(
        (soft / soft.std()).astype(np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC
    )
    return out


def elements(
    colours: np.ndarray, below: np.ndarray, rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return what of each element lies in the paint, (h, w) each."""
    share = pigments(colours, rng)
    thick = np.exp(0.2 * field(rng, share.shape[:2], 12) + 0.2 * field(rng, share.shape[:2], 120))
    found = {name: np.zeros(share.shape[:2], np.float32) for name in BRIGHTEST}
    for k, recipe in enumerate(PIGMENTS):
        for name, part in recipe.items():
            found[name] += part * share[..., k] * thick
    for name in ("Pb", "Hg", "Cu", "Fe"):  # mixed in everywhere
        found[name] += 0.1 * thick
    ground = np.exp(0.2 * field(rng, share.shape[:2], 60))
    found["Ca"] += 0.5 * ground
    hidden = cv2.resize(below, share.shape[1::-1], interpolation=cv2.INTER_AREA).mean(-1)
    for name in rng.choice(["Pb", "Fe", "Hg", "Ca"], 2, replace=False):
        found[name] += rng.uniform(0.1, 0.8) * hidden
    for name in EMPTY:
        found[name] = 0.02 * ground
    return found


def scan(
    found: dict[str, np.ndarray],
    to_surface,
    size: tuple[int, int],
    coarse: float,
    rng: np.random.Generator,
) -> dict[str, np.ndarray]:
    """Scan the elements, (height, width) counts each; `to_surface` takes px of a map to px of the painting."""
    count = int(rng.integers(6, 21))
    names = [*BRIGHTEST, *EMPTY]
    chosen = [names[k] for k in sorted(rng.permutation(len(names))[:count])]
    if not {"Pb", "Hg", "Cu", "Fe"} & set(chosen):
        chosen[0] = "Pb"
    fine = 3
    x, y = np.meshgrid(*((np.arange(n * fine) + 0.5) / fine - 0.5 for n in size))
    line = np.rint(y).astype(int).clip(0, size[1] - 1)
    swing = rng.uniform(-1 / 3, 1 / 3) / 2
    aside = np.where(np.arange(size[1]) % 2, swing, -swing) + rng.normal(0, 0.07, size[1])
    aside -= aside.mean()
    places = to_surface(np.stack([(x + aside[line]).ravel(), y.ravel()], 1))
    maps = {}
    dwell = np.exp(rng.uniform(np.log(8), np.log(150)))  # counts of a full layer in one px
    for name in chosen:
        soft = cv2.GaussianBlur(found[name], (0, 0), 0.35 * coarse)
        values = ndimage.map_coordinates(soft, places.T[::-1], order=1, mode="constant")
        values = values.reshape(size[1], fine, size[0], fine).mean((1, 3))
        strength = float(np.exp(rng.normal(0, 0.7)))
        background = rng.uniform(0, 0.2)
        maps[name] = rng.poisson(dwell * strength * (values + background)).astype(np.float32)
    return maps


def pair(pictures: list[np.ndarray], rng: np.random.Generator, *, same: bool):
    """Return bands of the photograph, maps, true map, sampling ratio and where maps show the painting."""
    k, other, below = rng.permutation(len(pictures))[:3]
    coarse = float(np.exp(rng.uniform(np.log(4), np.log(20))))
    longest = min(260, 3000 / coarse)
    width = int(rng.uniform(min(90, longest - 1), longest))
    size = (width, int(width * rng.uniform(0.65, 1)))
    photo = (round(size[0] * coarse * 1.1), round(size[1] * coarse * 1.1))

    def cut(picture: np.ndarray) -> np.ndarray:
        h, w = picture.shape[:2]
        part = rng.uniform(0.75, 1) * min(w / photo[0], h / photo[1])
        wide, high = int(part * photo[0]), int(part * photo[1])
        x, y = int(rng.integers(w - wide + 1)), int(rng.integers(h - high + 1))
        return cv2.resize(
            picture[y : y + high, x : x + wide],
            photo,
            interpolation=cv2.INTER_AREA if part > 1 else cv2.INTER_CUBIC,
        )

    colours = np.clip(cut(pictures[k]), 0.005, 1)
    texture = np.exp(0.04 * rng.normal(size=colours.shape[:2]).astype(np.float32))[..., None]
    shown = colours * texture
    reference = shown + rng.normal(0, 1, shown.shape).astype(np.float32) * np.sqrt(shown) / 60
    turn = rng.choice([0, 90, 180]) if rng.uniform() < 0.1 else 0
    truth = view(
        rng, photo, size, 1 / coarse, turn=turn + rng.normal(0, 1.5), shift=rng.normal(0, 0.04, 2)
    )
    painted = colours if same else np.clip(cut(pictures[other]), 0.005, 1)
    maps = scan(elements(painted, cut(pictures[below]), rng), truth.inverse, size, coarse, rng)
    return reference, maps, truth, coarse, size


def judge(reference, maps, truth, coarse, size) -> dict:
    """Register one pair and return its decision, its error in map px, and the time."""
    bands = [BandImage.of(name, reference[..., i]) for i, name in enumerate("BGR")]
    stack = [BandImage.of(name, values) for name, values in maps.items()]
    begun, row = time.perf_counter(), {"coarse": round(coarse, 1), "maps": len(maps), "size": size}
    try:
        found = register(bands, stack, reference_band="G", one_scan=True)
    except RegistrationRefused as refused:
        row |= {"decision": "refuse", "reasons": [p.code for p in refused.problems]}
        return row | {"s": round(time.perf_counter() - begun, 1)}
    h, w = reference.shape[:2]
    x, y = np.meshgrid(np.linspace(0, w - 1, 40), np.linspace(0, h - 1, 40))
    points = np.stack([x.ravel(), y.ravel()], 1)
    there = truth(points)
    inside = ((there >= 0) & (there <= np.array(size) - 1)).all(1)
    one = next(iter(found.transforms.values()))  # the maps share it
    error = np.linalg.norm(one(points[inside]) - there[inside], axis=1).mean()
    numbers = next(iter(found.errors["sensors"].values()))
    return row | {
        **found.verdict.to_dict(),
        "error": round(float(error), 3),
        "outlines": bool(numbers["by_outlines"]),
        "step": numbers["step"],
        "share": round(numbers["share_above_chance"], 2),
        "checks": [
            numbers["verification"][k] for k in ("windows", "found", "agreeing", "window_median")
        ],
        "s": round(time.perf_counter() - begun, 1),
    }


def main() -> None:
    """Register pairs and impostors and print how many are right."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pairs", type=int, default=40)
    parser.add_argument("--impostors", type=int, default=100)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--seed", type=int, default=61)
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    pictures, rows = paintings(), []
    for same, count in ((True, arguments.pairs), (False, arguments.impostors)):
        for number in range(arguments.first, arguments.first + count):
            rng = np.random.default_rng([arguments.seed, int(same), number])
            rows.append({"true": same, "number": number} | judge(*pair(pictures, rng, same=same)))
            print({k: v for k, v in rows[-1].items() if k != "numbers"}, flush=True)
            if arguments.json:
                arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")
    summarise(rows)


def summarise(rows: list[dict]) -> None:
    """Print right, wrong and refused ones."""
    for same in (True, False):
        group = [r for r in rows if r["true"] == same]
        found = Counter((r["decision"], r.get("error", 9) <= RIGHT_PX) for r in group)
        print("pairs" if same else "impostors", len(group), dict(found))


if __name__ == "__main__":
    main()
