"""`levkas plan` and its report."""

import json
import re

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.cli import app
from levkas.pages.plan import write_report
from levkas.planning import plan_light
from levkas.planning.exposure_advice import advise_frames


def run(*words):
    return CliRunner().invoke(app, ["plan", *map(str, words)])


@pytest.mark.slow
def test_light_is_told_in_lines_and_as_one_object(rewritten):
    path = rewritten()
    said = run("light", path, "--optimise")
    assert said.exit_code == 0, said.output
    assert "drop 7.7 %" in said.output and "Best pair: 69°" in said.output
    assert "smaller than the object" in said.output
    record = json.loads(run("light", path, "--optimise", "--json", "-s", "45-degree").stdout)
    assert record["command"] == "plan light" and record["ok"]
    assert record["light"]["setup"] == "45-degree" and len(record["setups"]) == 5
    assert record["optimum"]["weights"]["varnish"] == 2.0


def test_framing_and_exposure_are_told(rewritten):
    path = rewritten()
    assert "268 x 200 mm from 185 cm" in run("framing", path).output
    said = run("exposure", "--setup", path)
    assert "weakest B2" in said.output
    assert "lx·h" in said.output
    record = json.loads(run("exposure", "--setup", path, "--json").stdout)
    assert record["dose"]["sensitivity"] == "medium" and len(record["cameras"]) == 4


def test_a_bad_setup_is_refused_with_status_1(rewritten):
    path = rewritten(("distance_mm = 2100", "distance_mm = 2.1"))
    said = run("light", path)
    assert said.exit_code == 1 and "E_VALUE" in said.stderr
    record = json.loads(run("light", path, "--json").stdout)
    assert record["ok"] is False and record["problems"][0]["field"].endswith("distance_mm")
    assert run("light", rewritten(), "-s", "no-such").exit_code == 1


def test_the_report_stands_alone_and_says_what_matters(bench, tmp_path):
    page = write_report(tmp_path / "plan.html", bench).read_text(encoding="utf-8")
    assert "default-src 'none'" in page and "@page { size:A4" in page
    assert not re.search(r'(?:src|href)="(?!data:|#)', page)
    for words in (
        "Two lamps at 70°", "the bright field", "along the width", "cannot show the whole object",
        "lx·h", "CIE 157:2004", "of equal power",
    ):  # fmt: skip
        assert words in page, words
    assert page.count("<svg") == 5 and not re.search(r"\bnan\b", page)


def test_a_report_of_a_matte_object_without_cameras_has_what_there_is(rewritten, tmp_path):
    from levkas.planning import load_setup

    path = rewritten(
        ("varnish = { roughness = 0.1 }", ""), ("gold = { roughness = 0.2 }", ""),
        ("recess_mm = 3 ", ""),
        cut_cameras=True,
    )  # fmt: skip
    page = write_report(tmp_path / "plan.html", load_setup(path)).read_text(encoding="utf-8")
    assert "What shines" not in page and "Cameras" not in page and "Evenness" in page


@pytest.mark.slow
def test_text_from_a_setup_file_is_escaped_in_the_report(rewritten, tmp_path):
    from levkas.planning import load_setup

    path = rewritten(
        ('title = "The largest icon, on its side"', 'title = "<script>alert(1)</script>"'),
        ("[setups.proposed]", '[setups."<b>proposed"]'),
    )
    page = write_report(tmp_path / "plan.html", load_setup(path)).read_text(encoding="utf-8")
    assert "<script>" not in page and "<b>proposed" not in page


def test_help_loads_nothing_heavy():
    import subprocess
    import sys

    code = (
        "import sys; from typer.testing import CliRunner; from levkas.cli import app;"
        "r = CliRunner().invoke(app, ['plan', '--help']); assert r.exit_code == 0, r.output;"
        "print([m for m in ('numpy', 'jinja2', 'scipy') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_plan_needs_neither_scipy_nor_colour_science(rewritten):
    import subprocess
    import sys

    code = (
        f"import sys; from levkas.planning.text_report import light_record;"
        f"light_record({str(rewritten())!r});"
        "print([m for m in ('scipy', 'colour', 'numba') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_a_plan_of_a_lighting_keeps_its_name(bench):
    assert plan_light(bench, "soft").lighting.name == "soft"


def test_of_a_matte_panel_nothing_is_said_of_varnish_and_gold(rewritten):
    path = rewritten(
        ("varnish = { roughness = 0.1 }", ""),
        ("gold = { roughness = 0.2 }", ""),
        ("recess_mm = 3", ""),
    )
    result = CliRunner().invoke(app, ["plan", "light", str(path), "-s", "45-degree"]).output
    assert "nothing on it shines" in result and "varnish shines" not in result
    page = path.with_name("plan.html")
    CliRunner().invoke(app, ["plan", "light", str(path), "--report", str(page)])
    assert "varnish and leaf facets" not in page.read_text(encoding="utf-8")


def test_sensors_of_a_beam_splitter_are_read_by_their_campaign(tmp_path):
    rng = np.random.default_rng(2)
    levels = {"ccd1": (900, 1800, 700), "ccd2": (1500, 1200, 400), "ccd3": (2600, 2600, 2600)}
    for target, on in (("white", 1), ("dark", 0)):
        (tmp_path / "raw" / target).mkdir(parents=True)
        for i, (sensor, (r, g, b)) in enumerate(levels.items()):
            tile = np.tile([[r, g], [g, b]], (60, 80)) * on + 50.0 + 10 * i
            for shot in range(2):
                frame = np.rint(tile + 3 * rng.standard_normal(tile.shape)).astype(np.uint16)
                tifffile.imwrite(tmp_path / "raw" / target / f"{sensor}_{shot}.tif", frame)
    sensors = "".join(
        f'[[cameras.msbs.sensors]]\nname = "{name}"\nfiles = "raw/{{target}}/{name}_{{shot}}.tif"\n{keys}\n'
        for name, keys in (
            ("ccd1", 'pattern = "RGGB"\nbands = ["R1", "G1", "B1"]'),
            ("ccd2", 'pattern = "RGGB"\nbands = ["R2", "G2", "B2"]'),
            ("ccd3", 'bands = ["IR"]'),
        )
    )
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\nreference = { camera = "msbs" }\n[cameras.msbs]\nkind = "sensors"\nbits = 12\n'
        f'{sensors}[targets]\ndark = "dark"\nwhite = "white"\n'
    )
    found = advise_frames([tmp_path / "raw/white"], [tmp_path / "raw/dark"])
    assert [band.shot.name for band in found] == ["white ccd1", "white ccd2", "white ccd3"]
    levels = {a.reading.channel: a.reading.mean for band in found for a in band.advices}
    wanted = dict(
        zip(
            ("R1", "G1", "B1", "R2", "G2", "B2", "IR"),
            (900, 1800, 700, 1500, 1200, 400, 2600),
            strict=True,
        )
    )
    assert levels == pytest.approx(wanted, rel=0.005)  # each sensor's own dark is taken off
