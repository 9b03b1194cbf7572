"""Pigments, the icon and its light: what a spectroscopist and a photographer would expect."""

import numpy as np
import pytest

from levkas.simulation.cameras import camera_models
from levkas.simulation.capture import view_painting
from levkas.simulation.charts import chart_panel, paint_chart, patch_centres, patch_spectra
from levkas.simulation.icon import paint_icon
from levkas.simulation.lighting import SETUPS, compose, light
from levkas.simulation.optics import base_to_band, panel_to_base
from levkas.simulation.painting import Painting, Panel
from levkas.simulation.pigments import PIGMENTS, WAVELENGTHS

PANEL = Panel(radius_mm=3000.0, depth_mm=3.0, border_mm=34.0, bevel_mm=6.0)


def reflectance(pigment, wavelength):
    return float(PIGMENTS[pigment].reflectance(np.array([wavelength]))[0])


@pytest.fixture(scope="module")
def icon():
    return paint_icon(PANEL, 2.0, np.random.default_rng(4))


def test_colours_of_pigments_are_their_own_and_blues_part_in_the_near_infrared():
    assert reflectance("vermilion", 660) > 10 * reflectance("vermilion", 560)
    assert reflectance("azurite", 460) > 3 * reflectance("azurite", 640)
    assert reflectance("malachite", 530) > 3 * reflectance("malachite", 700)
    assert reflectance("lead-tin yellow", 600) > 3 * reflectance("lead-tin yellow", 430)

    assert reflectance("azurite", 850) < 0.2
    for clear in ("smalt", "indigo", "ultramarine", "madder"):
        assert reflectance(clear, 850) > 0.6, clear


def test_every_sample_of_the_icon_is_wholly_covered(icon):
    assert np.all(icon.amounts.sum(2, dtype=int) == 255)
    used = icon.amounts.reshape(-1, len(icon.names)).max(0) > 100
    assert used.sum() >= 16


def test_the_underdrawing_shows_in_the_near_infrared_alone(icon):
    view = camera_models()["lctf-nir"].view()
    lit = light(icon, PANEL, view, SETUPS["proposed"])
    bare = Painting(**{**vars(icon), "underdrawing": np.zeros_like(icon.underdrawing)})
    drawn = icon.underdrawing > 150
    for wavelength, least, most in ((550, 0.0, 0.01), (950, 0.3, 0.9)):
        response = (wavelength == WAVELENGTHS).astype(float)
        with_it, without = (
            compose(p, lit, response, WAVELENGTHS).values[drawn].mean() for p in (icon, bare)
        )
        assert least <= 1 - with_it / without <= most, wavelength


@pytest.mark.slow
def test_a_chart_before_a_camera_shows_its_patches():
    camera = camera_models()["lctf-vis"].scaled(0.2)
    view, panel, chart = camera.view(), chart_panel(), paint_chart(2.0)
    band, sensor = camera.bands[15], camera.sensors[0]
    image = view_painting(camera, view, panel, chart).reflectance(band, sensor, supersampling=2)
    chromatic = camera.chromatic.at(band.centre)
    where = (
        base_to_band(panel_to_base(patch_centres(), view, panel), view, chromatic, np.eye(2, 3))
        .round()
        .astype(int)
    )
    np.testing.assert_allclose(
        image[where[:, 1], where[:, 0]], patch_spectra() @ band.response, rtol=0.005
    )
