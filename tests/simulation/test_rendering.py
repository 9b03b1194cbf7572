"""Images against the map: discs lie where the map says, in every kind of band."""

import numpy as np
import pytest

from levkas.simulation.optics import (
    ChromaticOptics,
    Viewpoint,
    band_to_base,
    base_to_band,
    panel_to_base,
    turn,
)
from levkas.simulation.painting import Panel
from levkas.simulation.rendering import Texture, render, tabulate

# A disc over a bend of the relief has no single place: only the smooth parts are measured.
PANEL = Panel(
    width_mm=120.0, height_mm=90.0, radius_mm=1500.0, border_mm=10.0, depth_mm=3.0, bevel_mm=6.0
)
PX_PER_MM = 6.0  # 2.2 samples a pixel, as `campaigns` gives a camera
DISC_MM = 1.3


@pytest.fixture(scope="module")
def discs():
    """A white texture's darkness with discs, and where they are."""
    rng = np.random.default_rng(2)
    centres = np.stack(np.meshgrid(np.arange(-39, 40, 7.8), np.arange(-24, 25, 8.0)), -1).reshape(
        -1, 2
    )
    centres = centres + rng.uniform(-0.7, 0.7, centres.shape)
    s = (np.arange(720) + 0.5) / PX_PER_MM - 60
    t = (np.arange(540) + 0.5) / PX_PER_MM - 45
    texture = np.full((540, 720), 0.1, np.float32)
    for x, y in centres:
        far = np.hypot(s[None, :] - x, t[:, None] - y)
        texture += 0.8 * np.clip((DISC_MM - far) * PX_PER_MM + 0.5, 0, 1).astype(np.float32)
    return Texture(texture, PX_PER_MM), centres


def camera(motion=None):
    return Viewpoint(
        360, 270, tuple(turn(0.6, -0.9, 0.7).ravel()), (1.0, -0.5, 1850.0), 2.7 * 1850.0,
        (181.0, 133.0), 180.0, (-0.02, 0.004), (4e-4, -3e-4), motion, 1 / 2.7, (0.1, 40.0, 0.4),
    )  # fmt: skip


def centroids(image, expected, half=8):
    found = []
    for x, y in expected:
        j, i = round(x), round(y)
        part = image[i - half : i + half + 1, j - half : j + half + 1] - 0.1
        rows, columns = np.mgrid[i - half : i + half + 1, j - half : j + half + 1]
        found.append([(part * columns).sum(), (part * rows).sum()] / part.sum())
    return np.array(found)


@pytest.mark.parametrize("motion", [None, (0.01, 1.0, 0.0)], ids=["frame", "scanner"])
@pytest.mark.parametrize(("wavelength", "supersampling"), [(400.0, 3), (950.0, 2)])
def test_discs_lie_where_the_map_says(discs, motion, wavelength, supersampling):
    texture, centres = discs
    view = camera(motion)
    colour = ChromaticOptics((3e-3, 1e-3), (0.4,), (-0.3,), (0.4,)).at(wavelength)
    affine = np.array([[1.0, -0.003, 4.3], [0.003, 1.0, -2.6]])
    image = render(
        texture, tabulate(view, PANEL), *band_to_base(view, colour, affine),
        surroundings=0.1, supersampling=supersampling,
    )  # fmt: skip
    expected = base_to_band(panel_to_base(centres, view, PANEL), view, colour, affine)
    miss = centroids(image, expected) - expected
    assert np.abs(miss.mean(0)).max() < 0.003
    # Quadrature over discs with sharp edges: their own size in pixels is not a whole number.
    assert np.hypot(*miss.T).max() < 0.02


def test_the_edge_of_the_board_is_an_area_average():
    flat, plain = (
        Panel(width_mm=20.0, height_mm=20.0),
        Viewpoint(40, 40, tuple(np.eye(3).ravel()), (0.125, 0, 1000.0), 1000.0, (20.0, 20.0), 20.0),
    )
    image = render(Texture(np.ones((200, 200), np.float32), 10.0), tabulate(plain, flat), np.eye(2, 3),
                   blur=0.0, supersampling=8)  # fmt: skip
    # The board ends at x = 30.125: 62.5 % of pixel 30, which spans 29.5 to 30.5, is covered.
    assert image[20, 30] == pytest.approx(0.625, abs=1e-3)
    assert image[20, 29] == 1.0
    assert image[20, 31] == 0.0
