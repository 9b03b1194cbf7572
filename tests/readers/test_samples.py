"""Samples of a pixel that do not count: alpha, and the same grey three times."""

import cv2
import numpy as np
import pytest
import tifffile

from levkas.readers.frames import UnreadableCapture, read_facts, read_frame, read_plane
from levkas.readers.tiff import read_tiff_parts

RNG = np.random.default_rng(4)
GREY = RNG.integers(0, 65536, (40, 50)).astype(np.uint16)
COLOURS = RNG.integers(0, 65536, (40, 50, 3)).astype(np.uint16)
ALPHA = RNG.integers(0, 65536, (40, 50, 1)).astype(np.uint16)


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize("alpha", ["unassalpha", "assocalpha"])
@pytest.mark.parametrize("image", [GREY, COLOURS], ids=["grey", "colours"])
def test_alpha_of_a_tiff_is_no_sample_of_the_frame(tmp_path, image, alpha, compression, planar):
    path = tmp_path / "a.tif"
    samples = np.concatenate([np.atleast_3d(image), ALPHA], axis=2)
    photometric = "minisblack" if image.ndim == 2 else "rgb"
    tifffile.imwrite(
        path,
        samples if planar == "contig" else np.moveaxis(samples, 2, 0),
        photometric=photometric,
        planarconfig=planar,
        extrasamples=[alpha],
        compression=compression,
        rowsperstrip=8,
    )
    facts = read_facts(path)
    assert facts.shape == image.shape and "alpha" in facts.notes[0]
    assert np.array_equal(read_frame(path), image)
    part = read_tiff_parts(path, [(8, 20)], [(0, 10), (30, 40)])
    assert np.array_equal(part, np.concatenate([image[8:20, :10], image[8:20, 30:40]], axis=1))


def test_further_samples_that_are_no_alpha_are_bands(tmp_path):
    path = tmp_path / "cube.tif"
    cube = np.concatenate([COLOURS, ALPHA, ALPHA[::-1]], axis=2)
    kinds = ["unspecified", "unspecified", "unspecified", "unspecified"]
    tifffile.imwrite(path, cube, photometric="minisblack", extrasamples=kinds)
    assert read_facts(path).shape == (40, 50, 5) and not read_facts(path).notes
    assert np.array_equal(read_frame(path), cube)


def test_alpha_of_a_png_is_not_used_and_said(tmp_path):
    path = tmp_path / "a.png"
    samples = np.concatenate([COLOURS[..., ::-1], ALPHA], axis=2)
    path.write_bytes(cv2.imencode(".png", samples)[1].tobytes())
    assert np.array_equal(read_frame(path), COLOURS)
    assert "alpha" in read_facts(path).notes[0]


def test_equal_samples_of_a_band_are_one(tmp_path):
    path = tmp_path / "grey.tif"
    tifffile.imwrite(path, np.dstack([GREY] * 3), photometric="rgb")
    assert read_frame(path).shape == (40, 50, 3)
    assert np.array_equal(read_plane(path), GREY)


def test_samples_of_a_band_that_differ_in_one_pixel_are_refused(tmp_path):
    path = tmp_path / "colours.tif"
    samples = np.dstack([GREY] * 3)
    samples[7, 9, 2] ^= 1
    tifffile.imwrite(path, samples, photometric="rgb")
    with pytest.raises(UnreadableCapture, match=r"colours\.tif") as refused:
        read_plane(path)
    assert refused.value.problems[0].code == "E_BAND_COUNT"
