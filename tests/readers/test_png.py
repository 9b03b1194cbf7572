import struct
import zlib

import cv2
import numpy as np
import pytest

from levkas.readers.frames import UnreadableCapture, read_facts, read_frame
from levkas.readers.images import PNG

RNG = np.random.default_rng(3)


def chunk(name, content):
    return (
        struct.pack(">I", len(content))
        + name
        + content
        + struct.pack(">I", zlib.crc32(name + content))
    )


def write_png(path, rows, *, width, depth=8, colour=0, before=b""):
    head = struct.pack(">IIBBBBB", width, len(rows), depth, colour, 0, 0, 0)
    pixels = zlib.compress(b"".join(b"\0" + row for row in rows))
    chunks = chunk(b"IHDR", head) + before + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    path.write_bytes(PNG + chunks)
    return path


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("samples", [(), (3,)], ids=["gray", "colour"])
def test_samples_come_out_as_stored_and_colours_red_green_blue(tmp_path, dtype, samples):
    path = tmp_path / "frame.png"
    image = RNG.integers(0, np.iinfo(dtype).max, (15, 17, *samples)).astype(dtype)
    cv2.imwrite(str(path), image[..., ::-1] if samples else image)
    assert np.array_equal(read_frame(path), image)
    facts = read_facts(path)
    assert (facts.shape, facts.dtype, facts.bits) == (
        image.shape,
        image.dtype.name,
        8 * image.itemsize,
    )


@pytest.mark.parametrize(
    ("colour", "row", "before", "expected"),
    [
        (4, bytes([5, 255, 9, 0]), b"", [5, 9]),
        (6, bytes([1, 2, 3, 0, 4, 5, 6, 255]), b"", [[1, 2, 3], [4, 5, 6]]),
        (0, bytes([5, 9]), chunk(b"tRNS", b"\0\5"), [5, 9]),
        (3, bytes([1, 0]), chunk(b"PLTE", bytes([7, 8, 9, 1, 2, 3])), [[1, 2, 3], [7, 8, 9]]),
    ],
    ids=["gray and alpha", "colour and alpha", "gray with a transparent value", "palette"],
)
def test_alpha_is_dropped_and_palettes_are_looked_up(tmp_path, colour, row, before, expected):
    path = write_png(tmp_path / "a.png", [row] * 2, width=2, colour=colour, before=before)
    assert read_frame(path).tolist() == [expected] * 2
    assert read_facts(path).shape == read_frame(path).shape


def test_significant_bits_say_where_the_sensor_is_full(tmp_path):
    before = chunk(b"gAMA", struct.pack(">I", 45455)) + chunk(b"sBIT", b"\x0c")
    rows = [struct.pack(">2H", 4095, 65520)]
    path = write_png(tmp_path / "a.png", rows, width=2, depth=16, before=before)
    facts = read_facts(path)
    assert (facts.bits, facts.saturation) == (12, 65520.0)
    assert read_frame(path).tolist() == [[4095, 65520]]


def test_exposure_and_date_come_from_the_exif_chunk(tmp_path):
    # One IFD: DateTime at offset 26, big endian.
    exif = (
        struct.pack(">2sHIHHHIII", b"MM", 42, 8, 1, 0x132, 2, 20, 26, 0) + b"2020:05:11 10:00:00\0"
    )
    path = write_png(tmp_path / "a.png", [b"\0"], width=1, before=chunk(b"eXIf", exif))
    assert read_facts(path).captured == "2020-05-11T10:00:00"


def test_one_flipped_bit_in_the_pixels_is_found_wherever_it_is(tmp_path):
    path = tmp_path / "frame.png"
    cv2.imwrite(str(path), RNG.integers(0, 255, (40, 50)).astype(np.uint8))
    data = path.read_bytes()
    first, last = data.index(b"IDAT") + 4, data.index(b"IEND") - 4
    for place in range(first, last, (last - first) // 40):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        with pytest.raises(UnreadableCapture, match=r"frame\.png"):
            read_frame(path)


def test_pixels_for_fewer_rows_than_declared_are_refused(tmp_path):
    path = write_png(tmp_path / "short.png", [bytes(9)] * 5, width=9)
    data = path.read_bytes()
    head = struct.pack(">IIBBBBB", 9, 8, 8, 0, 0, 0, 0)
    path.write_bytes(PNG + chunk(b"IHDR", head) + data[33:])
    with pytest.raises(UnreadableCapture, match="Not enough image data"):
        read_frame(path)


@pytest.mark.parametrize("side", [0, 40_000, 2**31 - 1])
def test_a_declared_size_that_the_file_cannot_hold_is_refused(tmp_path, side):
    path = write_png(tmp_path / "bomb.png", [b"\0"], width=1)
    head = struct.pack(">IIBBBBB", side, side, 8, 0, 0, 0, 0)
    path.write_bytes(PNG + chunk(b"IHDR", head) + path.read_bytes()[33:])
    for read in (read_facts, read_frame):
        with pytest.raises(UnreadableCapture) as refused:
            read(path)
        assert refused.value.problems[0].code == "E_SIZE"


def test_the_nine_band_mosaic_and_the_kinect_read_as_opencv_reads_them(real_data):
    board = real_data / "silios-kinect/board"
    mosaic = read_frame(board / "2020511_multispectral_camera.png")
    assert mosaic.shape == (1024, 1280) and mosaic.dtype == np.uint8
    colour = read_frame(board / "2020511_kinect_hd_rgb.png")
    assert np.array_equal(colour[..., ::-1], cv2.imread(str(board / "2020511_kinect_hd_rgb.png")))
