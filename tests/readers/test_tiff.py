import struct

import imagecodecs
import numpy as np
import pytest
import tifffile

from levkas.readers.frames import UnreadableCapture, read_facts, read_frame

RNG = np.random.default_rng(2)
CODES = RNG.integers(0, 4096, (64, 96)).astype(np.uint16)


def refusal(path, read=read_frame, **more):
    with pytest.raises(UnreadableCapture) as refused:
        read(path, **more)
    (problem,) = refused.value.problems
    assert problem.file == str(path)
    return problem


def set_tag(path, code, *, count=None, value=None):
    """Overwrite the count or the (first) value of a tag of the first page."""
    with tifffile.TiffFile(path) as tiff:
        tag = tiff.pages[0].tags[code]
    data = bytearray(path.read_bytes())
    if count is not None:
        struct.pack_into("<I", data, tag.offset + 4, count)
    if value is not None:
        struct.pack_into({3: "<H", 4: "<I"}[tag.dtype], data, tag.valueoffset, value)
    path.write_bytes(data)


@pytest.mark.parametrize("dtype", ["u1", "u2", "f4"])
@pytest.mark.parametrize(
    "options",
    [{}, {"compression": "lzw"}, {"compression": "packbits"}, {"compression": "zstd"},
     {"byteorder": ">", "bigtiff": True}, {"tile": (16, 32), "compression": "zlib"}],
    ids=str,
)  # fmt: skip
def test_a_tiff_is_read_as_it_was_written_in_native_contiguous_numbers(tmp_path, options, dtype):
    path, image = tmp_path / "frame.tif", CODES.astype(dtype)
    predictor = options.get("compression") in ("lzw", "zstd") and dtype != "f4"
    rows = {} if "tile" in options else {"rowsperstrip": 10}
    tifffile.imwrite(path, image, predictor=predictor, **rows, **options)
    facts, values = read_facts(path), read_frame(path)
    assert np.array_equal(values, image) and values.dtype == image.dtype
    assert values.dtype.isnative and values.flags.c_contiguous
    assert (facts.kind, facts.shape, facts.pages) == ("tiff", (64, 96), 1)
    assert np.dtype(facts.dtype) == image.dtype and facts.bits == 8 * image.dtype.itemsize


@pytest.mark.parametrize("planar", ["contig", "separate"])
@pytest.mark.parametrize("samples", [3, 4, 31])
def test_samples_come_last_however_they_are_stored(tmp_path, planar, samples):
    path = tmp_path / "samples.tif"
    image = RNG.integers(0, 65536, (20, 21, samples)).astype(np.uint16)
    stored = image if planar == "contig" else np.moveaxis(image, -1, 0)
    tifffile.imwrite(path, stored, planarconfig=planar, photometric="minisblack")
    assert read_facts(path).shape == (20, 21, samples)
    assert np.array_equal(read_frame(path), image)


def test_twelve_bits_packed_are_unpacked_and_said(tmp_path):
    path = tmp_path / "packed.tif"
    packed = imagecodecs.packints_encode(CODES.ravel(), 12)
    tifffile.imwrite(path, CODES)
    data = path.read_bytes().replace(CODES.tobytes(), bytes(packed))
    path.write_bytes(data)
    set_tag(path, 258, value=12)
    set_tag(path, 279, value=len(packed))
    assert read_facts(path).bits == 12
    assert np.array_equal(read_frame(path), CODES)


def test_pages_are_read_one_by_one_and_previews_are_not_counted(tmp_path):
    path = tmp_path / "pages.tif"
    stack = RNG.integers(0, 255, (3, 20, 21)).astype(np.uint8)
    with tifffile.TiffWriter(path) as tiff:
        for i, page in enumerate(stack):
            tiff.write(page, metadata=None)
            if i == 0:
                tiff.write(page[::2, ::2], subfiletype=1, metadata=None)
    assert read_facts(path).pages == 3
    for i, page in enumerate(stack):
        assert np.array_equal(read_frame(path, page=i), page)
    assert refusal(path, page=3).code == "E_BAND_MISSING"
    with pytest.raises(ValueError):
        read_frame(path, page=-1)


