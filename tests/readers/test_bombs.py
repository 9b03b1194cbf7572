"""Files made to break a reader: one refusal each, soon, in little memory, and nothing else.

Every file is read in a process of its own kind: this script, run with a folder, reads them one by one
and tells what came, after how long, and how much memory the process held at its peak.
"""

import json
import os
import signal
import struct
import subprocess
import sys
import zlib
from pathlib import Path

import pytest

MOST_SECONDS = 2.0
"""Processor time; a loaded machine takes longer by the clock."""
MOST_BYTES = 200 << 20
PATIENCE_S = 900
CASES = {}


def bomb(code, *, field=None, said="", read="frame"):
    """Register a function that writes one hostile file into a folder and returns its path.

    A code of None: what is hostile is no part of the image, which is read or refused.
    """

    def keep(make):
        CASES[make.__name__] = (make, code, field, said, read)
        return make

    return keep


def put(path, data):
    path.write_bytes(data if isinstance(data, bytes) else data.encode())
    return path


# --- TIFF -------------------------------------------------------------------------------------

TYPES = {"B": 1, "H": 3, "I": 4, "Q": 16, "q": 17}


def tiff(tags, data=b"", *, next_directory=0, big=False):
    """Return a TIFF of one directory; `tags` maps a code to (type, values), `data` starts at byte DATA."""
    wide = "Q" if big else "I"
    entries, outside = b"", b""
    place = DATA + len(data)
    for code, (kind, values) in sorted(tags.items()):
        packed = struct.pack(f"<{len(values)}{kind}", *values)
        if len(packed) > (8 if big else 4):
            value = struct.pack("<" + wide, place + len(outside))
            outside += packed
        else:
            value = packed.ljust(8 if big else 4, b"\0")
        entries += struct.pack("<HH" + wide, code, TYPES[kind], len(values)) + value
    head = b"II+\0\x08\0\0\0" + struct.pack("<Q", 16) if big else b"II*\0" + struct.pack("<I", 8)
    count = struct.pack("<Q" if big else "<H", len(tags))
    directory = head + count + entries + struct.pack("<" + wide, next_directory)
    return directory.ljust(DATA, b"\0") + data + outside


DATA = 512


def page(
    width, height, data, *, compression=1, bits=8, offsets=None, counts=None, rows=None, **more
):
    """Tags of a plain gray page of one strip at byte DATA."""
    tags = {
        256: ("I", [width]),
        257: ("I", [height]),
        258: ("H", [bits]),
        259: ("H", [compression]),
        262: ("H", [1]),
        273: ("I", offsets or [DATA]),
        277: ("H", [1]),
        278: ("I", [rows or min(height, 0xFFFFFFFF)]),
        279: ("I", counts or [len(data)]),
    }
    return tags | {int(code[1:]): value for code, value in more.items()}


def one_page(folder, *args, **keys):
    data = args[2]
    return put(folder / "frame.tif", tiff(page(*args, **keys), data))


def codestream(**sizes):
    """Return a JPEG 2000 codestream of 16 x 16 px with other sizes in its header."""
    import imagecodecs
    import numpy as np

    flat = np.zeros((16, 16), np.uint8)
    content = bytearray(imagecodecs.jpeg2k_encode(flat, level=0, codecformat="j2k"))
    for name, value in sizes.items():
        struct.pack_into(">I", content, {"width": 8, "height": 12, "tile": 24}[name], value)
        if name == "tile":
            struct.pack_into(">I", content, 28, value)
    return bytes(content)


@bomb("E_SIZE")
def codestream_of_three_thousand_million_px(folder):
    return put(folder / "a.j2k", codestream(width=60_000, height=60_000, tile=60_000))


@bomb("E_SIZE")
def codestream_of_a_hundred_million_tiles(folder):
    return put(folder / "a.j2k", codestream(width=10_000, height=10_000, tile=1))


@bomb(None)
def jp2_of_boxes_without_end(folder):
    start = b"\0\0\0\x0cjP  \r\n\x87\n"
    return put(folder / "a.jp2", start + struct.pack(">I4s", 8, b"free") * 400_000)


@bomb("E_SIZE", field="width, height")
def tiff_of_four_thousand_million_columns(folder):
    return one_page(folder, 0xFFFFFFFF, 0xFFFFFFFF, bytes(64))


@bomb("E_SIZE", field="width, height")
def tiff_without_height(folder):
    return one_page(folder, 8, 0, bytes(64), rows=1)


