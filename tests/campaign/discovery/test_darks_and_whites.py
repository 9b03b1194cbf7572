import numpy as np
import pytest
import tifffile

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures, find_charts

TARGETS = 'dark = "dark"\nwhite = "white"\n'
SESSIONS = """[campaign]
reference = { camera = "cam" }
[cameras.cam]
kind = "bands"
bands = ["grey"]
files = ["{target}/frame_{shot}.tif", "{object}/{target}_{shot}.tif", "{target}_{shot}.tif"]
"""
FLAT = """[campaign]
reference = { camera = "cam" }
[cameras.cam]
kind = "bands"
bands = ["grey"]
files = "{target}_{shot}.tif"
"""


def touch(folder, *names, time=None):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        when = f"2024:05:31 {time}" if time else None
        tifffile.imwrite(path, np.zeros((4, 6), np.uint16), datetime=when, photometric="minisblack")


def find(folder, text, targets=TARGETS):
    (folder / "campaign.toml").write_text(f"{text}\n[targets]\n{targets}")
    captures, refusals = find_captures(load_campaign(folder))
    return {c.object: c.sensors[0] for c in captures}, refusals


def names(refs):
    return [f"{f.path.parent.name}/{f.path.name}" for f in refs]


def test_the_white_of_an_object_goes_before_the_white_of_all(tmp_path):
    for icon in ("icon1", "icon2"):
        touch(tmp_path, f"{icon}/frame_1.tif")
    touch(tmp_path, "icon1/white_1.tif", "white_1.tif", "dark_1.tif")
    found, refusals = find(tmp_path, SESSIONS)
    assert not refusals
    assert names(found["icon1"].white) == ["icon1/white_1.tif"]
    assert names(found["icon2"].white) == [f"{tmp_path.name}/white_1.tif"]
    assert names(found["icon1"].dark) == names(found["icon2"].dark)
    assert not found["icon1"].remarks
    assert "no white of icon2 alone was found, as there is of icon1" in found["icon2"].remarks[0]


def test_an_object_without_its_white_is_refused_and_the_others_are_not(tmp_path):
    for icon in ("icon1", "icon2"):
        touch(tmp_path, f"{icon}/frame_1.tif", f"{icon}/dark_1.tif")
    touch(tmp_path, "icon1/white_1.tif", "icon_2/white_1.tif")
    found, refusals = find(tmp_path, SESSIONS)
    assert list(found) == ["icon1"]
    (problem,) = refusals["icon2", "cam", ""].problems
    assert problem.code == "E_TEMPLATE_MISSING"
    assert problem.found == "white of icon1, icon_2" and "icon_2" in problem.fix
    assert "icon2/white_{shot}.tif" in problem.expected.replace("{target}", "white")


def test_a_setup_has_darks_and_whites_of_one_object_too(tmp_path):
    for folder in (".", "raking"):
        touch(tmp_path, *(f"{folder}/icon1/{n}_1.tif" for n in ("frame", "white")))
    touch(tmp_path, "icon1/dark_1.tif")
    text = SESSIONS.replace(
        "files = [",
        'files = ["{setup}/{target}/frame_{shot}.tif", "{setup}/{object}/{target}_{shot}.tif", ',
    )
    (tmp_path / "campaign.toml").write_text(
        f"{text}\n[targets]\n{TARGETS}\n[setups.raking.cameras.cam]\n"
    )
    captures, refusals = find_captures(load_campaign(tmp_path))
    assert not refusals
    found = {c.layer: c.sensors[0] for c in captures}
    assert names(found["cam@raking"].white) == ["icon1/white_1.tif"]
    assert "raking" in str(found["cam@raking"].white[0].path)
    assert names(found["cam@raking"].dark) == ["icon1/dark_1.tif"]


def test_a_chart_has_a_white_of_its_own_and_may_be_the_white_of_one_object(tmp_path):
    for target in ("icon1", "macbeth"):
        touch(tmp_path, f"{target}/frame_1.tif", f"{target}/white_1.tif", f"{target}/dark_1.tif")
    charts = 'charts = { macbeth = "ColorChecker24" }\n'
    (tmp_path / "campaign.toml").write_text(f"{SESSIONS}\n[targets]\n{TARGETS}{charts}")
    (chart,), refusals = find_charts(load_campaign(tmp_path))
    assert not refusals
    assert names(chart.sensors[0].white) == ["macbeth/white_1.tif"]
    touch(tmp_path, "icon1/macbeth_1.tif")
    own = SESSIONS + 'white = { chart = "macbeth" }\n'
    found, refusals = find(tmp_path, own, 'dark = "dark"\n' + charts)
    assert names(found["icon1"].chart) == ["icon1/macbeth_1.tif"]
    (chart,), _ = find_charts(load_campaign(tmp_path))
    assert names(chart.sensors[0].object) == ["macbeth/frame_1.tif"]


