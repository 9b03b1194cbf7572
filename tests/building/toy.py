"""Stages that write a line of text: what is fresh, refused, killed and in which order does not depend on what a stage computes.

A product names all that it was made of, so that a build that leaves out a stale stage is seen in its bytes. A frame
whose bytes end with ``#STAGE:WHAT`` makes that stage of its capture raise: a code refuses it, the name of an exception
raises that.
"""

from __future__ import annotations

import builtins
import hashlib
import json
import re
import shutil
from pathlib import Path

import every_kind

from levkas.building import (
    camera_reports,
    outcomes,
    records_file,
    report_pages,
    run,
    summarise,
    tasks,
)
from levkas.core import files
from levkas.core.digests import hash_file
from levkas.core.problems import Problem, Refused
from levkas.database.catalogue import Entry
from levkas.stages.written import Written

CAMERAS = ("photo", "xray", "filters", "colour", "twin", "scan")
KEYS = ("kind", "bits", "black", "saturation", "exposures", "denoise", "demosaic")
FACTS = ("creator", "date", "licence")
SPOILT = re.compile(rb"#(\w+):(\w+)$")


def make(folder, objects=("one", "two"), cameras=CAMERAS):
    """Write a campaign whose frames have a few pixels."""
    return every_kind.make(folder, objects, cameras, size=(24, 20))


def spoil(path, stage, what):
    """Make a stage of the capture that has this frame raise, until `heal`."""
    heal(path)
    path.write_bytes(path.read_bytes() + f"#{stage}:{what}".encode())


def heal(path):
    path.write_bytes(SPOILT.sub(b"", path.read_bytes()))


def _frames(capture):
    for sensor in capture.sensors:
        for role in ("object", "dark", "white", "chart"):
            for frame in getattr(sensor, role):
                use = role, sensor.name, frame.band, frame.wavelength, frame.exposure_s
                yield (
                    use,
                    frame.path.with_suffix(
                        ".raw" if frame.path.suffix == ".hdr" else frame.path.suffix
                    ),
                )


def _require(task):
    for _, path in _frames(task.capture):
        found = SPOILT.search(path.read_bytes())
        if found and found[1].decode() == task.key.stage:
            what = found[2].decode()
            error = getattr(builtins, what, None)
            raise (
                error("planted")
                if error
                else Refused(Problem(what, "planted", str(path), fix="Heal it."))
            )


def _hash(*parts):
    return hashlib.sha256(json.dumps(parts, default=str, sort_keys=True).encode()).hexdigest()


class Toys:
    """The three stages: `tasks.Stages.do` of a build, with what its `Stages` knows."""

    def __init__(self):
        self.computed, self.disk_is_full = [], False

    def __call__(self, stages, task):
        self.computed.append(
            " ".join(part for part in (task.key.object, task.key.layer, task.key.stage))
        )
        _require(task)
        return getattr(self, task.key.stage)(stages, task)

    def text(self, stages, capture):
        """Return what was calibrated: still in memory, or as it was kept."""
        held = getattr(stages, "toy", None)
        if held and held[0] is capture:
            return held[1]
        return (stages.places.kept / capture.object / capture.layer / "calibrated.txt").read_text()

    def calibrate(self, stages, task):
        campaign, capture = stages.campaign, task.capture
        camera, white = campaign.cameras[capture.camera], campaign.targets.white
        pixels = [(use, hash_file(path)) for use, path in _frames(capture)]
        light = (
            _read(campaign, white.reflectance)
            if white and any(s.white for s in capture.sensors)
            else ""
        )
        text = _hash(
            pixels,
            [getattr(camera, key) for key in KEYS],
            capture.sensors and [(s.pattern, s.bands) for s in capture.sensors],
            light,
            _read(campaign, camera.sensitivity),
        )
        stages.toy = capture, text
        kept = stages.places.kept / capture.object / capture.layer / "calibrated.txt"
        measured = {s.name: {"sensor": {"text": text}} for s in capture.sensors}
        notes = {"measured": measured if camera.traits.is_calibrated else {}, "captured": None}
        return _write([(kept, text)], notes, aside=True)

    def register(self, stages, task):
        campaign, places, capture, lead = (
            stages.campaign,
            stages.places,
            task.capture,
            task.reference,
        )
        path = places.registration(capture.object, capture.layer)
        points = campaign.root / f"{capture.object}_{capture.layer}.csv"
        edits = campaign.edits.of_layer(capture.object, capture.layer)
        made_of = [
            *(self.text(stages, one) for one in (capture, lead)),
            campaign.reference.model_dump(), campaign.cameras[capture.camera].reference_band,
            [*(campaign.grid or ())], campaign.registration_of(capture.camera),
            points.read_text() if points.is_file() else "", {b: e.describe() for b, e in edits.items()},
            "" if task.leads else places.registration(lead.object, lead.layer).read_text(),
        ]  # fmt: skip
        verdict = {"decision": "accept", "reasons": [], "next_step": ""}
        record = {
            "object": capture.object, "camera": capture.camera, "setup": capture.setup,
            "reference": {"camera": lead.camera}, "verdict": verdict, "method": _hash(*made_of),
        }  # fmt: skip
        return _write([(path, json.dumps(record))], {})

    def resample(self, stages, task):
        campaign, places, capture, lead = (
            stages.campaign,
            stages.places,
            task.capture,
            task.reference,
        )
        names = {lead.layer, capture.layer}
        records = [
            json.loads(places.registration(capture.object, n).read_text())["method"]
            for n in sorted(names)
        ]
        default = places.layer(capture.object, capture.camera)
        under = hash_file(default).encode() if capture.setup and default.is_file() else b""
        tiff = places.layer(capture.object, capture.camera, capture.setup)
        layer = places.output / task.key.of.group
        text = _hash(self.text(stages, capture), records, len(under))
        return _write_layer(tiff, layer, text, campaign, capture)


