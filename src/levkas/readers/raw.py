"""Camera raw: the mosaic as the sensor recorded it, or the colours of a linear DNG; never LibRaw's own rendering."""

from __future__ import annotations

import atexit
import json
import os
import signal
import struct
import subprocess
import sys
from collections import OrderedDict
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from itertools import islice
from math import ceil, prod
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np

from levkas.core.digests import Stamp, stamp_of
from levkas.readers.black_levels import BlackLevels, black_facts
from levkas.readers.exif import iso_date, read_exif
from levkas.readers.facts import (
    Facts,
    UnreadableCapture,
    check_memory,
    check_size,
    decoding,
    truncated,
    unreadable,
)
from levkas.readers.images import jpeg_frame, jpeg_segments
from levkas.readers.tiff import check_strips
from levkas.readers.tiff_tags import numbers_of

EXTENSIONS = """
    3fr ari arq arw bay cap cr2 cr3 crw cs1 dc2 dcr dcs dng drf erf fff gpr iiq k25 kdc mdc mef mos
    mrw nef nrw orf ori pef ptx pxn qtk raf raw rdc rw2 rwl rwz sr2 srf srw sti stx x3f
"""
SUFFIXES = frozenset(f".{name}" for name in EXTENSIONS.split())
PROGRAM = Path(__file__).with_name("libraw_worker.py")
PATIENCE_S = 600
OUT_OF_TIME = -int(getattr(signal, "SIGPROF", 0)) or None
"""Exit status of a decoder that took too much processor time; None where the system sets no limit."""
DNG_VERSION, MOSAIC, LINEAR, LOSSLESS_JPEG = 50706, 32803, 34892, 7
FLOATS, PLANES = 3, 2
FRAMES = (0xC0, 0xC1, 0xC3)
"""Markers of JPEG frames that LibRaw decodes in a mosaic."""
CONVERT_AGAIN = (
    "Convert the camera's own file again, to a DNG of integers, in tiles or without compression."
)
MOST_DIRECTORIES, MOST_SEGMENTS, HEADER_BYTES = 16, 64, 1 << 16

_read: OrderedDict[tuple[Path, Stamp], dict[str, Any]] = OrderedDict()
"""What was found beside the pixels of the last files: their facts need no second decoding."""
MOST_READ = 1 << 10

_idle: list[subprocess.Popen[bytes]] = []
"""Decoders without work: one for every thread that has read camera raws at a time."""


def read_raw_facts(path: Path) -> Facts:
    """Return size, levels and pattern of the visible area, and the shot's exposure and date.

    LibRaw has the levels of some cameras only when it has unpacked the pixels, so this takes
    nearly as long as `read_raw`.
    """
    found = _read.get((path, stamp_of(path))) or _decode(path, pixels=False)[0]
    white = float(found["white"]) or None
    with decoding(path, "camera raw"), path.open("rb") as handle:
        exif = read_exif(handle)
        levels = {"saturation": white, **_black(path, found, white)}
    return Facts(
        path=path,
        kind="raw" if len(found["shape"]) == 2 else "raw-colours",
        shape=tuple(found["shape"]),
        dtype="uint16",
        bits=int(white).bit_length() if white else None,
        **levels,
        pattern=found["pattern"],
        **{
            **exif,
            "exposure_s": exif["exposure_s"] or found["exposure_s"] or None,
            "iso": exif["iso"] or found["iso"] or None,
            "captured": exif["captured"] or iso_date(found["captured"]),
        },
    )


def read_raw_headers(path: Path) -> Facts:
    """Return what the EXIF of a camera raw states; its size, levels and pattern stay unknown, and nothing is decoded."""
    with decoding(path, "camera raw"), path.open("rb") as handle:
        return Facts(path=path, kind="raw", shape=(), dtype="uint16", **read_exif(handle))


def _black(path: Path, found: dict[str, Any], white: float | None) -> dict[str, Any]:
    """Return the black facts: of a DNG by its own tags, which LibRaw has the mean of, else by LibRaw's channels."""
    levels = tuple(float(b) for b in found["blacks"])
    mean = sum(levels) / len(levels)
    if len(found["shape"]) == 3:
        return _levels_of_colours(path, levels, white)
    with _opened(path, MOSAIC) as mosaics:
        if mosaics:
            (top, left), (height, width) = found["margins"], found["shape"]
            page = max(mosaics, key=lambda page: page.imagelength * page.imagewidth)
            area = (top, left, top + height, left + width)
            declared = black_facts(page, area, top=white, mean=mean)
            return {"black": mean} if declared == {"black": None} else declared
    blacks = BlackLevels((levels[:2], levels[2:])) if found["pattern"] else None
    return {"black": mean, "blacks": blacks if blacks and blacks.varies else None}


