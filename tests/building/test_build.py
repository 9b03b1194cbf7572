import json
import os
import shutil
import sqlite3
import stat
from contextlib import closing

import cv2
import numpy as np
import pytest
import tifffile

import levkas
from levkas.building import build, status, summarise
from levkas.building.hashes import Hashes
from levkas.building.records_file import NAME
from levkas.core.digests import hash_tree, stamp_of
from levkas.core.problems import Refused

KEYS = """
[campaign]
title = "Three plates"
date = 2019-08-29
reference = { camera = "photo", band = "G" }
[cameras.photo]
kind = "image"
files = "photo/{target}.png"
[cameras.irr]
kind = "image"
files = "irr/{target}.tif"
[targets]
objects = OBJECTS
[objects.panel]
title = "Panel <b>& sons</b>"
"""


def painting(seed, size=(300, 260)):
    """Strokes, patches and fine grain at twice the size, so that a warped copy is a real one."""
    rng = np.random.default_rng(seed)
    width, height = 2 * size[0], 2 * size[1]
    image = np.full((height, width), 90, np.float32)
    for _ in range(160):
        x, y, r = rng.integers(0, width), rng.integers(0, height), int(rng.integers(6, 60))
        cv2.circle(image, (int(x), int(y)), r, float(rng.integers(20, 235)), -1, cv2.LINE_AA)
    for _ in range(160):
        points = rng.integers(0, [width, height], (3, 2)).astype(np.int32)
        cv2.polylines(image, [points], False, float(rng.integers(20, 235)), 3, cv2.LINE_AA)
    grain = cv2.GaussianBlur(rng.standard_normal((height, width)).astype(np.float32), (0, 0), 2)
    return np.clip(image + 60 * grain, 5, 250)


def views(seed, matrix):
    """A colour photograph, and an inverted grey one through `matrix` (native px → big px)."""
    big = painting(seed)
    photo = cv2.resize(big, (300, 260), interpolation=cv2.INTER_AREA)
    soft = cv2.GaussianBlur(big, (0, 0), 0.8)
    irr = cv2.warpAffine(
        soft, matrix, (320, 280), flags=cv2.INTER_CUBIC | cv2.WARP_INVERSE_MAP, borderValue=5
    )
    return photo.astype(np.uint8), (255 - irr).clip(0, 255).astype(np.uint8)


MATRIX = np.array([[1.9, 0.06, 8.0], [-0.06, 1.9, 14.0]])


def truth(points):
    """Where points of the photograph lie in the infrared picture."""
    big = (points + 0.5) * 2 - 0.5
    return (big - MATRIX[:, 2]) @ np.linalg.inv(MATRIX[:, :2]).T


