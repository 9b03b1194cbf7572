"""Methods of spectral estimation on measured pigments: errors, coverage of the interval, time of a cube.

    python benchmarks/estimation.py [DATA] [--sensitivities CSV] [--methods NAME…] [--cube] [--json OUT] [--results FILE]

DATA is the folder of real data, ../shared/data by default: 1,592 swatches of 332 historical pigments,
410 to 720 nm by 10. Responses are those of a camera under D50, with noise of one part in 100 of each;
folds hold whole pigments out. CSV has wavelength, R, G, B; without it the camera is the Nikon D5100 that
the NPL measured, of colour-science. `--cube` also estimates a cube of 1,700 × 1,300 pixels, 33 bands from
16 channels, by each method.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import numpy as np
from results import add_option
from results import record as record_figures

from levkas.colour.illuminants import illuminant
from levkas.estimation import metrics
from levkas.estimation.methods import METHODS, EstimationMethod, find_method
from levkas.estimation.scores import summarise
from levkas.estimation.training import Training
from levkas.readers.envi_header import parse_header
from levkas.readers.spectra import parse_spectra

BANDS = np.arange(410.0, 721.0, 10.0)
SNR, FOLDS, SEED = 100, 5, 0
CUBE, CHANNELS, CUBE_BANDS, ANCHORS = 1700 * 1300, 16, 33, 1500
WIDE = 1.959964
NAMES = {
    "pseudo-inverse": "pseudo-inverse", "wiener": "Wiener",
    "matern": "kernel ridge, Matérn 3/2",
    "gaussian-process": "Gaussian process",
}  # fmt: skip
"""How results.json names a method; others are in the printed table only."""


def read_pigments(folder: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return wavelengths, spectra (n, w) and the number of each one's pigment."""
    header = parse_header(folder / "__speclib_averages.hdr")
    wavelengths = np.array(header.fields["wavelength"], float)
    spectra = np.fromfile(folder / "__speclib_averages.sli", "<f4").reshape(-1, len(wavelengths))
    names = [name.rpartition("--")[0] for name in header.fields["pname"]]
    return wavelengths, spectra.astype(float), np.unique(names, return_inverse=True)[1]


def read_sensitivities(path: Path | None) -> tuple[np.ndarray, str]:
    """Return wavelength, R, G, B as columns, and the camera's name."""
    if path is not None:
        return parse_spectra(path.read_text(encoding="utf-8"), 4)[0], path.stem
    import colour

    table = colour.MSDS_CAMERA_SENSITIVITIES["Nikon 5100 (NPL)"]
    return np.column_stack([table.wavelengths, table.values]), "Nikon D5100 (NPL)"


def simulate(data: Path, sensitivities: np.ndarray, rng: np.random.Generator) -> Training:
    """Return responses of the camera under D50 with noise, and spectra at `BANDS`; pigments are groups."""
    wavelengths, spectra, pigments = read_pigments(data / "spectra" / "pigments")
    fine = np.arange(406.0, 721.0)
    light = np.interp(fine, *illuminant("D50"))
    sensitivity = [
        np.interp(fine, sensitivities[:, 0], c, left=0, right=0) for c in sensitivities.T[1:4]
    ]
    weights = np.stack(sensitivity, 1) * light[:, None]
    fine_spectra = np.stack([np.interp(fine, wavelengths, s) for s in spectra])
    responses = fine_spectra @ (weights / weights.sum(0))
    responses *= 1 + rng.normal(0, 1 / SNR, responses.shape)
    bands = np.stack([np.interp(BANDS, wavelengths, s) for s in spectra])
    return Training(responses, bands, groups=pigments)


def cross_validate(
    method: EstimationMethod, samples: Training
) -> tuple[np.ndarray, np.ndarray | None, float]:
    """Return spectra and sigma of samples that were held out, pigment by pigment, and seconds."""
    rng = np.random.default_rng(SEED)
    fold = rng.permutation(samples.groups.max() + 1)[samples.groups] % FOLDS
    spectra, sigma = np.empty(samples.spectra.shape), np.empty(samples.spectra.shape)
    known = True
    start = time.perf_counter()
    for held in range(FOLDS):
        model = method.fit(samples.take(fold != held), rng)
        spectra[fold == held], found = model(samples.responses[fold == held])
        known = known and found is not None
        if found is not None:
            sigma[fold == held] = found
    return spectra, sigma if known else None, time.perf_counter() - start


