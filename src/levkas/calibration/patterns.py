"""Mosaic patterns: which channel each sensel records, and the phases they make.

A pattern is rows of channel names; it repeats from the sensor's top left sensel. A phase is the
set of sensels at one place of the pattern; a channel may own several (the green of a Bayer one).
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isqrt

import numpy as np

from levkas.calibration.findings import CalibrationRefused
from levkas.core.problems import Problem

Pattern = tuple[tuple[str, ...], ...]


def as_pattern(pattern: str | Sequence[Sequence[str]]) -> Pattern:
    """Return rows of channel names; four letters are a 2x2 pattern, 36 one of X-Trans.

    Raises CalibrationRefused, E_VALUE where rows differ in length or nothing is named.

    Examples
    --------
    >>> as_pattern("GBRG")
    (('G', 'B'), ('R', 'G'))
    """
    if isinstance(pattern, str):
        side = isqrt(len(pattern))
        square = side > 1 and side * side == len(pattern)
        rows: Pattern = tuple(
            (*pattern[i : i + side],) for i in range(0, len(pattern) if square else 0, side or 1)
        )
    else:
        rows = tuple(tuple(str(name) for name in row) for row in pattern)
    if not rows or not rows[0] or len({len(row) for row in rows}) != 1:
        raise CalibrationRefused(
            Problem(
                "E_VALUE",
                "a pattern must be 4, 9, 16 … letters, or rows with the same number of channel names",
                field="pattern",
                found=repr(pattern),
                expected='"RGGB" or [["B1", "B2", "B3"], …]',
            )
        )
    return rows


def channel_names(pattern: str | Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return the channels in the order in which they first appear, row by row.

    >>> channel_names("GBRG")
    ('G', 'B', 'R')
    """
    return tuple(dict.fromkeys(name for row in as_pattern(pattern) for name in row))


def channel_table(
    pattern: str | Sequence[Sequence[str]], channels: Sequence[str] | None = None
) -> np.ndarray:
    """Return the index of the channel at each place of the pattern, (rows, columns), int64.

    Raises CalibrationRefused, E_BAND_MISSING where `channels` and the pattern do not name the same.

    Parameters
    ----------
    channels : sequence of str, optional
        Order to count in; default `channel_names`.
    """
    rows, order = as_pattern(pattern), tuple(channels or channel_names(pattern))
    if sorted(order) != sorted(channel_names(rows)):
        raise CalibrationRefused(
            Problem(
                "E_BAND_MISSING",
                "the channels differ from those of the pattern",
                field="bands",
                found=", ".join(order),
                expected=", ".join(channel_names(rows)),
            )
        )
    return np.array([[order.index(name) for name in row] for row in rows])


def split(frame: np.ndarray, rows: int, columns: int) -> list[np.ndarray]:
    """Return the phases of a mosaic as views, row by row of the pattern; `merge` undoes it.

    >>> [p.tolist() for p in split(np.arange(6).reshape(2, 3), 2, 2)]
    [[[0, 2]], [[1]], [[3, 5]], [[4]]]
    """
    return [frame[y::rows, x::columns] for y in range(rows) for x in range(columns)]


def merge(phases: Sequence[np.ndarray], rows: int, columns: int) -> np.ndarray:
    """Return the mosaic whose `split` gives `phases`; a new array."""
    height = sum(phases[y * columns].shape[0] for y in range(rows))
    width = sum(phases[x].shape[1] for x in range(columns))
    frame = np.empty((height, width, *phases[0].shape[2:]), phases[0].dtype)
    for part, phase in zip(split(frame, rows, columns), phases, strict=True):
        part[...] = phase
    return frame


def blocks_of(plane: np.ndarray, side: int) -> np.ndarray:
    """Return the whole blocks of a plane, (rows, columns, side, side); a view where it can be.

    >>> blocks_of(np.arange(15).reshape(3, 5), 2).sum((2, 3)).tolist()
    [[12, 20]]
    """
    rows, columns = (n // side for n in plane.shape)
    whole = plane[: rows * side, : columns * side]
    return whole.reshape(rows, side, columns, side).swapaxes(1, 2)


def thin_periods(frame: np.ndarray, side: int, most: int) -> np.ndarray:
    """Return whole periods of `side` rows, evenly over a frame, of about `most` values; of few rows periods of columns, too.

    >>> thin_periods(np.arange(12).reshape(12, 1), 2, 6).ravel().tolist()
    [0, 1, 4, 5, 8, 9]
    """
    apart = -(-frame.size // most)
    frame = frame[(np.arange(len(frame)) // side) % apart == 0]
    apart = -(-frame.size // (2 * most))
    return frame if apart == 1 else frame[:, (np.arange(frame.shape[1]) // side) % apart == 0]
