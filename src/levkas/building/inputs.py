"""What a stage is made of: the keys that it reads by the schema, the files that these name, frames, and what it is made from.

A stage is given a campaign in which all other keys have their defaults (`limited`): whatever it can see is in its fingerprint.
"""

from __future__ import annotations

import hashlib
import json
import os
from dataclasses import astuple, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

from levkas.building.build_records import UNREADABLE, Key
from levkas.building.graph import captures_of
from levkas.campaign.discovery.captures import Capture
from levkas.campaign.schema.tables import (
    CALIBRATE,
    CAMERA,
    FACT,
    LIGHT,
    NATIVE,
    PLAN,
    REGISTER,
    REPORT,
    Table,
)
from levkas.core.internal_errors import CODE as INTERNAL
from levkas.registration.methods import DEFAULT_METHOD, code_of
from levkas.stages.control_points import fingerprint_points
from levkas.stages.sources import made_with

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Mapping, Sequence

    from levkas.building.build_records import BuildRecords
    from levkas.building.graph import Task
    from levkas.building.hashes import Hashes
    from levkas.campaign.campaign import Campaign
    from levkas.campaign.discovery.captures import FrameRef
    from levkas.core.problems import Problem
    from levkas.database.layout import LayerId

T = TypeVar("T", bound=Table)
CALIBRATION = (PLAN, CALIBRATE, LIGHT, NATIVE, FACT)
REGISTRATION = (*CALIBRATION, REGISTER)
"""Keys that a calibration is given; a registration and a resampling."""
ROLES = ("object", "dark", "white", "chart")
WRITTEN = "written: "
"""Begins what a stage writes about its pixels, which is written anew while these stay."""


def limited(table: T, readers: Collection[str]) -> T:
    """Return a table in which keys that others than `readers` read have their defaults.

    >>> from levkas.campaign.schema.tables import ObjectFacts
    >>> limited(ObjectFacts(title="Saint", medium="oil"), {FACT}).museum_facts()["medium"]
    ''
    """
    kept: dict[str, Any] = {}
    for key, field in type(table).model_fields.items():
        value = getattr(table, key)
        if isinstance(value, Table):
            value = limited(value, readers)
        elif isinstance(value, dict) and any(isinstance(one, Table) for one in value.values()):
            value = {name: limited(one, readers) for name, one in value.items()}
        elif table.reader_of(key) not in readers:
            value = field.get_default(call_default_factory=True)
        kept[key] = value
    return type(table).model_construct(**kept)


def declared(
    table: Table, readers: Collection[str], named: Mapping[str, str], where: str = ""
) -> Iterator[tuple[str, Any]]:
    """Yield path and value of the keys that some readers read, declared or by default.

    Of a table of tables it is the one that is `named`: ``{"cameras": "d80"}``.
    """
    for key in type(table).model_fields:
        value, path, name = getattr(table, key), f"{where}{key}", named.get(key, "")
        if isinstance(value, dict):
            value, path = value.get(name), f"{path}.{name}"
        if isinstance(value, Table):
            yield from declared(value, readers, named, f"{path}.")
        elif table.reader_of(key) in readers and value not in (None, "", (), {}):
            yield path, value


def read_by(
    readers: Collection[str], campaign: Campaign, capture: Capture, hashes: Hashes
) -> dict[str, Any]:
    """Return the keys of a capture that some readers read, and the hashes of the files that they name."""
    camera, white = campaign.cameras.get(capture.camera), campaign.targets.white
    chart = camera.white_chart if camera else None
    board = any(sensor.white for sensor in capture.sensors)
    by_table = chart or (white and board and isinstance(white.reflectance, str))
    setup = capture.setup or campaign.campaign.setup or "default"
    named = {
        **{"cameras": capture.camera, "objects": capture.object, "setups": setup},
        **{"traps": capture.object, "charts": chart.chart if chart else ""},
    }
    wanted = {*readers} - ({LIGHT} if CALIBRATE in readers and not by_table else set())
    found = {
        path: value
        for path, value in declared(campaign, wanted, named)
        if board or not path.startswith("targets.white.")
    }
    return found | files_named(campaign, found.values(), hashes)


