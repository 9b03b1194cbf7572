"""Corrections by hand: replayed to the same bytes, and what they do not name stays as it is."""

import json
import shutil

import numpy as np
import pytest

from levkas import map_points
from levkas.building import build, status, summarise
from levkas.campaign.edits import Edits, EditsInvalid, FrameEdits, round_pair, write_edits
from levkas.core.digests import hash_tree

pytestmark = pytest.mark.slow
CORNERS = np.array([[80.0, 70.0], [220.0, 60.0], [225.0, 190.0], [90.0, 200.0]])


def four_pairs(truth):
    """Four corners as a person points at them, half a pixel off."""
    off = np.random.default_rng(1).normal(0, 0.5, (4, 2))
    rows = np.hstack([CORNERS, truth(CORNERS) + off])
    return FrameEdits(added=tuple(sorted(round_pair(row) for row in rows)))


def states(report):
    return {(s.key.object, s.key.layer, s.key.stage): (s.state, s.why) for s in report.stages}


@pytest.fixture(scope="module")
def corrected(turned_plates, tmp_path_factory):
    """A campaign that was built, then four pairs were added, and it was built again."""
    folder = turned_plates.make(tmp_path_factory.mktemp("corrected") / "campaign")
    first = states(summarise(build(folder)))
    assert first["bad", "xray", "register"][0] == "refused"
    assert first["good", "xray", "register"][0] == "done"
    write_edits(folder / "edits.toml", Edits({("bad", "xray"): four_pairs(turned_plates.truth)}))
    between = states(status(folder))
    state, why = between["bad", "xray", "register"]
    assert state == "stale" and "edits.toml" in why
    others = [v for k, v in between.items() if k[1] and k[:2] != ("bad", "xray")]
    assert all(state == "fresh" for state, _ in others)
    assert summarise(build(folder)).ok
    return folder


def test_four_pairs_by_hand_make_the_build_accept_it(corrected, turned_plates):
    record = json.loads((corrected / "database/objects/bad/registration/xray.json").read_text())
    assert record["verdict"]["decision"] in ("accept", "warn")
    inside = CORNERS.mean(0) + 0.5 * (CORNERS - CORNERS.mean(0))
    mapped = map_points(corrected / "database", "bad", inside, source="grid", target="xray")
    # The pairs are half a native pixel off; what is seen all over the picture is better than they are.
    assert np.linalg.norm(mapped - turned_plates.truth(inside), axis=1).mean() < 0.35


def test_corrections_are_replayed_to_the_same_bytes(corrected, turned_plates, tmp_path):
    fresh = turned_plates.make(tmp_path / "elsewhere")
    shutil.copy(corrected / "edits.toml", fresh / "edits.toml")
    assert summarise(build(fresh)).ok
    assert hash_tree(fresh / "database") == hash_tree(corrected / "database")


def test_corrections_of_what_is_not_there_are_refused(corrected, turned_plates, tmp_path):
    folder = tmp_path / "campaign"
    shutil.copytree(corrected, folder, ignore=shutil.ignore_patterns("database*"))
    four = four_pairs(turned_plates.truth)
    edits = {("bad", "xry"): four, ("none", "xray"): four}
    write_edits(
        folder / "edits.toml",
        Edits({**edits, ("good", "xray:UV"): four}).with_outline(
            "ono", tuple(map(tuple, CORNERS.tolist()))
        ),
    )
    with pytest.raises(EditsInvalid) as refused:
        status(folder)
    assert {p.found for p in refused.value.problems} == {"xry", "UV", "none", "ono"}
