"""Whether what a registration says of its own accuracy is true: the share of errors that circles hold.

    python benchmarks/sigma.py [DATABASE=TRUTH …] [--results FILE]

Of every band of every camera of databases whose truth is known: the share of truth's points that lie
within the circle that should hold nine of ten, by the sigma of the registration record. Without an argument, of `levkas demo` with another seed.
"""

import json
import subprocess
import sys
import tempfile
from collections import defaultdict
from pathlib import Path

import numpy as np
from results import record as record_figures
from results import taken_option

from levkas.geometry import from_dict
from levkas.quality.evaluation.similarity import read_truth
from levkas.registration.record import Sigma
from levkas.registration.uncertainty import NINE_OF_TEN


def held(record: dict, truth) -> list[tuple[float, float, float]]:
    """Return (share held, sigma, error per axis) of every band that has a sigma above nought."""
    rows = []
    for label, band in record["bands"].items():
        sigma = Sigma.from_dict(band["sigma"])(truth.reference) if "sigma" in band else np.zeros(1)
        if sigma.max() == 0 or label not in truth.bands:
            continue
        places = from_dict(band["transform"]).inverse(truth.bands[label])
        known = np.isfinite(places).all(1)
        error = np.linalg.norm(places - truth.reference, axis=1)[known]
        sigma = sigma[known]
        share = float((error <= NINE_OF_TEN * sigma).mean())
        rows.append((share, float(sigma.mean()), float(np.sqrt((error**2).mean() / 2))))
    return rows


def made(folder: Path) -> str:
    """Simulate and build a campaign; return its DATABASE=TRUTH."""
    commands = ["simulate", str(folder), "--seed", "7"], ["build", str(folder)]
    for command in commands:
        program = "from levkas.cli import main; main()"
        subprocess.run([sys.executable, "-c", program, *command], check=True)
    return f"{folder / 'database'}={folder / 'truth'}"


def main(pairs: list[str], results: Path | None) -> None:
    """Print a line a capture and the share of each camera over all."""
    pairs = pairs or [made(Path(tempfile.mkdtemp()) / "seed7")]
    shares = defaultdict(list)
    print(f"{'capture':42s} {'held':>5s} {'sigma':>7s} {'error':>7s}")
    for pair in pairs:
        database, truth = (Path(part) for part in pair.split("="))
        for path in sorted(database.glob("objects/*/registration/*.json")):
            record = json.loads(path.read_text(encoding="utf-8"))
            known = read_truth(truth, record["object"], record["camera"])
            rows = held(record, known) if known and record["bands"] else []
            if not rows:
                continue
            share, sigma, error = np.mean(rows, 0)
            name = f"{database.parent.name} {record['object']}/{path.stem}"
            print(f"{name:42s} {share:5.2f} {sigma:7.4f} {error:7.4f}")
            shares[record["camera"]].append(share)
    for camera, several in shares.items():
        print(f"{camera:42s} {np.mean(several):5.2f}  of {len(several)} captures")
    figures = {camera: float(np.mean(several)) for camera, several in shares.items()}
    figures["all"] = float(np.mean([share for several in shares.values() for share in several]))
    record_figures(results, "sigma-position", figures)


if __name__ == "__main__":
    results = taken_option()
    main(sys.argv[1:], results)
