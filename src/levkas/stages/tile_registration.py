"""Tiles registered: those of the reference camera to one another, those of other cameras each to the reference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from math import hypot
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.campaign.discovery.tiles import place_in_grid, read_positions
from levkas.campaign.methods import DEFAULT_METHOD
from levkas.core.problems import Problem
from levkas.geometry.transforms import Affine, Composed, Inverse
from levkas.registration import Registration, RegistrationRefused, register
from levkas.registration.advice import LEAST_PAIRS, LOOK
from levkas.registration.bands import by_wavelength, present_bands, sqrt_images
from levkas.registration.features import CameraFeatures, GreyImages
from levkas.registration.initial import find_initial_transform
from levkas.registration.manual_points import ManualPoints
from levkas.registration.measured_bands import measured_bands
from levkas.registration.predictors import PreparedReference
from levkas.registration.record import HandMark, Matches, Sigma, Verdict
from levkas.registration.reduced import FACTOR, LEAST_SIDE, reduced
from levkas.registration.tiles import TilePlacement, place_tiles
from levkas.stages.tiles import Placement, TiledCapture, TilePlace

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.geometry.joining import Box
    from levkas.geometry.transforms import Transform
    from levkas.registration import BandImage
    from levkas.stages.reference import ReferenceFrame

Point = tuple[float, float]
Corrections = tuple[Mapping[str, ManualPoints], Mapping[str, float]]
SCALE_PAIRS, LEAST_SCALE_PAIRS = 8, 3
"""Pairs of neighbours that are tried, and that suffice, to learn how far the stage's unit is in pixels."""
FEW_TILES = 6
"""Up to so many tiles all pairs are compared: names and positions, which may be wrong, are not needed."""
AROUND = 0.12
"""Of a tile's side: how much more than where it is expected is cut out of the reference. A stage stops nearer than this."""
ASTRAY = 0.25
"""Of a tile's side: one that lies farther than this from where its neighbours' places put it is not where it was captured."""
OUTLINE = 9
"""Places along each side of a tile by which its outline is known."""
LATTICE = 25
"""Places a side at which the uncertainty of a mosaic is recorded."""
HELD_BY_HAND = "placed by hand; the pictures do not confirm it"
BY_POSITION = "Set pairs beside a neighbour in `levkas inspect CAMPAIGN`, or capture this tile with more overlap."
AROUND_TILE = "the part of the reference about the tile"
OVERLAP_UNKNOWNS = 4
"""Unknowns an axis of the map between two tiles: at its windows, on average, its variance is so many times that of their mean."""
NO_KEY_POINTS = "too few key points match between this tile and the reference"
RIGID = ("pattern", "sensors", "file")
"""Cameras whose bands are captured at once: they lie alike in all tiles."""


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


# --- the reference camera's tiles


def place_reference(
    native: TiledCapture,
    band: str,
    campaign: Campaign,
    by_hand: Mapping[tuple[str, str], ManualPoints],
) -> tuple[dict[str, FoundTile], TilePlacement]:
    """Place the tiles of the reference camera beside one another; `by_hand` are pairs of a neighbour and a tile.

    Returns
    -------
    found : dict of tile to FoundTile
    placement : TilePlacement

    Raises
    ------
    RegistrationRefused
        Where no two tiles overlap.
    """
    tiles = _Pictures(native, band)
    stage = _stage(native, campaign)
    starts = _starts(tiles, stage) if len(tiles) > FEW_TILES else None
    placement = place_tiles(tiles, starts=starts, by_hand=by_hand)
    if placement.left_out and not starts and campaign.cameras[native.capture.camera].positions:
        known = _starts(
            tiles, stage
        )  # of few tiles too they say where one lies that shows no detail
        other = place_tiles(tiles, starts=known, by_hand=by_hand) if known else placement
        placement = other if len(other.left_out) < len(placement.left_out) else placement
    if starts and placement.left_out:  # names or positions may be wrong
        other = place_tiles(tiles, by_hand=by_hand)
        placement = other if len(other.left_out) < len(placement.left_out) else placement
    rigid = campaign.cameras[native.capture.camera].traits.bands_in in RIGID
    own = _own_bands(native, band, list(placement.transforms), rigid=rigid)
    found = {}
    for name in tiles:
        size = tiles.sizes[name]
        if name not in placement.transforms:
            found[name] = _left_out(placement.left_out.get(name, "not placed"), size)
            continue
        onto, sigma = Inverse(placement.transforms[name]), _sigma_beside(placement, name)
        verdict, count = (
            Verdict("accept"),
            sum(len(g.fixed) for p, g in by_hand.items() if p[1] == name),
        )
        if name in placement.by_position:
            verdict = Verdict("warn", (placement.by_position[name],), BY_POSITION)
        if name in placement.by_hand:
            verdict, count = Verdict("by hand", (HELD_BY_HAND,)), placement.by_hand[name]
            sigma = max(sigma, placement.sigma[name])
        maps = {label: Composed(onto, one) for label, one in own[name].items()}
        flat = _even(sigma, placement.size)
        found[name] = FoundTile(
            verdict, size, maps, dict.fromkeys(maps, flat), sigma, pairs_by_hand=count
        )
    return found, placement


