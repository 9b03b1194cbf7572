"""The published grid: the reference mirrored, turned, cropped and scaled, as one affine map."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from levkas.problems import Problem, Refused
from levkas.transforms import Affine


class GridRefused(Refused):
    """A grid that shows nothing of the reference."""


@dataclass(frozen=True)
class Grid:
    """The frame that is published.

    Parameters
    ----------
    reference : (width, height) of the reference band, px
    mirror : bool
        x flips first.
    rotate : float
        Degrees clockwise as seen, after mirroring.
    region : (x, y, width, height), optional
        In the turned frame at native scale, origin at the top left of its bounding box; default
        the whole of it.
    output : (width, height), optional
        Size to scale to; default the region's, rounded. Another aspect stretches.

    Attributes
    ----------
    size : (width, height) of the grid
    transform : Affine
        Grid px → reference px.

    Raises
    ------
    GridRefused
        E_VALUE where the region lies outside the turned frame.

    Examples
    --------
    A quarter turn clockwise brings the bottom left corner to the top left:

    >>> Grid((4, 3), rotate=90).transform(np.array([[0.0, 0.0]])).tolist()
    [[0.0, 2.0]]
    >>> Grid((4, 3), rotate=90).size
    (3, 4)
    """

    reference: tuple[int, int]
    mirror: bool = False
    rotate: float = 0.0
    region: tuple[float, float, float, float] | None = None
    output: tuple[int, int] | None = None
    size: tuple[int, int] = field(init=False)
    transform: Affine = field(init=False, compare=False)

    def __post_init__(self) -> None:
        turn, full = _turned(self.reference, self.mirror, self.rotate)
        x, y, w, h = self.region or (0.0, 0.0, *full)
        if x >= full[0] or y >= full[1] or x + w <= 0 or y + h <= 0 or w <= 0 or h <= 0:
            raise GridRefused(
                Problem(
                    "E_VALUE",
                    "the region lies outside the turned reference frame",
                    field="grid.region",
                    found=[x, y, w, h],
                    expected=f"within {full[0]:g} x {full[1]:g} px",
                )
            )
        size = self.output or (max(1, round(w)), max(1, round(h)))
        scale = np.array([size[0] / w, size[1] / h])
        crop_and_scale = np.array(
            [
                [scale[0], 0, (0.5 - x) * scale[0] - 0.5],
                [0, scale[1], (0.5 - y) * scale[1] - 0.5],
                [0, 0, 1],
            ]
        )
        inverse = np.linalg.inv(crop_and_scale @ turn)[:2]
        # Quarter turns at native scale are whole numbers: what inv leaves of rounding goes.
        whole = np.round(inverse)
        inverse = np.where(np.abs(inverse - whole) < 1e-12 * max(self.reference), whole, inverse)
        object.__setattr__(self, "size", (int(size[0]), int(size[1])))
        object.__setattr__(self, "transform", Affine(inverse))


def _turned(
    size: tuple[int, int], mirror: bool, rotate: float
) -> tuple[np.ndarray, tuple[float, float]]:
    """Return reference px → turned px as a 3x3 matrix, and the size of the turned bounding box."""
    width, height = size
    flip = np.array([[-1.0, 0, width - 1], [0, 1, 0], [0, 0, 1]]) if mirror else np.eye(3)
    quarter = round(rotate / 90)
    if abs(rotate - 90 * quarter) < 1e-12:
        cosine, sine = [(1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0)][quarter % 4]
    else:
        cosine, sine = np.cos(np.deg2rad(rotate)), np.sin(np.deg2rad(rotate))
    # y runs down, so that this matrix turns clockwise as seen.
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
    corners = np.array(
        [[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]]
    )
    placed = corners @ turn[:2, :2].T
    low, high = placed.min(0), placed.max(0)
    turn[:2, 2] = -0.5 - low
    return turn @ flip, (float(high[0] - low[0]), float(high[1] - low[1]))
