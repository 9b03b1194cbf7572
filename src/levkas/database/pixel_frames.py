"""Points mapped between any two pixel frames of an object, through reference pixels, by its registration records."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from levkas.core.cube import find_band
from levkas.core.problems import Problem, Refused, unknown_name
from levkas.core.text import missing_path
from levkas.database.catalogue import database_of
from levkas.database.layout import layer_name
from levkas.database.manifest import check_inside, is_plain_name
from levkas.database.registrations import RecordRefused, beyond_checks, read_registration
from levkas.database.remote import is_remote
from levkas.geometry import from_dict
from levkas.geometry.transforms import Affine, Inverse, Transform
from levkas.readers.facts import check_memory
from levkas.readers.orientation import UPRIGHT, describe_turn
from levkas.registration.record import Sigma

GRID = "grid"
_FRAME = re.compile(
    r"(?P<camera>[^@#:]+)(?:@(?P<setup>[^#:]*))?(?:#(?P<tile>[^:]*))?(?::(?P<band>.*))?"
)
EDGE_PX = 1e-6
"""A corner that went through a map and back is still on the image."""


class MappingRefused(Refused):
    """Points cannot be mapped: a frame is not known, or a table of points cannot be read."""


@dataclass(frozen=True)
class Frame:
    """The name of a pixel frame; ``grid`` has no camera, without a band it is the reference channel's, without a tile that of tiles joined."""

    camera: str = ""
    setup: str = ""
    band: str = ""
    tile: str = ""

    @property
    def layer(self) -> str:
        return layer_name(self.camera, self.setup)

    def __str__(self) -> str:
        if not self.camera:
            return GRID
        name = f"{self.layer}#{self.tile}" if self.tile else self.layer
        return f"{name}:{self.band}" if self.band else name


def parse_frame(text: str) -> Frame:
    """Read ``grid``, ``CAMERA``, ``CAMERA:BAND``, ``CAMERA@SETUP`` or ``CAMERA@SETUP:BAND``, of tiles ``CAMERA#TILE:BAND``; raises MappingRefused.

    >>> parse_frame("lctf-nir@45-degree:650 nm")
    Frame(camera='lctf-nir', setup='45-degree', band='650 nm', tile='')
    """
    if text.strip() == GRID:
        return Frame()
    found = _FRAME.fullmatch(text)
    if not found or any(part is not None and not part.strip() for part in found.groups()):
        what, expected = f"{text!r} is not a pixel frame", "grid or CAMERA[@SETUP][#TILE][:BAND]"
        raise MappingRefused(Problem("E_KEY", what, found=text, expected=expected))
    return Frame(**{name: (part or "").strip() for name, part in found.groupdict().items()})


