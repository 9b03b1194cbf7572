"""What people read in a terminal: each mistake once, in three short lines, before any stage runs."""

import io
import re
import shutil

import cv2
import numpy as np
import pytest
import tifffile
from rich.console import Console
from typer.testing import CliRunner

from levkas.building.build_records import Key
from levkas.building.graph import Step
from levkas.cli import ORDER, app
from levkas.cli.output import draw_bar

TOML = """
[campaign]
title = "Two cameras"
date = 2020-01-01
reference = { camera = "vis", band = "550 nm" }
[cameras.vis]
kind = "bands"
files = "raw/vis/{target}/{wavelength}nm.tif"
[cameras.nir]
kind = "bands"
files = "raw/nir/{target}/{wavelength}nm.tif"
[targets]
dark = "dark"
white = { names = "white", reflectance = 0.99 }
objects = ["icon1"]
"""


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Frames of two cameras: small, of noise and strokes, enough to be found."""
    root = tmp_path_factory.mktemp("frames")
    rng = np.random.default_rng(1)
    for camera, centres in (("vis", (500, 550, 600)), ("nir", (800, 850))):
        for target, level in (("dark", 60), ("white", 3000), ("icon1", 1500)):
            for nm in centres:
                path = root / "raw" / camera / target / f"{nm}nm.tif"
                path.parent.mkdir(parents=True, exist_ok=True)
                tifffile.imwrite(path, rng.normal(level, 5, (60, 80)).astype(np.uint16))
    return root


@pytest.fixture
def campaign(frames, tmp_path):
    """Return what writes the campaign with a mistake: `campaign(old, new)`."""

    def write(old="", new=""):
        shutil.copytree(frames / "raw", tmp_path / "raw", dirs_exist_ok=True)
        assert old in TOML
        (tmp_path / "campaign.toml").write_text(TOML.replace(old, new) if old else TOML)
        return tmp_path

    return write


def run(*words):
    """Run a command: (exit status, standard output, standard error)."""
    done = CliRunner().invoke(app, [str(w) for w in words])
    assert done.exception is None or isinstance(done.exception, SystemExit), done.exception
    return done.exit_code, done.stdout, done.stderr


MISTAKES = [
    ('"550 nm"', '"560 nm"', "E_BAND_MISSING", "Did you mean '550 nm' or '600 nm'?"),
    ('"vis", band', '"viss", band', "E_VALUE", "Did you mean 'vis'?"),
    ('names = "white"', 'names = "whit"', "E_TEMPLATE_MISSING", "Did you mean 'white'?"),
    ('dark = "dark"', 'dark = "drak"', "E_TEMPLATE_MISSING", "Did you mean 'dark'?"),
    ('["icon1"]', '["icno1"]', "E_NO_FRAMES", "Did you mean 'icon1'?"),
    ('"raw/vis', '"rwa/vis', "E_NO_FRAMES", "Did you mean 'raw'?"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "code", "fix"), MISTAKES, ids=[m[1] for m in MISTAKES])
def test_a_mistake_is_one_message_of_three_lines_before_any_stage(campaign, old, new, code, fix):
    folder = campaign(old, new)
    status, out, err = run("build", folder)
    assert status == 1 and out == ""
    what, where, do = err.splitlines()
    assert what.startswith(f"{code}: ") and where.startswith("  where: ") and do == f"  do: {fix}"
    assert not (folder / "database").exists()


def test_a_refusal_and_what_follows_from_it_are_said_once(campaign):
    folder = campaign()
    (folder / "raw/vis/icon1/550nm.tif").write_bytes(b"no picture")
    status, out, err = run("build", folder)
    assert status == 1 and err.count("E_UNREADABLE") == 1 and "E_NO_REFERENCE" not in err + out
    lines = err.splitlines()
    at = next(i for i, line in enumerate(lines) if line.startswith("E_"))
    assert lines[at - 1] == "icon1/vis calibrate: refused"
    assert "550nm.tif" in lines[at + 1] and lines[at + 2].startswith("  do: ")
    assert "refused" in out and "E_" not in out


def test_a_build_ends_with_the_verdict_of_each_layer_that_it_did(tmp_path):
    """Two pictures of one panel, 3 px apart: one is the reference, the other is judged; what is fresh is not told again."""
    rng = np.random.default_rng(4)
    panel = cv2.GaussianBlur(rng.random((200, 240)).astype(np.float32), (0, 0), 2)
    panel = np.uint8(255 * (panel - panel.min()) / np.ptp(panel))
    for camera, left in (("photo", 3), ("infrared", 0)):
        (tmp_path / camera).mkdir()
        cv2.imwrite(str(tmp_path / camera / "icon1.png"), panel[:, left : left + 230])
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\ntitle = "Two"\ndate = 2020-01-01\nreference = { camera = "photo" }\n'
        '[cameras.photo]\nkind = "image"\nfiles = "photo/{target}.png"\n'
        '[cameras.infrared]\nkind = "image"\nfiles = "infrared/{target}.png"\n'
    )
    status, out, _ = run("build", tmp_path)
    lines = out.splitlines()
    assert status == 0 and "icon1/photo: reference" in lines
    judged = next(line for line in lines if line.startswith("icon1/infrared: "))
    assert re.match(r".*(accepted|doubtful, please check), held-out error 0\.\d{3} px", judged)
    assert lines[-1].endswith("database")
    _, again, _ = run("build", tmp_path)
    assert "reference" not in again


# --- bar and help ---------------------------------------------------------------------------------


def drawn(steps):
    """Return what a terminal shows while steps go by."""
    screen = io.StringIO()
    console = Console(file=screen, force_terminal=True, width=160, color_system=None)
    draw_bar(steps, console)
    return re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", screen.getvalue())


def test_the_bar_counts_work_alone_and_promises_no_time():
    keys = [Key("a", camera, stage="calibrate") for camera in ("c1", "c2", "c3", "c4")]
    steps = [
        Step(keys[0], "fresh", done=1, total=4), Step(keys[1], "fresh", done=2, total=4),
        Step(keys[2], "running", done=2, total=4), Step(keys[2], "done", done=3, total=4),
        Step(keys[3], "running", done=3, total=4),
    ]  # fmt: skip
    shown = drawn(iter(steps))
    assert "1 of at most 2" in shown and "of at most 4" not in shown.replace("0 of at most 3", "")
    assert "0:00; 0:00 in all" in shown and "a/c4 calibrate" in shown
    assert "-:--" not in shown and "remaining" not in shown


def test_the_commands_are_listed_in_groups_in_the_order_of_work():
    _, out, _ = run("--help")
    places = [out.index(f"\n{title}:") for title in ORDER]
    assert places == sorted(places) and "…" not in out and "..." not in out.split("Options:")[1]
    import typer.main

    listed = [name for names in ORDER.values() for name in names]
    assert sorted(listed) == sorted(typer.main.get_command(app).commands)
