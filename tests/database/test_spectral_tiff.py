import warnings
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp

from levkas.core.files import spooling
from levkas.database import spectral_tiff
from levkas.database.credits import Credits
from levkas.database.spectral_tiff import (
    PageSpool,
    TiffHeader,
    read_stiff,
    read_tiff_pages,
    write_pages,
    write_stiff,
)
from levkas.database.tiff_pages import TiffRefused, open_pages

RGB = np.random.default_rng(0).integers(0, 256, (40, 30, 3), dtype=np.uint8)


def smooth_cube(height=150, width=700, bands=5, seed=0):
    rng = np.random.default_rng(seed)
    return rng.normal(0.5, 0.1, (height, width, bands)).astype(np.float32)


def write(path, cube, **options):
    centres, step = range(400, 400 + 10 * cube.shape[2], 10), options.pop("step", len(cube))
    facts = {"wavelengths": centres, "dtype": cube.dtype, "rgb": RGB} | options
    blocks = (cube[y : y + step] for y in range(0, len(cube), step))
    write_pages(path, blocks, TiffHeader(cube.shape[:2], **facts))


cubes = hnp.arrays(
    st.sampled_from([np.float32, np.uint16, np.uint8]),
    hnp.array_shapes(min_dims=3, max_dims=3, max_side=9),
    elements=None,
)


@settings(max_examples=20, deadline=None)
@given(cubes, st.text(), st.booleans(), st.data())
def test_what_is_written_is_what_is_read(tmp_path_factory, cube, text, with_rgb, data):
    path = tmp_path_factory.mktemp("stiff") / "a.tif"
    nm = st.floats(200, 2500, width=32)
    size = cube.shape[2]
    wavelengths = sorted(data.draw(st.lists(nm, min_size=size, max_size=size, unique=True)))
    write_stiff(path, cube, wavelengths, RGB if with_rgb else None, text)
    read, centres, rgb, metadata = read_stiff(path)
    expected = cube if cube.dtype != np.uint16 else cube.astype(np.float32) / np.float32(65535)
    np.testing.assert_array_equal(read, expected)
    assert read.dtype == expected.dtype
    np.testing.assert_array_equal(centres, np.float32(wavelengths))
    assert metadata == text
    assert (rgb is None) or np.array_equal(rgb, RGB)
    assert (rgb is not None) == with_rgb
    np.testing.assert_array_equal(read_tiff_pages(path), cube)


def test_tifffile_reads_the_bands_and_the_tags_are_as_agreed(tmp_path):
    cube, path = smooth_cube(), tmp_path / "a.tif"
    facts = Credits("Ikone", "Müller", "2018-05-14T10:00:00+02:00", "CC BY 4.0", "front")
    write(path, cube, text="Zeile 1\nZeile ü", credits=facts, px_per_mm=12.5)
    with tifffile.TiffFile(path) as tiff:
        assert len(tiff.pages) == 6
        np.testing.assert_array_equal(tiff.asarray(key=range(1, 6)), np.moveaxis(cube, 2, 0))
        np.testing.assert_array_equal(tiff.asarray(key=0), RGB)
        render, first, second = tiff.pages[0], tiff.pages[1], tiff.pages[2]
        assert first.tags[65000].value == (400.0, 410.0, 420.0, 430.0, 440.0)
        assert first.tags[65000].dtype == tifffile.DATATYPE.FLOAT
        assert first.tags[65111].value == "Zeile 1\\nZeile \\xfc"
        assert (65000 in second.tags, 65111 in second.tags) == (False, False)
        assert (first.compression, first.predictor) == (8, 3)
        assert first.photometric == tifffile.PHOTOMETRIC.MINISBLACK
        assert 128 * 1024 < first.rowsperstrip * 700 * 4 <= 256 * 1024
        assert first.resolution == (125.0, 125.0)
        assert first.resolutionunit == tifffile.RESUNIT.CENTIMETER
        assert render.tags["DateTime"].value == "2018:05:14 10:00:00"
        assert render.tags["Artist"].value == "Müller"
        assert render.tags["Copyright"].value == "CC BY 4.0"
        assert render.tags["ImageDescription"].value == "Ikone – front"
        assert render.iccprofile[36:40] == b"acsp"
        assert b"<dc:rights>" in render.tags[700].value
        assert render.software.startswith("levkas")


def test_the_bytes_do_not_depend_on_threads_or_on_how_rows_come(tmp_path, monkeypatch):
    cube = smooth_cube()
    for threads, step in ((1, 150), (3, 150), (3, 7), (3, 100)):
        monkeypatch.setenv("LEVKAS_THREADS", str(threads))
        write(tmp_path / f"{threads} {step}.tif", cube, step=step)
    assert len({path.read_bytes() for path in tmp_path.iterdir()}) == 1


def test_rows_and_bands_are_read_alone(tmp_path):
    cube = smooth_cube()
    write(tmp_path / "a.tif", cube)
    pages = open_pages(tmp_path / "a.tif")
    assert pages.shape == cube.shape
    np.testing.assert_array_equal(pages.read(97, 131, [3, 1]), cube[97:131, :, [3, 1]])
    np.testing.assert_array_equal(pages.read(149, 150), cube[149:150])
    assert pages.read(60, 60).shape == (0, 700, 5)


