"""The radiometry of an object's page: its layers' rows, and close-ups under all setups."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from levkas.building.fingerprints import keys_of
from levkas.pages.page import CloseUpRow, CloseUps, embed_png
from levkas.pages.radiometry import RadiometryRow, describe_layer
from levkas.quality.targets.places import choose_places

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from levkas.building.ledger import Ledger
    from levkas.campaign.discovery.captures import Capture
    from levkas.database.layout import Places


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


def _read(path: Path) -> np.ndarray:
    from PIL import Image

    with Image.open(path) as picture:
        return np.asarray(picture.convert("RGB"))


def _cut(picture: np.ndarray, x: int, y: int, side: int) -> str:
    from levkas.database.preview import encode_png

    return embed_png(encode_png(np.ascontiguousarray(picture[y : y + side, x : x + side])))
