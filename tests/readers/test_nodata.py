"""Samples that hold nothing, scales, bad bands: what headers of cubes and GDAL's programs declare of values."""

import numpy as np
import pytest
import rasterio
import tifffile

from levkas.readers.envi import open_envi
from levkas.readers.frames import UnreadableCapture, read_facts, read_frame

RNG = np.random.default_rng(6)
CUBE = RNG.integers(1, 4000, (9, 7, 4))
EMPTY = RNG.random(CUBE.shape) < 0.2
CODES = {"u1": 1, "i2": 2, "i4": 3, "f4": 4, "f8": 5, "u2": 12}
ORDER = {"bil": (0, 2, 1), "bip": (0, 1, 2), "bsq": (2, 0, 1)}


def envi(folder, extra, cube=CUBE, kind="i2", interleave="bil"):
    stored = np.ascontiguousarray(cube.astype("<" + kind).transpose(ORDER[interleave]))
    (folder / "a.raw").write_bytes(stored.tobytes())
    lines, samples, bands = cube.shape
    (folder / "a.hdr").write_text(
        f"ENVI\nlines = {lines}\nsamples = {samples}\nbands = {bands}\ninterleave = {interleave}\n"
        f"data type = {CODES[kind]}\nbyte order = 0\n{extra}\n"
    )
    return folder / "a.hdr"


@pytest.mark.parametrize(
    ("kind", "value", "written", "interleave"),
    [
        ("i2", -9999, "-9999", "bil"),
        ("u2", 65535, "65535", "bsq"),
        ("f4", -3.4028234663852886e38, "-3.40282347e+38", "bip"),
        ("f4", np.nan, "NaN", "bil"),
    ],
)
def test_the_ignore_value_of_a_cube_is_no_number(tmp_path, kind, value, written, interleave):
    stored = np.where(EMPTY, value, CUBE.astype(float)).astype(kind)
    path = envi(tmp_path, f"data ignore value = {written}", stored, kind, interleave)
    found = read_frame(path)
    assert np.array_equal(np.isnan(found), EMPTY) and np.array_equal(found[~EMPTY], CUBE[~EMPTY])
    assert np.array_equal(open_envi(path).read_lines(3, 5), found[3:5], equal_nan=True)
    facts = read_facts(path)
    assert facts.nodata == pytest.approx(value, rel=1e-6, nan_ok=True)
    assert len(facts.notes) == 1 and facts.dtype == np.dtype(kind).name


@pytest.mark.parametrize("value", ["-9999", "12.5", "none", "1e400"])
def test_an_ignore_value_that_no_sample_can_have_changes_nothing(tmp_path, value):
    facts = read_facts(path := envi(tmp_path, f"data ignore value = {value}", kind="u2"))
    assert facts.nodata is None and len(facts.notes) == 1
    assert read_frame(path).dtype == np.uint16


@pytest.mark.parametrize("dtype", ["int16", "uint16", "float32"])
def test_nodata_that_gdal_wrote_is_no_number(tmp_path, dtype):
    path, value = tmp_path / "a.tif", -9999 if dtype != "uint16" else 65535
    planes = np.where(EMPTY, value, CUBE).transpose(2, 0, 1).astype(dtype)
    size = {"height": CUBE.shape[0], "width": CUBE.shape[1], "count": CUBE.shape[2]}
    with rasterio.open(path, "w", driver="GTiff", dtype=dtype, nodata=value, **size) as out:
        out.write(planes)
    found = read_frame(path)
    assert np.array_equal(np.isnan(found), EMPTY) and np.array_equal(found[~EMPTY], CUBE[~EMPTY])
    assert read_facts(path).nodata == value


@pytest.mark.parametrize("stating", [[0], [2]])
@pytest.mark.parametrize("zero", ["minisblack", "miniswhite"])
def test_nodata_of_one_page_holds_for_all_and_is_the_stored_value(tmp_path, stating, zero):
    path, full = tmp_path / "a.tif", 65535
    stored = np.where(EMPTY, 0, CUBE).astype(np.uint16)
    with tifffile.TiffWriter(path) as file:
        for page in range(4):
            tags = [(42113, 2, 2, "0", True)] if page in stating else []
            file.write(stored[..., page], photometric=zero, metadata=None, extratags=tags)
    assert read_facts(path).nodata == 0
    for page in range(4) if 0 in stating else stating:
        found = read_frame(path, page=page)
        values = CUBE[..., page] if zero == "minisblack" else full - CUBE[..., page]
        assert np.array_equal(np.isnan(found), EMPTY[..., page])
        assert np.array_equal(found[~EMPTY[..., page]], values[~EMPTY[..., page]])


@pytest.mark.parametrize(
    ("line", "field", "expected"),
    [
        ("reflectance scale factor = 10000", "reflectance_scale", (10000.0,) * 4),
        ("reflectance scale factor = {1, 2, 3, 4}", "reflectance_scale", (1.0, 2.0, 3.0, 4.0)),
        ("reflectance scale factor = {1, 0, 1, 1}", "reflectance_scale", None),
        ("bbl = {1, 0, 1.0, 0.0}", "bad_bands", (1, 3)),
        ("band names = {A (400.0 nm), B (500 nm), C (600 nm), D (700 nm)}", "wavelengths", (400.0, 500.0, 600.0, 700.0)),
    ],
)  # fmt: skip
def test_what_a_header_says_of_values_and_bands_is_read(tmp_path, line, field, expected):
    assert getattr(read_facts(envi(tmp_path, line)), field) == expected


def test_gains_are_noted_and_lists_of_another_length_refused(tmp_path):
    gains = "data gain values = {2, 2, 2, 2}\ndata offset values = {0, 0, 0, 0}"
    assert len(read_facts(envi(tmp_path, gains)).notes) == 1
    with pytest.raises(UnreadableCapture) as refused:
        read_facts(envi(tmp_path, "bbl = {1, 1, 0}"))
    assert (refused.value.problems[0].code, refused.value.problems[0].field) == (
        "E_BAND_COUNT",
        "bbl",
    )
