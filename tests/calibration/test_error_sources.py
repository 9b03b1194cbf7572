"""Errors that pixels and bands share: what is combined is what draws of the same errors scatter by."""

from pathlib import Path

import numpy as np
import pytest

from levkas.calibration.error_sources import (
    COVERAGE,
    ErrorSource,
    MeanSpectrum,
    join,
    uncertain_mean,
)
from levkas.calibration.flatfield import flat_field
from levkas.calibration.noise_fit import NoiseModel
from levkas.calibration.templates import average
from levkas.calibration.whites import WhiteBoard

LABELS = ["450 nm", "550 nm", "650 nm"]
NM = np.array([450.0, 550.0, 650.0])
FIRST, SECOND = np.array([0.2, 0.5, 0.8]), np.array([0.4, 0.3, 0.6])
DRAWS = 40_000


def of_all(size):
    return dict.fromkeys(LABELS, size)


SOURCES = [
    ErrorSource("white", "relative", of_all(0.01), "campaign", all_bands=True),
    ErrorSource("lamp", "relative", of_all(0.02), "frame", all_bands=False),
    ErrorSource("black", "reflectance", of_all(0.001), "frame", all_bands=True),
    ErrorSource("wavelength", "nm", of_all(1.0), "camera", all_bands=False),
    ErrorSource("place", "px", of_all(0.2), "frame", all_bands=True),
    ErrorSource("photons", "reflectance", of_all(0.005), "pixel", all_bands=False),
]
"""The last is in the noise of the means already."""


def mean_of(values, noise=0.002, seed=0):
    gradient = np.random.default_rng(seed).normal(0, 0.01, (2, 3))
    return MeanSpectrum(LABELS, values, np.full(3, noise), NM, gradient)


class Laboratory:
    """Draws of every error, made without the module: one number a source and what it is common to."""

    def __init__(self, seed):
        self.rng = np.random.default_rng(seed)
        self.white = 0.01 * self.rng.standard_normal((DRAWS, 1))

    def camera(self):
        """Return what one camera and capture make of means of several regions."""
        draw = self.rng.standard_normal
        lamp, nm = 0.02 * draw((DRAWS, 3)), draw((DRAWS, 3))
        black, place = 0.001 * draw((DRAWS, 1)), 0.2 * draw((DRAWS, 2))

        def see(mean):
            slope = np.gradient(mean.values, NM)
            errors = mean.values * (self.white + lamp) + black + slope * nm + place @ mean.gradient
            return mean.values + errors + 0.002 * draw((DRAWS, 3))

        return see


def test_means_ratios_and_differences_scatter_as_the_budget_says():
    see = Laboratory(1).camera()
    regions = mean_of(FIRST), mean_of(SECOND, seed=1)
    observed = np.concatenate([see(mean) for mean in regions], axis=1)
    both = join(
        [uncertain_mean(mean, SOURCES, layer="a", region=k) for k, mean in enumerate(regions)]
    )
    rows = np.array([*both.parts.values()])
    assert np.allclose(rows.T @ rows, np.cov(observed.T), atol=2e-6, rtol=0.05)
    for function in (
        lambda v: v[..., :3] - v[..., 3:],
        lambda v: v[..., :3] / v[..., 3:],
        lambda v: np.log(v[..., 1:2] / v[..., :1]),
    ):
        scatter = function(observed).std(0)
        assert np.allclose(both.through(function).sigma, scatter, rtol=0.03)


def test_two_cameras_share_the_white_of_the_campaign_and_nothing_else():
    laboratory = Laboratory(2)
    one, other = laboratory.camera(), laboratory.camera()
    mean = mean_of(FIRST)
    scatter = (one(mean) - other(mean)).std(0)
    found = [uncertain_mean(mean, SOURCES, layer=n, camera=n, region=n) for n in ("a", "b")]
    apart = join(found).through(lambda v: v[:3] - v[3:])
    assert np.allclose(apart.sigma, scatter, rtol=0.03)
    rows = apart.by_source()
    assert rows["white"].max() < 1e-9 and rows["lamp"][2] == pytest.approx(0.016 * 2**0.5)


