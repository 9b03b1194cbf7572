"""Channels of a mosaic lie where they were recorded: neither the place of a sensel in its period nor other channels' detail moves them."""

from dataclasses import dataclass

import numpy as np
import pytest
from scipy import ndimage

from levkas.calibration.mosaic import demosaic
from levkas.core.cube import Band, Cube
from levkas.geometry.transforms import Affine
from levkas.registration import BandImage, register
from levkas.registration.bands import Sites
from levkas.stages.parts import CalibratedCapture, Part
from levkas.stages.shared_noise import Mosaic

REFERENCE, FINE = 200, 6.0  # px; samples of the scene a px of the reference
REFERENCE_MIXES = ((1, 0.4, 0.2), (1, 0.1, 0.2), (1, -0.1, -0.1), (1, -0.3, -0.3))
MIXES = {"R": (1, 0.35, 0.1), "G": (1, -0.1, 0.2), "B": (1, -0.3, -0.2)}


@pytest.fixture(scope="module")
def pigments():
    """Return three periodic scenes, (3, n, n), of detail down to the finest that a sensel resolves."""
    side = int(REFERENCE * FINE)
    rng, frequency = np.random.default_rng(5), np.fft.fftfreq(side)
    radius = np.hypot(frequency[:, None], frequency)
    radius[0, 0] = 1
    fall = radius**-1.2 * np.exp(-np.square(radius * FINE / 1.6))
    scenes = np.fft.ifft2(np.fft.fft2(rng.normal(size=(3, side, side))) * fall).real
    return scenes / scenes.std((1, 2), keepdims=True)


def exposed(pigments, mix, to_reference, shape, pixel, *, seed):
    """Return what square px of `pixel` reference px see whose centres lie at `to_reference`."""
    scene = 0.3 + 0.06 * np.tensordot(mix, pigments, 1)
    scene = np.fft.ifft2(ndimage.fourier_uniform(np.fft.fft2(scene), pixel * FINE)).real
    x, y = np.meshgrid(np.arange(shape[1], dtype=float), np.arange(shape[0], dtype=float))
    places = (to_reference(np.stack([x.ravel(), y.ravel()], 1)) + 0.5) * FINE - 0.5
    values = ndimage.map_coordinates(scene, places.T[::-1], order=3, mode="grid-wrap")
    values += np.random.default_rng(seed).normal(0, 0.004, len(values))
    return values.reshape(shape).astype(np.float32)


@pytest.fixture(scope="module")
def reference(pigments):
    size = (REFERENCE, REFERENCE)
    bands = [
        exposed(pigments, mix, Affine.identity(), size, 1.0, seed=k)
        for k, mix in enumerate(REFERENCE_MIXES)
    ]
    return [
        BandImage.of(f"{nm} nm", band, nm)
        for nm, band in zip((450, 530, 610, 690), bands, strict=True)
    ]


@dataclass(frozen=True)
class ColourCamera:
    """Channels at `maps`, reference px → native px; `full`, (h, w, 3): what sensels would record that all saw every channel."""

    maps: dict
    full: np.ndarray

    @classmethod
    def at(cls, pigments, side, *, apart=0.0):
        """Return one of `side` px, turned by 10 mrad, with R and B `apart` px to either side of G."""
        scale, turn = side / REFERENCE, 0.01 * side / REFERENCE
        shifts = {"R": apart, "G": 0.0, "B": -apart}
        maps = {
            c: Affine(np.array([[scale, -turn, 3 + s], [turn, scale, 4.0]]))
            for c, s in shifts.items()
        }
        channels = [
            exposed(pigments, MIXES[c], maps[c].inverse, (side, side), 1 / scale, seed=9 + k)
            for k, c in enumerate("RGB")
        ]
        return cls(maps, np.stack(channels, -1))

    def developed(self, pattern, method):
        """Return the calibrated capture behind a mosaic."""
        rows = [list(pattern[:2]), list(pattern[2:])]
        side, table = len(self.full), np.array([["RGB".index(c) for c in row] for row in rows])
        which = np.tile(table, (side // 2, side // 2))
        mosaic = np.take_along_axis(self.full, which[..., None], 2)[..., 0]
        flags, channels = np.zeros(mosaic.shape, np.uint8), ["R", "G", "B"]
        values, noted, _ = demosaic(mosaic, flags, None, rows, method=method, channels=channels)
        bands = tuple(Band(c, float("nan")) for c in channels)
        cube = Cube(values, noted, None, bands, "reflectance")
        return CalibratedCapture([Part.held(cube, mosaic=Mosaic(rows, method, channels))])

    def errors(self, reference, images):
        """Return the median error of each channel, (3, 2) reference px."""
        found = register(reference, images, reference_band="530 nm")
        x, y = np.meshgrid(np.linspace(20, REFERENCE - 20, 9), np.linspace(20, REFERENCE - 20, 9))
        points = np.stack([x.ravel(), y.ravel()], 1)
        misses = [found.transforms[c](points) - self.maps[c](points) for c in "RGB"]
        return np.median(misses, axis=1) * REFERENCE / len(self.full)

    def bias_of(self, reference, pattern, method):
        """Return by how much each channel lies otherwise than without a mosaic, (3, 2) reference px."""
        plain = [BandImage.of(c, self.full[..., k]) for k, c in enumerate("RGB")]
        mosaiced = self.errors(reference, self.developed(pattern, method).images())
        return mosaiced - self.errors(reference, plain)


@pytest.fixture(scope="module")
def fine_camera(pigments):
    return ColourCamera.at(pigments, 520)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("pattern", "method"),
    [pytest.param("RGGB", "malvar", marks=pytest.mark.slow), ("GBRG", "bilinear")],
)
def test_no_channel_lies_towards_its_sensel_of_the_period(fine_camera, reference, pattern, method):
    assert np.abs(fine_camera.bias_of(reference, pattern, method)).max() < 0.004


@pytest.mark.slow
def test_a_channel_is_not_drawn_to_where_green_has_its_detail(pigments, reference):
    camera = ColourCamera.at(pigments, 240, apart=0.3)
    assert np.abs(camera.bias_of(reference, "RGGB", "malvar")).max() < 0.02


def test_between_its_sites_a_channel_is_what_they_measured():
    y, x = np.mgrid[:8, :8].astype("f4")
    plane = 2 * x + y
    sites = Sites(2, ((0, 0),))
    spoilt = np.where((y % 2 + x % 2) > 0, np.float32(99), plane)
    assert np.allclose(sites.filled(spoilt)[:7, :7], plane[:7, :7], atol=1e-5)