class _Pictures(Mapping[str, "BandImage"]):
    """The pictures of tiles in one band, read whenever they are needed."""

    def __init__(self, native: TiledCapture, band: str) -> None:
        self._native, self._band = native, band
        self._names = [part.tile for part in native.capture.tiles]
        self.sizes: dict[str, tuple[int, int]] = {}
        for name in self._names:
            self.sizes[name] = native.size_of_tile(name, band)

    def __getitem__(self, name: str) -> BandImage:
        images = self._native.tile(name).images()
        return next(image for image in images if image.label == self._band)

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)


def _left_out(reason: str, size: tuple[int, int]) -> FoundTile:
    return FoundTile(Verdict("refuse", (reason,)), size, {}, {})


def _sigma_beside(placement: TilePlacement, name: str) -> float:
    """Return how well a tile lies on its neighbours, mosaic px: that of its overlaps, shared by both tiles of each.

    How well its place in the frame of the whole mosaic is known, which may be bent as a whole, is in the record of the placement.
    """
    beside = [
        (OVERLAP_UNKNOWNS * one["sigma"] ** 2 + max(one["off"], one["misfit"]) ** 2) / 2
        for one in placement.overlaps
        if one["used"] and name in one["tiles"]
    ]
    return float(np.sqrt(np.mean(beside))) if beside else placement.sigma[name]


def _even(sigma: float, size: tuple[int, int]) -> Sigma:
    x, y = (np.array([0.0, side - 1.0]) for side in size)
    return Sigma(x, y, np.full((2, 2), sigma))


def _own_bands(
    native: TiledCapture, band: str, tiles: Sequence[str], *, rigid: bool
) -> dict[str, dict[str, Transform]]:
    """Return for every tile px of the reference band → px of each band.

    Of a `rigid` camera, which captures all bands at once, the tile with most detail serves all of them.
    """
    labels = [one.label for one in native.bands]
    if len(labels) == 1:
        return {name: {band: Affine.identity()} for name in tiles}
    found: dict[str, dict[str, Transform]] = {}
    best: tuple[float, str] = (np.inf, "")
    detail = {name: _detail(native.tile(name).images(), band) for name in tiles}
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


def _own(native: TiledCapture, name: str, band: str) -> Registration | None:
    whole = native.tile(name)
    images = whole.images()
    align = {s: Affine(np.array(a, float)) for s, a in native.aligns.items() if a != "measure"}
    try:
        found = register(images, images, reference_band=band, align=align)
    except RegistrationRefused:
        return None
    return None if found.verdict.decision == "refuse" else found


def _detail(images: Sequence[BandImage], band: str) -> float:
    """Return the spread of differences of neighbours in a band, in the unit of the values."""
    image = next(one for one in images if one.label == band)
    known = image.valid[:, 1:] & image.valid[:, :-1]
    steps = np.diff(image.values, axis=1)[known]
    return float(np.std(steps, dtype=np.float64)) if steps.size else 0.0


# --- where a stage put tiles


def _stage(native: TiledCapture, campaign: Campaign) -> dict[str, Point]:
    """Return where tiles are, by the declared positions, else by rows and columns in their names; nothing where neither says."""
    names = [part.tile for part in native.capture.tiles]
    declared = campaign.cameras[native.capture.camera].positions
    if declared:
        known = read_positions(campaign.root / declared)
        return {name: known[name] for name in names if name in known}
    places = {name: place_in_grid(name) for name in names}
    return {name: place for name, place in places.items() if place is not None}


def _starts(tiles: _Pictures, stage: Mapping[str, Point]) -> dict[str, Point] | None:
    """Return about where the first px of tiles lie, px; None where too few pairs show how far the stage's unit is."""
    if len(stage) < len(tiles):
        return None
    pairs = sorted(combinations(sorted(stage), 2), key=lambda pair: (_apart(stage, pair), pair))
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


