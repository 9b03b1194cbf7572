"""Lamps found from whites on disk: what was moved comes back, what cannot tell is refused."""

import json
from pathlib import Path

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.cli import app
from levkas.planning import illuminate
from levkas.planning.lamp_fit import moved_lighting

BENCH = Path(__file__).resolve().parents[2] / "examples" / "plan"


def run(*words):
    return CliRunner().invoke(app, ["plan", "fit", str(BENCH), *map(str, words)])


@pytest.fixture
def captured(bench, tmp_path):
    """Return a function that writes a white under lamps that miss their plan."""

    def write(name, shifts, *, size=None, peak=54_000, shape=(240, 315), mosaic=False, black=300):
        hung = moved_lighting(bench.lighting(), np.array(shifts, float))
        width, height = size or bench.object.size_mm
        x = (np.arange(shape[1]) + 0.5) / shape[1] * width - width / 2
        y = (np.arange(shape[0]) + 0.5) / shape[0] * height - height / 2
        points = np.stack([*np.meshgrid(x, y), np.zeros(shape)], -1)
        normals = np.zeros_like(points)
        normals[..., 2] = 1
        light = illuminate(hung.lamps, points, normals)
        light = peak * light / light.max()
        if mosaic:
            light[::2, ::2] *= 0.5
            light[1::2, 1::2] *= 0.4
        light = np.random.default_rng(3).normal(light, np.sqrt(light)) + black
        light[100:103, 50:54] = black  # dust
        tifffile.imwrite(tmp_path / name, np.clip(light, 0, 65_535).astype(np.uint16))
        return tmp_path / name

    return write


WEAK = np.zeros((2, 7))
WEAK[0, 0] = -1.0  # exp(-0.3): three quarters of the power


@pytest.mark.parametrize("mosaic", [False, True])
def test_a_weak_lamp_is_found_in_a_captured_white(captured, mosaic):
    white = captured("white.tif", WEAK, mosaic=mosaic)
    said = run(white, "--black", 300)
    assert said.exit_code == 0, said.output
    assert "halogen 1 gives the middle 2" in said.output
    record = json.loads(run(white, "--black", 300, "--json").stdout)
    assert record["command"] == "plan fit" and record["explained"]
    assert record["residual"] < 0.005
    one, other = record["lamps"]
    assert other["share"] == 1.0 and 0.7 < one["share"] < 0.87  # 0.74, drawn to the plan
    assert record["light_at_middle"] == [pytest.approx(0.74, abs=0.05), 1.0]
    assert record["planned_drop"] == pytest.approx(0.077, abs=0.003)
    assert record["drop"] > record["planned_drop"] + 0.03


def test_a_white_under_one_lamp_alone_is_fitted_to_that_one(captured):
    shifts = np.zeros((2, 7))
    shifts[0, 0], shifts[1, 3] = -40, 1.0  # the first is off, the second 6 % farther away
    white = captured("white.tif", shifts)
    record = json.loads(run(white, "--black", 300, "--lamp", 2, "--json").stdout)
    (lamp,), (error,) = record["lamps"], record["uncertainties"]
    assert lamp["distance_mm"] == pytest.approx(2230, abs=2 * error["distance_mm"])
    assert error["place_mm"] < 150 and record["explained"]
    said = run(white, "--lamp", 3)
    assert said.exit_code == 1 and "1 to 2" in said.stderr


def test_what_is_printed_can_be_put_into_the_setup_file(captured, rewritten):
    from levkas.planning import load_setup

    lines = run(captured("white.tif", WEAK), "--black", 300).output.splitlines()
    rows = "\n".join(lines[lines.index("As they hang, for the setup file:") + 1 :])
    text = rewritten().read_text(encoding="utf-8") + f"\n[setups.hung]\nlamps = [\n{rows}\n]\n"
    path = rewritten()
    path.write_text(text, encoding="utf-8")
    lamps = load_setup(path).lighting("hung").lamps
    assert lamps[0].candela < 0.87 * lamps[1].candela


