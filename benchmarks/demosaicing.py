"""Demosaicing of a beam-splitter camera's six channels: error a channel by method, and whether sigma holds.

    python benchmarks/demosaicing.py [FOLDER] [--results FILE]

Paintings (photographs in FOLDER, default ../shared/data/paintings, at half their size) as the two Bayer sensors of the simulated
beam-splitter camera see them. Reflectance spectra are mixtures of three smooth ones ("smooth"), or of the simulation's paints that
give the colour camera the same picture ("paints"); channels are their means under the sensitivities. Each sensor is made a mosaic with noise (of 1 % at white) and demosaiced. Of what was not measured: PSNR
a channel, dB of 1.0; spread of (value − truth)/sigma; share within 1.96 sigma.
"""

import sys
from pathlib import Path

import cv2
import numpy as np
from results import record, taken_option
from scipy.optimize import nnls

from levkas.calibration.mosaic import demosaic
from levkas.calibration.wiener_mosaic import correlate_channels, wiener_method
from levkas.simulation.cameras import camera_models
from levkas.simulation.painting import Canvas
from levkas.simulation.pigments import WAVELENGTHS, paint_spectra

PATTERN = (("R", "G"), ("G", "B"))
EDGE = 8


LEVELS = 32


def sensitivities():
    """Return those of the six channels, (n, 6)."""
    return np.stack([band.response for band in camera_models()["msbs"].bands[:6]], 1)


def smooth_spectra(codes):
    """Return spectra of sRGB codes, (n, 3) → (n, wavelengths), from three smooth ones."""
    blue, red = (
        1 / (1 + np.exp((WAVELENGTHS - at) / width)) for at, width in ((500, 10), (585, -10))
    )
    linear = np.where(codes <= 0.04045, codes / 12.92, ((codes + 0.055) / 1.055) ** 2.4)
    return linear @ np.stack([red, 1 - blue - red, blue])


def paint_mixtures(codes):
    """Return spectra of mixtures of paints, as the simulation mixes them: least squares without negative amounts."""
    paints = paint_spectra(Canvas(20, 20, 1.0, np.random.default_rng(0)).paints, WAVELENGTHS)
    responses = np.stack([band.response for band in camera_models()["d80"].bands])
    system = np.vstack([responses @ paints.T, np.full(len(paints), 0.5)])
    amounts = np.stack([nnls(system, np.append(code**2.2, 0.5))[0] for code in codes])
    return amounts / amounts.sum(1, keepdims=True) @ paints


def paintings(folder):
    """Yield a name and a picture of six channels, 0 to 1."""
    bands = sensitivities()
    for path in sorted(Path(folder).glob("*.jpg")):
        whole = cv2.imread(str(path))[..., ::-1].astype(np.float32) / 255
        small = cv2.resize(whole, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        for kind, spectra in (("smooth", smooth_spectra), ("paints", paint_mixtures)):
            levels = np.clip((small * LEVELS).astype(int), 0, LEVELS - 1).reshape(-1, 3)
            codes, at = np.unique(levels, axis=0, return_inverse=True)
            if kind == "smooth":
                codes, at = small.reshape(-1, 3), slice(None)
            else:
                codes = (codes + 0.5) / LEVELS
            seen = (spectra(codes) @ (bands / bands.sum(0)))[at].reshape(*small.shape[:2], 6)
            yield f"{path.stem}, {kind}", seen.astype(np.float32)


def mosaic_of(truth, noise=0.01):
    """Return a mosaic with noise, its variance, and where each channel was measured."""
    y, x = np.indices(truth.shape[:2])
    which = np.array([[0, 1], [1, 2]])[y % 2, x % 2]
    exact = np.take_along_axis(truth, which[..., None], 2)[..., 0]
    variance = (noise**2 * (exact + 1e-3)).astype(np.float32)
    rng = np.random.default_rng(0)
    seen = exact + np.sqrt(variance) * rng.standard_normal(exact.shape)
    return seen.astype(np.float32), variance, np.eye(3, dtype=bool)[which]


def score(truth, method):
    """Return PSNR a channel, dB, spread of the error over sigma, and the share within 1.96."""
    seen, variance, own = mosaic_of(truth)
    none = np.zeros(seen.shape, np.uint8)
    values, _, spread = demosaic(seen, none, variance, PATTERN, method=method, channels="RGB")
    inner = np.s_[EDGE:-EDGE, EDGE:-EDGE]
    miss, apart = (values - truth)[inner], ~own[inner]
    psnr = [-10 * np.log10(np.mean(miss[..., k][apart[..., k]] ** 2)) for k in range(3)]
    pull = (miss / np.sqrt(spread[inner]))[apart]
    return np.array(psnr), float(pull.std()), float(np.mean(np.abs(pull) < 1.96))


def main(folder="../shared/data/paintings", *, results=None):
    bands, gains, pulls = sensitivities(), {"bilinear": [], "malvar": []}, []
    print(
        "| painting, spectra, sensor | method | PSNR of R, G, B, dB | mean | error over sigma | within 1.96 |\n|---|---|---|---|---|---|"
    )
    for name, picture in paintings(folder):
        for number in (0, 1):
            part = slice(3 * number, 3 * number + 3)
            own = wiener_method(correlate_channels(WAVELENGTHS, bands[:, part]))
            means = {}
            for label, method in (("bilinear", "bilinear"), ("malvar", "malvar"), ("wiener", own)):
                psnr, pull, within = score(picture[..., part], method)
                three = ", ".join(f"{p:.1f}" for p in psnr)
                print(
                    f"| {name}, {number + 1} | {label} | {three} | {psnr.mean():.2f} | {pull:.2f} | {100 * within:.1f} % |"
                )
                means[label] = psnr.mean()
            pulls.append(pull)  # of the last, "wiener"
            for label, several in gains.items():
                several.append(means["wiener"] - means[label])
    figures = {
        "over bilinear": gains["bilinear"],
        "over Malvar": gains["malvar"],
        "error over sigma": pulls,
    }
    record(results, "demosaicing", {k: (min(v), max(v)) for k, v in figures.items()})


if __name__ == "__main__":
    results = taken_option()
    main(*sys.argv[1:], results=results)
