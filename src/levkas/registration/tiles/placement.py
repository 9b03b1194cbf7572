"""Tiles of a painting on one plane: neighbours, overlaps, one adjustment, and what is left out."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import Any

import numpy as np
from scipy import sparse

from levkas.core.machine import steady_libraries
from levkas.geometry.transforms import Affine, Composed, Inverse, Lens, Transform
from levkas.registration.bands import BandImage
from levkas.registration.manual_points import ManualPoints
from levkas.registration.record import RegistrationRefused, refusal
from levkas.registration.tiles.adjustment import (
    OWN,
    SHARED,
    Adjustment,
    TileMaps,
    Windows,
    adjust,
    choose_lens,
)
from levkas.registration.tiles.search import STAGE_SHARE, OverlapSearch, Pair, similarity

#: Tiles of a mosaic, at most.
MOST_TILES = 200
#: Unknowns an axis of the map between two tiles: at its windows, on average, its variance is so many times that of their mean.
OVERLAP_UNKNOWNS = 4
#: Share of a tile that another one shows too from which it is there twice.
TWICE_SHARE = 0.95
#: Up to which a loop closes, px at least, and of a tile's longer side.
LOOP_PX, LOOP_SHARE = 3.0, 0.01
#: Px, and times the common rms, by which an overlap may be off after the adjustment; rounds in which the worst is taken out.
MOST_OFF_PX, MOST_OFF, ROUNDS = 1.0, 8.0, 10
#: Of 15 x 15 places of a tile, how many a corner has.
CORNER = 3
#: Of a tile's longer side: how well a stage's position is known at best.
LEAST_STAGE = 0.002
REPEATS = "shows detail that repeats itself where it overlaps others"
NO_DETAIL = "shows no detail where it overlaps others"


@dataclass(frozen=True)
class TilePlacement:
    """Where every tile of a painting lies."""

    transforms: dict[str, Transform]
    """Px of a tile → mosaic px."""
    size: tuple[int, int]
    """In mosaic px: of the box about all tiles."""
    sigma: dict[str, float]
    """In mosaic px: standard uncertainty of a tile's px along an axis beside its neighbours, the root mean square over the tile."""
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
        """Return a JSON-ready record, without maps."""
        found = {key: value for key, value in vars(self).items() if key != "transforms"}
        size, lens = list(self.size), self.lens and self.lens.to_dict()
        return {"kind": "tiles", **found, "size": size, "lens": lens}