def _read(campaign, table):
    path = campaign.root / str(table)
    return path.read_text() if path.is_file() else table


def facts_of(campaign, capture):
    """Return what is written about pixels, which are not computed anew for it."""
    museum = campaign.objects.get(capture.object)
    facts = [museum.title, museum.rights, museum.size_mm] if museum else []
    sensitivity = campaign.cameras[capture.camera].sensitivity
    return _hash(
        facts, [getattr(campaign.campaign, k) for k in FACTS], _read(campaign, sensitivity)
    )


def _write(products, notes, *, aside=False):
    with files.together():
        for path, text in products:
            files.write_text(path, text)
    paths = tuple(path for path, _ in products)
    return Written((), notes, aside=paths) if aside else Written(paths, notes)


def _write_layer(tiff, layer, text, campaign, capture):
    with files.together():
        files.write_text(tiff, f"{text}\n{facts_of(campaign, capture)}\n")
        with files.publishing(layer) as made:
            made.write_bytes("zarr.json", b'{"node_type": "group"}')
            made.write_bytes("c/0", text.encode())
    row = Entry(capture.object, capture.camera, capture.setup, len(capture.bands), 24, 20, float("nan"),
                "counts", "accept", hash_file(tiff))  # fmt: skip
    return Written([tiff, layer / "zarr.json", layer / "c/0"], {"entry": row.to_row()})


def _describe(task, campaign, places, records):
    key, notes = task.key, records.notes(task.key)
    made = [places.output / name for name in records.products(key)]
    if key.stage != "resample":
        return Written(made, notes)
    tiff = places.output / f"{key.of.path}.tif"
    text = tiff.read_text().split()[0]
    with files.together():
        files.write_text(tiff, f"{text}\n{facts_of(campaign, task.capture)}\n")
    return Written(made, notes | {"entry": [*notes["entry"][:9], hash_file(tiff)]})


def _report(build, name, captures, steps):
    campaign, places, earlier = build.campaign, build.places, build.earlier
    folder = places.folder(name)
    facts = campaign.objects.get(name)
    said = {layer.name: why for layer, why in earlier.items() if layer.object == name}
    refused = [p.code for step in steps if step.state == "refused" for p in step.problems]
    with files.together():
        files.write_json(
            folder / "report.html", [sorted(said.items()), refused, [c.layer for c in captures]]
        )
        files.write_text(folder / "object.toml", repr(facts and facts.museum_facts()))
    return [folder / "report.html", folder / "object.toml"]


def _camera(page, build, templates):
    places, records = build.places, build.records
    path = places.output / "cameras" / page.camera / "camera.json"
    notes = [
        records.notes(run.key_of(capture, "calibrate")).get("measured")
        for capture in page.captures[:1]
    ]
    files.write_json(path, notes)
    return Written([path], {})


def install(patch):
    """Put the toys in the place of the stages, and of what draws pages; sqlite does not wait for the disk."""
    toys, connect = Toys(), records_file._connect

    def careless(*where):
        connection = connect(*where)
        connection.execute("PRAGMA synchronous = OFF")
        return connection

    patch.setattr(tasks.Stages, "do", lambda stages, task: toys(stages, task))
    patch.setattr(outcomes, "describe_anew", _describe)
    patch.setattr(report_pages, "write_report", _report)
    patch.setattr(camera_reports, "write_camera_page", _camera)
    patch.setattr(records_file, "_connect", careless)
    return toys


def ended(folder, **options):
    """Build, and return how the stages ended by their labels."""
    return {step.label: step for step in summarise(run.build(folder, **options)).stages}


def copied(folder, to):
    return Path(shutil.copytree(folder, to, symlinks=True))