def _apart(stage: Mapping[str, Point], pair: tuple[str, str]) -> float:
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


# --- tiles of other cameras


class TilesToReference:
    """Registers the tiles of a camera to the reference one after another, each to the part of it that it is expected on.

    Parameters
    ----------
    native : TiledCapture
    frame : ReferenceFrame
    campaign : Campaign
    options : dict
        Of the registration method.
    given : dict of tile to (pairs by hand by sensor, options set by hand)
        Px of the reference and of the tile.
    """

    def __init__(
        self,
        native: TiledCapture,
        frame: ReferenceFrame,
        campaign: Campaign,
        options: Mapping[str, Any],
        given: Mapping[str, Corrections],
    ) -> None:
        self._native, self._frame, self._given = native, frame, given
        self._options = {k: v for k, v in options.items() if k not in ("outline", "layer")}
        self._stage = _stage(native, campaign)
        self._own = frame.registration()
        self._label = native.bands[0].label
        self.found: dict[str, FoundTile] = {}

    def run(self) -> dict[str, FoundTile]:
        """Return every tile as it was found."""
        names = [part.tile for part in self._native.capture.tiles]
        detail = {name: _detail(self._native.pictures(name)[0], self._label) for name in names}
        waiting = sorted(names, key=lambda name: (-detail[name], name))
        again = []
        while waiting:
            name = waiting.pop(0)
            self.found[name] = self._register(name)
            if self._begun_by_hand(name) is not None:
                continue
            if not self.found[name].is_placed and self._predicted(name) is None:
                again.append(name)
        for name in again:  # once others are placed, they say where it is expected
            if self._predicted(name) is not None:
                self.found[name] = self._register(name)
        self._refuse_astray()
        return {name: self.found[name] for name in names}

    def _register(self, name: str) -> FoundTile:
        images, factor = self._native.pictures(name)
        size = self._native.size_of_tile(name, self._label)
        expected = self._begun_by_hand(name) or self._predicted(name)
        expected = expected or self._begin(images, factor)
        if expected is None and min(images[0].size) >= FACTOR * LEAST_SIDE:  # a macro photograph
            images, factor = [reduced(one, FACTOR) for one in images], FACTOR * factor
            expected = self._begin(images, factor)
        if expected is None:
            return _left_out(NO_KEY_POINTS, size)
        box = self._box(expected, size)
        if box is None:
            return _left_out("it lies outside of what the reference shows", size)
        try:
            found = self._once(images, factor, box, expected, self._given.get(name, ({}, {})))
        except RegistrationRefused as refused:
            return _left_out(" ".join(str(p.message) for p in refused.problems), size)
        maps = found.transforms
        middle = self._middle(maps[self._label], size)
        sigma = found.sigma.get(self._label)
        sigma_px = float(sigma(middle[None])[0]) if sigma else 0.0
        # What was judged is the part of the reference that was cut out, which is called a layer where it is one.
        reasons = tuple(text.replace("the layer", AROUND_TILE) for text in found.verdict.reasons)
        verdict = replace(found.verdict, reasons=reasons)
        matches = {"": found.matches, **found.others}
        by_hand = sum(int((m.kept & (m.reason == HandMark.ADDED)).sum()) for m in matches.values())
        return FoundTile(verdict, size, maps, found.sigma, sigma_px, found.errors, matches, by_hand)

    def _begun_by_hand(self, name: str) -> Transform | None:
        """Return where a person's pairs put a tile, reference px → native px; None where there are too few."""
        given = self._given.get(name, ({}, {}))[0].get(self._native.capture.sensors[0].name)
        pairs = given.fixed if given else np.zeros((0, 4))
        enough = (
            len(pairs) >= LEAST_PAIRS and np.linalg.matrix_rank(pairs[:, :2] - pairs[0, :2]) > 1
        )
        return Affine.fit(pairs[:, :2], pairs[:, 2:]) if enough else None

    def _begin(self, images: Sequence[BandImage], factor: int) -> Transform | None:
        """Return where key points put a tile in the whole reference, reference px → native px; None where they do not agree."""
        sensor = self._native.capture.sensors[0].name
        bands = by_wavelength([one for one in images if one.sensor == sensor])
        there = present_bands(bands)
        shown = sqrt_images([there[i] for i in measured_bands(there)])
        theirs = CameraFeatures(GreyImages(list(shown.values())))
        found = find_initial_transform(self._keys, theirs)
        if found is None:
            return None
        whole = Inverse(Affine.of_box(0, 0, self._frame.step))
        return Composed(whole, found.transform, Affine.of_box(0, 0, factor))

    @cached_property
    def _keys(self) -> CameraFeatures:
        return PreparedReference(self._frame.overview, self._frame.band).keys

    def _once(
        self,
        pictures: Sequence[BandImage],
        factor: int,
        box: Box,
        expected: Transform,
        corrections: Corrections,
    ) -> Registration:
        """Register the pictures of a tile to a box of the reference, where it is expected, with what a person corrected of it."""
        images, transforms, step = self._frame.part(box)
        corner = Affine.of_box(box[0], box[1], step)
        back, grow = Inverse(corner), Affine.of_box(0, 0, factor)
        sigma = {label: _moved(one, back, 1 / step) for label, one in self._own.sigma.items()}
        height, width = images[0].values.shape
        places = np.array([[0.2, 0.2], [0.8, 0.2], [0.8, 0.8], [0.2, 0.8]]) * (width, height)
        starts = np.hstack([places, grow.inverse(expected(corner(places)))])
        first = self._native.capture.sensors[0].name
        given = {
            sensor: pairs.moved(back, grow.inverse) for sensor, pairs in corrections[0].items()
        }
        given[first] = replace(given.get(first, ManualPoints()), starts=starts)
        options: dict[str, Any] = {**self._options, **corrections[1]}
        align = {
            s: Affine(np.array(a, float)) for s, a in self._native.aligns.items() if a != "measure"
        }
        found = register(
            images, pictures, reference_band=self._frame.band, given=given, align=align,
            reference_transforms=transforms, reference_sigma=sigma, **options,
        )  # fmt: skip
        errors = found.errors if step == 1 else _enlarged(found.errors, step)
        if "check_points" in errors:
            errors = errors | {
                "check_points": [_moved_check(c, corner, grow) for c in errors["check_points"]]
            }
        return replace(
            found,
            transforms={
                label: Composed(back, one, grow) for label, one in found.transforms.items()
            },
            sigma={label: _moved(one, corner, step) for label, one in found.sigma.items()},
            errors=errors,
            matches=_moved_matches(found.matches, corner, grow, step),
            others={s: _moved_matches(m, corner, grow, step) for s, m in found.others.items()},
        )

    def _box(self, expected: Transform, size: tuple[int, int]) -> Box | None:
        """Return the part of the reference, x, y and behind the last, that a tile may show."""
        outline = expected.inverse(_outline(size))
        outline = outline[np.isfinite(outline).all(1)]
        if not len(outline):
            return None
        low, high = outline.min(0), outline.max(0)
        width, height = self._frame.size
        more = AROUND * (high - low)
        x, y = np.maximum(np.floor(low - more), 0).astype(int)
        right, bottom = np.minimum(np.ceil(high + more) + 1, (width, height)).astype(int)
        if right - x < 32 or bottom - y < 32:
            return None
        return int(x), int(y), int(right), int(bottom)

    def _middle(self, one: Transform, size: tuple[int, int]) -> np.ndarray:
        return np.asarray(one.inverse(np.array([size]) / 2 - 0.5)[0])

    # --- where tiles are expected

    def _predicted(self, name: str) -> Transform | None:
        """Return where a tile is expected by the stage and the tiles that are placed, reference px → native px."""
        placed = [
            n for n, one in self.found.items() if one.is_placed and n in self._stage and n != name
        ]
        if name not in self._stage or len(placed) < 3:
            return None
        stage = np.array([self._stage[n] for n in placed])
        spread = stage - stage.mean(0)
        if np.linalg.matrix_rank(spread, tol=0.1 * np.abs(spread).max()) < 2:
            return None
        middles = np.array([self._middle_of(n) for n in placed])
        near = min(placed, key=lambda n: (_apart(self._stage, (n, name)), n))
        onto = Affine.fit(stage, middles)
        shift = onto(np.array([self._stage[name]]))[0] - onto(np.array([self._stage[near]]))[0]
        back = Affine(np.array([[1.0, 0, -shift[0]], [0, 1, -shift[1]]]))
        return Composed(back, self.found[near].maps[self._label])

    def _middle_of(self, name: str) -> np.ndarray:
        one = self.found[name]
        return self._middle(one.maps[self._label], one.size)

    def _refuse_astray(self) -> None:
        """Leave out tiles that lie elsewhere than the places of the others say: a repeated ornament, a picture of another painting."""
        for name in sorted(self.found):
            one = self.found[name]
            expected = self._predicted(name) if one.is_placed else None
            if expected is None or self._begun_by_hand(name) is not None:
                continue
            side = min(one.size)
            places = one.maps[self._label].inverse(np.array([one.size]) / 2 - 0.5)
            off = hypot(*(expected(places)[0] - (np.array(one.size) / 2 - 0.5)))
            if off > ASTRAY * side and self._stage_is_right(name):
                reason = f"it lies {off:.0f} px from where the places of the other tiles put it"
                self.found[name] = _left_out(reason, one.size)

    def _stage_is_right(self, but: str) -> bool:
        """Return whether rows and columns, or positions, describe where the other tiles lie."""
        placed = [
            n for n, one in self.found.items() if one.is_placed and n in self._stage and n != but
        ]
        if len(placed) < 4:
            return False
        stage = np.array([self._stage[n] for n in placed])
        middles = np.array([self._middle_of(n) for n in placed])
        off = np.linalg.norm(Affine.fit(stage, middles)(stage) - middles, axis=1)
        scale = np.sqrt(
            abs(np.linalg.det(self.found[placed[0]].maps[self._label].jacobian(middles[:1])[0]))
        )
        return bool(np.median(off) * scale < ASTRAY / 3 * min(self.found[placed[0]].size))


