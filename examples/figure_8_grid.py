"""Orientation, region and size of the grid, in one warp: python examples/figure_8_grid.py out.png"""

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import tifffile
from matplotlib.figure import Figure

import levkas
from levkas.simulation import Preset

SMALL = Preset(scale=0.25, thin=True, charts=False, supersampling=1, fineness=2.0)


def photograph() -> np.ndarray:
    """Three bands of a simulated icon over those of the white board, (h, w, 3): red, green, blue."""
    with TemporaryDirectory() as folder:
        list(levkas.simulate_campaign(Path(folder, "icon"), preset=SMALL, cameras=["lctf-vis"]))
        raw = Path(folder, "icon", "raw", "lctf-vis")
        bands = [
            tifffile.imread(raw / "icon1" / name) / tifffile.imread(raw / "white" / name)
            for name in ("630nm_00.tif", "550nm_00.tif", "470nm_00.tif")
        ]
    return np.stack(bands, -1).astype(np.float32)


def main(output: Path) -> Figure:
    source = photograph()
    height, width = source.shape[:2]
    # In the frame after a quarter turn clockwise; three grid pixels for every four of the source.
    grid = levkas.Grid((width, height), rotate=90, region=(26, 30, 212, 284), output=(159, 213))
    result = levkas.warp(source, grid.transform, grid.shape).values

    figure = Figure((7.6, 3.9), layout="constrained")
    left, right = figure.subplots(1, 2, width_ratios=(4, 2.24))
    for axes, picture in ((left, source), (right, result)):
        axes.imshow(np.clip(picture, 0, 1) ** (1 / 2.2))
        axes.set(xlabel="x (px)", ylabel="y (px)")
    w, h = grid.size
    corners = np.array([[0, 0], [w, 0], [w, h], [0, h], [0, 0]]) - 0.5
    outline = grid.transform(corners)
    left.plot(*outline.T, color="cyan", linewidth=1.5)
    left.plot(*outline[0], "o", color="cyan", markersize=7)
    right.plot(*corners[0], "o", color="cyan", markersize=7, clip_on=False)
    left.set_title(f"reference as captured, {width} x {height} px", fontsize=10)
    right.set_title(f"on the grid, {w} x {h} px", fontsize=10)
    figure.savefig(output, dpi=80)
    return figure


if __name__ == "__main__":
    main(Path(sys.argv[1]))
