"""Pairs by hand: kept whatever their error, never used once deleted, measured and never fitted."""

import numpy as np
import pytest

from levkas.geometry.transforms import Affine, Homography
from levkas.registration import BandImage, register
from levkas.registration.initial import fit_initial_transform
from levkas.registration.manual_points import ManualPoints, nearest_rows
from levkas.registration.outliers import RemovalTerms, clean
from levkas.registration.record import RegistrationRefused

SIZE = (800, 600)


def plant(n=300, wrong=60, seed=3):
    rng = np.random.default_rng(seed)
    target = rng.uniform(0, SIZE, (n, 2))
    reference = target + rng.normal(0, 0.2, (n, 2))
    bad = np.arange(n) < wrong
    reference[bad] += rng.uniform(8, 30, (wrong, 1)) * [[0.6, 0.8]]
    return target, reference, bad


def cleaned(target, reference, **options):
    return clean(
        target, reference, RemovalTerms(Affine.identity(), 60.0, 1.0), size=SIZE,
        target_size=SIZE, **options,
    )  # fmt: skip


def test_a_pinned_pair_stays_and_a_dropped_one_goes():
    target, reference, bad = plant()
    pinned, dropped = np.zeros(len(bad), bool), np.zeros(len(bad), bool)
    pinned[0], dropped[-1] = True, True
    found = cleaned(target, reference, pinned=pinned, dropped=dropped)
    assert found.kept[0] and not found.kept[-1]
    assert found.trace.kept_at(-1)[0] and not found.trace.kept_at(0)[-1]
    assert not found.kept[1:60].any()


def test_a_pair_pinned_beyond_reject_stays():
    target, reference, _ = plant(wrong=0)
    reference[0] += 500.0
    assert cleaned(target, reference, pinned=np.arange(300) == 0).kept[0]


def test_where_all_pairs_are_pinned_none_leaves():
    target, reference, bad = plant()
    found = cleaned(target, reference, pinned=np.ones(len(bad), bool))
    assert found.kept.all() and found.trace.rounds == 1


def test_masks_of_nothing_change_nothing():
    target, reference, bad = plant()
    nothing = np.zeros(len(bad), bool)
    plain, masked = (
        cleaned(target, reference, **o) for o in ({}, {"pinned": nothing, "dropped": nothing})
    )
    assert np.array_equal(plain.trace.removed, masked.trace.removed)
    assert np.array_equal(plain.model.coefficients, masked.model.coefficients)


def test_places_are_found_again_by_their_rounded_coordinates():
    rng = np.random.default_rng(0)
    exact = rng.uniform(0, 3000, (500, 4))
    assert np.array_equal(nearest_rows(exact.round(2), exact), np.arange(500))
    assert (nearest_rows(exact + np.array([0.05, 0, 0, 0]), exact) == -1).all()


@pytest.mark.parametrize(
    "matrix",
    [
        [[1.4, 0.3, 5], [-0.3, 1.4, 9], [0, 0, 1]],
        [[-1.4, 0.3, 900], [0.3, 1.4, 9], [0, 0, 1]],
        [[1.4, 0.3, 5], [-0.1, 2.2, 9], [0, 0, 1]],
        [[1.4, 0.3, 5], [-0.3, 1.4, 9], [4e-4, -2e-4, 1]],
    ],
    ids=["similarity", "mirrored", "affine", "homography"],
)
def test_four_pairs_start_what_they_lie_on(matrix):
    truth = Homography(np.array(matrix, float))
    corners = np.array([[50.0, 40], [700, 60], [720, 500], [30, 520]])
    found = fit_initial_transform(np.hstack([corners, truth(corners)]))
    inside = np.array([[300.0, 300], [100, 450]])
    assert np.linalg.norm(found.transform(inside) - truth(inside), axis=1).max() < 3.5
    assert found.mirrored == (matrix[0][0] < 0)


@pytest.fixture(scope="module")
def pair(studio):
    """A reference and a target through a known affine map, and that map."""
    truth = Affine(np.array([[0.99, 0.03, 4.0], [-0.03, 0.99, 7.0]]))
    painting = studio.paint(11)
    reference = studio.photograph(painting, lambda points: points, seed=1)
    target = studio.photograph(painting, truth.inverse, seed=2)
    return BandImage.of("550 nm", reference), BandImage.of("NIR", target), truth


def given_of(truth, points, kind="added", off=0.0):
    pairs = np.hstack([points, truth(points) + off])
    return {"": ManualPoints(**{kind: pairs})}


@pytest.mark.parametrize("method", ["levkas", "mirhashemi2019"])
def test_every_method_keeps_what_is_given_and_measures_check_points(pair, method):
    reference, target, truth = pair
    points = np.array([[60.0, 50], [240, 60], [230, 180], [70, 170]])
    pairs = np.hstack([points, truth(points)])
    hand = {"": ManualPoints(added=pairs[:2], checks=pairs[2:])}
    found = register([reference], [target], reference_band="550 nm", method=method, given=hand)
    rows = {tuple(r): (s, w) for r, s, w in zip(found.matches.reference.tolist(),
            found.matches.state, found.matches.reason, strict=True)}  # fmt: skip
    assert [rows[tuple(p)] for p in points[:2]] == [("kept", "added by hand")] * 2
    assert [rows[tuple(p)][0] for p in points[2:]] == ["check"] * 2
    errors = [row["error"] for row in found.errors["check_points"]]
    assert len(errors) == 2 and max(errors) < 0.3


@pytest.mark.slow
@pytest.mark.parametrize("method", ["levkas", "mirhashemi2019"])
def test_a_deleted_pair_is_not_used_and_says_so(pair, method):
    reference, target, _ = pair
    plain = register([reference], [target], reference_band="550 nm", method=method)
    row = int(np.flatnonzero(plain.matches.kept)[0])
    gone = np.concatenate([plain.matches.reference[row], plain.matches.target[row]])[None]
    hand = {"": ManualPoints(deleted=gone.round(2))}
    found = register([reference], [target], reference_band="550 nm", method=method, given=hand)
    at = nearest_rows(gone, np.hstack([found.matches.reference, found.matches.target]))[0]
    assert (found.matches.state[at], found.matches.reason[at]) == ("removed", "deleted by hand")


def test_three_pairs_are_not_enough_to_start_what_key_points_do_not(pair):
    reference, _, truth = pair
    rng = np.random.default_rng(0)
    noise = BandImage.of("NIR", rng.normal(0.5, 0.1, (230, 300)).astype(np.float32))
    hand = given_of(truth, np.array([[60.0, 50], [240, 60], [230, 180]]))
    with pytest.raises(RegistrationRefused) as refused:
        register([reference], [noise], reference_band="550 nm", given=hand)
    assert refused.value.problems[0].code == "E_MATCHES"


@pytest.mark.slow
def test_four_pairs_on_pictures_of_nothing_are_not_believed(pair):
    reference, _, truth = pair
    rng = np.random.default_rng(0)
    noise = BandImage.of("NIR", rng.normal(0.5, 0.1, (230, 300)).astype(np.float32))
    hand = given_of(truth, np.array([[60.0, 50], [240, 60], [230, 180], [70, 170]]))
    with pytest.raises(RegistrationRefused) as refused:
        register([reference], [noise], reference_band="550 nm", given=hand)
    assert refused.value.problems[0].code == "E_WINDOWS"