def test_a_camera_tells_which_part_of_the_board_a_region_shows(bench, captured):
    from levkas.planning import plan_framing
    from levkas.planning.lamp_positions import CapturedWhite, fit_white

    field = next(f.field_mm for f in plan_framing(bench) if f.camera == "d80")
    shifts = np.zeros((2, 7))
    white = captured("white.tif", shifts, size=field, shape=(261, 390))
    left = fit_white(
        bench, CapturedWhite([white], camera="d80", region=(0, 0, 130, 261), black=300)
    )
    assert left.size_mm == pytest.approx((field[0] / 3, field[1]))
    # Seen as a board of its own in the middle, the left third would need other lamps.
    for lamp, plan in zip(left.fitted.lighting.lamps, bench.lighting().lamps, strict=True):
        assert lamp.candela == pytest.approx(plan.candela, rel=0.05)
        assert lamp.angle_deg == pytest.approx(plan.angle_deg, abs=1.0)


def test_a_dark_is_subtracted(captured, tmp_path):
    white = captured("white.tif", np.zeros((2, 7)), peak=3000, black=1500)
    dark = tmp_path / "dark.tif"
    tifffile.imwrite(dark, np.full((240, 315), 1500, np.uint16))
    with_dark = json.loads(run(white, "--bits", 14, "--dark", dark, "--json").stdout)
    without = json.loads(run(white, "--bits", 14, "--json").stdout)
    assert with_dark["measured_drop"] == pytest.approx(0.066, abs=0.01)
    assert without["measured_drop"] < 0.05


def test_whites_of_twelve_bits_in_sixteen_are_refused_unless_their_full_scale_is_known(captured):
    whole = tifffile.imread(captured("whole.tif", np.zeros((2, 7)), peak=5000, black=64))
    white = captured("clipped.tif", np.zeros((2, 7)))
    tifffile.imwrite(white, np.minimum(whole, 4095))
    for told in ((), ("--bits", 12), ("--saturation", 4095)):
        refused = run(white, "--black", 64, *told)
        assert refused.exit_code == 1 and "the white clips" in refused.stderr
    asked = run(captured("open.tif", WEAK, peak=3500, black=64), "--black", 64)
    assert asked.exit_code == 1 and "full scale of the camera is unknown" in asked.stderr
    fits = run(captured("fits.tif", WEAK, peak=3500, black=64), "--black", 64, "--bits", 12)
    assert fits.exit_code == 0, fits.output


def test_a_campaign_above_the_whites_tells_their_full_scale(captured, tmp_path):
    whole = tifffile.imread(captured("whole.tif", np.zeros((2, 7)), peak=5000, black=64))
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\nreference = { camera = "c" }\n'
        '[cameras.c]\nkind = "bands"\nfiles = "{target}.tif"\nbands = ["a"]\nbits = 12\n',
        encoding="utf-8",
    )
    tifffile.imwrite(tmp_path / "board.tif", np.minimum(whole, 4095))
    refused = run(tmp_path / "board.tif", "--black", 64)
    assert refused.exit_code == 1 and "the white clips" in refused.stderr


def test_whites_that_cannot_tell_are_refused(captured, tmp_path):
    nought = np.zeros((2, 7))
    clipped = captured("clipped.tif", nought, peak=80_000)
    dark = captured("dark.tif", nought, peak=1)
    fine = captured("fine.tif", nought)
    small = tmp_path / "small.tif"
    tifffile.imwrite(small, np.ones((10, 10), np.uint16))
    empty = tmp_path / "empty"
    empty.mkdir()
    for words, code in (
        ((clipped,), "E_WHITE_SATURATED"),
        ((dark, "--black", 310, "--bits", 16), "E_WHITE_DARK"),
        ((fine, "--region", "300,0,100,100"), "E_REGION"),
        ((fine, "--dark", small), "E_SIZE"),
        ((empty,), "E_NO_FRAMES"),
        ((fine, "--camera", "none"), "E_VALUE"),
        ((fine, "-s", "none"), "E_VALUE"),
    ):
        said = run(*words)
        assert said.exit_code == 1 and code in said.stderr, (words, said.output, said.stderr)
    assert run(fine, "--region", "1,2").exit_code == 2


def test_another_shape_and_light_that_lamps_do_not_explain_are_said(captured, bench, tmp_path):
    white = captured("white.tif", np.zeros((2, 7)), shape=(240, 480))
    assert "name the camera" in run(white).output
    values = tifffile.imread(captured("spot.tif", np.zeros((2, 7)), peak=30_000)).astype(float)
    values[60:120, 200:260] *= 1.3  # a reflection from a window
    tifffile.imwrite(tmp_path / "spot.tif", values.astype(np.uint16))
    said = run(tmp_path / "spot.tif", "--black", 300).output
    assert "other light in the room" in said
