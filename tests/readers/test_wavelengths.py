"""Wavelengths in whatever unit and place a file states them."""

import numpy as np
import pytest
import tifffile
from hypothesis import assume, given
from hypothesis import strategies as st

from levkas.readers.frames import read_facts, read_frame
from levkas.readers.wavelengths import RANGE_NM, read_centres

NM = [450.0, 550.0, 650.0]
STACK = np.random.default_rng(1).integers(0, 4096, (3, 20, 24)).astype(np.uint16)
UNITS = {  # of one nanometre's wave, by hand
    "nm": lambda nm: nm, "Nanometers": lambda nm: nm, "um": lambda nm: nm / 1000,
    "Micrometers": lambda nm: nm / 1000, "Angstroms": lambda nm: nm * 10,
    "Wavenumber": lambda nm: 1e7 / nm, "cm-1": lambda nm: 1e7 / nm,
    "THz": lambda nm: 299_792.458 / nm, "GHz": lambda nm: 299_792_458 / nm,
    "eV": lambda nm: 1239.841984 / nm,
}  # fmt: skip


@given(st.sampled_from(sorted(UNITS)), st.lists(st.floats(*RANGE_NM), min_size=1, max_size=9))
def test_every_unit_comes_out_in_nanometres(unit, centres):
    found = read_centres([UNITS[unit](nm) for nm in centres], unit, [10.0] * len(centres))
    inside = np.clip(found.nm, *RANGE_NM) if found.nm else found.nm
    assert found.nm is None or np.allclose(inside, centres, rtol=1e-6)
    edge = any(nm < 1.001 * RANGE_NM[0] or nm > 0.999 * RANGE_NM[1] for nm in centres)
    assert edge or (found.nm is not None and not found.note and not found.unclear)


@given(st.lists(st.floats(*RANGE_NM), min_size=1, max_size=9))
def test_a_wrong_unit_of_length_is_seen_through_and_said(centres):
    micrometres = [nm / 1000 for nm in centres]
    assume(micrometres not in ([1.0], [1.0, 2.0]))  # those are numbers of bands, as below
    for written, unit in ((micrometres, "Nanometers"), (centres, "Micrometers")):
        found = read_centres(written, unit)
        assert np.allclose(found.nm, centres) and unit in found.note
    assert np.allclose(read_centres(micrometres).nm, centres)
    assert not read_centres(micrometres).note  # nothing else was stated


def test_widths_are_widths_of_their_bands_in_either_unit():
    assert read_centres([0.4, 0.5], "um", [0.01, 0.02]).fwhm == (10.0, 20.0)
    assert read_centres([400, 500], "nm", [0.01, 0.02]).fwhm == (10.0, 20.0)
    assert read_centres([400, 500], "nm", [900, 2]).fwhm is None
    ten = read_centres([20_000.0], "Wavenumber", [400.0])  # 490 to 510 nm is 20408 to 19608
    assert ten.nm == (500.0,) and ten.fwhm == (10.0,)


@pytest.mark.parametrize("values", [[0.01, 0.05], [1e5, 2e5], [0.4, 700.0], [-400.0, 500.0]])
@pytest.mark.parametrize("unit", ["nm", "um", "Unknown", ""])
def test_numbers_that_are_no_wavelengths_in_any_unit_are_not_understood(values, unit):
    found = read_centres(values, unit)
    assert found.nm is None and found.unclear


@pytest.mark.parametrize("values", [[0, 1, 2], [1, 2, 3], [0, 0, 0], []])
def test_numbers_of_bands_are_no_wavelengths(values):
    assert read_centres(values, "Unknown") == read_centres([], "")


# --- where TIFFs have them -----------------------------------------------------------------------


def imagej(path, labels):
    tifffile.imwrite(path, STACK, imagej=True, metadata={"Labels": labels})


def page_names(path, labels):
    with tifffile.TiffWriter(path) as tiff:
        for page, label in zip(STACK, labels, strict=True):
            tiff.write(page, metadata=None, extratags=[(285, "s", 0, label, True)])


def descriptions(path, labels):
    with tifffile.TiffWriter(path) as tiff:
        for page, label in zip(STACK, labels, strict=True):
            tiff.write(page, metadata=None, description=label)


def spectral(path, labels):
    render = np.zeros((*STACK.shape[1:], 3), np.uint8)
    with tifffile.TiffWriter(path) as tiff:
        tiff.write(render, photometric="rgb", metadata=None)
        for i, page in enumerate(STACK):
            tags = [(65000, "f", 3, NM, True), (65111, "s", 0, "made by hand", True)]
            tiff.write(page, metadata=None, extratags=[] if i else tags, contiguous=False)


@pytest.mark.parametrize("write", [imagej, page_names, descriptions, spectral])
def test_wavelengths_of_a_tiff_are_found_where_its_program_writes_them(tmp_path, write):
    path = tmp_path / "stack.tif"
    write(path, [f"{nm:g} nm" for nm in NM])
    facts = read_facts(path)
    assert facts.wavelengths == tuple(NM)
    assert all(np.array_equal(read_frame(path, page=i), STACK[i]) for i in range(3))


@pytest.mark.parametrize("write", [imagej, page_names, descriptions])
def test_labels_that_are_names_of_files_are_no_names_of_bands(tmp_path, write):
    path = tmp_path / "stack.tif"
    write(path, [f"white_{i:04}.tif" for i in range(3)])
    facts = read_facts(path)
    assert facts.wavelengths is None and facts.band_names is None
    assert facts.page_labels == ("white_0000.tif", "white_0001.tif", "white_0002.tif")


def test_a_spectral_tiff_of_whole_numbers_holds_reflectance_and_one_of_counts_does_not(tmp_path):
    spectral(tmp_path / "a.tif", NM)
    assert read_facts(tmp_path / "a.tif").reflectance_scale == (65535.0,) * 3
    text = '{"quantity": "counts", "bands": ["x", "y", "z"], "wavelength": [null, null, null]}'
    tags = [(65000, "f", 3, (0, 1, 2), True), (65111, "s", 0, text, True)]
    with tifffile.TiffWriter(tmp_path / "b.tif") as tiff:
        for page in STACK.astype(np.float32):
            tiff.write(page, metadata=None, extratags=tags, contiguous=False)
    facts = read_facts(tmp_path / "b.tif")
    assert facts.reflectance_scale is None and facts.wavelengths is None
    assert facts.band_names == ("x", "y", "z")


# --- pages that are no images --------------------------------------------------------------------


@pytest.mark.parametrize(("order", "big"), [("<", False), (">", True)])
def test_a_small_first_page_is_a_preview_and_said(tmp_path, order, big):
    path = tmp_path / "a.tif"
    frame = STACK[0]
    with tifffile.TiffWriter(path, byteorder=order, bigtiff=big) as tiff:
        tiff.write(frame[::4, ::4], metadata=None)
        tiff.write(frame, metadata=None)
        tiff.write(frame[::2, ::2], metadata=None)
    facts = read_facts(path)
    assert (facts.shape, facts.pages) == (frame.shape, 1)
    assert len(facts.notes) == 1
    assert np.array_equal(read_frame(path), frame)
