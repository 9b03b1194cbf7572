"""What the verdict of the default method rests on: what is covered, repeats itself or is absurd."""

import numpy as np
import pytest

from levkas.geometry.transforms import Affine
from levkas.registration import BandImage, register
from levkas.registration.pose_clustering import find_pose_cluster
from levkas.registration.verification import verify

STILL = Affine.identity()


def turned(degrees, shift, mirror=False):
    """Return reference px → target px: a rotation about the origin, then a shift."""
    angle = np.deg2rad(degrees)
    rows = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    rows = rows @ np.diag([-1.0 if mirror else 1.0, 1.0])
    return Affine(np.column_stack([rows, shift]))


def run(reference, target):
    bands = [[BandImage.of("grey", image.astype(np.float32))] for image in (reference, target)]
    return register(*bands, reference_band="grey")


def grid(size, margin=20):
    x, y = np.meshgrid(*(np.arange(margin, n - margin, 12.0) for n in size))
    return np.stack([x.ravel(), y.ravel()], 1)


@pytest.fixture(scope="module")
def painting(studio):
    return studio.paint(31)


@pytest.fixture(scope="module")
def front(studio, painting):
    return studio.photograph(painting, STILL, seed=1)


def test_a_half_covered_object_is_accepted_and_the_covered_half_is_named(studio, painting, front):
    truth = turned(3, (6.0, -9.0))
    behind = studio.photograph(painting, truth.inverse, seed=2)
    cloth = studio.photograph(studio.paint(32), STILL, seed=3)
    shown = np.arange(studio.size[0]) < studio.size[0] // 2
    found = run(front, np.where(shown, behind, cloth))
    assert found.verdict.decision == "warn"
    points = grid(studio.size)
    valid = truth(points)[:, 0] < studio.size[0] // 2 - 5
    miss = np.linalg.norm(found.transforms["grey"](points) - truth(points), axis=1)
    assert miss[valid].mean() < 0.1
    numbers = found.verdict.numbers["sensor"]
    assert 0.3 < numbers["coverage"] < 0.7
    # Cells are 50 px wide: none that is named lies wholly in the half that shows the object.
    assert all(x + width > 120 for x, _, width, _ in numbers["unsupported"] + numbers["off"])


@pytest.mark.parametrize(("degrees", "mirror"), [(-130, False), (75, True)])
def test_any_rotation_and_the_mirror_are_found(studio, painting, front, degrees, mirror):
    middle = (np.array(studio.size) - 1) / 2
    truth = turned(degrees, (0, 0), mirror)
    truth = turned(degrees, middle - truth(middle[None])[0] + (4, -3), mirror)
    found = run(front, studio.photograph(painting, truth.inverse, seed=4))
    points = grid(studio.size, 60)
    assert np.linalg.norm(found.transforms["grey"](points) - truth(points), axis=1).mean() < 0.05
    assert found.verdict.decision != "refuse"


@pytest.mark.slow
def test_a_repeated_ornament_is_refused():
    rng = np.random.default_rng(5)
    tile = rng.uniform(0.2, 0.8, (31, 31))
    tile = sum(np.roll(tile, (i, j), (0, 1)) for i in range(3) for j in range(3)) / 9
    wall = np.tile(tile, (9, 11))
    views = [wall[y : y + 230, x : x + 300] for y, x in ((0, 0), (12, 19))]
    views = [view + rng.normal(0, 0.005, view.shape) for view in views]
    verdict = run(*views).verdict
    assert verdict.decision == "refuse"
    assert any("pattern repeats" in r or "wrong place" in r for r in verdict.reasons)


def test_a_map_that_folds_is_no_start(front):
    from levkas.geometry.transforms import Polynomial
    from levkas.registration.initial import is_plausible

    x = np.linspace(0, 299, 15)
    points = np.stack(np.meshgrid(x, x), -1).reshape(-1, 2)
    bent = np.stack([points[:, 0] * (1.2 - points[:, 0] / 299), points[:, 1]], 1)
    assert not is_plausible(Polynomial.fit(points, bent, order=2), (0, 0, 299, 299), False)


def test_a_map_that_is_wholly_off_is_borne_out_nowhere(front):
    image = front - np.mean(front)
    valid = np.ones(front.shape, bool)
    right, _ = verify(image[None], image, 1, STILL, valid, valid)
    # What another place shows is predicted as well as blocks of gains allow, and no more.
    wrong, _ = verify(image[None], np.roll(image, (70, 90), (0, 1)), 1, STILL, valid, valid)
    assert right["coverage"] == 1 and right["second_peak_ratio"] < 0.8
    assert wrong["found"] < 0.2 * right["found"]


def test_one_right_match_in_two_hundred_is_found():
    rng = np.random.default_rng(4)
    count, right = 6000, 30
    p, q = rng.uniform(0, 400, (2, count, 2))
    growth, turn = np.exp(rng.normal(0, 0.7, count)), rng.uniform(0, 360, count)
    p[:right] = rng.uniform(100, 300, (right, 2))
    q[:right] = 1.3 * p[:right] @ np.array([[0.0, 1], [-1, 0]]) + (500, 20)
    q[:right] += rng.normal(0, 2, (right, 2))
    growth[:right] = 1.3 * np.exp(rng.normal(0, 0.1, right))
    turn[:right] = 90 + rng.normal(0, 6, right) + 180 * rng.integers(0, 2, right)
    found = find_pose_cluster(p, q, growth, turn, rng.uniform(0, 1, count), 400)
    assert found[:right].mean() > 0.8
    assert found[right:].sum() < 20
