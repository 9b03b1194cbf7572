"""How often a registration succeeds and its verdict is right: true pairs and impostors in one run.

    python benchmarks/verdict.py [--pairs 320] [--impostors 1000] [--method levkas] [--json OUT] [--results FILE]

A true pair is one surface imaged twice through known maps: any rotation, scale 0.2 to 5, shifted by up
to 40 % each way, SNR from 10, visible, near infrared or inverted, mirrored, half covered; an impostor
has no true map. Success is a pair that is not refused and at most 0.5 reference px wrong in the mean
over what both show; a false accept is an impostor that is not refused, or a pair that is more than
1 px wrong and not refused; a false refusal is a map that is right to 0.5 px and refused.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from pathlib import Path

import numpy as np
from pairs import Studio, impostor, right_pair
from results import add_option, record

from levkas.registration import METHODS, BandImage, RegistrationRefused, register

RIGHT_PX, WRONG_PX = 0.5, 1.0


def error_of(transform, truth, size, shown) -> float:
    """Return the mean error, reference px, over what both pictures show; `size` of the reference."""
    x, y = np.meshgrid(np.linspace(0, size[0] - 1, 25), np.linspace(0, size[1] - 1, 19))
    points = np.stack([x.ravel(), y.ravel()], 1)
    places = truth(points)
    both = np.all((places >= 0) & (places <= np.array(shown.shape[::-1]) - 1), 1)
    column, row = np.rint(places[both]).astype(int).T
    both[both] = shown[row, column]
    miss = truth.inverse(transform(points[both])) - points[both]
    distance = np.linalg.norm(miss, axis=1)
    return float(np.where(np.isfinite(distance), distance, 1e3).mean())


def judge_pair(number, name, reference, target, truth=None, shown=None, *, method: str) -> dict:
    """Register one pair; return what was decided and how wrong the transform is."""
    start = time.perf_counter()
    bands = [[BandImage.of("grey", image)] for image in (reference, target)]
    row = {"number": number, "name": name, "true": truth is not None, "error": np.inf}
    try:
        result = register(*bands, reference_band="grey", method=method)
    except RegistrationRefused as refusal:
        row |= {"decision": "refuse", "reasons": [str(refusal)], "numbers": {}}
    else:
        verdict = result.verdict.to_dict()
        row |= {
            "decision": verdict["decision"],
            "reasons": verdict["reasons"],
            "numbers": verdict["numbers"],
        }
        if truth is not None:
            row["error"] = error_of(result.transforms["grey"], truth, reference.shape[::-1], shown)
    return row | {"seconds": time.perf_counter() - start}


def tell(rows: list[dict]) -> tuple[float, int]:
    """Print what came of each kind of pair; return percent of true pairs that are right and not refused, and impostors that are not refused."""
    print(f"{'pairs':24s} {'n':>4s} {'accept':>7s} {'warn':>5s} {'refuse':>7s} {'right':>6s}")
    for name in sorted({r["name"] for r in rows}, key=lambda n: ("/" not in n, n)):
        group = [r for r in rows if r["name"] == name]
        said = Counter(r["decision"] for r in group)
        right = sum(r["error"] <= RIGHT_PX for r in group)
        print(
            f"{name:24s} {len(group):4d} {said['accept']:7d} {said['warn']:5d} "
            f"{said['refuse']:7d} {right:6d}"
        )
    pairs = [r for r in rows if r["true"]]
    right = [r for r in pairs if r["error"] <= RIGHT_PX]
    good = [r for r in right if r["decision"] != "refuse"]
    wrong = [r for r in rows if not r["true"] or WRONG_PX < r["error"] < np.inf]
    false_accepts = [r for r in wrong if r["decision"] != "refuse"]
    share = 100 * len(good) / max(len(pairs), 1)
    print(f"success {len(good)} of {len(pairs)} pairs ({share:.1f} %)")
    print(f"right transforms {len(right)}, refused {len(right) - len(good)}")
    print(f"wrong transforms and impostors {len(wrong)}, not refused {len(false_accepts)}")
    print(f"seconds a pair, median {np.median([r['seconds'] for r in rows]):.2f}")
    for r in rows:
        if r in false_accepts or (r["true"] and r not in good):
            print("  ", r["number"], r["name"], r["decision"], f"{r['error']:.2f}", *r["reasons"])
    return share, sum(not r["true"] for r in false_accepts)


def main() -> None:
    """Run the battery."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--pairs", type=int, default=320)
    parser.add_argument("--impostors", type=int, default=1000)
    parser.add_argument("--method", default="levkas", choices=sorted(METHODS))
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--json", type=Path)
    add_option(parser)
    arguments = parser.parse_args()
    studio, rows = Studio(arguments.seed), []
    for kind, (make, count) in enumerate(
        [(right_pair, arguments.pairs), (impostor, arguments.impostors)]
    ):
        for number in range(count):
            rng = np.random.default_rng([arguments.seed, kind, number])
            pair = make(studio, rng, number)
            rows.append(judge_pair(number, *pair, method=arguments.method))
    share, accepted = tell(rows)
    figures = {
        f"{arguments.pairs:,} true pairs: right, not refused": share,
        f"{arguments.impostors:,} impostors: accepted": accepted,
    }
    if arguments.method == "levkas":
        record(arguments.results, "verdict", figures)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
