"""Small databases of paintings whose spectra are smooth mixtures, seen by an RGB and a spectral camera."""

import importlib
import shutil
from pathlib import Path

import numpy as np
import pytest

from levkas.core.cube import Band, Cube, Flag
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.manifest import write_manifest

WAVES = np.arange(410.0, 711.0, 20.0)
SIGMA = 0.004
SIZE = (40, 48)
NAMES = ("icon1", "icon2", "icon3")


def planted_sensitivities():
    """(3, bands): red, green, blue, each with sum 1."""
    found = np.exp(-0.5 * ((WAVES - np.array([[610.0], [540.0], [460.0]])) / 35) ** 2)
    return found / found.sum(1, keepdims=True)


def paint(seed):
    """Spectra of a painting, (rows, columns, bands): patches of sigmoids and bands, of its own pigments."""
    rng = np.random.default_rng(seed)
    edges = 0.05 + 0.8 / (
        1 + np.exp(-(WAVES - rng.uniform(450, 650, (8, 1))) / rng.uniform(8, 30, (8, 1)))
    )
    hills = 0.1 + 0.5 * np.exp(-0.5 * ((WAVES - rng.uniform(430, 560, (8, 1))) / 40) ** 2)
    pigments = np.concatenate([edges, hills])
    patches = rng.integers(0, len(pigments), (SIZE[0] // 4, SIZE[1] // 4))
    shade = rng.uniform(0.4, 1.0, (*patches.shape, 1))
    return np.kron(pigments[patches] * shade, np.ones((4, 4, 1)))


def cube_of(spectra, bands, rng, sigma=SIGMA):
    values = spectra + rng.normal(0, sigma, spectra.shape)
    flags = np.zeros(values.shape, np.uint8)
    flags[:2, :3], values[:2, :3] = Flag.OUTSIDE, np.nan
    flags[10, 12, 0] = Flag.SATURATED
    return Cube(values.astype(np.float32), flags, np.full(values.shape, sigma, np.float32), bands)


def write_paintings(root):
    narrow = tuple(Band(f"{w:g} nm", w, 20.0) for w in WAVES)
    broad = tuple(Band(label) for label in "RGB")
    entries = []
    for seed, name in enumerate(NAMES):
        rng, spectra = np.random.default_rng(100 + seed), paint(seed)
        rgb = spectra @ planted_sensitivities().T
        layers = [
            ("vis", "", spectra, narrow),
            ("rgb", "", rgb, broad),
            ("cam2", "", rgb * 1.05, broad),
            ("rgb", "soft", rgb * [1.1, 1.0, 0.9], broad),
            ("raw", "", rgb * 4000, broad),
        ]
        for camera, setup, values, bands in layers:
            cube = cube_of(values, bands, rng)
            if camera == "raw":
                cube = Cube(cube.values, cube.flags, cube.sigma, bands, "counts")
            entries.append(write_layer(root, Layer(name, camera, setup, px_per_mm=2.0), cube)[0])
    write_catalogue(root, entries)
    write_manifest(root)
    return root


@pytest.fixture(scope="session")
def paintings(tmp_path_factory) -> Path:
    """Three paintings by rgb, cam2 (under another scale), rgb@soft, raw (in counts) and the spectral vis."""
    return write_paintings(tmp_path_factory.mktemp("estimating") / "database")


@pytest.fixture
def own_paintings(paintings, tmp_path) -> Path:
    """A copy of the paintings that a test may change."""
    return Path(shutil.copytree(paintings, tmp_path / "database"))


@pytest.fixture(scope="module")
def few_kernels():
    """Let kernels stand on a fifth of the samples that they may take: small paintings need no more."""
    methods = (f"levkas.estimation.methods.{name}" for name in ("kernel_ridge", "gaussian_process"))
    kernel_ridge, gaussian_process = map(importlib.import_module, methods)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(kernel_ridge, "MOST_ANCHORS", 300)
        patch.setattr(kernel_ridge, "TRIAL_ANCHORS", 150)
        patch.setattr(gaussian_process, "MOST_ANCHORS", 150)
        patch.setattr(gaussian_process, "MOST_SAMPLES", 300)
        yield
