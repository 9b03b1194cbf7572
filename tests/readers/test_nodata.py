"""Samples that hold nothing, as ENVI headers and GDAL's programs declare them."""

import numpy as np
import pytest
import rasterio
import tifffile

from levkas.readers.envi import open_envi
from levkas.readers.frames import UnreadableCapture, read_facts, read_frame
from levkas.readers.tiff import read_tiff_parts

RNG = np.random.default_rng(6)
CUBE = RNG.integers(1, 4000, (9, 7, 4))
EMPTY = RNG.random(CUBE.shape) < 0.2


def envi(folder, cube, kind, extra, interleave="bil"):
    order = {"bil": (0, 2, 1), "bip": (0, 1, 2), "bsq": (2, 0, 1)}[interleave]
    codes = {"u1": 1, "i2": 2, "i4": 3, "f4": 4, "f8": 5, "u2": 12}
    stored = np.ascontiguousarray(cube.astype("<" + kind).transpose(order))
    (folder / "a.raw").write_bytes(stored.tobytes())
    lines, samples, bands = cube.shape
    header = (
        f"ENVI\nlines = {lines}\nsamples = {samples}\nbands = {bands}\ninterleave = {interleave}"
    )
    path = folder / "a.hdr"
    path.write_text(f"{header}\ndata type = {codes[kind]}\nbyte order = 0\n{extra}\n")
    return path


@pytest.mark.parametrize("interleave", ["bil", "bip", "bsq"])
@pytest.mark.parametrize(
    ("kind", "value", "written"),
    [
        ("i2", -9999, "-9999"),
        ("i2", -9999, "-9999.0"),
        ("u2", 65535, "65535"),
        ("u1", 0, "0"),
        ("f4", -9999, "-9.999e+03"),
        ("f4", -3.4028234663852886e38, "-3.40282347e+38"),
        ("f8", -1e34, "-1e34"),
        ("f4", np.nan, "NaN"),
    ],
)
def test_the_ignore_value_of_a_cube_is_no_number(tmp_path, interleave, kind, value, written):
    values = np.clip(CUBE, 1, 250) if kind == "u1" else CUBE
    stored = np.where(EMPTY, value, values.astype(float)).astype(kind)
    path = envi(tmp_path, stored, kind, f"data ignore value = {written}", interleave)
    found = read_frame(path)
    assert np.array_equal(np.isnan(found), EMPTY) and np.array_equal(found[~EMPTY], values[~EMPTY])
    assert np.array_equal(open_envi(path).read_lines(3, 5), found[3:5], equal_nan=True)
    facts = read_facts(path)
    assert facts.nodata == pytest.approx(value, rel=1e-6, nan_ok=True)
    assert "outside" in facts.notes[0] and facts.dtype == np.dtype(kind).name


@pytest.mark.parametrize("value", ["-9999", "70000", "12.5", "none", "1e400"])
def test_an_ignore_value_that_no_sample_can_have_changes_nothing(tmp_path, value):
    facts = read_facts(path := envi(tmp_path, CUBE, "u2", f"data ignore value = {value}"))
    assert facts.nodata is None and f"{value} is no value of uint16 samples" in facts.notes[0]
    assert read_frame(path).dtype == np.uint16


@pytest.mark.parametrize("dtype", ["int16", "uint16", "float32"])
def test_nodata_that_gdal_wrote_is_no_number(tmp_path, dtype):
    path, value = tmp_path / "a.tif", -9999 if dtype != "uint16" else 65535
    planes = np.where(EMPTY, value, CUBE).transpose(2, 0, 1).astype(dtype)
    size = {"height": CUBE.shape[0], "width": CUBE.shape[1], "count": CUBE.shape[2]}
    with rasterio.open(path, "w", driver="GTiff", dtype=dtype, nodata=value, **size) as out:
        out.write(planes)
        out.descriptions = ("450 nm", "550 nm", "650 nm", "750 nm")
        out.scales = (1e-4,) * 4
    found, facts = read_frame(path), read_facts(path)
    assert np.array_equal(np.isnan(found), EMPTY) and np.array_equal(found[~EMPTY], CUBE[~EMPTY])
    part = read_tiff_parts(path, [(2, 5)], [(1, 4)])
    assert np.array_equal(part, found[2:5, 1:4], equal_nan=True)
    assert facts.nodata == value and facts.wavelengths == (450.0, 550.0, 650.0, 750.0)
    assert any("scale of the file (GDAL) are not applied" in note for note in facts.notes)


