"""Lines that are displaced against one another, as windows do not see them: scanners made by scipy, line by line."""

import cv2
import numpy as np
import pytest
from scipy import ndimage

from levkas.geometry.transforms import Affine
from levkas.registration import register
from levkas.registration.line_correction import find_correction
from levkas.registration.line_displacement import measure_line_displacement
from levkas.registration.local_shifts import highpass

MARGIN = 60  # of the painting about the reference, as in conftest
SIZE = (300, 230)
LINE = np.arange(240)


def turned(degrees, shift=(4.0, 6.0), scale=1.0):
    """Return reference px → scan px."""
    angle = np.deg2rad(degrees)
    rows = scale * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return Affine(np.column_stack([rows, shift]))


STRAIGHT = turned(0.6)


@pytest.fixture(scope="module")
def painting(studio):
    return studio.paint(41)


@pytest.fixture(scope="module")
def front(studio, painting):
    return studio.photograph(painting, Affine.identity(), seed=1)


def scan(painting, shift=None, transform=STRAIGHT, *, lines=240, noise=0.004, seed=2, gain=1.0):
    """Return what a scanner sees whose every line is off by its row of `shift`, (lines, 2) px."""
    x, y = np.meshgrid(np.arange(310.0), np.arange(float(lines)))
    if shift is not None:
        x, y = x + shift[:, :1], y + shift[:, 1:]
    places = transform.inverse(np.stack([x.ravel(), y.ravel()], 1)) + MARGIN
    observed = ndimage.map_coordinates(painting, places.T[::-1], order=3, mode="nearest")
    observed = gain * observed.reshape(x.shape)
    return (observed + np.random.default_rng(seed).normal(0, noise, x.shape)).astype(np.float32)


def along(course):
    return np.stack([course, 0 * course], 1)


def across(course):
    return along(course)[:, ::-1]


def sine(size, period):
    return size * np.sin(2 * np.pi * LINE / period + 1)


def measured(front, picture, transform=STRAIGHT):
    return measure_line_displacement(highpass(front)[None], picture, transform)


def some(course, first, last):
    return course * ((first < LINE) & (last > LINE))


JITTER = np.random.default_rng(5).normal(0, 0.3, (240, 2))


@pytest.mark.parametrize(
    ("shift", "rms"),
    [
        (along(sine(1.5, 60)), 1.5 / 2**0.5),
        (across(sine(0.3, 20)), 0.3 / 2**0.5),
        (along(sine(0.2, 7)), 0.2 / 2**0.5),
        (across(sine(1.0, 3)), 1 / 2**0.5),
        (across(some(sine(1.5, 20), 100, 150)), 1.5 * (49 / 480) ** 0.5),
        (along(0.2 * (LINE % 2 - 0.5)), 0.1),  # interlaced halves
        (along(4.0 * (LINE % 2 - 0.5)), 2.0),
        (across(1.2 * ((LINE / 30) % 1 - 0.5)), 1.2 / 12**0.5),
        (JITTER, 0.3 * 2**0.5),
    ],
)
def test_lines_are_found_displaced_by_what_was_planted(painting, front, shift, rms):
    found = measured(front, scan(painting, shift))
    assert (found.displaced, found.lines) == (True, "rows")
    # A cubic along the scan takes its part of long periods, and what strays counts less.
    assert found.rms == pytest.approx(rms, rel=0.15, abs=0.02)
    if shift is not JITTER:
        assert (found.along > 3 * found.across) == bool(shift[:, 0].any())


def test_columns_of_a_scanner_on_its_side_are_lines_too(painting, front):
    picture = scan(painting, across(sine(0.5, 25)))
    swap = Affine(STRAIGHT.matrix[::-1])
    found = measured(front, np.ascontiguousarray(picture.T), swap)
    assert (found.lines, found.displaced) == ("columns", True)


@pytest.mark.parametrize("noise", [0.002, 0.06])
def test_nothing_is_found_where_lines_lie_still(painting, front, noise):
    for seed in range(4):
        found = measured(front, scan(painting, noise=noise, seed=seed))
        assert not found.displaced and found.deviations < 3.5