@bomb("E_SIZE", field="width, height")
def tiff_just_below_the_largest_side(folder):
    return one_page(folder, 499_999, 4000, zlib.compress(bytes(4000)), compression=8)


@bomb("E_UNREADABLE", field="next directory")
def tiff_whose_directory_follows_itself(folder):
    data = bytes(64)
    return put(folder / "frame.tif", tiff(page(8, 8, data), data, next_directory=8))


@bomb("E_TRUNCATED", field="next directory")
def tiff_whose_next_directory_is_negative(folder):
    data = bytes(64)
    return put(folder / "frame.tif", tiff(page(8, 8, data), data, next_directory=0xFFFFFFF0))


@bomb("E_TRUNCATED", field="next directory")
def bigtiff_whose_next_directory_is_negative(folder):
    data = bytes(64)
    content = tiff(page(8, 8, data), data, next_directory=2**64 - 8, big=True)
    return put(folder / "frame.tif", content)


@bomb("E_UNREADABLE", field="next directory")
def tiff_of_two_directories_in_a_ring(folder):
    data = bytes(64)
    content = bytearray(tiff(page(8, 8, data), data, next_directory=2048).ljust(2048, b"\0"))
    content += struct.pack("<HHHIII", 1, 256, 4, 1, 8, 8)
    return put(folder / "frame.tif", bytes(content))


@bomb("E_SIZE", field="pages")
def tiff_of_seventy_thousand_empty_pages(folder):
    content, at = bytearray(b"II*\0\x08\0\0\0"), 8
    for _ in range(70_000):
        at += 18
        content += struct.pack("<HHHIII", 1, 256, 4, 1, 8, at)
    return put(folder / "frame.tif", bytes(content))


@bomb("E_UNREADABLE", field="next directory")
def tiff_of_directories_laid_over_one_another(folder):
    """Each claims the 4,000 tags behind it, so that a reader reads 48 kB for every 8 bytes."""
    count, pages = 4000, 6000
    content = bytearray(8 + 8 * pages + 12 * count + 16)
    content[:8] = b"II*\0\x08\0\0\0"
    for i in range(pages):
        at = 8 + 8 * i
        struct.pack_into("<H", content, at, count)
    for i in range(pages):
        struct.pack_into("<I", content, 8 + 8 * i + 2 + 12 * count, 16 + 8 * i)
    return put(folder / "frame.tif", bytes(content))


@bomb("E_UNREADABLE", field="number of tags")
def tiff_of_sixty_thousand_tags(folder):
    return put(folder / "frame.tif", b"II*\0\x08\0\0\0" + struct.pack("<H", 60_000) + bytes(900))


@bomb("E_TRUNCATED", field="directory")
def tiff_cut_inside_its_directory(folder):
    return put(folder / "frame.tif", tiff(page(8, 8, bytes(64)), bytes(64))[:40])


@bomb("E_TRUNCATED", field="directory")
def tiff_of_a_head_alone(folder):
    return put(folder / "frame.tif", b"II*\0")


@bomb("E_TRUNCATED", field="StripOffsets, StripByteCounts")
def tiff_whose_strip_lies_outside_the_file(folder):
    return one_page(folder, 8, 8, bytes(64), offsets=[1 << 30])


@bomb("E_TRUNCATED", field="StripOffsets, StripByteCounts")
def tiff_whose_strip_is_longer_than_the_file(folder):
    return one_page(folder, 8, 8, bytes(64), counts=[0xFFFFFFFF])


@bomb("E_TRUNCATED", field="StripOffsets, StripByteCounts")
def tiff_of_fewer_strips_than_rows_need(folder):
    data = bytes(64)
    keys = {"offsets": [DATA, DATA + 400], "counts": [8, 8], "rows": 1}
    return put(folder / "frame.tif", tiff(page(8, 8, data, **keys), bytes(512)))


@bomb("E_TRUNCATED", field="StripOffsets, StripByteCounts")
def tiff_of_more_offsets_than_counts(folder):
    keys = {"offsets": [DATA, DATA + 40, DATA + 99], "counts": [32], "rows": 4}
    return put(folder / "frame.tif", tiff(page(8, 12, b"", compression=5, **keys), bytes(512)))


