"""Points mapped between any two pixel frames of an object, by its registration records.

Every path leads through reference pixels: grid → reference by the record's ``grid``, reference →
native pixels of a band by the band's transform, and back by the inverses.
"""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.core.cube import find_band
from levkas.core.problems import Problem, Refused, closest_match
from levkas.core.text import missing_path, unusable_name
from levkas.database.catalogue import database_of
from levkas.database.containment import check_inside, is_plain_name
from levkas.database.layout import layer_name
from levkas.database.registrations import RecordRefused, beyond_checks, read_registration
from levkas.database.remote import is_remote
from levkas.geometry import from_dict
from levkas.geometry.transforms import Affine, Inverse, Transform
from levkas.readers.facts import check_memory
from levkas.readers.orientation import UPRIGHT, describe_turn
from levkas.registration.record import Sigma

if TYPE_CHECKING:
    pass

GRID = "grid"
EDGE_PX = 1e-6
"""A corner that went through a map and back is still on the image."""


class MappingRefused(Refused):
    """Points cannot be mapped: a frame is not known, or a table of points cannot be read."""


@dataclass(frozen=True)
class Frame:
    """The name of a pixel frame; ``grid`` has no camera, and a camera may leave its band open.

    A camera of tiles has a frame a tile; without one its frame is that of the tiles joined, reference px.
    """

    camera: str = ""
    setup: str = ""
    band: str = ""
    tile: str = ""

    @property
    def layer(self) -> str:
        """``CAMERA`` or ``CAMERA@SETUP``, as registration records are called."""
        return layer_name(self.camera, self.setup)

    def __str__(self) -> str:
        if not self.camera:
            return GRID
        name = f"{self.layer}#{self.tile}" if self.tile else self.layer
        return f"{name}:{self.band}" if self.band else name


def parse_frame(text: str) -> Frame:
    """Read ``grid``, ``CAMERA``, ``CAMERA:BAND``, ``CAMERA@SETUP`` or ``CAMERA@SETUP:BAND``, of tiles ``CAMERA#TILE:BAND``.

    Raises MappingRefused.

    Examples
    --------
    >>> parse_frame("lctf-nir@45-degree:650 nm")
    Frame(camera='lctf-nir', setup='45-degree', band='650 nm', tile='')
    >>> parse_frame("d80#r2c3:R")
    Frame(camera='d80', setup='', band='R', tile='r2c3')
    """
    if text.strip() == GRID:
        return Frame()
    layer, colon, band = text.partition(":")
    layer, sharp, tile = layer.partition("#")
    camera, at, setup = layer.partition("@")
    parts = [part.strip() for part in (camera, setup, band, tile)]
    given = (True, at, colon, sharp)
    if any(mark and not part for mark, part in zip(given, parts, strict=True)):
        raise MappingRefused(
            Problem(
                "E_KEY",
                f"{text!r} is not a pixel frame",
                found=text,
                expected="grid, CAMERA, CAMERA:BAND, CAMERA@SETUP, CAMERA@SETUP:BAND or CAMERA#TILE:BAND",
            )
        )
    return Frame(*parts)


@dataclass(frozen=True)
class FramePixels:
    """A frame's part of the way: the map from reference px to its own, and what it covers.

    `size` is [width, height], or None where the record does not say it.
    """

    from_reference: Transform
    size: tuple[float, float] | None = None

    def inside(self, points: np.ndarray) -> np.ndarray:
        """Return which of the (n, 2) points lie on the image, to the outer edges of its pixels."""
        if self.size is None:
            return np.isfinite(points).all(axis=1)
        with np.errstate(invalid="ignore"):
            low, high = -0.5 - EDGE_PX, np.array(self.size) - 0.5 + EDGE_PX
            return np.all((points >= low) & (points <= high), axis=1)


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
        result = np.full(points.shape, np.nan)
        rows = np.flatnonzero(self.source.inside(points))
        if len(rows) == 0:
            return result
        middle = self.source.from_reference.inverse(points[rows])
        known = self.reference.inside(middle) & np.isfinite(middle).all(axis=1)
        rows, middle = rows[known], middle[known]
        if len(rows) == 0:
            return result
        mapped = self.target.from_reference(middle)
        known = self.target.inside(mapped)
        result[rows[known]] = mapped[known]
        return result

    def inverse(self, points: np.ndarray) -> np.ndarray:
        """Map (n, 2) points of the target back to the source."""
        return FrameMap(self.target, self.source, self.reference)(points)