def test_neither_lamp_nor_contrast_nor_stripes_displace_lines(painting, front):
    rng = np.random.default_rng(7)
    flicker = 1 + 0.1 * rng.normal(size=(240, 1))
    banded = flicker * scan(painting) + 0.05 * rng.normal(size=(240, 1))
    striped = scan(painting) * (1 + 0.05 * rng.normal(size=310))
    for picture in (banded, 0.9 - scan(painting), striped):
        assert not measured(front, picture.astype(np.float32)).displaced


def test_a_ledge_displaces_no_lines(painting, front):
    shift = np.zeros((240, 310, 2))
    shift[50:190, 60:250] = (0.6, 0.6)
    x, y = np.meshgrid(np.arange(310.0), np.arange(240.0))
    places = np.stack([(x + shift[..., 0]).ravel(), (y + shift[..., 1]).ravel()], 1)
    places = STRAIGHT.inverse(places) + MARGIN
    observed = ndimage.map_coordinates(painting, places.T[::-1], order=3).reshape(x.shape)
    assert not measured(front, observed).displaced


def along_line(ends):
    """Return displacements (240, 310) that grow along each line from minus to plus `ends`, (240,) px."""
    return ends[:, None] * np.linspace(-1, 1, 310)


@pytest.mark.parametrize("quality", [80, 20])
def test_blocks_of_jpeg_displace_no_lines(painting, front, quality):
    pictures = []
    for observed in (front, scan(painting)):
        codes = np.clip(300 * observed, 0, 255).astype(np.uint8)
        coded = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        pictures.append(cv2.imdecode(coded, 0).astype(np.float32))
    assert not measured(*pictures).displaced


