"""Tiles of other cameras registered, each to the part of the reference that it shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry.transforms import Affine, Composed, Inverse
from levkas.registration import Registration, RegistrationRefused, register
from levkas.registration.advice import LEAST_PAIRS
from levkas.registration.bands import by_wavelength, present_bands, sqrt_images
from levkas.registration.chromatic import measured_bands
from levkas.registration.features import CameraFeatures, grey_pictures
from levkas.registration.initial import find_initial_transform
from levkas.registration.manual_points import ManualPoints
from levkas.registration.predictors import PreparedReference
from levkas.registration.record import HandMark, Matches, Sigma
from levkas.registration.reduced import FACTOR, LEAST_SIDE, enlarged, reduced
from levkas.stages.tile_placement import aligns_of, detail_of, places_of_stage
from levkas.stages.tiles import FoundTile, left_out

if TYPE_CHECKING:
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import Capture
    from levkas.geometry.joining import Box
    from levkas.geometry.transforms import Transform
    from levkas.registration import BandImage
    from levkas.stages.parts import CalibratedCapture
    from levkas.stages.reference import ReferenceFrame

AROUND = 0.12
"""Of a tile's side: how much more than where it is expected is cut out of the reference. A stage stops nearer than this."""
ASTRAY = 0.25
"""Of a tile's side: one that lies farther than this from where its neighbours' places put it is not where it was captured."""
LEAST_BOX = 32
"""Side of the part of the reference that a tile is registered to, px."""
OUTLINE = 9
"""Places along each side of a tile by which its outline is known."""