def find_map(database: str | Path, name: str, source: str | Frame, target: str | Frame) -> FrameMap:
    """Return the map between two frames of an object.

    Parameters
    ----------
    name : str
        The object.
    source, target : str or Frame
        As in `parse_frame`; a camera alone means its reference channel.

    Raises MappingRefused where a frame is not there, or its registration was refused.
    """
    records = Records(database_of(database), name)
    frames = [f if isinstance(f, Frame) else parse_frame(f) for f in (source, target)]
    ends = [records.pixels(frame) for frame in frames]
    return FrameMap(ends[0], ends[1], records.reference())


def find_position_sigma(
    database: str | Path, name: str, camera: str, setup: str = "", band: str | None = None
) -> np.ndarray | None:
    """Return how well the position of a band is known at every pixel of the grid.

    Parameters
    ----------
    name : str
        The object.
    band : str, optional
        The camera's reference channel without it.

    Returns
    -------
    sigma : ndarray, (height, width), float32, reference px, or None
        One standard deviation of either axis; NaN where the band does not see the object. None
        where the record has none.

    Raises MappingRefused.
    """
    records, frame = Records(database_of(database), name), Frame(camera, setup, band or "")
    grid = records.pixels(Frame())
    if "sigma" not in records.entry(frame) or grid.size is None:
        return None
    width, height = (round(n) for n in grid.size)
    check_memory(records.folder, width * height * 2, 8)
    x, y = np.meshgrid(np.arange(width, dtype=float), np.arange(height, dtype=float))
    values = position_sigma_at(records, frame, np.stack([x.ravel(), y.ravel()], 1))
    return values.reshape(height, width)


def position_sigma_at(records: Records, frame: Frame, points: np.ndarray) -> np.ndarray:
    """Return how well the position of a band is known at (n, 2) px of the grid, reference px; NaN where it is outside or unknown."""
    grid, entry = records.pixels(Frame()), records.entry(frame)
    values = np.full(len(points), np.nan, np.float32)
    if "sigma" in entry:
        inside = FrameMap(grid, records.pixels(frame), records.reference())(points)
        inside = np.isfinite(inside).all(1)
        values[inside] = Sigma.from_dict(entry["sigma"])(
            grid.from_reference.inverse(points[inside])
        )
    return values


def predict_error(
    record: Mapping[str, Any], size: tuple[int, int], step: int = 1
) -> np.ndarray | None:
    """Return the error of a registration over the grid as its own evidence predicts it.

    Parameters
    ----------
    record : mapping
        Of one layer.
    size : (width, height)
        Of the grid.
    step : int
        Every so many pixels.

    Returns
    -------
    error : ndarray, (rows, columns), reference px, or None
        One standard deviation of the worst band; NaN where nothing confirms the map, as outside the object's
        outline. None where the record has none.
    """
    bands = record.get("bands", {}).values()
    tables = (band["sigma"] for band in bands if isinstance(band, dict) and band.get("sigma"))
    known = _largest([Sigma.from_dict(table) for table in tables])
    if not known:
        return None
    x, y = np.meshgrid(*(np.arange(0.0, side, step) for side in size))
    grid = from_dict(record["grid"].get("transform", record["grid"]))
    places = grid(np.stack([x.ravel(), y.ravel()], 1))
    worst = np.max([sigma(places) for sigma in known], axis=0)
    worst[beyond_checks(record, places)] = np.nan
    return np.asarray(worst.reshape(x.shape))


def _largest(tables: Sequence[Sigma]) -> list[Sigma]:
    """Return those tables that no other exceeds all over the same lattice: one interpolates to less than what exceeds it."""
    found: list[Sigma] = []
    for one in sorted(tables, key=lambda table: -float(table.values.sum())):
        if not any(one.nowhere_exceeds(other) for other in found):
            found.append(one)
    return found


