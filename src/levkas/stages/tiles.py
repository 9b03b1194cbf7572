"""A capture of tiles: what registration sees of the mosaic, tiles as they were registered, and the record of the layer that they make."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil, sqrt
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.problems import Problem
from levkas.geometry.transforms import Affine
from levkas.registration.advice import LOOK
from levkas.registration.methods import DEFAULT_METHOD
from levkas.registration.record import Matches, RegistrationRefused, Sigma, Verdict
from levkas.stages.parts import CalibratedCapture, PartPlace, Placement

if TYPE_CHECKING:
    from levkas.campaign.discovery.captures import Capture
    from levkas.geometry.joining import Box
    from levkas.geometry.transforms import Transform
    from levkas.registration import BandImage

LATTICE = 25
"""Places a side at which the uncertainty of a mosaic is recorded."""
MOST_SAMPLES = 100_000_000
"""Of the pictures of a mosaic as registration takes them, half a gigabyte; of a larger one there are fewer bands."""


def coarseness(width: int, height: int) -> int:
    """Return how many px a side make one of a picture that can be held whole."""
    return ceil(sqrt(width * height / MOST_SAMPLES))


def view_of_mosaic(
    native: CalibratedCapture, capture: Capture, anchor: str, box: Box | None = None, step: int = 1
) -> list[BandImage]:
    """Return the bands of placed tiles as registration takes them; of many px some of them, `anchor` among them.

    `box` is the part of the mosaic, px, default all; `step` how many px of it make one of the picture, along a side.

    Raises RegistrationRefused, ``E_SIZE``, where even one band is more than `MOST_SAMPLES`.
    """
    size, labels = native.size_of(anchor), [band.label for band in native.bands]
    left, top, right, bottom = box or (0, 0, *size)
    width, height = (right - left) // step, (bottom - top) // step
    most = min(MOST_SAMPLES // (width * height), len(labels))
    if not most:
        raise RegistrationRefused(
            Problem(
                "E_SIZE",
                "the mosaic of the reference camera is too large to register a single frame to it",
                field=f"cameras.{capture.camera}",
                found=f"{size[0]} x {size[1]} px",
                expected=f"at most {MOST_SAMPLES / 1e6:g} million px",
                fix="Declare the single frame as the only tile of its camera, by {tile} in its pattern, or bin the frames of the mosaic.",
            )
        )
    numbers = {*np.linspace(0, len(labels) - 1, most).round().astype(int)}
    first = labels.index(anchor)
    if first not in numbers:
        numbers = {*sorted(numbers, key=lambda n: abs(n - first))[1:], first}
    chosen = [labels[number] for number in sorted(numbers)]
    return native.view(Affine.of_box(left, top, step), (width, height), chosen)


@dataclass(frozen=True, eq=False)
class FoundTile:
    """A tile as it was registered: maps of its bands, reference px → native px, or why there are none."""

    verdict: Verdict
    size: tuple[int, int]
    maps: Mapping[str, Transform]
    sigma: Mapping[str, Sigma]
    sigma_px: float = 0.0
    errors: Mapping[str, Any] | None = None
    matches: Mapping[str, Matches] = field(default_factory=dict)
    pairs_by_hand: int = 0

    @property
    def is_placed(self) -> bool:
        """Whether it can be resampled."""
        return self.verdict.decision != "refuse"

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record; without maps of a tile that is left out."""
        record: dict[str, Any] = {"verdict": self.verdict.to_dict(), "size": list(self.size)}
        if self.is_placed:
            record["sigma_px"] = self.sigma_px
            record["bands"] = {
                label: {"size": list(self.size), "transform": one.to_dict()}
                | ({"sigma": self.sigma[label].to_dict()} if label in self.sigma else {})
                for label, one in self.maps.items()
            }
        if self.errors:
            record["errors"] = dict(self.errors)
        if self.pairs_by_hand:
            record["pairs_by_hand"] = self.pairs_by_hand
        return record


