import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from levkas.colour.gamut import gamut_cells, lab_colours, xyz_to_lab
from levkas.colour.observer import read_table
from levkas.colour.srgb import SRGB_TO_XYZ, encode_srgb


def test_colour_science_gives_the_same_lab():
    import colour

    xyz = np.random.default_rng(1).random((50, 3))
    white = SRGB_TO_XYZ.sum(1)
    expected = colour.XYZ_to_Lab(xyz, white[:2] / white.sum())
    assert xyz_to_lab(xyz) == pytest.approx(expected, abs=1e-6)


def test_a_colour_and_its_lab_are_the_same_colour():
    linear = np.random.default_rng(4).random((200, 3))
    back = lab_colours(xyz_to_lab(linear @ SRGB_TO_XYZ.T))
    assert np.abs(back.astype(int) - encode_srgb(linear)).max() <= 1


@given(st.lists(st.tuples(*[st.floats(-80, 100)] * 3), min_size=1, max_size=40))
def test_every_colour_is_in_one_cell_and_counted_once(colours):
    cells = gamut_cells(np.array(colours))
    assert cells[:, 3].sum() == len(colours)
    nearest = np.abs(np.array(colours)[:, None] - cells[None, :, :3]).max(-1).min(1)
    assert nearest.max() <= 0.5 + 1e-9


def test_munsell_colours_are_those_of_colour_science():
    from colour.notation.datasets.munsell.real import MUNSELL_COLOURS_REAL

    theirs = [colour for _, colour in MUNSELL_COLOURS_REAL]
    np.testing.assert_array_equal(read_table("munsell_real.csv"), theirs)
