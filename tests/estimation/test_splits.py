import numpy as np
import pytest

import levkas
from levkas.core.problems import Refused
from levkas.estimation.samples import SampleSource
from levkas.estimation.splits import (
    RANDOM_FOLDS,
    EstimationFold,
    EstimationSplit,
    Part,
    group_pixels,
    lightings_of,
    require_no_leak,
    split_at_random,
    split_between,
    split_paintings,
)

NAMES = ["a", "b", "c"]


def both_sides(split):
    return [{p.object for p in f.train} & {p.object for p in f.test} for f in split.folds]


def test_no_painting_is_on_both_sides_of_any_split_but_the_optimistic_one():
    for split in (
        split_paintings(NAMES, ("rgb",)),
        split_paintings(NAMES, ("rgb",), test=["b"]),
        split_between("camera", NAMES, [("one",), ("two",)]),
        split_between("lighting", NAMES, [("rgb",), ("rgb@soft",)]),
    ):
        assert not split.optimistic and not any(both_sides(require_no_leak(split)))
    assert split_at_random(NAMES, ("rgb",)).optimistic
    assert "optimistic" in split_at_random(NAMES, ("rgb",)).note


def test_a_split_that_leaks_is_refused_however_it_is_asked_for():
    with pytest.raises(Refused, match="both sides") as refused:
        split_paintings(NAMES, ("rgb",), train=["a", "b"], test=["b"])
    assert refused.value.problems[0].code == "E_SPLIT_LEAK"
    part = (Part("a", ("rgb",)),)
    with pytest.raises(Refused, match="both sides"):
        require_no_leak(EstimationSplit("painting", (EstimationFold("a", part, part),)))


def test_a_single_painting_is_cut_into_blocks_and_the_report_says_so(one_painting):
    split = split_paintings(["icon1"], ("rgb",))
    samples = SampleSource(levkas.open(one_painting), "vis", 10_000).read("icon1", ["rgb"])
    groups = group_pixels(samples, split.grouping, 1)
    assert "only painting" in split.note and len(split.folds) == 4
    shares = np.bincount(groups) / len(groups)
    assert shares.min() > 0.2 and shares.max() < 0.3
    beside = np.flatnonzero((np.diff(samples.columns) == 1) & (np.diff(samples.rows) == 0))
    assert (groups[beside] == groups[beside + 1]).mean() > 0.9  # blocks, not scattered pixels


def test_random_groups_are_even_and_the_same_for_the_same_seed(one_painting):
    samples = SampleSource(levkas.open(one_painting), "vis", 10_000).read("icon1", ["rgb"])
    one, other = (group_pixels(samples, "random", 3) for _ in range(2))
    np.testing.assert_array_equal(one, other)
    np.testing.assert_allclose(np.bincount(one) / len(one), 1 / RANDOM_FOLDS, atol=0.05)


def test_lightings_are_those_that_all_cameras_were_used_under(paintings):
    database = levkas.open(paintings)
    assert lightings_of(database, ("rgb",)) == [("rgb",), ("rgb@soft",)]
    assert lightings_of(database, ("rgb", "cam2")) == [("rgb", "cam2")]


def test_a_split_between_one_lighting_is_refused():
    with pytest.raises(Refused, match="two lightings"):
        split_between("lighting", NAMES, [("rgb",)])
