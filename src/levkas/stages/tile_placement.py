"""Tiles of the reference camera placed beside one another, from where a stage put them or from what they show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from levkas.campaign.discovery.tiles import place_in_grid, read_positions
from levkas.core.problems import Problem
from levkas.geometry.transforms import Affine, Composed, Inverse
from levkas.registration import Registration, RegistrationRefused, register
from levkas.registration.record import Sigma, Verdict
from levkas.registration.tiles import TilePlacement, place_tiles
from levkas.stages.tiles import FoundTile, left_out

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.geometry.transforms import Transform
    from levkas.registration import BandImage
    from levkas.registration.manual_points import ManualPoints
    from levkas.stages.parts import CalibratedCapture

Point = tuple[float, float]
SCALE_PAIRS, LEAST_SCALE_PAIRS = 8, 3
"""Pairs of neighbours that are tried, and that suffice, to learn how far the stage's unit is in pixels."""
FEW_TILES = 6
"""Up to so many tiles all pairs are compared: names and positions, which may be wrong, are not needed."""
BY_POSITION = "Set pairs beside a neighbour in `levkas inspect CAMPAIGN`, or capture this tile with more overlap."
RIGID = ("pattern", "sensors", "file")
"""Cameras whose bands are captured at once: they lie alike in all tiles."""


def place_reference(
    capture: Capture,
    native: CalibratedCapture,
    band: str,
    campaign: Campaign,
    by_hand: Mapping[tuple[str, str], ManualPoints],
) -> tuple[dict[str, FoundTile], TilePlacement]:
    """Place the tiles of the reference camera beside one another; `by_hand` are pairs of a neighbour and a tile.

    Raises RegistrationRefused where no two tiles overlap.
    """
    tiles = _Pictures(native, [tile.tile for tile in capture.tiles], band)
    stage = places_of_stage(capture, campaign)
    starts = _starts(tiles, stage) if len(tiles) > FEW_TILES else None
    placement = place_tiles(tiles, starts=starts, by_hand=by_hand)
    if placement.left_out and not starts and campaign.cameras[capture.camera].positions:
        # Of few tiles too they say where one lies that shows no detail.
        known = _starts(tiles, stage)
        other = place_tiles(tiles, starts=known, by_hand=by_hand) if known else placement
        placement = other if len(other.left_out) < len(placement.left_out) else placement
    if starts and placement.left_out:  # names or positions may be wrong
        other = place_tiles(tiles, by_hand=by_hand)
        placement = other if len(other.left_out) < len(placement.left_out) else placement
    rigid = campaign.cameras[capture.camera].traits.bands_in in RIGID
    own = _own_bands(native, band, list(placement.transforms), rigid=rigid)
    found = {}
    for name in tiles:
        size = tiles.sizes[name]
        if name not in placement.transforms:
            found[name] = left_out(placement.left_out.get(name, "not placed"), size)
            continue
        onto, sigma = Inverse(placement.transforms[name]), placement.sigma[name]
        verdict = Verdict("accept")
        count = sum(len(given.fixed) for pair, given in by_hand.items() if pair[1] == name)
        if name in placement.by_position:
            verdict = Verdict("warn", (placement.by_position[name],), BY_POSITION)
        maps = {label: Composed(onto, one) for label, one in own[name].items()}
        flat = _even(sigma, placement.size)
        found[name] = FoundTile(
            verdict, size, maps, dict.fromkeys(maps, flat), sigma, pairs_by_hand=count
        )
    return found, placement


class _Pictures(Mapping[str, "BandImage"]):
    """The pictures of tiles in one band, read whenever they are needed."""

    def __init__(self, native: CalibratedCapture, names: Sequence[str], band: str) -> None:
        self._native, self._names, self._band = native, names, band
        self.sizes = {name: native.tile(name).size_of(band) for name in names}

    def __getitem__(self, name: str) -> BandImage:
        images = self._native.tile(name).images()
        return next(image for image in images if image.label == self._band)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _even(sigma: float, size: tuple[int, int]) -> Sigma:
    x, y = (np.array([0.0, side - 1.0]) for side in size)
    return Sigma(x, y, np.full((2, 2), sigma))


