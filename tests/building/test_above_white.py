"""What is told of values above the white and below the dark is counted alike in any parts of the lines."""

from dataclasses import replace

import numpy as np
import pytest

from levkas.core.cube import Band, Cube
from levkas.stages.above_white import count_above, findings_of_counts

BANDS = tuple(Band(label) for label in "RGB")


def cube_of(values):
    flags = np.zeros(values.shape, np.uint8)
    sigma = np.full(values.shape, 0.001, np.float32)
    return Cube(values.astype(np.float32), flags, sigma, BANDS[: values.shape[2]])


@pytest.mark.parametrize(
    ("dark", "named"), [(0.0, False), (0.001, False), (0.003, True), (0.01, True)]
)
def test_a_dark_that_is_too_bright_is_named_where_dark_paint_lies_below_it(dark, named):
    """By no single value, whose noise is as much, but by the means of dark paint."""
    rng = np.random.default_rng(2)
    truth = np.kron(np.geomspace(0.001, 1, 24).reshape(6, 4, 1), np.ones((20, 80, 1)))
    cube = cube_of(truth - dark + rng.normal(0, 0.001, truth.shape))
    counts = count_above(cube)
    assert len([*findings_of_counts(counts, cube.labels)]) == named
    halves = [
        replace(cube, values=cube.values[part], flags=cube.flags[part], sigma=cube.sigma[part])
        for part in (np.s_[:7], np.s_[7:])
    ]
    assert np.array_equal(sum(map(count_above, halves)), counts)
