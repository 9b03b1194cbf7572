"""A planted light field comes back from the patches of a chart."""

import numpy as np
import pytest

from levkas.calibration.chart_light import LEAST, MOST, Patches, fit_light

X, Y = np.meshgrid(200 + 80.0 * np.arange(6), 200 + 80.0 * np.arange(4))
PLACES = np.stack([X.ravel(), Y.ravel()], 1)
GREYS = np.arange(24) >= 18
KNOWN = np.concatenate(
    [np.random.default_rng(3).uniform(0.06, 0.7, 18), [0.9, 0.59, 0.36, 0.19, 0.09, 0.032]]
)
FIELDS = {
    "even": lambda p: np.full(len(p), 3000.0),
    "gradient": lambda p: 3000 * (1 + 4e-4 * (p[:, 0] - 400) - 3e-4 * (p[:, 1] - 300)),
    "vignetting": lambda p: 3000 / (1 + ((p[:, 0] - 450) ** 2 + (p[:, 1] - 350) ** 2) / 1.5e6) ** 2,
}


def patches_of(field, rng=None, scatter=0.0):
    levels = FIELDS[field](PLACES) * KNOWN
    if rng is not None:
        levels = levels * (1 + scatter * rng.standard_normal(24)) + rng.standard_normal(24)
    return Patches(PLACES, levels, np.ones(24), KNOWN, GREYS)


@pytest.mark.parametrize(
    ("field", "orders"), [("even", (0, 1)), ("gradient", (1,)), ("vignetting", (2,))]
)
def test_a_planted_field_comes_back_on_the_chart(field, orders):
    light = fit_light(patches_of(field, np.random.default_rng(0)))
    assert light.order in orders  # by chance a plane predicts even light as well
    # Of a lens's cos⁴, which is no polynomial, 0.3 % is left.
    assert light(PLACES) == pytest.approx(FIELDS[field](PLACES), rel=5e-3)
    assert light.rmse < 3e-3
    if field != "even":
        assert np.std(light.even_errors) > 5 * light.rmse


def test_beyond_the_chart_the_light_stays_within_bounds():
    light = fit_light(patches_of("vignetting", np.random.default_rng(2), 0.02))
    away = light(np.array([[400 + 200 * k, 320.0] for k in range(1, 12)]))
    edge = light(PLACES)
    assert np.all(away >= 0.99 * LEAST * edge.min()) and np.all(away <= 1.01 * MOST * edge.max())


def test_a_lent_shape_serves_a_band_of_which_greys_alone_are_known():
    full = fit_light(patches_of("gradient"))
    greys = patches_of("gradient").pick(GREYS)
    light = fit_light(greys._replace(levels=greys.levels / 2), full)
    assert light(PLACES) == pytest.approx(FIELDS["gradient"](PLACES) / 2, rel=1e-6)
    assert len(light.errors) == 6 and light.rmse < 1e-6


def test_the_light_is_worked_out_over_a_picture():
    light = fit_light(patches_of("vignetting", np.random.default_rng(4), 0.02))
    made = light.over(np.arange(640), np.arange(800))
    assert made[333, 420] == pytest.approx(float(light(np.array([[420.0, 333.0]]))[0]), rel=1e-5)