def _outline(size: tuple[int, int]) -> np.ndarray:
    x, y = (np.linspace(-0.5, side - 0.5, OUTLINE) for side in size)
    grid = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
    return grid


def _moved(sigma: Sigma, onto: Transform, step: float) -> Sigma:
    x = onto(np.stack([sigma.x, np.zeros_like(sigma.x)], 1))[:, 0]
    y = onto(np.stack([np.zeros_like(sigma.y), sigma.y], 1))[:, 1]
    return Sigma(x, y, sigma.values * step)


def _moved_matches(matches: Matches, corner: Transform, grow: Transform, step: float) -> Matches:
    """Return pairs in px of the reference and native px, of a box that `corner` puts into the reference and a picture that `grow` makes native."""
    return replace(
        matches,
        reference=corner(matches.reference),
        target=grow(matches.target),
        residual=matches.residual * step,
        leave_one_out=matches.leave_one_out * step,
    )


def _moved_check(point: Mapping[str, Any], corner: Transform, grow: Transform) -> dict[str, Any]:
    sides = {"reference": corner, "target": grow}
    return {**point, **{k: onto(np.array([point[k]]))[0].tolist() for k, onto in sides.items()}}


def _enlarged(errors: Mapping[str, Any], step: int) -> dict[str, Any]:
    """Return errors in px of which `step` were one."""
    return {
        key: _enlarged(value, step)
        if isinstance(value, Mapping)
        else value * step
        if key.endswith("_px") and value is not None
        else value
        for key, value in errors.items()
    }