def make(folder, objects=("panel",)):
    for n, name in enumerate(objects):
        photo, irr = views(n, MATRIX)
        for part in ("photo", "irr"):
            (folder / part).mkdir(parents=True, exist_ok=True)
        cv2.imwrite(str(folder / f"photo/{name}.png"), np.dstack([photo] * 3))
        tifffile.imwrite(folder / f"irr/{name}.tif", irr)
    (folder / "campaign.toml").write_text(KEYS.replace("OBJECTS", json.dumps(list(objects))))
    return folder


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A built campaign; tests that change it work on a copy."""
    folder = make(tmp_path_factory.mktemp("finished") / "campaign")
    report = summarise(build(folder))
    assert report.ok, report.text
    return folder


@pytest.fixture
def campaign(finished, tmp_path):
    shutil.copytree(finished, tmp_path / "campaign")
    return tmp_path / "campaign"


def states(report):
    return {f"{s.key.layer} {s.key.stage}".strip(): s.state for s in report.stages if s.key.object}


def test_an_inverted_infrared_picture_is_registered_to_a_twentieth_of_a_pixel(finished):
    database = levkas.open(finished / "database")
    grid = np.stack(np.meshgrid(np.linspace(20, 280, 14), np.linspace(20, 240, 12)), -1).reshape(
        -1, 2
    )
    mapped = levkas.map_points(finished / "database", "panel", grid, source="grid", target="irr")
    assert np.linalg.norm(mapped - truth(grid), axis=1).mean() < 0.05
    layer = database["panel"]["irr"]
    assert layer.shape == (260, 300, 1) and layer.dims == ("y", "x", "band")


def test_the_database_has_the_files_of_the_contract(finished):
    folder = finished / "database" / "objects" / "panel"
    names = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    assert {
        "panel_photo.tif",
        "panel_photo.flags.tif",
        "panel_photo.png",
        "panel_irr.tif",
        "panel_irr.png",
        "registration/irr.json",
        "registration/irr.matches.csv",
        "report.html",
        "object.toml",
    } <= names
    record = json.loads((folder / "registration/irr.json").read_text())
    assert {
        "method",
        "reference",
        "target",
        "verdict",
        "model",
        "bands",
        "errors",
        "trace",
    } <= record.keys()
    assert record["verdict"]["decision"] in ("accept", "warn")
    header = (finished / "database" / "catalogue.csv").read_text().splitlines()[0]
    assert header == "object,camera,setup,bands,width,height,px_per_mm,quantity,verdict,sha256"


def test_titles_are_escaped_on_the_page(finished):
    page = (finished / "database/objects/panel/report.html").read_text()
    assert "<b>&" not in page and "&lt;b&gt;&amp; sons" in page


def test_a_second_build_writes_nothing(campaign):
    before = {p: p.stat().st_mtime_ns for p in (campaign / "database/objects").rglob("*")}
    report = summarise(build(campaign))
    assert set(states(report).values()) == {"fresh"}
    assert {p: p.stat().st_mtime_ns for p in (campaign / "database/objects").rglob("*")} == before


@pytest.mark.slow
def test_a_changed_parameter_redoes_only_what_depends_on_it_and_status_says_why(campaign):
    text = (campaign / "campaign.toml").read_text()
    (campaign / "campaign.toml").write_text(text + "[cameras.irr.registration]\nstop = 0.5\n")
    stale = {
        f"{s.key.layer} {s.key.stage}": s.why for s in status(campaign).stages if s.state == "stale"
    }
    assert stale["irr register"] == "registration.stop is new"
    assert (
        "irr resample" in stale and "irr calibrate" not in stale and "photo register" not in stale
    )
    done = states(summarise(build(campaign)))
    assert done["irr register"] == "done" and done["photo resample"] == "fresh"


def flip_a_bit(path, kept):
    """Damage one file as a disk does: neither size nor times nor inode tell."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    hashes = Hashes(kept / NAME)
    hashes._learn(path, (*stamp_of(path), hashes.known(path)[-1]), old_enough=True)
    hashes.save()


@pytest.mark.parametrize(
    "damaged",
    [
        *("registration/photo.json", "registration/irr.json", "panel_photo.tif"),
    ],
)
def test_what_was_kept_is_checked_before_it_is_read_again(campaign, damaged):
    whole = hash_tree(campaign / "database")
    assert summarise(build(campaign)).ok  # from now on sizes and times are believed
    path = campaign / "database/objects/panel" / damaged
    flip_a_bit(path, campaign / "database.kept")
    for name in ("panel_irr.tif", "panel_irr.png"):
        (campaign / "database/objects/panel" / name).unlink()  # so that the last stage is due
    report = summarise(build(campaign))
    assert report.ok, report.text
    assert hash_tree(campaign / "database") == whole
    assert any("damaged" in step.why for step in report.stages)