@dataclass(frozen=True)
class FramePixels:
    """A frame's part of the way: the map from reference px to its own, and its size, (width, height), where the record says it."""

    from_reference: Transform
    size: tuple[float, float] | None = None

    @classmethod
    def read(cls, entry: Mapping[str, Any], *, inverse: bool = False) -> FramePixels:
        """Read what a record says of a frame, whose map is the `inverse` where it leads to the reference."""
        size, found = entry.get("size"), from_dict(entry["transform"])
        return cls(Inverse(found) if inverse else found, tuple(map(float, size)) if size else None)  # type: ignore[arg-type]

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return which of the (n, 2) points lie on the image, to the outer edges of its pixels."""
        known = np.isfinite(points).all(axis=1)
        if self.size is not None:
            with np.errstate(invalid="ignore"):
                low, high = -0.5 - EDGE_PX, np.array(self.size) - 0.5 + EDGE_PX
                known &= np.all((points >= low) & (points <= high), axis=1)
        return known


@dataclass(frozen=True)
class FrameMap:
    """A map from `source` px to `target` px of one object; NaN where either is left.

    Outside the reference image, too, nothing is known: there a registration only extrapolates.
    """

    source: FramePixels
    target: FramePixels
    reference: FramePixels

    def __call__(self, points: np.ndarray) -> np.ndarray:
        """Map (n, 2) points; rows keep their order."""
        points = np.asarray(points, np.float64).reshape(-1, 2)
        middle = _moved(points, self.source.inside(points), self.source.from_reference.inverse)
        there = _moved(middle, self.reference.inside(middle), self.target.from_reference)
        there[~self.target.inside(there)] = np.nan
        return there

    def inverse(self, points: np.ndarray) -> np.ndarray:
        return FrameMap(self.target, self.source, self.reference)(points)


def _moved(
    points: np.ndarray, known: np.ndarray, move: Callable[[np.ndarray], np.ndarray]
) -> np.ndarray:
    """Return moved points, NaN where they are not known."""
    moved = np.full(points.shape, np.nan)
    if known.any():
        moved[known] = move(points[known])
    return moved


class Records:
    """The registration records of one object; those that were read already may be given by the names of their layers."""

    def __init__(
        self, database: Path, name: str, known: Mapping[str, dict[str, Any]] | None = None
    ) -> None:
        absent = None if is_remote(database) else missing_path(database)
        if absent is not None:
            raise MappingRefused(absent)
        self.name = name
        self.folder = database / "objects" / name / "registration"
        if not is_plain_name(name) or not self.folder.is_dir():
            found = database.glob("objects/*/registration/*.json")
            there = sorted({p.parent.parent.name for p in found})
            raise _unknown(f"there is no registered object {name!r}", name, there, database)
        self.layers = {p.stem: p for p in sorted(self.folder.glob("*.json"))}
        check_inside(database, *self.layers.values())
        self._read = dict(known or {})

    def load(self, layer: str) -> dict[str, Any]:
        if layer not in self._read:
            try:
                self._read[layer] = read_registration(self.layers[layer])
            except RecordRefused as refused:
                raise MappingRefused(*refused.problems) from None
        return self._read[layer]

    def pixels(self, frame: Frame) -> FramePixels:
        if frame.camera:
            return FramePixels.read(self.entry(frame))
        for layer in self.layers:
            if grid := self.load(layer).get("grid"):
                return FramePixels.read(grid, inverse=True)
        what = f"no record of {self.name} describes the grid"
        raise MappingRefused(Problem("E_KEY", what, str(self.folder), "grid"))

    def entry(self, frame: Frame) -> dict[str, Any]:
        record = self._record(frame)
        labels = list(record["bands"])
        label = labels[find_band(labels, frame.band or _frame(record.get("target")).band)]
        if not frame.tile:
            return dict(record["bands"][label])
        tiles, placed = record.get("tiles", {}), self.tiles(frame)
        if frame.tile in placed:
            return dict(tiles[frame.tile]["bands"][label])
        left_out = tiles.get(frame.tile, {}).get("verdict", {}).get("reasons", [])
        why = f"was left out: {' '.join(left_out)}" if frame.tile in tiles else "is not there"
        what = f"tile {frame.tile} of {frame.layer} {why}"
        raise _unknown(what, frame.tile, placed, self.layers[frame.layer])

    def tiles(self, frame: Frame) -> list[str]:
        """Return the names of the tiles of a layer that were placed; none where it has no tiles."""
        tiles = self._record(frame).get("tiles", {})
        return [name for name, one in tiles.items() if one.get("bands")]

    def reference(self) -> FramePixels:
        """Return the reference frame itself, with its size where that is known."""
        for layer in self.layers:
            frame = _frame(self.load(layer).get("reference"))
            if frame.layer in self.layers:
                entry = self.load(frame.layer).get("bands", {}).get(frame.band, {})
                same = {"transform": Affine.identity().to_dict()}
                return FramePixels.read({**entry, **same})
        return FramePixels(Affine.identity())

    def _record(self, frame: Frame) -> dict[str, Any]:
        if frame.layer not in self.layers:
            what, there = f"{self.name} has no frame {frame}", [GRID, *self.layers]
            raise _unknown(what, frame.layer, there, self.folder)
        record = self.load(frame.layer)
        verdict = record.get("verdict", {})
        if verdict.get("decision") == "refuse" or not record.get("bands"):
            reasons = "; ".join(verdict.get("reasons", [])) or "no reason is recorded"
            what = f"the registration of {frame.layer} was refused: {reasons}"
            file, fix = str(self.layers[frame.layer]), verdict.get("next_step") or None
            raise MappingRefused(Problem("E_VERDICT", what, file, fix=fix))
        return record


def _unknown(what: str, name: str, known: Iterable[str], file: Path) -> MappingRefused:
    return MappingRefused(unknown_name(what, name, known, code="E_KEY", file=str(file)))


def _frame(value: Any) -> Frame:
    """Read a frame that a record names, as text or in its parts."""
    if isinstance(value, dict):
        return Frame(*(str(value.get(key) or "") for key in ("camera", "setup", "band")))
    return parse_frame(value) if value else Frame()


def find_map(database: str | Path, name: str, source: str, target: str) -> FrameMap:
    """Return the map between two frames of an object, as in `parse_frame`; a camera alone means its reference channel.

    Raises MappingRefused where a frame is not there, or its registration was refused.
    """
    records = Records(database_of(database), name)
    first, last = (records.pixels(parse_frame(frame)) for frame in (source, target))
    return FrameMap(first, last, records.reference())


def map_points(
    database: str | Path, name: str, points: np.ndarray, *, source: str, target: str
) -> np.ndarray:
    """Return where points of an object, (n, 2) px of `source`, x and y, pixel centres at integers, lie in px of `target`, in the same order.

    `database` is a folder or an address; frames are named as `parse_frame` has it. NaN for what lies outside what is known.
    Raises MappingRefused where database, object, frame or band is not there, or the camera was refused.

    >>> map_points(plates / "database", "one", np.array([[100.0, 80.0]]), source="grid", target="infrared").round(1)
    array([[100.6,  81.9]])
    """
    return find_map(database, name, source, target)(points)


def map_table(
    database: str | Path, name: str, text: str, *, source: str, target: str, file: str | None = None
) -> str:
    """Map the columns x and y of a CSV table, read from `file`; rows in the same order, ``nan,nan`` for points that lie outside.

    Raises MappingRefused also where rows are not two numbers (``nan`` is one); the first ten are listed.
    """
    lines = text.removeprefix("\ufeff").splitlines()
    head = [cell.strip(' "').lower() for cell in lines[0].split(",")] if lines else []
    if not {"x", "y"} <= {*head}:
        found, what = ",".join(head)[:80] or "nothing", "the points have no header"
        raise MappingRefused(Problem("E_KEY", what, file, "line 1", found, "x,y"))
    points, problems = [], []
    for number, line in enumerate(lines[1:], 2):
        cells = [cell.strip(' "') for cell in line.split(",")]
        try:
            if any(cells):
                points.append([float(cells[head.index(axis)]) for axis in "xy"])
        except (ValueError, IndexError):
            facts = (file, f"line {number}", line[:80], "two numbers")
            problems.append(Problem("E_VALUE", "a line is not a point", *facts))
    if problems:
        raise MappingRefused(*problems[:10])
    places = np.array(points, float).reshape(-1, 2)
    mapped = map_points(database, name, places, source=source, target=target)
    rows = ("nan,nan" if np.isnan(x) else f"{x:.6f},{y:.6f}" for x, y in mapped)
    return "\n".join(["x,y", *rows]) + "\n"


def warn_of_turns(database: str | Path, name: str, frames: Iterable[str]) -> list[str]:
    """Report of frames whose files viewers turn or mirror that their coordinates are those of the file as stored."""
    records, warnings = Records(database_of(database), name), []
    for layer in dict.fromkeys(parse_frame(frame).layer for frame in frames):
        target = records.load(layer).get("target") if layer in records.layers else None
        turn = target.get("orientation") if isinstance(target, dict) else None
        if turn in UPRIGHT:
            shown = f"viewers show that {describe_turn(turn)} (EXIF orientation {turn})"
            warnings.append(f"coordinates of {layer} are of its file as it is stored; {shown}")
    return warnings


def find_position_sigma(
    database: str | Path, name: str, camera: str, setup: str = "", band: str | None = None
) -> np.ndarray | None:
    """Return `position_sigma_at` every pixel of the grid, float32; of no `band`, the reference channel's. None where the record has none."""
    records, frame = Records(database_of(database), name), Frame(camera, setup, band or "")
    grid = records.pixels(Frame())
    if "sigma" not in records.entry(frame) or grid.size is None:
        return None
    width, height = (round(n) for n in grid.size)
    check_memory(records.folder, width * height * 2, 8)
    return position_sigma_at(records, frame, _lattice(width, height)).reshape(height, width)


