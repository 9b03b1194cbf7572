"""Captures by one camera adjusted together: against a planted lens, panels of other shapes, shared colour."""

import json
from functools import cache

import numpy as np
import pytest

from levkas.geometry.transforms import Affine, Composed, Homography, Lens
from levkas.registration.chromatic import ChromaticShifts, pool_chromatic
from levkas.registration.joint import SensorObservations, adjust_jointly
from levkas.registration.model_selection import SelectionTerms, select_model
from levkas.registration.models import Observations

SIZE = np.array([420.0, 320.0])
CELL = 16.0
LENS = Lens(np.array([335.0, 248.0]), 300.0, (-0.012, 0.004), (4e-4, -3e-4))
NOISE = 0.12


def truth(number):
    """A painting laid anew before a camera that stands still: its homography, then the lens."""
    rng = np.random.default_rng(100 + number)
    turn, shift = rng.normal(0, 0.004), rng.normal(0, 2.0, 2)
    lay = Affine(np.array([[1.5, -turn, 20.0 + shift[0]], [turn, 1.5, 8.0 + shift[1]]]))
    tilt = np.eye(3)
    tilt[2, :2] = rng.normal(0, 4e-6, 2)
    return Composed(lay, Homography(tilt), LENS)


def colour(bands=1, width=2, **known):
    return ChromaticShifts(
        "shift", (SIZE - 1) / 2, 210.0, np.zeros((bands, width)), np.full((bands, width), 1e-4),
        **known,
    )  # fmt: skip


def patches(rng, points, size=0.04, reach=40.0):
    """What windows of one patch err alike."""
    spots, lean = rng.uniform(0, SIZE, (60, 2)), rng.normal(0, size, (60, 2))
    near = np.exp(-((points[:, None] - spots) ** 2).sum(2) / (2 * reach**2))
    return near @ lean


@cache
def sighting(number, *, bulge=0.0, noise=NOISE, labels=("a",), cell=CELL):
    """What windows of one capture see; `bulge` lifts the middle of the panel by so many px."""
    rng = np.random.default_rng(number)
    x, y = np.meshgrid(np.arange(20, 400, cell), np.arange(20, 300, cell))
    points = np.stack([x.ravel(), y.ravel()], 1)
    imaged = truth(number)
    away = points - SIZE / 2
    lifted = points + bulge * away / 100 * np.exp(-((away / 80) ** 2).sum(1))[:, None]
    jacobian = imaged.jacobian(points)
    drawn = rng.normal(0, noise, points.shape) + patches(rng, points)
    target = imaged(lifted) + np.einsum("nab,nb->na", jacobian, drawn)
    known = np.broadcast_to(np.eye(2) / noise**2, (len(points), 2, 2)).copy()
    observed = Observations(points, target, jacobian, known)
    terms = SelectionTerms(4 * cell, 2.01 * cell, cell, depth_step=True)
    selected = select_model(observed, terms)
    return SensorObservations(
        "",
        labels,
        selected.transform,
        colour(len(labels)),
        selected.held_out_error,
        selected.observations,
        terms,
    )


def missed(base, number):
    x, y = np.meshgrid(np.linspace(20, 395, 31), np.linspace(20, 295, 23))
    points = np.stack([x.ravel(), y.ravel()], 1)
    observed = truth(number)
    miss = np.linalg.solve(observed.jacobian(points), (base(points) - observed(points))[..., None])[
        ..., 0
    ]
    return float(np.linalg.norm(miss, axis=1).mean())


@pytest.mark.slow
def test_companions_bring_noisy_captures_nearer_to_the_truth():
    captures = [sighting(k, cell=12.0) for k in range(4)]
    before = after = 0.0
    for k, mine in enumerate(captures[:3]):
        found = adjust_jointly(mine, captures[:k] + captures[k + 1 :])
        assert found.selected is not None
        assert found.companions == (0, 1, 2)
        before, after = before + missed(mine.base, k), after + missed(found.base, k)
    # How each painting lies is its own affair: eight of twelve terms.
    assert after < 0.92 * before


def test_a_panel_of_another_shape_takes_no_part():
    mine, like, other = sighting(0), sighting(1), sighting(2, bulge=1.6)
    found = adjust_jointly(mine, [other])
    assert found.companions == ()
    assert found.selected is None
    assert found.base is mine.base
    assert adjust_jointly(mine, [other, like]).companions == (1,)


def test_what_was_not_captured_from_the_same_place_takes_no_part():
    mine, far = sighting(0), sighting(1)
    bent = far.observations.points + 3.0 * np.sin(far.observations.points / 60)
    moved = Observations(
        bent, far.observations.target, far.observations.jacobian, far.observations.information
    )
    stranger = SensorObservations(
        "", far.labels, far.base, far.chromatic, far.held_out, moved, far.terms
    )
    assert adjust_jointly(mine, [stranger]).companions == ()


