"""All registrations of a campaign that the screen can open, by id."""

from __future__ import annotations

import csv
import io
import threading
from dataclasses import dataclass, field, replace
from datetime import date
from functools import cached_property, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.captures import Capture
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.edits import (
    FILE_NAME,
    Edits,
    FrameEdits,
    Outline,
    change_confirmation,
    change_edits,
    change_outline,
    read_edits,
)
from levkas.core.problems import Problem, Refused
from levkas.core.text import read_json
from levkas.database.layout import Places
from levkas.database.registrations import apply_confirmation, digest_of_map, unchecked_share
from levkas.pages.page import describe_decision
from levkas.registration.methods import method_of
from levkas.registration.record import COLUMNS, DECISIONS, Matches, decided
from levkas.stages.native_files import part_name
from levkas.workbench.frame import RegistrationView, SensorView, id_of, sensor_of
from levkas.workbench.pictures import ShownPicture, read_picture
from levkas.workbench.session import CorrectionSession, OperationRefused, RecordedPairs
from levkas.workbench.tiles import (
    is_placed,
    joined,
    neighbours,
    record_of_neighbour,
    record_of_tile,
)

if TYPE_CHECKING:
    from collections.abc import Mapping

    from levkas.campaign.campaign import Campaign

MOST_PICTURES = 8
FEW_BANDS = 4


class FrameMissing(Refused):
    """There is no such camera, or it was not built yet."""