def test_a_file_of_previews_only_holds_no_image(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", CODES, subfiletype=1, byteorder=">", bigtiff=True)
    assert refusal(tmp_path / "a.tif").field == "NewSubfileType"


@pytest.mark.parametrize("options", [{"imagej": True}, {"truncate": True}], ids=str)
def test_a_stack_behind_one_page_is_not_taken_for_one_frame(tmp_path, options):
    path = tmp_path / "stack.tif"
    tifffile.imwrite(path, np.zeros((4, 20, 21), np.uint16), photometric="minisblack", **options)
    with tifffile.TiffFile(path) as tiff:
        alone = len(tiff.pages) == 1
    if alone:
        assert refusal(path).field == "ImageDescription"
    else:
        assert read_facts(path).pages == 4


@pytest.mark.parametrize("photometric", ["palette", "separated", "cielab"])
def test_colours_that_are_no_counts_are_refused_with_a_way_out(tmp_path, photometric):
    path = tmp_path / "print.tif"
    samples = {"palette": (), "separated": (4,), "cielab": (3,)}[photometric]
    more = {"colormap": np.zeros((3, 256), np.uint16)} if photometric == "palette" else {}
    image = np.zeros((8, 8, *samples), np.uint8)
    tifffile.imwrite(path, image, photometric=photometric, **more)
    assert refusal(path).field == "PhotometricInterpretation"


@pytest.mark.parametrize("compression", [None, "zlib"])
def test_fewer_strips_than_the_image_needs_never_read_as_zeros(tmp_path, compression):
    path = tmp_path / "frame.tif"
    tifffile.imwrite(path, CODES, rowsperstrip=8, compression=compression)
    for code in (273, 279):
        set_tag(path, code, count=5)
    assert refusal(path).code == refusal(path, read_facts).code == "E_TRUNCATED"


@pytest.mark.parametrize("compression", [None, "zlib"])
@pytest.mark.parametrize(("code", "tile"), [(273, None), (279, (16, 32))])
def test_an_empty_strip_or_tile_is_refused(tmp_path, compression, code, tile):
    path = tmp_path / "sparse.tif"
    layout = {"tile": tile} if tile else {"rowsperstrip": 8}
    tifffile.imwrite(path, CODES, compression=compression, **layout)
    set_tag(path, {273: 324, 279: 325}[code] if tile else code, value=0)
    assert refusal(path).code == "E_TRUNCATED"


@pytest.mark.parametrize(
    "encode", [imagecodecs.zlib_encode, imagecodecs.lzw_encode, imagecodecs.packbits_encode]
)
def test_a_strip_that_holds_too_few_rows_is_refused(tmp_path, encode):
    path = tmp_path / "short.tif"
    name = encode.__name__.split("_")[0]
    tifffile.imwrite(path, CODES, compression=name, rowsperstrip=64)
    short = bytes(encode(CODES[:40].tobytes()))
    with tifffile.TiffFile(path) as tiff:
        offset = tiff.pages[0].dataoffsets[0]
    data = bytearray(path.read_bytes())
    data[offset : offset + len(short)] = short
    path.write_bytes(data)
    assert refusal(path).code == "E_UNREADABLE"


def test_a_jpeg_strip_cut_short_is_refused(tmp_path):
    path = tmp_path / "photo.tif"
    image = RNG.integers(0, 255, (64, 96, 3)).astype(np.uint8)
    tifffile.imwrite(path, image, compression="jpeg", photometric="rgb", rowsperstrip=64)
    with tifffile.TiffFile(path) as tiff:
        count = tiff.pages[0].databytecounts[0]
    set_tag(path, 279, value=count // 2)
    assert refusal(path).code == "E_TRUNCATED"


def test_the_five_lenses_say_their_bands_levels_and_exposures(real_data):
    facts = [read_facts(real_data / f"rededge-5lens/IMG_0000_{i}.tif") for i in range(1, 6)]
    # From the files' own XMP and EXIF, read with `strings`.
    assert [f.wavelengths for f in facts] == [(475.0,), (560.0,), (668.0,), (840.0,), (717.0,)]
    assert [f.fwhm for f in facts] == [(20.0,), (20.0,), (10.0,), (40.0,), (10.0,)]
    assert facts[0].band_names == ("Blue",) and facts[0].model == "RedEdge"
    assert facts[0].exposure_s == 0.0004725 and facts[0].iso == 100
    assert facts[0].black == 4800 and facts[0].captured == "2017-10-19T20:40:39"
    # 12 bits times 16: the brightest code in all five aerial frames is 65520.
    frame = read_frame(real_data / "rededge-5lens/IMG_0001_1.tif")
    assert frame.shape == (960, 1280) and frame.max() == facts[0].saturation == 65520