def files_named(campaign: Campaign, values: Collection[Any], hashes: Hashes) -> dict[str, str]:
    """Return the hashes of the files beside campaign.toml that some values name."""
    names = [value for value in values if isinstance(value, str)]
    there = (name for name in names if os.path.isfile(campaign.root / name))  # noqa: PTH113 -- any text is asked for
    return {f"file {name}": hashes(campaign.root / name) for name in there}


class Inputs:
    """Fingerprints of the tasks of captures, and digests of them for the tasks that read their products.

    Where `unread`, frames of layers that were never begun need not be read, as for `status`.
    """

    def __init__(self, campaign: Campaign, records: BuildRecords, *, unread: bool = False) -> None:
        self.campaign, self.records, self._unread = campaign, records, unread
        self.digests: dict[Key, str] = {}

    def of(self, task: Task, lost: Collection[LayerId]) -> dict[str, Any]:
        """Return the fingerprint of a task; those that it reads have had theirs. Of `lost` layers there are none of this build."""
        try:
            prints = self._prints(task, lost)
        except Exception as error:  # the stage meets it again, and is refused for it
            prints = {UNREADABLE: f"{type(error).__name__}: {error}"}
        self.digests[task.key] = digest(prints)
        return prints

    def _prints(self, task: Task, lost: Collection[LayerId]) -> dict[str, Any]:
        (capture, _), hashes = captures_of(task), self.records.hashes
        if task.key.stage == "calibrate":
            if self._unread and not self.records.is_begun(task.key):
                return {}
            own = of_calibration(self.campaign, capture, hashes)
        elif task.key.stage == "register":
            own = of_registration(self.campaign, capture, hashes)
        else:
            own = {}
        made_of = {
            f"{key.layer} {key.stage}": self._made_of(key, lost)
            for key in (*task.needs, *task.uses)
        }
        has_facts = task.key.stage != "calibrate" or self.campaign.database.native
        facts = read_by((FACT,), self.campaign, capture, hashes) if has_facts else {}
        said = {f"{WRITTEN}{path}": value for path, value in facts.items()}
        return plain({**made_with(), **own, **made_of, **said})

    def _made_of(self, key: Key, lost: Collection[LayerId]) -> str:
        """Return what the products of a task that is read are made of; of a lost layer those of an earlier build."""
        if key.of in lost:
            made = self.records.fingerprint(key)
            return digest(made) if made else ""
        return self.digests.get(key, "")


def digest(prints: dict[str, Any]) -> str:
    """Hash what pixels are made of, so that what depends on them can name it: neither facts nor whether native ones are written.

    >>> digest({"written: campaign.licence": "CC0"}) == digest({"database.native": True})
    True
    """
    prints = without(prints, (WRITTEN, "database."))
    text = json.dumps(prints, sort_keys=True, ensure_ascii=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:16]


def without(prints: dict[str, Any], beginnings: tuple[str, ...] = (WRITTEN,)) -> dict[str, Any]:
    """Return a fingerprint without what begins with one of some texts."""
    return {k: v for k, v in prints.items() if not k.startswith(beginnings)}


def of_calibration(campaign: Campaign, capture: Capture, hashes: Hashes) -> dict[str, Any]:
    """Return what a calibration reads: keys, what the plan found of each sensor, and every file of its frames."""
    prints = read_by((CALIBRATE, LIGHT, NATIVE), campaign, capture, hashes)
    where = f"cameras.{capture.camera}.sensors"
    if len(capture.sensors) > 1:  # bands are in their order, and the first is the others' frame
        prints[where] = [sensor.name for sensor in capture.sensors]
    for sensor in capture.sensors:
        bands = [[str(value) for value in astuple(band)] for band in sensor.bands]
        found = {k: v for k, v in vars(sensor).items() if k not in (*ROLES, "name") and v}
        here = f"{where}.{sensor.name}" if sensor.name else f"cameras.{capture.camera}"
        prints |= {f"{here}.{k}": v for k, v in {**found, "bands": bands}.items()}
    for name, role, frame in frames_of(capture):
        files = {relative(campaign, path): h for path, h in hashes.of_frame(frame.path).items()}
        # A file may be several frames: pages, or a dark of two sensors.
        uses = prints.setdefault(f"frame {next(iter(files))}", [])
        uses.append(use_of(name, role, frame))
        prints |= {f"file {path}": content for path, content in files.items()}
    return prints


