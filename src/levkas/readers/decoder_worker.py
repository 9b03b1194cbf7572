"""The program that decodes compressed files, run apart from the build: one request a line, one answer each.

It imports nothing of the package. A request is a JSON object: `path`, `kind`, `needed` (bytes that the frame is to have),
and what else its kind takes. The answer is 4 bytes with the length of a JSON object, the object, and, as many as its
`bytes`, the samples.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

MEMORY, ROOM, COPIES = 8 << 30, 192 << 20, 3
"""Bytes of the whole process; above what it has, and times the frame's, that a request with `needed` may take."""
READING_S, READING_S_PER_MB, DECODING_S_PER_MB = 1.0, 1.0, 0.02
"""Processor time, s, s per MB of the file and of the frame; cameras' own files take a tenth."""
PATTERNS = ((2, 2), (6, 6))
"""Tiles of colours that repeat over a sensor: Bayer's, and Fujifilm's X-Trans."""
LARGEST_RATIO, FREE_BYTES = 100, 64 << 20
"""Most bytes that a byte of a camera raw may unpack to, and what is allowed whatever the file's size."""
PIPE_BYTES = 1 << 20
"""Twice as fast as a pipe of 64 kB."""
MOST_SCANS = 64
"""Of a progressive JPEG; encoders write about ten, and each goes through the whole image."""
Answer = tuple[dict[str, Any], "np.ndarray | None"]


class Damaged(Exception):
    """What of a file is wrong: message, code of the refusal."""


def set_limit(name: str, most: int) -> None:
    """Bound a resource of this process, where the system can: not on Windows."""
    try:
        import resource
    except ImportError:
        return
    kind = getattr(resource, f"RLIMIT_{name}")
    hard = resource.getrlimit(kind)[1]
    resource.setrlimit(kind, (most if hard == resource.RLIM_INFINITY else min(most, hard), hard))


def held() -> int:
    """Return the bytes of memory that count against the limit, where the system tells."""
    try:
        rows = Path("/proc/self/status").read_text().splitlines()
        return next(int(row.split()[1]) for row in rows if row.startswith("VmData")) << 10
    except (OSError, StopIteration):
        return MEMORY


def limit_time(seconds: float) -> None:
    """Bound the processor time from here on; SIGPROF ends the process. 0: no bound."""
    if hasattr(signal, "setitimer"):
        signal.setitimer(signal.ITIMER_PROF, seconds)


# --- camera raws ------------------------------------------------------------------------------


def describe(raw: Any) -> dict[str, Any]:
    """Return size, levels, pattern and shot facts of an opened raw, as JSON-ready values."""
    tile = raw.raw_pattern
    facts: dict[str, Any] = {"pattern": None, "blacks": list(raw.black_level_per_channel)}
    if tile is not None and tile.shape in PATTERNS:
        side = len(tile)
        indices = [int(i) for i in np.asarray(raw.raw_colors_visible[:side, :side]).ravel()]
        letters = raw.color_desc.decode("ascii", "replace")
        facts["pattern"] = "".join(letters[i] for i in indices)
        blacks = [facts["blacks"][i] for i in indices]
        # LibRaw has one black a colour: of 36 sensels their mean alone is known.
        facts["blacks"] = blacks if side == 2 else 4 * [sum(blacks) / len(blacks)]
    elif tile is None:
        facts["blacks"] = facts["blacks"][: raw.num_colors]
    shot = raw.other
    return {
        **facts,
        "white": int(raw.white_level),
        "iso": float(shot.iso_speed),
        "exposure_s": float(shot.shutter_speed),
        "captured": str(shot.timestamp) if shot.timestamp.year > 1970 else "",
    }


def read_raw(path: Path, pixels: bool) -> Answer:
    """Return the facts and, if requested, the visible mosaic, or colours where the file has no mosaic."""
    import rawpy

    with rawpy.imread(str(path)) as raw:
        sizes = raw.sizes
        samples = 4 if raw.raw_type == rawpy.RawType.Stack else 1
        needed = 2 * samples * sizes.raw_height * sizes.raw_width
        if needed > max(FREE_BYTES, LARGEST_RATIO * path.stat().st_size):
            raise Damaged(f"a size of {sizes.raw_width} x {sizes.raw_height}")
        values = raw.raw_image_visible
        if values is not None and values.ndim == 3:
            values = values[..., : raw.num_colors]
        if values is None or values.dtype != np.uint16 or values.shape[2:] not in ((), (3,)):
            found = "no counts" if values is None else f"{values.shape} {values.dtype}"
            raise Damaged(f"neither a sensor mosaic nor colours: {found}")
        if not values.any():  # what LibRaw leaves where it could not begin to decode
            raise Damaged("nothing but zeros")
        # Levels and pattern only now: some formats have them set while their pixels unpack.
        margins = [int(sizes.top_margin), int(sizes.left_margin)]
        facts = {"shape": list(values.shape), "margins": margins, **describe(raw)}
        return facts, values.copy() if pixels else None


