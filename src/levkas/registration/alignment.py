"""Alignments of the sensors of one camera that are declared: first sensor's px → each sensor's px."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import Affine, Composed, Inverse, Transform
from levkas.registration.record import refusal

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


def read_alignments(given: Mapping[str, Any]) -> dict[str, Transform]:
    """Return declared alignments as maps; raises RegistrationRefused where a matrix is not (2, 3)."""
    return {name: _transform(name, matrix) for name, matrix in given.items()}


def declared_map(
    name: str, align: Mapping[str, Transform], known: Mapping[str, Transform]
) -> Transform | None:
    """Return reference px → px of a sensor by its declared alignment to one whose map is known; None without any.

    `align` are maps from the first sensor's px, `known` from reference px.

    Examples
    --------
    >>> align = {"ccd1": Affine.identity(), "ccd2": Affine(np.array([[1.0, 0, 5], [0, 1, 0]]))}
    >>> found = declared_map("ccd2", align, {"ccd1": Affine.scaling(2.0)})
    >>> found(np.array([[10.0, 20.0]])).tolist()
    [[25.5, 40.5]]
    """
    for other, transform in known.items():
        if other != name and other in align and name in align:
            return Composed(transform, Inverse(align[other]), align[name])
    return None


def distance_between(one: Transform, other: Transform, shape: Sequence[int]) -> float:
    """Return how far two maps lie apart, px of their target, the median over a frame (height, width)."""
    x, y = np.meshgrid(*(np.linspace(0, n - 1, 9) for n in shape[::-1]))
    points = np.stack([x, y], -1).reshape(-1, 2)
    miss = np.linalg.norm(one(points) - other(points), axis=1)
    return float(np.median(np.nan_to_num(miss, nan=np.inf)))


def _transform(name: str, given: Any) -> Transform:
    if isinstance(given, Transform):
        return given
    matrix = np.asarray(given, float)
    if matrix.shape != (2, 3) or not np.isfinite(matrix).all():
        raise refusal(
            "E_VALUE",
            f"the alignment of sensor {name!r} is not a matrix of numbers",
            field="align",
            found=str(matrix.shape),
            expected="2 rows of 3 numbers: px of the first sensor → px of this one",
        )
    return Affine(matrix)
