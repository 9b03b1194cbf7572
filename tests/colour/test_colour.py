import io

import colour as science
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.colour.observer import tables
from levkas.colour.srgb import (
    SRGB_TO_XYZ,
    camera_matrix,
    encode_srgb,
    find_rendering,
    observer_under,
    srgb_profile,
    xyz_weights,
)
from levkas.core.cube import Band

OBSERVER = science.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
D65 = science.SDS_ILLUMINANTS["D65"]
CHECKER = science.SDS_COLOURCHECKERS["ISO 17321-1"]
GRID = np.arange(380.0, 781.0)


def spectra(step=1.0, low=380.0, high=780.0):
    """ColorChecker reflectances, (patches, bands), and their wavelengths."""
    nm = np.arange(low, high + 1e-9, step)
    rows = [np.interp(nm, sd.wavelengths, sd.values) for sd in CHECKER.values()]
    return np.array(rows), nm


def reference_xyz(rows, nm):
    shape = science.SpectralShape(380, 780, 1)
    observer, light = OBSERVER.copy().align(shape), D65.copy().align(shape)
    spectral = [science.SpectralDistribution(row, nm).align(shape) for row in rows]
    options = {"cmfs": observer, "illuminant": light, "method": "Integration"}
    return np.array([science.sd_to_XYZ(sd, **options) for sd in spectral]) / 100


def delta_e(one, other):
    lab = [
        science.XYZ_to_Lab(
            xyz, science.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
        )
        for xyz in (one, other)
    ]
    return science.delta_E(*lab, method="CIE 2000")


def bands(*wavelengths):
    return [Band(f"{w:g} nm", w) for w in wavelengths]


def test_the_tables_are_those_of_colour_science():
    rows = tables()
    places = (rows[:, 0] - 360).astype(int)
    np.testing.assert_allclose(rows[:, 1:4], OBSERVER.values[places], rtol=1e-8)
    np.testing.assert_array_equal(rows[:, 4], D65[rows[:, 0]])


@pytest.mark.parametrize(
    ("step", "low", "high", "limit"), [(1, 380, 780, 0.05), (10, 400, 720, 0.35)]
)
def test_xyz_of_colour_checker_is_that_of_colour_science(step, low, high, limit):
    full, nm = spectra()
    expected = reference_xyz(full, nm)
    rows, wavelengths = spectra(step, low, high)
    difference = delta_e(rows @ xyz_weights(wavelengths), expected)
    # By 10 nm the straight lines between bands cost up to a third of a just visible difference.
    assert difference.max() < limit


def test_srgb_of_colour_checker_is_that_of_colour_science():
    rows, nm = spectra()
    shown = find_rendering(bands(*nm))(rows[:, None, :])[:, 0].astype(int)
    expected = np.clip(science.XYZ_to_sRGB(reference_xyz(rows, nm)), 0, 1) * 255
    assert np.abs(shown - expected).max() <= 1.5


@settings(max_examples=15, deadline=None)
@given(st.lists(st.floats(350, 1100), min_size=3, max_size=40, unique=True), st.randoms())
def test_white_is_white_and_the_order_of_bands_does_not_matter(wavelengths, random):
    np.testing.assert_allclose(xyz_weights(wavelengths).sum(0), SRGB_TO_XYZ.sum(1), rtol=1e-9)
    shuffled = random.sample(wavelengths, len(wavelengths))
    places = [wavelengths.index(w) for w in shuffled]
    np.testing.assert_allclose(xyz_weights(shuffled), xyz_weights(wavelengths)[places], atol=1e-12)


@pytest.mark.parametrize(
    ("wavelengths", "colour"),
    [
        (range(400, 721, 10), True),
        (range(420, 681, 10), True),
        (range(400, 701, 50), True),
        (range(650, 1101, 10), False),
        ((475, 560, 668, 717, 840), False),
        ((1000,), False),
    ],
)
def test_what_is_not_seen_is_not_called_colour(wavelengths, colour):
    assert find_rendering(bands(*wavelengths)).colour is colour


def test_letters_of_channels_make_the_colours_of_figure_13():
    names = ["R1", "G1", "B1", "R2", "G2", "B2", "IR"]
    values = np.zeros((1, 1, 7), np.float32)
    values[..., [0, 3]] = 0.5, 1.0
    rendering = find_rendering([Band(name) for name in names])
    assert rendering(values)[0, 0].tolist() == [encode_srgb(np.array(0.75)), 0, 0]
    assert not rendering.colour


def test_a_camera_that_sees_as_we_do_is_colorimetric():
    nm, target = observer_under()
    light = np.interp(nm, D65.wavelengths, D65.values)
    mixed = (target / light[:, None]) @ np.array([[1, 0.2, 0], [0.1, 1, 0.1], [0, 0.1, 1]])
    matrix, missed = camera_matrix(nm, mixed)
    rows, wavelengths = spectra()
    observed = mixed * light[:, None]
    channels = rows @ (observed / observed.sum(0))
    assert missed < 1e-6
    assert delta_e(channels @ matrix, reference_xyz(rows, wavelengths)).max() < 0.05


def test_a_camera_with_bell_curves_is_near_in_colour_and_exact_in_white():
    table = np.exp(-0.5 * ((GRID[:, None] - [600, 540, 460]) / [35, 40, 30]) ** 2)
    matrix, missed = camera_matrix(GRID, table)
    np.testing.assert_allclose(matrix.sum(0), SRGB_TO_XYZ.sum(1), rtol=1e-9)
    rows, nm = spectra()
    observed = table * np.interp(GRID, D65.wavelengths, D65.values)[:, None]
    error = delta_e(rows @ (observed / observed.sum(0)) @ matrix, reference_xyz(rows, nm))
    assert missed < 0.25
    assert np.median(error) < 2.0
    assert find_rendering([Band(c) for c in "RGB"], sensitivity=(GRID, table)).colour


def test_the_profile_is_srgb_for_little_cms():
    from PIL import Image, ImageCms

    ours = ImageCms.ImageCmsProfile(io.BytesIO(srgb_profile()))
    rgb = np.random.default_rng(0).integers(0, 256, (64, 64, 3), dtype=np.uint8)
    shown = ImageCms.profileToProfile(Image.fromarray(rgb), ours, ImageCms.createProfile("sRGB"))
    assert np.abs(np.asarray(shown).astype(int) - rgb).max() <= 1
    assert ImageCms.getProfileDescription(ours).strip() == "sRGB"
