import struct

import imagecodecs
import numpy as np
import pytest
import tifffile

from levkas.readers import decoder
from levkas.readers.frames import UnreadableCapture, read_facts, read_frame

RNG = np.random.default_rng(5)
MOSAIC = RNG.integers(64, 4096, (64, 96)).astype(np.uint16)


def refusal(path, read=read_frame):
    with pytest.raises(UnreadableCapture) as refused:
        read(path)
    (problem,) = refused.value.problems
    return problem


def write_dng(path, mosaic, *, pattern=(0, 1, 1, 2), black=(64,), white=4095, extra=(), **more):
    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True),
        (50708, "s", 0, "Levkas test", True),
        (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, pattern, True),
        (50714, "H", len(black), black, True),
        (50717, "I", 1, white, True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        (50778, "H", 1, 21, True),
        (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
        *extra,
    ]
    tifffile.imwrite(path, mosaic, photometric=32803, extratags=tags, metadata=None, **more)
    return path


def write_lossless(path, mosaic, tile=32):
    """Write a DNG of tiles in lossless JPEG; return their places and the places of their byte counts."""
    h, w = mosaic.shape
    places = [(y, x) for y in range(0, h, tile) for x in range(0, w, tile)]
    parts = (imagecodecs.ljpeg_encode(mosaic[y : y + tile, x : x + tile].copy()) for y, x in places)
    facts = {"shape": mosaic.shape, "dtype": mosaic.dtype, "compression": 7, "tile": (tile, tile)}
    write_dng(path, parts, **facts)
    with tifffile.TiffFile(path) as tiff:
        tags = tiff.pages[0].tags
        return tiff.pages[0].dataoffsets, tags["TileByteCounts"].valueoffset


@pytest.mark.parametrize(("codes", "letters"), [((0, 1, 1, 2), "RGGB"), ((1, 2, 0, 1), "GBRG")])
def test_the_mosaic_comes_bit_exact_with_the_black_of_each_of_its_phases(tmp_path, codes, letters):
    extra = [(50713, "H", 2, (2, 2), True), (274, "H", 1, 6, True)]
    blacks = (60, 61, 62, 63)
    path = write_dng(tmp_path / "a.dng", MOSAIC, pattern=codes, black=blacks, extra=extra)
    assert np.array_equal(read_frame(path), MOSAIC)  # turned by no orientation
    facts = read_facts(path)
    assert (facts.kind, facts.pattern, facts.bits) == ("raw", letters, 12)
    assert (facts.blacks.pattern, facts.black) == (((60, 61), (62, 63)), 61.5)
    assert facts.saturation == 4095


def test_exposure_sensitivity_date_and_model_are_read(tmp_path):
    extra = [
        (33434, "2I", 1, (1, 4), True),
        (34855, "H", 1, 100, True),
        (272, "s", 0, "D80", True),
        (306, "s", 20, "2019:02:08 17:43:35", True),
    ]
    facts = read_facts(write_dng(tmp_path / "a.dng", MOSAIC, extra=extra))
    assert (facts.exposure_s, facts.iso, facts.model) == (0.25, 100, "D80")
    assert facts.captured == "2019-02-08T17:43:35"


def test_the_compression_curve_of_a_camera_is_undone(tmp_path):
    table = np.round(np.linspace(0, 1, 683) ** 2 * 4095).astype(int)
    codes = RNG.integers(0, 683, (64, 96)).astype(np.uint16)
    extra = [(50712, "H", len(table), tuple(int(t) for t in table), True)]
    path = write_dng(tmp_path / "lossy.dng", codes, black=(0,), extra=extra)
    assert np.array_equal(read_frame(path), table[codes].astype(np.uint16))


def write_linear(path, colours, black=(64,), **more):
    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True),
        (50708, "s", 0, "Levkas test", True),
        (50714, "H", len(black), black, True),
        (50717, "H", 3, (4095,) * 3, True),
    ]
    tifffile.imwrite(path, colours, photometric=34892, extratags=tags, metadata=None, **more)
    return path


COLOURS = RNG.integers(64, 4096, (64, 96, 3)).astype(np.uint16)


def write_linear_jpeg(path, parts, rows, black=(64,)):
    facts = {"shape": COLOURS.shape, "dtype": COLOURS.dtype, "compression": 7}
    return write_linear(path, iter(parts), black, **facts, rowsperstrip=rows)


@pytest.mark.parametrize("lossless", [False, True])
@pytest.mark.parametrize("black", [(64,), (64, 64, 64)])  # LibRaw takes the first off the white
def test_the_colours_of_a_linear_dng_come_bit_exact(tmp_path, lossless, black):
    path = tmp_path / "linear.dng"
    if lossless:
        facts = {"lossless": True, "bitspersample": 16, "colorspace": "rgb", "outcolorspace": "rgb"}
        write_linear_jpeg(path, [imagecodecs.jpeg8_encode(COLOURS, **facts)], 64, black)
    else:
        write_linear(path, COLOURS, black)
    assert np.array_equal(read_frame(path), COLOURS)
    facts = read_facts(path)
    assert (facts.kind, facts.shape, facts.pattern) == ("raw-colours", (64, 96, 3), None)
    assert (facts.black, facts.saturation, facts.encoded) == (64.0, 4095.0, None)


