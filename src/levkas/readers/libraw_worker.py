"""The program that decodes camera raws, run apart from the build: one request a line, one answer each.

LibRaw reads some hundred undocumented formats in C: a damaged or hostile file must be able to end
or fill only this process. It imports nothing of the package.

A request is a line of JSON, ``["path", true]``; true requests the pixels too. The answer is 4 bytes
with the length of a JSON object, the object, and, as many as its `bytes`, the pixels.
"""

from __future__ import annotations

import json
import os
import signal
import struct
import sys
from pathlib import Path
from typing import Any

MEMORY = 8 << 30
READING_S, READING_S_PER_MB = 2.0, 1.0
"""Processor time for opening and unpacking a file, s and s/MB; cameras' own files take a tenth."""
PATTERNS = ((2, 2), (6, 6))
"""Tiles of colours that repeat over a sensor: Bayer's, and Fujifilm's X-Trans."""
LARGEST_RATIO, FREE_BYTES = 100, 64 << 20
"""Most bytes that a byte of the file may unpack to, and what is allowed whatever the file's size."""


def limit() -> None:
    """Bound memory and writing of this process, where the system can."""
    try:
        import resource
    except ImportError:  # not on Windows
        return
    for name, most in (("DATA", MEMORY), ("FSIZE", 0), ("CORE", 0)):
        kind = getattr(resource, f"RLIMIT_{name}")
        hard = resource.getrlimit(kind)[1]
        most = most if hard == resource.RLIM_INFINITY else min(most, hard)
        resource.setrlimit(kind, (most, hard))


def limit_reading(size: int | None) -> None:
    """Bound the processor time from here on by the bytes of a file; SIGPROF ends the process. None: no bound."""
    if hasattr(signal, "setitimer"):
        most = 0.0 if size is None else READING_S + READING_S_PER_MB * size / 1e6
        signal.setitimer(signal.ITIMER_PROF, most)


def describe(raw: Any) -> dict[str, Any]:
    """Return size, levels, pattern and shot facts of an opened raw, as JSON-ready values."""
    import numpy as np

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
    facts.update(
        white=int(raw.white_level),
        iso=float(shot.iso_speed),
        exposure_s=float(shot.shutter_speed),
        captured=str(shot.timestamp) if shot.timestamp.year > 1970 else "",
    )
    return facts


def read(path: str, pixels: bool) -> tuple[dict[str, Any], bytes]:
    """Return the facts and, if requested, the bytes of the visible mosaic, or of colours where the file has no mosaic."""
    import numpy as np
    import rawpy

    size = Path(path).stat().st_size
    limit_reading(size)
    with rawpy.imread(path) as raw:
        sizes = raw.sizes
        samples = 4 if raw.raw_type == rawpy.RawType.Stack else 1
        if 2 * samples * sizes.raw_height * sizes.raw_width > max(FREE_BYTES, LARGEST_RATIO * size):
            return {"error": f"a size of {sizes.raw_width} x {sizes.raw_height}"}, b""
        values = raw.raw_image_visible
        if values is not None and values.ndim == 3:
            values = values[..., : raw.num_colors]
        if values is None or values.dtype != np.uint16 or values.shape[2:] not in ((), (3,)):
            found = "no counts" if values is None else f"{values.shape} {values.dtype}"
            return {"error": f"neither a sensor mosaic nor colours: {found}"}, b""
        if not values.any():  # what LibRaw leaves where it could not begin to decode
            return {"error": "nothing but zeros"}, b""
        # Levels and pattern only now: some formats have them set while their pixels unpack.
        margins = [int(sizes.top_margin), int(sizes.left_margin)]
        facts = {"shape": list(values.shape), "margins": margins, **describe(raw)}
        return facts, np.ascontiguousarray(values).tobytes() if pixels else b""


def serve() -> None:
    """Answer the requests of standard input until it ends."""
    limit()
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # what LibRaw prints is no answer
    for line in sys.stdin.buffer:
        try:
            facts, data = read(*json.loads(line))
        except Exception as error:  # any class of rawpy, or of numpy on its numbers
            message = error.args[0] if error.args else ""
            message = message.decode("utf-8", "replace") if isinstance(message, bytes) else message
            facts, data = {"error": f"{type(error).__name__}: {message}"}, b""
        limit_reading(None)
        head = json.dumps({**facts, "bytes": len(data)}).encode()
        answers.write(struct.pack(">I", len(head)) + head + data)
        answers.flush()


if __name__ == "__main__":
    serve()
