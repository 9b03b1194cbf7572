import numpy as np

from levkas.geometry.depth_step import DepthStepShift
from levkas.geometry.transforms import Affine, Composed, Lens
from levkas.registration.depth_step import (
    find_depth_step,
    find_depth_steps,
    fit_with_depth_step,
)
from levkas.registration.model_selection import SelectionTerms, select_model
from levkas.registration.models import Observations, fit_polynomial, fit_projective

CELL, NOISE = 16.0, 0.03
VIEW = Affine(np.array([[1.2, 0.01, 8.0], [-0.02, 1.21, 5.0]]))


def sunk(turned=0.01, shift=((0.1, -0.05), (0.3, 0.0), (0.0, 0.25))):
    """A centre that is lowered between 150 and 850, 120 and 640 px, behind a slope of 24 px."""
    c, s = np.cos(turned), np.sin(turned)
    normals = np.array([[c, s], [-c, -s], [-s, c], [s, -c]])
    middle, half = np.array([500.0, 380]), np.array([350.0, 350, 260, 260])
    lines = np.column_stack([normals, half - normals @ middle])
    return DepthStepShift(lines, 24.0, middle, 500.0, np.array(shift))


def windows(truth, seed=0, step=CELL):
    """What windows of three cells see, `step` px apart: the mean of where their pixels lie."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(24, 1000, step), np.arange(24, 760, step))
    points = np.stack([x, y], -1).reshape(-1, 2)
    spots = (np.arange(-23, 24, 2.0), 1 - np.abs(np.arange(-23, 24, 2.0)) / 24)
    around = np.stack(np.meshgrid(spots[0], spots[0]), -1).reshape(-1, 2)
    weights = np.outer(spots[1], spots[1]).ravel() / np.outer(spots[1], spots[1]).sum()
    target = sum(w * truth(points + a) for a, w in zip(around, weights, strict=True))
    target = target + NOISE * rng.standard_normal(points.shape)
    jacobian = VIEW.jacobian(points)
    information = np.broadcast_to(np.eye(2) / NOISE**2, (len(points), 2, 2))
    return Observations(points, target, jacobian, information)


def test_a_ledge_is_found_where_it_was_planted_and_its_displacement_with_it():
    truth = Composed(sunk(), VIEW)
    observed = windows(truth)
    ledge = find_depth_step(observed, CELL)
    assert ledge is not None
    middles = ledge.edges[:4] + ledge.edges[4] / 2 * np.array([1, -1, 1, -1])
    middles += np.repeat(ledge.centre, 2)
    assert np.abs(middles - [162, 838, 132, 628]).max() < 4  # a quarter of a cell
    turned = ledge.edges[5]
    assert abs(turned - 0.01) < 0.01
    fitted = fit_with_depth_step(observed, ledge, lambda o: fit_polynomial(o, 2))
    inside = np.stack(np.meshgrid(np.linspace(190, 810, 20), np.linspace(160, 600, 20)), -1)
    points = inside.reshape(-1, 2)
    error = np.linalg.norm(fitted(points) - truth(points), axis=1)
    assert error.max() < 0.03  # as far as one window errs


def test_the_ladder_takes_a_ledge_where_there_is_one_and_is_nearer_to_the_truth_for_it():
    truth = Composed(sunk(), VIEW)
    observed = windows(truth, 1, 2 * CELL)
    with_it, without = (
        select_model(observed, SelectionTerms(192, cell=CELL, depth_step=True)),
        select_model(observed, SelectionTerms(192)),
    )
    assert with_it.name.endswith("+depth_step") and "depth_step" not in without.name
    rng = np.random.default_rng(2)
    points = rng.uniform([20, 20], [980, 740], (2000, 2))
    errors = [
        np.linalg.norm(r.transform(points) - truth(points), axis=1) for r in (with_it, without)
    ]
    assert errors[0].mean() < 0.5 * errors[1].mean()


def test_there_is_no_ledge_in_an_even_panel():
    observed = windows(VIEW, 3)
    assert find_depth_step(observed, CELL) is None
    assert (
        "depth_step"
        not in select_model(observed, SelectionTerms(192, cell=CELL, depth_step=True)).name
    )


def test_a_ledge_displaces_along_either_axis_evenly_and_growing_along_it():
    truth = Composed(sunk(shift=((0.6, 0.1), (0.07, 0.0), (0.0, -0.09))), VIEW)
    observed = windows(truth, 5)
    ledge = find_depth_step(observed, CELL)
    fitted = fit_with_depth_step(observed, ledge, lambda o: fit_projective(o, lens=False)).steps[0]
    inside = np.stack(np.meshgrid(np.linspace(200, 800, 9), np.linspace(170, 590, 9)), -1)
    points = inside.reshape(-1, 2)
    assert fitted.shift[2, 0] == fitted.shift[1, 1] == 0.0
    assert np.abs(fitted(points) - truth.steps[0](points)).max() < 0.02


def test_a_ledge_is_found_beside_a_strong_lens_and_only_there_beside_a_quintic():
    lens = Lens(np.array([500.0, 380]), 500.0, (0.01, 0.004), (0.0, 0.0))
    observed = windows(Composed(sunk(shift=((0.15, -0.1), (0, 0), (0, 0))), lens, VIEW), 10)
    found = find_depth_steps(observed, CELL)
    middles = [f.edges[:4] + f.edges[4] / 2 * np.array([1, -1, 1, -1]) for f in found]
    off = [
        np.abs(m + np.repeat(f.centre, 2) - [162, 838, 132, 628]).max()
        for m, f in zip(middles, found, strict=True)
    ]
    assert len(found) == 2 and off[0] > 20 and off[1] < 4
