"""The outline of an object through a build: declared, corrected by hand, refused, drawn, and what it makes stale."""

import json

import cv2
import numpy as np
import pytest

from levkas.building import build, status, summarise
from levkas.campaign.edits import Edits, write_edits
from levkas.core.text import read_json
from levkas.database.catalogue import read_catalogue

HALF = ((10.0, 10.0), (119.0, 10.0), (119.0, 189.0), (10.0, 189.0))
WIDER = ((10.0, 10.0), (200.0, 10.0), (200.0, 189.0), (10.0, 189.0))


def record_of(folder):
    return read_json(folder / "database/objects/one/registration/infrared.json")


def stale(folder):
    return {step.key.stage for step in status(folder).stages if step.state == "stale"}


@pytest.mark.slow
def test_an_outline_is_compared_within_drawn_corrected_by_hand_and_refused_by_its_file(
    make_plates, tmp_path
):
    folder = make_plates(tmp_path / "campaign", ["one"])
    toml = folder / "campaign.toml"
    plain = toml.read_text()
    toml.write_text(f"{plain}\n[objects.one]\noutline = {json.dumps(HALF)}\n")
    report = build(folder)
    assert summarise(report).ok
    record, share = record_of(folder), 110 * 180 / (240 * 200)
    mask, verdict = record["model"]["mask"], record["verdict"]
    assert not mask["automatic"] and mask["outline"] == [list(corner) for corner in HALF]
    assert abs(verdict["outside"] - (1 - share)) < 0.01 < verdict["outside"] <= verdict["unchecked"]
    page = (folder / "database/objects/one/report.html").read_text()
    assert "Outline of the object" in page and "As declared." in page
    assert "lies outside the object&#39;s outline" in page
    checked = f"{round(100 * (1 - verdict['unchecked']))} % of the layer"
    assert page.count(checked) >= 2 and "outline" not in read_text(folder, "object.toml")
    assert stale(folder) == set()
    # By hand it is corrected; what was calibrated stays.
    write_edits(folder / "edits.toml", Edits().with_outline("one", WIDER))
    assert "register" in stale(folder) and "calibrate" not in stale(folder)
    assert summarise(build(folder)).ok
    assert record_of(folder)["model"]["mask"]["outline"] == [list(corner) for corner in WIDER]
    assert record_of(folder)["verdict"]["outside"] < verdict["outside"] - 0.2
    # One that leaves the frame is refused by the file that has it, and nothing else is.
    write_edits(folder / "edits.toml", Edits().with_outline("one", (*WIDER[:2], (900.0, 189.0))))
    (problem, *_) = [p for step in build(folder) for p in getattr(step, "problems", ())]
    assert problem.file.endswith("edits.toml") and problem.field == "objects.one.outline"
    assert "outside the reference" in problem.message and "(900, 189)" in problem.found


def read_text(folder, name):
    return (folder / "database/objects/one" / name).read_text()


def panel(folder):
    """Write a campaign of one photograph: a panel of 160 x 200 px on a ground that is brighter than its lower half."""
    rng = np.random.default_rng(3)
    picture = 60 + rng.normal(0, 0.6, (340, 300))
    light = np.linspace(230, 25, 200)[:, None] * np.where(np.arange(200) < 130, 1, 0.5)[:, None]
    picture[70:270, 70:230] = light + rng.normal(0, 6, (200, 160))
    folder.mkdir()
    cv2.imwrite(str(folder / "icon.png"), picture.clip(0, 255).astype(np.uint8))
    (folder / "campaign.toml").write_text(
        '[campaign]\nreference = { camera = "photo" }\n[grid]\nregion = "auto"\n'
        '[cameras.photo]\nkind = "image"\nfiles = "{target}.png"\n'
        "[objects.icon]\nsize_mm = [100, 125]\n"
    )
    return folder


def test_the_grid_and_the_sampling_are_of_the_outline_that_is_drawn(tmp_path):
    folder = panel(tmp_path / "campaign")

    def built():
        report = summarise(build(folder))
        assert report.ok
        (entry,) = read_catalogue(folder / "database")
        unknown = any("outline = [[x, y]" in warning for warning in report.warnings)
        assert unknown == np.isnan(entry.px_per_mm)
        return entry

    entry = built()
    assert 160 <= entry.width <= 168 and 200 <= entry.height <= 208
    assert entry.px_per_mm == pytest.approx(1.6, rel=0.01)
    by_hand = ((70.0, 70.0), (229.0, 70.0), (229.0, 269.0), (70.0, 269.0))
    write_edits(folder / "edits.toml", Edits().with_outline("icon", by_hand))
    entry = built()
    assert (entry.width, entry.height) == (160, 200)
    assert entry.px_per_mm == pytest.approx(1.6, rel=0.01)
    # The upper half has not the shape of the whole: its lengths are not known, and not wrong.
    upper = (*by_hand[:2], (229.0, 169.0), (70.0, 169.0))
    write_edits(folder / "edits.toml", Edits().with_outline("icon", upper))
    entry = built()
    assert (entry.width, entry.height) == (160, 100) and np.isnan(entry.px_per_mm)
