"""Mosaics to channels: every channel at every sensel, in native pixels, none of them shifted."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from levkas.calibration import stencils
from levkas.calibration.detail import interpolation_variance
from levkas.calibration.patterns import channel_table
from levkas.calibration.templates import CalibrationRefused
from levkas.core.problems import Problem

METHODS: dict[str, Callable[[stencils.Place, int], stencils.Taps]] = {
    "malvar": stencils.malvar,
    "bilinear": stencils.normalised,
    "normalised": stencils.normalised,
}


def demosaic(
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    pattern: str | Sequence[Sequence[str]],
    *,
    method: str | None = None,
    channels: Sequence[str] | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Interpolate every channel of a mosaic at every sensel.

    Parameters
    ----------
    values : ndarray, (h, w), float32
        Best after the flat field and with defects replaced; NaN spreads.
    flags : ndarray, (h, w), uint8
        Bits of `cube.Flag`.
    variance : ndarray, (h, w), float32, or None
        Of `values`, taken as independent from sensel to sensel.
    pattern : str or rows of channel names
        ``"RGGB"`` or any rows; names may repeat.
    method : str, optional
        ``"malvar"`` [malvar2004]_, for Bayer patterns; ``"bilinear"`` and ``"normalised"`` are
        both first-order normalised convolution under a tent, which on a Bayer pattern *is*
        bilinear. Default: Malvar for Bayer patterns, normalised for all others.
    channels : sequence of str, optional
        Order of the last axis; default that of first appearance in `pattern`.

    Returns
    -------
    values, flags, variance : ndarray, (h, w, c), float32, uint8, float32 or None
        The variance of interpolated values holds that of detail between the sensels, see `detail`. An interpolated value is NEAR where a flagged sensel took part, with that sensel's bits
        if it was of the same channel. Measured values keep value and flags.

    Raises
    ------
    CalibrationRefused
        E_VALUE where method or pattern do not fit, E_SIZE for less than one period.

    Notes
    -----
    Away from borders Malvar's and bilinear values are those of `colour-demosaicing` (to 1e-6 of
    the range); within 2 sensels of a border that library mixes the phases, this one does not.

    Examples
    --------
    >>> y, x = np.mgrid[:6, :6]
    >>> plane = (2 * x + y).astype("f4")
    >>> made, _, _ = demosaic(plane, np.zeros((6, 6), "u1"), None, "RGGB")
    >>> bool(np.allclose(made, plane[:, :, None], atol=1e-5))
    True
    """
    table, stencil = method_of(pattern, method, channels)
    made, noted, spread = interpolate(values, flags, variance, table, stencil)
    if variance is not None and spread is not None:
        spread += interpolation_variance(
            values, flags, variance, table, lambda v, f, u: interpolate(v, f, u, table, stencil)
        )
    return made, noted, spread


def method_of(
    pattern: str | Sequence[Sequence[str]], method: str | None, channels: Sequence[str] | None
) -> tuple[np.ndarray, Callable[[stencils.Place, int], stencils.Taps]]:
    """Return the table of a pattern and the stencils of a method, arguments and refusals as of `demosaic`."""
    table = channel_table(pattern, channels)
    if method is None:
        method = "malvar" if _is_bayer(table) else "normalised"
    if method not in METHODS:
        raise CalibrationRefused(
            Problem(
                "E_VALUE",
                f"there is no demosaicing {method!r}",
                field="demosaic",
                found=method,
                expected=", ".join(METHODS),
            )
        )
    return table, METHODS[method]


def interpolate(
    values: np.ndarray,
    flags: np.ndarray,
    variance: np.ndarray | None,
    table: np.ndarray,
    method: Callable[[stencils.Place, int], stencils.Taps],
    weights: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Apply a stencil method to a mosaic whose pattern is `table`, (rows, columns) of indices.

    Arguments and results as in `demosaic`; `weights` as in `stencils.Place`.
    """
    from levkas.calibration.mosaic_kernel import weigh

    if values.ndim != 2 or any(n < p for n, p in zip(values.shape, table.shape, strict=True)):
        raise CalibrationRefused(
            Problem(
                "E_SIZE",
                "a mosaic holds one period of its pattern at least",
                found=str(values.shape),
                expected=f"(h, w), at least {table.shape}",
            )
        )
    shape = (values.shape[0], values.shape[1])
    plan = stencils.lay_out(table, shape, method, weights)
    made, noted, spread = weigh(
        np.ascontiguousarray(values, np.float32),
        np.ascontiguousarray(flags, np.uint8),
        np.zeros((1, 1), np.float32)
        if variance is None
        else np.ascontiguousarray(variance, np.float32),
        variance is not None,
        *(plan.rows, plan.columns, plan.start, plan.dy, plan.dx, plan.weight, plan.own),
        *(plan.channels, plan.reach),
    )
    return made, noted, None if variance is None else spread


def _is_bayer(table: np.ndarray) -> bool:
    if table.shape != (2, 2) or len(np.unique(table)) != 3:
        return False
    return table[0, 0] == table[1, 1] or table[0, 1] == table[1, 0]