@bomb("E_UNREADABLE", field="StripOffsets, StripByteCounts")
def tiff_whose_strips_are_all_the_same_bytes(folder):
    """2,000 strips that each claim the same 4 kB: 8 MB of picture from 20 kB of file."""
    data, strips = bytes(range(256)) * 16, 2000
    keys = {"offsets": [DATA] * strips, "counts": [4096] * strips, "rows": 1}
    return put(folder / "frame.tif", tiff(page(4096, strips, data, **keys), data))


@bomb("E_SIZE", field="width, height")
def tiff_of_deflate_at_an_impossible_ratio(folder):
    return one_page(folder, 40_000, 40_000, zlib.compress(bytes(40_000)), compression=8)


@bomb("E_SIZE", field="width, height")
def tiff_of_lzw_at_an_impossible_ratio(folder):
    return one_page(folder, 40_000, 40_000, b"\x80\x00\x20\x10" * 9, compression=5)


def _many_zeros(level):
    squeezer = zlib.compressobj(level)
    block = bytes(1 << 20)
    return b"".join(squeezer.compress(block) for _ in range(600)) + squeezer.flush()


@bomb("E_SIZE", field="StripByteCounts")
def tiff_of_eight_pixels_whose_deflate_holds_600_megabytes(folder):
    return one_page(folder, 8, 8, _many_zeros(9), compression=8)


@bomb("E_SIZE", field="StripByteCounts")
def tiff_of_eight_pixels_whose_zstd_holds_a_gigabyte(folder):
    # Blocks of one byte repeated 128 KiB: 4 bytes each.
    blocks = struct.pack("<I", (1 << 17) << 3 | 2)[:3] + b"\0"
    last = struct.pack("<I", (1 << 17) << 3 | 3)[:3] + b"\0"
    frame = b"\x28\xb5\x2f\xfd\x00\x48" + blocks * 8191 + last
    return one_page(folder, 8, 8, frame, compression=50000)


@bomb("E_SIZE", field="StripByteCounts")
def tiff_of_eight_pixels_whose_lzma_holds_600_megabytes(folder):
    import lzma

    squeezer = lzma.LZMACompressor(preset=0)
    block = bytes(1 << 24)
    data = b"".join(squeezer.compress(block) for _ in range(36)) + squeezer.flush()
    return one_page(folder, 8, 8, data, compression=34925)


def _jpeg(width, height, scans=1):
    """A gray progressive JPEG whose scans are empty."""
    import io

    from PIL import Image

    stream = io.BytesIO()
    Image.new("L", (16, 16), 90).save(stream, "JPEG", progressive=scans > 1)
    data = bytearray(stream.getvalue())
    at = data.index(b"\xff\xc2" if scans > 1 else b"\xff\xc0")
    data[at + 5 : at + 9] = struct.pack(">HH", height, width)
    if scans > 1:
        scan = data[data.rindex(b"\xff\xda") : -2]
        data[-2:] = bytes(scan) * scans + b"\xff\xd9"
    return bytes(data)


@bomb("E_SIZE", field="StripByteCounts")
def tiff_of_eight_pixels_whose_jpeg_is_of_65000(folder):
    return one_page(folder, 8, 8, _jpeg(65_000, 65_000), compression=7)


@bomb("E_UNREADABLE", field="Compression")
def tiff_of_an_unknown_codec(folder):
    return one_page(folder, 8, 8, bytes(64), compression=777)


@bomb("E_UNREADABLE", field="Compression")
def tiff_of_webp(folder):
    return one_page(folder, 8, 8, bytes(64), compression=50001)


@bomb("E_SIZE", field="StripByteCounts")
def tiff_of_eight_pixels_whose_jpeg_2000_is_of_a_million(folder):
    sides = struct.pack(">HIIIIIIII", 0, 10**6, 10**6, 0, 0, 10**6, 10**6, 0, 0)
    data = b"\xff\x4f\xff\x51" + struct.pack(">H", 41) + sides + b"\0\1\7\1\1"
    return one_page(folder, 8, 8, data, compression=34712)


@bomb("E_SIZE", field="StripByteCounts")
def tiff_of_eight_pixels_whose_jpeg_xl_is_of_a_million(folder):
    # not small; 30 bits of height, square
    bits = 3 << 1 | (10**6 - 1) << 3 | 1 << 33
    return one_page(folder, 8, 8, b"\xff\x0a" + bits.to_bytes(12, "little"), compression=50002)


@bomb("E_UNREADABLE", field="SampleFormat, BitsPerSample")
def tiff_of_two_hundred_bits(folder):
    return one_page(folder, 8, 8, bytes(4096), bits=200)


