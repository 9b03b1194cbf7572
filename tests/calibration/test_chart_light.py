"""A planted light field comes back from the patches of a chart, with an uncertainty that holds beyond them."""

import numpy as np
import pytest

from levkas.calibration.chart_light import (
    LEAST,
    MOST,
    ChartOutline,
    LightMap,
    Patches,
    fit_light,
)

X, Y = np.meshgrid(200 + 80.0 * np.arange(6), 200 + 80.0 * np.arange(4))
PLACES = np.stack([X.ravel(), Y.ravel()], 1)
GREYS = np.arange(24) >= 18
KNOWN = np.concatenate(
    [np.random.default_rng(3).uniform(0.06, 0.7, 18), [0.9, 0.59, 0.36, 0.19, 0.09, 0.032]]
)
OUTLINE = ChartOutline.around(
    np.concatenate([PLACES + 20 * np.array(s) for s in ((-1, -1), (-1, 1), (1, -1), (1, 1))])
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
    light = fit_light(patches_of(field, np.random.default_rng(0)), OUTLINE)
    assert light.order in orders  # by chance a plane predicts even light as well
    # Of a lens's cos⁴, which is no polynomial, 0.3 % is left.
    assert light(PLACES) == pytest.approx(FIELDS[field](PLACES), rel=5e-3)
    assert light.rmse < 3e-3
    if field != "even":
        assert light.flat_rmse > 5 * light.rmse


@pytest.mark.parametrize("field", FIELDS)
def test_sigma_holds_the_error_on_the_chart_and_beyond(field):
    """Twenty charts whose patches differ from their spectra by 2 %."""
    rng = np.random.default_rng(1)
    x, y = np.meshgrid(np.linspace(0, 800, 17), np.linspace(0, 640, 17))
    points = np.stack([x.ravel(), y.ravel()], 1)
    inside = OUTLINE.nearest(points)[1]
    held = []
    for _ in range(20):
        light = fit_light(patches_of(field, rng, 0.02), OUTLINE)
        off = light(points) / FIELDS[field](points) - 1
        held.append(np.abs(off) <= 1.96 * light.sigma(points))
    held = np.array(held)
    assert held[:, inside].mean() > 0.9 and held[:, ~inside].mean() > 0.9


def test_beyond_the_chart_the_light_stays_within_bounds_and_its_sigma_grows():
    light = fit_light(patches_of("vignetting", np.random.default_rng(2), 0.02), OUTLINE)
    edge = light(OUTLINE.corners)
    away = np.array([[400 + 200 * k, 320.0] for k in range(1, 12)])
    assert np.all(light(away) >= 0.99 * LEAST * edge.min())
    assert np.all(light(away) <= 1.01 * MOST * edge.max())
    sigma = light.sigma(away[1:])
    assert np.all(np.diff(sigma) >= -1e-9) and sigma[-1] > 5 * light.sigma(PLACES).max()
    assert sigma.max() <= 1


def test_a_lent_shape_serves_a_band_of_which_greys_alone_are_known():
    full = fit_light(patches_of("gradient"), OUTLINE)
    greys = patches_of("gradient").pick(GREYS)
    half = greys._replace(levels=greys.levels / 2)
    light = fit_light(half, OUTLINE, full.shape)
    assert light(PLACES) == pytest.approx(FIELDS["gradient"](PLACES) / 2, rel=1e-6)
    assert len(light.errors) == 6 and light.rmse < 1e-6


def test_the_light_is_worked_out_over_a_picture():
    light = fit_light(patches_of("gradient", np.random.default_rng(4), 0.02), OUTLINE)
    made = LightMap.of(light, OUTLINE, (640, 800))
    for part, known in ((made.levels, light), (made.sigma, light.sigma)):
        assert part.at(np.array([333]), np.array([420]))[0, 0] == pytest.approx(
            float(known(np.array([[420.0, 333.0]]))[0]), rel=0.02
        )
    assert 0 < made.beyond < 1