def map_points(
    database: str | Path, name: str, points: np.ndarray, *, source: str, target: str
) -> np.ndarray:
    """Map points of an object from one frame to another.

    Parameters
    ----------
    database : path
        Folder or address of a database.
    name : str
        The object.
    points : ndarray, (n, 2), px of `source`
        (x, y), pixel centres at integers.
    source, target : str
        Names of frames: ``"grid"``, ``"CAMERA"``, ``"CAMERA:BAND"``, ``"CAMERA@SETUP"``,
        ``"CAMERA@SETUP:BAND"``, or of a tile ``"CAMERA#TILE:BAND"``.

    Returns
    -------
    mapped : ndarray, (n, 2), px of `target`
        In the same order; NaN for what lies outside what is known.

    Raises
    ------
    MappingRefused
        Where database, object, frame or band is not there, or the camera was refused.

    Examples
    --------
    >>> map_points(plates / "database", "one", np.array([[100.0, 80.0]]), source="grid", target="infrared").round(1)
    array([[100.6,  81.9]])
    """
    return find_map(database, name, source, target)(points)


def warn_of_turns(database: str | Path, name: str, frames: Iterable[str]) -> list[str]:
    """Report of frames whose files viewers turn or mirror that their coordinates are those of the file as stored."""
    layers = Records(database_of(database), name).layers
    warnings = []
    for layer in dict.fromkeys(parse_frame(frame).layer for frame in frames):
        target = _load(layers[layer]).get("target") if layer in layers else None
        turn = target.get("orientation") if isinstance(target, dict) else None
        if turn in UPRIGHT:
            warnings.append(
                f"coordinates of {layer} are of its file as it is stored; viewers show that {describe_turn(turn)} "
                f"(EXIF orientation {turn}), and their coordinates are others"
            )
    return warnings


def map_table(
    database: str | Path, name: str, text: str, *, source: str, target: str, file: str | None = None
) -> str:
    """Map a CSV table with the header ``x,y``; the answer has the same rows in the same order.

    `file` is where the text was read from, for refusals; points that lie outside are ``nan,nan``.

    Raises MappingRefused also where a row is not two numbers; all such rows are listed, at most ten.
    """
    points = read_points(text, file=file)
    mapped = map_points(database, name, points, source=source, target=target)
    lines = ["x,y"]
    lines += ["nan,nan" if np.isnan(x) else f"{x:.6f},{y:.6f}" for x, y in mapped]
    return "\n".join(lines) + "\n"


