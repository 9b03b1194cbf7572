"""Every file that a frame is made of is looked at, by its content and by what it is used for."""

import json
import os
import shutil
import time

import numpy as np
import pytest

from levkas.building import build, status, summarise
from levkas.building.hashes import Hashes
from levkas.building.records_file import NAME
from levkas.calibration.templates import average
from levkas.campaign.discovery.captures import FrameRef
from levkas.core.digests import hash_file, hash_tree, stamp_of
from levkas.readers.envi import read_envi
from levkas.stages import scans
from levkas.stages.template_cache import TemplateCache


@pytest.fixture(scope="module")
def built(tmp_path_factory, make_every_kind):
    folder = make_every_kind(
        tmp_path_factory.mktemp("raw") / "campaign", ("one",), ("photo", "filters", "scan")
    )
    report = summarise(build(folder))
    assert report.ok, report.text
    return folder


@pytest.fixture
def campaign(built, tmp_path):
    copy = shutil.copytree(built, tmp_path / "campaign")
    assert {step.state for step in status(copy).stages} == {"fresh"}
    return copy


def why(folder, layer, **more):
    """Why the calibration of a layer is stale; empty where it is fresh."""
    steps = status(folder, **more).stages
    return next(s.why for s in steps if (s.key.layer, s.key.stage) == (layer, "calibrate"))


def test_other_data_under_the_same_header_are_noticed(campaign):
    data = campaign / "scan/one.raw"
    data.write_bytes(np.random.default_rng(1).bytes(data.stat().st_size))
    assert why(campaign, "scan") == "file scan/one.raw changed"
    assert not why(campaign, "filters")


def test_a_frame_replaced_at_the_same_size_and_time_is_noticed(campaign):
    frame = campaign / "filters/one_500nm.tif"
    status(campaign)
    before = frame.stat()
    frame.write_bytes(frame.read_bytes()[:-1] + b"\x07")
    os.utime(frame, ns=(before.st_atime_ns, before.st_mtime_ns))
    after = frame.stat()
    assert (after.st_size, after.st_mtime_ns) == (before.st_size, before.st_mtime_ns)
    assert why(campaign, "filters") == "file filters/one_500nm.tif changed"


def test_what_no_stamp_shows_is_found_by_reading_every_file_anew(campaign):
    time.sleep(0.2)  # files that were copied within the last tick of the clock are not kept
    list(build(campaign))  # the copy's own stamps
    frame, kept = campaign / "filters/one_500nm.tif", campaign / "database.kept" / NAME
    hashes = Hashes(kept)
    frame.write_bytes(frame.read_bytes()[:-1] + b"\x07")
    hashes._learn(frame, (*stamp_of(frame), hashes.known(frame)[-1]), old_enough=True)
    hashes.save()
    assert not why(campaign, "filters")
    assert why(campaign, "filters", verify=True) == "file filters/one_500nm.tif changed"


def test_a_file_changed_twice_within_a_tick_of_the_clock_is_read_again(tmp_path):
    frame, kept = tmp_path / "frame.tif", tmp_path / NAME
    frame.write_bytes(b"one")
    first = Hashes(kept)
    assert first(frame) == hash_file(frame)
    first.save()
    assert Hashes(kept).known(frame) is None


def test_dark_and_white_swapped_is_noticed(campaign):
    path = campaign / "campaign.toml"
    text = path.read_text().replace('dark = "dark"', 'dark = "white"')
    path.write_text(text.replace('names = "white"', 'names = "dark"'))
    assert why(campaign, "scan").startswith('frame scan/dark.hdr: role "dark" → "white"')


def test_another_exposure_in_the_manifest_is_noticed(campaign):
    path = campaign / "exposures.csv"
    path.write_text(path.read_text().replace("white_600nm.tif,0.1", "white_600nm.tif,0.2"))
    assert why(campaign, "filters") == "frame filters/white_600nm.tif: exposure_s 0.1 → 0.2"
    assert not why(campaign, "scan")


@pytest.mark.slow
def test_another_exposure_in_the_pattern_is_noticed(campaign):
    path = campaign / "campaign.toml"
    for old in (campaign / "scan").iterdir():
        old.rename(old.with_name(f"{old.stem}_10ms{old.suffix}"))
    path.write_text(path.read_text().replace("scan/{target}.hdr", "scan/{target}_{exposure}ms.hdr"))
    list(build(campaign))
    for old in (campaign / "scan").glob("white*"):
        old.rename(old.with_name(old.name.replace("_10ms", "_20ms")))
    assert "white_10ms" in why(campaign, "scan")


def test_provenance_has_every_file_of_every_frame_with_role_and_exposure(campaign):
    steps = json.loads((campaign / "database/objects/one/provenance.json").read_text())["steps"]
    scan, filters = (
        next(s for s in steps if (s["camera"], s["stage"]) == (camera, "calibrate"))["frames"]
        for camera in ("scan", "filters")
    )
    assert [(f["role"], *f["files"]) for f in scan] == [
        ("object", "scan/one.hdr", "scan/one.raw"),
        ("dark", "scan/dark.hdr", "scan/dark.raw"),
        ("white", "scan/white.hdr", "scan/white.raw"),
    ]
    assert {f["exposure_s"] for f in filters} == {0.1} and len(filters) == 6
    for frame in (*scan, *filters):
        for name, sha in frame["files"].items():
            assert sha == hash_file(campaign / name)


def test_templates_with_equal_headers_are_not_taken_for_one(campaign):
    shelf = TemplateCache(campaign / "shelf", Hashes(campaign / NAME).of_frame)

    def template(name):
        path = campaign / f"scan/{name}.hdr"
        frames = [FrameRef(path, name)]
        return shelf.template(frames, lambda: average([read_envi(path)]))

    assert hash_file(campaign / "scan/dark.hdr") == hash_file(campaign / "scan/white.hdr")
    assert template("white").mean.mean() > 10 * template("dark").mean.mean()


@pytest.mark.slow
def test_a_streamed_scan_ends_in_the_bytes_of_a_whole_one(campaign, monkeypatch):
    monkeypatch.setattr(scans, "STREAMED_SAMPLES", 0)
    assert summarise(build(campaign, output=campaign / "streamed")).ok
    whole, streamed = (hash_tree(campaign / name) for name in ("database", "streamed"))
    differ = {name for name in {**whole, **streamed} if whole.get(name) != streamed.get(name)}
    assert differ <= {"objects/one/report.html", "manifest-sha256.txt"}
