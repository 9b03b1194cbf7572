"""Pairs of another program are candidates of a start: right ones among wrong ones help, wrong ones alone change nothing."""

import numpy as np
import pytest

from levkas.geometry.transforms import Affine
from levkas.registration import BandImage, RegistrationRefused, register
from levkas.registration.manual_points import ManualPoints
from levkas.registration.starts import start_candidates

INSIDE = np.array([[60.0, 50.0], [220.0, 160.0]])


@pytest.fixture(scope="module")
def hard(studio):
    """A reference, a target on its side at 0.4 of the sampling in much noise, and the map: the pictures alone are refused."""
    angle, scale = np.deg2rad(137), 0.4
    rows = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    corners = np.array([[0, 0], [299, 0], [299, 229], [0, 229]]) @ rows.T
    size = np.ceil(np.ptp(corners, axis=0)).astype(int)
    truth = Affine(np.column_stack([rows, -corners.min(0)]))
    painting = studio.paint(11)
    reference = studio.photograph(painting, Affine.identity(), seed=5)
    target = studio.photograph(painting, truth.inverse, tuple(size.tolist()), seed=2, noise=0.2)
    return BandImage.of("r", reference), BandImage.of("heat", target), truth


def candidates(truth, rng, right, wrong):
    """Pairs of which some are right to 1 px, in any order."""
    places = rng.uniform(20, 210, (right, 2))
    good = np.hstack([places, truth(places) + rng.normal(0, 0.4, (right, 2))])
    bad = np.hstack([rng.uniform(0, 230, (wrong, 2)), rng.uniform(0, 110, (wrong, 2))])
    return rng.permutation(np.vstack([good, bad]))


def refusal(reference, target, **options):
    with pytest.raises(RegistrationRefused) as refused:
        register([reference], [target], reference_band="r", **options)
    return refused.value.problems


@pytest.mark.slow
def test_pairs_of_which_two_in_five_are_wrong_register_what_the_pictures_alone_do_not(hard):
    reference, target, truth = hard
    assert refusal(reference, target)[0].code == "E_MATCHES"
    starts = candidates(truth, np.random.default_rng(4), 30, 20)
    given = {"": ManualPoints(starts=starts)}
    found = register([reference], [target], reference_band="r", given=given)
    np.testing.assert_allclose(found.transforms["heat"](INSIDE), truth(INSIDE), atol=0.4)
    assert found.verdict.decision != "refuse"
    counted = found.errors["sensors"][""]["start_pairs"]
    assert counted["given"] == 50 and 30 <= counted["agreeing"] <= 31 and counted["used"]


def test_sets_of_pairs_are_tried_from_the_largest_to_the_smallest():
    rng = np.random.default_rng(2)
    p = rng.uniform(0, 300, (30, 2))
    pairs = np.vstack(
        [np.hstack([p[:12], p[:12] + 9]), np.hstack([p[12:], p[12:] * [-1, 1] + [300, 0]])]
    )
    first, second = start_candidates(pairs, (300, 300))
    assert (first.count, first.mirrored, second.count, second.mirrored) == (18, True, 12, False)
    assert not list(start_candidates(pairs[:5], (300, 300)))
    (coarse,) = start_candidates(np.hstack([p, p / 20]), (300, 300))
    assert coarse.scale == pytest.approx(1 / 20)
