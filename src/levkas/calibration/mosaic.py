"""Demosaicing: every channel at every sensel, in native pixels, none of them shifted.

A *stencil* holds the weights by which a mosaic's sensels make one channel at one place. All are exact on a constant and on a
plane, at the borders too: Σw = 1, Σw·dx = 0, Σw·dy = 0. A stencil depends on the phase and on how near the border is, so a
frame of any size has a few hundred of them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import product
from typing import NamedTuple

import numpy as np

from levkas.calibration.detail import interpolation_variance
from levkas.calibration.findings import refusal
from levkas.calibration.patterns import channel_table
from levkas.calibration.templates import read_only
from levkas.core.compiled import njit
from levkas.core.cube import Flag
from levkas.core.threads import in_threads

LARGEST = 4.0
"""Σ|w| of a stencil that extrapolates; a larger window is tried before more. 2 or 6 change the outermost two sensels only."""
WINDOWS = 4
"""Periods that a window may reach to each side, towards a border alone."""
Taps = list[tuple[int, int, float, bool]]
"""Offsets (dy, dx), weight, and whether the sensel is of the channel that is made."""


class Place(NamedTuple):
    """One sensel of a frame, as a stencil sees it: where it is and what is around it.

    `table` (rows, columns) is the channel at each place of the pattern; `weights`, like it, how much a sensel of each phase
    counts, 0: not at all.
    """

    y: int
    x: int
    shape: tuple[int, int]
    table: np.ndarray
    weights: np.ndarray

    def channel_at(self, dy: int, dx: int) -> int:
        """Return the channel recorded dy rows below and dx columns to the right."""
        rows, columns = self.table.shape
        return int(self.table[(self.y + dy) % rows, (self.x + dx) % columns])

    def holds(self, reach: int) -> bool:
        """Whether the frame reaches so far to all sides."""
        return reach <= self.y < self.shape[0] - reach and reach <= self.x < self.shape[1] - reach


Method = Callable[[Place, int], Taps]
"""Of a place and a channel: the taps that make it."""


def normalised(place: Place, channel: int) -> Taps:
    """Return first-order normalised convolution under a tent of one period's half width; what was measured is kept.

    On a Bayer pattern this is bilinear interpolation.
    """
    return [(0, 0, 1.0, True)] if place.channel_at(0, 0) == channel else smoothed(place, channel)


def smoothed(place: Place, channel: int) -> Taps:
    """Return the same without keeping what was measured: neighbours of the channel count too.

    Weights are k(1 + a·dx + b·dy)·c with the tent k, where a, b and c make the moments right [knutsson1993]_. Where the tent
    does not hold enough samples (borders) it is widened.
    """
    best: Taps = []
    (rows, columns), (height, width), y, x = place.table.shape, place.shape, place.y, place.x
    # Only towards a border does a window grow: what is far from one must not depend on it.
    edges = ((y, height, rows), (x, width, columns))
    sizes = [range(1, WINDOWS + 1 if i < p or i >= n - p else 2) for i, n, p in edges]
    for periods in sorted(product(*sizes), key=lambda n: (sum(n), n)):
        high, wide = periods[0] * rows, periods[1] * columns
        down = slice(max(-y, 1 - high), min(height - y, high))
        dy, dx = np.mgrid[down, max(-x, 1 - wide) : min(width - x, wide)].reshape(2, -1)
        phase = (y + dy) % rows, (x + dx) % columns
        tent = (1 - np.abs(dy) / high) * (1 - np.abs(dx) / wide) * place.weights[phase]
        kept = (place.table[phase] == channel) & (tent > 0)
        dy, dx, tent = dy[kept], dx[kept], tent[kept]
        if not len(tent):
            continue
        terms = np.stack([np.ones(len(dy)), dx, dy], 1)
        moments = terms.T @ (terms * tent[:, None])
        weights = tent * (terms @ (np.linalg.pinv(moments, rcond=1e-10) @ [1.0, 0, 0]))
        exact = np.allclose(terms.T @ weights, [1, 0, 0], atol=1e-9)
        if exact or not best:
            weights = weights if exact else tent / tent.sum()
            taps = zip(dy.tolist(), dx.tolist(), weights.tolist(), strict=True)
            best = [(v, h, w, True) for v, h, w in taps if abs(w) > 1e-12]
        if exact and np.abs(weights).sum() <= LARGEST:
            break
    return best


def _mask(text: str) -> np.ndarray:
    return np.array(text.split(), float).reshape(5, 5) / 16


GREEN_AT_COLOUR = _mask("0 0 -2 0 0  0 0 4 0 0  -2 4 8 4 -2  0 0 4 0 0  0 0 -2 0 0")
COLOUR_IN_ITS_ROW = _mask("0 0 1 0 0  0 -2 0 -2 0  -2 8 10 8 -2  0 -2 0 -2 0  0 0 1 0 0")
COLOUR_AT_COLOUR = _mask("0 0 -3 0 0  0 4 0 4 0  -3 0 12 0 -3  0 4 0 4 0  0 0 -3 0 0")
"""Masks of [malvar2004]_, doi:10.1109/ICASSP.2004.1326587, Figure 2."""


def malvar(place: Place, channel: int) -> Taps:
    """Return Malvar, He and Cutler's gradient-corrected mask; `normalised` within 2 of a border.

    Raises CalibrationRefused, E_VALUE where the pattern is not a Bayer one (2x2, one channel on a diagonal).
    """
    green, own = _green(place.table), place.channel_at(0, 0)
    if green is None:
        size = "{} x {}".format(*place.table.shape)
        raise refusal("not_bayer", f"{size}, {len(np.unique(place.table))} channels")
    if own == channel or not place.holds(2):
        return normalised(place, channel)
    if channel == green:
        mask = GREEN_AT_COLOUR
    elif own != green:
        mask = COLOUR_AT_COLOUR
    else:
        in_row = place.channel_at(0, 1) == channel
        mask = COLOUR_IN_ITS_ROW if in_row else COLOUR_IN_ITS_ROW.T
    return [
        (y - 2, x - 2, float(mask[y, x]), place.channel_at(y - 2, x - 2) == channel)
        for y, x in np.argwhere(mask).tolist()
    ]


def _green(table: np.ndarray) -> int | None:
    """Return the channel on a diagonal of a Bayer pattern; None of any other pattern."""
    if table.shape != (2, 2) or len(np.unique(table)) != 3:
        return None
    for one, other in ((table[0, 0], table[1, 1]), (table[0, 1], table[1, 0])):
        if one == other:
            return int(one)
    return None


class Stencils(NamedTuple):
    """All stencils of a frame, laid out for the kernel.

    `rows` (h,) gives each row its class; `places` (C, 3) each column class its first column, its step and its count. Stencil
    (r, c, k) of row class r, column class c and channel k has the taps ``start[i]:start[i + 1]``, i = (r·C + c)·K + k.
    """

    rows: np.ndarray
    places: np.ndarray
    start: np.ndarray
    dy: np.ndarray
    dx: np.ndarray
    weight: np.ndarray
    own: np.ndarray
    channels: int


def lay_out(
    table: np.ndarray, shape: tuple[int, int], method: Method, weights: np.ndarray | None = None
) -> Stencils:
    """Return the stencils of a method for every kind of place in a frame of `shape`; `table` and `weights` as of `Place`."""
    rows, row_class = _classes(shape[0], table.shape[0])
    columns, column_class = _classes(shape[1], table.shape[1])
    heights = np.ones(table.shape) if weights is None else np.asarray(weights, float)
    channels = int(table.max()) + 1
    taps: Taps = []
    start = [0]
    for y in rows.tolist():
        for x in columns.tolist():
            for channel in range(channels):
                taps += method(Place(y, x, shape, table, heights), channel)
                start.append(len(taps))
    alike = [np.flatnonzero(column_class == kind) for kind in range(len(columns))]
    places = [(at[0], at[1] - at[0] if len(at) > 1 else 1, len(at)) for at in alike]
    dy, dx, weight, own = (np.array(part) for part in zip(*taps, strict=True))
    return Stencils(
        row_class, np.array(places), np.array(start), dy, dx, weight, own.astype("u1"), channels
    )


def _classes(length: int, period: int) -> tuple[np.ndarray, np.ndarray]:
    """Return a position of each kind, and the kind of each position, along one axis."""
    reach = max(2, period)
    at = np.arange(length)
    if length <= 4 * WINDOWS * period:
        return at, at
    kinds = np.stack([at % period, np.minimum(at, reach), np.minimum(length - 1 - at, reach)], 1)
    _, first, which = np.unique(kinds, axis=0, return_index=True, return_inverse=True)
    return first, which.ravel()


NEAR = np.uint8(Flag.NEAR.value)


@njit(cache=True)
def _weigh(first_row, stop, planes, plan, out):  # type: ignore[no-untyped-def]
    """Fill rows with Σwv, flags and, where there is room for it, Σw²u², all (h, w, channels).

    `planes` are values, flags, variance, and the rows that have a flag within reach. Places of one kind take each tap together.
    """
    values, flags, variance, marked = planes
    colours, noted, spread = out
    known, kinds, channels = len(spread) > 0, len(plan.places), plan.channels
    sums, squares = np.empty(values.shape[1]), np.empty(values.shape[1])
    for y in range(first_row, stop):
        for kind in range(kinds):
            first, step, count = plan.places[kind]
            for k in range(channels):
                at = (plan.rows[y] * kinds + kind) * channels + k
                sums[:count], squares[:count] = 0.0, 0.0
                for i in range(plan.start[at], plan.start[at + 1]):
                    w, v, x = plan.weight[i], y + plan.dy[i], first + plan.dx[i]
                    for j in range(count):
                        sums[j] += w * values[v, x + j * step]
                    for j in range(count if known else 0):
                        squares[j] += w * w * variance[v, x + j * step]
                for j in range(count):
                    colours[y, first + j * step, k] = sums[j]
                for j in range(count if known else 0):
                    spread[y, first + j * step, k] = squares[j]
                for j in range(count if marked[y] else 0):
                    x = first + j * step
                    noted[y, x, k] = _merge_flags(flags, y, x, plan, at)


@njit
def _merge_flags(flags, y, x, plan, at):  # type: ignore[no-untyped-def]
    """Return the flags of the value that the stencil `at` gives at (y, x).

    A tap on the place itself hands its flags on as they are. Any other flagged tap sets NEAR, and hands on its bits too where
    it is of the same channel (`own`).
    """
    flag = np.uint8(0)
    for i in range(plan.start[at], plan.start[at + 1]):
        dy, dx, own = plan.dy[i], plan.dx[i], plan.own[i]
        bits = flags[y + dy, x + dx]
        if bits and dy == 0 and dx == 0 and own:
            flag |= bits
        elif bits:
            flag |= NEAR | (bits if own else np.uint8(0))
    return flag


METHODS: dict[str, Method] = {"malvar": malvar, "bilinear": normalised, "normalised": normalised}


def demosaic(
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    pattern: str | Sequence[Sequence[str]],
    *,
    method: str | None = None,
    channels: Sequence[str] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Interpolate every channel of a mosaic at every sensel: values, flags, variance, (h, w, c) each.

    Raises CalibrationRefused: E_VALUE where method or pattern do not fit, E_SIZE for less than one period.

    Parameters
    ----------
    values : ndarray, (h, w), float32
        Best after the flat field and with defects replaced; NaN spreads.
    flags : ndarray, (h, w), uint8
        Bits of `cube.Flag`. An interpolated value is NEAR where a flagged sensel took part, with that sensel's bits if it was
        of the same channel. Measured values keep value and flags.
    variance : ndarray, (h, w), float32, or None
        Of `values`, independent from sensel to sensel. That of interpolated values holds detail between the sensels, `detail`.
    pattern : str or rows of channel names
        ``"RGGB"`` or any rows; names may repeat.
    method : str, optional
        ``"malvar"`` [malvar2004]_, for Bayer patterns; ``"bilinear"`` and ``"normalised"`` are both first-order normalised
        convolution under a tent. Default: Malvar for Bayer patterns, normalised for all others.
    channels : sequence of str, optional
        Order of the last axis; default that of first appearance in `pattern`.

    Notes
    -----
    Away from borders Malvar's and bilinear values are those of `colour-demosaicing` (to 1e-6 of the range); within 2 sensels
    of a border that library mixes the phases, this one does not.

    Examples
    --------
    >>> y, x = np.mgrid[:6, :6]
    >>> plane = (2 * x + y).astype("f4")
    >>> made, _, _ = demosaic(plane, np.zeros((6, 6), "u1"), None, "RGGB")
    >>> bool(np.allclose(made, plane[:, :, None], atol=1e-5))
    True
    """
    table, stencil = method_of(pattern, method, channels)
    colours, noted, spread = interpolate(values, flags, variance, table, stencil)
    if variance is not None and spread is not None:
        spread += interpolation_variance(
            (values, flags, variance),
            table,
            lambda v, f, u: interpolate(v, f, u, table, stencil),
            compares=stencil is malvar,
        )
    return colours, noted, spread