@bomb("E_SIZE", field="TileWidth, TileLength")
def tiff_of_one_pixel_in_a_tile_of_a_gigapixel(folder):
    tags = page(8, 8, bytes(64), compression=8)
    for code in (273, 278, 279):
        del tags[code]
    data = zlib.compress(bytes(64))
    tags |= {322: ("I", [32_768]), 323: ("I", [32_768])}
    tags |= {324: ("I", [DATA]), 325: ("I", [len(data)])}
    return put(folder / "frame.tif", tiff(tags, data))


@bomb("E_TRUNCATED")
def tiff_of_garbage_behind_the_head(folder):
    noise = bytes((i * 7919 >> 3) & 255 for i in range(2000))
    return put(folder / "frame.tif", b"II*\0" + noise)


# --- PNG --------------------------------------------------------------------------------------


def chunk(name, data):
    return struct.pack(">I", len(data)) + name + data + struct.pack(">I", zlib.crc32(name + data))


def png(width, height, pixels, *, extra=b"", depth=8, colour=0):
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0))
    body = chunk(b"IDAT", pixels) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + head + extra + body


ROWS = zlib.compress(bytes(9 * 8))


@bomb("E_SIZE", field="width, height")
def png_of_two_thousand_million_rows(folder):
    return put(folder / "a.png", png(0x7FFFFFFF, 0x7FFFFFFF, ROWS))


@bomb("E_SIZE", field="width, height")
def png_without_a_width(folder):
    return put(folder / "a.png", png(0, 8, ROWS))


@bomb("E_SIZE", field="width, height")
def png_that_its_bytes_cannot_hold(folder):
    return put(folder / "a.png", png(30_000, 30_000, ROWS))


@bomb("E_TRUNCATED", field="IEND")
def png_cut_inside_its_pixels(folder):
    return put(folder / "a.png", png(8, 8, ROWS)[:-25])


@bomb("E_UNREADABLE")
def png_whose_chunk_is_longer_than_the_file(folder):
    content = bytearray(png(8, 8, ROWS))
    content[33:37] = b"\x7f\xff\xff\xff"
    return put(folder / "a.png", bytes(content))


@bomb("E_UNREADABLE", field="IHDR")
def png_of_seven_bits(folder):
    return put(folder / "a.png", png(8, 8, ROWS, depth=7))


@bomb("E_UNREADABLE")
def png_of_too_few_rows(folder):
    return put(folder / "a.png", png(8, 800, ROWS))


@bomb("E_UNREADABLE")
def png_with_a_wrong_checksum(folder):
    content = bytearray(png(8, 8, ROWS))
    content[-17] ^= 1
    return put(folder / "a.png", bytes(content))


def _fifty_megabytes():
    return zlib.compress(bytes(50 << 20), 9)


@bomb(None)
def png_with_a_profile_of_fifty_megabytes(folder):
    profile = chunk(b"iCCP", b"icc\0\0" + _fifty_megabytes())
    return put(folder / "a.png", png(8, 8, ROWS, extra=profile))


@bomb(None)
def png_with_a_text_of_fifty_megabytes(folder):
    text = chunk(b"zTXt", b"Comment\0\0" + _fifty_megabytes())
    return put(folder / "a.png", png(8, 8, ROWS, extra=text))


@bomb(None)
def png_with_four_thousand_texts(folder):
    return put(folder / "a.png", png(8, 8, ROWS, extra=chunk(b"tEXt", b"a\0b") * 4000))


def exif_of(count):
    """EXIF of `count` directories at one place, each of as many numbers: their product is walked."""
    start = 8 + 2 + 12 * count + 4
    outer, inner = (struct.pack("<HHII", tag, 4, 1, start) * count for tag in (0x8769, 0xA005))
    length = struct.pack("<H", count)
    return b"II*\0" + struct.pack("<I", 8) + length + outer + bytes(4) + length + inner + bytes(4)


@bomb(None)
def png_of_exif_that_is_walked_ten_million_times(folder):
    return put(folder / "a.png", png(8, 8, ROWS, extra=chunk(b"eXIf", exif_of(3200))))


@bomb("E_TRUNCATED", field="IHDR")
def png_whose_header_is_not_first(folder):
    return put(folder / "a.png", b"\x89PNG\r\n\x1a\n" + chunk(b"IDAT", ROWS))


# --- JPEG -------------------------------------------------------------------------------------


