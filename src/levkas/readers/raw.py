"""Camera raw: the mosaic as the sensor recorded it, never LibRaw's own rendering."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
from math import ceil, prod
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from levkas.readers.facts import COPY_AGAIN, Facts, check_memory, check_size, decoding, unreadable
from levkas.readers.images import iso_date, read_exif

EXTENSIONS = """
    3fr ari arq arw bay cap cr2 cr3 crw cs1 dc2 dcr dcs dng drf erf fff gpr iiq k25 kdc mdc mef mos
    mrw nef nrw orf ori pef ptx pxn qtk raf raw rdc rw2 rwl rwz sr2 srf srw sti stx x3f
"""
SUFFIXES = frozenset(f".{name}" for name in EXTENSIONS.split())
PROGRAM = Path(__file__).with_name("libraw_worker.py")
PATIENCE_S = 600
OUT_OF_TIME = -int(getattr(signal, "SIGPROF", 0)) or None
"""Exit status of a decoder that took too much processor time; None where the system sets no limit."""


def read_raw_facts(path: Path) -> Facts:
    """Return size, levels and pattern of the visible area, and the shot's exposure and date.

    LibRaw knows the levels of some cameras only when it has unpacked the pixels, so this takes
    nearly as long as `read_raw_mosaic`.
    """
    found, _ = _ask(path, "facts")
    with decoding(path, "camera raw"), path.open("rb") as handle:
        exif = read_exif(handle)
    blacks = tuple(float(b) for b in found["blacks"])
    white = found["white"]
    return Facts(
        path=path,
        kind="raw",
        shape=tuple(found["shape"]),
        dtype="uint16",
        bits=int(white).bit_length() if white else None,
        black=sum(blacks) / len(blacks),
        blacks=blacks if found["pattern"] and len(set(blacks)) > 1 else None,
        saturation=float(white) if white else None,
        pattern=found["pattern"],
        exposure_s=exif["exposure_s"] or found["exposure_s"] or None,
        iso=exif["iso"] or found["iso"] or None,
        captured=exif["captured"] or iso_date(found["captured"]),
        model=exif["model"],
    )


def read_raw_mosaic(path: Path) -> np.ndarray:
    """Return the visible mosaic, (h, w), uint16, curves of the camera's compression undone."""
    found, data = _ask(path, "mosaic")
    shape = tuple(int(s) for s in found["shape"])
    if len(data) != 2 * prod(shape):
        raise unreadable(
            path,
            "the camera raw cannot be read",
            code="E_TRUNCATED",
            found=f"{len(data)} bytes",
            expected=f"{2 * prod(shape)} bytes",
            fix=COPY_AGAIN,
        )
    return np.frombuffer(data, np.uint16).reshape(shape).copy()


def _ask(path: Path, what: str) -> tuple[dict[str, Any], memoryview]:
    """Run the decoder in a process of its own; its death is a refusal of this file."""
    with decoding(path, "camera raw"):
        check_parts(path)
    command = [sys.executable, "-P", str(PROGRAM), str(path.absolute()), what]
    # numpy's thread pools would count against the limits and are of no use there.
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    try:
        done = subprocess.run(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            timeout=PATIENCE_S,
            env=env,
            check=False,
        )
    except subprocess.TimeoutExpired as error:
        raise _refused(path, f"no end after {PATIENCE_S} s") from error
    if done.returncode == OUT_OF_TIME:
        raise _refused(path, "no end after as much processor time as its size allows")
    if done.returncode or len(done.stdout) < 4:
        raise _refused(path, f"the decoder ended with status {done.returncode}")
    (length,) = struct.unpack(">I", done.stdout[:4])
    found = json.loads(done.stdout[4 : 4 + length])
    if "error" in found:
        raise _refused(path, found["error"])
    check_size(path, tuple(found["shape"]))
    check_memory(path, prod(int(s) for s in found["shape"]), 2)
    return found, memoryview(done.stdout)[4 + length :]


def _refused(path: Path, found: str) -> Exception:
    expected = "a camera raw"
    if path.suffix.lower() == ".raw":
        expected = f"{path.stem}.hdr beside it (an ENVI cube), or a camera raw"
    return unreadable(
        path, "the camera raw cannot be read", found=found, expected=expected, fix=COPY_AGAIN
    )


WIDTH, LENGTH, COMPRESSION, COLOURS, SAMPLES = 256, 257, 259, 262, 277
STRIPS, STRIP_ROWS, STRIP_BYTES = 273, 278, 279
TILE_WIDTH, TILE_LENGTH, TILES, TILE_BYTES = 322, 323, 324, 325
INNER, VERSION = 330, 50706  # directories within, and what makes a TIFF a DNG
LOSSLESS_JPEG, MOSAIC = 7, 32803
FRAMES = (0xC0, 0xC1, 0xC3)
"""Markers of JPEG frames that LibRaw decodes in a mosaic."""
SIZES = {1: "B", 3: "H", 4: "I", 13: "I"}
"""Types of tags that count: bytes, numbers of two and four bytes, and places of directories."""
MOST_DIRECTORIES, MOST_TAGS, MOST_PARTS, MOST_MARKERS = 16, 4096, 1 << 16, 64
WANTED = frozenset((
    WIDTH, LENGTH, COMPRESSION, COLOURS, SAMPLES, STRIPS, STRIP_ROWS, STRIP_BYTES, TILE_WIDTH, TILE_LENGTH,
    TILES, TILE_BYTES, INNER, VERSION,
))  # fmt: skip
Tags = dict[int, tuple[int, ...]]


