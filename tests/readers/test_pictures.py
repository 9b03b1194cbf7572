"""Frames of any format: their samples as stored, what their headers state, and what is cut or no picture at all."""

import io
import os
import struct
import zlib

import cv2
import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms
from PIL.TiffImagePlugin import IFDRational

from levkas.readers import frames
from levkas.readers.frames import (
    UnreadableCapture,
    kind_of,
    read_facts,
    read_frame,
    read_plane,
)
from levkas.readers.pictures import PNG

RNG = np.random.default_rng(4)
CODES = RNG.integers(0, 65536, (40, 50)).astype(np.uint16)
COLOURS = RNG.integers(0, 65536, (40, 50, 3)).astype(np.uint16)
ALPHA = RNG.integers(0, 65536, (40, 50, 1)).astype(np.uint16)
PHOTO = cv2.resize(RNG.integers(0, 255, (6, 8, 3)).astype(np.uint8), (64, 48))


def refusal(path, read=read_frame, **more):
    with pytest.raises(UnreadableCapture) as refused:
        read(path, **more)
    (problem,) = refused.value.problems
    assert problem.file == str(path) and problem.fix
    return problem


def chunk(name, content):
    crc = struct.pack(">I", zlib.crc32(name + content))
    return struct.pack(">I", len(content)) + name + content + crc


def write_png(path, rows, *, width, depth=8, colour=0, before=b""):
    head = struct.pack(">IIBBBBB", width, len(rows), depth, colour, 0, 0, 0)
    pixels = zlib.compress(b"".join(b"\0" + row for row in rows))
    chunks = chunk(b"IHDR", head) + before + chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    path.write_bytes(PNG + chunks)
    return path


# --- any format ----------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["frame.tif", "packed.tif", "photo.png", "photo.jpg"])
@pytest.mark.parametrize("share", [0.02, 0.5, 0.97])
def test_a_truncated_file_is_refused_and_never_reads_as_zeros(tmp_path, name, share):
    path = tmp_path / name
    if name.endswith(".tif"):
        tifffile.imwrite(path, CODES, compression="zlib" if name == "packed.tif" else None)
    else:
        cv2.imwrite(str(path), PHOTO)
    path.write_bytes(path.read_bytes()[: int(share * path.stat().st_size)])
    assert refusal(path)


def test_what_is_no_file_is_refused(tmp_path):
    (tmp_path / "folder.tif").mkdir()
    os.mkfifo(tmp_path / "pipe.tif")
    (tmp_path / "text.tif").write_text("not an image at all")
    for name in ("nowhere.tif", "folder.tif", "pipe.tif", "null\0byte.tif", "text.tif"):
        assert refusal(tmp_path / name).code == "E_UNREADABLE"


def test_the_content_decides_and_not_the_suffix(tmp_path):
    path = tmp_path / "photo.tif"
    path.write_bytes(imagecodecs.png_encode(CODES))
    assert kind_of(path) == read_facts(path).kind == "png"
    assert np.array_equal(read_frame(str(path)), CODES)
    assert np.array_equal(read_frame(path, page=0), CODES)
    assert refusal(path, page=1).field == "page"


def test_facts_of_an_untouched_file_are_read_once_and_of_a_changed_one_anew(tmp_path, monkeypatch):
    path, opened, reader = tmp_path / "frame.png", [], frames._call

    def counted(kind, which, path):
        opened.append(path)
        return reader(kind, which, path)

    monkeypatch.setattr(frames, "_call", counted)
    path.write_bytes(imagecodecs.png_encode(CODES))
    assert [read_facts(path).shape for _ in range(3)] == [CODES.shape] * 3
    assert opened == [path]
    path.write_bytes(imagecodecs.png_encode(CODES[:9]))
    assert read_facts(path).shape == (9, 50)


def test_every_real_frame_is_what_its_facts_declare(real_data):
    folders = ["filterwheel-disks/dark", "rededge-5lens", "silios-kinect/burst", "paintings"]
    paths = [p for f in folders for p in sorted((real_data / f).glob("*.*"))]
    assert len(paths) == 28 + 10 + 12 + 3
    for path in paths[::6]:
        facts, values = read_facts(path), read_frame(path)
        assert values.shape == facts.shape and values.dtype == facts.dtype


# --- PNG -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("image", [CODES, COLOURS], ids=["gray", "colour"])
def test_samples_of_a_png_come_out_as_stored_and_colours_red_green_blue(tmp_path, dtype, image):
    path, image = tmp_path / "frame.png", image.astype(dtype)
    cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)
    assert np.array_equal(read_frame(path), image)
    facts = read_facts(path)
    found = (facts.shape, facts.dtype, facts.bits)
    assert found == (image.shape, image.dtype.name, 8 * image.itemsize)


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
    assert len(read_facts(path).notes) == (colour in (4, 6))


def test_significant_bits_say_where_the_sensor_is_full_and_exif_when(tmp_path):
    # One IFD: DateTime at offset 26, big endian.
    exif = struct.pack(">2sHIHHHIII", b"MM", 42, 8, 1, 0x132, 2, 20, 26, 0)
    before = chunk(b"sBIT", b"\x0c") + chunk(b"eXIf", exif + b"2020:05:11 10:00:00\0")
    rows = [struct.pack(">2H", 4095, 65520)]
    path = write_png(tmp_path / "a.png", rows, width=2, depth=16, before=before)
    facts = read_facts(path)
    assert (facts.bits, facts.saturation, facts.captured) == (12, 65520.0, "2020-05-11T10:00:00")
    assert read_frame(path).tolist() == [[4095, 65520]]


