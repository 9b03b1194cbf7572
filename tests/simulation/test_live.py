"""A session written frame by frame: its order, its clock, and that a planted fault is in the light and nowhere else."""

from __future__ import annotations

import numpy as np
import pytest
import tifffile

from levkas.campaign.campaign import load_campaign
from levkas.readers.frames import read_facts, read_frame
from levkas.simulation.live import copy_declarations, play_session, session_frames
from levkas.simulation.session_faults import FAULTS, FrameLevels, plant_fault

CAMPAIGN = """
[campaign]
reference = { camera = "d80", band = "G" }
[cameras.d80]
kind = "mosaic"
pattern = "RGGB"
files = "raw/{target}/DSC_{shot}.tif"
black = 64
saturation = 4095
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.98 }
objects = ["icon"]
"""


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    folder = tmp_path_factory.mktemp("whole")
    (folder / "campaign.toml").write_text(CAMPAIGN)
    rng = np.random.default_rng(2)
    for target, level in {"dark": 64, "white": 3000, "icon": 1200}.items():
        (folder / "raw" / target).mkdir(parents=True)
        for shot in (1, 2):
            codes = rng.normal(level, 9, (60, 80)).round().astype(np.uint16)
            tifffile.imwrite(folder / "raw" / target / f"DSC_{shot}.tif", codes, metadata=None)
    return folder


def test_a_session_begins_with_darks_and_ends_with_whites(source):
    frames = session_frames(load_campaign(source))
    roles = [frame.role for frame in frames if frame.camera == "d80"]
    assert roles[0] == "dark" and roles[-1] == "white" and "white" in roles[: roles.index("object")]


def test_sound_frames_are_those_of_the_campaign_with_a_clock(source, tmp_path):
    copy_declarations(source, tmp_path)
    rng = np.random.default_rng(1)
    played = list(play_session(source, tmp_path, interval_s=0, share=0, rng=rng))
    assert played[-1].done == played[-1].total == len(played)
    times = []
    for frame in played:
        copy = tmp_path / frame.path.relative_to(source)
        assert np.array_equal(read_frame(copy), read_frame(frame.path))
        facts = read_facts(copy)
        times.append(facts.captured)
        assert (facts.exposure_s, facts.iso) == (0.1, 100)
    assert times == sorted(times) and len(set(times)) == len(times)


def test_faults_change_the_light_by_what_they_say():
    rng = np.random.default_rng(4)
    levels = FrameLevels(64, 4095)
    sound = rng.normal(2064, 30, (200, 300)).round().astype(np.uint16)
    by_kind = {fault.kind.partition(",")[0]: fault for fault in FAULTS}

    def planted(kind: str, size: float) -> np.ndarray:
        return plant_fault(by_kind[kind], size, sound, levels, rng, beside=sound // 2)

    dim = planted("lamp between whites", 0.12)
    assert dim.mean() - 64 == pytest.approx(0.88 * 2000, rel=0.002)
    assert dim.std() == pytest.approx(30 * np.sqrt(0.88), rel=0.03)  # shot noise of less light
    assert 0.3 <= np.mean(planted("white clipped", 0.3) == 4095) < 0.4  # codes are whole numbers
    assert planted("noise of a shot", 3.0).std() == pytest.approx(90, rel=0.03)
    assert planted("another size", 0.5).shape == (100, 300)
    assert np.array_equal(planted("moved", 20)[:, 20:], sound[:, :-20])
    # 0.3 of each value and 0.7 of a Gaussian of 2 px: the sum of the squared weights is 0.1165
    assert planted("noise reduction", 0.7).std() == pytest.approx(30 * np.sqrt(0.1165), rel=0.02)
    before_wall = np.full((200, 300), 164, np.uint16)
    before_wall[60:140, 40:240] = 2064
    sound = before_wall
    for share, left in ((0.0, 200), (0.1, 170)):  # of the object's 200 columns
        shown = np.flatnonzero(planted("object at a side", share)[100] == 2064)
        assert shown[0] <= 1 and abs(len(shown) - left) <= 1  # its edge is found within a pixel
    assert planted("object at a side", 0.1).shape == sound.shape
    assert all(len(fault.sizes) == 2 and fault.sizes[0] <= fault.sizes[1] for fault in FAULTS)
