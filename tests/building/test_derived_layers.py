"""Estimated and spliced layers beside layers that are built again, or leave the campaign."""

import json

import cv2
import numpy as np
import pytest

from levkas.building import build, status, summarise
from levkas.core.cube import Band, Cube
from levkas.core.digests import hash_file
from levkas.core.files import write_json
from levkas.database.catalogue import ESTIMATED, MEASURED, SPLICED, read_catalogue, write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.layout import MADE_OF
from levkas.database.manifest import write_manifest
from levkas.database.reader import Database
from levkas.database.store import write_index
from levkas.database.validation import validate

GUESS = "guess"


KINDS = {"one": ESTIMATED, "two": SPLICED}


def derive(database, name):
    """Write a layer as `levkas estimate apply` does, from the photograph."""
    facts = {"method": "wiener", "from": ["photo"], "fitted to": "vis", "training": ["one"]}
    shape = Database(database)[name]["photo"].values.shape[:2]
    cube = Cube(np.ones((*shape, 2), np.float32), np.zeros((*shape, 2), np.uint8), None,
                (Band("500 nm", 500.0), Band("600 nm", 600.0)))  # fmt: skip
    layer = Layer(name, GUESS, px_per_mm=float("nan"), kind=KINDS[name], made_of=facts)
    entry, _ = write_layer(database, layer, cube, verdict="warn")
    source = database / f"objects/{name}/{name}_photo.tif"
    record = {"kind": KINDS[name], **facts, "sources": {"photo": hash_file(source)}}
    write_json(database / f"objects/{name}/{name}_{GUESS}{MADE_OF[KINDS[name]]}", record)
    write_catalogue(database, [*read_catalogue(database), entry])
    write_index(database / f"zarr/{name}.zarr")
    write_manifest(database)


def derived(database):
    return {e.object for e in read_catalogue(database) if e.kind != MEASURED}


@pytest.fixture
def folder(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["one", "two"])
    assert summarise(build(folder)).ok
    for name in ("one", "two"):
        derive(folder / "database", name)
    return folder


@pytest.mark.slow
def test_a_layer_made_from_others_is_marked_when_its_source_is_built_again_and_goes_with_its_object(
    folder,
):
    database = folder / "database"
    report = summarise(build(folder))
    assert report.ok and derived(database) == {"one", "two"}
    assert {step.state for step in status(folder).stages} == {"fresh"}

    photo = cv2.imread(str(folder / "photo/one.png"))
    cv2.imwrite(str(folder / "photo/one.png"), np.clip(photo.astype(int) + 9, 0, 255))
    report = summarise(build(folder))
    (warning,) = [w for w in report.warnings if GUESS in w]
    assert "photo was built again" in warning and "levkas estimate apply" in warning
    assert derived(database) == {"one", "two"} and validate(database).ok
    (marked,) = [e for e in read_catalogue(database) if e.earlier]
    assert (marked.object, marked.camera, marked.kind) == ("one", GUESS, KINDS["one"])
    assert {step.state for step in status(folder).stages} == {"fresh"}
    assert [w for w in summarise(build(folder)).warnings if GUESS in w] == [warning]

    text = (folder / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(text.replace('["one", "two"]', '["one"]'))
    report = summarise(build(folder))
    (warning,) = [w for w in report.warnings if f"two/{GUESS}" in w]
    assert "this layer is spliced" in warning
    assert derived(database) == {"one"} and validate(database).ok
    assert not [*database.rglob("*two*")]


def test_status_says_that_a_spliced_layer_is_of_an_older_source(folder):
    record = folder / f"database/objects/two/two_{GUESS}.splice.json"
    text = record.read_text()
    write_json(record, {**json.loads(text), "sources": {"photo": "0" * 64}})
    (stale,) = [step for step in status(folder).stages if step.state == "stale"]
    assert (
        stale.key.stage == "catalogue"
        and "two/guess, its source photo was built again" in stale.why
    )
