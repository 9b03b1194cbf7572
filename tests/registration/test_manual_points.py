"""Pairs by hand: kept whatever their error, never used once deleted, measured and never fitted."""

import numpy as np
import pytest

from levkas.geometry.transforms import Affine, Homography
from levkas.registration import BandImage, register
from levkas.registration.manual_points import ManualPoints
from levkas.registration.outliers import RemovalTerms, clean
from levkas.registration.starts import fit_initial_transform

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
