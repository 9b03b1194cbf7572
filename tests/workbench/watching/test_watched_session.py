"""A folder into which frames come whole, half, late, twice, in any order: the same files give the same state."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import time
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
import tifffile

from levkas.building.hashes import HASHES, TICK_NS, Hashes
from levkas.core.digests import hash_file
from levkas.core.progress import FRAMES
from levkas.readers import raw
from levkas.workbench.watching import WatchedSession
from levkas.workbench.watching.cache import MeasureCache

CAMPAIGN = """
[campaign]
reference = { camera = "colour", band = "G" }

[cameras.colour]
kind = "mosaic"
pattern = "RGGB"
files = "raw/{target}/{exposure}ms_{shot}.tif"
bits = 12

[targets]
dark = "dark"
white = { names = "white", reflectance = 0.98 }
objects = ["icon"]
"""
SHAPE = (200, 260)
RNG = np.random.default_rng(3)
PAINT = np.kron(RNG.uniform(0.1, 0.8, (20, 26)), np.ones((10, 10)))
FAR = 1e6  # of the clock, s, where every file has come to rest


def codes(light: np.ndarray | float, seed: int) -> np.ndarray:
    signal = 3000 * np.broadcast_to(light, SHAPE)
    noisy = np.random.default_rng(seed).normal(signal + 64, np.sqrt(0.4 * signal + 9))
    return noisy.round().clip(0, 4095).astype(np.uint16)


def frames() -> dict[str, np.ndarray]:
    """Return a good session by the names of its files."""
    return {
        **{f"raw/dark/100ms_{k}.tif": codes(0.0, k) for k in (1, 2)},
        **{f"raw/white/100ms_{k}.tif": codes(0.98, 10 + k) for k in (1, 2)},
        **{f"raw/icon/100ms_{k}.tif": codes(PAINT, 20 + k) for k in (1, 2, 3)},
    }


GOOD = frames()
AGES = {name: 1_700_000_000 + 60 * k for k, name in enumerate(GOOD)}


def put(folder: Path, name: str, values: np.ndarray) -> Path:
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    tifffile.imwrite(path, values, photometric="minisblack", metadata=None)
    os.utime(path, (AGES.get(name, 1_700_000_500),) * 2)
    return path


@pytest.fixture
def folder(tmp_path):
    home = tmp_path / "campaign"
    home.mkdir()
    (home / "campaign.toml").write_text(CAMPAIGN)
    return home


@pytest.fixture
def session(folder, tmp_path):
    return WatchedSession(folder, MeasureCache(tmp_path / "cache"))


def after(session: WatchedSession, now: float):
    """Return the state after two looks, the second when all has come to rest."""
    for moment in (now, now + 1):
        for _ in session.poll(moment):
            pass
    return session.state()


def verdicts(state) -> dict[str, str]:
    return {frame.file.name: frame.verdict for frame in state.frames}


def test_a_good_session_is_green_and_complete(session, folder):
    for name, values in GOOD.items():
        put(folder, name, values)
    put(folder, "raw/white/100ms_3.tif", codes(0.98, 99))
    put(folder, "raw/DSC_0001.tif", GOOD["raw/icon/100ms_1.tif"])
    state = after(session, 0.0)
    assert set(verdicts(state).values()) == {"green"}
    assert state.missing == () and state.strays == ("raw/DSC_0001.tif",)
    assert state.frames[1].what == "colour · dark · 0.1 s · 2"


def test_what_is_missing_is_listed_from_the_first_frame_on(session, folder):
    put(folder, "raw/white/100ms_1.tif", GOOD["raw/white/100ms_1.tif"])
    kinds = {(m.kind, m.what) for m in after(session, 0.0).missing}
    assert {("dark", "colour: dark"), ("capture", "colour: icon")} <= kinds


def test_order_of_coming_does_not_matter(tmp_path):
    bad = {**GOOD, "raw/white/100ms_2.tif": codes(0.90, 12)}
    states = []
    for seed in range(3):
        home = tmp_path / str(seed)
        home.mkdir()
        (home / "campaign.toml").write_text(CAMPAIGN)
        session = WatchedSession(home, MeasureCache(tmp_path / f"cache{seed}"))
        names = list(bad)
        random.Random(seed).shuffle(names)
        for k, name in enumerate(names):
            put(home, name, bad[name])
            state = after(session, 10.0 * k)
        states.append(state.to_dict())
    assert states[0] == states[1] == states[2]
    assert [f["verdict"] for f in states[0]["frames"] if f["findings"]] == ["look"]


def test_a_half_written_frame_waits_and_a_broken_one_stops(session, folder):
    path = put(folder, "raw/icon/100ms_1.tif", GOOD["raw/icon/100ms_1.tif"])
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    for _ in session.poll(0.0):
        pass
    assert verdicts(session.state()) == {"raw/icon/100ms_1.tif": "waiting"}
    assert verdicts(after(session, 1.0)) == {"raw/icon/100ms_1.tif": "waiting"}
    path.write_bytes(whole)
    assert verdicts(after(session, 3.0)) == {"raw/icon/100ms_1.tif": "green"}
    path.write_bytes(whole[:-500])
    for now in (10.0, 11.0, 13.0, 20.0):
        state = after(session, now)
    assert state.frames[0].verdict == "stop" and state.frames[0].findings[0].check == "file"
    assert state.missing[0].kind == "again"


def test_replaced_renamed_deleted_and_doubled_frames(session, folder):
    for name, values in GOOD.items():
        put(folder, name, values)
    first = after(session, 0.0)
    put(folder, "raw/icon/100ms_2.tif", codes(np.minimum(PAINT * 3, 1.5), 22))
    assert verdicts(after(session, 10.0))["raw/icon/100ms_2.tif"] == "stop"
    put(folder, "raw/icon/100ms_2.tif", GOOD["raw/icon/100ms_2.tif"])
    (folder / "raw/icon/100ms_3.tif").rename(folder / "raw/icon/100ms_7.tif")
    state = after(session, 20.0)
    assert "raw/icon/100ms_3.tif" not in verdicts(state)
    assert verdicts(state)["raw/icon/100ms_7.tif"] == "green"
    (folder / "raw/icon/100ms_7.tif").rename(folder / "raw/icon/100ms_3.tif")
    shutil.copyfile(folder / "raw/icon/100ms_1.tif", folder / "raw/icon/100ms_4.tif")
    doubled = after(session, 30.0)
    last = next(f for f in doubled.frames if f.file.name == "raw/icon/100ms_4.tif")
    assert [f.check for f in last.findings] == ["twice"]
    (folder / "raw/icon/100ms_4.tif").unlink()
    assert verdicts(after(session, 40.0)) == verdicts(first)


def test_a_share_that_goes_away_keeps_what_was_known(session, folder, tmp_path):
    for name, values in GOOD.items():
        put(folder, name, values)
    before = after(session, 0.0)
    folder.rename(tmp_path / "elsewhere")
    away = after(session, 10.0)
    assert away.away and away.frames == before.frames
    (tmp_path / "elsewhere").rename(folder)
    back = after(session, 30.0)
    assert not back.away and verdicts(back) == verdicts(before)


def test_shots_of_a_copied_folder_are_ordered_by_their_names(session, folder):
    """Copied within milliseconds, 10 before 2: the light sinks from the seventh shot on, and only there."""
    for order, k in enumerate([1, 10, 2, 3, 4, 5, 6, 7, 8, 9]):
        light = PAINT * (0.98 if k >= 7 else 1.0)
        path = put(folder, f"raw/icon/100ms_{k}.tif", codes(light, 20 + k))
        os.utime(path, ns=(1_700_000_000_000_000_000 + order * 1_000_000,) * 2)
    drifting = {f.file.shot for f in after(session, 0.0).frames if f.findings}
    assert drifting == {"7", "8", "9", "10"}


REAL = """
[campaign]
reference = { camera = "silios", band = "B5" }
[cameras.silios]
kind = "mosaic"
pattern = [["B1", "B2", "B3"], ["B4", "B5", "B6"], ["B7", "B8", "B9"]]
files = "FOLDER/silios-kinect/{target}/{shot}_multispectral_camera.png"
bits = 8
[cameras.microscope]
kind = "bands"
bands = ["grey"]
files = "FOLDER/tiles-section/{target}[Grid@{row} {column}].jpg"
[targets]
dark = "dark"
white = { names = "flat", reflectance = 1.0 }
objects = ["burst", "scene1", "stitch2d_ex"]
"""


@pytest.mark.slow
def test_real_captures_are_called_what_they_are(session, folder, real_data):
    """Tiles are sharp each for itself, though unlike; the white is one, whose corners lie beyond the filters and are full;
    the burst loses 1.8 % of its light at its fifth shot; the flat has less light than scene and burst."""
    (folder / "campaign.toml").write_text(REAL.replace("FOLDER", real_data.as_posix()))
    found = {f.what: {one.check for one in f.findings} for f in after(session, FAR).frames}
    assert found.pop("silios · dark · 2020511") == {"dark"}
    assert found.pop("silios · white · 2020511") == {"exposure"}
    assert found.pop("silios · scene1 · 2020511") == {"white"}
    burst = {k: found.pop(f"silios · burst · {k}") for k in range(11)}
    assert {k for k, checks in burst.items() if "drift" in checks} == set(range(4, 11))
    assert set.union(*burst.values()) == {"drift", "glare"}
    assert len(found) == 6 and set(map(frozenset, found.values())) == {frozenset()}


def test_a_restart_reads_no_frame_again(session, folder, tmp_path):
    for name, values in GOOD.items():
        put(folder, name, values)
    before = after(session, 0.0).to_dict()
    session.cache.close()
    count = FRAMES.count
    again = WatchedSession(folder, MeasureCache(tmp_path / "cache"))
    assert after(again, FAR).to_dict() == before
    assert FRAMES.count == count


def test_a_damaged_cache_is_made_anew(session, folder, tmp_path):
    put(folder, "raw/icon/100ms_1.tif", GOOD["raw/icon/100ms_1.tif"])
    before = after(session, 0.0).to_dict()
    session.cache.close()
    for path in (tmp_path / "cache").iterdir():
        path.write_bytes(b"no database")
    assert after(WatchedSession(folder, MeasureCache(tmp_path / "cache")), FAR).to_dict() == before


def test_a_camera_raw_is_decoded_once_for_its_levels_and_its_pixels(session, folder, monkeypatch):
    decode, decoded = raw._decode, []
    monkeypatch.setattr(raw, "_decode", lambda p, **how: decoded.append(p.name) or decode(p, **how))
    (folder / "campaign.toml").write_text(CAMPAIGN.replace(".tif", ".dng"))
    tags = [
        (50706, "B", 4, (1, 4, 0, 0), True), (50708, "s", 0, "Case", True), (33421, "H", 2, (2, 2), True),
        (33422, "B", 4, (0, 1, 1, 2), True), (50714, "H", 1, 64, True), (50717, "I", 1, 4095, True),
        (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        (50778, "H", 1, 21, True), (50728, "2I", 3, (1, 1, 1, 1, 1, 1), True),
    ]  # fmt: skip
    for name, values in GOOD.items():
        path = put(folder, name, values).rename(folder / name.replace(".tif", ".dng"))
        tifffile.imwrite(path, values, photometric=32803, extratags=tags, metadata=None)
    assert set(verdicts(after(session, FAR)).values()) == {"green"}
    assert len(decoded) == len(GOOD)


def test_a_folder_without_a_campaign_is_guessed(tmp_path):
    for name, values in GOOD.items():
        put(tmp_path / "frames", name, values)
    session = WatchedSession(tmp_path / "frames", MeasureCache(tmp_path / "cache"))
    state = after(session, 0.0)
    assert state.guessed
    assert {f.file.role for f in state.frames} == {"dark", "white", "object"}


def test_a_campaign_that_is_edited_is_read_again(session, folder):
    for name, values in GOOD.items():
        put(folder, name, values)
    after(session, 0.0)
    (folder / "campaign.toml").write_text(CAMPAIGN.replace("bits = 12", "saturation = 2000"))
    assert verdicts(after(session, 10.0))["raw/white/100ms_1.tif"] == "stop"
    (folder / "campaign.toml").write_text("[campaign")
    broken = after(session, 20.0)
    assert broken.problems and verdicts(broken)["raw/white/100ms_1.tif"] == "stop"


def test_a_build_takes_the_hashes_of_a_session_of_frames_that_are_as_they_were(
    session, folder, tmp_path
):
    """What the session noted is planted: a wrong hash shows that it was taken, and it must not be of a file that changed."""
    names = ["raw/icon/100ms_1.tif", "raw/white/100ms_1.tif"]
    for name in names:
        put(folder, name, GOOD[name])
    after(session, 0.0)
    newest = max((folder / name).stat().st_ctime_ns for name in names)
    while (
        time.time_ns() - newest <= TICK_NS
    ):  # a file that has just come may change within its stamp
        time.sleep(0.01)
    assert session.hash_frames() == 2 and session.hash_frames() == 0
    first, second = (folder / name for name in names)
    noted = tmp_path / "cache" / HASHES
    assert Hashes(tmp_path / "none", session=noted)(first) == hash_file(first)
    with closing(sqlite3.connect(noted)) as file, file:
        assert file.execute("UPDATE files SET sha256 = ?", ("0" * 64,)).rowcount == 2
    put(folder, names[1], GOOD[names[1]] + 1)
    of_build = Hashes(tmp_path / "records.sqlite", session=noted)
    assert of_build(first) == "0" * 64
    assert of_build(second) == hash_file(second)
    assert Hashes(tmp_path / "others.sqlite", session=noted, verify=True)(first) == hash_file(first)
