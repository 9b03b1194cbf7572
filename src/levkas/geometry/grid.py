"""The published grid: the reference frame mirrored, turned, cropped and scaled, as one map."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil, cos, radians, sin

import numpy as np

from levkas.core.problems import Problem, Refused
from levkas.geometry.transforms import Affine

QUARTERS: dict[float, tuple[float, float]] = {
    0: (1.0, 0.0),
    90: (0.0, 1.0),
    180: (-1.0, 0.0),
    270: (0.0, -1.0),
}
MOST_FRAMES = 4
"""Of the turned frame a side, that a region may be; more is nothing but margin, and memory for it."""


class GridRefused(Refused):
    """A grid that shows nothing of the reference."""


@dataclass(frozen=True, init=False, eq=False)
class Grid:
    """Pixel grid of an object, and the map from it to the reference band's native pixels.

    `size`, (width, height), is that of the reference frame, native px; as an attribute that of the grid. `mirror` flips x,
    first of all; `rotate` is degrees clockwise as seen, next: multiples of 90 map whole pixels to whole pixels. `region`,
    (x, y, width, height), px of the turned frame at native scale from the top left of its bounding box, may reach beyond
    it; by default it is the whole box, rounded up. `output`, (width, height) of the grid, px, is by default the region's,
    rounded; scales along x and y are output / region, each on its own.

    `transform` goes grid px → reference px; `turned` px of the turned frame, before cropping and scaling, → reference px.

    Refused where a side is not positive, or the region lies outside the turned frame.

    A frame 4 wide and 3 high, turned by 90 degrees: its bottom left pixel comes to the top left.

    >>> grid = Grid((4, 3), rotate=90)
    >>> grid.size, grid.transform(np.array([[0.0, 0], [2, 0], [2, 3]])).tolist()
    ((3, 4), [[0.0, 2.0], [0.0, 0.0], [3.0, 0.0]])
    """

    transform: Affine
    turned: Affine
    size: tuple[int, int]
    region: tuple[float, float, float, float]
    bounds: tuple[float, float] = field(repr=False)

    def __init__(
        self,
        size: tuple[int, int],
        *,
        mirror: bool = False,
        rotate: float = 0.0,
        region: tuple[float, float, float, float] | None = None,
        output: tuple[int, int] | None = None,
    ) -> None:
        _check_sides("size", size)
        forward, bounds = _turn(size, mirror, rotate)
        back = np.linalg.inv(forward)
        if not rotate % 90:  # a map of whole pixels, without rounding
            back[:2, :2] = forward[:2, :2].T
            back[:2, 2] = -forward[:2, :2].T @ forward[:2, 2] + 0.0
        whole = (0.0, 0.0, *(float(ceil(side - 1e-6)) for side in bounds))
        x, y, width, height = whole if region is None else (float(v) for v in region)
        _check_sides("grid.region", (width, height))
        outside = x >= bounds[0] or y >= bounds[1] or x + width <= 0 or y + height <= 0
        if outside or max(width / bounds[0], height / bounds[1]) > MOST_FRAMES:
            code, what = ("E_VALUE", "outside") if outside else ("E_SIZE", "far larger than")
            most = "within" if outside else f"at most {MOST_FRAMES} times"
            message = f"the region of the grid is {what} the turned frame"
            expected = f"{most} {bounds[0]:.6g} x {bounds[1]:.6g} px"
            fix = "Give the region in the frame after mirror and rotate, at native scale."
            found = [x, y, width, height]
            raise GridRefused(Problem(code, message, None, "grid.region", found, expected, fix))
        columns, rows = output or (max(1, round(width)), max(1, round(height)))
        _check_sides("grid.size", (columns, rows))
        step_x, step_y = width / columns, height / rows
        crop = np.diag([step_x, step_y, 1.0])
        crop[:2, 2] = step_x / 2 - 0.5 + x, step_y / 2 - 0.5 + y
        self.__dict__.update(
            transform=Affine((back @ crop)[:2] + 0.0),
            turned=Affine(back[:2]),
            size=(int(columns), int(rows)),
            region=(x, y, width, height),
            bounds=bounds,
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(height, width) of the grid."""
        return self.size[1], self.size[0]


def _turn(
    size: tuple[int, int], mirror: bool, rotate: float
) -> tuple[np.ndarray, tuple[float, float]]:
    """Return the (3, 3) matrix, reference px → turned px, and the sides of the bounding box."""
    width, height = size
    angle = rotate % 360
    c, s = QUARTERS.get(angle) or (cos(radians(angle)), sin(radians(angle)))
    # y points down: a positive angle turns x towards y, which is clockwise as seen.
    turn = np.array([[c, -s], [s, c]])
    corners = np.array([[0, 0], [width, 0], [width, height], [0, height]]) @ turn.T
    low, high = corners.min(0), corners.max(0)
    matrix = np.eye(3)
    matrix[:2, :2] = turn
    matrix[:2, 2] = turn @ (0.5, 0.5) - low - 0.5
    flip = np.array([[-1.0, 0, width - 1], [0, 1, 0], [0, 0, 1]]) if mirror else np.eye(3)
    return matrix @ flip, (float(high[0] - low[0]), float(high[1] - low[1]))


def _check_sides(name: str, sides: tuple[float, float]) -> None:
    if not all(np.isfinite(side) and side > 0 for side in sides):
        what, expected = "a frame needs positive sides", "[width, height] above 0"
        raise GridRefused(
            Problem("E_VALUE", what, field=name, found=list(sides), expected=expected)
        )
