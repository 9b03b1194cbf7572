"""A lamp that changes is no noise of pixels: whole builds of simulated campaigns whose lamp drifts."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile

from levkas.calibration.drift import LAMP
from levkas.stages.capture_statistics import describe_lamp

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))
from sigma_of_builds import LIGHT, Camera, built, scene, spreads, write_campaign

SHAPE = (100, 140)


class Built:
    """One camera of filters, built: values over truth, and what is said of the lamp."""

    def __init__(self, folder, lamp, times=None, **more):
        tones, inside = scene(SHAPE)
        write_campaign(folder, "bands", Camera(SHAPE), tones, lamp=lamp, **more)
        for name, moment in (times or {}).items():
            for path in folder.glob(f"raw/{name}.tif"):
                tifffile.imwrite(path, tifffile.imread(path), datetime=moment)
        made = built(folder)
        mask = np.repeat(inside[..., None], 4, 2)
        self.rows = spreads(*made, tones * lamp("panel", 0), tones, mask)
        ratio = made[0] / tones[..., None]
        bright = inside & (tones > 0.1)
        self.bias = float(np.mean(ratio[bright])) - 1
        self.miss = ratio[bright] - 1
        self.sigma = made[1][bright] / tones[bright][:, None]
        steps = json.loads((folder / "database/objects/panel/provenance.json").read_text())["steps"]
        (step,) = [one for one in steps if one["stage"] == "calibrate"]
        self.budget = {one["source"]: one for one in step.get("uncertainty", [])}
        self.report = (folder / "database/objects/panel/report.html").read_text()
        camera = folder / "database/cameras/cam"
        self.camera = (camera / "report.html").read_text()
        self.gain = json.loads((camera / "camera.json").read_text())["measured"][""][""]["sensor"][
            "gain"
        ]


def before_and_after(name, shot, band=0):
    """Whites 5 % apart, and an object that is darker than both."""
    return {"white": [1.025, 0.975][shot % 2], "panel": 0.96}.get(name, 1.0)


@pytest.fixture(scope="module")
def drifted(tmp_path_factory):
    return Built(tmp_path_factory.mktemp("drifted") / "c", before_and_after, whites=2)


def test_a_lamp_that_changes_within_a_stack_is_no_noise(drifted):
    # 700 values each and more: 4 % of chance, and 2 % of the model
    assert drifted.gain == pytest.approx(0.25, rel=0.03)
    spread = np.array([row[2] for row in drifted.rows])
    assert np.abs(spread - 1).max() < 0.15
    assert abs(spread.mean() - 1) < 0.03


def test_what_the_lamp_did_between_white_and_object_is_in_the_budget_and_reported(drifted):
    lamp = drifted.budget["lamp between white and object"]
    assert lamp["common_to"] == "frame" and not lamp["all_bands"]  # one file a band
    assert lamp["size"] == pytest.approx(dict.fromkeys(lamp["size"], 0.05), rel=0.02)
    assert drifted.bias == pytest.approx(-0.04, abs=0.003)
    combined = np.hypot(drifted.sigma, lamp["size"]["550 nm"])
    assert np.mean(np.abs(drifted.miss) < 1.96 * combined) > 0.95
    assert "known between white and object to 5 %" in drifted.report
    assert "changed by -5 % within the white" in drifted.camera


def test_a_black_level_that_wanders_is_no_noise_and_is_in_the_budget(tmp_path):
    wander = np.random.default_rng(3).normal(0, 6, 8)

    class Wandering(Camera):
        def frame(self, reflectance, seconds, light=LIGHT, lamp=1.0):
            black, self.black = (
                self.black,
                self.black + (lamp if np.ndim(reflectance) and not np.any(reflectance) else 0),
            )
            made = super().frame(reflectance, seconds, light)
            self.black = black
            return made

    tones, inside = scene(SHAPE)
    folder = tmp_path / "c"
    write_campaign(
        folder,
        "bands",
        Wandering(SHAPE),
        tones,
        lamp=lambda name, shot, band=0: wander[shot] if name == "dark" else 0.0,
    )
    values, sigma, _ = built(folder)
    dark = inside & (tones < 0.02)
    miss = (values[dark] - tones[dark][:, None]) / sigma[dark]
    assert abs(miss.std(0).mean() - 1) < 0.05
    steps = json.loads((folder / "database/objects/panel/provenance.json").read_text())["steps"]
    (step,) = [one for one in steps if one["stage"] == "calibrate"]
    (black,) = [one for one in step["uncertainty"] if one["source"].startswith("black level")]
    expected = wander.std(ddof=1) * np.sqrt(1 + 1 / 8) / (0.25 * LIGHT)
    assert black["size"]["550 nm"] == pytest.approx(expected, rel=0.35)


def test_noise_of_a_weak_band_is_no_change_of_the_lamp():
    none = {"white": 0.0, "object": None, "flicker": 0.0, "sigma": 0.007}
    weak = none | {"black": None, "black_sigma": 0.0}
    assert describe_lamp({"": {LAMP: {"1000 nm": weak}}}) == []
    strong = weak | {"white": -0.006, "sigma": 0.006}
    (note,) = describe_lamp({"": {LAMP: {"1000 nm": weak, "900 nm": strong}}})
    assert "900 nm" in note and "-0.6 % within the white" in note


def test_a_page_says_that_a_white_of_one_shot_tells_nothing_of_the_lamp(drifted, tmp_path):
    once = Built(tmp_path / "c", lambda name, shot, band=0: 1.0, whites=1)
    assert "how the lamp changed was not measured" in once.camera
    assert "how the lamp changed was not measured" not in drifted.camera
    assert "all at once between white and object is not known" in drifted.camera


def sinking(name, line, band=0):
    """Two per cent from the first line of a white of 100 to the last of an object of 480."""
    return 1 - 0.02 * {"dark": 0, "white": line, "panel": 100 + line}[name] / 579


def test_a_lamp_that_sinks_along_a_scan_is_in_the_budget_up_to_its_last_line(tmp_path):
    folder, shape = tmp_path / "c", (480, 60)
    camera, (tones, _) = Camera(shape), scene(shape)
    camera.response, camera.black = camera.response[:1], camera.black[:1]
    built(write_campaign(folder, "cube", camera, tones, lamp=sinking))
    provenance = json.loads((folder / "database/objects/panel/provenance.json").read_text())
    (step,) = [one for one in provenance["steps"] if one["stage"] == "calibrate"]
    (lamp,) = [one for one in step["uncertainty"] if one["source"].startswith("lamp")]
    assert [*lamp["size"].values()] == pytest.approx([0.02 * (50 + 480) / 579] * 4, rel=0.4)
    report = (folder / "database/objects/panel/report.html").read_text()
    assert "last line lies 5.3 times as far" in report
