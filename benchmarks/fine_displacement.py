"""Displacement finer than a check window: which patches and ripples are found, of pictures as in `line_displacement.py`.

    python benchmarks/fine_displacement.py [--seeds 2] [--kinds patch ripple]

A painted surface is photographed twice, the second time by a camera of one band, SNR 15, 30 or 40, in visible or infrared light. A patch
of it lies aside, or all of it ripples in x and y. By kind, size in px of the second picture (of a patch its displacement, of a ripple its amplitude) and by side or period: the share that is not accepted, the share
that is named at least, size found over planted, and the mean error, reference px, of the worst map that is accepted.
Pairs in which nothing is displaced: `line_displacement.py --seeds 0` prints those in which anything is found.
"""

from __future__ import annotations

import argparse
from itertools import product

import numpy as np
from line_displacement import LIGHTS, SIZE, error_of, over, scan, scanned, surface_of
from pairs import frame, view

from levkas.geometry.transforms import Composed
from levkas.registration import RegistrationRefused, register

PLANTED = {
    "patch": ((0.5, 1.0, 2.0, 4.0), (30, 44, 60)),
    "ripple": ((0.3, 0.6, 1.0), (16, 25, 40, 60)),
}


def displaced(kind: str, size: float, side: float, shape, rng) -> np.ndarray:
    """Return the displacement of every px, (h, w, 2)."""
    x, y = np.meshgrid(np.arange(shape[1], dtype=float), np.arange(shape[0], dtype=float))
    if kind == "ripple":
        a, b = rng.uniform(0, side, 2)
        amount = np.sin(2 * np.pi * (x - a) / side) * np.sin(2 * np.pi * (y - b) / side)
    else:
        a, b = rng.uniform(0.3, 0.7, 2) * shape[::-1]
        amount = (np.abs(x - a) < side / 2) & (np.abs(y - b) < side / 2)
    angle = rng.uniform(0, 2 * np.pi)
    return size * amount[..., None] * np.array([np.cos(angle), np.sin(angle)])


def planted(seed: int, snr: float, light: str, kind: str, size: float, side: float):
    """Return not accepted, named, size over planted, error where accepted; None without a map."""
    reference = scanned(seed, snr, light)[0]
    surface, rng = surface_of(seed), np.random.default_rng([9, seed])
    home, scale = frame(SIZE, surface), rng.uniform(0.8, 1.3)
    other = (round(SIZE[0] * scale), round(SIZE[1] * scale))
    truth = view(rng, SIZE, other, scale, turn=rng.normal(0, 1), shift=rng.normal(0, 0.02, 2))
    shift = displaced(kind, size, side, other[::-1], rng)
    layer = (
        surface.infrared if light == "infrared" else 0.9 * surface.visible + 0.1 * surface.infrared
    )
    target = scan(layer, Composed(truth.inverse, home), shift, rng, snr=snr)
    try:
        found = register(reference, target)
    except RegistrationRefused:
        return None
    reasons = " ".join(found.verdict.reasons)
    fine = found.verdict.numbers["sensor"]["verification"]["fine_displacement"] or {}
    size_px = fine.get("size_px" if kind == "patch" else "rms_px") or np.nan
    doubted = found.verdict.decision != "accept"
    error = np.nan if doubted else error_of(found, truth, shift)
    return doubted, "maller than" in reasons, size_px * scale / size, error


def main() -> None:
    """Print what is found by kind, size and side or period."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=2)
    parser.add_argument("--kinds", nargs="*", default=list(PLANTED), choices=list(PLANTED))
    options = parser.parse_args()
    print("kind size side: n, not accepted, named, size/planted, error px")
    for kind in options.kinds:
        for side, size in product(PLANTED[kind][1], PLANTED[kind][0]):
            tries = product(range(options.seeds), LIGHTS)
            rows = [planted(seed, *light, kind, size, side) for seed, light in tries]
            doubted, named, ratio, error = np.array([r for r in rows if r], float).T
            figures = doubted.mean(), named.mean(), over(ratio), over(error, np.max)
            text = " ".join(f"{v:.2f}" for v in figures)
            print(f"{kind} {size} {side}: {len(doubted)} {text}", flush=True)


if __name__ == "__main__":
    main()