def tiles(side, blur=0.0, shift=0.0, size=(480, 320)):
    """Return even tiles in a grid, (h, w), each line off by its row of `shift` along itself, px."""
    count = [n // side + 1 for n in size]
    tones = np.random.default_rng(7).permutation(np.geomspace(0.002, 1, count[0] * count[1]))
    picture = np.kron(tones.reshape(count), np.ones((side, side)))[: size[0], : size[1]]
    soft = cv2.GaussianBlur(picture, (0, 0), np.hypot(0.6, blur))
    y, x = np.mgrid[: size[0], : size[1]].astype(float)
    return ndimage.map_coordinates(soft, [y, x + shift], order=3, mode="nearest")


def noisy(picture, seed, noise=1.0):
    """Return what a sensor makes of a picture."""
    sigma = noise * (0.001 + 0.01 * np.sqrt(np.clip(picture, 0, None)))
    chance = np.random.default_rng(seed).normal(0, 1, picture.shape)
    return (picture + sigma * chance).astype(np.float32)


@pytest.mark.parametrize("noise", [1.0, pytest.param(4.0, marks=pytest.mark.exhaustive)])
@pytest.mark.parametrize("blur", [0.0, 1.0])
@pytest.mark.parametrize(
    "side", [20, *(pytest.param(n, marks=pytest.mark.exhaustive) for n in (8, 12, 32, 48))]
)
def test_edges_of_tiles_displace_no_lines_beside_them(side, blur, noise):
    """Lines between edges hold noise alone, which seems to lie anywhere but beyond the edges, in all parts alike."""
    one, other = noisy(tiles(side), 1, noise), noisy(tiles(side, blur), 2, noise)
    found = measured(one, other, Affine.identity())
    assert not found.displaced


def walk(size, smooth=3, seed=3):
    """Return a random walk, (240,) px, smooth over some lines and free of any period."""
    steps = np.random.default_rng(seed).normal(0, 1, 400)
    course = ndimage.gaussian_filter1d(np.cumsum(steps), smooth)[80:320]
    return size * (course - course.mean()) / course.std()


MIDDLE = slice(16, 224)  # lines that the reference shows whole


def put_right(front, picture, rounds=3):
    """Return the correction of a scan's lines under a map that lies right."""
    whole = None
    for _ in range(rounds):
        now = picture if whole is None else whole.put_right({"": picture})[""]
        found = measured(front, now)
        rest = find_correction(found, 1.0) if found.displaced else None
        if rest is None:
            return whole
        whole = rest if whole is None else whole.followed_by(rest)
    return whole


def beside_cubic(course):
    """Return what of a course, (240, 2), no smooth map follows, in the middle lines."""
    basis = np.polynomial.legendre.legvander(np.linspace(-1, 1, 240), 3)[MIDDLE]
    part = course[MIDDLE]
    return part - basis @ np.linalg.lstsq(basis, part, rcond=None)[0]


@pytest.mark.parametrize(
    ("way", "course"),
    [
        (along, sine(1.5, 20)),
        (across, walk(1.0)),
        (across, 1.0 * (LINE > 120)),
        pytest.param(along, sine(1.5, 60), marks=pytest.mark.exhaustive),
        pytest.param(across, sine(1.5, 200), marks=pytest.mark.exhaustive),
    ],
)
def test_lines_are_found_where_the_stage_put_them(painting, front, way, course):
    planted = way(course)
    found = put_right(front, scan(painting, planted))
    left = np.abs(beside_cubic(found.shift - planted)).sum(1)
    assert left.mean() < 0.08 and np.quantile(left, 0.95) < 0.25
    assert found.error < 0.12


@pytest.mark.parametrize("way", ["turn", "stretch"])
def test_lines_that_turn_or_stretch_are_put_right(painting, front, way):
    change = along_line(sine(1.5, 40))
    x, y = np.meshgrid(np.arange(310.0), np.arange(240.0))
    x, y = (x, y + change) if way == "turn" else (x + change, y)
    places = STRAIGHT.inverse(np.stack([x.ravel(), y.ravel()], 1)) + MARGIN
    observed = ndimage.map_coordinates(painting, places.T[::-1], order=3).reshape(x.shape)
    found = put_right(front, noisy(observed, 3, 0.5))
    line = np.arange(20.0, 220.0)
    for place in (30, 280):
        there = np.stack([np.full(len(line), float(place)), line], 1)
        moved = (found.transform().inverse(there) - there)[:, 1 if way == "turn" else 0]
        assert np.abs(moved - change[20:220, place]).mean() < 0.12


@pytest.fixture(scope="module")
def wobbling(painting, front):
    return register(front, scan(painting, along(sine(1.0, 40))))


def errors_of(found, planted, transform=STRAIGHT):
    """Return how far a map puts the pixels of a scan from what they show, (n, 2) reference px, and the places."""
    x, y = np.meshgrid(np.arange(8, 300, 4.0), np.arange(14, 226, 1.0))
    places = np.stack([x.ravel(), y.ravel()], 1)
    shown = transform.inverse(places + planted[places[:, 1].astype(int)])
    shown, places = (
        a[np.all((shown > 6) & (shown < np.array(SIZE) - 7), 1)] for a in (shown, places)
    )
    return found.transforms["1"].inverse(places) - shown, shown


def test_a_map_follows_a_wobbling_scan_and_its_record_has_the_size(wobbling):
    errors, places = errors_of(wobbling, along(sine(1.0, 40)))
    assert np.linalg.norm(errors, axis=1).mean() < 0.06
    sigma = wobbling.sigma["1"](places)
    assert 0.4 < np.sqrt(np.mean((errors / sigma[:, None]) ** 2)) < 1.4
    assert wobbling.verdict.decision == "accept"
    numbers = wobbling.verdict.numbers["sensor"]["line_correction"]
    assert numbers["before"]["rms_px"] == pytest.approx(1 / 2**0.5, rel=0.1)
    drawn = wobbling.basis["sensors"][0]["lines"]
    assert len(drawn["along"]) == 240


@pytest.mark.slow
@pytest.mark.parametrize(("apart", "decision"), [(0.5, "warn"), (3.0, "refuse")])
def test_interlaced_halves_are_never_accepted(painting, front, apart, decision):
    found = register(front, scan(painting, along(apart * (LINE % 2 - 0.5))))
    assert found.verdict.decision == decision