def _levels_of_colours(
    path: Path, blacks: tuple[float, ...], white: float | None
) -> dict[str, Any]:
    """Return black and full scale of a linear DNG by its own tags, else LibRaw's: of a black that all colours share LibRaw takes it off the white."""
    with _opened(path, LINEAR) as pages:
        if pages:
            tags = max(pages, key=lambda page: page.imagelength * page.imagewidth).tags
            blacks = numbers_of(tags, "BlackLevel") or (0.0,)
            white = min(numbers_of(tags, "WhiteLevel"), default=white)
    if len(set(blacks)) == 1:
        return {"black": blacks[0], "saturation": white}
    each = ", ".join(f"{level:g}" for level in blacks)
    return {"black": None, "black_unclear": f"levels of the colours: {each}", "saturation": white}


def read_raw(path: Path) -> np.ndarray:
    """Return the visible mosaic, (h, w), uint16, curves of the camera's compression undone.

    Of a raw of colours, such as a linear DNG, (h, w, 3): the camera's own red, green and blue, proportional to light.
    """
    stamp = stamp_of(path)
    found, data = _decode(path, pixels=True)
    _read[path, stamp] = found
    while len(_read) > MOST_READ:
        _read.popitem(last=False)
    return np.frombuffer(data, np.uint16).reshape(found["shape"])


# --- the decoder ------------------------------------------------------------------------------


def _decode(path: Path, *, pixels: bool) -> tuple[dict[str, Any], bytearray]:
    """Have a file decoded in a process apart, which stays for the next; its death is a refusal of this file."""
    with decoding(path, "camera raw"):
        _check_parts(path)
    worker = _worker()
    assert worker.stdin and worker.stdout
    timer = Timer(PATIENCE_S, worker.kill)
    timer.start()
    try:
        worker.stdin.write(json.dumps([str(path.absolute()), pixels]).encode() + b"\n")
        worker.stdin.flush()
        (length,) = struct.unpack(">I", _exactly(worker.stdout, 4))
        found = json.loads(_exactly(worker.stdout, length))
        if "error" not in found:
            check_size(path, tuple(found["shape"]))
            check_memory(path, prod(found["shape"]), 2)
        data = _exactly(worker.stdout, found["bytes"])
    except (EOFError, OSError) as error:
        status = _stop(worker)
        late = f"no end after {PATIENCE_S} s"
        if status == OUT_OF_TIME:
            late = "no end after as much processor time as its size allows"
        crashed = timer.is_alive() and status != OUT_OF_TIME
        found_instead = f"the decoder ended with status {status}" if crashed else late
        raise _refused(path, found_instead) from error
    except (
        BaseException
    ):  # also an interrupted read: what is left in the pipe would be the next answer
        worker.kill()
        _stop(worker)
        raise
    finally:
        timer.cancel()
    _idle.append(worker)
    if "error" in found:
        raise _refused(path, found["error"])
    return found, data