@dataclass
class Library:
    """A campaign's cameras; corrections of any of them go into one edits.toml.

    Parameters
    ----------
    path : Path
        The campaign.
    output : Path, optional
        The database, instead of the campaign's own.
    """

    path: Path
    output: Path | None = None
    _frames: dict[str, RegistrationView] = field(default_factory=dict)
    _pictures: dict[tuple[str, str], ShownPicture] = field(default_factory=dict)
    _lock: threading.RLock = field(default_factory=threading.RLock)
    turns: dict[str, int] = field(default_factory=dict)
    """By how many degrees clockwise a person turned the pictures of an object."""

    @cached_property
    def campaign(self) -> Campaign:
        """The campaign as it was when the library was opened."""
        return load_campaign(self.path)

    @cached_property
    def captures(self) -> list[Capture]:
        """Every camera of every object."""
        return find_captures(self.campaign)[0]

    @cached_property
    def views(self) -> dict[str, SensorView]:
        """Id → a sensor of a camera of an object: the first of every camera, then those that have a map of their own.

        Of a camera of tiles, a sensor of every tile; before those of the reference, all of them joined.
        """
        views: dict[str, SensorView] = {}
        for capture in self.captures:
            leads = self._leads(capture)
            for one in [capture] * (leads or not capture.tiles) + list(capture.tiles):
                of_one = self._views_of(one)
                views |= {v.key: v for v in (of_one[:1] if leads and capture.tiles else of_one)}
        return views

    def view_of(self, key: str) -> SensorView:
        """Return what an id names; of a tile of the reference it says beside which neighbour.

        Raises
        ------
        FrameMissing
            Where there is no such id.
        """
        own, _, number = key.partition("-")
        view = self.views.get(own)
        if view is None:
            raise FrameMissing(Problem("E_NO_FRAME", "unknown camera", found=key[:40]))
        if not (view.capture.tile and self._leads(view.capture)):
            return view
        tiles = self._whole(view.capture).tiles
        at = int(number) if number.isascii() and number.isdigit() else -1
        if not 0 <= at < len(tiles) or tiles[at].tile == view.capture.tile:
            at = self._beside(view, self._record(view.capture))
        return replace(view, beside=tiles[at], number=at)

    def neighbours(self, view: SensorView) -> list[dict[str, Any]]:
        """Return the tiles beside which a tile of the reference can be placed, the best first: id, name, and whether it is placed itself."""
        if view.beside is None:
            return []
        whole, record = self._whole(view.capture), self._record(view.capture)
        found = []
        for number in neighbours(whole, view.capture.tile, record):
            other = whole.tiles[number]
            key = replace(view, beside=other, number=number).key
            placed = is_placed(record, other.tile)
            found.append({"id": key, "tile": other.tile, "placed": placed})
        return found

    def _beside(self, view: SensorView, record: Mapping[str, Any]) -> int:
        """Return the number of the neighbour of a tile: the one beside which a person set pairs, else the best."""
        whole, capture = self._whole(view.capture), view.capture
        corrected = read_edits(self.edits_path).of_tiles(capture.object, capture.layer)
        ranked = neighbours(whole, capture.tile, record)
        chosen = (n for n in ranked if f"{capture.tile}#{whole.tiles[n].tile}" in corrected)
        return next(chosen, ranked[0])

    def _whole(self, capture: Capture) -> Capture:
        """The capture that a tile is part of."""
        same = (c for c in self.captures if (c.object, c.layer) == (capture.object, capture.layer))
        return next(same)

    def _leads(self, capture: Capture) -> bool:
        """Whether a capture, or that of a tile, is the reference's."""
        return capture.camera == self.campaign.reference.camera and not capture.setup

    def _views_of(self, capture: Capture) -> list[SensorView]:
        # A method that fits one map for all sensors of a camera has pairs of the first one alone.
        method = method_of(self.campaign.registration_of(capture.camera))
        sensors = capture.sensors if method.per_sensor else capture.sensors[:1]
        views = [SensorView(capture, sensor) for sensor in sensors]
        if not self._leads(capture):
            return views
        band = self.campaign.reference.band
        own = [v for v in views if band in v.labels] or views[:1]
        return own + [view for view in views if view not in own]

    @cached_property
    def places(self) -> Places:
        """Paths of the database."""
        return Places(self.output.resolve() if self.output else self.campaign.output)

    @property
    def edits_path(self) -> Path:
        """edits.toml."""
        return self.campaign.root / FILE_NAME

    def turn_of(self, frame: RegistrationView) -> int:
        """Return by how many degrees clockwise the pictures of a camera are turned: as a person did, else upright."""
        return self.turns.get(frame.capture.object, frame.upright)

    def registered_with(self, frame: RegistrationView) -> dict[str, Any]:
        """Return the corrections with which a camera was registered last, in words, and the declared outline; None where nothing says."""
        from levkas.building.build_records import BuildRecords, key_of

        view, capture = frame.view, frame.capture
        records = BuildRecords(self.places.kept, self.places.output)
        prints = records.fingerprint(key_of(capture, "register"))
        edits = read_edits(self.edits_path).of_layer(capture.object, view.frame)
        band = self._band_of(view, edits)
        name = f"edits.toml: correction of {view.frame}{f':{band}' if band else ''}"
        outline = [] if view.beside else prints.get("outline of the object", [])
        return {
            "registered": str(prints.get(name, "")) if prints else None,
            "registered_outline": outline if prints else None,
        }

    def declared_outline(self, frame: RegistrationView) -> Outline:
        """Return the outline that campaign.toml declares of an object, reference px; none where it does not, nor beside a neighbour."""
        if frame.view.beside:
            return ()
        facts = self.campaign.objects.get(frame.capture.object)
        return (facts.outline if facts else None) or ()

    def judge(self, frame: RegistrationView) -> None:
        """Give a camera's record the verdict of by now; `layer` is the decision on the whole layer, `map` the digest of its map."""
        record = self._judged(self._whole(frame.capture), read_edits(self.edits_path))
        verdict = (frame.record if frame.capture.tile else record)["verdict"]
        layer = {"layer": record["verdict"]["decision"], "map": digest_of_map(record)}
        frame.record["verdict"] = verdict | layer

    def confirm(self, frame: RegistrationView, name: str | None, words: str, map_: str) -> None:
        """Accept a doubtful layer in a person's name, without one take that back; raises OperationRefused for any other layer or map."""
        from levkas.campaign.schema.tables import ConfirmKeys

        whole = self._whole(frame.capture)
        record = self._judged(whole, Edits())
        decision = record["verdict"]["decision"]
        if name is not None and (decision != "warn" or map_ != digest_of_map(record)):
            why = "only a doubtful layer can be confirmed, as it was registered last"
            raise OperationRefused(Problem("E_VALUE", why, found=DECISIONS[decision]))
        camera, day = f"{whole.object}/{whole.layer}", date.today().isoformat()
        given = {"camera": camera, "name": name, "date": day, "words": words, "map": map_}
        word = None if name is None else ConfirmKeys.model_construct(None, **given)
        change_confirmation(self.edits_path, whole.object, whole.layer, word)

    def _judged(self, capture: Capture, edits: Edits) -> dict[str, Any]:
        """Return the record of a layer with what a person says of it; empty where it was not built."""
        record = self._record(capture)
        return record and record | {
            "verdict": apply_confirmation(
                record, edits.confirmed.get((capture.object, capture.layer))
            )
        }

    def list(self) -> list[dict[str, Any]]:
        """Return every camera, or tile of one, with the verdict of its last build, JSON-ready."""
        listed = []
        edits = read_edits(self.edits_path)
        records: dict[tuple[str, str], dict[str, Any]] = {}
        for view in self.views.values():
            capture = view.capture
            where = capture.object, capture.layer
            whole = records[where] = records.get(where) or self._judged(capture, edits)
            if capture.tile and self._leads(capture):
                number = self._beside(view, whole)
                view = replace(view, beside=self._whole(capture).tiles[number], number=number)
            record = whole.get("tiles", {}).get(capture.tile) if capture.tile else whole
            record = record or whole
            verdict = record.get("verdict", {"decision": "not built"})
            decision, reasons = verdict["decision"], verdict.get("reasons", [])
            is_reference = self._is_reference(view)
            facts = self.campaign.objects.get(capture.object)
            listed.append(
                {
                    "id": view.key,
                    "object": capture.object,
                    "title": (facts.title if facts else "") or capture.object,
                    "camera": capture.camera,
                    "setup": capture.setup,
                    "tile": capture.tile,
                    "sensor": view.sensor.name if len(capture.sensors) > 1 else "",
                    "bands": _name_bands(view.labels),
                    "reference": is_reference,
                    "decision": decision,
                    "verdict": describe_decision(
                        "reference" if is_reference else decided(verdict),
                        unchecked_share(record),
                    ),
                    "reason": next(iter(reasons), ""),
                    "corrections": self._edits(view, edits).describe(),
                }
            )
        return listed

    def open(self, key: str) -> RegistrationView:
        """Open a camera, or return it if it is open.

        Raises
        ------
        FrameMissing
            Where there is no such id, or nothing of it was built yet.
        """
        with self._lock:
            if key not in self._frames:
                view = self.view_of(key)
                key = view.key
            if key not in self._frames:
                self._frames[key] = self._opened(view)
            return self._frames[key]

    def catch_up(self, frame: RegistrationView) -> None:
        """Take over what others wrote into edits.toml of a camera; the frame's lock is held by the caller."""
        edits = read_edits(self.edits_path)
        outline = () if frame.view.beside else edits.outlines.get(frame.capture.object, ())
        frame.session.take(self._edits(frame.view, edits), outline)

    def reopen(self, key: str) -> None:
        """Read the records of an object anew after a build; corrections and undo stay."""
        with self._lock:
            name = self.view_of(key).capture.object
            for (
                capture
            ) in self.captures:  # where tiles lie may have changed, and with it the mosaic
                if capture.object == name and capture.tiles:
                    own = id_of(capture.object, capture.frame)
                    for one in [k for k in self._pictures if k[0] == own]:
                        del self._pictures[one]
            for each in [k for k in self._frames if self.view_of(k).capture.object == name]:
                old = self._frames.pop(each)
                old.renew(self.open(each))
                self._frames[each] = old

    def picture(self, capture: Capture, band: str) -> ShownPicture:
        """Return one band as a picture; the last few are kept."""
        key = (id_of(capture.object, capture.frame), band)
        with self._lock:
            if key not in self._pictures:
                path, page = self._page(capture, band)
                self._pictures[key] = read_picture(path, page)
                while len(self._pictures) > MOST_PICTURES:
                    self._pictures.pop(next(iter(self._pictures)))
            self._pictures[key] = self._pictures.pop(key)
            return self._pictures[key]

    def _page(self, capture: Capture, band: str) -> tuple[Path, int]:
        for sensor in capture.sensors:
            labels = [b.label for b in (capture if capture.tiles else sensor).bands]
            if band in labels:
                name = "" if capture.tiles else part_name(capture, sensor.name)
                where = capture.object, capture.camera, capture.setup, name
                place = self.places.native(*where)
                if not place.is_file():
                    place = self.places.native(*where, folder=self._folder(capture))
                return place, labels.index(band)
        raise FrameMissing(Problem("E_BAND_MISSING", "unknown band", found=band))

    def _folder(self, capture: Capture) -> Path:
        """Return where the native pixels of a capture or of a tile are beside the database, or its tiles joined."""
        if capture.tiles:
            with self._lock:
                return joined(capture, self.campaign, self.places)
        if capture.tile:
            return self.places.kept_native(capture.object, capture.layer)
        from levkas.building.run import calibrate_aside

        with self._lock:
            return calibrate_aside(capture, self.campaign, self.places)

    def _opened(self, view: SensorView) -> RegistrationView:
        capture = view.capture
        record, reference = self._record(capture), view.beside or self._reference(capture)
        main_record = self._record(reference)
        if capture.tile and record:
            main_record = record_of_neighbour(record, view) if view.beside else main_record
            record = record_of_tile(record, view, self._sizes(view))
        if not record or "reference" not in record:
            raise FrameMissing(
                Problem(
                    "E_NOT_BUILT",
                    f"{capture.object}/{capture.layer} has not been built yet",
                    fix=f"Run: levkas build {self.campaign.root}",
                )
            )
        band = record["target"]["band"]
        if band not in view.labels:
            band = view.labels[len(view.labels) // 2]
        ours = record["reference"]
        size = record["bands"].get(band, {}).get("size")
        shape = size[::-1] if size else self._shape(self._page(capture, band)[0])
        keys = self.campaign.registration_of(capture.camera)
        found = RecordedPairs.of(
            self._matches(view),
            size=(int(ours["size"][0]), int(ours["size"][1])),
            target_size=(shape[1], shape[0]),
            reject=keys.get("reject"),
            stop=keys.get("stop", 1.0),
        )
        edits = read_edits(self.edits_path)
        session = CorrectionSession(
            found,
            self._edits(view, edits),
            partial(self._save, view),
            () if view.beside else edits.outlines.get(capture.object, ()),
            _no_outline
            if view.beside
            else partial(change_outline, self.edits_path, capture.object),
        )
        main = SensorView(reference, sensor_of(reference, str(ours["band"])))
        return RegistrationView(
            view, main, record, main_record, session, band, str(ours["band"]),
            self.picture,
        )  # fmt: skip

    def _sizes(self, view: SensorView) -> tuple[tuple[int, int], tuple[int, int]]:
        """(width, height) of the neighbour and of the tile, px."""
        shapes = [
            self._shape(self._page(part, view.labels[0])[0])
            for part in (view.beside or view.capture, view.capture)
        ]
        (height, width), (down, across) = shapes
        return (width, height), (across, down)

    def _shape(self, path: Path) -> tuple[int, int]:
        from levkas.database.tiff_pages import open_pages

        return open_pages(path).shape[:2]

    def _reference(self, capture: Capture) -> Capture:
        wanted = self.campaign.reference.camera
        mine = (c for c in self.captures if c.object == capture.object)
        return next((c for c in mine if c.camera == wanted and not c.setup), capture)

    def _is_reference(self, view: SensorView) -> bool:
        """Whether all others are registered to this sensor."""
        reference = self._reference(view.capture)
        if view.capture.frame != reference.layer:
            return False
        wanted = self._record(reference).get("reference", {}).get("band", "")
        return sensor_of(reference, wanted or self.campaign.reference.band or "") == view.sensor

    def _record(self, capture: Capture) -> dict[str, Any]:
        path = self.places.registration(capture.object, capture.layer)
        try:
            return read_json(path)
        except Refused:
            return {}

    def _matches(self, view: SensorView) -> Matches:
        capture, sensor = view.capture, view.sensor.name
        where = capture.object, capture.layer
        path = self.places.matches(*where, part_name(capture, sensor))
        if view.is_first and not path.is_file():
            path = self.places.matches(*where, part_name(capture, ""))
        text = path.read_text(encoding="utf-8") if path.is_file() else ""
        return parse_matches(text)

    def _edits(self, view: SensorView, edits: Edits) -> FrameEdits:
        of_layer = edits.of_layer(view.capture.object, view.frame)
        return of_layer.get(self._band_of(view, of_layer), FrameEdits())

    def _band_of(self, view: SensorView, edits: Mapping[str, FrameEdits]) -> str:
        """Return the band by which edits.toml names a sensor: "" for the first, else as it has done so far, or by the band shown."""
        named = [band for band in edits if band in view.labels]
        return named[0] if named else "" if view.is_first else view.labels[len(view.labels) // 2]

    def _save(self, view: SensorView, before: FrameEdits, after: FrameEdits) -> FrameEdits:
        """Write a change into edits.toml; return the corrections of the camera that the file then holds."""
        capture = view.capture

        def frame_of(edits: Edits) -> str:
            band = self._band_of(view, edits.of_layer(capture.object, view.frame))
            return f"{view.frame}:{band}" if band else view.frame

        return change_edits(self.edits_path, capture.object, frame_of, before, after)


def _no_outline(before: Outline, after: Outline) -> Outline:
    fix = "Draw it over the reference, with another camera or with the whole reference."
    raise OperationRefused(Problem("E_VALUE", "a tile has no outline of its own", fix=fix))


def _name_bands(labels: list[str]) -> str:
    """Name the bands of a sensor: a few each, many by the first and the last.

    >>> _name_bands(["R1", "G1", "B1"]), _name_bands([f"{w} nm" for w in range(400, 701, 10)])
    ('R1, G1, B1', '400–700 nm, 31 bands')
    """
    if len(labels) <= FEW_BANDS:
        return ", ".join(labels)
    start = labels[0].removesuffix(" nm") if labels[-1].endswith(" nm") else labels[0]
    return f"{start}–{labels[-1]}, {len(labels)} bands"


def parse_matches(text: str) -> Matches:
    """Read CAMERA.matches.csv.

    >>> len(parse_matches(""))
    0
    """
    rows = list(csv.DictReader(io.StringIO(text)))

    def numbers(*names: str) -> np.ndarray:
        values = [[float(row[n]) if row[n] else np.nan for n in names] for row in rows]
        return np.array(values, float).reshape(len(rows), len(names))

    return Matches(
        reference=numbers(*COLUMNS[:2]),
        target=numbers(*COLUMNS[2:4]),
        residual=numbers("residual")[:, 0],
        leave_one_out=numbers("leave_one_out")[:, 0],
        weight=numbers("weight")[:, 0],
        state=np.array([row["state"] for row in rows], object),
        reason=np.array([row["reason"] for row in rows], object),
        round=np.array([int(row["round"] or -1) for row in rows], int),
    )
