"""Codes of raw frames against the bits that are declared."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from levkas.calibration.code_spacing import count_codes
from levkas.calibration.templates import CalibrationRefused
from levkas.core.problems import Problem

SAMPLE = 1 << 20
FEW_CODES = 1 << 16
"""Values of every frame whose alignment is looked at."""
LEAST_LEVELS = 16
"""Fewer different codes say nothing of their spacing: a dark frame has three."""
EVEN = 0.9
"""Of the spacing that 8 bits have when they are stretched; rounding makes some steps shorter."""


class CodesRefused(CalibrationRefused):
    """Frames whose codes do not have the bits that are declared."""


def check_codes(values: np.ndarray, path: Path, camera: str, bits: int, full: float | None) -> None:
    """Refuse a frame that cannot have, or does not keep to, the bits that are declared.

    Raises CodesRefused, ``E_BITS`` for 8-bit frames where more bits are declared, and for codes beyond both full scales.

    Parameters
    ----------
    bits : int
        Declared.
    full : float, optional
        Declared saturation: 4095 · 16 where 12 bits stand at the upper end of 16.
    """
    if values.dtype.kind not in "ui":
        return
    stored = 8 * values.dtype.itemsize
    if stored < bits and stored == 8:
        raise CodesRefused(
            Problem(
                "E_BITS",
                f"{camera}: the frame has 8 bits, and {bits} are declared",
                str(path),
                f"cameras.{camera}.bits",
                f"{values.dtype} codes up to {int(values.max(initial=0))}",
                f"codes of {bits} bits, up to {2**bits - 1}",
                "Export the frames again in 16 bits; write `bits = 8` only if the camera has no more.",
            )
        )
    most = max(2**bits - 1, full or 0)
    if (top := int(values.max(initial=0))) > most:
        raise CodesRefused(
            Problem(
                "E_BITS",
                f"{camera}: codes exceed {bits} bits",
                str(path),
                f"cameras.{camera}.bits",
                top,
                f"at most {most:g}",
                f"Write `bits = {top.bit_length()}`. If the {bits} bits are stored in the upper bits "
                "of a code, write `saturation` in stored codes.",
            )
        )


def doubt_codes(frames: Iterable[np.ndarray], bits: int, full: float) -> list[str]:
    """Return what contradicts `bits`, looking at some bright frames of one sensor.

    Examples
    --------
    >>> stretched = np.round(np.arange(256) * 4095 / 255).astype(np.uint16)
    >>> doubt_codes([stretched.reshape(16, 16)], 12, 4095)
    ['only 256 codes, 16 or more apart: 8 bits were stretched to 12, and the tones between are lost']
    """
    codes = [_distinct(thin_rows(values)) for values in frames if values.dtype.kind in "ui"]
    distinct = np.unique(np.concatenate(codes)) if codes else np.empty(0, int)
    if bits <= 8 or distinct.size < LEAST_LEVELS:
        return []
    if distinct[-1] <= 255:
        return [
            f"no code exceeds {int(distinct[-1])}, and {bits} bits are declared: the frames may have "
            "8 bits, or very little light"
        ]
    gap = int(np.diff(distinct.astype(np.int64)).min())
    if distinct.size <= 256 and gap >= EVEN * full / 255:
        return [
            f"only {distinct.size} codes, {gap} or more apart: 8 bits were stretched to {bits}, and "
            "the tones between are lost"
        ]
    return []


def _distinct(values: np.ndarray) -> np.ndarray:
    """Return the codes that occur, in order; of 8 and 16 bits by counting, a tenth of the time."""
    if values.dtype in (np.uint8, np.uint16):
        return np.flatnonzero(count_codes([values]))
    return np.unique(values)


def thin_rows(values: np.ndarray, most: int = SAMPLE) -> np.ndarray:
    """Whole rows of a frame, about `most` values."""
    step = max(1, values.size // most)
    return values[:: min(step, max(values.shape[0] // 8, 1))]