@bomb(None)
def jpeg_of_exif_that_is_walked_seven_million_times(folder):
    data, exif = _jpeg(16, 16), b"Exif\0\0" + exif_of(2700)
    marker = b"\xff\xe1" + struct.pack(">H", len(exif) + 2) + exif
    return put(folder / "a.jpg", data[:2] + marker + data[2:])


@bomb("E_SIZE", field="width, height")
def jpeg_of_65000_columns(folder):
    return put(folder / "a.jpg", _jpeg(65_000, 65_000))


@bomb("E_SIZE", field="scan")
def jpeg_of_four_hundred_scans(folder):
    return put(folder / "a.jpg", _jpeg(5000, 5000, scans=400))


@bomb("E_SIZE", field="width, height")
def jpeg_without_a_height(folder):
    return put(folder / "a.jpg", _jpeg(8, 0))


@bomb("E_TRUNCATED")
def jpeg_cut_before_its_scan(folder):
    return put(folder / "a.jpg", _jpeg(16, 16)[:60])


@bomb("E_TRUNCATED")
def jpeg_cut_inside_its_scan(folder):
    return put(folder / "a.jpg", _jpeg(16, 16)[:-6])


@bomb("E_UNREADABLE", field="frame header")
def jpeg_of_nine_components(folder):
    data = bytearray(_jpeg(16, 16))
    at = data.index(b"\xff\xc0")
    data[at + 9] = 9
    return put(folder / "a.jpg", bytes(data))


# --- ENVI -------------------------------------------------------------------------------------


def envi(folder, text="", data=bytes(48), **changes):
    """Write a header of 3 lines x 4 samples x 2 bands of 16 bits and its data, with changes."""
    fields = {"samples": 4, "lines": 3, "bands": 2, "data type": 12, "interleave": "bil"}
    fields |= {key.replace("_", " "): value for key, value in changes.items()}
    rows = ["ENVI", *(f"{key} = {value}" for key, value in fields.items()), text]
    if data is not None:
        put(folder / "scan.raw", data)
    return put(folder / "scan.hdr", "\n".join(rows))


@bomb("E_SIZE", field="lines, samples, bands")
def envi_of_a_million_million_lines(folder):
    return envi(folder, lines=10**12)


@bomb("E_SIZE", field="lines, samples, bands")
def envi_whose_sizes_overflow_64_bits(folder):
    return envi(folder, lines=400_000, samples=400_000, bands=400_000)


@bomb("E_TRUNCATED", field="scan.hdr: lines", said="lines = 3")
def envi_of_more_lines_than_data(folder):
    return envi(folder, lines=300_000)


@bomb("E_TRUNCATED", field="scan.hdr: header offset")
def envi_whose_offset_overflows(folder):
    return envi(folder, header_offset=2**63 + 5)


@bomb("E_UNREADABLE", field="header offset")
def envi_of_a_negative_offset(folder):
    return envi(folder, header_offset=-4)


@bomb("E_TRUNCATED", field="scan.hdr: bands", said="bands = 2")
def envi_with_a_band_too_few_in_its_data(folder):
    return envi(folder, data=bytes(48), bands=3, interleave="bsq")


@bomb("E_SIZE", field="scan.hdr: lines", said="lines = 4")
def envi_with_a_line_too_many_in_its_data(folder):
    return envi(folder, data=bytes(64))


@bomb("E_UNREADABLE", field="data file")
def envi_without_data(folder):
    return envi(folder, data=None)


@bomb("E_UNREADABLE", field="data file")
def envi_whose_data_are_a_pipe(folder):
    os.mkfifo(folder / "scan.raw")
    return envi(folder, data=None)


@bomb("E_UNREADABLE", field="data file")
def envi_whose_data_are_a_device(folder):
    (folder / "scan.raw").symlink_to("/dev/zero")
    return envi(folder, data=None)


@bomb("E_SIZE", said="header")
def envi_header_of_ten_megabytes(folder):
    return envi(folder, "description = {" + "a" * (10 << 20) + "}")


@bomb("E_UNREADABLE", field="samples")
def envi_of_a_million_digits(folder):
    return envi(folder, samples="1" * 1_000_000 + "x")


@bomb("E_UNREADABLE", field="samples")
def envi_header_of_semicolons(folder):
    return envi(folder, 'description = {"' + " ;}" * 300_000 + "}", samples="none")


@bomb("E_UNREADABLE", field="samples")
def envi_header_of_blanks(folder):
    return envi(folder, "description = a" + " " * 1_000_000 + "x", samples="none")