def left_out(reason: str, size: tuple[int, int]) -> FoundTile:
    """Return a tile that is left out, with the reason."""
    return FoundTile(Verdict("refuse", (reason,)), size, {}, {})


def verdict_of(found: Mapping[str, FoundTile]) -> Verdict:
    """Return the verdict of a layer: refused where no tile is placed, doubtful where some are left out or doubtful."""
    lost = {name: one for name, one in found.items() if not one.is_placed}
    reasons = [
        f"Tile {name} is left out, and is a hole in the layer: {' '.join(one.verdict.reasons)}"
        for name, one in lost.items()
    ]
    reasons += [
        f"Tile {name}: {' '.join(one.verdict.reasons)}"
        for name, one in found.items()
        if name not in lost and one.verdict.decision in ("warn", "by hand")
    ]
    placed = len(found) - len(lost)
    numbers = {"tiles": len(found), "placed": placed}
    if not placed:
        return Verdict("refuse", tuple(reasons), "Correct the frames of the tiles.", numbers)
    if reasons:
        step = "Capture these tiles again, or use the layer without them." if lost else LOOK
        return Verdict("warn", tuple(reasons), step, numbers)
    return Verdict("accept", (f"All {placed} tiles are placed.",), "", numbers)


def results_of(
    found: Mapping[str, FoundTile], native: CalibratedCapture, size: tuple[int, int]
) -> dict[str, Any]:
    """Return the part of a layer's record that holds maps, verdict and evidence; its bands are those of the joined frame."""
    verdict = verdict_of(found)
    worst: dict[str, Any] = {}
    for name, one in found.items():
        for sensor, numbers in ((one.errors or {}).get("sensors") or {}).items():
            before = (worst.get(sensor) or {}).get("held_out_px") or -1.0
            if numbers and (numbers.get("held_out_px") or 0.0) > before:
                # A start that follows from other tiles is no pair of another program.
                kept = {key: value for key, value in numbers.items() if key != "start_pairs"}
                worst[sensor] = kept | {"tile": name}
    sigma = sigma_of_mosaic(found, size).to_dict()
    frame = {"size": list(size), "transform": Affine.identity().to_dict(), "sigma": sigma}
    bands = {band.label: frame for band in native.bands}
    by_hand = sum(one.pairs_by_hand for one in found.values() if one.is_placed)
    return {
        "method": DEFAULT_METHOD,
        "verdict": verdict.to_dict(),
        "model": {"kind": "tiles", "tiles": len(found)},
        "errors": {"sensors": worst} if worst else {},
        "trace": {},
        "bands": bands if verdict.decision != "refuse" else {},
        "tiles": {name: one.to_dict() for name, one in found.items()},
        **({"pairs_by_hand": by_hand} if by_hand else {}),
    }


def sigma_of_mosaic(found: Mapping[str, FoundTile], size: tuple[int, int]) -> Sigma:
    """Return how well the pixels of a mosaic are placed: at each, the tile in whose frame it lies deepest; beyond all of them the worst."""
    x, y = (np.linspace(0, side - 1, LATTICE) for side in size)
    points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    deepest, values = np.zeros(len(points)), np.zeros(len(points))
    for one in found.values():
        if not one.is_placed:
            continue
        label, onto = next(iter(one.maps.items()))
        places = onto(points)
        depth = np.min([places + 0.5, np.array(one.size) - 0.5 - places], axis=(0, 2))
        here = np.nan_to_num(depth, nan=-1.0) > deepest
        sigma = one.sigma[label](points[here]) if label in one.sigma else one.sigma_px
        deepest[here], values[here] = depth[here], sigma
    values[deepest <= 0] = values.max(initial=0.0)
    return Sigma(x, y, values.reshape(LATTICE, LATTICE))


def placement_of(found: Mapping[str, FoundTile], size: tuple[int, int]) -> Placement:
    """Return where the tiles lie that are placed."""
    return Placement(
        {name: PartPlace(one.maps, one.sigma_px) for name, one in found.items() if one.is_placed},
        size,
    )
