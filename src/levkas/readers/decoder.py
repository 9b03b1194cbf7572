"""Everything compressed is decoded by a process apart, `decoder_worker.py`: bounded in memory and time, and asked again and again.

Decoders are C that reads what anybody may have written: a damaged or hostile file ends or fills only that process, and
is refused.
"""

from __future__ import annotations

import atexit
import json
import os
import signal
import struct
import subprocess
import sys
from math import prod
from pathlib import Path
from threading import Timer
from typing import Any

import numpy as np

from levkas.readers.facts import check_memory, check_size, unreadable

PROGRAM = Path(__file__).with_name("decoder_worker.py")
PATIENCE_S = 600
OUT_OF_TIME = -int(getattr(signal, "SIGPROF", 0)) or None
"""Exit status of a decoder that took too much processor time; None where the system sets no limit."""

_idle: list[subprocess.Popen[bytes]] = []
"""Decoders without work: one for every thread that has read compressed files at a time."""


def decode(
    path: Path, kind: str, *, expected: str, needed: int = 0, **request: Any
) -> tuple[dict[str, Any], np.ndarray]:
    """Have a file decoded; return what its decoder states of it, and its samples, empty where there are none.

    `kind` names the decoder, `needed` the bytes of the frame as its header declares them, which bound memory and time;
    `expected` is for the refusal. Raises UnreadableCapture, whatever became of the decoder.
    """
    worker = _worker()
    assert worker.stdin and worker.stdout
    timer = Timer(PATIENCE_S, worker.kill)
    timer.start()
    try:
        request = {"path": str(path.absolute()), "kind": kind, "needed": needed, **request}
        worker.stdin.write(json.dumps(request).encode() + b"\n")
        (length,) = struct.unpack(">I", _exactly(worker.stdout, 4))
        found = json.loads(_exactly(worker.stdout, length))
        if "error" not in found:
            check_size(path, tuple(found["shape"]))
            check_memory(path, prod(found["shape"]), np.dtype(found["dtype"]).itemsize)
        data = _exactly(worker.stdout, found["bytes"])
    except (EOFError, OSError) as error:
        status = _stop(worker)
        why = f"the decoder ended with status {status}"
        if status == OUT_OF_TIME:
            why = "no end after as much processor time as its size allows"
        elif not timer.is_alive():
            why = f"no end after {PATIENCE_S} s"
        raise _refused(path, {"error": why}, expected) from error
    except BaseException:
        # An interrupted read too: what is left in the pipe would be the next answer.
        worker.kill()
        _stop(worker)
        raise
    finally:
        timer.cancel()
    _idle.append(worker)
    if "error" in found:
        raise _refused(path, found, expected)
    samples = np.frombuffer(data, found["dtype"])
    return found, samples.reshape(found["shape"]) if data else samples


def _refused(path: Path, found: dict[str, Any], expected: str) -> Exception:
    more = {"code": found.get("code", "E_UNREADABLE"), "field": found.get("field")}
    message = "the file cannot be decoded"
    return unreadable(path, message, found=str(found["error"])[:300], expected=expected, **more)


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
        bufsize=0,
        env=env,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
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
