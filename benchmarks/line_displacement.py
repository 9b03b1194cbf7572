"""Lines that are displaced against one another: what is found of them, and what is found where there is nothing.

    python benchmarks/line_displacement.py [--honest 24] [--real 64] [--seeds 2] [--sizes 1.5]
        [--kinds sine walk halves step random turn some]

A painted surface is photographed by a camera of three bands and scanned by a camera of one, down the painting (lines are
rows) or to its right (lines are columns). Every line is sampled, by scipy's spline, where a stage that is off would have put
it: a sine, a random walk, odd lines beside even ones, one step, or at random, along the lines or across them; a sine by which lines stretch or
turn about their middles, or seven lines alone aside. SNR is 15, 30 or 40, light visible or
infrared. First come pairs in which no line is displaced, with the deviations that chance makes: scanners of
that kind, pairs of `pairs.py` (visible, infrared, inverted, turned, scaled) and of real captures
(`verdict_classes.py`, `modalities.py`). Then, by size, period and direction of the scan: the share that is found and named rightly,
the size found over the planted one, the period likewise, the share that is not accepted, the mean error of all maps, reference px, that of the
worst map that is accepted, and the root mean square of all errors over their sigma.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from functools import lru_cache
from itertools import product

import cv2
import numpy as np
from modalities import lens_pairs
from pairs import Studio, Surface, frame, paint, right_pair, view
from scipy import ndimage
from verdict_classes import real_bands, real_pair

from levkas.geometry.transforms import Composed
from levkas.registration import Registration, RegistrationRefused, register

SIZE = (418, 312)
#: Sizes, native px (amplitude, distance of the halves, height, standard deviation), and periods in lines.
PLANTED = {
    "sine": ((0.1, 0.2, 0.3, 0.75, 1.5), (7, 20, 35, 60, 100, 200)),
    "walk": ((0.3, 0.75, 1.5), (0,)),
    "halves": ((0.1, 0.2, 0.5, 1.0, 2.0), (2,)),
    "step": ((0.5, 1.0, 2.0), (0,)),
    "random": ((0.1, 0.2, 0.5), (0,)),
    "turn": ((0.2, 0.5, 1.0, 2.0), (20, 60)),
    "some": ((0.5, 1.0, 3.0), (0,)),
}
#: What a kind is rightly called.
NAMES = {
    "sine": "period",
    "walk": "",
    "halves": "comb",
    "step": "step",
    "random": "irregular",
    "turn": "period",
    "some": "aside",
}
LIGHTS = ((15, "visible"), (40, "visible"), (30, "infrared"))


@lru_cache(maxsize=2)
def surface_of(seed: int) -> Surface:
    """Return the painted surface of a seed."""
    return paint(np.random.default_rng([77, seed]))


def course(kind: str, size: float, period: float, lines: int, rng) -> np.ndarray:
    """Return the displacement of every line, (lines,) native px."""
    line = np.arange(lines)
    if kind == "step":
        return size * (line > lines * rng.uniform(0.35, 0.65))
    if kind == "some":
        return size * (np.abs(line - round(lines * rng.uniform(0.2, 0.8))) < 4)
    if kind == "random":
        return rng.normal(0, size, lines)
    if kind == "walk":
        steps = ndimage.gaussian_filter1d(np.cumsum(rng.normal(0, 1, lines + 40)), 3)[20:-20]
        return size * (steps - steps.mean()) / steps.std()
    if kind == "halves":
        return size * (line % 2 - 0.5)
    return size * np.sin(2 * np.pi * line / period + rng.uniform(0, 2 * np.pi))


def displaced(displacement: np.ndarray, shape, lines: str, way: str, *, turns: bool) -> np.ndarray:
    """Return the displacement of every px, (h, w, 2), of lines that are rows or columns, along or across them; of their ends."""
    by_row = displacement[:, None] if lines == "rows" else displacement[None, :]
    if turns:
        ends = np.linspace(-1, 1, shape[lines == "rows"])
        by_row = by_row * (ends[None, :] if lines == "rows" else ends[:, None])
    x = (lines == "rows") == (way == "along")
    return np.broadcast_to(by_row, shape)[..., None] * np.array([x, not x])


def scan(layer: np.ndarray, to_layer, shift: np.ndarray, rng, *, snr: float) -> np.ndarray:
    """Return what a scanner shows of a layer, each px moved by `shift`, (h, w, 2) px."""
    h, w, _ = shift.shape
    x, y = np.meshgrid(np.arange(w, dtype=float), np.arange(h, dtype=float))
    places = to_layer((np.stack([x, y], -1) + shift).reshape(-1, 2))
    spacing = float(np.hypot(*(places[w // 2 + 1] - places[w // 2])))
    soft = cv2.GaussianBlur(layer, (0, 0), 0.45 * max(spacing, 1.0))
    values = ndimage.map_coordinates(soft, places.T[::-1], order=3, mode="nearest").reshape(h, w)
    noise = rng.normal(0, 1, (h, w)) * np.sqrt(np.clip(values, 0.01, None) * 0.4) / snr
    return (values + noise).astype(np.float32)


def scanned(
    seed: int, snr=40.0, light="visible", kind="", size=0.0, period=0.0, lines="rows", way="along"
):
    """Return (reference bands, scan, true map without displacement, displacement of every px)."""
    surface, rng = surface_of(seed), np.random.default_rng([5, seed])
    home, scale = frame(SIZE, surface), rng.uniform(0.75, 1.3)
    other = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    truth = view(rng, SIZE, other, scale, turn=rng.normal(0, 1), shift=rng.normal(0, 0.02, 2))
    shift = np.zeros((*other[::-1], 2))
    if kind:
        count = other[1] if lines == "rows" else other[0]
        shift = displaced(
            course(kind, size, period, count, rng), other[::-1], lines, way, turns=kind == "turn"
        )
    a, b = surface.visible, surface.infrared
    still = np.zeros((*SIZE[::-1], 2))
    layers = (0.8 * a + 0.1 * a * a, a, 0.75 * a + 0.25 * b)
    ours = [scan(layer, home, still, rng, snr=40) for layer in layers]
    layer = b if light == "infrared" else 0.9 * a + 0.1 * b
    target = scan(layer, Composed(truth.inverse, home), shift, rng, snr=snr)
    return np.stack(ours, -1), target, truth, shift


def errors_of(found: Registration, truth, shift: np.ndarray) -> tuple[float, float]:
    """Return how far native px are mapped from what they show, reference px, the mean, and the root mean square over sigma."""
    h, w, _ = shift.shape
    places = np.stack(np.meshgrid(np.arange(8, w - 8, 5), np.arange(8, h - 8)), -1)
    places = places.reshape(-1, 2)
    shown = truth.inverse(places + shift[places[:, 1], places[:, 0]])
    inside = np.all((shown > 8) & (shown < np.array(SIZE) - 9), 1)
    miss = found.transforms["1"].inverse(places[inside].astype(float)) - shown[inside]
    over = miss / found.sigma["1"](shown[inside])[:, None]
    return float(np.nanmean(np.linalg.norm(miss, axis=1))), float(np.sqrt(np.nanmean(over**2)))


def judged(reference: np.ndarray, target: np.ndarray):
    """Return the registration and its line displacement; None where it was refused without a map."""
    try:
        found = register(reference, target)
    except RegistrationRefused:
        return None, None
    numbers = found.verdict.numbers["sensor"]["verification"]
    followed = numbers["line_correction"]
    return found, followed["before"] if followed else numbers["line_displacement"]


def honest(seeds: int, real: int) -> Iterator[tuple[str, np.ndarray, np.ndarray]]:
    """Yield (name, reference, target) of pairs in which no line is displaced."""
    for seed, (snr, light) in product(range(seeds), LIGHTS):
        yield f"scan {seed} {snr} {light}", *scanned(seed, snr, light)[:2]
    studio, pictures = Studio(51), real_bands() if real else {}
    for k in range(real):
        yield right_pair(studio, np.random.default_rng([51, k]), k)[:3]
        yield real_pair(pictures, np.random.default_rng([52, k]))[:3]
    for pair in lens_pairs() if real else ():
        yield pair[:3]


def planted(seed, snr, light, kind, size, period, lines, way):
    """Return found, size and period over planted, not accepted, error, error where accepted, and over sigma; None without a map."""
    reference, target, truth, shift = scanned(seed, snr, light, kind, size, period, lines, way)
    found, numbers = judged(reference, target)
    if found is None or not found.transforms:
        return None
    named = bool(numbers and numbers["course"] and NAMES[kind] in ("", numbers["course"]))
    named = named and (kind == "random" or numbers["lines"] == lines)
    ratio = numbers["size_px"] / (size * SIZE[0] / target.shape[1]) if named else np.nan
    length = numbers["period_lines"] / period if named and period else np.nan
    doubted = found.verdict.decision != "accept"
    error, spread = errors_of(found, truth, shift)
    return named, ratio, length, doubted, error, np.nan if doubted else error, spread


def over(values: np.ndarray, of=np.median) -> float:
    """Return a statistic of the values that are known, NaN of none."""
    known = values[np.isfinite(values)]
    return float(of(known)) if len(known) else np.nan


def main() -> None:
    """Print what is found of nothing, then a table of what is found by kind, size, period and direction."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--honest", type=int, default=24)
    parser.add_argument("--real", type=int, default=64)
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--sizes", type=float, nargs="*", help="only these")
    parser.add_argument("--kinds", nargs="*", default=list(PLANTED), choices=list(PLANTED))
    options = parser.parse_args()
    chance = []
    for name, reference, target in honest(options.honest, options.real):
        found, numbers = judged(reference, target)
        if numbers:
            chance.append(numbers["deviations"])
            if numbers["course"]:
                print(f"false: {name}, {found.verdict.decision}, {numbers}", flush=True)
    if chance:
        quantiles = np.quantile(chance, (0.5, 0.9, 0.99, 1)).round(1)
        print(f"{len(chance)} honest pairs: deviations {quantiles}", flush=True)
    print(
        "kind size period lines: n, named, size/planted, period/planted, not accepted, error px, worst accepted, over sigma"
    )
    for kind in options.kinds if options.seeds else ():
        for period, size, lines in product(PLANTED[kind][1], PLANTED[kind][0], ("rows", "columns")):
            if options.sizes and size not in options.sizes:
                continue
            tries = product(range(options.seeds), LIGHTS, ("along", "across"))
            rows = [planted(s, *light, kind, size, period, lines, way) for s, light, way in tries]
            table = np.array([r for r in rows if r], float).T
            named, ratio, length, doubted, error, accepted, spread = table
            figures = named.mean(), over(ratio), over(length), doubted.mean(), error.mean()
            figures += over(accepted, np.max), over(spread)
            text = " ".join(f"{v:.2f}" for v in figures)
            print(f"{kind} {size} {period} {lines}: {len(named)} {text}", flush=True)


if __name__ == "__main__":
    main()
