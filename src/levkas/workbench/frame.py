"""The registration of one sensor opened for the screen: pictures, maps, tiles, partners."""

from __future__ import annotations

import hashlib
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.geometry import from_dict
from levkas.geometry.transforms import Inverse, Transform
from levkas.workbench.correlation import REACH_PX, SURE, Correlated, find_partner
from levkas.workbench.pictures import ShownPicture, encode, warped_tile
from levkas.workbench.session import refused

if TYPE_CHECKING:
    from levkas.campaign.discovery.captures import Capture, SensorFrames
    from levkas.workbench.session import CorrectionSession

SIDES = ("reference", "target")
FEW = 12
WIDE_SHARE = 0.03
SNAP_PX = 8.0


@dataclass
class RegistrationView:
    """One sensor of a camera of an object.

    Parameters
    ----------
    view, main : SensorView
        What is corrected, and the reference.
    record, main_record : dict
        registration/CAMERA.json of either camera.
    session : CorrectionSession
    band, reference_band : str
        Shown unless others are chosen.
    read : callable, (capture, band) → Picture
    """

    view: SensorView
    main: SensorView
    record: dict[str, Any]
    main_record: dict[str, Any]
    session: CorrectionSession
    band: str
    reference_band: str
    read: Callable[[Capture, str], ShownPicture]
    lock: threading.RLock = field(default_factory=threading.RLock)
    builds: int = 0
    """How often it was registered again."""

    @property
    def key(self) -> str:
        """Its id."""
        return self.view.key

    @property
    def capture(self) -> Capture:
        """The camera that is corrected."""
        return self.view.capture

    @property
    def reference(self) -> Capture:
        """The camera that it is registered to."""
        return self.main.capture

    @property
    def built(self) -> Transform | None:
        """The map of the last build, reference px → target px of the band; None without one."""
        return self._built.get(self.band)

    @cached_property
    def _built(self) -> dict[str, Transform]:
        return _transforms(self.record, self.view.labels)

    @cached_property
    def _own(self) -> dict[str, Transform]:
        """Reference px → px of the reference camera's own bands, which colour moves a little."""
        return _transforms(self.main_record, self.main.labels)

    def labels(self, side: str, numbers: tuple[int, ...] = ()) -> list[str]:
        """Return the labels of bands by their numbers, one or three; without any that of the band shown.

        Raises
        ------
        OperationRefused
            Where there is no such band, or they are neither one nor three.
        """
        first, view = (
            (self.reference_band, self.main) if side == "reference" else (self.band, self.view)
        )
        if len(numbers) not in (0, 1, 3) or any(not 0 <= n < len(view.labels) for n in numbers):
            found = ", ".join(map(str, numbers))
            raise refused("unknown band", found, f"one or three below {len(view.labels)}")
        return [view.labels[n] for n in numbers] or [first]

    @property
    def px_per_mm(self) -> float | None:
        """Reference px per mm, where the object's size is known."""
        grid = self.record.get("grid", {})
        if not grid.get("px_per_mm"):
            return None
        slope = from_dict(grid["transform"]).jacobian(np.zeros((1, 2)))[0]
        return float(grid["px_per_mm"]) / float(np.sqrt(abs(np.linalg.det(slope))))

    @property
    def upright(self) -> int:
        """Degrees clockwise, a multiple of 90, by which the reference is turned to stand as on the grid."""
        grid = self.record.get("grid", {}).get("transform")
        if not grid:
            return 0
        slope = from_dict(grid).jacobian(np.zeros((1, 2)))[0]
        if np.linalg.det(slope) < 0:  # mirrored before it is turned
            slope = slope * np.array([[-1.0], [1.0]])
        return round(float(np.degrees(np.arctan2(slope[0, 1], slope[0, 0]))) / 90) * 90 % 360

    def renew(self, fresh: RegistrationView) -> None:
        """Take over what a new build recorded; corrections and undo stay."""
        with self.lock:
            self.record, self.main_record = fresh.record, fresh.main_record
            for name in ("_built", "_own"):
                self.__dict__.pop(name, None)
            self.builds += 1
            self.session.refresh(fresh.session.found)

    def forward(self, which: str) -> Transform:
        """Return the map of the last build (``"built"``), else of the pairs as they stand."""
        with self.lock:  # a picture may not be brought over by a map that an edit is replacing
            return self.built if which == "built" and self.built else self.session.view.forward

    def picture(self, which: str, label: str = "") -> ShownPicture:
        """Return a picture of the ``"reference"`` or of the ``"target"``, of the band shown unless another is named."""
        if which == "reference":
            return self.read(self.reference, label or self.reference_band)
        return self.read(self.capture, label or self.band)

    def tile(
        self,
        which: str,
        place: tuple[int, int, int],
        *,
        map_: str = "",
        bands: tuple[int, ...] = (),
    ) -> tuple[bytes, str]:
        """Return a tile of the ``reference``, of the ``target``, or of the target ``warped`` on to it.

        Parameters
        ----------
        place : (level, column, row)
        map_ : str
            As `forward` takes it.
        bands : tuple of int
            Numbers of one band, or of three as red, green and blue.

        Raises
        ------
        IndexError
            Where there is none.
        OperationRefused
            Where there is no such band.
        """
        if which not in ("reference", "target", "warped"):
            raise IndexError(which)
        side = "reference" if which == "reference" else "target"
        parts = [self._part(which, label, place, map_) for label in self.labels(side, bands)]
        inside = [valid for _, valid in parts if valid is not None]
        values = parts[0][0] if len(parts) == 1 else np.dstack([part for part, _ in parts])
        return encode(values, np.all(inside, axis=0) if inside else None)

    def _part(
        self, which: str, label: str, place: tuple[int, int, int], map_: str
    ) -> tuple[np.ndarray, np.ndarray | None]:
        """A tile of one band, and where it is known; the reference's other bands are placed by their own maps."""
        picture, size = self.picture(which, label), self.session.found.size
        if which == "target":
            return picture.tile(*place), None
        if which == "warped":
            return warped_tile(picture, self._forward_of(label, map_), size, *place)
        own = None if label == self.reference_band else self._own.get(label)
        return (
            (picture.tile(*place), None) if own is None else warped_tile(picture, own, size, *place)
        )

    def _forward_of(self, label: str, which: str) -> Callable[[np.ndarray], np.ndarray]:
        """The map of one band: pairs give that of the sensor, what colour adds is the last build's."""
        forward, built, here = self.forward(which), self.built, self._built.get(label)
        if built is None or here is None or label == self.band:
            return forward
        return (
            here
            if forward is built
            else lambda points: forward(points) + here(points) - built(points)
        )

    def partner(
        self,
        *,
        x: float,
        y: float,
        side: str,
        which: str = "",
        reach: float | None = None,
        bands: Mapping[str, tuple[int, ...]] | None = None,
    ) -> dict[str, Any]:
        """Find where a place of one picture lies in the other: by the map, and by comparing.

        Parameters
        ----------
        x, y : float
            Px of the picture of `side`.
        side : {"reference", "target"}
        which : {"built", ""}
            The map to begin with.
        reach : float, optional
            Reference px that the map may be off; by how well it fits without it.
        bands : mapping of side to numbers of bands, optional
            Whose pictures are compared; of three the first.

        Returns
        -------
        found : dict
            ``pair``; ``predicted`` by the map alone; ``score``; ``sure``; ``shift`` in reference px,
            ``shift_mm`` where the sampling is known.
        """
        forward, point = self.forward(which), np.array([x, y], float)
        if side == "target":
            back = forward.of if isinstance(forward, Inverse) else Inverse(forward)
            point = back(point[None])[0]
        predicted = forward(point[None])[0]
        if not (np.isfinite(point).all() and np.isfinite(predicted).all()):
            raise refused("the map does not cover this place", [x, y], "a place in both pictures")
        found = self._compared(forward, point, reach or self._reach(which), bands or {})
        place = np.array([x, y], float)
        pair = [*point, *found.target]
        if side == "target":
            # The person pointed into the target: what moves is the reference.
            pair = [*(point - np.array(found.shift)), *place]
        length = float(np.hypot(*found.shift))
        return {
            "pair": [round(float(v), 3) for v in pair],
            "predicted": [round(float(v), 3) for v in (*point, *predicted)],
            "shift": [round(v, 3) for v in found.shift],
            "length": round(length, 3),
            "length_mm": None if not self.px_per_mm else round(length / self.px_per_mm, 4),
            "score": round(found.score, 3),
            "sure": found.score >= SURE,
        }

    def snap(
        self, pair: list[float], bands: Mapping[str, tuple[int, ...]] | None = None
    ) -> dict[str, Any]:
        """Move the target of a pair to where its surroundings agree best; return the score."""
        start = np.array(pair, float)
        forward = _shifted(self.session.view.forward, start)
        found = self._compared(forward, start[:2], SNAP_PX, bands or {})
        if found.score < SURE:
            raise refused(
                "no similar place was found around this pair",
                f"score {found.score:.2f}",
                f"at least {SURE:g}",
            )
        self.session.apply("move", pair, [*pair[:2], *found.target])
        return {"score": round(found.score, 3)}

    def _compared(
        self,
        forward: Transform,
        point: np.ndarray,
        reach: float,
        bands: Mapping[str, tuple[int, ...]],
    ) -> Correlated:
        """Compare two bands around a place; what colour shifts in either of them is taken off again."""
        ours, theirs = (self.labels(side, bands.get(side, ())[:1])[0] for side in SIDES)
        here, there = point[None], forward(point[None])
        if ours != self.reference_band and ours in self._own:
            here = self._own[ours](point[None])
        shift = np.zeros(2)
        if theirs != self.band and self.built is not None and theirs in self._built:
            shift = (self._built[theirs](point[None]) - self.built(point[None]))[0]
        nearest_rows = np.concatenate([here[0], there[0] + shift])
        local = (
            _shifted(forward, nearest_rows, at=point)
            if np.isfinite(nearest_rows).all()
            else forward
        )
        pictures = self.picture("reference", ours), self.picture("target", theirs)
        found = find_partner(*pictures, local, nearest_rows[:2], reach=reach)
        x, y = np.array(found.target) - shift
        return replace(found, target=(float(x), float(y)))

    def export(self) -> tuple[str, bytes]:
        """Return the pairs as a CSV, its name first."""
        from levkas.registration.control_points import ControlPoints, format_points

        matches = self.session.view.matches
        points = ControlPoints(
            matches.reference,
            matches.target,
            enabled=matches.state != "removed",
            check=matches.state == "check",
        )
        parts = [self.capture.object, self.view.frame]
        stem = "_".join(parts if self.view.is_first else [*parts, self.view.sensor.name])
        return f"{stem}.csv", format_points(points)

    def take(self, data: bytes) -> dict[str, Any]:
        """Add the pairs of a file: those that are there already stay as they are."""
        from levkas.registration.control_points import parse_points
        from levkas.registration.manual_points import nearest_rows

        points = parse_points(data)
        rows = np.hstack([points.reference, points.target])
        matches = self.session.view.matches
        here = np.hstack([matches.reference, matches.target]).reshape(-1, 4)
        new = (nearest_rows(rows, here) < 0) & np.asarray(points.enabled, bool)
        check = np.asarray(points.check, bool)
        self.session.add_all(
            [tuple(row) for row in rows[new & ~check].tolist()],
            [tuple(row) for row in rows[new & check].tolist()],
        )
        return {"imported": int(new.sum()), "known": int((~new).sum())}

    def _reach(self, which: str) -> float:
        """How far the map may be off: much where it rests on few pairs."""
        if which == "built" and self.built:
            return REACH_PX
        kept = int(self.session.view.matches.kept.sum())
        return REACH_PX if kept >= FEW else max(REACH_PX, WIDE_SHARE * max(self.session.found.size))