@dataclass(eq=False)
class TilesToReference:
    """Registers the tiles of a camera to the reference one after another, each to the part of it that it is expected on.

    `options` are those of the registration method; `given` is by tile the pairs by hand by sensor, px of the reference and of the
    tile, and the options set by hand.
    """

    capture: Capture
    native: CalibratedCapture
    frame: ReferenceFrame
    campaign: Campaign
    options: Mapping[str, Any]
    given: Mapping[str, tuple[Mapping[str, ManualPoints], Mapping[str, float]]]
    found: dict[str, FoundTile] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self._stage = places_of_stage(self.capture, self.campaign)
        self._label, self._first = self.native.bands[0].label, self.capture.sensors[0].name

    def run(self) -> dict[str, FoundTile]:
        """Return every tile as it was found: those of most detail first, then those that others say something of."""
        names = [part.tile for part in self.capture.tiles]
        detail = {name: detail_of(self.native.tile(name).images(), self._label) for name in names}
        for name in sorted(names, key=lambda name: (-detail[name], name)):
            self.found[name] = self._register(name)
        for name in [name for name, one in self.found.items() if not one.is_placed]:
            if self._begun_by_hand(name) is None and self._predicted(name) is not None:
                self.found[name] = self._register(name)
        for name in sorted(self.found):
            if (off := self._astray(name)) is not None:
                reason = f"it lies {off:.0f} px from where the places of the other tiles put it"
                self.found[name] = left_out(reason, self.found[name].size)
        return {name: self.found[name] for name in names}

    def _register(self, name: str) -> FoundTile:
        tile = self.native.tile(name)
        images, factor, size = tile.images(), 1, tile.size_of(self._label)
        expected = self._begun_by_hand(name) or self._predicted(name) or self._begin(images, 1)
        if expected is None and min(images[0].size) >= FACTOR * LEAST_SIDE:  # a macro photograph
            images, factor = [reduced(one, FACTOR) for one in images], FACTOR
            expected = self._begin(images, factor)
        if expected is None:
            return left_out("too few key points match between this tile and the reference", size)
        box = self._box(expected, size)
        if box is None:
            return left_out("it lies outside of what the reference shows", size)
        try:
            found = self._once(name, images, factor, box, expected)
        except RegistrationRefused as refused:
            return left_out(" ".join(str(p.message) for p in refused.problems), size)
        sigma = found.sigma.get(self._label)
        middle = _middle_of(found.transforms[self._label], size)[None]
        # What was judged is the part of the reference that was cut out, which is called a layer where it is one.
        part = "the part of the reference about the tile"
        reasons = tuple(text.replace("the layer", part) for text in found.verdict.reasons)
        verdict, matches = (
            replace(found.verdict, reasons=reasons),
            {"": found.matches, **found.others},
        )
        by_hand = sum(int((m.kept & (m.reason == HandMark.ADDED)).sum()) for m in matches.values())
        sigma_px = float(sigma(middle)[0]) if sigma else 0.0
        maps = found.transforms
        return FoundTile(verdict, size, maps, found.sigma, sigma_px, found.errors, matches, by_hand)

    def _begun_by_hand(self, name: str) -> Transform | None:
        """Return where a person's pairs put a tile, reference px → native px; None where there are too few."""
        given = self.given.get(name, ({}, {}))[0].get(self._first)
        pairs = given.fixed if given else np.zeros((0, 4))
        if len(pairs) < LEAST_PAIRS or np.linalg.matrix_rank(pairs[:, :2] - pairs[0, :2]) < 2:
            return None
        return Affine.fit(pairs[:, :2], pairs[:, 2:])

    def _begin(self, images: Sequence[BandImage], factor: int) -> Transform | None:
        """Return where key points put a tile in the whole reference, reference px → native px; None where they do not agree."""
        there = present_bands(by_wavelength([one for one in images if one.sensor == self._first]))
        shown = sqrt_images([there[i] for i in measured_bands(there)])
        found = find_initial_transform(
            self._keys, CameraFeatures(grey_pictures(list(shown.values())))
        )
        if found is None:
            return None
        whole = Inverse(Affine.of_box(0, 0, self.frame.step))
        return Composed(whole, found.transform, Affine.of_box(0, 0, factor))

    @cached_property
    def _keys(self) -> CameraFeatures:
        return PreparedReference(self.frame.overview, self.frame.band).keys

    def _once(
        self, name: str, pictures: Sequence[BandImage], factor: int, box: Box, expected: Transform
    ) -> Registration:
        """Register the pictures of a tile to a box of the reference, where it is expected, with what a person corrected of it."""
        images, transforms, step = self.frame.part(box)
        corner = Affine.of_box(box[0], box[1], step)
        back, grow = Inverse(corner), Affine.of_box(0, 0, factor)
        own = self.frame.registration()
        sigma = {label: _moved(one, back, 1 / step) for label, one in own.sigma.items()}
        height, width = images[0].values.shape
        places = np.array([[0.2, 0.2], [0.8, 0.2], [0.8, 0.8], [0.2, 0.8]]) * (width, height)
        starts = np.hstack([places, grow.inverse(expected(corner(places)))])
        pairs, by_hand = self.given.get(name, ({}, {}))
        given = {sensor: one.moved(back, grow.inverse) for sensor, one in pairs.items()}
        given[self._first] = replace(given.get(self._first, ManualPoints()), starts=starts)
        options = {k: v for k, v in self.options.items() if k not in ("outline", "layer")}
        found = register(
            images, pictures, reference_band=self.frame.band, given=given,
            align=aligns_of(self.native), reference_transforms=transforms, reference_sigma=sigma,
            **{**options, **by_hand},
        )  # fmt: skip
        return _in_reference(enlarged(found, factor), corner, step)

    def _box(self, expected: Transform, size: tuple[int, int]) -> Box | None:
        """Return the part of the reference, x, y and behind the last, that a tile may show."""
        x, y = (np.linspace(-0.5, side - 0.5, OUTLINE) for side in size)
        outline = expected.inverse(np.stack(np.meshgrid(x, y), -1).reshape(-1, 2))
        outline = outline[np.isfinite(outline).all(1)]
        if not len(outline):
            return None
        low, high = outline.min(0), outline.max(0)
        more = AROUND * (high - low)
        left, top = np.maximum(np.floor(low - more), 0).astype(int).tolist()
        right, bottom = np.minimum(np.ceil(high + more) + 1, self.frame.size).astype(int).tolist()
        if min(right - left, bottom - top) < LEAST_BOX:
            return None
        return left, top, right, bottom

    # --- where tiles are expected

    def _placed(self, but: str) -> tuple[list[str], np.ndarray, np.ndarray]:
        """Return the other tiles that are placed and on the stage; where the stage has them, and the reference, (n, 2) each."""
        names = [
            n for n, one in self.found.items() if one.is_placed and n in self._stage and n != but
        ]
        middles = [_middle_of(self.found[n].maps[self._label], self.found[n].size) for n in names]
        shape = (len(names), 2)
        return names, np.reshape([self._stage[n] for n in names], shape), np.reshape(middles, shape)

    def _predicted(self, name: str) -> Transform | None:
        """Return where a tile is expected by the stage and the tiles that are placed, reference px → native px."""
        names, stage, middles = self._placed(name)
        if name not in self._stage or len(names) < 3:
            return None
        spread = stage - stage.mean(0)
        if np.linalg.matrix_rank(spread, tol=0.1 * np.abs(spread).max()) < 2:
            return None
        here = np.array(self._stage[name])
        apart = np.hypot(*(stage - here).T).tolist()
        near = min(range(len(names)), key=lambda k: (apart[k], names[k]))
        x, y = np.diff(Affine.fit(stage, middles)(np.stack([here, stage[near]])), axis=0)[0]
        return Composed(Affine.of_box(x, y), self.found[names[near]].maps[self._label])

    def _astray(self, name: str) -> float | None:
        """Return how far a tile lies, px of it, from where the places of the others put it, where these are right and it lies elsewhere: a repeated ornament, a picture of another painting."""
        one = self.found[name]
        expected = self._predicted(name) if one.is_placed else None
        if expected is None or self._begun_by_hand(name) is not None:
            return None
        middle = np.array(one.size) / 2 - 0.5
        off = float(
            np.hypot(*(expected(_middle_of(one.maps[self._label], one.size)[None])[0] - middle))
        )
        names, stage, middles = self._placed(name)
        if off <= ASTRAY * min(one.size) or len(names) < 4:
            return None
        miss = np.linalg.norm(Affine.fit(stage, middles)(stage) - middles, axis=1)
        other = self.found[names[0]]
        scale = np.sqrt(abs(np.linalg.det(other.maps[self._label].jacobian(middles[:1])[0])))
        return off if np.median(miss) * scale < ASTRAY / 3 * min(other.size) else None


