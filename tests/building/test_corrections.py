"""Corrections by hand: replayed to the same bytes, and what they do not name stays as it is."""

import json
import shutil

import numpy as np
import pytest

from levkas import map_points
from levkas.building import build, status, summarise
from levkas.campaign.edits import Edits, EditsInvalid, FrameEdits, round_pair, write_edits
from levkas.core.digests import hash_tree
from levkas.publish.run import publish
from levkas.registration.advice import percent
from levkas.registration.shares import checked_share

CORNERS = np.array([[80.0, 70.0], [220.0, 60.0], [225.0, 190.0], [90.0, 200.0]])


def four_pairs(truth):
    """Four corners as a person points at them, half a pixel off."""
    off = np.random.default_rng(1).normal(0, 0.5, (4, 2))
    rows = np.hstack([CORNERS, truth(CORNERS) + off])
    return FrameEdits(added=tuple(sorted(round_pair(row) for row in rows)))


def states(report):
    return {(s.key.object, s.key.layer, s.key.stage): (s.state, s.why) for s in report.stages}


@pytest.fixture(scope="module")
def built(turned_plates, tmp_path_factory):
    folder = turned_plates.make(tmp_path_factory.mktemp("corrected") / "campaign")
    return folder, summarise(build(folder))


@pytest.fixture(scope="module")
def corrected(built, turned_plates, tmp_path_factory):
    """The same campaign after four pairs were added and it was built again; the status between."""
    folder = tmp_path_factory.mktemp("again") / "campaign"
    shutil.copytree(built[0], folder)
    write_edits(folder / "edits.toml", Edits({("bad", "xray"): four_pairs(turned_plates.truth)}))
    between = status(folder)
    return folder, between, summarise(build(folder))


def test_a_camera_that_no_key_points_register_is_refused(built):
    _, report = built
    assert not report.ok
    assert states(report)["bad", "xray", "register"][0] == "refused"
    assert states(report)["good", "xray", "register"][0] == "done"


def test_four_pairs_by_hand_make_the_build_accept_it(corrected, turned_plates):
    folder, _, report = corrected
    assert report.ok, report.text
    record = json.loads((folder / "database/objects/bad/registration/xray.json").read_text())
    assert record["verdict"]["decision"] in ("accept", "warn")
    inside = CORNERS.mean(0) + 0.5 * (CORNERS - CORNERS.mean(0))
    mapped = map_points(folder / "database", "bad", inside, source="grid", target="xray")
    # The pairs are half a native pixel off; what is seen all over the picture is better than they are.
    assert np.linalg.norm(mapped - turned_plates.truth(inside), axis=1).mean() < 0.35


def test_only_what_is_named_is_stale_and_status_says_why(corrected):
    _, between, _ = corrected
    reported = states(between)
    state, why = reported["bad", "xray", "register"]
    assert state == "stale" and "edits.toml" in why
    others = [v for k, v in reported.items() if k[1] and k[:2] != ("bad", "xray")]
    assert all(state == "fresh" for state, _ in others)


@pytest.mark.slow
def test_corrections_are_replayed_to_the_same_bytes(corrected, turned_plates, tmp_path):
    folder, _, _ = corrected
    fresh = turned_plates.make(tmp_path / "elsewhere")
    shutil.copy(folder / "edits.toml", fresh / "edits.toml")
    assert summarise(build(fresh)).ok
    assert hash_tree(fresh / "database") == hash_tree(folder / "database")


def test_the_record_tells_the_course_and_the_matches_what_became_of_them(corrected):
    folder, _, _ = corrected
    place = folder / "database/objects/bad/registration"
    record = json.loads((place / "xray.json").read_text())
    rows = (place / "xray.matches.csv").read_text().splitlines()
    assert sum("added by hand" in row for row in rows) == 4
    # What the paper's removal would do to the pairs is not what happened.
    assert record["trace"]["kind"] == "windows" and "rounds" not in record["trace"]
    (sensor,) = record["trace"]["sensors"]
    windows = sensor["windows"]
    assert {len(column) for column in windows.values()} == {sensor["count"]}
    # Pairs by hand are fitted too, and stay.
    places = {(x, y) for x, y in zip(windows["x"], windows["y"], strict=True)}
    assert {tuple(corner) for corner in CORNERS} <= places
    numbers = record["errors"]["sensors"][""]
    assert sum(sensor["checks"]["found"]) == numbers["verification"]["found"]
    page = (folder / "database/objects/bad/report.html").read_text()
    assert "check windows agree with the map" in page and "Figure 10" not in page
    assert f"over {percent(checked_share(numbers | numbers['verification']))}" in page
    # What an X-ray and a photograph have in common is not likeness.
    assert "SSIM map" not in page and page.index("In short") < page.index('id="evidence"')
    assert "aligned with 4 pairs by hand" in page and record["pairs_by_hand"] == 4
    other = folder / "database/objects/good"
    assert "pairs_by_hand" not in json.loads((other / "registration/xray.json").read_text())
    assert "by hand" not in (other / "report.html").read_text()
    climbs = record["model"]["sensors"][0]["selections"]
    assert climbs and all(c["model"] in c["held_out_px"] for c in climbs)


def test_a_publication_says_which_layers_were_aligned_by_hand(corrected, tmp_path):
    folder, _, _ = corrected
    list(publish(folder / "database", output=tmp_path / "out", iiif=False))
    (row,) = (
        line
        for line in (tmp_path / "out/README.md").read_text().splitlines()
        if "pairs by hand" in line
    )
    assert row.startswith("| bad | xray |") and "aligned with 4 pairs by hand" in row
    page = (tmp_path / "out/viewer/objects/bad/index.html").read_text()
    assert page.count('"by_hand": "Aligned with 4 pairs by hand"') == 1


def test_corrections_of_what_is_not_there_are_refused(corrected, turned_plates, tmp_path):
    folder = tmp_path / "campaign"
    shutil.copytree(corrected[0], folder, ignore=shutil.ignore_patterns("database*"))
    four = four_pairs(turned_plates.truth)
    edits = {("bad", "xry"): four, ("none", "xray"): four}
    write_edits(folder / "edits.toml", Edits({**edits, ("good", "xray:UV"): four}))
    with pytest.raises(EditsInvalid) as refused:
        status(folder)
    assert [p.found for p in refused.value.problems] == ["xry", "UV", "none"]


def test_two_tables_of_one_sensor_are_refused(corrected, turned_plates, tmp_path):
    folder = tmp_path / "campaign"
    shutil.copytree(corrected[0], folder, ignore=shutil.ignore_patterns("database*"))
    four = four_pairs(turned_plates.truth)
    write_edits(folder / "edits.toml", Edits({("bad", "xray"): four, ("bad", "xray:grey"): four}))
    with pytest.raises(EditsInvalid) as refused:
        status(folder)
    assert [p.found for p in refused.value.problems] == ["xray, xray:grey"]
