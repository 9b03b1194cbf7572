"""Whether a capture that is held whole fits in memory: found out before it is read, not by the system."""

from __future__ import annotations

from math import prod
from typing import TYPE_CHECKING

from levkas.core.machine import free_memory, memory_bound
from levkas.core.problems import Problem, Refused

if TYPE_CHECKING:
    from pathlib import Path

    from levkas.campaign.discovery.captures import Capture

CUBE_BYTES = 9
"""Of a calibrated value with its flags and its sigma; what is needed beside them comes on top."""


class TooLarge(Refused):
    """A capture that does not fit in memory."""


def require_memory(capture: Capture, kind: str) -> None:
    """Refuse with ``E_MEMORY`` a capture whose calibrated values alone are more than what is free.

    Parameters
    ----------
    capture : Capture
    kind : str
        Of its camera.

    Raises
    ------
    TooLarge
    """
    free = memory_bound()
    needed = CUBE_BYTES * count_values(capture, kind)
    if free is None or needed <= free:
        return
    raise TooLarge(
        Problem(
            "E_MEMORY",
            f"{capture.object}/{capture.layer} does not fit in memory",
            file=str(capture.sensors[0].object[0].path),
            field=f"cameras.{capture.camera}",
            found=f"{free / 1e9:.1f} GB free",
            expected=f"at least {needed / 1e9:.1f} GB",
            fix="Build on a machine with more memory, or cut or bin the frames. Only a line scan in one "
            "ENVI file, of another camera than the reference, is built line by line.",
        )
    )


def ran_out(capture: Capture, error: MemoryError) -> TooLarge:
    """Return the refusal of a capture whose stage ended for want of memory."""
    free = free_memory()
    return TooLarge(
        Problem(
            "E_MEMORY",
            f"{capture.object}/{capture.layer}: memory ran out: {error or 'no more was given'}",
            file=str(capture.sensors[0].object[0].path),
            field=f"cameras.{capture.camera}",
            found=None if free is None else f"{free / 1e9:.1f} GB free",
            fix="Close other programs, or build on a machine with more memory; then build again: what "
            "is done is kept.",
        )
    )


def count_values(capture: Capture, kind: str) -> int:
    """Return how many values, all bands, the largest sensor of a capture has; of a scan, all strips."""
    counts = [0]
    for sensor in capture.sensors:
        sizes = [_size_of(frame.path) for frame in sensor.object]
        if kind == "cube":
            counts.append(sum(sizes))
        elif kind == "bands":
            counts.append(max(sizes, default=0) * len(sensor.bands))
        else:
            counts.append(max(sizes, default=0))
    return max(counts)


def _size_of(path: Path) -> int:
    from levkas.readers.frames import read_facts

    try:
        return prod(int(n) for n in read_facts(path).shape)
    except Refused:  # all that is wrong with the frames is told together, when they are read
        return 0
