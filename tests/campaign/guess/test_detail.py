import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.campaign.guess.detail import (
    compare_detail,
    find_detail,
    show_the_same,
    structured_share,
)

SHAPE = (180, 240)


def strokes(seed, shape=SHAPE, count=250):
    """Strokes of a painting, shares of one."""
    rng = np.random.default_rng(seed)
    picture = np.full(shape, 0.4, np.float32)
    for _ in range(count):
        x, y = rng.integers(0, shape[::-1]).tolist()
        end = int(x + rng.integers(-25, 25)), int(y + rng.integers(-25, 25))
        cv2.line(picture, (x, y), end, float(rng.uniform(0.1, 0.9)), int(rng.integers(2, 5)))
    return picture


def light(shape=SHAPE):
    """A fall-off to a half in the corners."""
    y, x = (np.linspace(-1, 1, n) for n in shape)
    return 1 - 0.25 * (x[None] ** 2 + y[:, None] ** 2)


def frame(shares, seed=0, full=3000.0, read=3.0):
    """Counts with shot noise of a gain of 0.5 e and read noise."""
    rng = np.random.default_rng(seed)
    counts = 60 + full * np.asarray(shares) * light(np.shape(shares))
    return (counts + rng.normal(0, np.sqrt(read**2 + 0.5 * counts))).round()


def test_bands_in_which_an_ink_fades_and_turns_around_show_the_same():
    parchment, ink = 0.6 + 0.1 * strokes(1), strokes(2) < 0.3
    bands = [
        find_detail(frame(parchment - fade * ink, seed))
        for seed, fade in enumerate((0.4, 0.1, -0.1))
    ]
    assert show_the_same(bands) is True


@pytest.mark.parametrize("full", [3000.0, 200.0])
def test_two_paintings_in_one_frame_do_not(full):
    pictures = []
    for seed in (3, 4):
        picture = np.full(SHAPE, 0.8, np.float32)  # one easel, one board
        picture[20:-20, 20:-20] = strokes(seed)[20:-20, 20:-20]
        pictures.append(find_detail(frame(picture, seed, full)))
    assert show_the_same(pictures) is False


def test_frames_of_several_lenses_are_compared_at_their_shift():
    scene = strokes(5, (200, 260))
    one, other = (
        find_detail(frame(scene[y : y + 180, x : x + 240], y)) for x, y in ((0, 0), (9, 7))
    )
    assert compare_detail(one, other).is_same is True


def test_what_shows_nothing_decides_nothing():
    blank = [find_detail(frame(np.full(SHAPE, 0.9), seed)) for seed in range(3)]
    assert show_the_same(blank) is None
    assert show_the_same([find_detail(np.ones((4, 5)))] * 2) is None


@pytest.mark.parametrize(
    "tile", [None, [[0.5, 1.0], [1.0, 0.4]], np.linspace(0.3, 1, 9).reshape(3, 3)]
)
@pytest.mark.parametrize("level", [0.0, 0.9])
def test_darks_and_whites_have_no_structure_behind_any_mosaic(tile, level):
    shares = np.full(SHAPE, level)
    if tile is not None:
        tall, wide = np.shape(tile)
        shares = shares * np.tile(tile, (SHAPE[0] // tall, SHAPE[1] // wide))
    detail = find_detail(frame(shares), period=0 if tile is None else len(tile))
    assert structured_share(detail) < 0.05
    painted = find_detail(
        frame(shares * strokes(6) + 0.01), period=0 if tile is None else len(tile)
    )
    assert structured_share(painted) > 0.4 or level == 0.0


def test_columns_of_a_line_scanner_are_no_structure():
    sensels = 1 + 0.1 * np.random.default_rng(0).normal(size=(1, 240))
    white = frame(0.9 * sensels * np.ones((60, 1)))
    assert structured_share(find_detail(white, along_lines=True)) < 0.05
    scan = frame(sensels * strokes(7)[:60])
    assert structured_share(find_detail(scan, along_lines=True)) > 0.4


@settings(max_examples=20)
@given(st.floats(0.2, 4), st.floats(0, 500), st.booleans())
def test_brightness_and_the_order_of_two_frames_do_not_matter(gain, offset, turned):
    one, other = frame(strokes(8), 1), gain * frame(1 - strokes(8), 2) + offset
    pair = [find_detail(v) for v in ((other, one) if turned else (one, other))]
    assert compare_detail(*pair).is_same is True