def method_of(
    pattern: str | Sequence[Sequence[str]], method: str | None, channels: Sequence[str] | None
) -> tuple[np.ndarray, Method]:
    """Return the table of a pattern and the stencils of a method, arguments and refusals as of `demosaic`."""
    table = channel_table(pattern, channels)
    if method is None:
        method = "normalised" if _green(table) is None else "malvar"
    if method not in METHODS:
        raise refusal("demosaicing", method, expected=", ".join(METHODS))
    return table, METHODS[method]


def interpolate(
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    table: np.ndarray,
    method: Method,
    weights: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Apply a stencil method to a mosaic whose pattern is `table`, without the variance of detail; else as `demosaic`."""
    if values.ndim != 2 or any(n < p for n, p in zip(values.shape, table.shape, strict=True)):
        raise refusal("mosaic_small", str(values.shape), expected=f"(h, w), at least {table.shape}")
    shape = (values.shape[0], values.shape[1])
    plan = lay_out(table, shape, method, weights)
    spreads = np.zeros((1, 1), np.float32) if variance is None else variance
    reach = int(np.abs(plan.dy).max())
    flagged = np.convolve(np.any(flags, axis=1), np.ones(2 * reach + 1), "full")[reach:][: shape[0]]
    planes = (
        read_only(np.ascontiguousarray(values, np.float32)),
        read_only(np.ascontiguousarray(flags, np.uint8)),
        read_only(np.ascontiguousarray(spreads, np.float32)),
        flagged > 0,
    )
    full = (*shape, plan.channels)
    colours, noted = np.empty(full, np.float32), np.zeros(full, np.uint8)
    spread = np.empty(full if variance is not None else (0, *full[1:]), np.float32)
    in_threads(_weigh, shape[0], planes, plan, (colours, noted, spread), worth=colours.size)
    return colours, noted, None if variance is None else spread