def read_points(text: str, *, file: str | None = None) -> np.ndarray:
    """Read the columns x and y of a CSV table, (n, 2); ``nan`` is allowed. Raises MappingRefused.

    Examples
    --------
    >>> read_points("x,y\\n1,2.5\\n").tolist()
    [[1.0, 2.5]]
    """
    expected = "a CSV with the header x,y"
    try:
        rows = list(csv.reader(io.StringIO(text.removeprefix("\ufeff"), newline="")))
    except csv.Error as error:
        raise MappingRefused(
            Problem("E_UNREADABLE", "the points are not a table", file, None, str(error), expected)
        ) from None
    head = [cell.strip().lower() for cell in rows[0]] if rows else []
    if "x" not in head or "y" not in head:
        found = ",".join(head)[:80] or "nothing"
        raise MappingRefused(
            Problem("E_KEY", "the points have no header", file, found=found, expected="x,y")
        )
    columns, points, problems = (head.index("x"), head.index("y")), [], []
    for number, row in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        try:
            points.append([float(row[column]) for column in columns])
        except (ValueError, IndexError):
            what = ",".join(row)[:80]
            why = f"line {number} is not a point"
            problems.append(Problem("E_VALUE", why, file, found=what, expected="two numbers"))
    if problems:
        raise MappingRefused(*problems[:10])
    return np.array(points, float).reshape(-1, 2)


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
        if not is_plain_name(name) or unusable_name(name) or not self.folder.is_dir():
            records = database.glob("objects/*/registration/*.json")
            there = sorted({p.parent.parent.name for p in records})
            raise MappingRefused(
                Problem(
                    "E_KEY",
                    f"there is no registered object {name!r}",
                    file=str(database),
                    found=name,
                    expected=", ".join(there) or "a database with registration records",
                    fix=closest_match(name, there),
                )
            )
        self.layers = {p.stem: p for p in sorted(self.folder.glob("*.json"))}
        check_inside(database, *self.layers.values())
        self._read = dict(known or {})

    def _load(self, path: Path) -> dict[str, Any]:
        if path.stem not in self._read:
            self._read[path.stem] = _load(path)
        return self._read[path.stem]

    def pixels(self, frame: Frame) -> FramePixels:
        """Return the maps and the size of one frame."""
        if not frame.camera:
            return self._grid()
        entry = self.entry(frame)
        return FramePixels(from_dict(entry.get("transform", entry)), _size(entry))

    def entry(self, frame: Frame) -> dict[str, Any]:
        """Return what a record says of one band."""
        record = self._record(frame)
        labels = list(record["bands"])
        label = labels[find_band(labels, frame.band)] if frame.band else _reference_channel(record)
        bands = self._tile(record, frame)["bands"] if frame.tile else record["bands"]
        return dict(bands[label])

    def tiles(self, frame: Frame) -> list[str]:
        """Return the names of the tiles of a layer that were placed; none where it has no tiles."""
        tiles = self._record(frame).get("tiles", {})
        return [name for name, one in tiles.items() if one.get("bands")]

    def _tile(self, record: dict[str, Any], frame: Frame) -> dict[str, Any]:
        """Return what a record says of one tile."""
        tiles = record.get("tiles", {})
        placed = [name for name, one in tiles.items() if one.get("bands")]
        if frame.tile in placed:
            return dict(tiles[frame.tile])
        left_out = tiles.get(frame.tile, {}).get("verdict", {}).get("reasons", [])
        why = f"was left out: {' '.join(left_out)}" if frame.tile in tiles else "is not there"
        raise MappingRefused(
            Problem(
                "E_KEY",
                f"tile {frame.tile} of {frame.layer} {why}",
                file=str(self.layers[frame.layer]),
                found=str(frame),
                expected=", ".join(placed) or f"{frame.layer}, which has no tiles",
                fix=closest_match(frame.tile, placed),
            )
        )

    def reference(self) -> FramePixels:
        """Return the reference frame itself, with its size where that is known."""
        for path in self.layers.values():
            frame = _frame(self._load(path).get("reference"))
            if frame.layer in self.layers:
                entry = self._load(self.layers[frame.layer]).get("bands", {}).get(frame.band, {})
                return FramePixels(Affine.identity(), _size(entry))
        return FramePixels(Affine.identity())

    def _grid(self) -> FramePixels:
        for path in self.layers.values():
            if grid := self._load(path).get("grid"):
                return FramePixels(Inverse(from_dict(grid.get("transform", grid))), _size(grid))
        raise MappingRefused(
            Problem(
                "E_KEY", f"no record of {self.name} describes the grid", str(self.folder), "grid"
            )
        )

    def _record(self, frame: Frame) -> dict[str, Any]:
        if frame.layer not in self.layers:
            raise MappingRefused(
                Problem(
                    "E_KEY",
                    f"{self.name} has no frame {frame}",
                    file=str(self.folder),
                    found=str(frame),
                    expected=", ".join([GRID, *self.layers]),
                    fix=closest_match(frame.layer, [GRID, *self.layers]),
                )
            )
        record = self._load(self.layers[frame.layer])
        verdict = record.get("verdict", {})
        if verdict.get("decision") == "refuse" or not record.get("bands"):
            raise MappingRefused(
                Problem(
                    "E_VERDICT",
                    f"the registration of {frame.layer} was refused: "
                    + ("; ".join(verdict.get("reasons", [])) or "no reason is recorded"),
                    file=str(self.layers[frame.layer]),
                    fix=verdict.get("next_step") or None,
                )
            )
        return record


def _reference_channel(record: dict[str, Any]) -> str:
    label = _frame(record.get("target")).band
    if label in record["bands"]:
        return label
    raise MappingRefused(
        Problem(
            "E_KEY",
            "the record does not name the camera's reference channel",
            field="target",
            found=str(record.get("target")),
            expected=", ".join(record["bands"]),
            fix="Name a band: CAMERA:BAND.",
        )
    )


def _frame(value: Any) -> Frame:
    """Read a frame that a record names, as text or in its parts."""
    if isinstance(value, dict):
        return Frame(*(str(value.get(key) or "") for key in ("camera", "setup", "band")))
    return parse_frame(value) if value else Frame()


def _size(entry: dict[str, Any]) -> tuple[float, float] | None:
    size = entry.get("size")
    return None if size is None else (float(size[0]), float(size[1]))


def _load(path: Path) -> dict[str, Any]:
    try:
        return read_registration(path)
    except RecordRefused as refused:
        raise MappingRefused(*refused.problems) from None
