"""Tiles of a painting on one plane: neighbours, overlaps, one adjustment, and what is left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from levkas.core.machine import steady_libraries
from levkas.geometry import from_dict
from levkas.geometry.transforms import Affine, Composed, Inverse, Lens, Transform
from levkas.registration.bands import BandImage
from levkas.registration.manual_points import ManualPoints
from levkas.registration.record import RegistrationRefused, refusal
from levkas.registration.tiles.adjustment import (
    Adjustment,
    Windows,
    adjust,
    choose_lens,
    overlap_misfits,
    overlap_offsets,
)
from levkas.registration.tiles.loops import components, consistent_pairs, lay_along_tree
from levkas.registration.tiles.neighbours import STAGE_SHARE, similarity
from levkas.registration.tiles.overlap_search import OverlapSearch, Pair
from levkas.registration.tiles.tile_maps import OWN, SHARED, TileFrame, TileMaps, similar

#: Tiles of a mosaic, at most.
MOST_TILES = 200
#: Unknowns an axis of the map between two tiles: at its windows, on average, its variance is so many times that of their mean.
OVERLAP_UNKNOWNS = 4
#: Share of a tile that another one shows too from which it is there twice.
TWICE_SHARE = 0.95
#: Px, and times the common rms, by which an overlap may be off after the adjustment.
MOST_OFF_PX, MOST_OFF = 1.0, 8.0
#: Rounds in which overlaps that contradict the adjustment are taken out.
ROUNDS = 10
#: Longer sides of a tile up to which middles of neighbours are apart; of 15 x 15 places, how many a corner has.
NEAR, CORNER = 1.05, 3
#: Of a tile's longer side: how well a stage's position is known at best.
LEAST_STAGE = 0.002
REPEATS = "shows detail that repeats itself where it overlaps others"
BY_HAND_UNLIKE = "shows nothing that its neighbour shows where the pairs by hand put it"
NO_DETAIL = "shows no detail where it overlaps others"
#: Why overlaps are missing of a tile that is taken where its position says.
DOUBTFUL = ({"no detail"}, {"repeats"}, {"no detail", "repeats"})


@dataclass(frozen=True)
class TilePlacement:
    """Where every tile of a painting lies."""

    transforms: dict[str, Transform]
    """Px of a tile → mosaic px."""
    size: tuple[int, int]
    """In mosaic px: of the box about all tiles."""
    sigma: dict[str, float]
    """In mosaic px: standard uncertainty of a tile's px along an axis, the root mean square over the tile, in the frame of
    the whole mosaic."""
    left_out: dict[str, str]
    """Why a tile is not placed."""
    overlaps: list[dict[str, Any]]
    """Of every pair of tiles that was used or refused: `tiles`, `windows`, `rms` and `sigma` (px), `off`
    (px after the adjustment, of all windows), `misfit` (px along an axis, of windows beside one another), `used`,
    `reason`."""
    lens: Lens | None
    """Which all tiles share: px put right → px."""
    rms: float
    """In px: of all windows after the adjustment, along an axis."""
    errors: dict[str, float]
    """In px: in windows left out, of plain homographies (``"none"``) and with a lens."""
    by_position: dict[str, str] = field(default_factory=dict)
    """Tiles that no overlap holds and that lie where their position says; why."""

    def to_dict(self) -> dict[str, Any]:
        """Return a JSON-ready record."""
        return {
            "kind": "tiles",
            "transforms": {name: one.to_dict() for name, one in self.transforms.items()},
            "size": list(self.size),
            "sigma": self.sigma,
            "left_out": self.left_out,
            "by_position": self.by_position,
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
                "sigma", "left_out", "overlaps", "rms", "errors", "by_position",
            )
        }  # fmt: skip
        return cls(transforms=transforms, size=(width, height), lens=lens, **rest)


def place_tiles(
    tiles: Mapping[str, BandImage],
    *,
    starts: Mapping[str, tuple[float, float]] | None = None,
    by_hand: Mapping[Pair, ManualPoints] | None = None,
    lens: bool = True,
) -> TilePlacement:
    """Place the tiles of a painting beside one another.

    Raises RegistrationRefused: ``E_TILES`` where no two tiles overlap, or of more than 200.

    Parameters
    ----------
    tiles : mapping of name to BandImage
        Pictures of parts of one plane by one camera. A value is read whenever it is needed, and few are held: a mapping may read files.
    starts : mapping of name to (x, y), px, optional
        Where the first px of a tile lies, to about a tenth of its side.
    by_hand : mapping of (name, name) to ManualPoints, optional
        Pairs of two tiles, px of the first and of the second. Four say where the overlap lies, which the pictures then show.
    lens : bool
        Whether tiles share a lens that is not known.

    Returns
    -------
    placement : TilePlacement
        The first tile in name order that is placed is neither turned nor scaled.

    Notes
    -----
    A block adjustment as photogrammetry has it ([brown1976]_), of windows in place of tie points; docs/explanation/tiles.md describes it.
    """
    if len(tiles) > MOST_TILES:
        raise refusal(
            "E_TILES",
            "there are too many tiles",
            field="tiles",
            found=f"{len(tiles)} tiles",
            expected=f"at most {MOST_TILES}",
            fix="Join parts of the mosaic by a program for microscopes, and build from these.",
        )
    with steady_libraries():
        return _Mosaic(OverlapSearch(tiles, starts or {}, by_hand or {}), lens).place()


def _sigma_beside(name: str, records: list[dict[str, Any]]) -> float:
    """Return how well a tile lies on its neighbours, mosaic px: that of its overlaps, shared by both tiles of each."""
    beside = [
        (OVERLAP_UNKNOWNS * one["sigma"] ** 2 + max(one["off"], one["misfit"]) ** 2) / 2
        for one in records
        if one["used"] and name in one["tiles"]
    ]
    return float(np.sqrt(np.mean(beside)))


class _Mosaic:
    """A mosaic at work: overlaps, and why some of them and of the tiles are left out."""

    def __init__(self, overlaps: OverlapSearch, lens: bool) -> None:
        self.overlaps, self.lens = overlaps, lens
        self.names, self.size, self.starts = overlaps.names, overlaps.size, overlaps.starts
        self.refused: dict[Pair, str] = {}
        self.left_out: dict[str, str] = {}

    def place(self) -> TilePlacement:
        self.overlaps.run()
        self._leave_out_twins()
        joined, adjusted = self._adjusted(lens=self.lens, alike=True)
        if self._measure_predicted(joined, adjusted):
            joined, adjusted = self._adjusted(lens=self.lens, alike=True)
        return self._placement(joined)

    # --- overlaps

    def _measure_predicted(self, joined: list[str], adjusted: Adjustment) -> bool:
        """Measure overlaps of placed tiles that were not found before, from where the adjustment puts them."""
        number = {name: k for k, name in enumerate(joined)}
        new = False
        for pair in self._predicted(joined, adjusted.maps):
            if pair in self.overlaps.found or pair in self.refused:
                continue
            onto = Composed(*(
                adjusted.maps.transform(number[pair[0]]),
                Inverse(adjusted.maps.transform(number[pair[1]])),
            ))  # fmt: skip
            new |= self.overlaps.measure_at(pair, onto)
        return new

    def _predicted(self, joined: list[str], maps: TileMaps) -> list[Pair]:
        """Return the pairs of placed tiles that overlap by more than a corner, however they are turned."""
        x, y = (np.linspace(0, n - 1, 15) for n in self.size)
        points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        tree, near = cKDTree(maps.own[:, 2:4]), []
        for i, j in sorted(map(tuple, map(sorted, tree.query_pairs(NEAR * max(self.size))))):
            there = maps(np.full(len(points), i), points)
            there = (there - maps.own[j, 2:4]) @ np.linalg.inv(similar(maps.own[j])).T
            if (np.abs(there) * maps.frame.spread <= np.array(self.size) / 2).all(1).sum() > CORNER:
                near.append((joined[i], joined[j]))
        return near

    def _by_position(
        self, joined: list[str], maps: TileMaps
    ) -> tuple[list[str], np.ndarray, float]:
        """Return tiles that have no detail where they overlap, their unknowns where their positions put them, and how far these err, px."""
        lone = [
            name
            for name in self.starts
            if name not in joined
            and name not in self.left_out
            and not any(name in pair for pair in (*self.overlaps.found, *self.refused))
            and {r for p, r in self.overlaps.missed.items() if name in p} - {"apart"} in DOUBTFUL
        ]
        known = [name for name in joined if name in self.starts]
        if not lone or len(known) < 2:
            return [], np.zeros((0, OWN)), 0.0
        stage = np.array([self.starts[name] for name in known]) + maps.frame.centre
        place = maps.own[[joined.index(name) for name in known], 2:4]
        onto = similarity(stage, place)
        freedom = 2 * len(known) - 4
        scatter = float(np.sqrt(((onto(stage) - place) ** 2).sum() / max(freedom, 1)))
        least = LEAST_STAGE if freedom else STAGE_SHARE / 2
        own = np.tile(maps.own.mean(0), (len(lone), 1))
        own[:, 2:4] = onto(np.array([self.starts[name] for name in lone]) + maps.frame.centre)
        return lone, own, max(scatter, least * max(self.size))

    def _why(self, name: str) -> str:
        return (
            REPEATS
            if "repeats" in {r for p, r in self.overlaps.missed.items() if name in p}
            else NO_DETAIL
        )

    def _leave_out_twins(self) -> None:
        """Leave out tiles that show the same as one before them."""
        for (first, second), overlap in sorted(self.overlaps.found.items()):
            if overlap.share >= TWICE_SHARE and first not in self.left_out:
                self.left_out[second] = (
                    f"shows the same as tile {first!r}: {100 * overlap.share:.0f} % of it"
                )

    # --- adjustment

    def _adjusted(self, *, lens: bool, alike: bool = False) -> tuple[list[str], Adjustment]:
        """Return the tiles that are joined, and their adjustment; overlaps that contradict it are refused."""
        for _ in range(ROUNDS):
            joined, pairs = self._joined()
            windows, begin = self._windows(joined, pairs), self._begin(joined, pairs)
            adjusted = adjust(windows, begin, lens=lens, alike=alike)
            off = overlap_offsets(windows, adjusted)
            size = np.hypot(*off.T)
            worst = int(np.argmax(size))
            if size[worst] <= max(MOST_OFF_PX, MOST_OFF * adjusted.rms):
                break
            self.refused[pairs[worst]] = f"contradicts the others by {size[worst]:.1f} px"
        return joined, adjusted

    def _joined(self) -> tuple[list[str], list[Pair]]:
        """Return the largest set of tiles that overlaps join, and these; what contradicts loops is refused."""
        usable = {
            pair: one
            for pair, one in sorted(self.overlaps.found.items())
            if pair not in self.refused and not set(pair) & self.left_out.keys()
        }
        maps = {pair: similarity(one.points, one.partners) for pair, one in usable.items()}
        weights = {pair: one.windows * one.explained for pair, one in usable.items()}
        tolerance = max(3.0, 0.01 * max(self.size))
        kept, refused = consistent_pairs(maps, weights, self.size, tolerance)
        self.refused |= {
            pair: f"does not close its loops: off by {off:.1f} px" for pair, off in refused.items()
        }
        parts = components(self.names, kept)
        joined = max(parts, key=lambda part: (len(part), [-self.names.index(n) for n in part]))
        if len(joined) < 2:
            raise self._nothing_joined()
        return joined, [pair for pair in kept if pair[0] in set(joined)]

    def _nothing_joined(self) -> RegistrationRefused:
        reasons = sorted(set(self.overlaps.missed.values()) | set(self.left_out.values()))
        return refusal(
            "E_TILES",
            "no two tiles overlap",
            field="tiles",
            found=f"{len(self.names)} tiles" + (f", {'; '.join(reasons[:3])}" if reasons else ""),
            expected="tiles of one painting, each with detail that a neighbour shows too",
            fix="Give the positions of the tiles, or capture with more overlap.",
        )

    def _windows(self, joined: list[str], pairs: list[Pair]) -> Windows:
        number = {name: k for k, name in enumerate(joined)}
        found = [self.overlaps.found[pair] for pair in pairs]
        return Windows(
            np.array([[number[a], number[b]] for a, b in pairs]),
            np.repeat(np.arange(len(pairs)), [len(one.points) for one in found]),
            np.concatenate([one.points for one in found]),
            np.concatenate([one.partners for one in found]),
            np.concatenate([one.information for one in found]),
        )

    def _begin(self, joined: list[str], pairs: list[Pair]) -> TileMaps:
        """Return tiles along the strongest overlaps, from the middle one on."""
        maps = {
            pair: similarity(self.overlaps.found[pair].points, self.overlaps.found[pair].partners)
            for pair in pairs
        }
        weights = {pair: float(self.overlaps.found[pair].windows) for pair in pairs}
        laid = lay_along_tree(joined, maps, weights)
        frame = TileFrame.of_size(self.size)
        own = np.zeros((len(joined), 8))
        for k, name in enumerate(joined):
            own[k, :2] = laid[name].matrix[:, 0] * frame.spread
            own[k, 2:4] = laid[name](frame.centre[None])[0]
        return TileMaps(frame, own, np.zeros(SHARED))

    # --- what is handed back

    def _placement(self, joined: list[str]) -> TilePlacement:
        lens, errors = False, dict[str, float]()
        if self.lens:
            _, pairs = self._joined()
            lens, errors = choose_lens(self._windows(joined, pairs), self._begin(joined, pairs))
        joined, adjusted = self._adjusted(lens=lens)
        _, pairs = self._joined()
        windows = self._windows(joined, pairs)
        off = overlap_offsets(windows, adjusted)
        lone, own, stage_px = self._by_position(joined, adjusted.maps)
        maps = replace(adjusted.maps, own=np.concatenate([adjusted.maps.own, own]))
        gauge = self._gauge(maps)
        transforms, boxes = {}, []
        for k, name in enumerate(joined + lone):
            height, width = self.overlaps.pictures.shapes[name]
            x, y = np.meshgrid(np.linspace(0, width - 1, 9), np.linspace(0, height - 1, 9))
            transforms[name] = Composed(maps.transform(k), gauge)
            boxes.append(transforms[name](np.stack([x.ravel(), y.ravel()], 1)))
        low = np.floor(np.min([box.min(0) for box in boxes], axis=0) + 0.5)
        high = np.max([box.max(0) for box in boxes], axis=0)
        shift = Affine(np.array([[1.0, 0, -low[0]], [0, 1, -low[1]]]))
        width, height = (np.ceil(high - low - 1e-6) + 1).astype(int).tolist()
        self._explain_missing(joined + lone)
        records = self._overlap_records(pairs, off, overlap_misfits(windows, adjusted))
        stage_px *= float(np.sqrt(np.linalg.det(gauge.matrix[:, :2])))
        return TilePlacement(
            {name: Composed(one, shift) for name, one in transforms.items()},
            (width, height),
            {n: _sigma_beside(n, records) for n in joined} | dict.fromkeys(lone, stage_px),
            dict(sorted(self.left_out.items())),
            records,
            adjusted.maps.lens if lens else None,
            adjusted.rms,
            errors,
            {
                name: f"{self._why(name)}: its position is known to ± {stage_px:.1f} px"
                for name in lone
            },
        )

    def _gauge(self, maps: TileMaps) -> Affine:
        """Return the similarity after which the first tile is neither turned nor scaled about its middle."""
        place, by_px, _, _ = maps.linearised(np.zeros(1, int), maps.frame.centre[None])
        (a, b), (c, d) = by_px[0]
        linear = np.array([[a + d, c - b], [b - c, a + d]]) / 2
        linear = linear / np.linalg.det(linear)
        return Affine(np.column_stack([linear, maps.frame.centre - linear @ place[0]]))

    def _explain_missing(self, joined: list[str]) -> None:
        """Say of every tile that is not placed why."""
        for name in self.names:
            if name in joined or name in self.left_out:
                continue
            refused = {p: r for p, r in self.refused.items() if name in p}
            others = sorted({n for p in self.overlaps.found if name in p for n in p} - {name})
            missed = {r for p, r in self.overlaps.missed.items() if name in p}
            if any(
                name in pair for pair in self.overlaps.by_hand.keys() - self.overlaps.found.keys()
            ):
                self.left_out[name] = BY_HAND_UNLIKE
            elif refused and all(pair in refused for pair in self.overlaps.found if name in pair):
                pair, reason = next(iter(sorted(refused.items())))
                partner = pair[1] if pair[0] == name else pair[0]
                self.left_out[name] = f"its overlap with tile {partner!r} {reason}"
            elif others:
                listed = ", ".join(repr(n) for n in others)
                self.left_out[name] = (
                    f"overlaps {listed} only, which no overlap joins to the others"
                )
            elif missed == {"no detail"}:
                self.left_out[name] = NO_DETAIL
            elif "repeats" in missed:
                self.left_out[name] = f"{REPEATS}: give the positions of the tiles"
            else:
                self.left_out[name] = "shows nothing that any other tile shows"

    def _overlap_records(
        self, pairs: list[Pair], off: np.ndarray, misfits: np.ndarray
    ) -> list[dict[str, Any]]:
        at = {pair: float(np.hypot(*off[k])) for k, pair in enumerate(pairs)}
        misfit = dict(zip(pairs, misfits.tolist(), strict=True))
        records = []
        for pair, one in sorted(self.overlaps.found.items()):
            left = next((self.left_out[name] for name in pair if name in self.left_out), None)
            spread = np.linalg.inv(one.information.sum(0))
            records.append(
                {
                    "tiles": list(pair),
                    "windows": one.windows,
                    "share": one.share,
                    "rms": one.rms,
                    "sigma": float(np.sqrt(np.trace(spread) / 2)),
                    "off": at.get(pair),
                    "misfit": misfit.get(pair),
                    "used": pair in at,
                    "reason": self.refused.get(pair) or (left if pair not in at else None),
                }
            )
        for pair, reason in sorted(self.overlaps.missed.items()):
            if reason != "apart":
                records.append({"tiles": list(pair), "windows": 0, "used": False, "reason": reason})
        return records
