"""A map between two pixel frames as OME-Zarr states it: an affine map and fields of displacements for both directions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from levkas.geometry.transforms import Affine, Composed, Inverse, Transform

TOLERANCE_PX = 0.01
"""Of the grid: what linear interpolation of a field may be off by before its lattice is made finer."""
STEPS_PX = (64, 32, 16, 8)
"""Of the lattice, px of the grid; a field that jumps, as at a step of depth, stays at the last."""
MOST_NODES = 4_000_000
PROBES = 33
"""A side, of the lattices that find where the two frames show the same."""
AFFINE_PX = 1e-6
"""A map that differs less from its affine part needs no field."""

Size = tuple[float, float]


@dataclass(frozen=True)
class Field:
    """Displacements on a lattice, to be interpolated linearly.

    Parameters
    ----------
    start : (x, y)
        Of the first node, px.
    step : int
        Between neighbours along either axis, px.
    vectors : ndarray, (rows, columns, 2), float32
        (x, y), px; what is added to a point.
    largest_error_px : float
        Found in the middles of the lattice's cells that both frames show.
    """

    start: tuple[float, float]
    step: int
    vectors: np.ndarray
    largest_error_px: float


@dataclass(frozen=True)
class FittedMap:
    """A map of grid px to native px, ``affine(p + onto_native(p))``, and back, ``q + onto_grid(q)`` with q = affine⁻¹(native).

    Both fields are None where the map is affine; both displace px of the grid.
    """

    affine: Affine
    onto_native: Field | None
    onto_grid: Field | None


def fit_map(to_native: Transform, grid_size: Size, native_size: Size) -> FittedMap | None:
    """Return a map as an affine one with two fields; None where the frames have nothing in common.

    Parameters
    ----------
    to_native : Transform
        Grid px → native px.
    grid_size, native_size : (width, height), px

    Examples
    --------
    >>> fitted = fit_map(Affine.scaling(0.5), (100, 80), (50, 40))
    >>> (fitted.affine.matrix.round(6) + 0.0).tolist(), fitted.onto_grid is None
    ([[0.5, 0.0, -0.25], [0.0, 0.5, -0.25]], True)
    """
    grid, native = _pairs(to_native, grid_size, native_size)
    if len(grid) < 3 or np.linalg.matrix_rank(grid - grid.mean(0), tol=1e-6) < 2:
        return None
    affine = Affine.fit(grid, native)
    rectified = affine.inverse(native)
    if np.abs(rectified - grid).max() <= AFFINE_PX:
        return FittedMap(affine, None, None)
    onto_native = Composed(to_native, Inverse(affine))
    pad = max(grid_size) / (PROBES - 1)
    boxes = [(p.min(0) - pad, p.max(0) + pad) for p in (grid, rectified)]
    fields = [
        _sample(shift, box, affine, grid_size, native_size, is_inverse=is_inverse)
        for shift, box, is_inverse in (
            (onto_native, boxes[0], False),
            (Inverse(onto_native), boxes[1], True),
        )
    ]
    return FittedMap(affine, *fields)


def _pairs(to_native: Transform, grid_size: Size, native_size: Size) -> tuple[np.ndarray, ...]:
    """Return points that both frames show, (n, 2) px of either, from a lattice over each."""
    of_grid, of_native = (lattice(size) for size in (grid_size, native_size))
    with np.errstate(all="ignore"):
        grid = np.concatenate([of_grid, to_native.inverse(of_native)])
        native = np.concatenate([to_native(of_grid), of_native])
    both = _inside(grid, grid_size) & _inside(native, native_size)
    return grid[both], native[both]


def lattice(size: Size) -> np.ndarray:
    """Return even points over a frame, its outer edges among them, (n, 2) px."""
    axes = (np.linspace(-0.5, side - 0.5, PROBES) for side in size)
    return np.stack(np.meshgrid(*axes), -1).reshape(-1, 2)


def _inside(points: np.ndarray, size: Size) -> np.ndarray:
    with np.errstate(invalid="ignore"):
        return np.all((points >= -0.5 - 1e-6) & (points <= np.array(size) - 0.5 + 1e-6), axis=1)


def _sample(
    shift: Transform,
    box: tuple[np.ndarray, np.ndarray],
    affine: Affine,
    grid_size: Size,
    native_size: Size,
    *,
    is_inverse: bool,
) -> Field:
    """Sample a map as displacements, on a lattice as coarse as the tolerance allows."""
    low, high = np.floor(box[0]), np.ceil(box[1])
    for step in STEPS_PX:
        count = np.ceil((high - low) / step).astype(int) + 1
        if step != STEPS_PX[0] and count.prod() > MOST_NODES:
            break
        axes = [low[i] + step * np.arange(count[i]) for i in range(2)]
        vectors = _fill(_displace(shift, *axes))
        middles = [axis[:-1] + step / 2 for axis in axes]
        true = _displace(shift, *middles)
        parts = (vectors[a, b] for a in (_FIRST, _LAST) for b in (_FIRST, _LAST))
        error = np.abs(sum(parts) / 4 - true).max(-1)
        places = np.stack(np.meshgrid(*middles), -1)
        ends = (places + true).reshape(-1, 2), places.reshape(-1, 2)
        grid, rectified = ends if is_inverse else ends[::-1]
        both = _inside(grid, grid_size) & _inside(affine(rectified), native_size)
        worst = float(error.reshape(-1)[both].max(initial=0.0))
        field = Field((low[0], low[1]), step, vectors.astype(np.float32), worst)
        if worst <= TOLERANCE_PX:
            break
    return field


_FIRST, _LAST = slice(None, -1), slice(1, None)


def _displace(shift: Transform, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Return the displacements at the nodes of two axes, (rows, columns, 2)."""
    nodes = np.stack(np.meshgrid(x, y), -1)
    with np.errstate(all="ignore"):
        return np.asarray(shift(nodes.reshape(-1, 2))).reshape(nodes.shape) - nodes


def _fill(vectors: np.ndarray) -> np.ndarray:
    """Give nodes where the map has no answer, outside what both frames show, the nearest one's."""
    lost = ~np.isfinite(vectors).all(-1)
    if not lost.any():
        return vectors
    from scipy.ndimage import distance_transform_edt

    nearest = distance_transform_edt(lost, return_distances=False, return_indices=True)
    return np.asarray(vectors[tuple(nearest)])
