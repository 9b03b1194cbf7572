"""Stray light of whole builds: planted with a form that is not the model's, measured in a trap and on a chart, budgeted."""

import json
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import levkas
from levkas.building import build, status, summarise
from levkas.core.problems import Refused
from levkas.quality.targets.charts import chart_of, reference_of
from levkas.stages.charts import measure_charts

sys.path.insert(0, str(Path(__file__).parents[1] / "promises"))
import camera as promises

SHAPE = (160, 200)
PLANTED = 0.01
QUIET = {"gain": 0.02, "read": 0.3, "shots": (4, 4, 4)}
"""Counts an electron, counts: what strays is to be seen in tiles of 100 pixels."""
BOX = (82, 62, 36, 36)
TRAPS = f"traps = {{ panel = {{ cam = [{', '.join(map(str, BOX))}] }} }}\n[cameras.cam]"


def paint():
    """Return tiles, with a light trap among them that reflects nothing."""
    truth, inner = promises.tones(SHAPE)
    truth = truth.copy()
    x, y, width, height = BOX
    truth[y - 2 : y + height + 2, x - 2 : x + width + 2] = 0.0
    return truth, inner


def campaign_of(folder, *, traps=True, chart=None, kind="bands", **habits):
    made = promises.write_campaign(
        folder, kind, promises.Habits(**(QUIET | habits)), SHAPE, truth=paint()[0], chart=chart
    )
    path = made / "campaign.toml"
    text = path.read_text().replace("[cameras.cam]", TRAPS) if traps else path.read_text()
    path.write_text(text)
    return made


def row_of(folder):
    record = json.loads((folder / "database/objects/panel/provenance.json").read_text())
    (step,) = [one for one in record["steps"] if one["stage"] == "calibrate"]
    (row,) = [row for row in step["uncertainty"] if row["source"] == "stray light"]
    return row


@pytest.fixture(scope="module")
def veiled(tmp_path_factory):
    folder = campaign_of(tmp_path_factory.mktemp("stray") / "c", stray=PLANTED, stray_px=30.0)
    report = summarise(build(folder))
    assert report.ok
    return folder, report


def test_a_trap_gives_the_budget_its_stray_light(veiled):
    folder, _ = veiled
    row = row_of(folder)
    assert row["basis"] == "measured" and row["common_to"] == "camera"
    for size in row["size"].values():
        assert size == pytest.approx(PLANTED, rel=0.35)


@pytest.mark.slow
def test_greys_of_a_chart_give_the_budget_its_stray_light_and_rebuild_the_report_with_the_chart(
    tmp_path,
):
    """Of charts the black is known to 0.002, of a view whose mean is 0.2: to 1 % of that."""
    nm = np.array(promises.WAVELENGTHS, float)
    patches = reference_of(chart_of("ColorChecker24")).at(nm)
    folder = campaign_of(tmp_path / "c", traps=False, chart=patches, stray=0.05)
    assert summarise(build(folder)).ok
    row = row_of(folder)
    assert row["basis"] == "measured"
    assert max(row["size"].values()) == pytest.approx(0.05, abs=0.015)
    text = (folder / "campaign.toml").read_text()
    (folder / "campaign.toml").write_text(re.sub(r"(?m)^charts = .*$", "", text))
    stale = {step.key.stage for step in status(folder).stages if step.state == "stale"}
    assert "report" in stale and "calibrate" not in stale
    assert summarise(build(folder)).ok and row_of(folder)["basis"] == "unknown"


@pytest.mark.slow
def test_a_chart_target_may_be_a_trap_alone(tmp_path):
    """What is captured as `flare` shows a trap before a white wall, and the panel has none."""
    folder = campaign_of(tmp_path / "c", traps=False, stray=0.02)
    for path in (folder / "raw").glob("panel_*"):
        shutil.copy(path, path.with_name(path.name.replace("panel", "flare")))
    text = (folder / "campaign.toml").read_text()
    named = 'charts = { flare = "trap" }\n' + TRAPS.replace("panel", "flare")
    (folder / "campaign.toml").write_text(text.replace("[cameras.cam]", named))
    assert summarise(build(folder)).ok
    row = row_of(folder)
    assert row["basis"] == "measured"
    assert max(row["size"].values()) == pytest.approx(0.02 / 1.02, rel=0.2)
    page = (folder / "database/cameras/cam/report.html").read_text()
    assert "light traps show" in page and "was not measured" not in page
    assert "light traps show" in measure_charts(folder).text


@pytest.mark.parametrize(
    ("old", "new", "field"),
    [
        ("bits = 12", "bits = 12\nstray_light = { share = 0.01 }", "cameras.cam.stray_light"),
        ("{ panel = { cam", "{ panel = { other", "targets.traps.panel"),
        ("{ panel = { cam", "{ flare = { cam", "targets.traps.flare"),
        ("[82, 62, 36, 36]", "[82, 62, 36]", "targets.traps.panel.cam"),
        ("[82, 62, 36, 36]", "[182, 62, 36, 36]", "targets.traps.panel"),
    ],
)
def test_stray_light_that_is_declared_wrongly_is_refused(veiled, tmp_path, old, new, field):
    folder = shutil.copytree(veiled[0], tmp_path / "c", ignore=shutil.ignore_patterns("database*"))
    text = (folder / "campaign.toml").read_text()
    assert old in text
    (folder / "campaign.toml").write_text(text.replace(old, new, 1))
    try:
        problems = summarise(build(folder)).problems
    except Refused as refused:
        problems = refused.problems
    assert field in [problem.field for problem in problems]


def test_traps_of_a_scanner_are_refused(tmp_path):
    folder = campaign_of(tmp_path / "c", kind="cube", traps=True)
    with pytest.raises(Refused) as refused:
        levkas.load_campaign(folder)
    fields = {problem.field for problem in refused.value.problems}
    assert fields == {"targets.traps.panel"}
