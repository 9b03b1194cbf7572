"""Strips that wait in a spool until their page is whole."""

import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest

from levkas.core.files import spooling
from levkas.database.spectral_tiff import PageSpool, encode_strip, strip_rows


@pytest.fixture
def spool(tmp_path):
    shape = (90, 700, 3)
    cube = np.random.default_rng(4).random(shape, np.float32)
    with ThreadPoolExecutor(2) as pool, spooling(tmp_path, "layer.spool") as handle:
        made = PageSpool(handle, shape, np.float32, pool)
        for start in range(0, 90, 7):
            made.write_rows(cube[start : start + 7])
        yield made, cube, handle


def test_strips_come_back_page_by_page_as_they_were_encoded(spool):
    made, cube, _ = spool
    rows = strip_rows(cube.shape[1], np.float32)
    starts = range(0, cube.shape[0], rows)
    pages = list(made.pages())
    assert len(pages) == cube.shape[2]
    for band, page in enumerate(pages):
        plain = np.ascontiguousarray(cube[..., band])
        assert page == [encode_strip(plain[start : start + rows]) for start in starts]


def test_a_spool_that_became_shorter_is_told_and_never_read_as_less(spool):
    made, _, handle = spool
    handle.flush()
    handle.truncate(handle.seek(0, 2) - 10)
    with pytest.raises(OSError, match="could be read back"):
        list(made.pages())


def test_a_spool_whose_pages_are_written_gives_its_space_back(spool):
    made, _, handle = spool
    list(made.pages())
    assert os.fstat(handle.fileno()).st_size > 100_000
    made.drop()
    assert os.fstat(handle.fileno()).st_size == 0
