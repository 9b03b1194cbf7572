import numpy as np
import pytest
import spectral.io.envi as spy
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.readers.envi import DATA_TYPES, open_envi
from levkas.readers.facts import UnreadableCapture
from levkas.readers.frames import read_facts, read_frame

ORDER = {"bsq": (2, 0, 1), "bil": (0, 2, 1), "bip": (0, 1, 2)}
CUBE = np.arange(60, dtype=np.uint16).reshape(4, 5, 3)


def write_envi(folder, cube, *, interleave="bil", big=False, suffix=".raw", extra="", offset=0):
    """Write ``scan.hdr`` as a vendor might, and its data; returns the header."""
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
    header += ["byte order = 1"] * big + [f"header offset = {offset}"] * bool(offset)
    (folder / "scan.hdr").write_text("\n".join(header) + "\n", encoding="utf-8")
    data = cube.transpose(ORDER[interleave]).astype(cube.dtype.newbyteorder(">" if big else "<"))
    (folder / f"scan{suffix}").write_bytes(b"\7" * offset + data.tobytes())
    return folder / "scan.hdr"


def refusal(path):
    with pytest.raises(UnreadableCapture) as refused:
        read_frame(path)
    (problem,) = refused.value.problems
    return problem


def header_facts(folder, row):
    return read_facts(write_envi(folder, CUBE, extra=row))


@settings(deadline=None, max_examples=25)
@given(
    st.sampled_from(sorted(ORDER)),
    st.sampled_from(sorted(DATA_TYPES.values())),
    st.booleans(),
    st.sampled_from([".raw", ".dat", ".img", ".bil", ".BSQ", ""]),
    st.tuples(st.integers(1, 5), st.integers(1, 5), st.integers(1, 5)),
    st.integers(0, 9),
)
def test_what_a_vendor_wrote_is_what_is_read(
    tmp_path_factory, interleave, dtype, big, suffix, shape, offset
):
    folder = tmp_path_factory.mktemp("envi")
    limits = np.iinfo(dtype) if dtype[0] in "ui" else np.finfo(dtype)
    cube = np.arange(np.prod(shape)).reshape(shape).astype(dtype)
    cube.flat[-1] = limits.max  # a swapped byte would show
    path = write_envi(folder, cube, interleave=interleave, big=big, suffix=suffix, offset=offset)
    values = read_frame(path)
    assert np.array_equal(values, cube) and values.dtype == dtype and values.dtype.isnative
    assert np.array_equal(read_frame(folder / f"scan{suffix}"), cube)


@settings(deadline=None, max_examples=12)
@given(st.sampled_from(sorted(ORDER)), st.booleans(), st.data())
def test_blocks_of_lines_are_parts_of_the_whole(tmp_path_factory, interleave, big, data):
    cube = np.arange(7 * 3 * 4, dtype=np.uint16).reshape(7, 3, 4)
    opened = open_envi(
        write_envi(tmp_path_factory.mktemp("envi"), cube, interleave=interleave, big=big)
    )
    start = data.draw(st.integers(0, 7))
    stop = data.draw(st.integers(start, 7))
    block = opened.read_lines(start, stop)
    assert block.shape == (stop - start, 3, 4) and np.array_equal(block, cube[start:stop])
    with pytest.raises(ValueError):
        opened.read_lines(3, 8)


@pytest.mark.parametrize(("interleave", "dtype"), [("bil", "u1"), ("bip", "i2"), ("bsq", "f4")])
def test_spectral_python_reads_the_same(tmp_path, interleave, dtype):
    cube = np.random.default_rng(1).integers(0, 100, (6, 5, 4)).astype(dtype)
    path = tmp_path / "spy.hdr"
    spy.save_image(str(path), cube, interleave=interleave, ext=".img", dtype=dtype)
    assert np.array_equal(read_frame(path), np.asarray(spy.open(str(path)).load(dtype=dtype)))


