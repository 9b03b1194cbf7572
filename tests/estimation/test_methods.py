"""Methods of spectral estimation against planted maps, scikit-learn and one another."""

import numpy as np
import pytest

from levkas.core.problems import Refused
from levkas.estimation.methods import METHODS, find_method, load_model, save_model
from levkas.estimation.training import Training


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
def test_a_model_is_read_back_as_it_was_written(name, rng, tmp_path):
    training = smooth(rng, noise=0.01)
    model = METHODS[name].fit(training, rng)
    save_model(tmp_path / "model.npz", name, model)
    found, again = load_model(tmp_path / "model.npz")
    assert found == name
    for one, other in zip(model(training.responses), again(training.responses), strict=True):
        assert (one is None and other is None) or np.array_equal(one, other)


@pytest.mark.parametrize("name", METHODS)
def test_responses_of_other_channels_are_refused(name, rng):
    training = smooth(rng)
    model = METHODS[name].fit(training, rng)
    with pytest.raises(Refused, match="other channels"):
        model(training.responses[:, :3])


@pytest.mark.parametrize("name", METHODS)
def test_fewer_samples_than_coefficients_are_refused(name, rng):
    with pytest.raises(Refused, match="needs as many samples"):
        METHODS[name].fit(smooth(rng, count=2), rng)


def test_an_unknown_method_is_refused_by_name():
    with pytest.raises(Refused, match="wiener"):
        find_method("winner")


def test_a_file_that_is_no_model_is_refused(tmp_path):
    (tmp_path / "model.npz").write_bytes(b"no archive")
    with pytest.raises(Refused, match="no fitted model"):
        load_model(tmp_path / "model.npz")
