import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.problems import Refused
from levkas.readers.envi import DATA_TYPES, open_envi
from levkas.readers.facts import UnreadableCapture
from levkas.readers.frames import read_facts, read_frame

ORDER = {"bsq": (2, 0, 1), "bil": (0, 2, 1), "bip": (0, 1, 2)}


def write_envi(
    folder, cube, *, interleave="bil", big=False, suffix=".raw", extra="", name="scan", offset=0
):
    code = next(k for k, v in DATA_TYPES.items() if v == cube.dtype.str[1:])
    lines, samples, bands = cube.shape
    header = [
        "ENVI",
        "; written by a vendor",
        f"samples = {samples}",
        f"Lines={lines}",
        f"bands   = {bands}",
        f"data type = {code}",
        f"interleave = {interleave}",
        extra,
    ]
    if big:
        header.append("byte order = 1")
    if offset:
        header.append(f"header offset = {offset}")
    (folder / f"{name}.hdr").write_text("\n".join(header) + "\n")
    data = cube.transpose(ORDER[interleave]).astype(cube.dtype.newbyteorder(">" if big else "<"))
    (folder / f"{name}{suffix}").write_bytes(b"\7" * offset + data.tobytes())
    return folder / f"{name}.hdr"


@settings(deadline=None, max_examples=40)
@given(
    st.sampled_from(sorted(ORDER)),
    st.sampled_from(["u1", "i2", "u2", "i4", "f4", "f8"]),
    st.booleans(),
    st.sampled_from([".raw", ".dat", ".img", ""]),
    st.tuples(st.integers(1, 5), st.integers(1, 5), st.integers(1, 5)),
    st.integers(0, 9),
)
def test_what_a_vendor_wrote_is_what_is_read(
    tmp_path_factory, interleave, dtype, big, suffix, shape, offset
):
    folder = tmp_path_factory.mktemp("envi")
    cube = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    path = write_envi(folder, cube, interleave=interleave, big=big, suffix=suffix, offset=offset)
    assert np.array_equal(read_frame(path), cube)
    assert np.array_equal(read_frame(folder / f"scan{suffix}"), cube)
    opened = open_envi(path)
    assert np.array_equal(opened.read_lines(shape[0] - 1, shape[0]), cube[-1:])


def test_lists_over_many_lines_comments_and_units_are_understood(tmp_path):
    extra = "wavelength units = Micrometers\nwavelength = {\n 0.4,\n;a comment\n 0.5 ,0.6}\nFWHM = {0.01,0.01,0.01}\nband names = {a, b, c}"
    facts = read_facts(write_envi(tmp_path, np.zeros((2, 2, 3), np.uint16), extra=extra))
    assert facts.wavelengths == (400.0, 500.0, 600.0) and facts.fwhm == (10.0, 10.0, 10.0)
    assert facts.band_names == ("a", "b", "c")


def test_data_cut_short_say_expected_found_and_the_likely_field(tmp_path):
    path = write_envi(tmp_path, np.zeros((4, 5, 3), np.uint16))
    data = tmp_path / "scan.raw"
    data.write_bytes(data.read_bytes()[:-30])
    with pytest.raises(UnreadableCapture) as refused:
        read_frame(path)
    problem = refused.value.problems[0]
    assert problem.code == "E_TRUNCATED" and "lines" in problem.field
    assert problem.found == "90 bytes" and problem.expected.startswith("120 bytes")
    assert "lines = 3" in problem.fix


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("bands   = 3", ""), "does not say its bands"),
        (("data type = 12", "data type = 6"), "samples of this type"),
        (("interleave = bil", "interleave = bix"), "unknown interleave"),
        (("bands   = 3", "bands   = 99999999999"), "cannot be right"),
        (("ENVI\n", "NVI\n"), "no ENVI header"),
        (("; written by a vendor", "wavelength = {1, 2"), "has no end"),
        (("; written by a vendor", "wavelength = {1, 2}"), "does not fit the bands"),
    ],
)
def test_a_header_that_cannot_be_right_is_refused(tmp_path, change, message):
    path = write_envi(tmp_path, np.zeros((4, 5, 3), np.uint16))
    path.write_text(path.read_text().replace(*change))
    with pytest.raises(UnreadableCapture, match=message):
        read_frame(path)


def test_a_header_without_data_says_what_it_looked_for(tmp_path):
    path = write_envi(tmp_path, np.zeros((1, 1, 1), np.uint8))
    (tmp_path / "scan.raw").unlink()
    with pytest.raises(UnreadableCapture, match=r"\.raw, \.dat"):
        read_facts(path)


@settings(deadline=None, max_examples=80)
@given(st.lists(st.tuples(st.integers(0, 200), st.integers(0, 255)), min_size=1, max_size=5))
def test_a_mutated_header_gives_a_cube_or_our_refusal(tmp_path_factory, changes):
    folder = tmp_path_factory.mktemp("mutated")
    path = write_envi(folder, np.zeros((3, 4, 2), np.uint16), extra="wavelength = {400, 500}")
    data = bytearray(path.read_bytes())
    for place, value in changes:
        data[place % len(data)] = value
    path.write_bytes(data)
    try:
        read_frame(path)
    except Refused:
        pass


def test_the_real_line_scan_reads_as_it_is_stored(real_data):
    path = real_data / "envi-linescan/white_reference_crop.hdr"
    ours = read_frame(path)
    assert ours.shape == (31, 43, 580)
    raw = np.fromfile(path.with_suffix(".raw"), "<u2").reshape(31, 580, 43)
    assert np.array_equal(ours, raw.transpose(0, 2, 1))
