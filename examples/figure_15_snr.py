"""Signal-to-noise of grey patches by three cameras: python examples/figure_15_snr.py out.png

Two shots of a ColorChecker each, by Eq. (2), flat-fielded; the tunable filter blurs below 510 nm.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter

import levkas.quality.targets as chart
from levkas.calibration.noise_model import Sensor

KIND, PITCH, SENSOR = chart.CHARTS["ColorChecker24"], 60, Sensor()
AREAS = chart.place_patches((KIND.corners + 0.5) * PITCH, KIND, (6 * PITCH, 4 * PITCH))
GREYS, Y = list(KIND.greys), KIND.luminances[list(KIND.greys)]
CAMERAS = {  # wavelengths, nm, and electrons that the white gives there
    "(a) RGB camera": ([610, 540, 460], [22e3, 30e3, 17e3]),
    "(b) beam splitter": ([630, 545, 465, 600, 525, 445], [9e3, 12e3, 2e3, 8e3, 9e3, 1e3]),
    "(c) tunable filter": (range(420, 721, 20), np.geomspace(6e3, 24e3, 16)),
}


def shot(scene: np.ndarray, electrons: np.ndarray, blurred: np.ndarray, rng: np.random.Generator):
    counts = rng.poisson(scene * electrons) + rng.poisson(SENSOR.dark, scene.shape)
    values = (counts - SENSOR.dark + rng.normal(0, SENSOR.read, scene.shape)) / electrons
    return np.where(blurred, uniform_filter(values, (3, 3, 0)), values)


def main(output: Path) -> Figure:
    rng, figure = np.random.default_rng(1), Figure((10, 7.5), layout="constrained")
    axes = figure.subplots(2, 2).ravel()
    for panel, (name, (nm, electrons)) in zip(axes, CAMERAS.items(), strict=False):
        spectra = chart.reference_of(KIND).at(np.array(nm, float)).reshape(4, 6, -1)
        scene = np.kron(spectra, np.ones((PITCH, PITCH, 1)))
        blurred = np.array(nm) < (510 if "tunable" in name else 0)
        shots = [shot(scene, np.array(electrons), blurred, rng) for _ in range(2)]
        mean, flags = sum(shots) / 2, np.zeros(scene.shape, np.uint8)
        table = chart.measure_patches(mean, flags, AREAS, shots=shots)
        planes = chart.noise_planes(mean, AREAS, shots=shots)
        corrected = table.corrected_db([chart.find_preblur(p, fitted=3) for p in planes])
        for i, wavelength in enumerate(nm):
            x, y = table.mean[GREYS, i], table.snr_db[GREYS, i]
            panel.plot(x, y, "o-", ms=3, label=f"{wavelength} nm")
        panel.set(xscale="log", title=name, xlabel="signal of the channel", ylabel="SNR (dB)")
        above = panel.secondary_xaxis("top")
        above.set_xticks(table.mean[GREYS].mean(1), [f"{100 * v:.0f} %" for v in Y])
    for g, grey in zip(GREYS, np.linspace(0.75, 0, 6), strict=True):
        axes[3].plot(nm, table.snr_db[g], "o-", ms=3, color=str(grey), label=KIND.patches[g])
        axes[3].plot(nm, corrected[g], "--", color="#c62828", lw=1, label="corrected")
    axes[3].set(title="(d) by patch; red: corrected", xlabel="wavelength (nm)", ylabel="SNR (dB)")
    figure.savefig(output, dpi=80)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