def test_nodata_is_the_stored_value_where_zero_is_white(tmp_path):
    path = tmp_path / "a.tif"
    plane = np.where(EMPTY[..., 0], 255, np.clip(CUBE[..., 0], 0, 250)).astype(np.uint8)
    tags = [(42113, "s", 0, "255", True)]
    tifffile.imwrite(path, plane, photometric="miniswhite", extratags=tags)
    found = read_frame(path)
    assert np.array_equal(np.isnan(found), EMPTY[..., 0])
    assert np.array_equal(found[~EMPTY[..., 0]], 255 - plane[~EMPTY[..., 0]])


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("reflectance scale factor = 10000", (10000.0,) * 4),
        ("reflectance scale factor = {100, 200, 300, 400}", (100.0, 200.0, 300.0, 400.0)),
        ("reflectance scale factor = 0", None),
        ("reflectance scale factor = {1, 0, 1, 1}", None),
        ("reflectance scale factor = much", None),
    ],
)
def test_the_value_of_reflectance_one_is_read_for_every_band(tmp_path, line, expected):
    assert read_facts(envi(tmp_path, CUBE, "i2", line)).reflectance_scale == expected


def test_bad_bands_and_gains_are_read(tmp_path):
    facts = read_facts(envi(tmp_path, CUBE, "i2", "bbl = {1, 0, 1.0, 0.0}"))
    assert facts.bad_bands == (1, 3)
    assert read_facts(envi(tmp_path, CUBE, "i2", "bbl = {1, 1, 1, 1}")).bad_bands is None
    with pytest.raises(UnreadableCapture, match="list of bbl"):
        read_facts(envi(tmp_path, CUBE, "i2", "bbl = {1, 1, 0}"))
    gains = "data gain values = {2, 2, 2, 2}\ndata offset values = {0, 0, 0, 0}"
    assert read_facts(envi(tmp_path, CUBE, "i2", gains)).notes == (
        "`data gain values` of the header are not applied",
    )
    neutral = "data gain values = {1, 1, 1, 1}"
    assert read_facts(envi(tmp_path, CUBE, "i2", neutral)).notes == ()


def test_wavelengths_are_read_from_names_of_bands(tmp_path):
    names = ", ".join(f"Band {i} ({nm}.0 nm)" for i, nm in enumerate((400, 500, 600, 700), 1))
    facts = read_facts(envi(tmp_path, CUBE, "i2", f"band names = {{{names}}}"))
    assert facts.wavelengths == (400.0, 500.0, 600.0, 700.0)
    listed = f"band names = {{{names}}}\nwavelength = {{1, 2, 3, 4}}"
    assert read_facts(envi(tmp_path, CUBE, "i2", listed)).wavelengths == facts.wavelengths


@pytest.mark.parametrize("stating", [[0], [0, 1, 2, 3], [2]])
@pytest.mark.parametrize("zero", ["minisblack", "miniswhite"])
def test_nodata_of_one_page_holds_for_all(tmp_path, stating, zero):
    path, full = tmp_path / "a.tif", 65535
    stored = np.where(EMPTY, 0, CUBE).astype(np.uint16)
    with tifffile.TiffWriter(path) as file:
        for page in range(4):
            tags = [(42113, 2, 2, "0", True)] if page in stating else []
            file.write(stored[..., page], photometric=zero, metadata=None, extratags=tags)
    assert read_facts(path).nodata == 0
    for page in range(4):
        if 0 in stating or page in stating:
            found = read_frame(path, page=page)
            values = CUBE[..., page] if zero == "minisblack" else full - CUBE[..., page]
            assert np.array_equal(np.isnan(found), EMPTY[..., page])
            assert np.array_equal(found[~EMPTY[..., page]], values[~EMPTY[..., page]])
