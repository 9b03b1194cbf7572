"""Deflate of our own: whatever bytes come, every zlib gives them back, and noise takes no more room."""

import zlib

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from levkas.database.deflating import MOST_BITS, deflate_rows
from levkas.database.planes import turned
from levkas.database.predicting import predict_planes, predict_rows

SIZES = st.tuples(st.integers(1, 40), st.integers(1, 300))


def read_back(rows: np.ndarray) -> bool:
    return zlib.decompress(deflate_rows(rows)) == rows.tobytes()


@given(arrays(np.uint8, SIZES, elements=st.sampled_from([0, 1, 2, 255]) | st.integers(0, 255)))
def test_any_bytes_come_back(rows):
    assert read_back(rows)


@pytest.mark.parametrize("width", [*range(1, 10), 257, 258, 259, 32767, 32768, 32769, 40000])
def test_rows_that_repeat_come_back_whatever_their_width(width):
    row = np.random.default_rng(width).integers(0, 256, width).astype(np.uint8)
    rows = np.tile(row, (5, 1))
    assert read_back(rows)
    if 8 <= width <= 32768:
        assert len(deflate_rows(rows)) < 2 * width + 300


def test_runs_of_every_length_come_back():
    noise = np.random.default_rng(0).integers(1, 256, 600).astype(np.uint8)
    runs = [np.r_[noise[: 1 + n % 7], np.zeros(n, np.uint8)] for n in range(600)]
    assert read_back(np.concatenate(runs)[None])


def test_codes_that_would_be_too_long_are_cut_short():
    """Counts that grow like Fibonacci's numbers make Huffman's tree as deep as there are bytes."""
    counts = [1, 1]
    while sum(counts) < 300_000:
        counts.append(counts[-1] + counts[-2])
    assert len(counts) > MOST_BITS + 8
    rows = np.repeat(np.arange(len(counts), dtype=np.uint8), counts)
    np.random.default_rng(0).shuffle(rows)
    assert read_back(rows[None])


def test_noise_takes_the_room_of_its_entropy():
    rng = np.random.default_rng(0)
    rows = np.clip(rng.normal(128, 12, (64, 4096)), 0, 255).astype(np.uint8)
    share = np.bincount(rows.ravel(), minlength=256) / rows.size
    share = share[share > 0]
    entropy = -(share * np.log2(share)).sum() / 8
    assert len(deflate_rows(rows)) < 1.01 * entropy * rows.size


def test_flags_take_hardly_any_room():
    flags = np.zeros((256, 1024), np.uint8)
    flags[40:90, 100:300] = 2
    assert len(deflate_rows(flags)) < 1500


@pytest.mark.parametrize("shape", [(3, 40, 20), (2, 7, 5), (5, 16, 33), (4, 17, 16), (1, 1, 1)])
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16, np.float32])
def test_bands_are_turned_whatever_their_number(shape, dtype):
    values = np.random.default_rng(0).integers(0, 60000, shape).astype(dtype)
    for start in range(0, shape[2], 16):
        stop = min(start + 16, shape[2])
        planes = turned(values, start, stop)
        assert np.array_equal(planes, np.moveaxis(values[:, :, start:stop], 2, 0))
        if dtype == np.float32:
            predicted = predict_planes(values, start, stop)
            assert np.array_equal(predicted, [predict_rows(plane) for plane in planes])
