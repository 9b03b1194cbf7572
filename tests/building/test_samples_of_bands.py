"""Frames of bands whose pixels have more than one sample, through a whole build."""

import numpy as np
import pytest
import tifffile

import levkas
from levkas.building import build, summarise

SIZE = (90, 110)
BANDS = (500, 600)
CAMPAIGN = """
[campaign]
reference = { camera = "cam", band = "500 nm" }
[cameras.cam]
kind = "bands"
files = "raw/{target}_{wavelength}nm.tif"
[targets]
dark = "dark"
white = "white"
objects = ["panel", "other"]
"""


def truth(band):
    rng = np.random.default_rng(5)
    made, (y, x) = np.zeros(SIZE), np.indices(SIZE)
    for _ in range(50):
        cy, cx, s, a = (
            rng.uniform(0, SIZE[0]),
            rng.uniform(0, SIZE[1]),
            rng.uniform(2, 12),
            rng.normal(),
        )
        made += a * (1 + 0.4 * band) * np.exp(-((y - cy) ** 2 + (x - cx) ** 2) / (2 * s * s))
    return 0.1 + 0.7 / (1 + np.exp(-made))


def make(folder, write, objects=("panel", "other")):
    rng = np.random.default_rng(1)
    (folder / "raw").mkdir(parents=True)
    for k, band in enumerate(BANDS):
        for target in ("dark", "white", *objects):
            light = {"dark": 0.0, "white": 1.0}.get(target, truth(k))
            codes = np.rint(60 + 3000 * light + rng.normal(0, 2, SIZE)).astype(np.uint16)
            write(folder / f"raw/{target}_{band}nm.tif", codes, target)
    (folder / "campaign.toml").write_text(CAMPAIGN)
    return folder


def with_alpha(path, codes, _):
    samples = np.dstack([codes, np.full(SIZE, 65535, np.uint16)])
    tifffile.imwrite(path, samples, photometric="minisblack", extrasamples=["unassalpha"])


def as_colours(path, codes, target):
    samples = np.dstack([codes] * 3)
    if target == "other":
        samples[..., 1] += 1
    tifffile.imwrite(path, samples, photometric="rgb")


@pytest.mark.slow
def test_alpha_and_equal_samples_are_left_out_and_one_bad_object_is_one_refusal(tmp_path):
    for name, write in (("alpha", with_alpha), ("colours", as_colours)):
        folder = make(tmp_path / name, write)
        report = summarise(build(folder))
        refused = [step for step in report.stages if step.state == "refused"]
        if name == "alpha":
            assert not refused and "alpha" in report.text
        else:
            assert [step.key.object for step in refused] == ["other"]
            assert "other_500nm.tif" in str(refused[0].problems)
        cube = levkas.open(folder / "database")["panel"]["cam"]
        for k in range(len(BANDS)):
            assert abs(np.median(cube.values[..., k] / truth(k)) - 1) < 1e-3