def _shifted(forward: Transform, pair: np.ndarray, at: np.ndarray | None = None) -> Transform:
    """The map near a place (`at`, else the pair's own), shifted so that it leads through a pair."""
    from levkas.geometry.transforms import Affine

    slope = forward.jacobian((pair[:2] if at is None else at)[None])[0]
    return Affine(np.column_stack([slope, pair[2:] - slope @ pair[:2]]))


def _transforms(record: dict[str, Any], labels: list[str]) -> dict[str, Transform]:
    """The maps of bands in a record, reference px → px of the band."""
    bands = record.get("bands", {})
    return {label: from_dict(bands[label]["transform"]) for label in labels if label in bands}


@dataclass(frozen=True)
class SensorView:
    """One sensor of a capture; most cameras have one. Or of a tile; one of the reference's is seen beside a neighbour.

    Parameters
    ----------
    capture : Capture
    sensor : SensorFrames
    beside : Capture or None
        The neighbour.
    number : int
        Of the neighbour among the tiles, from 0.
    """

    capture: Capture
    sensor: SensorFrames
    beside: Capture | None = None
    number: int = 0

    @property
    def key(self) -> str:
        """Id."""
        own = id_of(
            self.capture.object, self.capture.frame, "" if self.is_first else self.sensor.name
        )
        return f"{own}-{self.number}" if self.beside else own

    @property
    def frame(self) -> str:
        """How edits.toml names it, but for the band: ``d80``, ``xray#left``, ``d80#r2c3#r2c2``."""
        return self.capture.frame + (f"#{self.beside.tile}" if self.beside else "")

    @property
    def is_first(self) -> bool:
        """Whether edits.toml names it by its camera alone."""
        return self.sensor == self.capture.sensors[0]

    @property
    def labels(self) -> list[str]:
        """Labels of its bands."""
        return [band.label for band in self.sensor.bands]


def id_of(name: str, layer: str, sensor: str = "") -> str:
    """Return the id of a camera of an object, of its first sensor unless another is named.

    >>> id_of("icon1", "d80"), id_of("icon1", "msbs", "ccd2") == id_of("icon1", "msbs")
    ('081b6cfe9096', False)
    """
    parts = [name, layer, sensor] if sensor else [name, layer]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:12]


def sensor_of(capture: Capture, band: str) -> SensorFrames:
    """Return the sensor that recorded a band; the first where none did."""
    found = (s for s in capture.sensors if any(b.label == band for b in s.bands))
    return next(found, capture.sensors[0])
