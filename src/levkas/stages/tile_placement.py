"""Tiles of the reference camera placed beside one another, from where a stage put them or from what they show."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from levkas.campaign.discovery.tiles import place_in_grid, read_positions
from levkas.geometry.transforms import Affine, Composed, Inverse
from levkas.registration import RegistrationRefused, register
from levkas.registration.record import Sigma, Verdict, refusal
from levkas.registration.tiles import TilePlacement, place_tiles, similarity
from levkas.stages.tiles import FoundTile, left_out

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.geometry.transforms import Transform
    from levkas.registration import BandImage
    from levkas.registration.manual_points import ManualPoints
    from levkas.stages.parts import CalibratedCapture

    Point = tuple[float, float]
    Pairs = Mapping[tuple[str, str], ManualPoints]

MOST_PAIRS, LEAST_STEPS = 32, 3
"""Pairs of neighbours that are tried, and those in each of two directions that suffice, to learn how far the stage's unit is in pixels."""
ALONG = 0.7
"""Cosine of the angle up to which two steps of a stage go in one direction."""
FEW_TILES = 6
"""Up to so many tiles all pairs are compared: names and positions, which may be wrong, are not needed."""
RIGID = ("pattern", "sensors", "file")
"""Cameras whose bands are captured at once: they lie alike in all tiles."""


def place_reference(
    capture: Capture, native: CalibratedCapture, band: str, campaign: Campaign, by_hand: Pairs
) -> tuple[dict[str, FoundTile], TilePlacement]:
    """Place the tiles of the reference camera beside one another; `by_hand` are pairs of a neighbour and a tile.

    Raises RegistrationRefused where no two tiles overlap.
    """
    camera, tiles = campaign.cameras[capture.camera], _Pictures(native, capture, band)
    placement = _placed(tiles, places_of_stage(capture, campaign), by_hand, bool(camera.positions))
    rigid = camera.traits.bands_in in RIGID
    own = _own_bands(native, band, list(placement.transforms), rigid=rigid)
    found = {}
    for name in tiles:
        size = native.tile(name).size_of(band)
        if name not in placement.transforms:
            found[name] = left_out(placement.left_out.get(name, "not placed"), size)
            continue
        onto, sigma, verdict = (
            Inverse(placement.transforms[name]),
            placement.sigma[name],
            Verdict("accept"),
        )
        count = sum(len(given.fixed) for pair, given in by_hand.items() if pair[1] == name)
        if name in placement.by_position:
            step = "Set pairs beside a neighbour in `levkas inspect CAMPAIGN`, or capture this tile with more overlap."
            verdict = Verdict("warn", (placement.by_position[name],), step)
        maps = {label: Composed(onto, one) for label, one in own[name].items()}
        x, y = (np.array([0.0, side - 1.0]) for side in placement.size)
        even = Sigma(x, y, np.full((2, 2), sigma))
        found[name] = FoundTile(
            verdict, size, maps, dict.fromkeys(maps, even), sigma, pairs_by_hand=count
        )
    return found, placement


def _placed(
    tiles: Mapping[str, BandImage], stage: Mapping[str, Point], by_hand: Pairs, declared: bool
) -> TilePlacement:
    """Place tiles with the stage's places and, where some are left out, without: the better of both. Of few tiles, declared places say where one lies that shows no detail."""
    few = len(tiles) <= FEW_TILES
    starts = None if few else _starts(tiles, stage)
    found = place_tiles(tiles, starts=starts, by_hand=by_hand)
    again = _starts(tiles, stage) if few and declared and found.left_out else None
    if found.left_out and (starts or again):
        other = place_tiles(tiles, starts=again, by_hand=by_hand)
        found = other if len(other.left_out) < len(found.left_out) else found
    return found


class _Pictures(Mapping[str, "BandImage"]):
    """The pictures of tiles in one band, read whenever they are needed."""

    def __init__(self, native: CalibratedCapture, capture: Capture, band: str) -> None:
        self._native, self._band = native, band
        self._names = [tile.tile for tile in capture.tiles]

    def __getitem__(self, name: str) -> BandImage:
        images = self._native.tile(name).images()
        return next(image for image in images if image.label == self._band)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _own_bands(
    native: CalibratedCapture, band: str, tiles: Sequence[str], *, rigid: bool
) -> dict[str, dict[str, Transform]]:
    """Return for every tile px of the reference band → px of each band.

    Of a `rigid` camera, which captures all bands at once, the tile with most detail serves all of them.
    """
    if len(native.bands) == 1:
        return {name: {band: Affine.identity()} for name in tiles}
    found: dict[str, dict[str, Transform]] = {}
    detail = {name: detail_of(native.tile(name).images(), band) for name in tiles}
    for name in sorted(tiles, key=lambda n: (-detail[n], n)):
        images = native.tile(name).images()
        try:
            one = register(images, images, reference_band=band, align=aligns_of(native))
        except RegistrationRefused:
            continue
        if one.verdict.decision != "refuse":
            found[name] = one.transforms
            if rigid:
                break
    if not found:
        raise refusal(
            "E_TILES",
            "the bands of the reference camera cannot be registered to one another in any tile",
            field="tiles",
            found="none that is accepted",
            expected="a tile with detail",
            fix="Capture the tiles with the object in focus.",
        )
    best = next(iter(found.values()))
    return {name: found.get(name, best) for name in tiles}


def aligns_of(native: CalibratedCapture) -> dict[str, Affine]:
    """Return native px of the first sensor → each, of those that declare it."""
    declared = {s: a for s, a in native.aligns.items() if a != "measure"}
    return {sensor: Affine(np.array(one, float)) for sensor, one in declared.items()}


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
    known = read_positions(campaign.root / declared) if declared else {}
    places = {name: known.get(name) if declared else place_in_grid(name) for name in names}
    return {name: place for name, place in places.items() if place is not None}


def _starts(tiles: Mapping[str, BandImage], stage: Mapping[str, Point]) -> dict[str, Point] | None:
    """Return about where the first px of tiles lie, px; None where too few pairs show how far the stage's unit is."""
    if len(stage) < len(tiles):
        return None
    apart = {p: np.subtract(stage[p[1]], stage[p[0]]) for p in combinations(sorted(stage), 2)}
    steps: list[np.ndarray] = []
    moved: list[np.ndarray] = []
    for pair, step in sorted(apart.items(), key=lambda it: (float(np.hypot(*it[1])), it[0]))[
        :MOST_PAIRS
    ]:
        alike = [s for s in steps if abs(s @ step) > ALONG * np.hypot(*s) * np.hypot(*step)]
        if len(alike) >= LEAST_STEPS or not step.any():
            continue
        try:
            placed = place_tiles({name: tiles[name] for name in pair}, lens=False)
        except RegistrationRefused:
            continue
        if len(placed.transforms) == 2:
            corners = [placed.transforms[name](np.zeros((1, 2)))[0] for name in pair]
            moved.append(corners[1] - corners[0])
            steps.append(step)
    if not steps:
        return None
    # There and back, so that the middle stays; a similarity where all go in one direction.
    both, there = (np.concatenate([part, np.negative(part)]) for part in (steps, moved))
    onto = similarity(both, there)
    if np.linalg.matrix_rank(steps, tol=0.1 * np.abs(steps).max()) == 2:
        onto = Affine.fit(both, there)
    first = np.array([stage[name] for name in sorted(stage)]).min(0)
    linear = onto.matrix[:, :2]
    found = {name: linear @ np.subtract(place, first) for name, place in stage.items()}
    return {name: (float(x), float(y)) for name, (x, y) in found.items()}
