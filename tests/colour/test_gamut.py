import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from levkas.colour.gamut import gamut_cells, lab_colours, lab_of, munsell_lab, xyz_to_lab
from levkas.colour.observer import read_table
from levkas.colour.srgb import SRGB_TO_XYZ, encode_srgb
from levkas.publish.swatches import _joined, draw_gamut


def test_lab_of_greys_is_their_lightness():
    waves = np.arange(400, 721, 20.0)
    lab = lab_of(np.full((2, len(waves)), 0.184187), waves)
    assert lab == pytest.approx(np.array([[50.0, 0, 0]] * 2), abs=0.02)


@pytest.mark.slow
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


def test_munsell_greys_reds_and_greens_lie_where_they_should():
    lab = munsell_lab()
    assert lab.shape == (2734, 3)
    assert 5 < lab[:, 0].min() < 15 and 88 < lab[:, 0].max() < 95
    assert lab[:, 1].max() > 60 and lab[:, 1].min() < -50 and lab[:, 2].max() > 80


def test_a_view_shows_cells_in_their_colour():
    cells = gamut_cells(np.array([[53.24, 80.09, 67.2]]))  # sRGB's red
    picture = draw_gamut(cells, np.zeros((0, 3)))
    red = (picture == lab_colours(cells[:, :3])[0]).all(-1)
    assert red.sum() == 3 * 9 and picture.dtype == np.uint8


def test_cells_of_several_layers_are_added():
    one = gamut_cells(np.array([[50.0, 0, 0]] * 3))
    two = gamut_cells(np.array([[50.0, 0, 0], [9, 9, 9]]))
    assert _joined(one, two).tolist() == [[9, 9, 9, 1], [50, 0, 0, 4]]
