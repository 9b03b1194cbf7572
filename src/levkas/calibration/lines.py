"""Lines of a push-broom camera: what `flatfield` makes of them, faster, for dark and white are one line."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.calibration.flatfield import Side, exact_side, model_of, pair_darks
from levkas.calibration.templates import Template, as_marks, gaps_of
from levkas.calibration.whites import check_white, reflectance_table
from levkas.core.cube import Flag
from levkas.core.rounding import SIGMA_DROP, VALUE_DROP

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from levkas.calibration.noise_fit import NoiseModel

BLACK_CLIP = 0.0
_DEFECT, _SATURATED = int(Flag.DEFECT), int(Flag.SATURATED)


@dataclass(frozen=True, eq=False)
class LineField:
    """All of the flat field that is the same for every line.

    Made by `of`; `develop` applies it.
    """

    shape: tuple[int, int]
    quantity: str
    notes: tuple[str, ...]
    has_sigma: bool
    _tables: Any

    @classmethod
    def of(
        cls,
        darks: Sequence[Template],
        white: Template | None,
        *,
        exposure_s: float | None = None,
        shape: tuple[int, int],
        reflectance: float | np.ndarray,
        black: float | None,
        noise: NoiseModel | None,
        labels: Sequence[str],
    ) -> LineField:
        """Work the tables out.

        Parameters
        ----------
        darks : sequence of Template, (1, samples, bands)
            Of one or several exposures.
        white : Template, (1, samples, bands), or None
        exposure_s : float, optional
            Of the lines.
        shape : (samples, bands)
        reflectance, black, noise, labels
            As for `flat_field`.

        Raises
        ------
        CalibrationRefused
            As `flat_field` does.
        """
        from levkas.calibration.line_kernels import Tables, fill_share

        nothing = np.zeros((1, *shape), bool)
        zero = np.zeros((1, *shape), np.float32)
        line = Template(zero, None, 1, nothing, nothing, exposure_s)
        under, white_under, ratio, notes = pair_darks(line, darks, white, black)
        scale = reflectance_table(reflectance, line, None) * ratio
        flags = _spread(as_marks(under.saturated), shape) * np.uint8(_DEFECT)
        if white is None:
            scale, lit_side = np.ones((1, 1)), exact_side(1.0)
        else:
            check_white(white, white_under.mean, None, labels)
            lit_side = Side.of_shots(white)
            flags |= _spread(as_marks(white.saturated), shape) * np.uint8(_SATURATED)
        sides = lit_side, Side.of_dark(under), Side.of_dark(white_under)
        means = [_spread(side.mean, shape).astype(np.float64) for side in sides]
        lit = means[0] - means[2]
        if (lost := gaps_of(*darks, white)) is not None:
            lit[_spread(lost, shape)] = np.nan  # as where the white is not above dark
        gain, read, white_read, step = model_of(noise, under, white_under)
        signals = (lit, np.zeros_like(lit), np.zeros_like(lit))
        reads = (white_read, read, white_read)
        shares = np.empty((3, lit.size))
        for row, side, signal, own in zip(shares, sides, signals, reads, strict=True):
            measured = _spread(side.variance, shape)
            fill_share(row, signal, measured, side.freedom, side.share, gain, own, step)
        shared = under.mean is white_under.mean
        table = np.resize(scale.reshape(-1), lit.size)
        if not shared:
            shares[0] += shares[2]
        with np.errstate(divide="ignore", invalid="ignore"):
            share_of_white = np.where(lit > 0, 1 / lit, 0.0)
            factor = table / lit
        lost_places = np.flatnonzero(~(share_of_white > 0))
        means_and_shares = (means[1], share_of_white, factor, shares[0], shares[1], flags)
        tables = Tables(*means_and_shares, lost_places, gain, read, bool(shared))
        quantity = "counts" if white is None else "reflectance"
        return cls(shape, quantity, notes, noise is not None, tables)

    def develop(
        self,
        raw: np.ndarray,
        *,
        saturation: float | None,
        threads: int,
        exact: bool = False,
        squared: bool = False,
        out: tuple[np.ndarray, np.ndarray, np.ndarray | None] | None = None,
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
        """Calibrate lines, (lines, samples, bands), uint8 or uint16, of any strides.

        Values that are to be `exact` are not rounded; `squared`, the square of sigma takes its place.
        They are written to `out`, values, flags and sigma, C-contiguous, where it is given.

        Returns
        -------
        values, flags, sigma : ndarray like `raw`, float32, uint8, float32 or None
            Where the white is not above dark, or a template lost its value, the value is 0 and
            flagged DEFECT and OUTSIDE.
        """
        from levkas.calibration.line_kernels import LineLimits, develop_lines

        kernel: Callable[..., None] = develop_lines
        if out is None:
            known = np.empty(raw.shape, np.float32) if self.has_sigma else None
            out = np.empty(raw.shape, np.float32), np.empty(raw.shape, np.uint8), known
        values, flags, noise = out
        sigma = np.empty((0, 0), np.float32) if noise is None else noise
        made = tuple(p.reshape(len(p), -1) if p.size else p for p in (values, flags, sigma))
        limit = np.inf if saturation is None else float(saturation)
        limits = LineLimits(limit, BLACK_CLIP, 0 if exact else VALUE_DROP, SIGMA_DROP, squared)
        codes, apart = _flat(raw)
        apart = (*apart, self.shape[1])
        edges = np.linspace(0, len(raw), min(threads, len(raw)) + 1).astype(int)

        def work(part: tuple[int, int]) -> None:
            kernel(*part, codes, apart, self._tables, limits, made)

        with ThreadPoolExecutor(threads) as pool:
            list(pool.map(work, zip(edges[:-1].tolist(), edges[1:].tolist(), strict=True)))
        return out


def _flat(raw: np.ndarray) -> tuple[np.ndarray, tuple[int, ...]]:
    """Return the numbers of an array as they lie in memory, and how far neighbours on each axis are apart."""
    order = sorted(range(raw.ndim), key=lambda axis: -raw.strides[axis])
    packed = np.ascontiguousarray(raw.transpose(order))
    strides = dict(zip(order, packed.strides, strict=True))
    return packed.reshape(-1), tuple(strides[a] // raw.itemsize for a in range(raw.ndim))


def _spread(array: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Repeat one number for all, or take a line as it is."""
    return np.ascontiguousarray(np.broadcast_to(array.reshape(-1), (shape[0] * shape[1],)))
