"""What a verdict says of a map where nothing confirms it."""

import numpy as np
import pytest
from scipy import ndimage

from levkas.geometry.transforms import Affine, Polynomial
from levkas.pages.figures import draw_basis
from levkas.registration import BandImage, register
from levkas.registration.manual_points import ManualPoints
from levkas.registration.uncertainty import NINE_OF_TEN
from levkas.registration.window_matching import CheckWindows

STILL = Affine.identity()


def bent(size, amount):
    """Reference px → target px: bent by `amount` px at the lower rim, as a warped panel is."""
    x, y = np.meshgrid(np.linspace(0, size[0], 21), np.linspace(0, size[1], 21))
    points = np.stack([x.ravel(), y.ravel()], 1)
    down = points[:, 1] / size[1]
    field = amount * np.stack([down**3 - 0.3 * down, -(down**2)], 1)
    return Polynomial.fit(points, points + field, order=3)


@pytest.fixture(scope="module")
def half_blank(studio):
    """An infrared picture that shows nothing in its lower half, registered; and the truth."""
    painting, truth = studio.paint(51), bent(studio.size, 4.0)
    reference = studio.photograph(painting, STILL, seed=1)
    target = 1 - studio.photograph(painting, truth.inverse, seed=2)
    blank = ndimage.gaussian_filter(target, 30)
    blank += np.random.default_rng(3).normal(0, 0.004, target.shape)
    rows = np.arange(target.shape[0])[:, None]
    target = np.where(rows < target.shape[0] // 2, target, blank).astype(np.float32)
    bands = BandImage.of("550 nm", reference, 550), BandImage.of("NIR", target, 900)
    return register([bands[0]], [bands[1]], reference_band="550 nm"), truth


def halves(size):
    x, y = np.meshgrid(np.arange(12, size[0] - 12, 8.0), np.arange(12, size[1] - 12, 8.0))
    points = np.stack([x.ravel(), y.ravel()], 1)
    return points[points[:, 1] < size[1] * 0.4], points[points[:, 1] > size[1] * 0.6]


def test_a_map_that_reaches_over_half_of_the_object_is_doubtful_and_names_the_place(
    half_blank, studio
):
    found, _ = half_blank
    assert found.verdict.decision == "warn"
    numbers = found.verdict.numbers["NIR" if "NIR" in found.verdict.numbers else "sensor"]
    assert 0.4 < numbers["checked"] < 0.75
    _, y, width, height, share = numbers["unchecked"][0]
    # The lower half begins at 115; windows of 40 px confirm the map down to there.
    assert 90 < y < 175 and y + height > 215 and width > 250 and 0.25 < share < 0.6


def test_sigma_grows_where_nothing_was_checked(half_blank, studio):
    found, truth = half_blank
    above, below = halves(studio.size)
    # Errors of one map move together: one map tells the share badly.
    for points, most, least in ((above, 0.15, 0.75), (below, 8.0, 0.85)):
        error = np.linalg.norm(truth.inverse(found.transforms["NIR"](points)) - points, axis=1)
        sigma = found.sigma["NIR"](points)
        assert (error <= NINE_OF_TEN * sigma).mean() >= least
        assert np.median(sigma) < most
    assert np.median(found.sigma["NIR"](below)) > 5 * np.median(found.sigma["NIR"](above))


# --- what is recorded -------------------------------------------------------------------------


def test_check_points_are_measured_in_the_band_in_which_they_were_placed(studio):
    """Two bands 2 px apart by lateral colour: points placed in either are right in that one alone."""
    painting = studio.paint(12)
    maps = {
        "450 nm": Affine(np.array([[1.0, 0, 5.0], [0, 1.0, 3.0]])),
        "650 nm": Affine(np.array([[1.008, 0, 3.8], [0, 1.008, 2.1]])),
    }
    reference = BandImage.of("550 nm", studio.photograph(painting, STILL, seed=1), 550)
    target = [
        BandImage.of(label, studio.photograph(painting, truth.inverse, seed=3), float(label[:3]))
        for label, truth in maps.items()
    ]
    points = np.array([[250.0, 190], [40, 180], [230, 30]])
    checks = [np.hstack([points, truth(points)]) for truth in maps.values()]
    placed = ("450 nm",) * 3 + ("650 nm",) * 3
    hand = {"": ManualPoints(checks=np.concatenate(checks), placed=placed)}
    found = register([reference], target, reference_band="550 nm", given=hand)
    record = found.errors["check_points"]
    assert [one["band"] for one in record] == list(placed)
    assert max(one["error"] for one in record) < 0.15
    assert found.matches.residual[found.matches.state == "check"].max() < 0.15
    # In the sensor's first band all of them would be measured wrongly.
    apart = np.linalg.norm(maps["650 nm"](points) - maps["450 nm"](points), axis=1)
    assert apart.min() > 0.5


def test_the_trace_is_of_the_windows_that_the_map_rests_on(half_blank):
    found, _ = half_blank
    trace = found.to_dict()["trace"]
    (sensor,) = trace["sensors"]
    assert (trace["kind"], sensor["source"], sensor["band"]) == ("windows", "NIR", "NIR")
    windows, checks = sensor["windows"], CheckWindows.from_dict(sensor["checks"])
    held = np.array([v for v in windows["held_out"] if v is not None], float)
    assert 0.8 < len(held) / sensor["count"] <= 1
    shift = np.hypot(windows["shift_x"], windows["shift_y"])
    assert 0 < np.median(shift) <= np.median(held) < 1
    numbers = found.errors["sensors"][""]
    assert int(checks.confirmed.sum()) == numbers["agreeing"]
    (figure,) = draw_basis(trace, (300, 230))
    assert figure.svg.count("<use") >= len(checks.found)
