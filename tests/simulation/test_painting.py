"""Pigments, the icon and its light: what a spectroscopist and a photographer would expect."""

import numpy as np
import pytest

from levkas.simulation.cameras import camera_models
from levkas.simulation.capture import view_painting
from levkas.simulation.icon import paint_icon
from levkas.simulation.lighting import SETUPS, compose, light
from levkas.simulation.optics import base_to_band, panel_to_base
from levkas.simulation.painting import Painting, Panel
from levkas.simulation.photographs import (
    PhotographRefused,
    chart_panel,
    paint_chart,
    paint_photograph,
    patch_centres,
    patch_spectra,
)
from levkas.simulation.pigments import (
    LIBRARY_NUMBERS,
    PAINTS,
    PIGMENTS,
    WAVELENGTHS,
    LibraryRefused,
    paint_spectra,
    read_library,
)

PANEL = Panel(radius_mm=3000.0, depth_mm=3.0, border_mm=34.0, bevel_mm=6.0)


def reflectance(pigment, wavelength):
    return float(PIGMENTS[pigment].reflectance(np.array([wavelength]))[0])


@pytest.fixture(scope="module")
def icon():
    return paint_icon(PANEL, 2.0, np.random.default_rng(4))


def test_there_are_more_than_a_dozen_pigments_and_their_colours_are_their_own():
    assert len(PIGMENTS) >= 12
    assert reflectance("vermilion", 660) > 10 * reflectance("vermilion", 560)
    assert reflectance("azurite", 460) > 3 * reflectance("azurite", 640)
    assert reflectance("malachite", 530) > 3 * reflectance("malachite", 700)
    assert reflectance("lead-tin yellow", 600) > 3 * reflectance("lead-tin yellow", 430)


def test_blues_part_in_the_near_infrared():
    assert reflectance("azurite", 850) < 0.2
    for clear in ("smalt", "indigo", "ultramarine", "madder"):
        assert reflectance(clear, 850) > 0.6, clear


def test_paints_reflect_between_nothing_and_all():
    spectra = paint_spectra(tuple(PAINTS), WAVELENGTHS)
    assert spectra.shape == (len(PAINTS), len(WAVELENGTHS))
    assert 0 < spectra.min() < 0.05 < 0.9 < spectra.max() <= 1


def test_measured_spectra_take_the_place_of_ours(real_data):
    library = real_data / "spectra" / "pigments" / "__speclib_averages.hdr"
    names, grid, values = read_library(library)
    assert values.shape == (1592, 186)
    assert grid[0] == pytest.approx(405.37, abs=0.01)
    assert set(LIBRARY_NUMBERS["azurite"]) <= set(names)
    ours = paint_spectra(("azurite", "gesso"), WAVELENGTHS)
    measured = paint_spectra(("azurite", "gesso"), WAVELENGTHS, library=library)
    assert np.abs(measured[0] - ours[0]).max() > 0.05
    np.testing.assert_array_equal(measured[1], ours[1])


def test_a_library_that_is_cut_short_is_refused(tmp_path):
    (tmp_path / "a.hdr").write_text("ENVI\nspectra names = {x, y}\nwavelength = {400, 500}\n")
    np.zeros(3, "<f4").tofile(tmp_path / "a.sli")
    with pytest.raises(LibraryRefused, match="3 values; expected: 2 spectra of 2 bands"):
        read_library(tmp_path / "a.hdr")


def test_every_sample_of_the_icon_is_wholly_covered(icon):
    assert np.all(icon.amounts.sum(2, dtype=int) == 255)
    used = icon.amounts.reshape(-1, len(icon.names)).max(0) > 100
    assert used.sum() >= 16


@pytest.mark.slow
def test_the_icon_is_the_same_at_any_fineness(icon):
    fine = paint_icon(PANEL, 4.0, np.random.default_rng(4)).reduced(2)
    shape = tuple(
        min(a, b) for a, b in zip(fine.underdrawing.shape, icon.underdrawing.shape, strict=True)
    )
    a, b = ((p.amounts[: shape[0], : shape[1]] @ p.spectra[:, 100]).ravel() for p in (icon, fine))
    assert np.corrcoef(a, b)[0, 1] > 0.9


def test_another_seed_paints_another_icon(icon):
    other = paint_icon(PANEL, 2.0, np.random.default_rng(5))
    assert (other.amounts != icon.amounts).any(2).mean() > 0.3


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


def plain(gloss=0.0, metal=False):
    return Painting(
        np.full((60, 80, 1), 255, np.uint8), np.full((1, len(WAVELENGTHS)), 0.5),
        np.array([metal]), np.zeros((60, 80), np.uint8), np.zeros((60, 80), np.float32), 0.2, gloss,
    )  # fmt: skip


@pytest.mark.parametrize("setup", SETUPS)
def test_a_flat_matte_board_shows_its_reflectance_under_any_lamps(setup):
    view = camera_models()["lctf-vis"].view()
    lit = light(plain(), Panel(), view, SETUPS[setup])
    response = np.full(len(WAVELENGTHS), 1 / len(WAVELENGTHS))
    np.testing.assert_allclose(compose(plain(), lit, response, WAVELENGTHS).values, 0.5, atol=1e-4)


def test_lamps_at_70_degrees_darken_varnish_by_an_eighth_and_tame_gold():
    view = camera_models()["lctf-vis"].view()
    low, high = (
        light(plain(gloss=1.0), Panel(), view, SETUPS[s]) for s in ("proposed", "45-degree")
    )
    assert low.shade.mean() / high.shade.mean() == pytest.approx(0.829 / 0.950, abs=0.002)
    assert high.gold.mean() > 1.3 * low.gold.mean()
    assert high.varnish.max() > 3 * low.varnish.max()


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


def test_a_photograph_keeps_its_look_in_paints(tmp_path):
    from PIL import Image

    picture = np.zeros((80, 60, 3), np.uint8)
    picture[:40], picture[40:] = (230, 225, 215), (150, 40, 30)
    Image.fromarray(picture).save(tmp_path / "a.png")
    painting = paint_photograph(PANEL, 1.0, np.random.default_rng(0), photograph=tmp_path / "a.png")
    blue, red = (painting.amounts @ painting.spectra[:, k] / 255 for k in (40, 140))
    top, low = (slice(40, 280), slice(40, 180)), (slice(40, 280), slice(240, 380))
    assert blue[top].mean() > 0.5 > 0.2 > blue[low].mean()
    assert red[low].mean() > 2 * blue[low].mean()
    with pytest.raises(PhotographRefused, match="cannot be read"):
        paint_photograph(PANEL, 1.0, np.random.default_rng(0), photograph=tmp_path / "none.png")