def place_tiles(
    tiles: Mapping[str, BandImage],
    *,
    starts: Mapping[str, tuple[float, float]] | None = None,
    by_hand: Mapping[Pair, ManualPoints] | None = None,
    lens: bool = True,
) -> TilePlacement:
    """Place the tiles of a painting beside one another; the first in name order is neither turned nor scaled.

    A block adjustment as photogrammetry has it ([brown1976]_), of windows in place of tie points; docs/explanation/tiles.md describes it.

    Raises RegistrationRefused: ``E_TILES`` where no two tiles overlap, or of more than 200.

    Parameters
    ----------
    tiles : mapping of name to BandImage
        Pictures of parts of one plane by one camera, of one size. A value is read whenever it is needed, and few are held: a mapping
        may read files.
    starts : mapping of name to (x, y), px, optional
        Where the first px of a tile lies, to about a tenth of its side.
    by_hand : mapping of (name, name) to ManualPoints, optional
        Pairs of two tiles, px of the first and of the second. Four say where the overlap lies, which the pictures then show.
    lens : bool
        Whether tiles share a lens that is not known.
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


class _Mosaic:
    """A mosaic at work: overlaps, and why some of them and of the tiles are left out."""

    def __init__(self, overlaps: OverlapSearch, lens: bool) -> None:
        self.overlaps, self.lens = overlaps, lens
        self.names, self.size = overlaps.names, overlaps.size
        self.starts = {n: overlaps.starts[n] for n in self.names if n in overlaps.starts}
        self.refused: dict[Pair, str] = {}
        self.left_out: dict[str, str] = {}

    def place(self) -> TilePlacement:
        self.overlaps.run()
        for (first, second), one in sorted(self.overlaps.found.items()):
            if one.share >= TWICE_SHARE and first not in self.left_out:
                share = f"{100 * one.share:.0f} % of it"
                self.left_out[second] = f"shows the same as tile {first!r}: {share}"
        adjusted = self._adjusted(lens=self.lens)
        if self._measure_predicted(*adjusted[:2]):
            self._adjusted(lens=self.lens)
        lens, errors = False, dict[str, float]()
        if self.lens:
            joined, pairs = self._joined()
            lens, errors = choose_lens(self._windows(joined, pairs), self._begin(joined, pairs))
        return self._placement(*self._adjusted(lens=lens), lens, errors)

    # --- overlaps

    def _measure_predicted(self, joined: list[str], adjusted: Adjustment) -> bool:
        """Measure overlaps of placed tiles that were not found before, from where the adjustment puts them."""
        x, y = (np.linspace(0, n - 1, 15) for n in self.size)
        points = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        maps = [adjusted.maps.transform(k) for k in range(len(joined))]
        new = False
        for (i, one), (j, other) in combinations(enumerate(joined), 2):
            if (one, other) in self.overlaps.found or (one, other) in self.refused:
                continue
            onto = Composed(maps[i], Inverse(maps[j]))
            there = onto(points)
            inside = ((there >= 0) & (there <= np.array(self.size) - 1)).all(1)
            if inside.sum() > CORNER:
                new |= self.overlaps.measure((one, other), onto)
        return new

    def _missed_by(self, name: str) -> set[str]:
        return {r for pair, r in self.overlaps.missed.items() if name in pair} - {"apart"}

    # --- adjustment

    def _adjusted(self, *, lens: bool) -> tuple[list[str], Adjustment, list[Pair], Windows]:
        """Return the tiles that are joined, their adjustment, and by which overlaps; those that contradict it are refused."""
        for _ in range(ROUNDS):
            joined, pairs = self._joined()
            windows = self._windows(joined, pairs)
            adjusted = adjust(windows, self._begin(joined, pairs), lens=lens)
            size = np.hypot(*windows.mean_residuals(adjusted.residual).T)
            worst = int(np.argmax(size))
            if size[worst] <= max(MOST_OFF_PX, MOST_OFF * adjusted.rms):
                break
            self.refused[pairs[worst]] = f"contradicts the others by {size[worst]:.1f} px"
        return joined, adjusted, pairs, windows

    def _joined(self) -> tuple[list[str], list[Pair]]:
        """Return the largest set of tiles that overlaps join, and these; what contradicts loops is refused."""
        maps = {
            pair: similarity(one.points, one.partners)
            for pair, one in sorted(self.overlaps.found.items())
            if pair not in self.refused and not set(pair) & self.left_out.keys()
        }
        weights = {
            p: self.overlaps.found[p].windows * self.overlaps.found[p].explained for p in maps
        }
        tolerance = max(LOOP_PX, LOOP_SHARE * max(self.size))
        kept, refused = consistent_pairs(maps, weights, self.size, tolerance)
        self.refused |= {
            pair: f"does not close its loops: off by {off:.1f} px" for pair, off in refused.items()
        }
        number = {name: k for k, name in enumerate(self.names)}
        graph = _graph([(number[a], number[b]) for a, b in kept], [1.0] * len(kept), len(number))
        _, part = sparse.csgraph.connected_components(graph, directed=False)
        largest = int(np.argmax(np.bincount(part)))
        joined = [name for name in self.names if part[number[name]] == largest]
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
        found = [self.overlaps.found[pair] for pair in pairs]
        arrays = ([getattr(one, n) for one in found] for n in ("points", "partners", "information"))
        return Windows(
            np.array([[joined.index(a), joined.index(b)] for a, b in pairs]),
            np.repeat(np.arange(len(pairs)), [len(one.points) for one in found]),
            *(np.concatenate(some) for some in arrays),
        )

    def _begin(self, joined: list[str], pairs: list[Pair]) -> TileMaps:
        """Return tiles laid along the fewest overlaps from the one with most, of these the strongest; scales are left at 1, which a chain would drift in."""
        ends = [(joined.index(a), joined.index(b)) for a, b in pairs]
        lengths = [1 + 0.1 / self.overlaps.found[pair].windows for pair in pairs]
        graph = _graph(ends, lengths, len(joined))
        centre = int(np.argmax(np.bincount(np.ravel(ends), minlength=len(joined))))
        far, before = sparse.csgraph.dijkstra(
            graph, directed=False, indices=centre, return_predecessors=True
        )
        maps = TileMaps(self.size, np.zeros((len(joined), OWN)), np.zeros(SHARED))
        laid = {centre: Affine.identity()}
        for k in np.argsort(far, kind="stable").tolist():
            if k != centre:
                name, known = joined[k], joined[int(before[k])]
                one = self.overlaps.found[min(name, known), max(name, known)]
                step = similarity(*((one.points, one.partners)[:: 1 if name < known else -1]))
                onto = Composed(step, laid[int(before[k])])
                corners = np.array([[0.0, 0], [self.size[0], 0], [0, self.size[1]]])
                laid[k] = similarity(corners, onto(corners))
            linear = laid[k].matrix[:, :2]
            maps.own[k, 1] = maps.spread * np.arctan2(linear[1, 0], linear[0, 0])
            maps.own[k, 2:4] = laid[k](maps.centre[None])[0]
        return maps

    # --- what is handed back

    def _placement(
        self,
        joined: list[str],
        adjusted: Adjustment,
        pairs: list[Pair],
        windows: Windows,
        lens: bool,
        errors: dict[str, float],
    ) -> TilePlacement:
        lone, own, stage_px = self._by_position(joined, adjusted.maps)
        maps = replace(adjusted.maps, own=np.concatenate([adjusted.maps.own, own]))
        gauge = _gauge(maps)
        x, y = (np.linspace(0, n - 1, 9) for n in self.size)
        outline = np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)
        transforms = {
            name: Composed(maps.transform(k), gauge) for k, name in enumerate(joined + lone)
        }
        places = np.concatenate([one(outline) for one in transforms.values()])
        low, high = np.floor(places.min(0) + 0.5), places.max(0)
        width, height = (np.ceil(high - low - 1e-6) + 1).astype(int).tolist()
        stage_px *= float(np.sqrt(np.linalg.det(gauge.matrix[:, :2])))
        self._explain_missing(joined + lone)
        records = self._overlap_records(pairs, windows, adjusted.residual)
        return TilePlacement(
            {name: Composed(one, Affine.of_box(*-low)) for name, one in transforms.items()},
            (width, height),
            {n: _sigma_beside(n, records) for n in joined} | dict.fromkeys(lone, stage_px),
            dict(sorted(self.left_out.items())),
            records,
            adjusted.maps.lens if lens else None,
            adjusted.rms,
            errors,
            {
                name: f"{REPEATS if 'repeats' in self._missed_by(name) else NO_DETAIL}: "
                f"its position is known to ± {stage_px:.1f} px"
                for name in lone
            },
        )

    def _by_position(
        self, joined: list[str], maps: TileMaps
    ) -> tuple[list[str], np.ndarray, float]:
        """Return tiles that have no detail where they overlap, their unknowns where their positions put them, and how far these err, px."""
        measured = {name for p in (*self.overlaps.found, *self.refused) for name in p}
        lone = [
            name
            for name in self.starts
            if name not in {*joined, *self.left_out, *measured}
            and self._missed_by(name)
            and self._missed_by(name) <= {"no detail", "repeats"}
        ]
        known = [name for name in joined if name in self.starts]
        if not lone or len(known) < 2:
            return [], np.zeros((0, OWN)), 0.0
        stage = np.array([self.starts[name] for name in known]) + maps.centre
        place = maps.own[[joined.index(name) for name in known], 2:4]
        onto, freedom = similarity(stage, place), 2 * len(known) - 4
        scatter = float(np.sqrt(((onto(stage) - place) ** 2).sum() / max(freedom, 1)))
        least = LEAST_STAGE if freedom else STAGE_SHARE / 2
        own = np.tile(maps.own.mean(0), (len(lone), 1))
        own[:, 2:4] = onto(np.array([self.starts[name] for name in lone]) + maps.centre)
        return lone, own, max(scatter, least * max(self.size))

    def _explain_missing(self, placed: list[str]) -> None:
        """Say of every tile that is not placed why."""
        for name in self.names:
            if name in placed or name in self.left_out:
                continue
            refused = {p: r for p, r in self.refused.items() if name in p}
            found = [p for p in self.overlaps.found if name in p]
            others = ", ".join(repr(n) for p in found for n in p if n != name)
            missed = self._missed_by(name)
            if any(name in p for p in self.overlaps.by_hand.keys() - self.overlaps.found.keys()):
                reason = "shows nothing that its neighbour shows where the pairs by hand put it"
            elif refused and all(pair in refused for pair in found):
                pair, why = min(refused.items())
                reason = f"its overlap with tile {pair[pair[0] == name]!r} {why}"
            elif others:
                reason = f"overlaps {others} only, which no overlap joins to the others"
            elif missed == {"no detail"}:
                reason = NO_DETAIL
            elif "repeats" in missed:
                reason = f"{REPEATS}: give the positions of the tiles"
            else:
                reason = "shows nothing that any other tile shows"
            self.left_out[name] = reason

    def _overlap_records(
        self, pairs: list[Pair], windows: Windows, residual: np.ndarray
    ) -> list[dict[str, Any]]:
        off = np.hypot(*windows.mean_residuals(residual).T)
        misfit = windows.common_residuals(residual)
        used = {
            p: {"off": float(o), "misfit": float(m)}
            for p, o, m in zip(pairs, off, misfit, strict=True)
        }
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
                    **used.get(pair, {"off": None, "misfit": None}),
                    "used": pair in used,
                    "reason": self.refused.get(pair) or (left if pair not in used else None),
                }
            )
        for pair, reason in sorted(self.overlaps.missed.items()):
            if reason != "apart":
                records.append({"tiles": list(pair), "windows": 0, "used": False, "reason": reason})
        return records


def consistent_pairs(
    maps: Mapping[Pair, Affine],
    weights: Mapping[Pair, float],
    size: tuple[int, int],
    tolerance: float,
) -> tuple[list[Pair], dict[Pair, float]]:
    """Return the overlaps that close their loops of three to a `tolerance`, px, and those that do not, with their least closure, px.

    An overlap of which more loops fail than close is taken out, the worst first, of equals the one of least weight; until none is left.
    `maps` go px of the first tile → px of the second; tiles are (width, height) `size`.
    """
    kept = sorted(maps)
    refused: dict[Pair, float] = {}
    middle = (np.array(size, float)[None] - 1) / 2
    loops = []
    for a, b in kept:
        for c in (name for one, name in kept if one == b and (a, name) in maps):
            there = maps[a, c].inverse(maps[b, c](maps[a, b](middle)))
            loops.append((((a, b), (b, c), (a, c)), float(np.hypot(*(there - middle)[0]))))
    while True:
        votes = {pair: [0, 0] for pair in kept}
        for edges, off in loops:
            for pair in edges:
                votes[pair][off > tolerance] += 1
        doubtful = [pair for pair in kept if votes[pair][1] > votes[pair][0]]
        if not doubtful:
            return kept, refused
        worst = min(doubtful, key=lambda p: (votes[p][0] - votes[p][1], weights[p], p))
        refused[worst] = min(off for edges, off in loops if worst in edges)
        kept.remove(worst)
        loops = [one for one in loops if worst not in one[0]]


def _graph(ends: list[tuple[int, int]], lengths: list[float], count: int) -> sparse.coo_array:
    rows, columns = np.array(ends, int).reshape(-1, 2).T
    return sparse.coo_array((lengths, (rows, columns)), (count, count))


def _gauge(maps: TileMaps) -> Affine:
    """Return the similarity after which the first tile is neither turned nor scaled about its middle."""
    first, middle = np.zeros(1, int), maps.centre[None]
    (a, b), (c, d) = maps.by_px(first, middle)[0]
    linear = np.array([[a + d, c - b], [b - c, a + d]]) / 2
    linear = linear / np.linalg.det(linear)
    return Affine(np.column_stack([linear, maps.centre - linear @ maps(first, middle)[0]]))


def _sigma_beside(name: str, records: list[dict[str, Any]]) -> float:
    """Return how well a tile lies on its neighbours, mosaic px: that of its overlaps, shared by both tiles of each."""
    beside = [
        (OVERLAP_UNKNOWNS * one["sigma"] ** 2 + max(one["off"], one["misfit"]) ** 2) / 2
        for one in records
        if one["used"] and name in one["tiles"]
    ]
    return float(np.sqrt(np.mean(beside)))