@pytest.mark.slow
def test_the_order_of_the_companions_only_numbers_them():
    mine, *others = (sighting(k) for k in range(3))
    one, other = adjust_jointly(mine, others), adjust_jointly(mine, others[::-1])
    points = SIZE * np.random.default_rng(1).random((50, 2))
    np.testing.assert_allclose(one.base(points), other.base(points), atol=1e-6)


def test_the_reference_s_own_bands_are_shared_and_its_frame_stays():
    own = [
        SensorObservations("", ("a", "b", "c"), Affine.identity(), measured(k, fixed=1))
        for k in range(4)
    ]
    found = adjust_jointly(own[0], own[1:])
    assert found.selected is None
    assert not found.chromatic.amounts[1].any()


# --- what sets the bands apart ----------------------------------------------------------------

COLOURS = np.random.default_rng(7).normal(0, 0.3, (3, 4))


def measured(number, *, noise=0.05, drift=0.0, fixed=None):
    rng = np.random.default_rng(50 + number)
    real = COLOURS + rng.normal(0, drift, COLOURS.shape) if drift else COLOURS
    amounts = real + rng.normal(0, noise, COLOURS.shape)
    variances = np.full(COLOURS.shape, noise**2)
    if fixed is not None:
        amounts -= amounts[fixed]
        variances[fixed] = 0.0
    return ChromaticShifts("similarity", (SIZE - 1) / 2, 210.0, amounts, variances)


def off(one, truth=COLOURS):
    """How far the bands are off from one another: what they have in common is the base map's."""
    apart = one.amounts - truth
    return float(np.sqrt(((apart - apart.mean(0)) ** 2).mean()))


def test_bands_of_several_captures_are_known_better_than_of_one():
    alone = [measured(k) for k in range(6)]
    together = [pool_chromatic(one, alone[:k] + alone[k + 1 :]) for k, one in enumerate(alone)]
    before, after = (np.mean([off(c) for c in some]) for some in (alone, together))
    assert after < 0.65 * before
    assert all((t.variances <= a.variances).all() for t, a in zip(together, alone, strict=True))


def test_bands_that_really_differ_from_capture_to_capture_stay_apart():
    rng_of = [np.random.default_rng(50 + k) for k in range(6)]
    real = [COLOURS + rng.normal(0, 0.5, COLOURS.shape) for rng in rng_of]
    alone = [measured(k, noise=0.02, drift=0.5) for k in range(6)]
    together = [pool_chromatic(one, alone[:k] + alone[k + 1 :]) for k, one in enumerate(alone)]
    for one, shared, truth in zip(alone, together, real, strict=True):
        assert off(shared, truth) < 1.2 * off(one, truth)


def test_what_all_bands_have_in_common_is_never_shared():
    alone = [measured(k, noise=0.001) for k in range(3)]
    moved = ChromaticShifts(
        "similarity", alone[0].centre, 210.0, alone[0].amounts + 2.0, alone[0].variances
    )
    shared = pool_chromatic(moved, alone[1:])
    np.testing.assert_allclose(shared.amounts.mean(0), moved.amounts.mean(0), atol=0.01)


def test_one_capture_alone_and_bands_never_measured_come_back_as_they_are():
    one = measured(0)
    assert pool_chromatic(one, []) is one
    blind = ChromaticShifts("similarity", one.centre, 210.0, one.amounts, None)
    np.testing.assert_array_equal(pool_chromatic(blind, [blind]).amounts, one.amounts)


# --- what is kept -----------------------------------------------------------------------------


@pytest.mark.parametrize("observed", [True, False])
def test_a_sighting_comes_back_from_its_arrays_as_it_was(observed):
    one = sighting(3, labels=("a", "b"))
    if not observed:
        one = SensorObservations("left", ("a", "b"), Affine.identity(), colour(2))
    again = SensorObservations.from_arrays(one.to_arrays())
    assert (again.sensor, again.labels, again.terms) == (one.sensor, one.labels, one.terms)
    assert json.dumps(again.base.to_dict()) == json.dumps(one.base.to_dict())
    np.testing.assert_array_equal(again.chromatic.variances, one.chromatic.variances)
    if observed:
        np.testing.assert_array_equal(again.observations.information, one.observations.information)


def test_an_enlarged_sighting_speaks_of_the_larger_pixels():
    one = sighting(2)
    grow = Affine(np.array([[4.0, 0, 1.5], [0, 4.0, 1.5]]))
    large = one.enlarged(grow)
    points = one.observations.points[:5]
    np.testing.assert_allclose(large.base(points), grow(one.base(points)))
    np.testing.assert_allclose(
        large.observations.residuals(large.base), one.observations.residuals(one.base), atol=1e-9
    )
