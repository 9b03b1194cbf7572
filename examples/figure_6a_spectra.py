"""Halogen before and after a D50-simulating filter: python examples/figure_6a_spectra.py out.png"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from levkas.colour.illuminants import illuminant, planck
from levkas.planning import GRID, colour_temperature, load_setup

BENCH = Path(__file__).parent / "plan"


def main(output: Path) -> Figure:
    setup = load_setup(BENCH)
    bare = planck(GRID, 3000.0)  # as in plan/bench.toml
    curves = {
        "halogen": (bare, "#a40000", "-"),
        "behind the D50 filter": (setup.lighting("proposed").lamps[0].spectrum, "#204a87", "-"),
        "behind the D65 filter": (setup.lighting("d65").lamps[0].spectrum, "#4e9a06", "-"),
    }
    for name, colour in (("A", "#a40000"), ("D50", "#204a87"), ("D65", "#4e9a06")):
        curves[f"CIE {name}"] = (np.interp(GRID, *illuminant(name)), colour, ":")

    figure = Figure((7.4, 4.2), layout="constrained")
    axes = figure.subplots()
    inside = (GRID >= 380) & (GRID <= 780)
    for name, (power, colour, style) in curves.items():
        kelvin, duv = colour_temperature(power)
        label = f"{name}: {kelvin:,.0f} K, Duv {duv:+.3f}"
        shown = power[inside] / power[inside].max()
        axes.plot(GRID[inside], shown, style, color=colour, linewidth=1.6, label=label)
    axes.set(xlim=(380, 780), ylim=(0, 1.02), xlabel="wavelength (nm)", ylabel="relative power")
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=9, loc="lower right")
    figure.savefig(output, dpi=100)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
