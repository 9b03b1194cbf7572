"""Every file that a frame is made of is looked at, by its content and by what it is used for."""

import os
import time

import numpy as np
import pytest
from cameras import text

from levkas.building import build, status
from levkas.building.hashes import Hashes
from levkas.building.records_file import NAME
from levkas.calibration.templates import average
from levkas.campaign.discovery.captures import FrameRef
from levkas.core.digests import hash_file, stamp_of
from levkas.readers.envi import read_envi
from levkas.stages.template_cache import TemplateCache


@pytest.fixture
def campaign(world, tmp_path):
    """The small world, to be changed."""
    return world.copy(tmp_path / "campaign").folder


def why(folder, layer, **more):
    """Why the calibration of a layer is stale; empty where it is fresh."""
    steps = status(folder, **more).stages
    return next(s.why for s in steps if (s.key.layer, s.key.stage) == (layer, "calibrate"))


def spoilt(path):
    path.write_bytes(path.read_bytes()[:-1] + b"\x07")


def test_other_data_under_the_same_header_are_noticed(campaign):
    data = campaign / "scan/panel_2.raw"
    data.write_bytes(np.random.default_rng(1).bytes(data.stat().st_size))
    assert "scan/panel_2.raw" in why(campaign, "scan")
    assert not why(campaign, "filters")


def test_a_frame_replaced_at_the_same_size_and_time_is_noticed(campaign):
    frame = campaign / "filters/panel_500nm_0.tif"
    status(campaign)
    before = frame.stat()
    spoilt(frame)
    os.utime(frame, ns=(before.st_atime_ns, before.st_mtime_ns))
    after = frame.stat()
    assert (after.st_size, after.st_mtime_ns) == (before.st_size, before.st_mtime_ns)
    assert "filters/panel_500nm_0.tif" in why(campaign, "filters")


def test_what_no_stamp_shows_is_found_by_reading_every_file_anew(campaign):
    time.sleep(0.2)  # files that were copied within the last tick of the clock are not kept
    list(build(campaign))  # the copy's own stamps
    frame, kept = campaign / "filters/panel_500nm_0.tif", campaign / "database.kept" / NAME
    hashes = Hashes(kept)
    spoilt(frame)
    hashes._learn(frame, (*stamp_of(frame), hashes.known(frame)[-1]), old_enough=True)
    hashes.save()
    assert not why(campaign, "filters")
    assert "filters/panel_500nm_0.tif" in why(campaign, "filters", verify=True)


def test_a_file_changed_twice_within_a_tick_of_the_clock_is_read_again(tmp_path):
    frame, kept = tmp_path / "frame.tif", tmp_path / NAME
    frame.write_bytes(b"one")
    first = Hashes(kept)
    assert first(frame) == hash_file(frame)
    first.save()
    assert Hashes(kept).known(frame) is None


def test_another_role_or_exposure_of_a_frame_is_noticed(campaign):
    text('dark = "dark"', 'dark = "white"')(campaign)
    text('names = "white"', 'names = "dark"')(campaign)
    assert "scan/dark_1.hdr" in why(campaign, "scan")
    text('dark = "white"', 'dark = "dark"')(campaign)
    text('names = "dark"', 'names = "white"')(campaign)
    assert not why(campaign, "filters")
    frames = sorted(p.name for p in (campaign / "filters").iterdir())
    rows = "".join(f"{name},{0.2 if 'white' in name else 0.1}\n" for name in frames)
    (campaign / "times.csv").write_text("file,exposure_s\n" + rows)
    text("[cameras.filters]\n", '[cameras.filters]\nmanifest = "times.csv"\n')(campaign)
    assert why(campaign, "filters") and not why(campaign, "colour")


def test_templates_with_equal_headers_are_not_taken_for_one(campaign):
    shelf = TemplateCache(campaign / "shelf", Hashes(campaign / NAME).of_frame)

    def template(name):
        path = campaign / f"scan/{name}_1.hdr"
        return shelf.template([FrameRef(path, name)], lambda: average([read_envi(path)]))

    assert hash_file(campaign / "scan/dark_1.hdr") == hash_file(campaign / "scan/white_1.hdr")
    assert template("white").mean.mean() > 10 * template("dark").mean.mean()
