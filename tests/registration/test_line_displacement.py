"""Lines that are displaced against one another, as windows do not see them: scanners made by scipy, line by line."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import ndimage

from levkas.geometry.transforms import Affine
from levkas.registration import register
from levkas.registration.line_correction import LineCorrection, find_correction
from levkas.registration.line_course import LineShifts, find_displacement
from levkas.registration.line_displacement import measure_line_displacement
from levkas.registration.local_shifts import highpass
from levkas.registration.verdict_rules import lines_lie_still

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


@pytest.mark.parametrize("way", [along, across])
@pytest.mark.parametrize(("size", "period"), [(1.5, 60), (0.3, 20), (0.2, 7), (1.0, 3), (0.6, 110)])
def test_a_wobble_of_the_stage_is_found_with_its_size(painting, front, way, size, period):
    found = measured(front, scan(painting, way(sine(size, period))))
    assert (found.displaced, found.lines) == (True, "rows")
    # A cubic along the scan takes its part of long periods, and what strays counts less.
    assert found.rms == pytest.approx(size / 2**0.5, rel=0.15, abs=0.02)
    assert (found.along > 3 * found.across) == (way is along)


def test_a_weak_wobble_of_a_noisy_scan_is_found(painting, front):
    for seed in range(4):
        found = measured(front, scan(painting, across(sine(0.4, 9)), noise=0.06, seed=seed))
        assert found.displaced and found.rms == pytest.approx(0.4 / 2**0.5, rel=0.3)


@pytest.mark.parametrize("apart", [0.2, 1.0, 2.0, 4.0])
def test_interlaced_halves_are_found_with_their_distance(painting, front, apart):
    found = measured(front, scan(painting, along(apart * (LINE % 2 - 0.5))))
    assert (found.picture, found.displaced) == ("target", True)
    assert found.rms == pytest.approx(apart / 2, rel=0.08)


@pytest.mark.parametrize("lost", [1, 2])
def test_lines_that_are_lost_or_repeated_are_found_where_they_are(painting, front, lost):
    whole = scan(painting, lines=242)
    for picture, way in (
        (np.delete(whole, np.arange(120, 120 + lost), 0), 1),
        (np.insert(whole, 120, np.repeat(whole[120:121], lost, 0), 0), -1),
    ):
        # The map lies in the middle: half of the lines are off one way, half the other.
        place = turned(0.6, (4.0, 6.0 - way * lost / 2))
        found = measured(front, picture[:238], place)
        assert found.displaced and 0.1 * lost < found.rms < 0.5 * lost
        step = np.nanmedian(found.displacement[130:160, 1] - found.displacement[80:110, 1])
        assert np.sign(step) == way


def test_random_lines_and_a_saw_tooth_are_found(painting, front):
    jitter = np.random.default_rng(5).normal(0, 0.3, (240, 2))
    found = measured(front, scan(painting, jitter))
    assert found.displaced and found.rms == pytest.approx(0.3 * 2**0.5, rel=0.12)
    found = measured(front, scan(painting, across(1.2 * ((LINE / 30) % 1 - 0.5))))
    assert found.displaced and found.rms == pytest.approx(1.2 / 12**0.5, rel=0.15)


def test_columns_of_a_scanner_on_its_side_are_lines_too(painting, front):
    picture = scan(painting, across(sine(0.5, 25)))
    swap = Affine(STRAIGHT.matrix[::-1])
    found = measured(front, np.ascontiguousarray(picture.T), swap)
    assert (found.lines, found.displaced) == ("columns", True)


def test_lines_of_the_reference_are_told_from_those_of_a_turned_picture(studio, painting):
    place = turned(25, (60.0, -30.0))
    wobbling = scan(painting, along(sine(0.6, 16)), Affine.identity())
    still = studio.photograph(painting, place.inverse, SIZE, seed=3, noise=0.004)
    found = measured(wobbling, still, place)
    assert (found.picture, found.lines) == ("reference", "rows")
    assert found.rms == pytest.approx(0.6 / 2**0.5, rel=0.15)


def test_a_slow_wobble_of_parallel_pictures_may_be_of_either(painting, front):
    still = scan(painting, None, turned(0.0))
    wobbling = scan(painting, across(sine(0.6, 60)), Affine.identity(), noise=0.002)
    assert measured(wobbling, still, turned(0.0)).picture == "either"


def test_sizes_are_in_px_of_the_reference(studio, painting, front):
    twice = turned(0.4, (3.0, 2.0), 2.0)
    x, y = np.meshgrid(np.arange(600.0), np.arange(460.0))
    places = twice.inverse(np.stack([(x + sine_of(460, 1.0, 40)).ravel(), y.ravel()], 1)) + MARGIN
    observed = ndimage.map_coordinates(painting, places.T[::-1], order=3).reshape(x.shape)
    found = measured(front, observed.astype(np.float32), twice)
    assert found.rms == pytest.approx(0.5 / 2**0.5, rel=0.1)


def sine_of(lines, size, period):
    return size * np.sin(2 * np.pi * np.arange(lines)[:, None] / period)


@pytest.mark.parametrize("noise", [0.002, 0.02, 0.06])
def test_nothing_is_found_where_lines_lie_still(painting, front, noise):
    for seed in range(8):
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
    assert lines_lie_still({"line_displacement": measured(front, observed).to_dict()}) is None


def test_some_lines_alone_make_a_map_doubtful(painting, front):
    shift = np.zeros((240, 2))
    shift[60:67], shift[180:184] = (3.0, 0.0), (0.0, -0.7)
    found = measured(front, scan(painting, shift))
    assert (found.displaced, found.lines) == (True, "rows")
    assert lines_lie_still({"line_displacement": found.to_dict()}).decision == "warn"


def test_a_wobble_in_a_part_of_the_lines_makes_a_map_doubtful(painting, front):
    some = (LINE > 100) & (LINE < 150)
    found = measured(front, scan(painting, across(sine(1.5, 20) * some)))
    assert found.rms == pytest.approx(1.5 * (49 / 480) ** 0.5, rel=0.15)
    assert lines_lie_still({"line_displacement": found.to_dict()}).decision == "warn"


def along_line(ends):
    """Return displacements (240, 310) that grow along each line from minus to plus `ends`, (240,) px."""
    return ends[:, None] * np.linspace(-1, 1, 310)


@pytest.mark.parametrize(
    ("size", "period"), [(2.0, 60), pytest.param(0.5, 25, marks=pytest.mark.exhaustive), (1.5, 8)]
)
@pytest.mark.parametrize("way", ["turn", "stretch"])
def test_a_stage_that_turns_or_stretches_its_lines_is_found(painting, front, way, size, period):
    change = along_line(sine(size, period))
    x, y = np.meshgrid(np.arange(310.0), np.arange(240.0))
    x, y = (x, y + change) if way == "turn" else (x + change, y)
    places = STRAIGHT.inverse(np.stack([x.ravel(), y.ravel()], 1)) + MARGIN
    observed = ndimage.map_coordinates(painting, places.T[::-1], order=3).reshape(x.shape)
    found = measured(front, noisy(observed, 3, 0.5))
    assert (found.displaced, found.lines, found.slope) == (True, "rows", True)
    assert found.rms == pytest.approx(size / 6**0.5, rel=0.2)
    assert lines_lie_still({"line_displacement": found.to_dict()}).decision == "warn"


@pytest.mark.parametrize("quality", [80, 40, 20])
def test_blocks_of_jpeg_displace_no_lines(painting, front, quality):
    pictures = []
    for observed in (front, scan(painting)):
        codes = np.clip(300 * observed, 0, 255).astype(np.uint8)
        coded = cv2.imencode(".jpg", codes, [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
        pictures.append(cv2.imdecode(coded, 0).astype(np.float32))
    found = measured(*pictures)
    assert lines_lie_still({"line_displacement": found.to_dict()}) is None


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
    "side", [8, 20, 48, *(pytest.param(n, marks=pytest.mark.exhaustive) for n in (12, 32))]
)
def test_edges_of_tiles_displace_no_lines_beside_them(side, blur, noise):
    """Lines between edges hold noise alone, which seems to lie anywhere but beyond the edges, in all parts alike."""
    one, other = noisy(tiles(side), 1, noise), noisy(tiles(side, blur), 2, noise)
    found = measured(one, other, Affine.identity())
    assert not found.displaced


def test_tiles_show_a_wobble_along_the_lines_and_say_nothing_across_them():
    y = np.arange(480)[:, None]
    wobbling = tiles(20, shift=0.5 * np.sin(2 * np.pi * y / 60))
    found = measured(noisy(tiles(20), 1), noisy(wobbling, 2), Affine.identity())
    assert found.displaced and found.rms == pytest.approx(0.5 / 2**0.5, rel=0.15)
    assert found.common_edges and found.across == 0.0 and found.to_dict()["common_edges"]


def framed(painting):
    """Return a painting between bars that run along the lines, as an icon is scanned towards its frame."""
    found = painting.copy()
    for first in (6, 15, 24, 33, 42, 196, 205, 214):
        found[MARGIN + first : MARGIN + first + 9] = 0.9 if first % 2 else 0.05
    return found


def test_a_frame_along_the_lines_hides_no_wobble_across_them(studio, painting):
    panel = framed(painting)
    front = studio.photograph(panel, Affine.identity(), seed=1)
    found = measured(front, scan(panel, across(sine(0.8, 40))))
    assert (found.lines, found.displaced) == ("rows", True)
    painted = slice(56, 190)
    left = find_correction(found, 1.0).shift[painted, 1] - sine(0.8, 40)[painted]
    smooth = np.polynomial.legendre.legvander(np.linspace(-1, 1, len(left)), 3)
    left = left - smooth @ np.linalg.lstsq(smooth, left, rcond=None)[0]  # a map is smooth, too
    assert np.sqrt(np.mean(left**2)) < 0.1
    assert not measured(front, scan(panel)).displaced


@pytest.mark.parametrize(("information", "least", "most"), [(6.0, 0, 2), (80.0, 20, 20)])
def test_lines_at_the_rim_that_show_next_to_nothing_are_not_displaced(information, least, most):
    found = 0
    for seed in range(20):
        rng = np.random.default_rng(seed)
        shift, known = rng.normal(0, 0.1, (200, 4, 2)), rng.uniform(60, 100, (200, 4, 2))
        shift[190:198, :, 1] += rng.normal(0, 4, (8, 1))
        known[190:198] = information
        shifts = LineShifts.of(shift, known, np.array([10.0, 50, 150, 190]), (0.0, 200.0))
        found += find_displacement(shifts, np.ones(2))[0]
    assert least <= found <= most


def test_too_few_lines_are_not_measured(front):
    blank = measured(front, np.full((240, 310), 0.5, np.float32))
    assert blank is None or not blank.displaced
    assert measured(front[:20], front[:20], Affine.identity()) is None


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


@pytest.mark.parametrize("way", [along, across])
@pytest.mark.parametrize(
    "course",
    [
        *(sine(1.5, 20), walk(1.0), 1.0 * (LINE > 120)),
        *(pytest.param(sine(1.5, n), marks=pytest.mark.exhaustive) for n in (60, 200)),
    ],
)
def test_lines_are_found_where_the_stage_put_them(painting, front, way, course):
    planted = way(course)
    found = put_right(front, scan(painting, planted))
    left = np.abs(beside_cubic(found.shift - planted)).sum(1)
    assert left.mean() < 0.08 and np.quantile(left, 0.95) < 0.25
    assert found.error < 0.12


def test_odd_and_even_lines_are_each_found(painting, front):
    found = put_right(front, scan(painting, along(1.5 * (LINE % 2 - 0.5))))
    odd, even = found.shift[17:224:2, 0], found.shift[16:224:2, 0]
    assert np.median(odd) - np.median(even) == pytest.approx(1.5, abs=0.08)
    assert found.spacing == 1 and found.uneven == pytest.approx(0.75, rel=0.1)


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


@pytest.mark.parametrize("lines", ["rows", "columns"])
def test_a_correction_puts_every_line_where_it_lies(lines):
    shift = np.stack([0.7 * sine(1, 15), sine(1.0, 40)], 1)
    still = np.zeros_like(shift)
    correction = LineCorrection(lines, shift, still, (0.0, 309.0), 4.0, 0.0, 1.0, None)
    number = np.arange(10, 230.0)
    right = np.stack([np.full(220, 50.0), number], 1) + shift[10:230]
    there = np.stack([np.full(220, 50.0), number], 1)
    if lines == "columns":
        right, there = right[:, ::-1], there[:, ::-1]
    assert np.abs(correction.transform()(right) - there).max() < 0.02
    half = replace(correction, shift=shift / 2)
    twice = half.followed_by(replace(half, shift=shift / 2))
    assert np.abs(twice.shift - shift)[10:230].max() < 0.1


def test_nothing_is_put_right_where_parts_of_lines_disagree(painting, front):
    found = measured(front, scan(painting, along(sine(1.0, 40))))
    noise = np.random.default_rng(1).normal(0, 0.3, found.parts.shift.shape)
    apart = replace(found, parts=replace(found.parts, shift=noise))
    assert find_correction(apart, 1.0) is None


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
    numbers = wobbling.verdict.numbers["sensor"]["verification"]["line_correction"]
    assert numbers["before"]["rms_px"] == pytest.approx(1 / 2**0.5, rel=0.1)
    drawn = wobbling.basis["sensors"][0]["lines"]
    assert len(drawn["along"]) == 240


@pytest.mark.slow
@pytest.mark.parametrize(
    "planted",
    [
        across(walk(1.0)),
        *(
            pytest.param(one, marks=pytest.mark.exhaustive)
            for one in (across(sine(1.5, 20)), along(1.0 * (LINE % 2 - 0.5)))
        ),
    ],
)
def test_a_map_follows_what_lines_do(painting, front, planted):
    errors, _ = errors_of(register(front, scan(painting, planted)), planted)
    assert np.linalg.norm(errors, axis=1).mean() < 0.1


def test_rows_and_columns_that_are_displaced_both_are_named_and_one_of_them_is_followed(
    painting, front
):
    x, y = np.meshgrid(np.arange(310.0), np.arange(240.0))
    moved = np.stack([x + np.sin(2 * np.pi * y / 40), y + 0.5 * np.sin(2 * np.pi * x / 30)], -1)
    places = STRAIGHT.inverse(moved.reshape(-1, 2)) + MARGIN
    shown = ndimage.map_coordinates(painting, places.T[::-1], order=3).reshape(x.shape)
    noise = np.random.default_rng(2).normal(0, 0.004, x.shape)
    found = register(front, (shown + noise).astype(np.float32))
    assert found.verdict.decision == "warn"
    numbers = found.verdict.numbers["sensor"]["verification"]
    assert numbers["line_correction"]["lines"] == "rows"
    assert numbers["line_displacement"]["lines"] == "columns"


@pytest.mark.slow
def test_sigma_holds_the_displacement_of_lines(painting, front):
    still = register(front, scan(painting))
    assert still.verdict.decision == "accept"
    assert still.basis["sensors"][0]["lines"] is None
    assert np.median(still.sigma["1"].values) < 0.05
    halves = register(front, scan(painting, along(LINE % 2 - 0.5)))
    assert halves.sigma["1"].values.min() == pytest.approx(0.37, rel=0.1)  # of either axis


@pytest.mark.slow
@pytest.mark.parametrize(("apart", "decision"), [(0.5, "warn"), (3.0, "refuse")])
def test_interlaced_halves_are_never_accepted(painting, front, apart, decision):
    found = register(front, scan(painting, along(apart * (LINE % 2 - 0.5))))
    assert found.verdict.decision == decision


def test_less_than_the_limit_is_accepted_and_named(painting, front):
    found = register(front, scan(painting, along(0.12 * (LINE % 2 - 0.5)), noise=0.002))
    assert found.verdict.decision == "accept" and found.verdict.next_step == ""
    lines = found.verdict.numbers["sensor"]["verification"]["line_displacement"]
    assert lines["rms_px"] == pytest.approx(0.06, rel=0.2)
    assert found.sigma["1"].values.min() > 0.04


def test_the_papers_method_looks_at_lines_too(painting, front):
    found = register(front, scan(painting, across(sine(0.6, 30))), method="mirhashemi2019")
    assert found.verdict.decision == "warn"
    assert found.verdict.numbers["line_displacement"]["displaced"]
