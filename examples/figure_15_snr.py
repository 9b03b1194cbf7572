"""Signal-to-noise of grey patches by three cameras: python examples/figure_15_snr.py out.png

Two flat-fielded shots of a ColorChecker each, drawn by Eq. (2); the tunable filter blurs below 510 nm.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from scipy.ndimage import uniform_filter

from levkas.noise import Sensor
from levkas.radiometry import CHARTS, find_preblur, measure_patches, noise_planes
from levkas.radiometry import place_patches, reference_of

CHART, PITCH, SENSOR = CHARTS["ColorChecker24"], 60, Sensor()
CORNERS = (CHART.corners + 0.5) * PITCH
# Wavelengths, and electrons that the white gives in each channel.
CAMERAS = {
    "(a) RGB camera": ([610, 540, 460], [22e3, 30e3, 17e3]),
    "(b) beam splitter": ([630, 545, 465, 600, 525, 445, 720], [9e3, 12e3, 2e3, 8e3, 9e3, 1e3, 14e3]),
    "(c) tunable filter": (np.arange(420, 721, 20), np.geomspace(6e3, 24e3, 16)),
}  # fmt: skip


def shot(scene, electrons, wavelength, rng):
    counts = rng.poisson(scene * electrons) + rng.poisson(SENSOR.dark, scene.shape)
    values = (counts - SENSOR.dark + rng.normal(0, SENSOR.read, scene.shape)) / electrons
    return (
        uniform_filter(values, 3)
        if "tunable" in wavelength and int(wavelength[:3]) < 510
        else values
    )


def main(output: Path) -> Figure:
    rng, figure = np.random.default_rng(1), Figure((10, 7.5), layout="constrained")
    axes, greys = figure.subplots(2, 2).ravel(), list(CHART.greys)
    for panel, (name, (wavelengths, electrons)) in zip(axes, CAMERAS.items(), strict=False):
        spectra = reference_of(CHART).at(np.asarray(wavelengths, float)).reshape(4, 6, -1)
        scene = np.kron(spectra, np.ones((PITCH, PITCH, 1)))
        names = [f"{w} {name}" for w in wavelengths]
        shots = [np.stack([shot(scene[..., i], e, names[i], rng) for i, e in enumerate(electrons)], -1)
                 for _ in range(2)]  # fmt: skip
        areas = place_patches(CORNERS, CHART, (6 * PITCH, 4 * PITCH))
        mean, clear = (shots[0] + shots[1]) / 2, np.zeros(scene.shape, np.uint8)
        table = measure_patches(mean, clear, areas, shots=tuple(shots))
        preblurs = [find_preblur(p) for p in noise_planes(mean, areas, shots=tuple(shots))]
        for i, wavelength in enumerate(wavelengths):
            panel.plot(
                table.mean[greys, i], table.snr_db[greys, i], "o-", ms=3, label=f"{wavelength} nm"
            )
        panel.set(xscale="log", title=name, xlabel="signal of the channel", ylabel="SNR (dB)")
        above = panel.secondary_xaxis("top")
        above.set_xticks(
            table.mean[greys].mean(1), [f"{100 * y:.0f}" for y in CHART.luminances[greys]]
        )
        above.set_xlabel("luminance Y, %")
    for patch in greys:
        label = {"label": CHART.patches[patch]}
        axes[3].plot(
            wavelengths,
            table.snr_db[patch],
            "o-",
            ms=3,
            color=str(0.1 * greys.index(patch)),
            **label,
        )
        axes[3].plot(wavelengths, table.corrected_db(preblurs)[patch], "--", color="#c62828", lw=1)
    axes[3].set(title="(d) the same, patch by patch", xlabel="wavelength (nm)", ylabel="SNR (dB)")
    axes[0].legend(), axes[3].legend(ncols=3, fontsize=7)
    figure.savefig(output, dpi=80)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