def test_a_damaged_record_of_a_stage_is_not_believed(campaign):
    whole = hash_tree(campaign / "database")
    with closing(sqlite3.connect(campaign / "database.kept" / NAME)) as kept, kept:
        kept.execute("UPDATE stages SET record = replace(record, '\"accept\"', '\"accepT\"')")
        assert kept.total_changes
    assert states(status(campaign))["irr resample"] == "stale"
    summarise(build(campaign))
    assert hash_tree(campaign / "database") == whole


@pytest.mark.slow
def test_the_same_input_gives_the_same_bytes_in_another_folder(finished, tmp_path):
    other = make(tmp_path / "elsewhere")
    assert summarise(build(other, output=tmp_path / "there")).ok
    assert hash_tree(tmp_path / "there") == hash_tree(finished / "database")


def test_raw_frames_are_never_changed(finished, tmp_path):
    fresh = make(tmp_path / "again")
    for part in ("photo", "irr"):
        assert hash_tree(fresh / part) == hash_tree(finished / part)


@pytest.mark.slow
def test_a_different_painting_is_refused_by_reason_and_nothing_of_it_is_written(campaign):
    tifffile.imwrite(campaign / "irr/panel.tif", views(77, MATRIX)[1])
    report = summarise(build(campaign))
    assert not report.ok and states(report)["irr register"] == "refused"
    assert report.problems and report.problems[0].fix
    assert not list((campaign / "database").rglob("panel_irr.tif"))[1:]
    assert not (campaign / "database/objects/panel/panel_irr.tif").exists()
    assert "irr" not in (campaign / "database/catalogue.csv").read_text()
    page = (campaign / "database/objects/panel/report.html").read_text()
    assert "irr was left out: its registration was refused" in page
    assert "What was refused" not in page  # its own section says why


@pytest.mark.slow
def test_a_blank_picture_is_refused(campaign):
    tifffile.imwrite(campaign / "irr/panel.tif", np.full((280, 320), 128, np.uint8))
    report = summarise(build(campaign))
    assert states(report)["irr register"] == "refused" and report.problems[0].code.startswith("E_")


@pytest.mark.slow
def test_a_truncated_file_refuses_its_camera_and_the_other_object_is_built(tmp_path):
    folder = make(tmp_path / "two", ("one", "two"))
    path = folder / "irr/one.tif"
    path.write_bytes(path.read_bytes()[:900])
    report = summarise(build(folder))
    refused = [s for s in report.stages if s.state == "refused"]
    assert [(s.key.object, s.key.camera) for s in refused] == [("one", "irr")]
    assert "one.tif" in report.problems[0].file
    assert sorted(levkas.open(folder / "database")) == ["one", "two"]
    assert list(levkas.open(folder / "database")["one"]) == ["photo"]


@pytest.mark.slow
def test_without_the_reference_picture_only_that_object_is_refused(tmp_path):
    folder = make(tmp_path / "two", ("one", "two"))
    (folder / "photo/one.png").unlink()
    report = summarise(build(folder))
    codes = {p.code for s in report.stages if s.key.object == "one" for p in s.problems}
    assert codes == {"E_NO_FRAMES", "E_NO_REFERENCE"}
    assert sorted(levkas.open(folder / "database")) == ["two"]


@pytest.mark.skipif(os.name == "nt", reason="needs POSIX permissions")
def test_an_output_that_cannot_be_written_is_refused_before_any_work(tmp_path):
    folder = make(tmp_path / "campaign")
    blocked = tmp_path / "file"
    blocked.write_text("in the way")
    with pytest.raises(Refused) as refused:
        list(build(folder, output=blocked / "database"))
    assert refused.value.problems[0].code == "E_UNWRITABLE"
    assert stat.S_ISREG(blocked.stat().st_mode)


def test_an_output_over_the_campaign_is_refused(campaign):
    with pytest.raises(Refused, match="replace the campaign"):
        list(build(campaign, output=campaign))


def test_an_unknown_object_is_refused_with_the_known_ones(campaign):
    with pytest.raises(Refused, match="panel"):
        list(build(campaign, objects=["pannel"]))
