"""Errors of spectra against colour-science, scikit-learn and values worked by hand."""

import colour
import numpy as np
import pytest

from levkas.estimation import metrics
from levkas.estimation.samples import PaintSamples
from levkas.estimation.scores import metamer_floor

BANDS = np.arange(400.0, 721.0, 10.0)


@pytest.fixture
def pair():
    rng = np.random.default_rng(2)
    measured = rng.uniform(0.05, 0.9, (40, len(BANDS)))
    return measured + rng.normal(0, 0.02, measured.shape), measured


def test_equal_spectra_have_no_error(pair):
    same = pair[1]
    assert metrics.rmse(same, same).max() == 0
    assert metrics.mrae(same, same).max() == 0
    np.testing.assert_allclose(metrics.gfc(same, same), 1)
    assert metrics.spectral_angle(same, same).max() < 1e-7
    assert metrics.delta_e(same, same, BANDS).max() == 0
    np.testing.assert_allclose(metrics.r2(same, same), 1)


def test_goodness_of_fit_and_angle_do_not_see_the_exposure(pair):
    estimated, measured = pair
    np.testing.assert_allclose(metrics.gfc(2 * estimated, measured), metrics.gfc(*pair))
    np.testing.assert_allclose(
        metrics.spectral_angle(0.5 * estimated, measured), metrics.spectral_angle(*pair)
    )


def test_a_spectrum_of_zeros_has_no_angle(pair):
    assert np.isnan(metrics.gfc(np.zeros(3), np.ones(3)))
    assert np.isnan(metrics.spectral_angle(np.zeros(3), np.ones(3)))


def test_r2_is_that_of_scikit_learn(pair):
    score = pytest.importorskip("sklearn.metrics").r2_score
    expected = score(pair[1], pair[0], multioutput="raw_values")
    np.testing.assert_allclose(metrics.r2(*pair), expected, rtol=1e-12)


def test_r2_of_a_constant_band_is_unknown():
    assert np.isnan(metrics.r2(np.array([[0.1], [0.2]]), np.array([[0.3], [0.3]]))[0])


def test_relative_errors_have_a_floor():
    assert metrics.mrae(np.array([0.01]), np.array([0.0])) == pytest.approx(1.0)


@pytest.mark.filterwarnings("ignore::colour.utilities.ColourRuntimeWarning")
@pytest.mark.parametrize("light", ["D65", "A"])
def test_colour_differences_are_those_of_colour_science(light, pair):
    """Within 0.05: interpolation of bands and of the tables of light differ."""

    grid = colour.SpectralShape(400, 720, 1)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(grid)
    source = colour.SDS_ILLUMINANTS[light].copy().align(grid)
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"][light]

    def lab(values):
        spectrum = colour.SpectralDistribution(dict(zip(BANDS, values, strict=True)))
        spectrum = spectrum.interpolate(grid, interpolator=colour.LinearInterpolator)
        return colour.XYZ_to_Lab(colour.sd_to_XYZ(spectrum, observer, source) / 100, white)

    expected = [colour.delta_E(lab(a), lab(b)) for a, b in zip(*(p[:4] for p in pair), strict=True)]
    found = metrics.delta_e(pair[0][:4], pair[1][:4], BANDS, light)
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_colour_needs_the_visible():
    assert metrics.sees_colour(BANDS)
    assert not metrics.sees_colour(np.arange(700.0, 1000.0, 10.0))


@pytest.mark.parametrize("values", [40, 400, 100_000])
def test_the_metamer_floor_is_the_spread_of_spectra_of_equal_responses(values):
    """Responses of few codes coincide: a pixel is no partner of itself, and all of a group are partners."""
    rng = np.random.default_rng(2)
    count = 3000
    level = rng.integers(0, values, count) / values
    responses = np.stack([level, 1 - level], 1).astype(np.float32)
    spread = np.where(rng.random(count) < 0.5, -0.05, 0.05)  # of metamers: standard deviation 0.05
    spectra = np.repeat((level + spread)[:, None], 6, 1)
    rows = np.arange(count)
    sigma, gold = np.full(responses.shape, 0.01), np.zeros(count, bool)
    samples = PaintSamples(responses, spectra, sigma, None, gold, rows, rows)
    floor = metamer_floor(samples, 2500, rng)
    assert floor["rmse"] == pytest.approx(0.05, rel=0.04)
    assert floor["pairs"] == 2500
