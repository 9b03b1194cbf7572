"""Captures of one camera adjusted together: the two rounds of a build, what is redone, what is lost."""

import json
import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest

from levkas.building import build, status
from levkas.building.graph import NEIGHBOURS, companions_of
from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.campaign.discovery.captures import Capture
from levkas.geometry.transforms import Affine
from levkas.stages.joint import adjusted
from levkas.stages.register import Measured

NAMES = ("one", "two", "three")


@pytest.fixture(scope="module")
def plates(tmp_path_factory, make_plates):
    folder = make_plates(tmp_path_factory.mktemp("joint") / "campaign", NAMES)
    _joint(folder)
    for _ in build(folder):
        pass
    return folder


@pytest.fixture
def built(plates, tmp_path):
    return shutil.copytree(plates, tmp_path / "campaign")


def _joint(folder):
    with (folder / "campaign.toml").open("a") as handle:
        handle.write("[registration]\njoint = true\n")


def _states(steps):
    return {step.label: step for step in steps if step.finished}


def _record(folder, name, layer):
    path = folder / "database" / "objects" / name / "registration" / f"{layer}.json"
    return json.loads(path.read_text())


def _files(folder):
    root = folder / "database"
    return {p.relative_to(root).as_posix(): p.read_bytes() for p in root.rglob("*") if p.is_file()}


def test_a_record_says_with_whom_it_was_adjusted_and_how_far_it_moved(plates):
    reported = _record(plates, "one", "infrared")["model"]["sensors"][0]["joint"]
    assert set(reported["with"]) <= {"two/infrared", "three/infrared"}
    assert reported["with"]
    assert 0 <= reported["moved_px"]["mean"] <= reported["moved_px"]["max"] < 1
    reasons = _record(plates, "one", "infrared")["verdict"]["reasons"]
    assert any("joint adjustment with" in reason for reason in reasons)


def _adjusted(folder, spoilt=0.0):
    """What adjusting one/infrared comes to where all that its windows saw lies `spoilt` native px aside."""
    kept = folder / "database.kept"
    measured = {n: Measured.read(kept / n / "infrared" / "measured.npz") for n in NAMES}
    aside = Affine(np.array([[1, 0, spoilt], [0, 1, spoilt]]))
    for name, one in measured.items():
        measured[name] = replace(
            one, observations=tuple(s.enlarged(aside) for s in one.observations)
        )
    others = {f"{name}/infrared": one for name, one in measured.items() if name != "one"}
    return adjusted(measured["one"], others, None).record


@pytest.mark.slow
def test_the_verdict_is_of_the_map_that_is_written(plates):
    sound, bad = _adjusted(plates), _adjusted(plates, spoilt=6.0)
    assert bad["model"]["sensors"][0]["joint"]["moved_px"]["mean"] > 3
    assert sound["verdict"]["decision"] == "accept"
    assert bad["verdict"]["decision"] == "refuse"
    reported = bad["verdict"]["numbers"]["sensor"]
    # Six native px along both axes; 20 native px are 19 reference px.
    assert reported["verification"]["window_median"] == pytest.approx(6 * 2**0.5 * 0.95, abs=0.4)
    assert reported["verification"]["agreeing"] < 0.1 * reported["verification"]["found"]
    assert reported["joint_excess"]["sigmas"] > 3
    assert bad["errors"]["sensors"][""] == reported


def test_a_second_build_does_nothing_and_status_agrees(built):
    before = _files(built)
    states = {step.state for step in build(built) if step.finished}
    assert states == {"fresh"}
    assert {stage.state for stage in status(built).stages} == {"fresh"}
    assert _files(built) == before


@pytest.mark.slow
def test_what_changes_in_one_object_is_told_of_the_others_and_redone(built):
    path = built / "infrared" / "two.png"
    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    picture[40:60, 40:60] //= 2
    cv2.imwrite(str(path), picture)
    stale = {s.label: s.why for s in status(built).stages if s.state == "stale"}
    assert stale["one/infrared register"].startswith("registration of two/infrared")
    assert "one/infrared measure" not in stale
    states = _states(build(built))
    assert states["one/infrared measure"].state == "fresh"
    assert states["one/infrared register"].state == "done"
    assert states["one/photo register"].state == "fresh"