def test_of_several_whites_the_nearest_before_and_after_an_object_are_used_and_said(tmp_path):
    touch(tmp_path, "dark_1.tif", time="08:00:00")
    touch(tmp_path, "white_1.tif", time="09:00:00")
    touch(tmp_path, "white_2.tif", time="09:00:40")
    touch(tmp_path, "icon1_1.tif", time="09:10:00")
    touch(tmp_path, "white_3.tif", time="10:00:00")
    touch(tmp_path, "icon2_1.tif", time="10:20:00")
    touch(tmp_path, "white_4.tif", time="10:25:00")
    touch(tmp_path, "icon3_1.tif", time="12:25:00")
    found, refusals = find(tmp_path, FLAT)
    assert not refusals
    assert [f.shot for f in found["icon1"].white] == ["1", "2", "3"]
    assert [f.shot for f in found["icon2"].white] == ["3", "4"]
    assert [f.shot for f in found["icon3"].white] == ["4"]
    used = "of 3 whites those nearest to the object are used:"
    assert found["icon2"].remarks == (f"{used} 20 min before it and 5 min after it",)
    assert found["icon3"].remarks == (f"{used} 2 h before it",)


def test_bands_captured_in_turns_have_one_white_each(tmp_path):
    text = FLAT.replace('bands = ["grey"]\n', "").replace("_{shot}", "_{wavelength}nm_{shot}")
    for hour, nm in enumerate((450, 550, 650), 8):
        for minute, target in enumerate(("dark", "white", "icon1", "icon2")):
            for shot in (1, 2):
                time = f"{hour:02}:{10 * minute + shot:02}:00"
                touch(tmp_path, f"{target}_{nm}nm_{shot}.tif", time=time)
    found, refusals = find(tmp_path, text)
    assert not refusals
    assert {len(s.white) for s in found.values()} == {6}
    assert not any(s.remarks for s in found.values())


def test_the_nearest_dark_is_taken_exposure_by_exposure(tmp_path):
    text = FLAT.replace("_{shot}", "_{exposure}ms_{shot}") + 'exposures = "best"\n'
    for milliseconds, hour in ((10, 8), (20, 8), (10, 10)):
        touch(tmp_path, f"dark_{milliseconds}ms_{hour}.tif", time=f"{hour:02}:00:00")
    touch(tmp_path, "icon0_10ms_1.tif", time="09:00:00")
    touch(tmp_path, "white_10ms_1.tif", time="11:00:00")
    touch(tmp_path, "icon1_10ms_1.tif", time="11:30:00")
    found, refusals = find(tmp_path, text)
    assert not refusals
    assert [(f.exposure_s, f.shot) for f in found["icon1"].dark] == [(0.01, "10"), (0.02, "8")]
    (remark,) = found["icon1"].remarks
    assert remark == "of 2 darks those nearest to the object are used: 90 min before it"


def test_without_times_running_numbers_give_the_order(tmp_path):
    touch(tmp_path, "dark_1.tif", "white_2.tif", "icon1_3.tif", "icon2_7.tif", "white_8.tif")
    found, _ = find(tmp_path, FLAT)
    assert [f.shot for f in found["icon1"].white] == ["2"]
    assert [f.shot for f in found["icon2"].white] == ["8"]
    assert "1 file after it" in found["icon2"].remarks[0]


@pytest.mark.parametrize("shots", [("1", "2"), ("b", "a")])
def test_names_that_do_not_count_say_nothing_of_the_order(tmp_path, shots):
    for target in ("dark", "icon1", "white"):
        touch(tmp_path, *(f"{target}_{shot}.tif" for shot in shots))
    found, _ = find(tmp_path, FLAT)
    assert len(found["icon1"].white) == 2 and not found["icon1"].remarks


def test_a_frame_that_cannot_be_read_refuses_its_own_capture_alone(tmp_path):
    touch(tmp_path, "dark_1.tif", time="08:00:00")
    touch(tmp_path, "white_1.tif", time="09:00:00")
    touch(tmp_path, "icon1_1.tif", time="09:10:00")
    touch(tmp_path, "icon3_1.tif", time="11:00:00")
    touch(tmp_path, "white_3.tif", time="12:00:00")
    (tmp_path / "icon2_1.tif").write_bytes(b"II*\0junk")
    found, _ = find(tmp_path, FLAT)
    assert [f.shot for f in found["icon1"].white] == ["1", "3"]
    assert {"icon1", "icon3"} <= set(found)


def test_an_object_of_a_white_may_stand_beside_its_name(tmp_path):
    touch(tmp_path, "icon_1_frame_001.tif", "icon_1_white_001.tif", "icon_1_dark_001.tif")
    text = FLAT.replace(
        '"{target}_{shot}.tif"', '["{target}_frame_{shot}.tif", "{object}_{target}_{shot}.tif"]'
    )
    found, refusals = find(tmp_path, text)
    assert not refusals and list(found) == ["icon_1"]
    assert names(found["icon_1"].white) == [f"{tmp_path.name}/icon_1_white_001.tif"]
