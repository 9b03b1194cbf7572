"""Signal-to-noise of grey patches by three cameras: python examples/figure_15_snr.py out.png"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter

import levkas.quality.targets.charts as chart
import levkas.quality.targets.patches as patch
from levkas.calibration.noise_model import Sensor

KIND, PITCH, SENSOR = chart.CHARTS["ColorChecker24"], 60, Sensor()
AREAS = chart.place_patches((KIND.corners + 0.5) * PITCH, KIND, (6 * PITCH, 4 * PITCH))
GREYS, Y = list(KIND.greys), 100 * KIND.luminances[list(KIND.greys)]
INKS = {"R": "#d55e00", "G": "#009e73", "B": "#0072b2", "I": "#000000"}
CAMERAS = {  # name, channels, their wavelengths in nm, electrons that the white gives there
    "(a) RGB camera": ("R G B", [610, 540, 460], [22e3, 30e3, 17e3]),
    "(b) beam splitter": ("R1 G1 B1 R2 G2 B2 IR", [630, 545, 465, 600, 525, 445, 800], [9e3, 12e3, 2e3, 8e3, 9e3, 1e3, 6e3]),
    "(c) tunable filter": ("", list(range(420, 721, 20)), np.geomspace(6e3, 24e3, 16)),
}  # fmt: skip


def shot(scene: np.ndarray, nm: np.ndarray, electrons: list[float], rng: np.random.Generator):
    counts = rng.poisson(scene * electrons) + rng.poisson(SENSOR.dark, scene.shape)
    values = (counts - SENSOR.dark + rng.normal(0, SENSOR.read, scene.shape)) / electrons
    return np.where((nm < 510) & (len(nm) > 7), uniform_filter(values, (3, 3, 0)), values)


def main(output: Path) -> Figure:
    rng, figure = np.random.default_rng(1), Figure((11, 8), layout="constrained")
    axes = figure.subplots(2, 2).ravel()
    for panel, (name, (labels, nm, electrons)) in zip(axes, CAMERAS.items(), strict=False):
        spectra = chart.reference_of(KIND).at(np.minimum(nm, 730.0))
        spectra[GREYS[-2:]] = np.where(np.array(nm) > 730, 0.3, spectra[GREYS[-2:]])
        scene = np.kron(spectra.reshape(4, 6, -1), np.ones((PITCH, PITCH, 1)))
        mean = sum(shots := [shot(scene, np.array(nm), electrons, rng) for _ in range(2)]) / 2
        table = patch.measure_patches(mean, np.zeros(mean.shape, np.uint8), AREAS, shots=shots)
        for i, label in enumerate(labels.split() or [f"{n} nm" for n in nm]):
            ink = INKS.get(label[0], (i / 15, 0.4, 1 - i / 15))
            line = "o--" if label[1:] == "2" else "o-"
            panel.plot(Y, table.snr_db[GREYS, i], line, ms=3, color=ink, label=label)
        panel.set(xscale="log", title=name, xlabel="luminance of the patch (%)", ylabel="SNR (dB)")
        panel.set_xticks(Y, [f"{v:.0f}" for v in Y])
        panel.minorticks_off()
        panel.legend(ncols=2, fontsize=7, frameon=False, loc="lower right")
    planes = patch.noise_planes(mean, AREAS, shots=shots)
    corrected = table.corrected_db([patch.find_preblur(p, fitted=3) for p in planes])
    axes[3].set(title="(d) dashed: corrected", xlabel="wavelength (nm)", ylabel="SNR (dB)")
    for g, y, grey in zip(GREYS, Y, np.linspace(0.75, 0, 6), strict=True):
        axes[3].plot(nm, table.snr_db[g], "o-", ms=3, color=str(grey), label=f"{y:.0f} %")
        axes[3].plot(nm, corrected[g], "--", color=INKS["R"], lw=1)
    axes[3].legend(title="luminance", ncols=2, fontsize=7, title_fontsize=8, frameon=False)
    figure.savefig(output, dpi=80)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
