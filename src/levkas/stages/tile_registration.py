"""Tiles of other cameras registered, each to the part of the reference that it shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from math import hypot
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import Affine, Composed, Inverse
from levkas.registration import Registration, RegistrationRefused, register
from levkas.registration.advice import LEAST_PAIRS
from levkas.registration.bands import by_wavelength, present_bands, sqrt_images
from levkas.registration.features import CameraFeatures, GreyImages
from levkas.registration.initial import find_initial_transform
from levkas.registration.manual_points import ManualPoints
from levkas.registration.measured_bands import measured_bands
from levkas.registration.predictors import PreparedReference
from levkas.registration.record import HandMark, Matches, Sigma
from levkas.registration.reduced import FACTOR, LEAST_SIDE, reduced
from levkas.stages.tile_placement import detail_of, places_of_stage, stage_distance
from levkas.stages.tiles import FoundTile, left_out

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.geometry.joining import Box
    from levkas.geometry.transforms import Transform
    from levkas.registration import BandImage
    from levkas.stages.parts import CalibratedCapture
    from levkas.stages.reference import ReferenceFrame

Corrections = tuple[Mapping[str, ManualPoints], Mapping[str, float]]
AROUND = 0.12
"""Of a tile's side: how much more than where it is expected is cut out of the reference. A stage stops nearer than this."""
ASTRAY = 0.25
"""Of a tile's side: one that lies farther than this from where its neighbours' places put it is not where it was captured."""
OUTLINE = 9
"""Places along each side of a tile by which its outline is known."""
AROUND_TILE = "the part of the reference about the tile"
NO_KEY_POINTS = "too few key points match between this tile and the reference"


class TilesToReference:
    """Registers the tiles of a camera to the reference one after another, each to the part of it that it is expected on.

    Parameters
    ----------
    options : dict
        Of the registration method.
    given : dict of tile to (pairs by hand by sensor, options set by hand)
        Px of the reference and of the tile.
    """

    def __init__(
        self,
        capture: Capture,
        native: CalibratedCapture,
        frame: ReferenceFrame,
        campaign: Campaign,
        options: Mapping[str, Any],
        given: Mapping[str, Corrections],
    ) -> None:
        self._capture, self._native, self._frame, self._given = capture, native, frame, given
        self._options = {k: v for k, v in options.items() if k not in ("outline", "layer")}
        self._stage = places_of_stage(capture, campaign)
        self._own = frame.registration()
        self._label = native.bands[0].label
        self.found: dict[str, FoundTile] = {}

    def run(self) -> dict[str, FoundTile]:
        """Return every tile as it was found."""
        names = [part.tile for part in self._capture.tiles]
        detail = {name: detail_of(self._native.tile(name).images(), self._label) for name in names}
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
        images, factor = self._native.tile(name).images(), 1
        size = self._native.tile(name).size_of(self._label)
        expected = self._begun_by_hand(name) or self._predicted(name)
        expected = expected or self._begin(images, factor)
        if expected is None and min(images[0].size) >= FACTOR * LEAST_SIDE:  # a macro photograph
            images, factor = [reduced(one, FACTOR) for one in images], FACTOR * factor
            expected = self._begin(images, factor)
        if expected is None:
            return left_out(NO_KEY_POINTS, size)
        box = self._box(expected, size)
        if box is None:
            return left_out("it lies outside of what the reference shows", size)
        try:
            found = self._once(images, factor, box, expected, self._given.get(name, ({}, {})))
        except RegistrationRefused as refused:
            return left_out(" ".join(str(p.message) for p in refused.problems), size)
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
        given = self._given.get(name, ({}, {}))[0].get(self._capture.sensors[0].name)
        pairs = given.fixed if given else np.zeros((0, 4))
        enough = (
            len(pairs) >= LEAST_PAIRS and np.linalg.matrix_rank(pairs[:, :2] - pairs[0, :2]) > 1
        )
        return Affine.fit(pairs[:, :2], pairs[:, 2:]) if enough else None

    def _begin(self, images: Sequence[BandImage], factor: int) -> Transform | None:
        """Return where key points put a tile in the whole reference, reference px → native px; None where they do not agree."""
        sensor = self._capture.sensors[0].name
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
        first = self._capture.sensors[0].name
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
        near = min(placed, key=lambda n: (stage_distance(self._stage, (n, name)), n))
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
                self.found[name] = left_out(reason, one.size)

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
