"""Where every tile of a painting lies, and the record of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from levkas.geometry import from_dict
from levkas.geometry.transforms import Lens, Transform


@dataclass(frozen=True)
class TilePlacement:
    """Where every tile of a painting lies.

    Parameters
    ----------
    transforms : dict of name to Transform
        Px of a tile → mosaic px.
    size : (width, height), mosaic px
        Of the box about all tiles.
    sigma : dict of name to float, mosaic px
        Standard uncertainty of a tile's px along an axis, the root mean square over the tile, in the frame of the whole mosaic.
    left_out : dict of name to str
        Why a tile is not placed.
    overlaps : list of dict
        Of every pair of tiles that was used or refused: `tiles`, `windows`, `rms` and `sigma` (px), `held_out` (px), `off` (px after the
        adjustment, of all windows), `misfit` (px along an axis, of windows beside one another), `used`, `reason`.
    lens : Lens or None
        Which all tiles share: px put right → px.
    rms : float, px
        Of all windows after the adjustment, along an axis.
    errors : dict of str to float, px
        In windows left out, of plain homographies (``"none"``) and with a lens.
    by_position : dict of name to str
        Tiles that no overlap holds and that lie where their position says; why.
    by_hand : dict of name to int
        Tiles that only pairs by hand hold, which no picture confirms; how many pairs.
    """

    transforms: dict[str, Transform]
    size: tuple[int, int]
    sigma: dict[str, float]
    left_out: dict[str, str]
    overlaps: list[dict[str, Any]]
    lens: Lens | None
    rms: float
    errors: dict[str, float]
    by_position: dict[str, str] = field(default_factory=dict)
    by_hand: dict[str, int] = field(default_factory=dict)

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "kind": "tiles",
            "transforms": {name: one.to_dict() for name, one in self.transforms.items()},
            "size": list(self.size),
            "sigma": self.sigma,
            "left_out": self.left_out,
            "by_position": self.by_position,
            "by_hand": self.by_hand,
            "overlaps": self.overlaps,
            "lens": self.lens and self.lens.to_dict(),
            "rms": self.rms,
            "errors": self.errors,
        }

    @classmethod
    def from_dict(cls, record: Mapping[str, Any]) -> TilePlacement:
        """Read what `to_dict` wrote."""
        lens = from_dict(record["lens"]) if record["lens"] else None
        assert lens is None or isinstance(lens, Lens)
        transforms = {name: from_dict(one) for name, one in record["transforms"].items()}
        width, height = record["size"]
        rest = {
            key: record[key]
            for key in (
                "sigma", "left_out", "overlaps", "rms", "errors", "by_position", "by_hand",
            )
        }  # fmt: skip
        return cls(transforms=transforms, size=(width, height), lens=lens, **rest)