def test_one_flipped_bit_in_the_pixels_of_a_png_is_found_wherever_it_is(tmp_path):
    path = tmp_path / "frame.png"
    cv2.imwrite(str(path), PHOTO)
    data = path.read_bytes()
    first, last = data.index(b"IDAT") + 4, data.index(b"IEND") - 4
    for place in range(first, last, (last - first) // 20):
        path.write_bytes(data[:place] + bytes([data[place] ^ 1]) + data[place + 1 :])
        assert refusal(path)


# --- JPEG ----------------------------------------------------------------------------------------


def write_photo(path, image=PHOTO, **options):
    Image.fromarray(image).save(path, **options)
    return path


@pytest.mark.parametrize("progressive", [False, True])
@pytest.mark.parametrize("image", [PHOTO, PHOTO[..., 0]], ids=["colour", "gray"])
def test_a_photograph_is_what_pillow_decodes(tmp_path, progressive, image):
    path = write_photo(tmp_path / "photo.jpg", image, progressive=progressive)
    assert np.array_equal(read_frame(path), np.asarray(Image.open(path)))
    assert (read_facts(path).shape, read_facts(path).encoded) == (image.shape, "JPEG")


def test_orientation_is_ignored_and_exposure_and_date_are_read(tmp_path):
    exif = Image.Exif()
    exif[0x0112], exif[0x0110] = 6, "D80"
    exif.get_ifd(0x8769).update(
        {0x9003: "2019:02:08 17:43:35", 0x829A: IFDRational(1, 4), 0x8827: 100, 0x9011: "+01:00"}
    )
    path = write_photo(tmp_path / "photo.jpg", exif=exif)
    facts = read_facts(path)
    assert read_frame(path).shape == (48, 64, 3) == facts.shape
    assert (facts.exposure_s, facts.iso, facts.model, facts.bits) == (0.25, 100, "D80", 8)
    assert facts.captured == "2019-02-08T17:43:35+01:00"


def test_a_cut_photograph_with_a_whole_thumbnail_is_refused(tmp_path):
    thumbnail = io.BytesIO()
    Image.fromarray(PHOTO[::4, ::4]).save(thumbnail, "jpeg")
    path = write_photo(tmp_path / "photo.jpg")
    data, small = path.read_bytes(), thumbnail.getvalue()
    whole = data[:2] + b"\xff\xe2" + struct.pack(">H", len(small) + 2) + small + data[2:]
    path.write_bytes(whole)
    assert read_frame(path).shape == (48, 64, 3)
    path.write_bytes(whole[:-40])
    assert refusal(path).code == "E_TRUNCATED"


# --- samples of a TIFF that do not count ---------------------------------------------------------


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize(("compression", "alpha"), [(None, "unassalpha"), ("zlib", "assocalpha")])
@pytest.mark.parametrize("image", [CODES, COLOURS], ids=["grey", "colours"])
def test_alpha_of_a_tiff_is_no_sample_of_the_frame(tmp_path, image, alpha, compression, planar):
    path = tmp_path / "a.tif"
    samples = np.concatenate([np.atleast_3d(image), ALPHA], axis=2)
    stored = samples if planar == "contig" else np.moveaxis(samples, 2, 0)
    options = {"planarconfig": planar, "extrasamples": [alpha], "compression": compression}
    photometric = "minisblack" if image.ndim == 2 else "rgb"
    tifffile.imwrite(path, stored, photometric=photometric, rowsperstrip=8, **options)
    assert read_facts(path).shape == image.shape and read_facts(path).notes
    assert np.array_equal(read_frame(path), image)


def test_equal_samples_of_a_band_are_one_and_unlike_ones_are_refused(tmp_path):
    path, samples = tmp_path / "grey.tif", np.dstack([CODES] * 3)
    tifffile.imwrite(path, samples, photometric="rgb")
    assert read_frame(path).shape == (40, 50, 3)
    assert np.array_equal(read_plane(path), CODES)
    samples[7, 9, 2] ^= 1
    tifffile.imwrite(path, samples, photometric="rgb")
    assert refusal(path, read_plane).code == "E_BAND_COUNT"


# --- tone curves ---------------------------------------------------------------------------------

SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def linear_profile():
    """sRGB's primaries with straight curves."""
    data = bytearray(SRGB)
    (count,) = struct.unpack_from(">I", data, 128)
    for at in range(132, 132 + 12 * count, 12):
        name, start, _ = struct.unpack_from(">4sII", data, at)
        if name in (b"rTRC", b"gTRC", b"bTRC"):
            data[start : start + 14] = b"curv" + bytes(4) + struct.pack(">IH", 1, 256)
    return bytes(data)


def profile(data):
    return chunk(b"iCCP", b"mine\0\0" + data)


@pytest.mark.parametrize(
    ("before", "encoded"),
    [
        (b"", False),
        (chunk(b"sRGB", b"\0"), True),
        (chunk(b"gAMA", struct.pack(">I", 45455)), True),
        (profile(zlib.compress(SRGB)), True),
        (profile(zlib.compress(linear_profile())), False),
    ],
    ids=[
        "none",
        "sRGB",
        "gAMA",
        "profile of sRGB",
        "linear profile",
    ],  # profiles hold the time of day
)
def test_a_png_states_its_curve_in_one_of_three_chunks(tmp_path, before, encoded):
    path = write_png(tmp_path / "a.png", [b"\1"], width=1, before=before)
    assert bool(read_facts(path).encoded) == encoded


def test_a_tiff_states_its_curve_by_profile_or_exif(tmp_path):
    path = tmp_path / "a.tif"
    for made, encoded in ((SRGB, True), (linear_profile(), False)):
        tifffile.imwrite(path, CODES, iccprofile=made)
        assert bool(read_facts(path).encoded) == encoded
    tifffile.imwrite(path, CODES, extratags=[(40961, "H", 1, 1, True)])  # ColorSpace
    assert read_facts(path).encoded == "sRGB"