# --- the record of a layer of tiles


def verdict_of(found: Mapping[str, FoundTile]) -> Verdict:
    """Return the verdict of a layer: refused where no tile is placed, doubtful where some are left out or doubtful."""
    placed = [name for name, one in found.items() if one.is_placed]
    lost = {name: one for name, one in found.items() if not one.is_placed}
    doubtful = {
        n: one
        for n, one in found.items()
        if one.is_placed and one.verdict.decision in ("warn", "by hand")
    }
    reasons = [
        f"Tile {name} is left out, and is a hole in the layer: {' '.join(one.verdict.reasons)}"
        for name, one in lost.items()
    ]
    reasons += [f"Tile {name}: {' '.join(one.verdict.reasons)}" for name, one in doubtful.items()]
    numbers = {"tiles": len(found), "placed": len(placed)}
    if not placed:
        return Verdict("refuse", tuple(reasons), "Correct the frames of the tiles.", numbers)
    if reasons:
        step = "Capture these tiles again, or use the layer without them." if lost else LOOK
        return Verdict("warn", tuple(reasons), step, numbers)
    return Verdict("accept", (f"All {len(placed)} tiles are placed.",), "", numbers)


def results_of(
    found: Mapping[str, FoundTile], native: TiledCapture, size: tuple[int, int]
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
    sigma = sigma_of_mosaic(found, size)
    bands = {
        band.label: {
            "size": list(size),
            "transform": Affine.identity().to_dict(),
            "sigma": sigma.to_dict(),
        }
        for band in native.bands
    }
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
        {name: TilePlace(one.maps, one.sigma_px) for name, one in found.items() if one.is_placed},
        size,
    )
