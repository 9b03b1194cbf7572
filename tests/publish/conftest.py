"""Small databases, written without a build."""

import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from levkas.core.cube import Band, Cube, Flag
from levkas.database.catalogue import write_catalogue
from levkas.database.credits import Credits
from levkas.database.layers import Layer, write_layer
from levkas.database.manifest import write_manifest
from levkas.database.store import write_index

FACTS = """title = "Icons of Levkas"
creator = "Painter, Ada"
date = "2019-06-30"
licence = "CC-BY-4.0"
setup = "proposed"

[reference]
camera = "vis"
band = "550 nm"

[cameras.vis]
kind = "bands"

[cameras.rgb]
kind = "mosaic"

[setups.proposed]
title = "Two lamps"
cameras = ["rgb", "vis"]
"""
SIZES = {"icon1": (120, 90), "icon2": (48, 64)}
"""(width, height)."""


def make_cube(rng: np.random.Generator, size: tuple[int, int], labels: list[str]) -> Cube:
    """Draw a smooth cube with flags and sigma."""
    width, height = size
    y, x = np.mgrid[0:height, 0:width] / 20
    waves = [np.sin(x * (1 + i / 5) + rng.random()) * np.cos(y) for i in range(len(labels))]
    values = (0.5 + 0.3 * np.stack(waves, -1)).astype(np.float32)
    flags = np.zeros(values.shape, np.uint8)
    flags[:4, :4] = Flag.OUTSIDE
    flags[20:24, 10:13, 0] = Flag.SATURATED
    values[:4, :4] = np.nan
    sigma = np.full(values.shape, 0.01, np.float32)
    bands = tuple(
        Band(label, float(label.split()[0]), 10.0) if " nm" in label else Band(label)
        for label in labels
    )
    return Cube(values, flags, sigma, bands)


@pytest.fixture(scope="session")
def _database(tmp_path_factory: pytest.TempPathFactory) -> Path:
    root = tmp_path_factory.mktemp("published") / "database"
    rng, entries = np.random.default_rng(7), []
    cameras = {"vis": [f"{w} nm" for w in range(420, 721, 30)], "rgb": ["R", "G", "B"]}
    for name, size in SIZES.items():
        for camera, labels in cameras.items():
            credits = Credits(
                title=f"Icon {name}", creator="Ada", date="2019-06-30", rights="CC-BY-4.0"
            )
            layer = Layer(name, camera, px_per_mm=2.0, credits=credits)
            entries.append(write_layer(root, layer, make_cube(rng, size, labels))[0])
        (root / f"objects/{name}/object.toml").write_text(
            f'name = "{name}"\ntitle = "The {name}"\n'
        )
        write_index(root / f"zarr/{name}.zarr")
    write_catalogue(root, entries)
    (root / "database.toml").write_text(FACTS)
    write_manifest(root)
    return root


@pytest.fixture
def database(_database: Path, tmp_path: Path) -> Path:
    """Return a database of two objects by two cameras, that may be changed."""
    return Path(shutil.copytree(_database, tmp_path / "database"))


@pytest.fixture(scope="session")
def publish() -> Callable[..., Path]:
    """Return a function that publishes and gives the folder."""
    from levkas.publish import run

    def make(database: Path, **options: object) -> Path:
        return run.summarise(run.publish(database, **options)).output

    return make
