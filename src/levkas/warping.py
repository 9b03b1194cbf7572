"""Resampling: every band on the grid, each pixel interpolated once through one composed map.

The kernel is Keys' cubic with a = −0.5, exact on a ramp; where the grid is coarser than the source
it is widened by the local scale, so that nothing aliases. Weights are corrected for position, so that
a ramp stays a ramp for any width and at every border. Sums are float64: the bytes do not depend on
threads or tiles.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from levkas.transforms import Transform

LATTICE_PX = 16
LARGEST_MAP_ERROR_PX = 1e-4
PROBES = 257
WIDE_FROM = 1.05


@dataclass(frozen=True)
class Warped:
    """What lies on the grid.

    Parameters
    ----------
    values : ndarray, (h, w, bands), float32
        NaN where the camera did not see.
    flags : ndarray, (h, w, bands), uint8
    variance : ndarray, (h, w, bands), float32, or None
    """

    values: np.ndarray
    flags: np.ndarray
    variance: np.ndarray | None


@dataclass(frozen=True)
class Lattice:
    """A map evaluated every `step` px, one node beyond each border; cubic in between.

    Parameters
    ----------
    nodes : ndarray, (rows, columns, 2), float64, source px
    step : int
    """

    nodes: np.ndarray
    step: int

    @classmethod
    def of(cls, transform: Transform, shape: tuple[int, int]) -> Lattice:
        """Evaluate a map so densely that cubic interpolation errs by less than 1e-4 px.

        Checked on points between the nodes; the lattice is made finer until it holds.
        """
        step = LATTICE_PX
        while True:
            lattice = cls(_nodes(transform, shape, step), step)
            if step == 1 or lattice.error(transform, shape) < LARGEST_MAP_ERROR_PX:
                return lattice
            step //= 2

    @property
    def wide(self) -> bool:
        """Whether the grid is coarser than the source somewhere."""
        along = np.diff(self.nodes, axis=1)[:-1] / self.step
        down = np.diff(self.nodes, axis=0)[:, :-1] / self.step
        scale = np.hypot(along, down)
        return bool(scale[np.isfinite(scale)].max(initial=0.0) >= WIDE_FROM)

    def error(self, transform: Transform, shape: tuple[int, int]) -> float:
        """Largest distance, source px, of the interpolated map from the exact one on probes."""
        from levkas.plane_kernels import interpolate_map

        k = np.arange(PROBES)
        points = np.stack(
            [(k * 0.7548776662) % 1 * (shape[1] - 1), (k * 0.5698402910) % 1 * (shape[0] - 1)], 1
        )
        exact, near = transform(points), interpolate_map(self.nodes, self.step, points)
        known = np.isfinite(exact).all(1)
        return float(np.abs(exact - near)[known].max(initial=0.0))


def _nodes(transform: Transform, shape: tuple[int, int], step: int) -> np.ndarray:
    rows, columns = ((n - 1) // step + 4 for n in shape)
    y, x = np.mgrid[-1 : rows - 1, -1 : columns - 1] * float(step)
    nodes = transform(np.stack([x.ravel(), y.ravel()], 1))
    return np.ascontiguousarray(nodes.reshape(rows, columns, 2))


def warp(
    source: np.ndarray,
    transforms: Transform | Sequence[Transform],
    shape: tuple[int, int],
    *,
    flags: np.ndarray | None = None,
    variance: np.ndarray | None = None,
) -> Warped:
    """Resample every band of `source` on to a grid.

    Parameters
    ----------
    source : ndarray, (h, w, bands), float32 or uint16
    transforms : Transform or sequence of Transform
        Grid px → source px; one for all bands, or one a band.
    shape : (height, width) of the grid
    flags : ndarray like `source`, uint8, optional
        Bits of `cube.Flag`. The pixel nearest keeps its bits; one that has a share in the value
        adds its bits and NEAR.
    variance : ndarray like `source`, float32, optional
        Out comes Σ w² u².

    Returns
    -------
    warped : Warped
        OUTSIDE and NaN where the map leaves the source's pixels (−0.5 … size − 0.5).
    """
    from levkas.plane_kernels import resample_plane

    height, width = shape
    count = source.shape[2]
    each = list(transforms) if isinstance(transforms, Sequence) else [transforms] * count
    if len(each) != count:
        raise ValueError(f"{count} bands and {len(each)} maps")
    values, out_flags = (
        np.empty((height, width, count), np.float32),
        np.empty((height, width, count), np.uint8),
    )
    spread = None if variance is None else np.empty((height, width, count), np.float32)
    nothing, no_flags = np.zeros((1, 1), np.float32), np.zeros((1, 1), np.uint8)
    lattice: Lattice | None = None
    for b, transform in enumerate(each):
        if lattice is None or transform is not each[b - 1]:
            lattice = Lattice.of(transform, shape)
        plane = resample_plane(
            np.ascontiguousarray(source[..., b], np.float32),
            no_flags if flags is None else np.ascontiguousarray(flags[..., b]),
            nothing if variance is None else np.ascontiguousarray(variance[..., b]),
            lattice.nodes,
            lattice.step,
            height,
            width,
            lattice.wide,
        )
        values[..., b], out_flags[..., b] = plane[0], plane[1]
        if spread is not None:
            spread[..., b] = plane[2]
    return Warped(values, out_flags, spread)
