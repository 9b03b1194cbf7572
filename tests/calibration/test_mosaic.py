import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.calibration.mosaic import demosaic
from levkas.calibration.patterns import channel_names, channel_table, merge, split
from levkas.calibration.templates import CalibrationRefused
from levkas.core.cube import Flag

NINE = (("B1", "B2", "B3"), ("B4", "B5", "B6"), ("B7", "B8", "P"))
UNEVEN = (("A", "B", "A"), ("C", "A", "D"))
WIDE = (("A", "B", "C", "D", "E"), ("D", "E", "A", "B", "C"))
BAYER = ("RGGB", "BGGR", "GRBG", "GBRG")


def clear(shape):
    return np.zeros(shape, np.uint8)


EVERY = [(p, "normalised") for p in ("GBRG", NINE, UNEVEN, WIDE)] + [
    (p, "malvar") for p in BAYER[:2]
]


@pytest.mark.parametrize(("pattern", "method"), EVERY)
@pytest.mark.parametrize("shape", [(70, 83), (13, 11)])
def test_planes_are_exact_in_every_channel_up_to_the_border(pattern, method, shape):
    y, x = np.mgrid[: shape[0], : shape[1]]
    plane = (3 * x - 2 * y + 5).astype(np.float32)
    made, _, _ = demosaic(plane, clear(shape), None, pattern, method=method)
    assert made.shape == (*shape, len(channel_names(pattern)))
    np.testing.assert_allclose(made, np.broadcast_to(plane[:, :, None], made.shape), atol=1e-3)


@pytest.mark.parametrize("pattern", ["GRBG", NINE])
def test_constants_are_exact_even_in_the_smallest_frame(pattern):
    shape = channel_table(pattern).shape
    made, _, _ = demosaic(np.full(shape, 7, np.float32), clear(shape), None, pattern)
    np.testing.assert_allclose(made, 7, rtol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("pattern", BAYER)
@pytest.mark.parametrize("method", ["malvar", "bilinear"])
def test_bayer_values_are_those_of_colour_demosaicing_away_from_borders(pattern, method):
    import colour_demosaicing as oracle

    peer = {
        "malvar": oracle.demosaicing_CFA_Bayer_Malvar2004,
        "bilinear": oracle.demosaicing_CFA_Bayer_bilinear,
    }[method]
    frame = np.random.default_rng(0).random((40, 51)).astype(np.float32)
    made, _, _ = demosaic(frame, clear(frame.shape), None, pattern, method=method, channels="RGB")
    np.testing.assert_allclose(made[2:-2, 2:-2], peer(frame, pattern)[2:-2, 2:-2], atol=1e-6)


def test_measured_values_and_their_flags_are_kept():
    frame = np.random.default_rng(1).random((12, 15)).astype(np.float32)
    flags = (np.random.default_rng(2).random(frame.shape) < 0.1).astype(np.uint8) * 2
    made, noted, _ = demosaic(frame, flags, None, NINE)
    table = channel_table(NINE)
    for y, x in np.ndindex(12, 15):
        channel = table[y % 3, x % 3]
        assert made[y, x, channel] == frame[y, x]
        assert noted[y, x, channel] == flags[y, x]


def test_a_flagged_sensel_marks_what_is_made_of_it():
    flags = clear((12, 12))
    flags[6, 6] = Flag.SATURATED  # a red one
    _, noted, _ = demosaic(np.ones((12, 12), np.float32), flags, None, "RGGB", method="bilinear")
    red, green = noted[:, :, 0], noted[:, :, 1]
    assert red[6, 6] == Flag.SATURATED
    assert red[6, 7] == red[7, 7] == Flag.NEAR | Flag.SATURATED
    assert np.count_nonzero(red) == 9
    assert not green.any()
    # Malvar's green at a red sensel is corrected by the red ones around: near, not saturated.
    _, noted, _ = demosaic(np.ones((12, 12), np.float32), flags, None, "RGGB", method="malvar")
    assert noted[6, 8, 1] == Flag.NEAR
    assert noted[6, 6, 1] == Flag.NEAR


def test_variance_is_that_of_the_weights():
    # Bilinear red on blue is the mean of 4: variance 1/4; on green the mean of 2.
    frame = np.ones((12, 12), np.float32)
    _, _, variance = demosaic(frame, clear((12, 12)), frame, "RGGB", method="bilinear")
    np.testing.assert_allclose(variance[5:7, 5:7, 0], [[0.25, 0.5], [0.5, 1.0]])
    # Malvar's green on red: (8² + 4·4² + 4·2²)/16² = 0.5625
    _, _, variance = demosaic(frame, clear((12, 12)), frame, "RGGB", method="malvar")
    assert variance[6, 6, 1] == pytest.approx(0.5625)


@pytest.mark.parametrize(
    ("pattern", "options"),
    [(NINE, {"method": "malvar"}), ("RGGB", {"method": "menon"}), ("RGGB", {"channels": "RGX"})],
)
def test_methods_and_channels_that_do_not_fit_are_refused(pattern, options):
    with pytest.raises(CalibrationRefused):
        demosaic(np.ones((9, 9), np.float32), clear((9, 9)), None, pattern, **options)


@settings(max_examples=15, deadline=None)
@given(st.integers(1, 3), st.integers(1, 4), st.integers(3, 20), st.integers(4, 20))
def test_merge_undoes_split(rows, columns, height, width):
    frame = np.arange(height * width).reshape(height, width)
    np.testing.assert_array_equal(merge(split(frame, rows, columns), rows, columns), frame)
