"""Simulated campaigns, several seeds, the default method and the paper's side by side in one run.

    python benchmarks/registration.py [FOLDER] [--seeds 1 2 3 …] [--presets small hard] [--scale 0.2]
        [--objects 1] [--methods levkas mirhashemi2019] [--results FILE]
    python benchmarks/registration.py --built DATABASE=TRUTH … [--results FILE]

Of every camera: the mean error of all its bands, and the largest 99.9th percentile of any, in px of the
reference band, against exact truth on the whole frame; and, of the default method, the share of errors within the circles
that should hold nine of ten, by the sigma of the registration record. FOLDER keeps campaigns, databases and results.
With --built nothing is simulated: databases whose truth is known are measured.
"""

from __future__ import annotations

import argparse
import json
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np
from results import add_option, record

from levkas.building import build
from levkas.geometry import from_dict
from levkas.quality.evaluation.similarity import position_errors, read_truth
from levkas.registration.record import Sigma
from levkas.registration.uncertainty import NINE_OF_TEN
from levkas.simulation import simulate_campaign


def measure(database: Path, truth: Path) -> dict[str, dict]:
    """Return what became of every capture: verdict, mean and 99.9th percentile of its errors, share held by sigma."""
    found = {}
    for path in sorted(database.glob("objects/*/registration/*.json")):
        record = json.loads(path.read_text(encoding="utf-8"))
        known = read_truth(truth, record["object"], record["camera"])
        errors, held = [], []
        for label, band in record["bands"].items():
            miss = position_errors(
                from_dict(band["transform"]), known.reference, known.bands[label]
            )
            errors.append(np.where(np.isfinite(miss), miss, np.inf))
            sigma = Sigma.from_dict(band["sigma"])(known.reference) if "sigma" in band else 0.0
            if np.max(sigma) > 0:
                held.append(np.mean((miss <= NINE_OF_TEN * sigma)[np.isfinite(miss)]))
        found[f"{record['object']}/{path.stem}"] = {
            "camera": record["camera"],
            "verdict": record["verdict"]["decision"],
            "mean": float(np.mean([e.mean() for e in errors])) if errors else None,
            "p999": float(max(np.quantile(e, 0.999) for e in errors)) if errors else None,
            "held": float(np.mean(held)) if held else None,
        }
    return found


KEYS = {
    "levkas": "",
    "mirhashemi2019": '\n[registration]\nmethod = "mirhashemi2019"\n',
}


COLUMNS = {"levkas": "Levkas", "mirhashemi2019": "paper"}
"""How results.json names a method."""


def run(
    folder: Path, preset: str, seed: int, scale: float, methods: list[str], objects: int
) -> dict[str, dict]:
    """Simulate one campaign where it is not there yet, and build it by every method."""
    several = "" if objects == 1 else f"-{objects}"
    campaign = folder / f"{preset}-{seed}-{scale:g}{several}"
    if not (campaign / "truth" / "truth.json").is_file():
        for _ in simulate_campaign(
            campaign, preset=preset, seed=seed, scale=scale, objects=objects
        ):
            pass
    plain = (
        (campaign / "campaign.toml").read_text(encoding="utf-8").partition("\n[registration]")[0]
    )
    result = {}
    for method in methods:
        (campaign / "campaign.toml").write_text(plain + KEYS[method], encoding="utf-8")
        database = campaign / method
        for step in build(campaign, output=database):
            if step.state in ("refused", "failed"):
                print("   ", method, step.line)
        result[method] = measure(database, campaign / "truth")
    (campaign / "campaign.toml").write_text(plain, encoding="utf-8")
    return result


def tell(results: dict[str, list[dict]]) -> dict[tuple[str, str], float | None]:
    """Print a line a preset, camera and method; return the median of the means, by camera and method."""
    medians = {}
    print(f"{'preset':8s} {'capture':20s} {'method':16s} {'n':>3s} {'mean':>7s} {'worst':>7s} "
          f"{'p99.9':>7s} {'worst':>7s}  verdicts; held")  # fmt: skip
    for preset, several in results.items():
        rows = defaultdict(list)
        for result in several:
            for method, captures in result.items():
                for name, row in captures.items():
                    rows[name.partition("/")[2], method].append(row)
        for (name, method), row in sorted(rows.items()):
            means, highs = ([r[k] for r in row if r[k] is not None] for k in ("mean", "p999"))
            said = [r["verdict"] for r in row]
            counts = ", ".join(f"{said.count(v)} {v}" for v in dict.fromkeys(said))
            numbers = (np.median(means), max(means), np.median(highs), max(highs)) if means else ()
            text = " ".join(f"{v:7.3f}" for v in numbers)
            held = [r["held"] for r in row if r["held"] is not None]
            share = f"; {np.mean(held):.2f}" if held else ""
            print(f"{preset:8s} {name:20s} {method:16s} {len(row):3d} {text}  {counts}{share}")
            if method in COLUMNS:
                camera = name, f"{preset}, {COLUMNS[method]}"
                medians[camera] = numbers[0] if numbers else None
    return medians


def held_of(captures: list[dict]) -> dict[str, float]:
    """Return the mean share held of each camera and of all captures."""
    shares = defaultdict(list)
    for row in captures:
        if row["held"] is not None:
            shares[row["camera"]].append(row["held"])
            shares["all"].append(row["held"])
    return {name: float(np.mean(several)) for name, several in shares.items()}


def main() -> None:
    """Run all seeds, telling what is known after each."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("folder", type=Path, nargs="?", default=Path(tempfile.mkdtemp()))
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(1, 11)))
    parser.add_argument("--presets", nargs="+", default=["small", "hard"])
    parser.add_argument("--scale", type=float, default=0.2)
    parser.add_argument("--objects", type=int, default=1)
    parser.add_argument("--methods", nargs="+", choices=KEYS, default=["levkas", "mirhashemi2019"])
    parser.add_argument("--built", nargs="+", metavar="DATABASE=TRUTH", help="measure only these")
    add_option(parser)
    arguments = parser.parse_args()
    if arguments.built:
        found = [measure(*map(Path, one.split("="))) for one in arguments.built]
        tell({"built": [{"levkas": captures} for captures in found]})
        shares = held_of([row for captures in found for row in captures.values()])
        print(", ".join(f"{name} {share:.2f}" for name, share in shares.items()))
        record(arguments.results, "sigma-position", shares)
        return
    results: dict[str, list[dict]] = defaultdict(list)
    for seed in arguments.seeds:
        for preset in arguments.presets:
            one = run(
                arguments.folder, preset, seed, arguments.scale, arguments.methods,
                arguments.objects,
            )  # fmt: skip
            results[preset].append(one)
            print(f"== {preset}, seeds up to {seed}", flush=True)
    record(arguments.results, "seeds", tell(results))
    (arguments.folder / "results.json").write_text(json.dumps(results, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
