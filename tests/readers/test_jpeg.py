import struct
from io import BytesIO

import cv2
import numpy as np
import pytest
from PIL import Image
from PIL.TiffImagePlugin import IFDRational

from levkas.readers.frames import UnreadableCapture, read_facts, read_frame

RNG = np.random.default_rng(4)
PHOTO = cv2.resize(RNG.integers(0, 255, (6, 8, 3)).astype(np.uint8), (64, 48))


def write_photo(path, image=PHOTO, exif=None, **options):
    Image.fromarray(image).save(path, **({"exif": exif} if exif else {}), **options)
    return path


def exif_of():
    exif = Image.Exif()
    exif[0x0112] = 6
    exif[0x0110] = "D80"
    exif.get_ifd(0x8769).update(
        {0x9003: "2019:02:08 17:43:35", 0x829A: IFDRational(1, 4), 0x8827: 100, 0x9011: "+01:00"}
    )
    return exif


@pytest.mark.parametrize("progressive", [False, True])
@pytest.mark.parametrize("gray", [False, True])
def test_a_photograph_is_what_pillow_decodes(tmp_path, progressive, gray):
    image = PHOTO[..., 0] if gray else PHOTO
    path = write_photo(tmp_path / "photo.jpg", image, progressive=progressive)
    assert np.array_equal(read_frame(path), np.asarray(Image.open(path)))
    assert read_facts(path).shape == image.shape


def test_orientation_is_ignored_and_exposure_and_date_are_read(tmp_path):
    path = write_photo(tmp_path / "photo.jpg", exif=exif_of())
    assert read_frame(path).shape == (48, 64, 3) == read_facts(path).shape
    facts = read_facts(path)
    assert (facts.exposure_s, facts.iso, facts.model, facts.bits) == (0.25, 100, "D80", 8)
    assert facts.captured == "2019-02-08T17:43:35+01:00"


def test_damaged_exif_costs_the_facts_and_not_the_photograph(tmp_path):
    path = write_photo(tmp_path / "photo.jpg")
    data = path.read_bytes()
    junk = b"Exif\0\0MM\0*\xff\xff\xff\xff" + bytes(range(200))
    path.write_bytes(data[:2] + b"\xff\xe1" + struct.pack(">H", len(junk) + 2) + junk + data[2:])
    assert read_frame(path).shape == (48, 64, 3)
    assert read_facts(path).exposure_s is None


def test_a_cut_photograph_with_a_whole_thumbnail_is_refused(tmp_path):
    thumbnail = BytesIO()
    Image.fromarray(PHOTO[::4, ::4]).save(thumbnail, "jpeg")
    path = write_photo(tmp_path / "photo.jpg")
    data, small = path.read_bytes(), thumbnail.getvalue()
    segment = b"\xff\xe2" + struct.pack(">H", len(small) + 2) + small
    whole = data[:2] + segment + data[2:]
    path.write_bytes(whole)
    assert read_frame(path).shape == (48, 64, 3)
    path.write_bytes(whole[:-40])
    with pytest.raises(UnreadableCapture, match="is truncated"):
        read_frame(path)


def test_four_inks_are_refused_with_a_way_out(tmp_path):
    path = tmp_path / "print.jpg"
    Image.fromarray(PHOTO).convert("CMYK").save(path)
    with pytest.raises(UnreadableCapture, match="Export it again as an RGB JPEG"):
        read_frame(path)