def _worker() -> subprocess.Popen[bytes]:
    """Return an idle decoder that is alive, or start one."""
    while _idle:
        try:
            worker = _idle.pop()
        except IndexError:  # another thread took the last
            break
        if worker.poll() is None:
            return worker
        _stop(worker)
    # numpy's thread pools would count against the limits and are of no use there.
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    return subprocess.Popen(
        [sys.executable, "-P", str(PROGRAM)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
        bufsize=0,
        env=env,
    )


def _stop(worker: subprocess.Popen[bytes]) -> int:
    """Wait for a decoder that has ended, or end it; return its status."""
    try:
        worker.wait(timeout=1)
    except subprocess.TimeoutExpired:
        worker.kill()
    with worker:
        return worker.wait()


@atexit.register
def _stop_idle() -> None:
    while _idle:
        worker = _idle.pop()
        worker.kill()
        _stop(worker)


if hasattr(os, "register_at_fork"):  # a child has no part in its parent's pipes
    os.register_at_fork(after_in_child=_idle.clear)


def _exactly(stream: Any, count: int) -> bytearray:
    """Read `count` bytes of a pipe; raises EOFError where it ends before."""
    data = bytearray(count)
    left = memoryview(data)
    while left:
        got = stream.readinto(left)
        if not got:
            raise EOFError
        left = left[got:]
    return data


def _refused(path: Path, found: str) -> Exception:
    expected = "a camera raw"
    if path.suffix.lower() == ".raw":
        expected = f"{path.stem}.hdr beside it (an ENVI cube), or a camera raw"
    return unreadable(path, "the camera raw cannot be read", found=found, expected=expected)


# --- DNG: LibRaw leaves zeros where a part of lossless JPEG is none ----------------------------


@contextmanager
def _opened(path: Path, *kinds: int) -> Iterator[list[Any]]:
    """Yield the pages of a DNG that are of some kinds (PhotometricInterpretation); none of another file."""
    import tifffile

    with path.open("rb") as handle:
        plain = handle.read(4) in (b"II*\0", b"MM\0*")
    try:
        tiff = tifffile.TiffFile(path) if plain else None
    except Exception:  # whatever damaged directories lead it to
        if path.suffix.lower() == ".dng":
            raise
        tiff = None
    if tiff is None:
        yield []
        return
    with tiff:
        pages: list[Any] = list(islice(tiff.pages, MOST_DIRECTORIES))
        for page in pages:  # directories within directories follow as they are found
            if page.subifds and len(pages) < MOST_DIRECTORIES:
                pages += islice(page.pages or (), MOST_DIRECTORIES - len(pages))
        dng = any(DNG_VERSION in page.tags for page in pages)
        yield [page for page in pages if dng and page.photometric in kinds]


def _check_parts(path: Path) -> None:
    """Refuse a DNG whose raw image LibRaw would change without a word, or of lossless JPEG that lacks a strip or tile; what is no DNG is passed over.

    Of other compressions LibRaw complains itself.

    Raises UnreadableCapture: ``E_TRUNCATED`` where a part is missing, reaches past the end or does not begin as it should.
    """
    with _opened(path, MOSAIC, LINEAR) as pages:
        for page in pages:
            _check_layout(path, page)
            if page.compression == LOSSLESS_JPEG:
                _check_page(path, page.parent, page)


def _check_layout(path: Path, page: Any) -> None:
    """Refuse a page of floats, which LibRaw scales by the most of each file, and colours in planes, which it mixes."""
    if page.sampleformat == FLOATS:
        raise _unlike(path, "SampleFormat", "floats", "integers")
    if page.planarconfig == PLANES and page.samplesperpixel > 1:
        raise _unlike(path, "PlanarConfiguration", "planes", "the samples of a pixel side by side")


def _unlike(path: Path, field: str, found: str, expected: str) -> Exception:
    """Return the refusal of a raw image that LibRaw would change."""
    message = "a raw image of this layout is not read"
    return unreadable(path, message, field=field, found=found, expected=expected, fix=CONVERT_AGAIN)


def _check_page(path: Path, tiff: Any, page: Any) -> None:
    """Refuse a page of which a strip or tile is missing, or declares fewer samples than it has to hold."""
    message, field = "a strip or tile of the camera raw is missing", "offsets and byte counts"
    try:
        check_strips(path, tiff, page, "the raw image")
    except UnreadableCapture as refused:
        (problem,) = refused.problems
        raise truncated(path, message, field, problem.found, str(problem.expected)) from None
    if not page.is_tiled and len(page.dataoffsets) > 1:  # LibRaw reads the first, and leaves zeros
        strips = f"{len(page.dataoffsets)} strips of lossless JPEG"
        raise _unlike(path, "RowsPerStrip", strips, "tiles, or one strip")
    high = page.tilelength if page.is_tiled else page.rowsperstrip
    wide = page.tilewidth if page.is_tiled else page.imagewidth
    across = ceil(page.imagewidth / wide)
    for number, (start, count) in enumerate(
        zip(page.dataoffsets, page.databytecounts, strict=True)
    ):
        left = high if page.is_tiled else page.imagelength - number // across * high
        least = wide * min(high, left) * page.samplesperpixel
        tiff.filehandle.seek(start)
        found, components = _lossless_size(tiff.filehandle.read(min(count, HEADER_BYTES)))
        if found < least:
            found_text = f"{found} samples in part {number}"
            raise truncated(path, message, field, found_text, f"{least} in a JPEG")
        if page.photometric == LINEAR and components != page.samplesperpixel:
            mixed = f"{components} components of the JPEG in part {number}"
            raise _unlike(path, "SamplesPerPixel", mixed, f"{page.samplesperpixel}")


def _lossless_size(data: bytes) -> tuple[int, int]:
    """Return how many samples a JPEG declares that LibRaw decodes in a raw image, and of how many components; 0 for any other."""
    segments = list(islice(jpeg_segments(BytesIO(data)), MOST_SEGMENTS))
    if data[:2] != b"\xff\xd8" or not segments or segments[-1][0] != 0xDA:
        return 0, 0
    found = 0, 0
    for marker, content in segments:
        frame = jpeg_frame(marker, content) if marker in FRAMES else None
        if frame:
            found = (prod(frame[1:]), frame[3]) if 2 <= frame[0] <= 16 else (0, 0)
    return found
