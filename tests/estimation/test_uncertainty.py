"""Intervals of estimated spectra hold the truth of paints that nobody fitted to, under planted errors of cameras."""

import numpy as np
import pytest

from levkas.calibration.error_sources import COVERAGE, ErrorSource, MeanSpectrum, uncertain_mean
from levkas.estimation.methods import METHODS
from levkas.estimation.scores import MethodScore, PixelErrors
from levkas.estimation.training import Training
from levkas.estimation.uncertainty import (
    Channels,
    Estimate,
    ModelErrors,
    PredictionError,
    noise_of_residuals,
    slopes_of,
)

NM = np.arange(410.0, 711.0, 20.0)
CENTRES = np.array([430.0, 480, 530, 580, 630, 680])
SEEN = np.exp(-0.5 * ((NM - CENTRES[:, None]) / 25) ** 2)
SEEN /= SEEN.sum(1, keepdims=True)
CHANNELS, BANDS = [f"c{k}" for k in range(6)], [f"{w:g} nm" for w in NM]
NOISE, WHITE, LAMP, TARGET = 0.004, 0.02, 0.02, 0.01


def paints(rng, count):
    """Spectra of paints, (count, bands): steps and hills of any place, one upon the other."""
    edge = 1 / (
        1 + np.exp(-(NM - rng.uniform(430, 680, (count, 1))) / rng.uniform(12, 40, (count, 1)))
    )
    hill = np.exp(
        -0.5 * ((NM - rng.uniform(420, 700, (count, 1))) / rng.uniform(30, 70, (count, 1))) ** 2
    )
    low, step, top = (
        rng.uniform(a, b, (count, 1)) for a, b in ((0.05, 0.1), (0.1, 0.5), (0, 0.25))
    )
    return low + step * edge + top * hill  # fmt: skip


def channels():
    rows = (
        ErrorSource("white", "relative", dict.fromkeys(CHANNELS, WHITE), "campaign", all_bands=True),
        ErrorSource("lamp", "relative", dict.fromkeys(CHANNELS, LAMP), "frame", all_bands=False),
    )  # fmt: skip
    return Channels("cam", "cam", CHANNELS, np.full(6, np.nan), rows)


def captured(rng, spectrum, white, pixels):
    """Responses of a paint under a wrong white and other lamps for every channel, the mean of some pixels."""
    errors = 1 + white + LAMP * rng.standard_normal(6)
    return spectrum @ SEEN.T * errors + rng.normal(0, NOISE / pixels**0.5, 6)


def fitted(method, *, white=0.0, target=0.0):
    """Return a model, its held-out errors, and responses of its training; the training has a wrong white on either side."""
    rng = np.random.default_rng(7)
    sets = []
    for count in (700, 1500):
        spectra = paints(rng, count)
        responses = (1 + white) * (spectra @ SEEN.T + rng.normal(0, NOISE, (count, 6)))
        sets.append((responses, (1 + target) * (spectra + rng.normal(0, NOISE, spectra.shape))))
    training = Training(*sets[0], np.full((700, 6), NOISE), np.full((700, len(NM)), NOISE))
    model = METHODS[method].fit(training, rng)
    noise = noise_of_residuals(
        slopes_of(model, sets[0][0][:100]), training.response_sigma[:100], training.spectrum_sigma
    )
    return model, PredictionError.measure(model(sets[1][0])[0] - sets[1][1], noise), sets[0][0]


def share_within(made, truth):
    """Share of true values that the expanded intervals hold, of one paint."""
    return np.mean(np.abs(made.values - truth) <= COVERAGE * made.sigma)


def share_of_difference(made, truth):
    """Whether the interval of the difference of two bands holds it."""
    return share_within(made.pick([3, 9]).through(lambda v: v[:1] - v[1:]), truth[3] - truth[9])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "same", "pixels"),
    [
        ("wiener", True, 1),
        ("wiener", False, 10_000),
        pytest.param("matern", True, 10_000, marks=pytest.mark.exhaustive),
        pytest.param("gaussian-process", False, 1, marks=pytest.mark.slow),
    ],
)
def test_the_budget_of_an_estimated_layer_holds_the_truth(method, same, pixels):
    """A wrong white of the camera is undone where the training had it too; that of the training's spectra is inherited."""
    rng, held = np.random.default_rng(5), []
    row = dict.fromkeys(BANDS, TARGET)
    target = ErrorSource("white", "relative", row, "campaign", all_bands=True, owner="training")
    for _ in range(8):
        white, inherited = WHITE * rng.standard_normal(), TARGET * rng.standard_normal()
        model, missed, trained = fitted(method, white=white if same else 0.0, target=inherited)
        errors, noise = ModelErrors(missed, (target,)), np.full((60, 6), NOISE)
        estimate = Estimate(model, errors, trained[:60], noise, [channels()], BANDS)
        rows = estimate.rows(same_cameras=same)
        for spectrum in paints(rng, 40):
            off = white if same else WHITE * rng.standard_normal()
            spectra, own = model(captured(rng, spectrum, off, pixels)[None])
            sigma = (estimate.sigma(noise[:1]) if own is None else own)[0]
            mean = MeanSpectrum(BANDS, spectra[0], sigma / pixels**0.5, NM, sigma=sigma)
            made = uncertain_mean(mean, rows, layer="icon1/guess")
            held.append((share_within(made, spectrum), share_of_difference(made, spectrum)))
    bands, difference = np.mean(held, 0)
    assert bands == pytest.approx(0.95, abs=0.02)
    assert difference == pytest.approx(0.95, abs=0.03)  # of 320 draws alone


def test_what_neighbours_are_missed_by_is_measured_whatever_their_noise_is():
    """Paints of 16 px a side, each missed by an error of its own in all bands alike; noise of pixels is several times as large."""
    rng = np.random.default_rng(3)
    paints_missed = np.kron(rng.normal(0, 0.01, (12, 12, 1)), np.ones((16, 16, 1)))
    y, x = (places.ravel() for places in np.mgrid[:192, :192])
    residuals = paints_missed.reshape(-1, 1) + rng.normal(0, 0.03, (192 * 192, 5))
    errors = PixelErrors("icon", y, x, {}, residuals, residuals, None)
    score = MethodScore("wiener", (errors,))
    first, second = score.pairs(4)
    apart = np.hypot(y[first] - y[second], x[first] - x[second])
    assert (apart == 4).all() and len(apart) > 50_000
    found = PredictionError.measure(score.residuals(), 0.0, (first, second))
    # Of a fourth of the pairs the two are of two paints.
    assert found.sigma == pytest.approx(0.75**0.5 * paints_missed.std(), rel=0.1)
    assert np.hypot(found.sigma, found.alone) == pytest.approx(residuals.std(0), rel=1e-2)