# --- pictures ---------------------------------------------------------------------------------


def read_png(path: Path) -> Answer:
    """Return the samples of a PNG, alpha among them; the checksum of every chunk is verified."""
    import imagecodecs

    data = path.read_bytes()
    if b"IEND" not in data[-4096:]:
        raise Damaged("no IEND chunk at the end", "E_TRUNCATED")
    return {}, np.asarray(imagecodecs.png_decode(data))


def read_jpeg(path: Path, scan: int) -> Answer:
    """Return the samples of a JPEG whose first scan begins at byte `scan`; damage inside of it is told by nothing."""
    import imagecodecs

    data = path.read_bytes()
    if data.rfind(b"\xff\xd9") < scan:
        raise Damaged("no end-of-image marker after the scan", "E_TRUNCATED")
    if (scans := data.count(b"\xff\xda", scan - 4)) > MOST_SCANS:
        raise Damaged(f"{scans} scans, at most {MOST_SCANS}", "E_SIZE")
    return {}, np.asarray(imagecodecs.jpeg8_decode(data))


def read_tiff(path: Path, page: int) -> Answer:
    """Return the samples of a page of a TIFF, counted with previews and masks, in the order in which they are stored."""
    import tifffile

    with tifffile.TiffFile(path) as tiff:
        one = tiff.pages[page]
        for start, count in zip(one.dataoffsets, one.databytecounts, strict=True):
            tiff.filehandle.seek(start + max(count - 16, 0))
            # What a JPEG lacks decoders fill with gray.
            if one.compression in (6, 7, 33007) and b"\xff\xd9" not in tiff.filehandle.read(16):
                raise Damaged("a strip or tile without an end-of-image marker", "E_TRUNCATED")
        return {}, one.asarray(maxworkers=1)


# --- requests ---------------------------------------------------------------------------------


READERS = {"raw": read_raw, "png": read_png, "jpeg": read_jpeg, "tiff": read_tiff}


def answer(path: str, kind: str, needed: int, **more: Any) -> tuple[dict[str, Any], Any]:
    """Return the facts of a file, or what is wrong with it, and its samples, bytes or an array of them."""
    file = Path(path)
    stored = READING_S_PER_MB * file.stat().st_size + DECODING_S_PER_MB * needed
    limit_time(READING_S + stored / 1e6)
    set_limit("DATA", min(MEMORY, held() + ROOM + COPIES * needed) if needed else MEMORY)
    try:
        facts, values = READERS[kind](file, **more)  # type: ignore[operator]
    except MemoryError:
        found = {"error": "more memory than its size allows", "code": "E_SIZE"}
        return found, b""
    if values is None:
        return {"dtype": "uint16", **facts}, b""
    dtype = values.dtype.newbyteorder("=")
    facts = {"shape": list(values.shape), "dtype": dtype.name, **facts}
    return facts, np.ascontiguousarray(values, dtype).reshape(-1).view(np.uint8)


def serve() -> None:
    """Answer the requests of standard input until it ends."""
    set_limit("FSIZE", 0)
    set_limit("CORE", 0)
    with suppress(ImportError, AttributeError, OSError):  # of Linux, as long as a user has few
        import fcntl

        fcntl.fcntl(1, fcntl.F_SETPIPE_SZ, PIPE_BYTES)
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what LibRaw prints is no answer
    for line in sys.stdin.buffer:
        data: Any = b""
        try:
            facts, data = answer(**json.loads(line))
        except Damaged as error:
            facts = dict(zip(("error", "code"), error.args, strict=False))
        except Exception as error:  # any class of the decoders, or of numpy on their numbers
            message = error.args[0] if error.args else ""
            message = message.decode("utf-8", "replace") if isinstance(message, bytes) else message
            facts = {"error": f"{type(error).__name__}: {message}"}
        limit_time(0)
        set_limit("DATA", MEMORY)
        head = json.dumps({**facts, "bytes": len(data)}).encode()
        answers.write(struct.pack(">I", len(head)) + head)
        answers.flush()
        left = memoryview(data)
        while left:  # past the buffer, which would take a copy
            left = left[os.write(answers.fileno(), left) :]


if __name__ == "__main__":
    serve()
