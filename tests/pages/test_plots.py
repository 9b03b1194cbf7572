"""Plots: what has no place on a logarithmic axis, colours of the page, the same bytes."""

import re

from matplotlib.patches import Circle

from levkas.pages.plots import Line, new_figure, plot, to_svg


def marks(svg):
    """Places along x of the marks of the first line."""
    return [
        float(x) for x in re.findall(r'<use [^>]*x="([\d.]+)"[^>]*style="fill: var\(--ref\)', svg)
    ]


def test_decades_are_equally_far_apart_and_what_has_no_logarithm_is_left_out():
    x = [0.01, 0.1, 1.0, 0.0, None, -1.0]
    svg = plot([Line("a", x, [1, 2, 3, 4, 5, 6])], x="x", y="y", log_x=True)
    low, middle, high = marks(svg)
    assert low < middle < high and abs((high - middle) - (middle - low)) < 0.2
    assert all(f">{tick}</text>" in svg for tick in ("0.01", "0.1", "1"))
    assert plot([Line("a", [0.0, -1.0], [1, 2])], x="x", y="y", log_x=True) == ""


def test_a_plot_has_the_colours_of_its_page_a_name_for_readers_and_the_same_bytes():
    one, other = (
        plot([Line("<a>", [1, 2], [1, 2]), Line("b", [1, 2], [2, 1], "tgt")], x="x", y="y & z")
        for _ in range(2)
    )
    assert one == other
    assert "var(--ref)" in one and "var(--tgt)" in one and "#0101" not in one
    assert 'role="img" aria-label="y &amp; z over x"' in one and "&lt;a&gt;" in one
    assert "metadata" not in one and "<!--" not in one and ' id="axes' not in one


def test_bytes_do_not_depend_on_where_objects_lie_in_memory():
    """A line that is cut along a shape: matplotlib names the shape by its address."""

    def draw():
        figure = new_figure()
        axes = figure.subplots()
        circle = Circle((0.5, 0.5), 0.4, transform=axes.transData)
        axes.plot([0, 1], [0, 1])[0].set_clip_path(circle)
        kept.append(figure)
        return to_svg(figure, "cut")

    kept: list = []
    first, second = draw(), draw()
    assert first == second
    places = {name for name in re.findall(r"url\(#([^)]+)\)", first)}
    assert places and all(f'id="{name}"' in first for name in places)