def _own_bands(
    native: CalibratedCapture, band: str, tiles: Sequence[str], *, rigid: bool
) -> dict[str, dict[str, Transform]]:
    """Return for every tile px of the reference band → px of each band.

    Of a `rigid` camera, which captures all bands at once, the tile with most detail serves all of them.
    """
    labels = [one.label for one in native.bands]
    if len(labels) == 1:
        return {name: {band: Affine.identity()} for name in tiles}
    found: dict[str, dict[str, Transform]] = {}
    best: tuple[float, str] = (np.inf, "")
    detail = {name: detail_of(native.tile(name).images(), band) for name in tiles}
    for name in sorted(tiles, key=lambda n: (-detail[n], n)):
        one = _own(native, name, band)
        if one is None:
            continue
        found[name] = one.transforms
        best = min(best, (-detail[name], name))
        if rigid:
            break
    if not found:
        raise RegistrationRefused(
            Problem(
                "E_TILES",
                "the bands of the reference camera cannot be registered to one another in any tile",
                field="tiles",
                expected="a tile with detail",
                fix="Capture the tiles with the object in focus.",
            )
        )
    return {name: found.get(name, found[best[1]]) for name in tiles}


def _own(native: CalibratedCapture, name: str, band: str) -> Registration | None:
    whole = native.tile(name)
    images = whole.images()
    align = {s: Affine(np.array(a, float)) for s, a in native.aligns.items() if a != "measure"}
    try:
        found = register(images, images, reference_band=band, align=align)
    except RegistrationRefused:
        return None
    return None if found.verdict.decision == "refuse" else found


def detail_of(images: Sequence[BandImage], band: str) -> float:
    """Return the spread of differences of neighbours in a band, in the unit of the values."""
    image = next(one for one in images if one.label == band)
    known = image.valid[:, 1:] & image.valid[:, :-1]
    steps = np.diff(image.values, axis=1)[known]
    return float(np.std(steps, dtype=np.float64)) if steps.size else 0.0


# --- where a stage put tiles


def places_of_stage(capture: Capture, campaign: Campaign) -> dict[str, Point]:
    """Return where tiles are, by the declared positions, else by rows and columns in their names; nothing where neither says."""
    names = [tile.tile for tile in capture.tiles]
    declared = campaign.cameras[capture.camera].positions
    if declared:
        known = read_positions(campaign.root / declared)
        return {name: known[name] for name in names if name in known}
    places = {name: place_in_grid(name) for name in names}
    return {name: place for name, place in places.items() if place is not None}


def _starts(tiles: _Pictures, stage: Mapping[str, Point]) -> dict[str, Point] | None:
    """Return about where the first px of tiles lie, px; None where too few pairs show how far the stage's unit is."""
    if len(stage) < len(tiles):
        return None
    pairs = sorted(
        combinations(sorted(stage), 2), key=lambda pair: (stage_distance(stage, pair), pair)
    )
    moved: list[np.ndarray] = []
    steps: list[np.ndarray] = []
    for one, other in pairs[: 4 * SCALE_PAIRS]:
        step = np.subtract(stage[other], stage[one])
        alike = [s for s in steps if abs(s @ step) > 0.7 * hypot(*s) * hypot(*step)]
        if len(alike) >= LEAST_SCALE_PAIRS or not step.any():
            continue
        try:
            placed = place_tiles({name: tiles[name] for name in (one, other)}, lens=False)
        except RegistrationRefused:
            continue
        if len(placed.transforms) == 2:
            corners = [placed.transforms[name](np.zeros((1, 2)))[0] for name in (one, other)]
            moved.append(corners[1] - corners[0])
            steps.append(step)
        if len(steps) >= 2 * LEAST_SCALE_PAIRS:
            break
    linear = _linear(np.array(steps), np.array(moved))
    if linear is None:
        return None
    first = np.array([stage[name] for name in sorted(stage)]).min(0)
    return {
        name: (float(p[0]), float(p[1]))
        for name, place in stage.items()
        for p in [linear @ np.subtract(place, first)]
    }


def stage_distance(stage: Mapping[str, Point], pair: tuple[str, str]) -> float:
    """Return how far apart a stage put two tiles, in its unit."""
    return hypot(*np.subtract(stage[pair[1]], stage[pair[0]]))


def _linear(steps: np.ndarray, moved: np.ndarray) -> np.ndarray | None:
    """Return the matrix, (2, 2), from steps of a stage to px: a median of all where they lie in two directions, else a similarity."""
    if not len(steps):
        return None
    if np.linalg.matrix_rank(steps, tol=0.1 * np.abs(steps).max()) == 2:
        solved = np.linalg.lstsq(steps, moved, rcond=None)[0].T
        return np.asarray(solved)
    z, w = (part @ (1, 1j) for part in (steps, moved))
    ratio = w / z
    turn = complex(np.median(ratio.real), np.median(ratio.imag))
    return np.array([[turn.real, -turn.imag], [turn.imag, turn.real]])
