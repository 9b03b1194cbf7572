"""A scan larger than memory in parts: joined, they are the bytes of one pass, whatever happened to them."""

import json
import random
from itertools import pairwise
from math import prod

import dask
import distributed  # noqa: F401 -- its settings are read before one is set
import numpy as np
import pytest
import tifffile

from levkas.building import build, calibrate, scan_parts, scans, streaming, summarise
from levkas.building.build_records import key_of
from levkas.building.cluster_executor import memory_needed
from levkas.building.graph import graph_of
from levkas.building.scan_parts import cuts_of, part_of, write_part
from levkas.building.template_cache import TemplateCache
from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core import disk
from levkas.core.digests import hash_tree
from levkas.core.files import PARTIAL
from levkas.database import spectral_tiff
from levkas.database.layout import Places

SMALL = {
    scans: {"STREAMED_SAMPLES": 0},
    streaming: {"HELD_BYTES": 3_000_000},
    spectral_tiff: {"STRIP_BYTES": 1 << 14},
}
"""Limits under which a small scan is streamed, and its strips are of few rows."""


@pytest.fixture
def small(monkeypatch):
    for module, limits in SMALL.items():
        for name, value in limits.items():
            monkeypatch.setattr(module, name, value)


@pytest.fixture
def opened(small_scan, small, monkeypatch):
    """Campaign, capture, and a function that opens its scan; a pixel of its pictures is of several."""
    monkeypatch.setattr(scans, "LOOKED_AT_PX", 3000)
    campaign = load_campaign(small_scan)
    capture = next(c for c in find_captures(campaign)[0] if c.camera == "v10")
    shelf = TemplateCache(small_scan, None, shared=False)
    return campaign, capture, lambda: calibrate.calibrate(capture, campaign, shelf)


def nothing():
    pass


@pytest.mark.parametrize("count", [1, 2, 5])
def test_joined_parts_are_the_files_and_the_record_of_one_pass(
    opened, tmp_path, monkeypatch, count
):
    campaign, capture, open_it = opened
    made, trees = [], []
    scan = open_it()
    monkeypatch.setattr(scan_parts, "PART_SAMPLES", prod(scan.shape) / count)
    cuts = cuts_of(scan)
    assert len(pairwise_of(cuts)) == (count if count > 1 else 0)
    flag_rows = spectral_tiff.strip_rows(scan.shape[1], np.uint8)
    assert count < 5 or any(cut % flag_rows for cut in cuts[:-1]), "strips of flags are cut"
    for way, at in (("whole", ()), ("parts", cuts)):
        places = Places(tmp_path / way / "database")
        for lines in random.Random(count).sample(pairwise_of(at), len(pairwise_of(at))):
            write_part(open_it(), capture, places, lines, nothing)
        joined = open_it()
        made.append(calibrate.write_calibrated(joined, capture, campaign, places, at, nothing))
        trees.append(hash_tree(places.output))
        if at:
            again = calibrate.load_calibrated(capture, campaign, places, {}, None)
            monkeypatch.setattr(scans.Scan, "passed", None)  # no line is calibrated again
            assert all(same(a, b) for a, b in zip(again.images(), joined.images(), strict=True))
    assert trees[0] == trees[1] and len(trees[0]) == 3
    assert made[0].notes == made[1].notes and made[0].warnings == made[1].warnings


def pairwise_of(cuts):
    return [*pairwise(cuts)]


def same(one, other):
    return np.array_equal(one.values, other.values) and np.array_equal(one.valid, other.valid)


