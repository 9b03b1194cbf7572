"""Names of objects, cameras, setups, sensors and charts: those that no program and no system takes otherwise."""

import subprocess

import pytest

from levkas.building import build, summarise
from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.campaign.schema.names import why_unsafe
from levkas.publish import run

ODD = "-a#b [1] it's; é&$~`^+=,!"
"""What is odd, and travels."""
UNSAFE = {
    "Icon 50%": "'%'", "%41": "'%'", "a/b": "'/'", "a\\b": "'\\\\'", "a:b": "':'", "a?": "'?'",
    "con": "Windows", "NUL.tif": "Windows", "lpt1": "Windows", "a\nb": "U+000A", "a\x85b": "U+0085",
    "a\u2028b": "U+2028", "a\u202eb": "U+202E", "a\udc80": "U+DC80", ".a": "dot", "a.": "dot", "a ": "space",
    "a\xa0": "space", "x" * 81: "81 letters", "": "empty", "e\u0301": "NFC", "a.levkas.partial-12345678": "unfinished",
}  # fmt: skip


@pytest.mark.parametrize("name", UNSAFE)
def test_a_name_that_does_not_travel_is_known_with_its_reason(name):
    assert UNSAFE[name] in why_unsafe(name)


@pytest.mark.parametrize("name", [ODD, "d80", "console", "com", "a.b", "日本語", "x" * 80, "Икона"])
def test_a_name_that_travels_is_left_alone(name):
    assert why_unsafe(name) == ""


@pytest.mark.parametrize(
    ("before", "after", "field"),
    [
        ('["one"]', '["Icon 50%"]', "objects.Icon 50%"),
        ("[cameras.infrared]", '[cameras."50%"]', "cameras.50%"),
        ("[targets]", '[setups."50%"]\ntitle = "Half"\n[targets]', "setups.50%"),
        ("[targets]", '[targets]\ncharts = { "50%" = "edges" }', "targets.charts.50%"),
    ],
)
def test_a_campaign_with_such_a_name_is_refused_before_it_is_built(
    make_plates, tmp_path, before, after, field
):
    folder = make_plates(tmp_path / "campaign", ["one"])
    text = (folder / "campaign.toml").read_text()
    assert before in text
    (folder / "campaign.toml").write_text(text.replace(before, after))
    with pytest.raises(CampaignInvalid) as refused:
        load_campaign(folder)
    assert field in {problem.field for problem in refused.value.problems}


@pytest.mark.slow
def test_a_layer_whose_files_would_have_too_long_a_name_is_refused_by_name(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", ["日" * 80, "one"])
    report = summarise(build(folder))
    assert {s.key.object for s in report.stages if s.state == "refused"} == {"日" * 80}
    assert report.problems[0].code == "E_VALUE"


@pytest.mark.slow
def test_an_odd_name_survives_checksums(make_plates, tmp_path):
    folder = make_plates(tmp_path / "campaign", [ODD])
    text = (folder / "campaign.toml").read_text()
    head = '[campaign]\ncreator = "Doe, Jane"\nlicence = "CC-BY-4.0"\n'
    (folder / "campaign.toml").write_text(text.replace("[campaign]\n", head))
    assert summarise(build(folder)).ok
    list(run.publish(folder / "database", output=tmp_path / "out"))
    for place in (folder / "database", tmp_path / "out"):
        command = ["sha256sum", "-c", "--quiet", "manifest-sha256.txt"]
        done = subprocess.run(command, cwd=place, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stdout