def _lattice(width: int, height: int, step: int = 1) -> np.ndarray:
    """Return every `step`-th pixel of a grid, row by row, (n, 2)."""
    x, y = np.meshgrid(*(np.arange(0.0, side, step) for side in (width, height)))
    return np.stack([x.ravel(), y.ravel()], 1)


def position_sigma_at(records: Records, frame: Frame, points: np.ndarray) -> np.ndarray:
    """Return how well the position of a band is known at (n, 2) px of the grid: one standard deviation of either axis, reference px.

    NaN where the band does not see the object, or nothing is known. Raises MappingRefused.
    """
    grid, entry = records.pixels(Frame()), records.entry(frame)
    values = np.full(len(points), np.nan, np.float32)
    if "sigma" in entry:
        native = FrameMap(grid, records.pixels(frame), records.reference())(points)
        inside = np.isfinite(native).all(1)
        places = grid.from_reference.inverse(points[inside])
        values[inside] = Sigma.from_dict(entry["sigma"])(places)
    return values


def predict_error(
    record: Mapping[str, Any], size: tuple[int, int], step: int = 1
) -> np.ndarray | None:
    """Return the error of a layer's registration over its grid of `size` (width, height) as its own evidence predicts it.

    Of every `step`-th pixel, (rows, columns), one standard deviation of the worst band, reference px; NaN where nothing
    confirms the map, as outside the object's outline. None where the record has none.
    """
    bands = record.get("bands", {}).values()
    known = [Sigma.from_dict(b["sigma"]) for b in bands if isinstance(b, dict) and b.get("sigma")]
    if not known:
        return None
    largest: list[Sigma] = []  # of those that no other exceeds all over the same lattice
    for one in sorted(known, key=lambda table: -float(table.values.sum())):
        if not any(one.nowhere_exceeds(other) for other in largest):
            largest.append(one)
    places = from_dict(record["grid"]["transform"])(_lattice(*size, step))
    worst = np.max([sigma(places) for sigma in largest], axis=0)
    worst[beyond_checks(record, places)] = np.nan
    return np.asarray(worst.reshape(-1, len(range(0, size[0], step))))