def check_parts(path: Path) -> None:
    """Refuse a DNG of lossless JPEG whose mosaic lacks a strip or tile; what is none is passed over.

    LibRaw leaves zeros where a part is no JPEG; of other compressions it complains itself.

    Raises
    ------
    UnreadableCapture
        ``E_TRUNCATED`` where a part is missing, reaches past the end or does not begin as it should.
    """
    with path.open("rb") as handle:
        size = handle.seek(0, 2)
        handle.seek(0)
        head = handle.read(8)
        order = {b"II*\0": "<", b"MM\0*": ">"}.get(head[:4])
        if order is None or len(head) < 8:
            return
        found = _directories(handle, order, struct.unpack(order + "I", head[4:])[0])
        if not any(VERSION in tags for tags in found):
            return
        for tags in found:
            if tags.get(COLOURS) == (MOSAIC,) and tags.get(COMPRESSION) == (LOSSLESS_JPEG,):
                _check_mosaic(path, handle, tags, size)


def _directories(handle: BinaryIO, order: str, first: int) -> list[Tags]:
    """Return the tags of all directories, those within others too; each place is gone to once."""
    left, seen = [first], set[int]()
    found: list[Tags] = []
    while left and len(found) < MOST_DIRECTORIES:
        at = left.pop(0)
        if at in seen or not at:
            continue
        seen.add(at)
        tags, following = _tags(handle, order, at)
        found.append(tags)
        left += [following, *tags.get(INNER, ())[:MOST_DIRECTORIES]]
    return found


def _tags(handle: BinaryIO, order: str, at: int) -> tuple[Tags, int]:
    """Return the whole numbers of a directory by their tags, and where the next directory is."""
    handle.seek(at)
    data = handle.read(2)
    count = min(struct.unpack(order + "H", data)[0] if len(data) == 2 else 0, MOST_TAGS)
    data = handle.read(12 * count + 4)
    tags: Tags = {}
    for start in range(0, min(12 * count, len(data) - 11), 12):
        tag, kind, many = struct.unpack_from(order + "HHI", data, start)
        if tag not in WANTED or tag in tags or kind not in SIZES or many > MOST_PARTS:
            continue
        form = f"{order}{many}{SIZES[kind]}"
        values = data[start + 8 : start + 12]
        if struct.calcsize(form) > 4:
            handle.seek(struct.unpack(order + "I", values)[0])
            values = handle.read(struct.calcsize(form))
        if len(values) >= struct.calcsize(form):
            tags[tag] = struct.unpack_from(form, values)
    last = data[12 * count : 12 * count + 4]
    return tags, struct.unpack(order + "I", last)[0] if len(last) == 4 else 0


def _check_mosaic(path: Path, handle: BinaryIO, tags: Tags, size: int) -> None:
    def one(tag: int, default: int) -> int:
        return (tags.get(tag) or (default,))[0]

    width, length = one(WIDTH, 0), one(LENGTH, 0)
    tiled = TILES in tags
    across = one(TILE_WIDTH, 0) if tiled else width
    down = one(TILE_LENGTH, 0) if tiled else min(one(STRIP_ROWS, length), length)
    starts = tags.get(TILES if tiled else STRIPS, ())
    counts = tags.get(TILE_BYTES if tiled else STRIP_BYTES, ())
    if min(width, length, across, down) < 1:
        raise _lacking(
            path, f"parts of {across} x {down} in {width} x {length} pixels", "sizes > 0"
        )
    expected = ceil(width / across) * ceil(length / down)
    there = sum(s > 0 and c > 0 for s, c in zip(starts, counts, strict=False))
    if there < max(expected, len(starts)):
        raise _lacking(path, f"{there} with data", f"{max(expected, len(starts))}")
    end = max(s + c for s, c in zip(starts, counts, strict=False))
    if max(end, sum(counts)) > size:
        raise _lacking(path, f"{size} bytes", f"at least {max(end, sum(counts))} bytes")
    for number, (start, count) in enumerate(zip(starts, counts, strict=False)):
        left = length - number // ceil(width / across) * down
        least = across * (down if tiled else min(down, left)) * one(SAMPLES, 1)
        if (found := _samples(handle, start, start + count)) < least:
            raise _lacking(path, f"{found} samples in part {number}", f"{least} in a JPEG")


def _samples(handle: BinaryIO, start: int, end: int) -> int:
    """Return how many samples a JPEG says that it has; 0 for what is none."""
    handle.seek(start)
    found = 0
    if handle.read(2) != b"\xff\xd8":
        return 0
    for _ in range(MOST_MARKERS):
        head = handle.read(4)
        if handle.tell() > end or len(head) < 4 or head[0] != 0xFF:
            return 0
        body = handle.read(struct.unpack(">H", head[2:])[0] - 2 if head[2:] > b"\0\2" else 0)
        if head[1] in FRAMES and len(body) >= 6:
            bits, down, across, channels = struct.unpack_from(">BHHB", body)
            found = down * across * channels if 2 <= bits <= 16 else 0
        if head[1] == 0xDA:
            return found
    return 0


def _lacking(path: Path, found: str, expected: str) -> Exception:
    return unreadable(
        path,
        "a strip or tile of the camera raw is not there",
        code="E_TRUNCATED",
        field="offsets and byte counts",
        found=found,
        expected=expected,
        fix=COPY_AGAIN,
    )
