"""Sensitivities of the bench's cameras, and what they get: python examples/figure_7_sensitivities.py out.png"""

import sys
from pathlib import Path

import numpy as np
from matplotlib import colormaps
from matplotlib.figure import Figure

from levkas.planning import GRID, load_setup, plan_exposure

BENCH = Path(__file__).parent / "plan"
LETTERS = {"R": "#d55e00", "G": "#009e73", "B": "#0072b2", "I": "#555555"}


def colour_of(label: str, wavelength: float):
    if label[0] in LETTERS:
        return LETTERS[label[0]]
    return colormaps["turbo"](np.clip((wavelength - 380) / 600, 0, 1))


def main(output: Path) -> Figure:
    setup = load_setup(BENCH)
    found = {e.camera: e for e in plan_exposure(setup, "proposed")}
    names = ("lctf-nir", "d80", "msbs")
    figure = Figure((7, 7.2), layout="constrained")
    for axes, name, letter in zip(figure.subplots(3, 1, sharex=True), names, "abc", strict=True):
        camera, exposure = setup.cameras[name], found[name]
        for label, centre, quantum in zip(
            camera.labels, camera.wavelengths, camera.quantum, strict=True
        ):
            drawn = quantum / camera.quantum.max()
            axes.plot(GRID, drawn, color=colour_of(label, centre), linewidth=1.3)
            if len(camera.labels) < 8:
                top = int(drawn.argmax())
                axes.annotate(label, (GRID[top], drawn[top]), (0, 3), textcoords="offset points")
        words = f"({letter}) {name}: weakest under the proposed light {exposure.limiting}"
        if name == "msbs":
            peaks = camera.quantum.max(1) / camera.quantum.max(1).min()
            words += f"\npeaks {':'.join(camera.labels)} = {':'.join(f'{v:.1f}' for v in peaks)}"
        axes.set_title(words, loc="left", fontsize=10)
        axes.set(xlim=(380, 1000), ylim=(0, 1.18), ylabel="relative sensitivity")
        axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("wavelength (nm)")
    figure.savefig(output, dpi=90)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