@pytest.mark.parametrize("source", ["linearity", "stray light"])
def test_what_bends_or_veils_the_picture_does_not_leave_a_ratio(source):
    """Counts are drawn, not reflectances: both sides of a ratio, and the white, are bent by one curve or lie under one veil."""
    size, view = 0.005, 0.35
    draws = size * np.random.default_rng(5).standard_normal(DRAWS)[:, None]

    def observed(light, around):
        return light - draws * light**2 if source == "linearity" else light + draws * around

    both = np.concatenate([FIRST, SECOND])
    measured = observed(both, view) / observed(1.0, 1.0)
    unit = "relative" if source == "linearity" else "reflectance"
    zero = of_all(1.0 if source == "linearity" else view)
    row = ErrorSource(source, unit, of_all(size), "camera", all_bands=True, zero_at=zero)
    assert ErrorSource.from_dict(row.to_dict()) == row
    found = join([
        uncertain_mean(MeanSpectrum(LABELS, v, np.zeros(3), NM), [row], layer="a", region=k)
        for k, v in enumerate((FIRST, SECOND))
    ])  # fmt: skip
    assert np.allclose(found.sigma, measured.std(0), rtol=0.03)
    for function in (lambda v: v[..., :3] / v[..., 3:], lambda v: v[..., :3] - v[..., 3:]):
        assert np.allclose(found.through(function).sigma, function(measured).std(0), rtol=0.03)


def test_another_certificate_is_another_error():
    mean = mean_of(FIRST)
    whites = [
        ErrorSource("white", "relative", of_all(0.01), "campaign", all_bands=True, owner=name)
        for name in ("a.csv", "a.csv", "b.csv")
    ]
    found = [uncertain_mean(mean, [white], layer=str(k)) for k, white in enumerate(whites)]
    same, other = (join([found[0], one]).through(lambda v: v[:3] - v[3:]) for one in found[1:])
    assert np.allclose(other.by_source()["white"], 0.01 * 2**0.5 * FIRST)
    assert np.allclose(same.by_source()["white"], 0, atol=1e-12)


def test_bands_without_a_wavelength_have_no_slope_and_rows_come_back():
    mean = MeanSpectrum(LABELS, FIRST, np.zeros(3), np.array([450.0, np.nan, 650.0]))
    assert mean.slope.tolist() == pytest.approx([0.003, 0.0, 0.003])
    for source in SOURCES:
        assert ErrorSource.from_dict(source.to_dict()) == source
    unknown = ErrorSource(
        "linearity", "relative", {}, "camera", all_bands=True, basis="unknown", advice="…"
    )
    assert ErrorSource.from_dict(unknown.to_dict()) == unknown
    assert uncertain_mean(mean, [unknown], layer="a").parts == {}


def test_the_number_worked_by_hand_in_the_docs_is_what_calibration_gives():
    """From counts to k = 2: docs/explanation/how_sure.md, by the functions that a build runs."""
    shot, dark, white = (
        average([np.full((2, 2), level, np.float32)] * count)
        for level, count in ((2060, 1), (60, 8), (4060, 4))
    )
    noise = NoiseModel(gain=0.25, read_variance=2.0**2)
    flat = flat_field(shot, dark, white, board=WhiteBoard(0.990), noise=noise)
    value, sigma = float(flat.values[0, 0]), float(np.sqrt(flat.variance[0, 0]))
    rows = [
        ErrorSource("white board", "relative", {"R": 0.005 / 0.990}, "campaign", all_bands=True),
        ErrorSource("lamp", "relative", {"R": 0.003}, "frame", all_bands=True),
    ]
    page = (Path(__file__).parents[2] / "docs/explanation/how_sure.md").read_text("utf-8")
    for pixels, digits in ((1, 3), (10_000, 4)):
        mean = MeanSpectrum(["R"], np.array([value]), np.array([sigma / pixels**0.5]), NM[:1])
        made = uncertain_mean(mean, rows, layer="a")
        u = COVERAGE * float(made.sigma[0])
        assert f"R = {value:.{digits}f} ± {u:.{digits}f} (k = 2)" in page
    assert f"**{sigma:.4f}**" in page and f"**{float(made.sigma[0]):.4f}**" in page