def test_colours_that_libraw_would_mix_are_refused(tmp_path):
    parts = [imagecodecs.ljpeg_encode(COLOURS.reshape(64, -1))]
    path = write_linear_jpeg(tmp_path / "linear.dng", parts, 64)
    assert refusal(path).field == "SamplesPerPixel"


def test_strips_of_which_libraw_reads_the_first_alone_are_refused(tmp_path):
    parts = (imagecodecs.ljpeg_encode(MOSAIC[y : y + 32].copy()) for y in (0, 32))
    facts = {"shape": MOSAIC.shape, "dtype": MOSAIC.dtype, "compression": 7, "rowsperstrip": 32}
    path = write_dng(tmp_path / "strips.dng", parts, **facts)
    assert refusal(path).field == "RowsPerStrip"


def test_raw_images_that_libraw_would_change_are_refused(tmp_path):
    """Floats it scales by the most of each file: a white and an object by different factors. Planes it mixes."""
    floats = write_dng(tmp_path / "floats.dng", (3 * MOSAIC / 4095).astype(np.float32), white=1)
    planes = np.moveaxis(COLOURS, -1, 0)
    write_linear(tmp_path / "planes.dng", planes, planarconfig=2)
    assert refusal(floats).field == "SampleFormat"
    assert refusal(tmp_path / "planes.dng").field == "PlanarConfiguration"


def test_a_raw_that_is_cut_or_none_is_refused(tmp_path):
    write_dng(tmp_path / "a.dng", MOSAIC)
    write_linear(tmp_path / "b.dng", COLOURS)
    for name in ("a.dng", "b.dng"):
        path = tmp_path / name
        path.write_bytes(path.read_bytes()[: int(0.9 * path.stat().st_size)])
    (tmp_path / "scan.raw").write_bytes(bytes(range(256)) * 40)
    for name in ("a.dng", "b.dng", "scan.raw"):
        assert refusal(tmp_path / name).file == str(tmp_path / name)


def test_tiles_of_lossless_jpeg_come_bit_exact(tmp_path):
    write_lossless(tmp_path / "a.dng", MOSAIC)
    assert np.array_equal(read_frame(tmp_path / "a.dng"), MOSAIC)


def spoil_beginning(data, starts, _):
    data[starts[2]] = 0


def spoil_size(data, starts, _):
    at = data.index(b"\xff\xc3", starts[2])
    data[at + 5 : at + 7] = b"\0\x08"  # 8 rows of 32


def spoil_count(data, _, counts):
    struct.pack_into("<I", data, counts + 8, 1 << 20)  # past the end of the file


@pytest.mark.parametrize("spoil", [spoil_beginning, spoil_size, spoil_count])
def test_a_tile_that_libraw_would_leave_as_zeros_is_refused(tmp_path, spoil):
    path = tmp_path / "a.dng"
    starts, counts = write_lossless(path, MOSAIC)
    data = bytearray(path.read_bytes())
    spoil(data, starts, counts)
    path.write_bytes(data)
    assert refusal(path).code == refusal(path, read_facts).code == "E_TRUNCATED"


def test_one_decoder_reads_many_files_and_another_follows_a_dead_one(tmp_path, monkeypatch):
    monkeypatch.setattr(decoder, "_idle", [])
    paths = [write_dng(tmp_path / f"{i}.dng", MOSAIC + i) for i in range(3)]
    for i, path in enumerate(paths):
        assert np.array_equal(read_frame(path), MOSAIC + i) and read_facts(path).kind == "raw"
    (alive,) = decoder._idle
    alive.kill()
    alive.wait()
    assert np.array_equal(read_frame(paths[0]), MOSAIC)
    assert decoder._idle[0].pid != alive.pid


@pytest.mark.skipif(not hasattr(decoder.signal, "setitimer"), reason="processor time of Unix")
def test_a_decoder_that_does_not_end_is_ended_by_its_processor_time(tmp_path, monkeypatch):
    path = write_dng(tmp_path / "a.dng", MOSAIC)
    program = tmp_path / "endless.py"
    program.write_text(
        f"import runpy\nfound = runpy.run_path({str(decoder.PROGRAM)!r})\n"
        "found['answer'].__globals__['READING_S'] = 0.1\n"
        "def endless(path, pixels):\n    while True:\n        pass\n"
        "found['READERS']['raw'] = endless\nfound['serve']()\n"
    )
    monkeypatch.setattr(decoder, "PROGRAM", program)
    monkeypatch.setattr(decoder, "_idle", [])
    assert refusal(path, read_facts)
