"""Errors of spectra against colour-science, scikit-learn and values worked by hand."""

import colour
import numpy as np
import pytest

from levkas.estimation import metrics

BANDS = np.arange(400.0, 721.0, 10.0)


@pytest.mark.filterwarnings("ignore::colour.utilities.ColourRuntimeWarning")
@pytest.mark.parametrize("light", ["D65", "A"])
def test_colour_differences_are_those_of_colour_science(light):
    """Within 0.05: interpolation of bands and of the tables of light differ."""
    rng = np.random.default_rng(2)
    measured = rng.uniform(0.05, 0.9, (4, len(BANDS)))
    pair = measured + rng.normal(0, 0.02, measured.shape), measured
    grid = colour.SpectralShape(400, 720, 1)
    observer = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(grid)
    source = colour.SDS_ILLUMINANTS[light].copy().align(grid)
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"][light]

    def lab(values):
        spectrum = colour.SpectralDistribution(dict(zip(BANDS, values, strict=True)))
        spectrum = spectrum.interpolate(grid, interpolator=colour.LinearInterpolator)
        return colour.XYZ_to_Lab(colour.sd_to_XYZ(spectrum, observer, source) / 100, white)

    expected = [colour.delta_E(lab(a), lab(b)) for a, b in zip(*pair, strict=True)]
    found = metrics.delta_e(*pair, BANDS, light)
    np.testing.assert_allclose(found, expected, atol=0.05)


def test_colour_needs_the_visible():
    assert metrics.sees_colour(BANDS)
    assert not metrics.sees_colour(np.arange(700.0, 1000.0, 10.0))
