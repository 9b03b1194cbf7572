import struct

import imagecodecs
import numpy as np
import pytest

from levkas.readers.facts import UnreadableCapture
from levkas.readers.frames import read_facts, read_frame


def picture(shape, dtype, seed=0):
    rng = np.random.default_rng(seed)
    return rng.integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


def put(path, values, **options):
    options = {"level": 0, "reversible": True, "codecformat": "jp2"} | options
    path.write_bytes(imagecodecs.jpeg2k_encode(values, **options))
    return path


@pytest.mark.parametrize("form", ["jp2", "j2k"])
@pytest.mark.parametrize("shape", [(37, 53), (37, 53, 3)])
@pytest.mark.parametrize("dtype", ["uint8", "uint16"])
def test_pixels_are_those_that_were_saved(tmp_path, form, shape, dtype):
    values = picture(shape, dtype)
    path = put(tmp_path / f"a.{form}", values, codecformat=form)
    facts = read_facts(path)
    assert (facts.kind, facts.shape, facts.dtype) == ("jpeg2000", shape, dtype)
    assert facts.bits == 8 * values.itemsize
    assert facts.encoded == ("sRGB" if form == "jp2" else None)
    np.testing.assert_array_equal(read_frame(path), values)


def test_pillow_reads_the_same_in_red_green_blue(tmp_path):
    from PIL import Image

    values = picture((40, 60, 3), "uint8")
    path = tmp_path / "a.jp2"
    Image.fromarray(values).save(path, irreversible=False)
    np.testing.assert_array_equal(read_frame(path), values)


def test_transparency_is_left_out_and_said(tmp_path):
    from PIL import Image

    values = picture((20, 30, 4), "uint8")
    Image.fromarray(values, "RGBA").save(tmp_path / "a.jp2", irreversible=False)
    assert "transparency" in read_facts(tmp_path / "a.jp2").notes[0]
    np.testing.assert_array_equal(read_frame(tmp_path / "a.jp2"), values[..., :3])


@pytest.mark.parametrize("form", ["jp2", "j2k"])
def test_a_file_cut_anywhere_is_refused(tmp_path, form):
    path = put(tmp_path / f"a.{form}", picture((64, 64, 3), "uint8"), codecformat=form)
    data = path.read_bytes()
    for length in (13, 40, 60, len(data) // 2, len(data) - 1):
        path.write_bytes(data[:length])
        with pytest.raises(UnreadableCapture) as refused:
            read_frame(path)
        assert refused.value.problems[0].code in ("E_TRUNCATED", "E_UNREADABLE"), length


def spoilt(tmp_path, place, form, value):
    """A codestream with one field of its SIZ segment replaced."""
    path = put(tmp_path / "a.j2k", picture((16, 16), "uint8"), codecformat="j2k")
    data = bytearray(path.read_bytes())
    struct.pack_into(form, data, place, value)
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("place", "form", "value", "code"),
    [
        (8, ">I", 4_000_000_000, "E_SIZE"),  # width
        (8, ">I", 0, "E_SIZE"),
        (12, ">I", 400_000, "E_SIZE"),  # height; tiles of 16 px
        (24, ">I", 0, "E_SIZE"),  # width of a tile
        (40, ">H", 16_000, "E_TRUNCATED"),  # components
        (42, ">B", 0x87, "E_UNREADABLE"),  # eight bits with a sign
        (42, ">B", 37, "E_UNREADABLE"),
        (43, ">B", 2, "E_UNREADABLE"),  # every second column
    ],
)
def test_a_header_of_no_photograph_is_refused_before_anything_is_decoded(
    tmp_path, place, form, value, code
):
    with pytest.raises(UnreadableCapture) as refused:
        read_facts(spoilt(tmp_path, place, form, value))
    assert refused.value.problems[0].code == code
