"""Black levels by phase, as DNG 1.7 states them."""

from fractions import Fraction

import numpy as np
import pytest
import tifffile

from levkas.readers.frames import read_facts, read_frame

SIZE = (36, 48)
BASE = [
    (50706, "B", 4, (1, 4, 0, 0), True),
    (50708, "s", 0, "Levkas test", True),
    (33421, "H", 2, (2, 2), True),
    (33422, "B", 4, (0, 1, 1, 2), True),
    (50717, "I", 1, 4095, True),
    (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
    (50778, "H", 1, 21, True),
    (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
]


def rationals(numbers):
    pairs = (Fraction(n).limit_denominator(1000) for n in numbers)
    return tuple(part for f in pairs for part in (f.numerator, f.denominator))


def write(path, levels=(), repeat=(), *, rows=(), columns=(), area=()):
    """Write a frame that holds nothing but what its tags declare as black."""
    tags = list(BASE)
    if repeat:
        tags.append((50713, "H", 2, repeat, True))
    if len(levels):
        tags.append((50714, "2I", len(levels), rationals(levels), True))
    for code, delta in ((50715, columns), (50716, rows)):
        if len(delta):
            tags.append((code, "2i", len(delta), rationals(delta), True))
    if area:
        tags.append((50829, "I", 4, area, True))
    codes = np.arange(np.prod(SIZE), dtype=np.uint16).reshape(SIZE) + 64
    tifffile.imwrite(path, codes, photometric=32803, extratags=tags, metadata=None)
    return path


@pytest.mark.parametrize("suffix", [".dng", ".tif"])
@pytest.mark.parametrize("repeat", [(1, 1), (2, 2), (1, 2), (6, 6)])
def test_the_black_of_every_sensel_is_that_of_its_phase(tmp_path, repeat, suffix):
    levels = np.random.default_rng(7).integers(40, 90, repeat[0] * repeat[1])
    facts = read_facts(write(tmp_path / f"a{suffix}", levels.tolist(), repeat))
    truth = np.resize(levels.reshape(repeat), repeat)[
        np.arange(SIZE[0])[:, None] % repeat[0], np.arange(SIZE[1]) % repeat[1]
    ]
    assert facts.black_unclear is None
    assert facts.black == pytest.approx(truth.mean(), abs=1e-3)
    found = np.full(SIZE, facts.black) if facts.blacks is None else facts.blacks.plane(SIZE)
    assert np.allclose(found, truth, atol=1e-3)


def test_levels_belong_to_the_visible_area(tmp_path):
    area = (2, 4, 34, 47)  # top, left, bottom, right
    facts = read_facts(write(tmp_path / "a.dng", (60, 64, 66, 110), (2, 2), area=area))
    assert facts.shape == read_frame(tmp_path / "a.dng").shape == (32, 43)
    assert facts.blacks.plane(facts.shape)[:2, :2].tolist() == [[60, 64], [66, 110]]


@pytest.mark.parametrize(
    "stated",
    [
        {"levels": (60, 64, 66), "repeat": (2, 2)},
        {"levels": (64,), "rows": range(36)},
        {"levels": (64,), "columns": range(48)},
        {"levels": (5000, 5001), "repeat": (1, 2)},
        {"levels": (60, 64), "repeat": (1, 2), "area": (2, 1, 34, 47)},
    ],
    ids=str,
)
def test_levels_that_are_not_read_or_do_not_fit_the_frame_are_told(tmp_path, stated):
    facts = read_facts(write(tmp_path / "a.tif", **stated))
    assert facts.black is None and facts.blacks is None and facts.black_unclear


def test_equal_levels_are_one_number(tmp_path):
    facts = read_facts(write(tmp_path / "a.tif", (64, 64, 64, 64)))
    assert (facts.black, facts.blacks, facts.pattern) == (64.0, None, "RGGB")
