"""Close-ups of one object under all setups of a camera: python examples/figure_4_setups.py database out.png

The database must hold a camera under two setups: levkas simulate --setups makes a campaign that has.
"""

import sys
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from PIL import Image

import levkas
from levkas.quality.image_quality.light import choose_places


def pictures(database: Path) -> tuple[str, dict[str, np.ndarray]]:
    opened = levkas.open(database)
    for name in opened:
        layers = [(layer, "") if isinstance(layer, str) else layer for layer in opened[name]]
        for camera in {camera for camera, setup in layers if setup}:
            shown = {}
            for setup in sorted(setup for other, setup in layers if other == camera):
                stem = "_".join(part for part in (name, camera, setup) if part)
                preview = opened.path / "objects" / name / f"{stem}.png"
                shown[setup or "default setup"] = np.asarray(Image.open(preview).convert("RGB"))
            return f"{name}, {camera}", shown
    raise SystemExit("no camera stands under two setups in this database")


def main(database: Path, output: Path) -> Figure:
    title, shown = pictures(database)
    side, corners = choose_places(list(shown.values()))
    figure = Figure((2.2 * len(corners), 2.2 * len(shown) + 0.4), layout="constrained")
    figure.suptitle(title)
    rows = figure.subplots(len(shown), len(corners), squeeze=False)
    for row, (setup, picture) in zip(rows, shown.items(), strict=True):
        for axes, (x, y), letter in zip(row, corners, "abcd", strict=False):
            axes.imshow(picture[y : y + side, x : x + side])
            axes.set(xticks=[], yticks=[], xlabel=f"({letter})" if row is rows[-1] else "")
        row[0].set_ylabel(setup)
    figure.savefig(output, dpi=72)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
