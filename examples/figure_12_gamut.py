"""The CIELAB gamut of a database in three views: python examples/figure_12_gamut.py demo/database out.png"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

import levkas
from levkas.colour.gamut import VIEWS, gamut_cells, lab_colours, lab_of, munsell_lab

CAMERA = "lctf-vis"
SPANS = ((0, 105), (-80, 100), (-80, 120))  # L, a, b


def main(database: Path, output: Path) -> Figure:
    opened = levkas.open(database)
    colours = []
    for name in opened:
        cube = opened[name][CAMERA]
        lab = lab_of(cube.values, cube.wavelength.values)
        untrue = levkas.Flag.OUTSIDE | levkas.Flag.SATURATED | levkas.Flag.GLARE
        lab[(cube.levkas.flags.values & untrue).any(-1)] = np.nan
        colours.append(lab.reshape(-1, 3))
    cells = gamut_cells(np.concatenate(colours))
    shades, munsell = lab_colours(cells[:, :3]) / 255, munsell_lab()

    figure = Figure((11, 4), layout="constrained")
    for axes, letter in zip(figure.subplots(1, 3), VIEWS, strict=True):
        across, up, x, y = VIEWS[letter]
        order = np.argsort(cells[:, 3 - x - y], kind="stable")
        axes.scatter(*cells[order][:, [x, y]].T, s=5, c=shades[order], linewidths=0)
        axes.plot(*munsell[:, [x, y]].T, "k.", markersize=0.8)
        axes.set(xlabel=across, ylabel=up, title=f"({letter})", aspect="equal")
        axes.set(xlim=SPANS[x], ylim=SPANS[y])
        axes.grid(alpha=0.3)
    figure.savefig(output, dpi=90)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
