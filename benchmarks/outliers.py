"""The paper's removal of outliers, one pair a round: 10,000 matches, 5,000 of them wrong.

    python benchmarks/outliers.py [--matches 10000] [--repeats 5] [--plain 400] [--json OUT]

Half of the matches are right to 0.3 px, half lie up to 60 px off and pass the cut under scale alone,
so that the loop itself removes them. The plain loop, which solves the fit anew for every round, is
run on `--plain` matches of the same kind: the pairs that leave, and their order, are compared there,
and its time is told for 10,000 by what a round takes.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from results import add_option, record

from levkas.geometry.transforms import Affine, Polynomial
from levkas.registration.outliers import RemovalTerms, clean

SIZE = (1392, 1040)
REJECT, STOP = 108.0, 1.0


def matches(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    target = rng.uniform(0, 1, (count, 2)) * SIZE
    middle = np.array(SIZE) / 2
    p = (target - middle) / SIZE[0]
    reference = middle + (p * (1 + 0.02 * (p**2).sum(1, keepdims=True))) * SIZE[0]
    reference += rng.uniform(-0.3, 0.3, reference.shape) * 0.9
    wrong = rng.permutation(count)[: count // 2]
    away = rng.uniform(3, 60, len(wrong))
    turn = rng.uniform(0, 2 * np.pi, len(wrong))
    reference[wrong] += np.stack([away * np.cos(turn), away * np.sin(turn)], 1)
    return target, reference


def run(target: np.ndarray, reference: np.ndarray) -> np.ndarray:
    trace = clean(
        target, reference, RemovalTerms(Affine.identity(), REJECT, STOP), size=SIZE,
        target_size=SIZE,
    ).trace  # fmt: skip
    return trace.removed[trace.removed >= 0]


def plain(target: np.ndarray, reference: np.ndarray) -> list[int]:
    """Solve, measure, drop the worst: as the paper writes it."""
    kept = np.linalg.norm(target - reference, axis=1) < REJECT
    removed = []
    while True:
        model = Polynomial.fit(target[kept], reference[kept], order=3)
        errors = np.where(kept, np.linalg.norm(model(target) - reference, axis=1), -np.inf)
        worst = int(errors.argmax())
        if errors[worst] <= STOP:
            return removed
        kept[worst] = False
        removed.append(worst)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--matches", type=int, default=10_000)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--plain", type=int, default=400)
    parser.add_argument("--json", type=Path)
    add_option(parser)
    given = parser.parse_args()
    target, reference = matches(given.matches, 1)
    removed = run(target, reference)
    wall, worked = [], []
    for _ in range(given.repeats):
        start, cpu = time.perf_counter(), time.process_time()
        run(target, reference)
        wall.append(time.perf_counter() - start)
        worked.append(time.process_time() - cpu)
    few = matches(given.plain, 2)
    start = time.process_time()
    slow = plain(*few)
    each = (time.process_time() - start) / max(len(slow), 1) * given.matches / given.plain
    report = {
        "matches": given.matches,
        "removed": len(removed),
        "seconds": float(np.min(wall)),
        "cpu_seconds": float(np.min(worked)),
        "same_pairs_as_plain": run(*few).tolist() == slow,
        "plain_cpu_seconds": each * len(removed),
    }
    print(json.dumps(report, indent=1))
    if given.json:
        given.json.write_text(json.dumps(report))
    name = f"removal of {len(removed):,} outliers"
    record(given.results, "speed", {name: float(np.min(worked))})


if __name__ == "__main__":
    main()
