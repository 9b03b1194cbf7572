"""Parts of a plane joined on a grid."""

import numpy as np
import pytest

from levkas.core.flags import Flag
from levkas.geometry.joining import FEATHER_PX, Seams, TilePart, depth_in_frame, join, weights_of
from levkas.geometry.transforms import Affine

SHAPE = (40, 100, 1)
WIDE = 60


def part(name, start, value, *, noise=None, sigma=0.0):
    """A part of `WIDE` columns from `start` on."""
    moved = Affine(np.array([[1.0, 0, -start], [0, 1, 0]]))
    depth = depth_in_frame(moved, (WIDE, 40), (start, 0, start + WIDE, 40), (0, 40))
    values = np.full((40, WIDE, 1), value, np.float32)
    variance = None if noise is None else np.full(values.shape, noise**2, np.float32)
    columns = slice(start, start + WIDE)
    return TilePart(name, columns, values, np.zeros(values.shape, np.uint8), variance, depth, sigma)


def test_depth_is_the_distance_from_the_edge_of_the_frame():
    turned = Affine(np.array([[0.0, 1, 3], [-1, 0, 50]]))
    box = (5, 2, 45, 40)
    depth = depth_in_frame(turned, (50, 40), box, (7, 31))
    for y, x in ((7, 5), (20, 30), (30, 44)):
        u, v = y + 3, 50 - x
        expected = min(u + 0.5, 49.5 - u, v + 0.5, 39.5 - v)
        assert depth[y - 7, x - 5] == pytest.approx(expected, abs=1e-4)
    np.testing.assert_array_equal(depth[5:9], depth_in_frame(turned, (50, 40), box, (12, 16)))


def test_weights_sum_to_one_beside_the_seam_and_change_over_the_feather_alone():
    parts = [part("a", 0, 1.0), part("b", 40, 2.0)]
    joined = join(parts, SHAPE).values[20, :, 0]
    assert (joined[:40] == 1).all()
    assert (joined[60:] == 2).all()
    assert (np.diff(joined) >= 0).all()
    half = FEATHER_PX / 2  # depths differ by 2 px a column
    assert (joined[: int(49.5 - half)] == 1).all()
    assert joined[49] == pytest.approx(1.5, abs=0.07)
    a, b = weights_of(parts, SHAPE[:2])
    assert a[20, 49] > 0.9
    assert b[20, 9] > 0.9


def test_where_the_deepest_part_is_saturated_the_other_counts():
    a, b = part("a", 0, 1.0), part("b", 40, 2.0)
    a.flags[10, 45] = Flag.SATURATED
    b.flags[11, 5] = Flag.SATURATED
    a.values[12, 45], b.values[12, 5] = np.nan, np.nan
    a.values[13, 20] = np.nan
    joined = join([a, b], SHAPE)
    assert joined.values[10, 45, 0] == 2
    assert joined.flags[10, 45, 0] == 0
    assert joined.values[11, 45, 0] == 1
    for y, x in ((12, 45), (13, 20)):
        assert np.isnan(joined.values[y, x, 0])
        assert joined.flags[y, x, 0] == Flag.OUTSIDE


def test_noise_of_a_mean_is_less_than_that_of_a_part():
    rng = np.random.default_rng(2)
    a, b = part("a", 0, 0.0, noise=0.1), part("b", 40, 0.0, noise=0.1)
    drawn = []
    for _ in range(60):
        for one in (a, b):
            one.values[:] = 0.1 * rng.normal(size=one.values.shape)
        drawn.append(join([a, b], SHAPE).values)
    predicted = np.sqrt(join([a, b], SHAPE).variance[:, 46:54].mean((0, 2)))
    observed = np.std(drawn, axis=(0, 1, 3))[46:54]
    np.testing.assert_allclose(observed, predicted, rtol=0.06)
    assert predicted.min() < 0.072


def test_a_seam_is_measured_over_its_uncertainty():
    rng = np.random.default_rng(3)
    for step, within in (
        (0.0, 0.9545),
        (0.3, 0.4431),
    ):  # normal: within 2; of a shift of 2.12 sigma
        a, b = part("a", 0, 0.0, noise=0.1), part("b", 40, 0.0, noise=0.1)
        for one in (a, b):
            one.values[:] = 1 + 0.1 * rng.normal(size=one.values.shape)
        b.values[:] += step
        seams = Seams(("grey",))
        join([a, b], SHAPE, seams)
        (record,) = seams.records()
        assert record["tiles"] == ["a", "b"]
        assert record["within"] == pytest.approx(within, abs=0.05)
        assert record["relative"]["grey"] == pytest.approx(step / (1 + step / 2), abs=0.02)
