"""Training samples: refusals, the choice of samples, weights from sigma, held-out residuals by refitting."""

from dataclasses import replace

import numpy as np
import pytest

from levkas.core.problems import Refused
from levkas.estimation.training import Training, held_out_residuals, select_training


@pytest.fixture
def rng():
    return np.random.default_rng(11)


@pytest.fixture
def training(rng):
    return Training(rng.uniform(0, 1, (50, 3)), rng.uniform(0, 1, (50, 5)))


@pytest.mark.parametrize(
    ("field", "values"),
    [
        ("spectra", np.ones((40, 5))),
        ("response_sigma", np.ones((50, 2))),
        ("spectrum_sigma", -np.ones((50, 5))),
        ("groups", np.zeros(49, int)),
        ("responses", np.where(np.arange(150).reshape(50, 3) == 7, np.inf, 1.0)),
    ],
)
def test_what_is_no_row_a_sample_is_refused_by_its_name(training, field, values):
    with pytest.raises(Refused) as refused:
        replace(training, **{field: values})
    assert [problem.field for problem in refused.value.problems] == [field]


def test_what_is_chosen_covers_the_responses_better_than_chance(rng):
    responses = rng.beta(1, 4, (3000, 3))
    chosen = select_training(Training(responses, responses), 100, rng).responses
    drawn = responses[rng.choice(3000, 100, replace=False)]

    def farthest(samples):
        return np.linalg.norm(responses[:, None] - samples, axis=2).min(1).max()

    assert farthest(chosen) < 0.6 * farthest(drawn)


@pytest.mark.parametrize("grouped", [False, True])
def test_held_out_residuals_are_those_of_refitting(grouped, rng):
    x, y = rng.normal(size=(24, 4)), rng.normal(size=(24, 3))
    groups = np.arange(24) // (4 if grouped else 1)
    left, scale, _ = np.linalg.svd(x, full_matrices=False)
    (found,) = held_out_residuals(left, scale**2, y, [0.3], groups if grouped else None)
    for group in np.unique(groups):
        held = groups == group
        known = x[~held]
        slope = np.linalg.solve(known.T @ known + 0.3 * np.eye(4), known.T @ y[~held])
        np.testing.assert_allclose(found[held], y[held] - x[held] @ slope, atol=1e-12)
