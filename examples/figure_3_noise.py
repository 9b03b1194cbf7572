"""Signal-to-noise ratio over exposure, and what limits it: python examples/figure_3_noise.py out.png

The line is the closed form; each dot is one simulated picture of 640 x 480 pixels, Eqs. (1) and (2).
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from levkas.calibration.noise_model import Sensor, noise_variance, snr_db

PIXELS = 640 * 480
REGIMES = {"dark and read-out": "#e8e8ee", "shot noise": "#f6eeda", "PRNU": "#e6f0e6"}


def sampled_snr_db(exposure: float, sensor: Sensor, rng: np.random.Generator) -> float:
    shot = rng.poisson(exposure, PIXELS) * (1 + rng.normal(0, sensor.prnu, PIXELS))
    dark = rng.poisson(sensor.dark, PIXELS) * (1 + rng.normal(0, sensor.dsnu, PIXELS))
    values = shot + dark + rng.normal(0, sensor.read, PIXELS)  # Eq. (2)
    return 10 * float(np.log10(values.mean() / values.std()))  # Eq. (1)


def main(output: Path) -> Figure:
    sensor, rng = Sensor(), np.random.default_rng(1)
    exposure = np.geomspace(1, sensor.full_well, 400)
    dots = np.geomspace(1, sensor.full_well, 24)
    sampled = [sampled_snr_db(e, sensor, rng) for e in dots]

    figure = Figure((7, 4.2), layout="constrained")
    axes = figure.subplots()
    # Shot noise overtakes the noise in the dark, PRNU the shot noise.
    grown = 1 + sensor.prnu**2
    crossings = float(noise_variance(0.0, sensor)) / grown, grown / sensor.prnu**2
    edges = (exposure[0], *crossings, exposure[-1])
    for (name, colour), left, right in zip(REGIMES.items(), edges, edges[1:], strict=False):
        axes.axvspan(left, right, color=colour, linewidth=0)
        axes.text(np.sqrt(left * right), 18.1, name, ha="center", va="center")
    ceiling = -10 * float(np.log10(sensor.prnu))  # of PRNU alone, dB of Eq. (1)
    axes.axhline(ceiling, color="0.4", linestyle="--", linewidth=1)
    axes.text(1.2, ceiling - 0.2, f"PRNU alone: {ceiling:.1f} dB", va="top", color="0.3")
    curve = snr_db(exposure, sensor, subtract_dark=False)
    axes.plot(exposure, curve, color="#204a87", label="closed form")
    axes.plot(dots, sampled, "o", color="#a40000", markersize=4, clip_on=False, label="sampled")
    axes.set(xscale="log", xlim=(1, sensor.full_well), ylim=(5.5, 18.8))
    axes.set(xlabel="exposure e (photo-electrons)", ylabel="SNR (dB, 10 log₁₀ μ/σ)")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="center left", bbox_to_anchor=(0.0, 0.5), frameon=False)
    figure.savefig(output, dpi=110)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
