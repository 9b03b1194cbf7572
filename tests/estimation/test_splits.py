import numpy as np
import pytest

import levkas
from levkas.core.problems import Refused
from levkas.estimation.samples import SampleSource
from levkas.estimation.splits import group_pixels, split_paintings

NAMES = ["a", "b", "c"]


def both_sides(split):
    return [{p.object for p in f.train} & {p.object for p in f.test} for f in split.folds]


def test_no_painting_is_on_both_sides():
    for split in (split_paintings(NAMES, ("rgb",)), split_paintings(NAMES, ("rgb",), test=["b"])):
        assert not any(both_sides(split))


def test_a_split_that_leaks_is_refused_however_it_is_asked_for():
    with pytest.raises(Refused, match="both sides") as refused:
        split_paintings(NAMES, ("rgb",), train=["a", "b"], test=["b"])
    assert refused.value.problems[0].code == "E_SPLIT_LEAK"


def test_a_single_painting_is_cut_into_blocks_and_the_report_says_so(one_painting):
    split = split_paintings(["icon1"], ("rgb",))
    samples = SampleSource(levkas.open(one_painting), "vis", 10_000).read("icon1", ["rgb"])
    groups = group_pixels(samples)
    assert "only painting" in split.note and len(split.folds) == 4
    shares = np.bincount(groups) / len(groups)
    assert shares.min() > 0.2 and shares.max() < 0.3
    beside = np.flatnonzero((np.diff(samples.columns) == 1) & (np.diff(samples.rows) == 0))
    assert (groups[beside] == groups[beside + 1]).mean() > 0.9  # blocks, not scattered pixels
