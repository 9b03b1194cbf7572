"""How even the light is, from measured whites: python examples/figure_6b_light.py out.png dark.tif white.tif …

Frames are TIFF; of a Bayer mosaic one green sensel in four is enough (--phase as an option of `main`).
"""

import sys
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import tifffile
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from levkas.quality.image_quality.light import light_field


def main(
    output: Path, dark: Path, whites: Sequence[Path], *, phase: tuple[int, int] = (0, 1)
) -> Figure:
    frames = [tifffile.imread(path).astype(float) for path in whites]
    above = np.mean(frames, axis=0) - tifffile.imread(dark)
    field = light_field(above[phase[0] :: 2, phase[1] :: 2])
    (width, height), (x, y, across, down) = field.size, field.rectangle

    figure = Figure((8, 4.6), layout="constrained")
    grid = figure.add_gridspec(2, 2, width_ratios=(4, 1), height_ratios=(3, 1))
    axes, right, below = (figure.add_subplot(part) for part in (grid[0, 0], grid[0, 1], grid[1, 0]))
    extent = (0, width, height, 0)
    axes.imshow(field.levels, extent=extent, cmap="gray", vmin=0, aspect="auto")
    drawn = axes.contour(
        field.levels, np.arange(0.5, 1, 0.05), extent=(0, width, 0, height), colors="#a9822b"
    )
    axes.clabel(drawn, fontsize=7, fmt=lambda level: f"{100 * level:.0f} %")
    axes.add_patch(Rectangle((x, y), across, down, fill=False, edgecolor="#2d7a46", linewidth=2.5))
    (
        axes.axhline(height / 2, color="#c62828", lw=0.8),
        axes.axvline(width / 2, color="#c62828", lw=0.8),
    )
    axes.set_title(
        f"within {100 * field.drop:.0f} %: {across} x {down} px, {100 * field.share:.0f} % of the field"
    )
    row, column = field.profiles
    below.plot((np.arange(len(row)) + 0.5) * field.step, row, color="#c62828")
    below.set(xlim=(0, width), ylim=(0, 1.05), xlabel="px")
    right.plot(column, (np.arange(len(column)) + 0.5) * field.step, color="#c62828")
    right.set(ylim=(height, 0), xlim=(0, 1.05))
    figure.savefig(output, dpi=80)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), [Path(name) for name in sys.argv[3:]])