@bomb("E_UNREADABLE", field="data type")
def envi_of_an_unknown_data_type(folder):
    return envi(folder, data_type=77)


@bomb("E_UNREADABLE", field="lines")
def envi_of_nan_lines(folder):
    return envi(folder, lines="nan")


@bomb("E_UNREADABLE", field="samples")
def envi_of_negative_samples(folder):
    return envi(folder, samples=-4)


@bomb("E_UNREADABLE", field="bands")
def envi_of_infinite_bands(folder):
    return envi(folder, bands="1e999")


@bomb("E_UNREADABLE", said="END|end")
def envi_whose_list_has_no_end(folder):
    return envi(folder, "wavelength = {1, 2")


@bomb("E_BAND_COUNT", field="wavelength")
def envi_of_nan_wavelengths(folder):
    return envi(folder, "wavelength = {nan, 500}")


@bomb("E_UNREADABLE", said=".hdr beside it")
def envi_data_of_a_very_long_name(folder):
    return put(folder / ("a" * 251 + ".raw"), bytes(48))


# --- camera raw ---------------------------------------------------------------------------------


@bomb("E_UNREADABLE")
def nef_of_noise(folder):
    noise = bytes((i * i * 31 >> 4) & 255 for i in range(5000))
    return put(folder / "shot.nef", noise)


@bomb("E_UNREADABLE")
def nef_of_a_tiff_head_and_noise(folder):
    noise = bytes((i * i * 31 >> 4) & 255 for i in range(5000))
    return put(folder / "shot.nef", b"MM\0*\0\0\0\x08" + noise)


def dng(side, compression, data=bytes(64)):
    tags = page(side, side, data, bits=16)
    tags |= {259: ("H", [compression]), 262: ("H", [32803]), 50706: ("B", [1, 4, 0, 0])}
    tags |= {33421: ("H", [2, 2]), 33422: ("B", [0, 1, 1, 2])}
    return tiff(tags, data)


@bomb("E_UNREADABLE")
def dng_of_sixty_thousand_columns(folder):
    return put(folder / "shot.dng", dng(60_000, 1))


@bomb("E_TRUNCATED")
def dng_of_lossless_jpeg_that_is_none(folder):
    return put(folder / "shot.dng", dng(30_000, 7))


@bomb("E_UNREADABLE")
def dng_of_deflate_that_is_none(folder):
    return put(folder / "shot.dng", dng(30_000, 8))


@bomb("E_UNREADABLE")
def dng_whose_directory_follows_itself(folder):
    return put(folder / "shot.dng", tiff(page(8, 8, bytes(64)), bytes(64), next_directory=8))


# --- not files, and other kinds ------------------------------------------------------------------


@bomb("E_TRUNCATED")
def empty_file(folder):
    return put(folder / "frame.tif", b"")


@bomb("E_UNREADABLE", said="folder")
def folder_named_as_a_file(folder):
    (folder / "frame.tif").mkdir()
    return folder / "frame.tif"


@bomb("E_UNREADABLE", said="pipe")
def pipe_named_as_a_file(folder):
    os.mkfifo(folder / "frame.tif")
    return folder / "frame.tif"


@bomb("E_UNREADABLE", said="device")
def link_to_a_device(folder):
    (folder / "frame.tif").symlink_to("/dev/zero")
    return folder / "frame.tif"


@bomb("E_UNREADABLE", said="no such file|itself")
def link_to_itself(folder):
    (folder / "frame.tif").symlink_to(folder / "frame.tif")
    return folder / "frame.tif"


@bomb("E_UNREADABLE")
def file_nobody_may_read(folder):
    path = put(folder / "frame.tif", tiff(page(8, 8, bytes(64)), bytes(64)))
    path.chmod(0)
    return path


@bomb("E_UNREADABLE", said="HDF5")
def hdf5_cube(folder):
    return put(folder / "cube.h5", b"\x89HDF\r\n\x1a\n" + bytes(100))


@bomb("E_UNREADABLE", said="HDF5")
def hdf5_cube_of_another_name(folder):
    return put(folder / "cube.tif", b"\x89HDF\r\n\x1a\n" + bytes(100))


@bomb("E_UNREADABLE", said="MATLAB")
def matlab_cube(folder):
    return put(folder / "cube.mat", b"MATLAB 5.0 MAT-file, Platform: GLNXA64".ljust(128) + bytes(9))


