"""Camera raw: the mosaic as the sensor recorded it, never LibRaw's own rendering."""

from __future__ import annotations

import json
import os
import signal
import struct
import subprocess
import sys
from math import prod
from pathlib import Path
from typing import Any

import numpy as np

from levkas.readers.dng import check_parts
from levkas.readers.exif import iso_date, read_exif
from levkas.readers.facts import COPY_AGAIN, Facts, check_memory, check_size, decoding, unreadable

EXTENSIONS = """
    3fr ari arq arw bay cap cr2 cr3 crw cs1 dc2 dcr dcs dng drf erf fff gpr iiq k25 kdc mdc mef mos
    mrw nef nrw orf ori pef ptx pxn qtk raf raw rdc rw2 rwl rwz sr2 srf srw sti stx x3f
"""
SUFFIXES = frozenset(f".{name}" for name in EXTENSIONS.split())
PROGRAM = Path(__file__).with_name("libraw.py")
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
