"""Tiles placed by ashlar and by multiview-stitcher, for `benchmarks/tiles.py --others PYTHON`.

Runs in an environment that has them (`pip install ashlar multiview-stitcher`; ashlar wants Java). Reads a folder of `0.tif`, `1.tif` …
(row by row) and `layout.json` with the number of columns, the share of the side that neighbours overlap by and the positions of corners;
prints {way: {number of tile: 3 x 3 matrix, px of the tile → px of the mosaic}} as JSON on the last line.
"""

import json
import sys
from pathlib import Path

import numpy as np
import tifffile


def by_ashlar(folder, layout):
    from ashlar import fileseries, reg

    reader = fileseries.FileSeriesReader(
        str(folder), pattern="{series}.tif", overlap=layout["overlap"], width=layout["columns"],
        height=layout["rows"], layout="raster", direction="horizontal", pixel_size=1.0,
    )  # fmt: skip
    aligner = reg.EdgeAligner(reader, channel=0, max_shift=60, do_make_thumbnail=False)
    aligner.run()
    return {k: shifted(*place[::-1]) for k, place in enumerate(np.asarray(aligner.positions))}


def by_multiview_stitcher(folder, layout):
    from multiview_stitcher import msi_utils, registration
    from multiview_stitcher import spatial_image_utils as si_utils

    pictures = [
        msi_utils.get_msim_from_sim(
            si_utils.get_sim_from_array(
                tifffile.imread(folder / f"{k}.tif"), dims=["y", "x"], scale={"y": 1.0, "x": 1.0},
                translation={"y": y, "x": x}, transform_key="stage",
            ),
            scale_factors=[],
        )
        for k, (x, y) in enumerate(layout["positions"])
    ]  # fmt: skip
    registration.register(
        pictures, reg_channel_index=0, transform_key="stage", new_transform_key="placed"
    )
    places = {}
    for k, (picture, (x, y)) in enumerate(zip(pictures, layout["positions"], strict=True)):
        world = np.asarray(msi_utils.get_transform_from_msim(picture, "placed"), float)
        world = world.reshape(world.shape[-2:])
        swap = np.eye(3)[[1, 0, 2]]
        places[k] = swap @ world @ swap @ shifted(x, y)
    return places


def shifted(x, y):
    return np.array([[1.0, 0, x], [0, 1, y], [0, 0, 1]])


def main():
    folder = Path(sys.argv[1])
    layout = json.loads((folder / "layout.json").read_text())
    found = {}
    for name, way in (("ashlar", by_ashlar), ("multiview-stitcher", by_multiview_stitcher)):
        try:
            found[name] = {k: m.tolist() for k, m in way(folder, layout).items()}
        except Exception as error:
            print(name, "failed:", error, file=sys.stderr)
    print(json.dumps(found))


if __name__ == "__main__":
    main()
