"""Thousands of files: names are read, headers opened and targets looked up once each, not once per pair."""

import sys

import numpy as np
import pytest
import tifffile

from levkas.building import status
from levkas.campaign.guess import look, write_campaign

KINDS = {
    "objects": lambda n: f"panel{n}-b.tif",
    "wavelengths": lambda n: f"panel_{400 + n / 10:.1f}nm.tif",
    "numbers": lambda n: f"{300 + n / 10:.1f}.tif",
    "both": lambda n: f"plate{n // 5}_{400 + 50 * (n % 5)}nm.tif",
}


def calls_of(action, *arguments):
    """Count the calls of Python functions that an action makes."""
    count = 0

    def counted(_frame, event, _argument):
        nonlocal count
        count += event == "call"

    sys.setprofile(counted)
    try:
        action(*arguments)
    finally:
        sys.setprofile(None)
    return count


@pytest.fixture
def folder(tmp_path):
    """Return a function that makes a folder of some files of one kind."""
    levels = np.random.default_rng(0).integers(0, 4000, (8, 10)).astype(np.uint16)
    tifffile.imwrite(tmp_path / "one.tif", levels)
    data = (tmp_path / "one.tif").read_bytes()

    def make(kind, count):
        place = tmp_path / f"{kind}{count}"
        place.mkdir()
        for n in range(count):
            (place / KINDS[kind](n)).write_bytes(data)
        return place

    return make


@pytest.mark.slow
@pytest.mark.parametrize(
    "kind",
    [pytest.param(one, marks=[pytest.mark.exhaustive] * (one != "numbers")) for one in KINDS],
)
def test_the_work_of_looking_grows_with_the_number_of_files(folder, kind):
    few, many = folder(kind, 250), folder(kind, 750)
    look(folder(kind, 5))  # imports
    proposals = []
    work = [calls_of(lambda f=f: proposals.append(look(f))) for f in (few, many)]
    assert work[1] < 3.6 * work[0]
    assert len(proposals[1].text) > 200


@pytest.mark.slow
def test_the_work_of_status_grows_with_the_number_of_files(folder):
    kind = "both"
    work = []
    for count in (5, 200, 600):
        made = folder(kind, count)
        write_campaign(look(made))
        work.append(calls_of(status, made))
    assert work[2] < 3.6 * work[1]
