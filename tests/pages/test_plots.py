"""Small plots: what is drawn where, and what has no place on a logarithmic axis."""

import re

from levkas.pages.plots import Line, plot


def heights(svg):
    points = re.search(r'polyline points="([^"]*)"', svg)[1]
    return [float(p.split(",")[1]) for p in points.split()]


def test_decades_are_equally_far_apart_on_a_logarithmic_y():
    svg = plot([Line("a", [1, 2, 3], [0.01, 0.1, 1.0])], x="x", y="y", log_y=True)
    low, middle, high = heights(svg)
    assert low > middle > high and abs((low - middle) - (middle - high)) < 0.2
    assert all(f">{tick}</text>" in svg for tick in ("0.01", "0.1", "1"))


def test_what_has_no_logarithm_is_left_out():
    svg = plot([Line("a", [1, 2, 3, 4], [0.0, 0.1, None, 1.0])], x="x", y="y", log_y=True)
    assert len(heights(svg)) == 2
    assert plot([Line("a", [1, 2], [0.0, -1.0])], x="x", y="y", log_y=True) == ""
