"""Every kind of key points that the docs offer registers a small campaign by the paper's method."""

import json
import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from levkas.building import build, summarise
from levkas.building.plan import check_detectors
from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.geometry import from_dict
from levkas.registration.features import DETECTORS, available_detectors

pytestmark = pytest.mark.slow

DOCS = Path(__file__).resolve().parents[2] / "docs" / "campaign.md"
(ROW,) = (
    line for line in DOCS.read_text(encoding="utf-8").splitlines() if "| `detector` |" in line
)
SMALL = """
[campaign]
reference = "vis"
[cameras.vis]
kind = "image"
files = "{target}.png"
"""
OFFERED = sorted(set(re.findall(r'`"([a-z]+)"`', ROW)))


def test_the_docs_offer_what_opencv_has_and_no_more():
    assert set(OFFERED) <= set(available_detectors()) and {"sift", "orb"} <= set(OFFERED)


def test_a_detector_that_opencv_lacks_is_refused_with_those_that_it_has(tmp_path):
    here = available_detectors()
    assert {"sift", "orb"} <= set(here)
    for detector in DETECTORS:
        for table in ("registration", "cameras.vis.registration"):
            keys = f'[{table}]\nmethod = "mirhashemi2019"\ndetector = "{detector}"\n'
            (tmp_path / "campaign.toml").write_text(SMALL + keys)
            if detector in here:
                check_detectors(load_campaign(tmp_path))
                continue
            with pytest.raises(CampaignInvalid, match="OpenCV") as refused:
                check_detectors(load_campaign(tmp_path))
            (problem,) = refused.value.problems
            assert problem.field == f"{table}.detector" and problem.found == detector
            assert all(f'"{name}"' in problem.expected for name in here)


@pytest.fixture(scope="module")
def plates(make_plates, tmp_path_factory):
    """A photograph and one of the same sign at twice its sampling; the paper's method knows no other."""
    folder = make_plates(tmp_path_factory.mktemp("detectors") / "plates", ["one"])
    for part in ("photo", "infrared"):
        path = str(folder / part / "one.png")
        picture = cv2.imread(path, cv2.IMREAD_UNCHANGED)
        larger = cv2.resize(picture, None, fx=2, fy=2, interpolation=cv2.INTER_CUBIC)
        cv2.imwrite(path, larger if part == "photo" else 255 - larger)
    return folder


@pytest.mark.parametrize("detector", OFFERED)
def test_every_documented_detector_registers_a_campaign(plates, tmp_path, detector):
    text = (plates / "campaign.toml").read_text()
    for part in ("photo", "infrared"):
        text = text.replace(f'"{part}/', f'"{plates}/{part}/')
    keys = f'[registration]\nmethod = "mirhashemi2019"\norder = 1\ndetector = "{detector}"\n'
    (tmp_path / "campaign.toml").write_text(text + keys)
    report = summarise(build(tmp_path))
    assert report.ok, report.text
    record = json.loads(
        (tmp_path / "database/objects/one/registration/infrared.json").read_text(encoding="utf-8")
    )
    assert record["method"] == "mirhashemi2019" and record["verdict"]["decision"] == "accept"
    found = from_dict(record["bands"]["grey"]["transform"])
    places = np.stack(np.meshgrid(np.linspace(60, 400, 6), np.linspace(60, 340, 6)), -1)
    # As make_plates draws them, both of twice that size: photograph → drawing → infrared.
    drawn = (places.reshape(-1, 2) + 0.5) / 2 * 2 - 0.5
    slope = np.array([[1.9, 0.04], [-0.04, 1.9]])
    truth = (np.linalg.solve(slope, (drawn - (6.0, 9.0)).T).T + 0.5) * 2 - 0.5
    assert np.median(np.hypot(*(found(places.reshape(-1, 2)) - truth).T)) < 0.5
