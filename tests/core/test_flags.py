"""Every flag has its word, its meaning and its colour, in the code, in the docs and on a map."""

import re
from pathlib import Path

import numpy as np

from levkas.core.cube import Band, Cube, Flag
from levkas.core.flags import MARKS, describe_marks
from levkas.database.layers import Layer, write_tiffs
from levkas.pages.maps import CLEAR, flag_map

DOCS = Path(__file__).resolve().parents[2] / "docs" / "conventions.md"


def test_every_flag_has_a_word_a_meaning_and_a_colour_of_its_own():
    assert set(MARKS) == set(Flag) and sum(mark["bit"] for mark in describe_marks()) == 255
    for part in ("word", "meaning", "colour"):
        assert len({getattr(mark, part) for mark in MARKS.values()}) == len(Flag)
    colours = np.array([CLEAR, *(mark.colour for mark in MARKS.values())], float)
    apart = np.linalg.norm(colours[:, None] - colours, axis=2) + 1e3 * np.eye(len(colours))
    assert apart.min() > 45
    assert not MARKS[Flag.VEILED].trusted


def test_the_docs_say_of_every_flag_what_the_table_says():
    rows = re.findall(r"^\| (\d+) \| ([^|]+) \| [^|]+ \| ([^|]+) \|$", DOCS.read_text(), re.M)
    reported = {int(bit): (word, usable != "no") for bit, word, usable in rows}
    assert reported == {m["bit"]: (m["word"], m["trusted"]) for m in describe_marks()}


def test_a_map_shows_every_flag_in_its_colour(tmp_path):
    flags = np.array([0, *Flag], np.uint8).reshape(1, -1, 1)
    cube = Cube(np.zeros(flags.shape, np.float32), flags, None, (Band("550 nm", 550.0),))
    write_tiffs(tmp_path / "a", Layer("icon1", "vis"), cube)
    image, palette, legend = flag_map(tmp_path / "a.flags.tif")
    assert [tuple(c) for c in palette[image[0]].tolist()] == [
        CLEAR,
        *(MARKS[flag].colour for flag in Flag),
    ]
    assert {name for name, _ in legend.entries} == {"no flag", *(m.meaning for m in MARKS.values())}
