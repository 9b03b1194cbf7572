"""Previews of every camera, side by side: python examples/figure_13_previews.py demo/database out.png"""

import sys
from pathlib import Path

from matplotlib.figure import Figure
from PIL import Image

import levkas


def main(database: Path, output: Path) -> Figure:
    opened = levkas.open(database)
    name = next(iter(opened))
    shown = {}
    for layer in opened[name]:
        parts = (layer,) if isinstance(layer, str) else layer  # camera, or camera and setup
        preview = opened.path / "objects" / name / f"{'_'.join((name, *parts))}.png"
        if preview.is_file():  # a refused camera has none
            cube = opened[name][layer]
            shown[f"{', '.join(parts)}: {cube.sizes['band']} bands"] = Image.open(preview)

    width, height = next(iter(shown.values())).size
    figure = Figure((2 * len(shown), 2 * height / width + 0.35), layout="constrained")
    row = figure.subplots(1, len(shown), squeeze=False)[0]
    for axes, letter, (title, picture) in zip(row, "abcdefghijkl", shown.items(), strict=False):
        axes.imshow(picture)
        axes.set_title(f"({letter}) {title}", fontsize=9)
        axes.set_axis_off()
    figure.savefig(output, dpi=72)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