@bomb("E_UNREADABLE", said="NumPy")
def numpy_array(folder):
    return put(folder / "cube.npy", b"\x93NUMPY\x01\0" + bytes(100))


# --- TOML, CSV and JSON ---------------------------------------------------------------------------


@bomb("E_SIZE", read="toml", said="1 MiB")
def toml_of_more_than_a_mebibyte(folder):
    return put(folder / "campaign.toml", "a = 1\n" * 200_000)


@bomb("E_SIZE", read="toml", said="nested")
def toml_of_ten_thousand_levels(folder):
    return put(folder / "campaign.toml", "a = " + "[" * 10_000 + "]" * 10_000)


@bomb("E_SIZE", read="toml", said="nested")
def toml_key_of_twenty_thousand_parts(folder):
    return put(folder / "campaign.toml", ".".join("a" * 20_000) + " = 1")


@bomb("E_SIZE", read="toml", said="key|word")
def toml_key_of_forty_kilobytes(folder):
    return put(folder / "campaign.toml", '"' + "a" * 40_000 + '" = 1')


@bomb("E_VALUE", read="toml")
def toml_with_a_key_twice(folder):
    return put(folder / "campaign.toml", "a = 1\na = 2\n")


@bomb("E_UNREADABLE", read="toml", said="UTF-8")
def toml_that_is_not_utf8(folder):
    return put(folder / "campaign.toml", b'a = "\xff\xfe\xe9"\n')


@bomb("E_UNREADABLE", read="toml", said="pipe")
def toml_that_is_a_pipe(folder):
    os.mkfifo(folder / "campaign.toml")
    return folder / "campaign.toml"


@bomb("E_UNREADABLE", read="toml", said="device")
def toml_that_is_a_device(folder):
    (folder / "campaign.toml").symlink_to("/dev/zero")
    return folder / "campaign.toml"


@bomb("E_UNREADABLE", read="toml", said="folder")
def toml_that_is_a_folder(folder):
    (folder / "campaign.toml").mkdir()
    return folder / "campaign.toml"


@bomb("E_UNREADABLE", read="toml", said="no such file|itself")
def toml_that_links_to_itself(folder):
    (folder / "campaign.toml").symlink_to(folder / "campaign.toml")
    return folder / "campaign.toml"


@bomb("E_UNREADABLE", read="manifest", said="pipe")
def manifest_that_is_a_pipe(folder):
    os.mkfifo(folder / "exposures.csv")
    return folder / "exposures.csv"


@bomb("E_SIZE", read="manifest")
def manifest_of_twenty_megabytes(folder):
    return put(folder / "exposures.csv", "file,exposure_s\n" + "a.tif,1\n" * 2_500_000)


@bomb("E_VALUE", read="manifest", field="exposure_s")
def manifest_of_nan_seconds(folder):
    return put(folder / "exposures.csv", "file,exposure_s\na.tif,nan\n")


@bomb("E_UNREADABLE", read="manifest")
def manifest_of_one_cell_of_a_megabyte(folder):
    return put(folder / "exposures.csv", "file,exposure_s\n" + "a" * 1_000_000 + ",1\n")


@bomb("E_UNREADABLE", read="json", said="NaN")
def json_of_nan(folder):
    return put(folder / "truth.json", '{"a": NaN}')


@bomb("E_UNREADABLE", read="json", said="Infinity")
def json_of_infinity(folder):
    return put(folder / "truth.json", '{"a": -Infinity}')


@bomb("E_UNREADABLE", read="json", said="1e999")
def json_of_a_number_beyond_all(folder):
    return put(folder / "truth.json", '{"a": 1e999}')


@bomb("E_UNREADABLE", read="json", said="twice")
def json_with_a_key_twice(folder):
    return put(folder / "truth.json", '{"a": 1, "a": 2}')


@bomb("E_SIZE", read="json", said="nested")
def json_of_a_hundred_thousand_levels(folder):
    return put(folder / "truth.json", "[" * 100_000 + "]" * 100_000)


@bomb("E_UNREADABLE", read="json")
def json_of_a_number_of_a_hundred_thousand_digits(folder):
    return put(folder / "truth.json", '{"a": ' + "9" * 100_000 + "}")


@bomb("E_UNREADABLE", read="json", said="table")
def json_that_is_a_list(folder):
    return put(folder / "truth.json", "[1, 2]")


@bomb("E_UNREADABLE", read="json")
def json_cut_short(folder):
    return put(folder / "truth.json", '{"a": {"b": 1')