def score(method: EstimationMethod, samples: Training) -> dict[str, object]:
    spectra, sigma, seconds = cross_validate(method, samples)
    measured = samples.spectra
    errors = {
        "rmse": metrics.rmse(spectra, measured),
        "delta_e_d65": metrics.delta_e(spectra, measured, BANDS, "D65"),
    }
    record: dict[str, object] = {k: summarise(e) for k, e in errors.items()}
    record["rmse_of_all"] = float(np.sqrt(np.square(spectra - measured).mean()))
    record["seconds"] = round(seconds, 2)
    if sigma is not None:
        record["coverage"] = float((np.abs(spectra - measured) <= WIDE * sigma).mean())
    return record


def cube_seconds(method: EstimationMethod) -> dict[str, float]:
    """Return seconds, and seconds of all processors, in which a full-size cube is estimated."""
    rng = np.random.default_rng(SEED)
    grid = np.linspace(0, 1, CUBE_BANDS)
    bumps = np.exp(-(((grid - np.linspace(0, 1, 6)[:, None]) / 0.2) ** 2))
    narrow = np.exp(-(((grid[:, None] - np.linspace(0, 1, CHANNELS)) / 0.05) ** 2))
    narrow /= narrow.sum(0)
    spectra = rng.dirichlet(np.ones(6), ANCHORS) @ bumps
    noise = rng.normal(0, 0.01, (ANCHORS, CHANNELS))
    model = method.fit(Training(spectra @ narrow + noise, spectra), rng)
    pixels = rng.dirichlet(np.ones(6), CUBE) @ (bumps @ narrow)
    start, used = time.perf_counter(), time.process_time()
    model(pixels)
    return {"wall": time.perf_counter() - start, "processors": time.process_time() - used}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    shared = Path(__file__).resolve().parents[2] / "shared" / "data"
    parser.add_argument("data", nargs="?", type=Path, default=shared)
    parser.add_argument("--sensitivities", type=Path)
    parser.add_argument("--methods", nargs="+", default=list(METHODS))
    parser.add_argument("--cube", action="store_true")
    parser.add_argument("--json", type=Path)
    add_option(parser)
    options = parser.parse_args()
    sensitivities, camera = read_sensitivities(options.sensitivities)
    samples = simulate(options.data, sensitivities, np.random.default_rng(SEED))
    print(f"{len(samples)} spectra of {samples.groups.max() + 1} pigments, {camera}, SNR {SNR}")
    print(f"{'method':22} {'RMSE':>7} {'median':>7} {'p95':>7} {'ΔE00':>6} {'of all':>7} {'s':>6}")
    record: dict[str, object] = {"camera": camera, "methods": {}}
    for name in options.methods:
        method = find_method(name)
        found = score(method, samples)
        if options.cube:
            found["cube_seconds"] = cube_seconds(method)
        record["methods"][name] = found
        rmse, colour = found["rmse"], found["delta_e_d65"]
        print(
            f"{name:22} {rmse['mean']:7.4f} {rmse['median']:7.4f} {rmse['p95']:7.4f} {colour['mean']:6.2f} "
            f"{found['rmse_of_all']:7.4f} {found['seconds']:6.1f}"
            + (f"  interval holds {found['coverage']:.1%}" if "coverage" in found else "")
            + (f"  cube {found['cube_seconds']['wall']:.0f} s" if options.cube else ""),
            flush=True,
        )
    figures = {}
    for name, found in record["methods"].items():
        for column, kind in (("RMSE", "rmse"), ("ΔE00 D65", "delta_e_d65")):
            if name in NAMES:
                figures[NAMES[name], column] = found[kind]["mean"]
    record_figures(options.results, "estimation", figures)
    if options.json:
        options.json.write_text(json.dumps(record, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