def test_a_part_is_sent_with_less_memory_than_their_joining(opened):
    campaign, capture, open_it = opened
    graph = graph_of(campaign, find_captures(campaign)[0])
    task = graph[key_of(capture, "calibrate")]
    scan = open_it()
    half = memory_needed(task, campaign, (0, scan.shape[0] // 2))
    whole = memory_needed(task, campaign)
    pictures = sum(image.values.nbytes for image in scan.images())
    assert 0.4 * pictures < whole - half < 1.2 * pictures
    assert memory_needed(graph[key_of(capture, "resample")], campaign) > 1.5e9


def test_room_for_parts_and_their_joining_is_foreseen(opened, tmp_path, monkeypatch):
    _, capture, open_it = opened
    scan = open_it()
    monkeypatch.setattr(disk, "_free_bytes", lambda folder: 3 * prod(scan.shape))
    with pytest.raises(disk.WriteRefused) as refused:
        write_part(scan, capture, Places(tmp_path / "database"), (0, 16), nothing)
    assert refused.value.problems[0].code == "E_DISK_FULL"
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]


def test_a_part_that_is_cut_off_is_never_joined(opened, tmp_path, monkeypatch):
    campaign, capture, open_it = opened
    scan = open_it()
    monkeypatch.setattr(scan_parts, "PART_SAMPLES", prod(scan.shape) / 2)
    places, cuts = Places(tmp_path / "database"), cuts_of(scan)
    for lines in pairwise(cuts):
        write_part(scan, capture, places, lines, nothing)
    strips = part_of(places, capture, cuts[1:3]).strips("values")
    strips.write_bytes(strips.read_bytes()[:-1])
    with pytest.raises(OSError, match="could be read back"):
        calibrate.write_calibrated(open_it(), capture, campaign, places, cuts, nothing)
    assert not [p for p in places.output.rglob("*") if p.is_file()]


# --- on workers ---------------------------------------------------------------------------------

PRELOAD = """
from levkas.building import {modules}
from levkas.database import spectral_tiff
{lines}
"""


@pytest.fixture
def on_workers(tmp_path, monkeypatch, small):
    """Return a function that gives the workers, which are other processes, the limits of this one."""

    def set_limits(samples, *more):
        lines = [f"scan_parts.PART_SAMPLES = {samples}", *more]
        for module, limits in SMALL.items():
            name = module.__name__.rpartition(".")[2]
            lines += [f"{name}.{key} = {value}" for key, value in limits.items()]
        text = PRELOAD.format(modules="scan_parts, scans, streaming", lines="\n".join(lines))
        (tmp_path / "limits.py").write_text(text)
        return dask.config.set({"distributed.worker.preload": [str(tmp_path / "limits.py")]})

    return set_limits


@pytest.fixture(scope="module")
def alone(small_scan, tmp_path_factory):
    """The database as one process builds it in one pass, the samples of its scan, and its lines."""
    output = tmp_path_factory.mktemp("alone") / "database"
    with pytest.MonkeyPatch.context() as patch:
        for module, limits in SMALL.items():
            for name, value in limits.items():
                patch.setattr(module, name, value)
        report = summarise(build(small_scan, output=output, workers=0))
    assert report.ok, report.text
    return output, hash_tree(output)


def record_of(output):
    (path,) = output.with_name("database.kept").rglob("v10/calibrate.json")
    return json.loads(path.read_text())


def nothing_left(folder):
    names = [p.name for p in folder.rglob("*")]
    kinds = (".parts", ".strips", ".made", ".asked")
    return not [n for n in names if PARTIAL.fullmatch(n) or n.endswith(kinds)]


def samples_of(output, count):
    """Return the samples of a part of which the scan has so many."""
    (path,) = output.rglob("native/*v10.flags.tif")
    with tifffile.TiffFile(path) as tiff:
        return prod(tiff.pages[0].shape) * len(tiff.pages) / count


@pytest.mark.slow
@pytest.mark.parametrize("parts", [1, 5])
def test_workers_share_a_scan_and_write_the_bytes_of_one_process(
    parts, alone, small_scan, on_workers, tmp_path
):
    output, expected = alone
    with on_workers(samples_of(output, parts)):
        report = summarise(build(small_scan, output=tmp_path / "database", workers=2))
    assert report.ok, report.text
    assert hash_tree(tmp_path / "database") == expected
    notes = record_of(tmp_path / "database")["notes"]
    assert [one["why"] for one in notes["attempts"]] == ["done"] * (parts + 1 if parts > 1 else 1)
    assert len({one["worker"] for one in notes["attempts"]}) == min(parts, 2)
    assert nothing_left(tmp_path)


# dask may run a file twice under one name: what was there before is kept the first time.
KILLED = """
import os
from pathlib import Path
from levkas.database.streaming_writer import RowsPart
write = vars().get("write", RowsPart.write)
def killed(self, *args, **more):
    mark = Path("MARK")
    if self.rows[0] and not mark.exists():
        mark.touch()
        next(iter(args[0]))
        os._exit(9)
    write(self, *args, **more)
RowsPart.write = killed
"""
SPOILT = """
from itertools import pairwise
from pathlib import Path
from levkas.building import worker
do = vars().get("do", worker.Workplace.do)
def spoilt(self, job):
    mark = Path("MARK")
    if job.cuts and not mark.exists():
        mark.touch()
        folder = self.records.path_of(worker.Key(*job.key), worker.PARTS)
        first, second, third = (f"{a}-{b}" for a, b in list(pairwise(job.cuts))[:3])
        strips = folder / f"{first}.strips"
        strips.write_bytes(strips.read_bytes()[:-1])
        (folder / f"{second}.npz").unlink()
        (folder / f"{third}.made").unlink()
    return do(self, job)
worker.Workplace.do = spoilt
"""


@pytest.mark.slow
@pytest.mark.parametrize("fault", [KILLED, SPOILT], ids=["killed", "spoilt"])
def test_parts_that_were_lost_are_made_again(fault, alone, small_scan, on_workers, tmp_path):
    output, expected = alone
    fault = fault.replace("MARK", str(tmp_path / "mark"))
    with on_workers(samples_of(output, 3), fault):
        report = summarise(build(small_scan, output=tmp_path / "database", workers=2))
    assert report.ok, report.text
    assert [*tmp_path.glob("mark*")], "the fault was there"
    assert hash_tree(tmp_path / "database") == expected
    assert nothing_left(tmp_path)