def test_comments_quotes_spaces_and_case_are_read_as_meant(tmp_path):
    extra = """  Wavelength   UNITS = "Nanometers" ; said by the camera
    ;samples = 99
    Description = { one; two, three }
    sensor type = 'Specim V10E'
    wavelength = { 400.0, ; blue
      500.0 ,
    ; a comment, with a } in it
      600.0 }
    band names = {"B 1", B2; B3,
    B4}
    reflectance scale factor = 10000
    data ignore value = -1
    tint = 20.0
    acquisition date = DATE(yyyy-mm-dd): 2019-05-03"""
    opened = open_envi(write_envi(tmp_path, CUBE, extra=extra))
    facts = opened.facts
    assert facts.wavelengths == (400.0, 500.0, 600.0) and facts.band_names == (
        "B 1",
        "B2; B3",
        "B4",
    )
    assert (facts.model, facts.exposure_s, facts.captured) == ("Specim V10E", 0.02, "2019-05-03")
    assert facts.reflectance_scale == (10000.0,) * 3
    assert facts.nodata is None and len(facts.notes) == 1
    assert opened.header["description"] == ["one; two", "three"]


@pytest.mark.parametrize(
    ("said", "found"),
    [
        ("acquisition date = DATE(yyyy-mm-dd): 2019-05-03\nStart Time = UTC TIME: 08:18:45", "2019-05-03T08:18:45+00:00"),
        ("acquisition date = 1970-01-01", None),
        ("acquisition time = 2024-05-03T16:00:00", "2024-05-03T16:00:00"),
        ("acquisition time = 2024-05-03T16:00:00.250+02:00", "2024-05-03T16:00:00.250+02:00"),
    ],
)  # fmt: skip
def test_day_and_time_of_a_scan_are_read(tmp_path, said, found):
    assert header_facts(tmp_path, said).captured == found


@pytest.mark.parametrize(
    ("said", "read"),
    [
        ("tint = 20.0", 0.02),  # Specim's, in ms
        ("integration time (µs) = 20000", 0.02),
        ("integration time = 20\nintegration time units = milliseconds", 0.02),
        ("tint = 20\nexposure = 20.1 ms", 0.02),
        ("tint = {10, 20, 40}", (0.01, 0.02, 0.04)),
        ("integration time = 20", "integration time = 20"),  # HySpex's are µs, others' ms
        ("tint = 20\nexposure = 10 ms", "tint = 20; exposure = 10 ms"),
        ("exposures = {10 ms, 20 us, 40 ms}", "exposures = 10 ms, 20 us, 40 ms"),
        ("tint = 0\nexposure = auto\nexposure mode = 3", None),
    ],
)
def test_exposures_are_read_with_their_units_and_never_without(tmp_path, said, read):
    facts = read_facts(write_envi(tmp_path, CUBE, extra=said))
    stated = facts.exposure_s, facts.band_times_s, facts.exposure_unclear
    assert stated.count(None) == (3 if read is None else 2)
    assert next((one for one in stated if one is not None), None) == read


GAIN, STOP = (("gain", "6 db"),), 2.8


@pytest.mark.parametrize(
    ("row", "field", "value"),
    [("gain = 6 dB", "gain", GAIN), ("Gain (dB) = 6.0", "gain", GAIN), ("camera_gain = 6", "gain", (("camera gain", "6"),)),
     ("gain mode = high", "gain", (("gain mode", "high"),)), ("gain file = white_1.cal", "gain", None),
     ("fstop = 2.8", "f_number", STOP), ("f-number = f/2.8", "f_number", STOP), ("aperture = F 2,8", "f_number", STOP),
     ("f-stop = 1:2.8", "f_number", STOP), ("aperture (mm) = 4", "f_number", None),
     ("iso_speed_rating = ISO 400", "iso", 400), ("lens_focal_length = 23 mm", "focal_mm", 23),
     ("Camera_Model = FX10", "model", "FX10"), ("camera serial-no = 12", "serial", "12"),
     ("horizontal_binning = 2", "binning", (("horizontal binning", "2"),)), ("X_Start = 0", "region", (("x start", "1"),)),
     ("exposure_time_ms = 20", "exposure_s", 0.02), ("IntegrationTime[us] = 20000", "exposure_s", 0.02)],
)  # fmt: skip
def test_a_setting_is_read_however_its_key_is_written(tmp_path, row, field, value):
    assert getattr(header_facts(tmp_path, row), field) == value