def frames_of(capture: Capture) -> Iterator[tuple[str, str, FrameRef]]:
    """Yield sensor, role and frame of all frames of a capture."""
    for sensor in capture.sensors:
        for role in ROLES:
            for frame in getattr(sensor, role):
                yield sensor.name, role, frame


def use_of(sensor: str, role: str, frame: FrameRef) -> dict[str, Any]:
    """Return what a frame is used for, as its name or a manifest says; all else it says itself."""
    use = {"role": role, **vars(frame), "sensor": sensor}
    return {k: v for k, v in use.items() if k not in ("path", "target") and v not in (None, "")}


def of_registration(campaign: Campaign, capture: Capture, hashes: Hashes) -> dict[str, Any]:
    """Return what a registration reads beside its bands: keys, tables of points and tiles, and what a hand corrected."""
    found = read_by((REGISTER,), campaign, capture, hashes)
    merged = (
        "edits",
        f"objects.{capture.object}.outline",
    )  # frame by frame, and in this order, below
    prints = {k: v for k, v in found.items() if "registration." not in k and k not in merged}
    options = campaign.registration_of(capture.camera)
    prints |= {f"registration.{key}": value for key, value in options.items()}
    if code := code_of(options.get("method") or DEFAULT_METHOD):
        prints["code of the registration method"] = code
    if corners := campaign.outline_of(capture.object)[0]:
        prints["outline of the object"] = [list(corner) for corner in corners]
    name, layer, edits = capture.object, capture.layer, campaign.edits
    tiles = {f"{layer}#{tile}": by_band for tile, by_band in edits.of_tiles(name, layer).items()}
    for frame, bands in {layer: edits.of_layer(name, layer), **tiles}.items():
        for band, edited in bands.items():
            where = f"edits.toml: correction of {frame}{f':{band}' if band else ''}"
            prints[where] = edited.describe()
    return prints | fingerprint_points(campaign, capture)


def of_report(
    campaign: Campaign,
    name: str,
    layers: dict[str, str],
    captures: Sequence[Capture],
    hashes: Hashes,
) -> dict[str, Any]:
    """Return what the page of an object is made of: its layers in their order, facts, lights, and what is declared of errors."""
    order = [capture.layer for capture in captures]
    prints: dict[str, Any] = {**made_with(), "order of layers": order}
    prints |= {f"layer {layer}": value for layer, value in layers.items()}
    readers = (FACT, REPORT, CAMERA, NATIVE, *((LIGHT,) if len(captures) > 1 else ()))  # compared
    for capture in (Capture(name, "", "", ()), *captures):
        prints |= read_by(readers, campaign, capture, hashes)
    for layer in order:
        if word := campaign.edits.confirmed.get((name, layer)):
            prints[f"edits.toml: confirmation of {layer}"] = dict(word)
    prints["campaign.reference"] = campaign.reference.model_dump()
    return plain(prints)


def relative(campaign: Campaign, path: Any) -> str:
    """Return the name of a file from the campaign's folder; of one elsewhere its last parts."""
    try:
        return str(path.relative_to(campaign.root).as_posix())
    except ValueError:
        return "/".join(path.parts[-3:])


def written(campaign: Campaign, problem: Problem) -> str:
    """Return a problem as a database holds it: its text is the same for any folder of the campaign."""
    file = problem.file
    if file and Path(file).is_absolute():
        file = relative(campaign, Path(file))
    fix = None if problem.code == INTERNAL else problem.fix  # where its report lies on this machine
    return str(replace(problem, file=file, fix=fix)).replace(f"{campaign.root}{os.sep}", "")


def plain(prints: dict[str, Any]) -> dict[str, Any]:
    """Return what JSON would make of it, so that a stored fingerprint equals a new one."""
    return dict(json.loads(json.dumps(prints, default=str)))
