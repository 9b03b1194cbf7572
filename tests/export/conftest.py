"""A small database of two objects, one layer with broad channels, one under another setup."""

from pathlib import Path

import numpy as np
import pytest

from levkas.core.cube import Band, Cube, Flag
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer

WAVES = (420.0, 500.5, 610.0, 700.0)


@pytest.fixture(scope="session")
def database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a database of random numbers with NaN, flags and sigma."""
    root = tmp_path_factory.mktemp("exporting") / "database"
    rng, entries = np.random.default_rng(5), []
    narrow = tuple(Band(f"{w:g} nm", w, 10.0) for w in WAVES)
    broad = tuple(Band(label) for label in "RGB")
    layers = [
        ("icon1", "vis", ""),
        ("icon1", "rgb", ""),
        ("icon1", "rgb", "soft"),
        ("icon2", "vis", ""),
    ]
    for name, camera, setup in layers:
        bands = narrow if camera == "vis" else broad
        values = rng.random((21, 34, len(bands)), np.float32)
        values[:2, :3] = np.nan
        flags = rng.choice(np.array([0, 2, 64, 128], np.uint8), values.shape)
        flags[:2, :3] = Flag.OUTSIDE
        cube = Cube(values, flags, (values / 100).astype(np.float32), bands)
        entries.append(write_layer(root, Layer(name, camera, setup, px_per_mm=4.0), cube)[0])
    write_catalogue(root, entries)
    return root
