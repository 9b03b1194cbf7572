"""Methods of spectral estimation against planted maps, scikit-learn and one another."""

import importlib
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from levkas.core.problems import Refused
from levkas.estimation.methods import METHODS, find_method, load_model, save_model
from levkas.estimation.methods.gaussian_process import condition, log_likelihoods
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


def test_the_likelihood_is_that_of_scikit_learn(rng):
    gp = pytest.importorskip("sklearn.gaussian_process")
    training = smooth(rng, count=50, bands=5, noise=0.02)
    centred = replace(training, spectra=training.spectra - training.spectra.mean(0))
    expected = []
    for noise in (1e-3, 1e-1):
        total = 0.0
        for band in centred.spectra.T:
            matern = gp.kernels.Matern(0.5, nu=1.5)
            gram = matern(training.responses) + noise * np.eye(50)
            variance = float(band @ np.linalg.solve(gram, band)) / 50
            kernel = gp.kernels.ConstantKernel(variance) * matern
            oracle = gp.GaussianProcessRegressor(kernel, alpha=noise * variance, optimizer=None)
            total += oracle.fit(training.responses, band).log_marginal_likelihood_value_
        expected.append(total)
    kernel = Kernel(0.5, training.responses.mean(0))
    found = log_likelihoods(centred, kernel, [1e-3, 1e-1])
    assert found[1] - found[0] == pytest.approx(expected[1] - expected[0], rel=1e-6)


# --- properties ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", [n for n in METHODS if n not in ("pseudo-inverse",)])
def test_spectra_of_three_components_are_recovered(name, rng):
    """Four channels see all that varies: without noise little is lost."""
    training, test = (smooth(np.random.default_rng(5), count=600) for _ in range(2))
    test = test.take(np.arange(0, 600, 3))
    training = training.take(np.arange(600) % 3 > 0)
    found = METHODS[name].fit(training, rng)(test.responses)[0]
    assert np.sqrt(np.square(found - test.spectra).mean()) < 0.01


@pytest.mark.parametrize("name", ["wiener", "matern"])
def test_samples_of_large_sigma_count_little(name, rng):
    """Half of the samples are off by 0.2 and say so."""
    training = smooth(rng, count=400)
    wrong = np.arange(400) % 2 == 0
    spectra = training.spectra + np.where(wrong, 0.2, 0.0)[:, None]
    sigma = np.where(wrong, 0.3, 0.003)[:, None] * np.ones_like(spectra)
    test = smooth(np.random.default_rng(5), count=400)
    misses = [
        np.abs(METHODS[name].fit(t, rng)(test.responses)[0] - test.spectra).mean()
        for t in (
            replace(training, spectra=spectra),
            Training(training.responses, spectra, None, sigma),
        )
    ]
    assert misses[1] < 0.6 * misses[0]


@pytest.mark.slow
def test_the_interval_of_the_gaussian_process_holds_what_was_held_out(rng):
    """Paintings differ in their noise-free colours: whole ones are held out."""
    paintings = [smooth(np.random.default_rng(seed), count=250, noise=0.02) for seed in range(6)]
    mix = np.random.default_rng(3).dirichlet(np.ones(9), 4).T
    parts = [p.spectra @ mix + rng.normal(0, 0.02, (250, 4)) for p in paintings]
    inside = []
    for held in range(6):
        others = [i for i in range(6) if i != held]
        training = Training(
            np.concatenate([parts[i] for i in others]),
            np.concatenate([paintings[i].spectra for i in others]),
            groups=np.repeat(others, 250),
        )
        spectra, sigma = METHODS["gaussian-process"].fit(training, rng)(parts[held])
        inside.append((np.abs(spectra - paintings[held].spectra) <= 1.96 * sigma).mean())
    assert 0.93 < np.mean(inside) < 0.97


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


@pytest.mark.parametrize("name", ["wiener", "matern", "gaussian-process"])
def test_responses_that_do_not_vary_give_the_mean_spectrum(name, rng):
    training = smooth(rng)
    flat = replace(training, responses=np.full_like(training.responses, 0.4))
    found = METHODS[name].fit(flat, rng)(flat.responses[:1])[0]
    np.testing.assert_allclose(found[0], training.spectra.mean(0), atol=1e-3)


# --- measured pigments ---------------------------------------------------------------------------


@pytest.fixture
def benchmark(monkeypatch):
    monkeypatch.syspath_prepend(str(Path(__file__).resolve().parents[2] / "benchmarks"))
    return importlib.import_module("estimation")


@pytest.mark.slow
@pytest.mark.parametrize("camera", ["Nikon D5100", "Nikon D80"])
def test_kernels_are_a_quarter_better_than_a_line_on_pigments(camera, benchmark, real_data, rng):
    """Whole pigments held out, D50, SNR 100: 0.039 by a line, 0.027 by kernels with the D80."""
    path = None
    if camera == "Nikon D80":
        path = Path(os.environ.get("LEVKAS_D80", real_data / "spectra/cameras/nikon-d80.csv"))
        if not path.is_file():
            pytest.skip(f"no sensitivities of the D80: {path} is not there; set LEVKAS_D80")
    samples = benchmark.simulate(real_data, benchmark.read_sensitivities(path)[0], rng)
    errors = {
        name: benchmark.metrics.rmse(
            benchmark.cross_validate(METHODS[name], samples)[0], samples.spectra
        ).mean()
        for name in ("pseudo-inverse", "wiener", "matern")
    }
    assert errors["matern"] < 0.75 * min(errors["wiener"], errors["pseudo-inverse"])
    assert errors["wiener"] < 0.045