def _middle_of(one: Transform, size: tuple[int, int]) -> np.ndarray:
    """Return where the middle of a tile lies, reference px."""
    return np.asarray(one.inverse(np.array([size]) / 2 - 0.5)[0])


def _in_reference(found: Registration, corner: Affine, step: int) -> Registration:
    """Return a registration to a box, which `corner` puts into the reference, of which `step` px a side are one of it, as one to the reference."""
    errors, back = _enlarged(found.errors, step), Inverse(corner)
    if "check_points" in errors:
        errors["check_points"] = [
            {**one, "reference": corner(np.array([one["reference"]]))[0].tolist()}
            for one in errors["check_points"]
        ]
    return replace(
        found,
        transforms={label: Composed(back, one) for label, one in found.transforms.items()},
        sigma={label: _moved(one, corner, step) for label, one in found.sigma.items()},
        errors=errors,
        matches=_moved_matches(found.matches, corner, step),
        others={s: _moved_matches(m, corner, step) for s, m in found.others.items()},
    )


def _moved(sigma: Sigma, onto: Transform, step: float) -> Sigma:
    x = onto(np.stack([sigma.x, np.zeros_like(sigma.x)], 1))[:, 0]
    y = onto(np.stack([np.zeros_like(sigma.y), sigma.y], 1))[:, 1]
    return Sigma(x, y, sigma.values * step)


def _moved_matches(matches: Matches, corner: Transform, step: float) -> Matches:
    return replace(
        matches,
        reference=corner(matches.reference),
        residual=matches.residual * step,
        leave_one_out=matches.leave_one_out * step,
    )


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
