import os
import sys
import types

import cv2
import numpy as np
import pytest
import tifffile
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.core.problems import Refused
from levkas.readers import frames
from levkas.readers.facts import Facts
from levkas.readers.frames import Reader, UnreadableCapture, kind_of, read_facts, read_frame

RNG = np.random.default_rng(1)
CODES = RNG.integers(0, 4096, (24, 30)).astype(np.uint16)


@pytest.mark.parametrize("name", ["frame.tif", "packed.tif", "photo.png", "photo.jpg"])
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.97])
def test_a_truncated_file_is_refused_by_name_and_never_reads_as_zeros(tmp_path, name, share):
    path = tmp_path / name
    if name.endswith(".tif"):
        tifffile.imwrite(path, CODES, compression="zlib" if name == "packed.tif" else None)
    else:
        cv2.imwrite(str(path), RNG.integers(0, 255, (40, 50, 3)).astype(np.uint8))
    data = path.read_bytes()
    path.write_bytes(data[: int(share * len(data))])
    with pytest.raises(UnreadableCapture, match=name):
        read_frame(path)


def test_a_file_that_is_no_image_says_what_was_expected(tmp_path):
    path = tmp_path / "notes.tif"
    path.write_text("not an image at all")
    with pytest.raises(UnreadableCapture, match="TIFF, PNG, JPEG, JPEG 2000, camera raw, ENVI"):
        read_frame(path)


def test_what_is_no_file_is_refused(tmp_path):
    (tmp_path / "folder.tif").mkdir()
    if hasattr(os, "mkfifo"):
        os.mkfifo(tmp_path / "pipe.tif")
    for name in ("nowhere.tif", "folder.tif", "pipe.tif", "null\0byte.tif"):
        with pytest.raises(UnreadableCapture, match="cannot be opened"):
            read_frame(tmp_path / name)


def test_the_content_decides_and_not_the_suffix(tmp_path):
    path = tmp_path / "photo.tif"
    assert cv2.imwrite(str(tmp_path / "photo.png"), CODES)
    (tmp_path / "photo.png").rename(path)
    assert kind_of(path) == read_facts(path).kind == "png"
    assert np.array_equal(read_frame(str(path)), CODES)


def test_a_reader_is_added_by_a_row(tmp_path, monkeypatch):
    np.save(tmp_path / "frame.npy", CODES)
    with pytest.raises(UnreadableCapture, match="NumPy array is not supported"):
        read_facts(tmp_path / "frame.npy")
    module = types.ModuleType("levkas.readers.npy")
    module.facts = lambda path: Facts(path, "npy", np.load(path, mmap_mode="r").shape, "uint16")
    module.frame = np.load
    monkeypatch.setitem(sys.modules, module.__name__, module)
    row = Reader(module.__name__, "facts", "frame", (b"\x93NUMPY",))
    monkeypatch.setitem(frames.READERS, "npy", row)
    assert kind_of(tmp_path / "frame.npy") == read_facts(tmp_path / "frame.npy").kind == "npy"
    assert np.array_equal(read_frame(tmp_path / "frame.npy"), CODES)


def test_only_a_tiff_has_pages(tmp_path):
    path = tmp_path / "photo.png"
    cv2.imwrite(str(path), CODES)
    assert np.array_equal(read_frame(path, page=0), CODES)
    with pytest.raises(UnreadableCapture, match="no page 1"):
        read_frame(path, page=1)


def test_reading_leaves_the_file_and_its_folder_as_they_were(tmp_path):
    path = tmp_path / "frame.tif"
    tifffile.imwrite(path, CODES)
    before = (path.read_bytes(), path.stat().st_mtime_ns)
    path.chmod(0o444)
    values = read_frame(path)
    values += 1  # the caller's own copy
    assert (path.read_bytes(), path.stat().st_mtime_ns) == before
    assert [p.name for p in tmp_path.iterdir()] == ["frame.tif"]


@settings(deadline=None, max_examples=60)
@given(
    st.sampled_from(["png", "jpg"]),
    st.lists(st.tuples(st.floats(0, 1), st.integers(0, 255)), min_size=1, max_size=6),
    st.floats(0.5, 1),
)
def test_a_mutated_file_gives_an_image_or_our_refusal(tmp_path_factory, kind, changes, share):
    path = tmp_path_factory.mktemp("mutated") / f"frame.{kind}"
    cv2.imwrite(str(path), np.arange(20 * 24, dtype=np.uint8).reshape(20, 24))
    data = bytearray(path.read_bytes())
    for place, value in changes:
        data[min(int(place * len(data)), len(data) - 1)] = value
    path.write_bytes(data[: int(share * len(data))] if share < 0.9 else data)
    for read in (read_facts, read_frame):
        try:
            assert read(path).shape is not None
        except Refused as refused:
            assert str(path) in str(refused)


def test_every_real_frame_is_what_its_facts_declare(real_data):
    folders = ["filterwheel-disks/dark", "rededge-5lens", "silios-kinect/burst", "paintings"]
    paths = [p for f in folders for p in sorted((real_data / f).glob("*.*"))]
    assert len(paths) == 28 + 10 + 12 + 3
    for path in paths[::4]:
        facts, values = read_facts(path), read_frame(path)
        assert values.shape == facts.shape and values.dtype == facts.dtype


def test_facts_of_an_untouched_file_are_read_once_and_of_a_changed_one_anew(tmp_path, monkeypatch):
    path, opened, reader = tmp_path / "frame.png", [], frames._call

    def counted(kind, which, path):
        opened.append(path)
        return reader(kind, which, path)

    monkeypatch.setattr(frames, "_call", counted)
    cv2.imwrite(str(path), CODES)
    assert [read_facts(path).shape[:2] for _ in range(3)] == [CODES.shape] * 3
    assert opened == [path]
    cv2.imwrite(str(path), CODES[:9])
    assert read_facts(path).shape[:2] == (9, 30)