@pytest.mark.slow
def test_one_object_alone_is_built_as_with_all_of_them(built, tmp_path):
    whole = _files(built)
    alone = tmp_path / "alone"
    steps = _states(build(built, output=alone, objects=["one"]))
    assert "two/infrared measure" in steps
    assert "two/infrared resample" not in steps
    for name in ("one_infrared.tif", "registration/infrared.json"):
        assert (alone / "objects" / "one" / name).read_bytes() == whole[f"objects/one/{name}"]


@pytest.mark.slow
def test_a_capture_that_cannot_be_read_leaves_the_others_their_adjustment(built):
    (built / "infrared" / "two.png").write_bytes(b"no picture")
    steps = list(build(built))
    states = _states(steps)
    assert states["two/infrared calibrate"].state == "refused"
    assert states["one/infrared register"].state == "done"
    assert _record(built, "one", "infrared")["model"]["sensors"][0]["joint"]["with"] == [
        "three/infrared"
    ]
    assert [s.label for s in steps if s.state == "refused"].count("two/infrared calibrate") == 1
    assert steps[-1].done == steps[-1].total


@pytest.mark.slow
def test_without_its_reference_an_object_is_refused_once_and_the_others_go_on(built):
    (built / "photo" / "two.png").write_bytes(b"no picture")
    states = _states(build(built))
    assert states["two/photo calibrate"].state == "refused"
    assert states["two/infrared calibrate"].problems[0].code == "E_NO_REFERENCE"
    assert states["one/infrared resample"].state == "done"


def test_a_kept_registration_that_was_damaged_is_never_read_silently(built):
    path = built / "database.kept" / "two" / "infrared" / "measured.npz"
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    before = _files(built)
    states = _states(build(built))
    assert states["two/infrared measure"].state == "done"
    assert states["two/infrared measure"].why.endswith("was changed after it was built")
    assert _files(built) == before


@pytest.mark.slow
def test_the_order_of_the_objects_changes_no_byte(plates, tmp_path):
    other = tmp_path / "other"
    shutil.copytree(plates, other, ignore=shutil.ignore_patterns("database*"))
    text = (other / "campaign.toml").read_text()
    shuffled = text.replace('["one", "two", "three"]', '["three", "one", "two"]')
    assert shuffled != text
    (other / "campaign.toml").write_text(shuffled)
    for _ in build(other):
        pass
    one, two = _files(plates), _files(other)
    pictures = [name for name in one if name.endswith((".tif", ".csv", ".png"))]
    assert pictures
    assert all(one[name] == two[name] for name in pictures)


def test_of_many_captures_the_nearest_by_name_are_mates_and_one_more_changes_few(built):
    campaign = load_campaign(built)

    def companions(names):
        captures = [Capture(name, "infrared", "", ()) for name in names]
        return {
            c.object: [m.object for m in companions_of(campaign, c, captures[::-1])]
            for c in captures
        }

    names = [f"panel {n:02d}" for n in range(40)]
    before, after = companions(names), companions([*names, "panel 20b"])
    assert before["panel 00"] == [f"panel {n:02d}" for n in (1, 2, 3, 4, 5, 6, *range(34, 40))]
    assert {len(found) for found in before.values()} == {2 * NEIGHBOURS}
    assert sum(before[name] != after[name] for name in names) == 2 * NEIGHBOURS


@pytest.mark.parametrize("said", ['"yes"', "1", "[true]"])
def test_anything_but_true_or_false_is_refused(built, said):
    text = (built / "campaign.toml").read_text()
    (built / "campaign.toml").write_text(text.replace("joint = true", f"joint = {said}"))
    with pytest.raises(CampaignInvalid) as refused:
        load_campaign(built)
    assert refused.value.problems[0].field == "registration.joint"


def test_the_papers_method_adjusts_nothing_together(built):
    text = (built / "campaign.toml").read_text()
    (built / "campaign.toml").write_text(text + 'method = "mirhashemi2019"\n')
    with pytest.raises(CampaignInvalid) as refused:
        load_campaign(built)
    assert refused.value.problems[0].field == "registration.joint"