def test_bigtiff_is_read_too(tmp_path, monkeypatch):
    cube = smooth_cube(20, 30, 3)
    monkeypatch.setattr(spectral_tiff, "CLASSIC_LIMIT", 0)
    write(tmp_path / "a.tif", cube)
    assert (tmp_path / "a.tif").read_bytes()[:4] == b"II\x2b\x00"
    np.testing.assert_array_equal(read_stiff(tmp_path / "a.tif")[0], cube)


@pytest.mark.parametrize(
    "options", [{"tile": (16, 32)}, {"compression": "lzw", "predictor": 2}, {}]
)
def test_uint16_files_of_others_are_reflectance_and_ascend(tmp_path, options):
    rng = np.random.default_rng(1)
    stored = rng.integers(0, 65536, (3, 50, 70), dtype=np.uint16)
    with tifffile.TiffWriter(tmp_path / "a.tif", byteorder=">") as tiff:
        for page in stored:
            tags = [
                (65000, "f", 3, (600.0, 500.0, 400.0), True),
                (65111, "s", 0, "'x\\\\ny'", True),
            ]
            tiff.write(page, metadata=None, contiguous=False, extratags=tags, **options)
    with pytest.warns(UserWarning, match="repeated on 3 pages"):
        read_stiff(tmp_path / "a.tif")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cube, wavelengths, rgb, text = read_stiff(tmp_path / "a.tif", True)
    assert wavelengths.tolist() == [400, 500, 600]
    np.testing.assert_allclose(cube, np.moveaxis(stored[::-1], 0, 2) / 65535, rtol=1e-6)
    assert (rgb, text) == (None, "x\ny")


def test_a_file_without_tags_counts_its_bands_and_has_no_text(tmp_path):
    tifffile.imwrite(
        tmp_path / "a.tif", np.ones((4, 5, 6), np.float32), photometric="minisblack", metadata=None
    )
    cube, wavelengths, _, text = read_stiff(tmp_path / "a.tif")
    assert (cube.shape, wavelengths.tolist(), text) == ((5, 6, 4), [0, 1, 2, 3], "")
    assert read_stiff(tmp_path / "a.tif", rgb_only=True)[0] is None


def test_lists_that_differ_are_refused(tmp_path):
    with tifffile.TiffWriter(tmp_path / "a.tif") as tiff:
        for nm in (400.0, 500.0):
            tags = [(65000, "f", 2, (nm, 600.0), True)]
            tiff.write(np.zeros((4, 5), "f4"), metadata=None, contiguous=False, extratags=tags)
    with pytest.raises(TiffRefused):
        read_stiff(tmp_path / "a.tif")


def test_bands_of_another_number_and_missing_rows_leave_no_file(tmp_path):
    cube = np.zeros((4, 5, 3), np.float32)
    for count in (2, 4):
        with pytest.raises(TiffRefused) as info:
            write_stiff(tmp_path / "a.tif", cube, range(count), None)
        assert info.value.problems[0].code == "E_BAND_COUNT"
    with pytest.raises(ValueError):
        write_pages(tmp_path / "a.tif", [cube], TiffHeader((5, 5), range(3)))
    assert list(tmp_path.iterdir()) == []


def damaged(data, rng):
    """One of: cut off, a flipped bit, a zeroed block."""
    kind, place = rng.integers(3), int(rng.integers(len(data)))
    if kind == 0:
        return data[:place], "cut"
    changed = bytearray(data)
    if kind == 1:
        changed[place] ^= 1 << int(rng.integers(8))
        return bytes(changed), "bit"
    changed[place : place + 512] = bytes(len(changed[place : place + 512]))
    return bytes(changed), "zeros"


def test_damage_is_refused_or_harmless_never_another_picture(tmp_path):
    cube = smooth_cube(40, 60, 4)
    write(tmp_path / "a.tif", cube)
    data = (tmp_path / "a.tif").read_bytes()
    rng = np.random.default_rng(3)
    wrong = {"cut": 0, "bit": 0, "zeros": 0}
    for _ in range(150):
        changed, kind = damaged(data, rng)
        if changed == data:
            continue
        (tmp_path / "b.tif").write_bytes(changed)
        try:
            read = read_stiff(tmp_path / "b.tif", silent=True)[0]
        except TiffRefused:
            continue
        wrong[kind] += not np.array_equal(read, cube)
    # The directory has no checksum of its own: a flipped bit in it may swap two tags. Hashes find it.
    assert wrong["cut"] == 0
    assert wrong["zeros"] <= 1
    assert wrong["bit"] <= 3


def test_a_missing_strip_is_an_error_not_zeros(tmp_path):
    write(tmp_path / "a.tif", smooth_cube(), rgb=None)
    with tifffile.TiffFile(tmp_path / "a.tif", mode="r+") as tiff:
        tag = tiff.pages[2].tags["StripByteCounts"]
        tag.overwrite((0, *tag.value[1:]))
    with pytest.raises(TiffRefused):
        read_stiff(tmp_path / "a.tif")


def test_a_spool_that_became_shorter_is_refused_and_never_read_as_less(tmp_path):
    cube = smooth_cube()
    with ThreadPoolExecutor(2) as pool, spooling(tmp_path, "layer.spool") as handle:
        spool = PageSpool(handle, cube.shape, cube.dtype, pool)
        spool.write_rows(cube)
        handle.flush()
        handle.truncate(handle.seek(0, 2) - 10)
        with pytest.raises(OSError):
            list(spool.pages())
