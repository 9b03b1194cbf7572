import struct

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.problems import Refused
from levkas.readers.frames import UnreadableCapture, read_facts, read_frame

RNG = np.random.default_rng(1)
CODES = RNG.integers(0, 4096, (24, 30)).astype(np.uint16)


def write_dng(path, mosaic, pattern=(0, 1, 1, 2), black=64, white=4095, table=None):
    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True),
        (50708, "s", 0, "Levkas test", True),
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, pattern, True),
        (50714, "H", 1, black, True),
        (50717, "I", 1, white, True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        (50778, "H", 1, 21, True),
        (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
    ]
    if table is not None:
        tags.append((50712, "H", len(table), tuple(int(t) for t in table), True))
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags, metadata=None)


@pytest.mark.parametrize("compression", [None, "zlib", "lzw", "packbits"])
def test_a_tiff_is_read_as_it_was_written(tmp_path, compression):
    path = tmp_path / "frame.tif"
    tifffile.imwrite(path, CODES, compression=compression)
    assert np.array_equal(read_frame(path), CODES)
    facts = read_facts(path)
    assert (facts.kind, facts.shape, facts.dtype, facts.bits) == ("tiff", (24, 30), "uint16", 16)


def test_pages_of_a_tiff_are_read_one_by_one(tmp_path):
    path = tmp_path / "pages.tif"
    stack = RNG.integers(0, 255, (3, 20, 21)).astype(np.uint8)
    tifffile.imwrite(path, stack, photometric="minisblack")
    assert read_facts(path).pages == 3
    assert np.array_equal(read_frame(path, page=2), stack[2])
    with pytest.raises(UnreadableCapture, match="no page 3"):
        read_frame(path, page=3)


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_colours_of_a_png_come_out_red_green_blue(tmp_path, dtype):
    path = tmp_path / "photo.png"
    image = np.zeros((5, 7, 3), dtype)
    image[..., 0] = 200
    cv2.imwrite(str(path), image[..., ::-1])
    assert np.array_equal(read_frame(path), image)


def test_the_orientation_in_exif_is_ignored(tmp_path):
    path = tmp_path / "photo.jpg"
    image = np.full((16, 32, 3), 90, np.uint8)
    data = cv2.imencode(".jpg", image)[1].tobytes()
    exif = b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif + data[2:])
    assert read_frame(path).shape == (16, 32, 3) == read_facts(path).shape


def test_a_dng_gives_the_mosaic_bit_exact_with_its_levels_and_pattern(tmp_path):
    path = tmp_path / "frame.dng"
    mosaic = RNG.integers(64, 4096, (64, 96)).astype(np.uint16)
    write_dng(path, mosaic, pattern=(1, 2, 0, 1))
    assert np.array_equal(read_frame(path), mosaic)
    facts = read_facts(path)
    assert (facts.kind, facts.pattern, facts.black, facts.saturation) == ("raw", "GBRG", 64, 4095)


def test_the_compression_curve_of_a_dng_is_undone(tmp_path):
    path = tmp_path / "lossy.dng"
    table = np.round(np.linspace(0, 1, 683) ** 2 * 4095)
    codes = RNG.integers(0, 683, (64, 96)).astype(np.uint16)
    write_dng(path, codes, black=0, table=table)
    assert np.array_equal(read_frame(path), table[codes].astype(np.uint16))


@pytest.mark.parametrize("name", ["frame.tif", "packed.tif", "photo.png", "photo.jpg", "frame.dng"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.97])
def test_a_truncated_file_is_refused_by_name_and_never_reads_as_zeros(tmp_path, name, share):
    path = tmp_path / name
    if name == "frame.dng":
        write_dng(path, np.full((64, 96), 900, np.uint16))
    elif name.endswith(".tif"):
        tifffile.imwrite(path, CODES, compression="zlib" if name == "packed.tif" else None)
    else:
        cv2.imwrite(str(path), RNG.integers(0, 255, (40, 50, 3)).astype(np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(UnreadableCapture, match=name):
        read_frame(path)


def test_a_tiff_without_one_of_its_strips_is_refused(tmp_path):
    path = tmp_path / "frame.tif"
    tifffile.imwrite(path, CODES, rowsperstrip=8)
    with tifffile.TiffFile(path) as tiff:
        tag = tiff.pages[0].tags["StripByteCounts"]
        place, kind = tag.valueoffset, {3: "<H", 4: "<I"}[tag.dtype]
    data = bytearray(path.read_bytes())
    struct.pack_into(kind, data, place, 0)
    path.write_bytes(data)
    with pytest.raises(UnreadableCapture) as refused:
        read_frame(path)
    assert refused.value.problems[0].code == "E_TRUNCATED"


def test_a_file_that_is_no_image_says_what_was_expected(tmp_path):
    path = tmp_path / "notes.tif"
    path.write_text("not an image at all")
    with pytest.raises(UnreadableCapture, match="TIFF, PNG, JPEG, camera raw or ENVI"):
        read_frame(path)
    with pytest.raises(UnreadableCapture, match="cannot be opened"):
        read_frame(tmp_path / "nowhere.tif")


@settings(deadline=None, max_examples=60)
@given(
    st.sampled_from(["tif", "png", "jpg"]),
    st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=6),
)
def test_a_mutated_file_gives_an_image_or_our_refusal(tmp_path_factory, kind, changes):
    path = tmp_path_factory.mktemp("mutated") / f"frame.{kind}"
    image = np.arange(20 * 24, dtype=np.uint8).reshape(20, 24)
    if kind == "tif":
        tifffile.imwrite(path, image, compression="zlib")
    else:
        cv2.imwrite(str(path), image)
    data = bytearray(path.read_bytes())
    for place, value in changes:
        data[min(int(place * len(data)), len(data) - 1)] = value
    path.write_bytes(data)
    for read in (read_facts, read_frame):
        try:
            read(path)
        except Refused as refused:
            assert str(path) in str(refused)


def test_real_captures_read(real_data):
    disks = next((real_data / "filterwheel-disks/frames").glob("*550nm_500ms*"))
    assert read_frame(disks).shape == (344, 408)
    lens = read_facts(real_data / "rededge-5lens/IMG_0000_4.tif")
    assert (
        lens.wavelengths == (840.0,)
        and lens.black == 4800
        and lens.exposure_s == pytest.approx(0.0018)
    )
    assert read_frame(real_data / "silios-kinect/board/2020511_kinect_hd_rgb.png").shape == (
        1080,
        1920,
        3,
    )
    assert read_frame(real_data / "paintings/the_scream.jpg").shape == (1528, 1200, 3)
