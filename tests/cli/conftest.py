"""A small database, as a build leaves it, for every command that reads one."""

import numpy as np
import pytest

from levkas.core.cube import Band, Cube
from levkas.core.files import write_json
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.manifest import write_manifest
from levkas.database.store import write_index
from levkas.geometry.transforms import Affine


def record_of(camera, bands):
    entry = {"transform": Affine.identity().to_dict(), "size": [50, 40]}
    return {
        **{"object": "icon1", "camera": camera, "setup": "", "method": "affine"},
        "reference": {"camera": "vis", "band": "550 nm", "size": [50, 40]},
        "target": {"camera": camera, "setup": "", "band": bands[1]},
        "grid": {"transform": Affine.identity().to_dict(), "size": [50, 40], "px_per_mm": 2.5},
        "verdict": {"decision": "accept", "reasons": [], "next_step": ""},
        "errors": {},
        "bands": {band: entry for band in bands},
    }


@pytest.fixture(scope="session")
def made_database(tmp_path_factory):
    """A database of one object by two cameras, with a table of points beside it; not to be changed."""
    root, rng = tmp_path_factory.mktemp("sound") / "db", np.random.default_rng(0)
    cameras = {"vis": [Band(f"{n} nm", float(n), 7.0) for n in (450, 550, 650)],
               "d80": [Band(c) for c in "RGB"]}  # fmt: skip
    entries = []
    for camera, bands in cameras.items():
        values = rng.normal(0.5, 0.2, (40, 50, 3)).astype(np.float32)
        cube = Cube(values, np.zeros(values.shape, np.uint8), 0.01 * np.abs(values), tuple(bands))
        entries.append(write_layer(root, Layer("icon1", camera, px_per_mm=2.5), cube)[0])
        write_json(
            root / f"objects/icon1/registration/{camera}.json",
            record_of(camera, [band.label for band in bands]),
        )
    write_index(root / "zarr/icon1.zarr")
    write_catalogue(root, entries)
    write_manifest(root)
    points = root.parent / "points.csv"
    points.write_text("x,y\n1,2\n")
    return root
