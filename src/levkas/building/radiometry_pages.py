"""The radiometry of an object's page: its layers' rows, and close-ups under all setups."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.building.fingerprints import keys_of
from levkas.reporting.page import CloseUpRow, CloseUps, embed_png
from levkas.reporting.radiometry import RadiometryRow, describe_layer

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from levkas.building.ledger import Ledger
    from levkas.building.places import Places
    from levkas.discovery import Capture

SIDE = 160
"""Of a close-up, px, at most a third of the shorter side of the picture."""
PLACES = 4


def radiometry_rows(ledger: Ledger, captures: Sequence[Capture]) -> list[RadiometryRow]:
    """Return the rows of the layers that were built."""
    rows = []
    for capture in captures:
        keys = keys_of(capture)
        row = describe_layer(
            capture.layer, ledger.told(keys["calibrate"]), ledger.told(keys["resample"])
        )
        if row is not None:
            rows.append(row)
    return rows


def close_ups(places: Places, captures: Sequence[Capture]) -> list[CloseUps]:
    """Return close-ups of every camera that has several setups, as the paper's Figure 4."""
    groups = []
    for camera in dict.fromkeys(c.camera for c in captures):
        mine = [c for c in captures if c.camera == camera]
        paths = [places.layer(c.object, c.camera, c.setup, kind=".png") for c in mine]
        shown = [(c, _read(path)) for c, path in zip(mine, paths, strict=True) if path.is_file()]
        if len(shown) < 2 or len({picture.shape for _, picture in shown}) > 1:
            continue
        side, corners = choose_places([picture for _, picture in shown])
        rows = tuple(
            CloseUpRow(
                c.setup or "default setup",
                tuple(_cut(picture, x, y, side) for x, y in corners),
            )
            for c, picture in shown
        )
        names = tuple(f"({x + side // 2}, {y + side // 2})" for x, y in corners)
        groups.append(CloseUps(camera, names, rows))
    return groups


def choose_places(pictures: Sequence[np.ndarray]) -> tuple[int, list[tuple[int, int]]]:
    """Choose places to compare: where pictures differ most, and where they have most detail.

    Parameters
    ----------
    pictures : sequence of ndarray, (h, w, 3), uint8
        Of one size.

    Returns
    -------
    side : int
        Of a close-up, px.
    corners : list of (x, y)
        Their top left pixels; none laps over another.
    """
    stack = np.stack([p.astype(np.float32).mean(2) for p in pictures])
    height, width = stack.shape[1:]
    side = max(8, min(SIDE, height // 3, width // 3))
    apart = np.ptp(stack, axis=0)
    detail = np.abs(np.diff(stack[0], axis=1, append=0)) + np.abs(
        np.diff(stack[0], axis=0, append=0)
    )
    detail[:, -1] = detail[-1] = 0
    corners: list[tuple[int, int]] = []
    for number in range(PLACES):
        x, y = _highest(apart if number < PLACES // 2 else detail, side, corners)
        if x < 0:
            break
        corners.append((x, y))
    return side, corners


def _highest(of: np.ndarray, side: int, taken: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """Top left of the window of the greatest sum that laps over none that is taken."""
    step = max(1, side // 4)
    total = np.pad(of, ((1, 0), (1, 0))).cumsum(0, dtype=np.float64).cumsum(1)
    best, found = -1.0, (-1, -1)
    for y in range(0, of.shape[0] - side + 1, step):
        for x in range(0, of.shape[1] - side + 1, step):
            if any(abs(x - a) < side and abs(y - b) < side for a, b in taken):
                continue
            value = (
                total[y + side, x + side] - total[y, x + side] - total[y + side, x] + total[y, x]
            )
            if value > best:
                best, found = float(value), (x, y)
    return found


def _read(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def _cut(picture: np.ndarray, x: int, y: int, side: int) -> str:
    from levkas.database.preview import encode_png

    return embed_png(encode_png(np.ascontiguousarray(picture[y : y + side, x : x + side])))