@pytest.mark.parametrize(
    ("units", "written", "read"),
    [
        ("Micrometers", "0.4, .5, 6e-1", (400, 500, 600)),
        ("Wavenumber", "25000, 20000, 15625", (400, 500, 640)),
    ],
)
def test_wavelengths_come_out_in_nanometres(tmp_path, units, written, read):
    extra = f"wavelength units = {units}\nwavelength = {{{written}}}\nfwhm = {{{written}}}"
    facts = read_facts(write_envi(tmp_path, CUBE, extra=extra))
    assert facts.wavelengths == read == facts.fwhm


def test_a_key_said_twice_is_the_last_but_a_layout_must_agree(tmp_path):
    path = write_envi(tmp_path, CUBE, extra="sensor type = A\nsensor type = B\nsamples = 5")
    assert read_facts(path).model == "B"
    path = write_envi(tmp_path, CUBE, extra="samples = 6")
    assert (refusal(path).field, refusal(path).found) == ("samples", "5 and 6")


@pytest.mark.parametrize(
    ("keep", "likely"),
    [
        (90, "lines"),
        (240, "data type"),
        (80, "bands"),
        (127, "header offset"),
        (91, "lines, samples, bands or data type"),
    ],
)
def test_a_misfit_says_expected_found_and_the_likely_field(tmp_path, keep, likely):
    path = write_envi(tmp_path, CUBE, interleave="bsq" if likely == "bands" else "bil")
    data = tmp_path / "scan.raw"
    whole = data.read_bytes()
    data.write_bytes((whole * 3)[:keep])
    problem = refusal(path)
    assert problem.code == ("E_TRUNCATED" if keep < len(whole) else "E_SIZE")
    assert (problem.field, problem.found) == (f"scan.hdr: {likely}", f"{keep} bytes")


def test_data_that_shrink_while_they_are_read_are_refused(tmp_path):
    opened = open_envi(write_envi(tmp_path, CUBE))
    data = tmp_path / "scan.raw"
    data.write_bytes(data.read_bytes()[:-1])
    with pytest.raises(UnreadableCapture) as refused:
        opened.read()
    assert refused.value.problems[0].code == "E_TRUNCATED"


@pytest.mark.parametrize(
    ("change", "field"),
    [
        (("bands   = 3", ""), "bands"),
        (("bands   = 3", "bands   = 99999999999"), "lines, samples, bands"),
        (("data type = 12", "data type = 6"), "data type"),
        (("interleave = bil", "interleave = bix"), "interleave"),
        (("interleave", "header offset = -4\ninterleave"), "header offset"),
        (("interleave", "file compression = 1\ninterleave"), "file compression"),
        (("ENVI\n", "NVI\n"), "header"),
        (("; written by a vendor", "wavelength = {1, 2, x}"), "wavelength"),
    ],
)
def test_a_header_that_cannot_be_right_is_refused_by_its_field(tmp_path, change, field):
    path = write_envi(tmp_path, CUBE)
    path.write_text(path.read_text().replace(*change))
    assert refusal(path).field == field


def test_header_and_data_find_each_other(tmp_path):
    path = write_envi(tmp_path, CUBE)
    path.rename(tmp_path / "scan.raw.hdr")
    for name in ("scan.raw", "scan.raw.hdr"):
        assert np.array_equal(read_frame(tmp_path / name), CUBE)
    (tmp_path / "scan.raw").rename(tmp_path / "other.bin")
    assert refusal(tmp_path / "scan.raw.hdr").field == "data file"
    assert refusal(tmp_path / "other.bin").code == "E_UNREADABLE"
    path = write_envi(tmp_path, CUBE, extra="data file = other.bin")
    assert open_envi(path).data.name == "other.bin"


@pytest.mark.parametrize("name", ["4-22-22_right_same_B73_top_00", "white_reference_crop"])
def test_the_real_line_scan_reads_as_it_is_stored(real_data, name):
    path = real_data / f"envi-linescan/{name}.hdr"
    opened = open_envi(path)
    facts = opened.facts
    assert facts.shape == (31, 43, 580) and facts.interleave == "bil"
    assert (facts.wavelengths[0], facts.wavelengths[1]) == (366.551, 367.656)
    raw = np.fromfile(path.with_suffix(".raw"), "<u2").reshape(31, 580, 43)
    assert np.array_equal(opened.read(), raw.transpose(0, 2, 1))
    assert np.array_equal(opened.read_lines(30, 31)[0, 42], raw[30, :, 42])
