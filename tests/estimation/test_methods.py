"""Methods of spectral estimation against planted maps, scikit-learn and one another."""

from dataclasses import replace

import numpy as np
import pytest

from levkas.core.problems import Refused
from levkas.estimation.methods import METHODS, find_method, load_model, save_model
from levkas.estimation.methods.gaussian_process import condition
from levkas.estimation.methods.kernel_ridge import Kernel, fit_kernel_ridge
from levkas.estimation.methods.linear_model import RIDGES, fit_ridge
from levkas.estimation.methods.wiener import fit_wiener
from levkas.estimation.training import Training, sample_weights


@pytest.fixture
def rng():
    return np.random.default_rng(5)


def smooth(rng, count=300, channels=4, bands=9, noise=0.0):
    """Spectra of three smooth components, and channels that are sums of their bands."""
    grid = np.linspace(0, 1, bands)
    amounts = rng.dirichlet(np.ones(3), count)
    spectra = amounts @ np.stack([grid, 1 - grid, np.exp(-(((grid - 0.5) / 0.2) ** 2))])
    responses = spectra @ rng.dirichlet(np.ones(bands), channels).T
    return Training(responses + rng.normal(0, noise, responses.shape), spectra)


@pytest.mark.parametrize("name", METHODS)
def test_a_model_is_read_back_as_it_was_written_and_refuses_what_it_cannot_take(
    name, rng, tmp_path
):
    training = smooth(rng, noise=0.01)
    model = METHODS[name].fit(training, rng)
    save_model(tmp_path / "model.npz", name, model)
    found, again = load_model(tmp_path / "model.npz")
    assert found == name
    for refused, code in (
        (lambda: model(training.responses[:, :3]), "E_CHANNELS"),
        (lambda: METHODS[name].fit(smooth(rng, count=2), rng), "E_TOO_FEW_SAMPLES"),
    ):
        with pytest.raises(Refused) as error:
            refused()
        assert error.value.problems[0].code == code
    for one, other in zip(model(training.responses), again(training.responses), strict=True):
        assert (one is None and other is None) or np.array_equal(one, other)


def test_what_is_no_method_and_no_model_is_refused(tmp_path):
    (tmp_path / "model.npz").write_bytes(b"no archive")
    for call, code in (
        (lambda: find_method("winner"), "E_METHOD"),
        (lambda: load_model(tmp_path / "model.npz"), "E_MODEL"),
    ):
        with pytest.raises(Refused) as refused:
            call()
        assert refused.value.problems[0].code == code


# --- scikit-learn as the oracle ------------------------------------------------------------------


def noisy(rng, **options):
    """Samples with noise, sigma of the spectra that differ a hundredfold, and new responses."""
    training = smooth(rng, noise=0.01, **options)
    sigma = np.repeat(rng.uniform(0.001, 0.1, (len(training), 1)), training.spectra.shape[1], 1)
    weighted = replace(training, spectrum_sigma=sigma)
    return training, weighted, smooth(rng, noise=0.01, **options).responses


def test_wiener_equals_ridge_of_scikit_learn(rng):
    linear_model = pytest.importorskip("sklearn.linear_model")
    for training in noisy(rng)[:2]:
        expected = linear_model.Ridge(alpha=0.3, solver="cholesky").fit(
            training.responses, training.spectra, sample_weight=sample_weights(training)
        )
        found = fit_wiener(training, rng, ridge=0.3)(training.responses)[0]
        np.testing.assert_allclose(found, expected.predict(training.responses), atol=1e-9)


def test_the_ridge_that_is_chosen_is_the_best_of_scikit_learn_s_leave_one_out(rng):
    linear_model = pytest.importorskip("sklearn.linear_model")
    training = smooth(rng, count=60, noise=0.05)
    fit = fit_ridge(training)
    scale = np.linalg.norm(training.responses - training.responses.mean(0), 2) ** 2
    expected = linear_model.RidgeCV(alphas=RIDGES * scale).fit(training.responses, training.spectra)
    assert fit.ridge == pytest.approx(expected.alpha_, rel=1e-9)
    assert fit.error == pytest.approx(-expected.best_score_, rel=1e-6)


def test_kernel_ridge_equals_scikit_learn(rng):
    kernels = pytest.importorskip("sklearn.gaussian_process.kernels")
    ridge_of = pytest.importorskip("sklearn.kernel_ridge").KernelRidge
    for training in noisy(rng)[:2]:
        model = fit_kernel_ridge(training, rng, length=0.4, ridge=1e-3)
        new = noisy(rng)[2]
        oracle = kernels.Matern(0.4, nu=1.5)
        weights = sample_weights(training)
        mean = weights @ training.spectra / weights.sum()
        expected = ridge_of(alpha=1e-3, kernel="precomputed").fit(
            oracle(training.responses, training.responses), training.spectra - mean, weights
        )
        found = model(new)[0]
        there = expected.predict(oracle(new, training.responses)) + mean
        np.testing.assert_allclose(found, there, atol=1e-6)


def test_gaussian_process_equals_scikit_learn(rng):
    gp = pytest.importorskip("sklearn.gaussian_process")
    training, _, new = noisy(rng, count=120)
    model = condition(training, Kernel(0.4, training.responses.mean(0)), 1e-2)
    spectra, sigma = model(new)
    for band in (0, 5):
        variance = model.scale[band] ** 2
        kernel = gp.kernels.ConstantKernel(variance) * gp.kernels.Matern(0.4, nu=1.5)
        oracle = gp.GaussianProcessRegressor(kernel, alpha=1e-2 * variance, optimizer=None)
        oracle.fit(training.responses, training.spectra[:, band] - training.spectra[:, band].mean())
        mean, deviation = oracle.predict(new, return_std=True)
        expected = np.sqrt(deviation**2 + 1e-2 * variance)  # scikit-learn's has no noise
        there = mean + training.spectra[:, band].mean()
        np.testing.assert_allclose(spectra[:, band], there, atol=1e-6)
        np.testing.assert_allclose(sigma[:, band], expected, atol=1e-6)


# --- properties ----------------------------------------------------------------------------------


@pytest.mark.slow
@pytest.mark.parametrize("name", METHODS)
def test_neither_blocks_nor_threads_show_and_no_response_gives_no_spectrum(name, rng, monkeypatch):
    training = smooth(rng, noise=0.01)
    responses = smooth(rng, count=3000, noise=0.01).responses
    responses[1, 1] = np.nan
    found = []
    for threads in ("1", "3"):
        monkeypatch.setenv("LEVKAS_THREADS", threads)
        model = METHODS[name].fit(training, np.random.default_rng(1))
        found.append(model(responses)[0])
    assert found[0].tobytes() == found[1].tobytes()
    assert np.isnan(found[0][1]).all() and np.isfinite(np.delete(found[0], 1, 0)).all()
    parts = np.concatenate([model(responses[i : i + 3])[0] for i in (1023, 2997)])
    there = [1023, 1024, 1025, 2997, 2998, 2999]
    np.testing.assert_allclose(found[0][there], parts, atol=1e-9)


# --- measured pigments ---------------------------------------------------------------------------
