"""Tone curves that files state of their codes."""

import io
import struct
import zlib

import imagecodecs
import numpy as np
import pytest
import tifffile
from PIL import Image, ImageCms

from levkas.readers.frames import read_facts

PLANE = np.random.default_rng(1).integers(0, 4096, (16, 20)).astype(np.uint16)
SRGB = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()


def linear_profile():
    """sRGB's primaries with straight curves: gamma 1.0 as one number, and as a parametric curve."""
    data = bytearray(SRGB)
    (count,) = struct.unpack_from(">I", data, 128)
    for at in range(132, 132 + 12 * count, 12):
        name, start, _ = struct.unpack_from(">4sII", data, at)
        if name in (b"rTRC", b"gTRC", b"bTRC"):
            data[start : start + 14] = b"curv" + bytes(4) + struct.pack(">IH", 1, 256)
    return bytes(data)


def png(path, *chunks):
    """Write a PNG with more chunks behind its header."""
    data = imagecodecs.png_encode(PLANE)
    head = 8 + 25
    more = b"".join(
        struct.pack(">I", len(content))
        + name
        + content
        + struct.pack(">I", zlib.crc32(name + content))
        for name, content in chunks
    )
    path.write_bytes(data[:head] + more + data[head:])
    return read_facts(path).encoded


def test_a_png_states_its_curve_in_one_of_three_chunks(tmp_path):
    path = tmp_path / "a.png"
    assert png(path) is None
    assert png(path, (b"sRGB", b"\0")) == "sRGB"
    assert png(path, (b"gAMA", struct.pack(">I", 45455))) == "gamma 0.455"
    assert png(path, (b"gAMA", struct.pack(">I", 100000))) is None
    for profile, found in ((SRGB, "the profile mine"), (linear_profile(), None), (b"junk", None)):
        assert png(path, (b"iCCP", b"mine\0\0" + zlib.compress(profile))) == found


@pytest.mark.parametrize("compressed", [b"no zlib", zlib.compress(bytes(1 << 26))], ids=len)
def test_a_profile_that_is_none_states_nothing(tmp_path, compressed):
    assert png(tmp_path / "a.png", (b"iCCP", b"mine\0\0" + compressed)) is None


def test_a_tiff_states_its_curve_by_profile_or_exif(tmp_path):
    path = tmp_path / "a.tif"
    for profile, found in ((SRGB, "an ICC profile with a tone curve"), (linear_profile(), None)):
        tifffile.imwrite(path, PLANE, iccprofile=profile)
        assert read_facts(path).encoded == found
    tifffile.imwrite(path, PLANE, extratags=[(40961, "H", 1, 1, True)])  # ColorSpace
    assert read_facts(path).encoded == "sRGB"


def test_a_jpeg_is_never_proportional_to_light(tmp_path):
    handle = io.BytesIO()
    Image.fromarray((PLANE >> 4).astype(np.uint8)).save(handle, "jpeg")
    (tmp_path / "a.jpg").write_bytes(handle.getvalue())
    assert read_facts(tmp_path / "a.jpg").encoded == "JPEG"