@bomb("E_UNREADABLE", read="json", said="pipe")
def json_that_is_a_pipe(folder):
    os.mkfifo(folder / "truth.json")
    return folder / "truth.json"


# --- the reading process --------------------------------------------------------------------------


def readers():
    from levkas.campaign.discovery.file_index import read_exposures
    from levkas.campaign.schema.toml import read_toml
    from levkas.core.text import read_json
    from levkas.readers.frames import read_facts, read_frame

    return {
        "frame": (read_facts, read_frame),
        "toml": (read_toml,),
        "manifest": (read_exposures,),
        "json": (read_json,),
    }


def processor_time():
    """Seconds of this process and of the decoders that it waited for."""
    return sum(os.times()[:4])


def tell(read, path):
    """Read one file; return what came of it as plain values."""
    from levkas.core.problems import Refused

    started = processor_time()
    try:
        signal.alarm(180)
        value = read(path)
        reported = {"came": f"no refusal: {getattr(value, 'shape', type(value).__name__)}"}
    except Refused as refused:
        reported = {"came": "refused", "problems": [p.to_dict() for p in refused.problems]}
    except BaseException as error:
        reported = {"came": f"{type(error).__name__}: {error}"[:300]}
    finally:
        signal.alarm(0)
    return reported | {"seconds": processor_time() - started, "bytes": peak()}


def peak():
    """Peak resident bytes since the last call, where the kernel tells; else of the whole process."""
    import resource

    try:
        rows = Path("/proc/self/status").read_text().splitlines()
        found = next(int(row.split()[1]) for row in rows if row.startswith("VmHWM"))
        Path("/proc/self/clear_refs").write_text("5")
        return found << 10
    except (OSError, StopIteration):
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10


def main(folder):
    """Read every file, each by each of its readers, and print what came as JSON."""
    import cv2  # noqa: F401  what readers import is no growth
    import imagecodecs
    import numpy as np
    import tifffile

    from levkas.readers.frames import read_frame

    warm = Path(folder) / "warm.tif"
    tifffile.imwrite(warm, np.ones((9, 9), np.uint16), compression="zlib")
    read_frame(warm)
    imagecodecs.png_decode(imagecodecs.png_encode(np.ones((9, 9), np.uint8)))
    imagecodecs.jpeg8_decode(imagecodecs.jpeg8_encode(np.ones((9, 9), np.uint8)))
    signal.signal(signal.SIGALRM, lambda *_: (_ for _ in ()).throw(TimeoutError("180 s")))
    reads, results = readers(), {}
    for name, (_, _, _, _, kind) in CASES.items():
        path = Path((Path(folder) / name / "path").read_text())
        before = peak()
        results[name] = [tell(read, path) for read in reads[kind]]
        for reported in results[name]:
            reported["growth"] = reported["bytes"] - before
    print(json.dumps(results))


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    """What came of every file, read in one process of its own."""
    root = tmp_path_factory.mktemp("bombs")
    for name, (make, *_) in CASES.items():
        (root / name).mkdir()
        (root / name / "path").write_text(str(make(root / name)))
    command = [sys.executable, __file__, str(root)]
    done = subprocess.run(command, capture_output=True, timeout=PATIENCE_S, check=False)
    assert done.returncode == 0, done.stderr.decode()[-2000:]
    return json.loads(done.stdout)


@pytest.mark.skipif(sys.platform == "win32", reason="pipes, devices and alarms of Unix")
@pytest.mark.parametrize("name", CASES)
def test_a_hostile_file_is_refused_once_soon_and_in_little_memory(results, name):
    if name == "file_nobody_may_read" and os.geteuid() == 0:
        pytest.skip("root reads everything")
    _, code, field, said, _ = CASES[name]
    assert results[name]
    for reported in results[name][-1:] if code else ():
        assert reported["came"] == "refused", reported
        (problem,) = reported["problems"]
        assert problem["code"] == code, problem
        assert all(problem[key] for key in ("file", "found", "expected", "fix")), problem
        assert field is None or problem["field"] == field, problem
        text = " ".join(str(value) for value in problem.values())
        assert any(word in text for word in said.split("|")), problem
    for reported in results[name]:
        refused = reported["came"] == "refused" or reported["came"].startswith("no refusal")
        assert refused, reported
        assert reported["seconds"] < MOST_SECONDS, reported
        assert reported["growth"] < MOST_BYTES, reported


if __name__ == "__main__":
    main(sys.argv[1])
