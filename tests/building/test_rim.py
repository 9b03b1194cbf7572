"""Frames that are no good numbers, and campaigns with several faults at once."""

import json

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.building.build_records import BuildRecords
from levkas.calibration.templates import CalibrationRefused
from levkas.campaign.campaign import CampaignInvalid, load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.cli import app
from levkas.core.cube import Flag
from levkas.core.problems import Refused
from levkas.database.layout import Places
from levkas.stages.calibrate import develop
from levkas.stages.template_cache import TemplateCache

KEYS = """
[campaign]
reference = "vis"
[cameras.vis]
kind = "bands"
files = "vis/{target}/{band}.tif"
bands = ["B1", "B2", "B3"]
BITS
[targets]
dark = "dark"
white = { names = "white", reflectance = 1.0 }
objects = ["panel"]
"""
LEVELS = {"dark": 100.0, "white": 3100.0, "panel": 1600.0}
BANDS = ("B1", "B2", "B3")
PLACE = (20, 25)


def campaign(folder, *, bits="", dtype=np.float32, change=None):
    """Three bands of 40 x 50; `change(frame, target, band)` may return another frame."""
    rng = np.random.default_rng(1)
    for target, level in LEVELS.items():
        (folder / "vis" / target).mkdir(parents=True, exist_ok=True)
        for band in BANDS:
            frame = rng.normal(level, 5, (40, 50)).astype(dtype)
            if change is not None:
                frame = change(frame, target, band)
            tifffile.imwrite(folder / "vis" / target / f"{band}.tif", frame)
    (folder / "campaign.toml").write_text(KEYS.replace("BITS", bits))
    return folder


def developed(folder):
    read = load_campaign(folder)
    (capture,), refusals = find_captures(read)
    assert not refusals
    places = Places(folder / "database")
    shelf = TemplateCache(folder / "kept", BuildRecords(places.kept, places.output).hashes.of_frame)
    native = develop(capture, read, shelf)
    return native.cubes[""], native.warnings


def spoil(target, band, value, where=PLACE):
    def change(frame, of, label):
        if (of, label) == (target, band):
            frame = frame.copy()
            frame[where] = value
        return frame

    return change


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("target", LEVELS)
def test_a_value_that_is_no_number_is_flagged_counted_and_poisons_no_neighbour(
    tmp_path, target, value
):
    clean, _ = developed(campaign(tmp_path / "clean"))
    cube, warnings = developed(campaign(tmp_path / "odd", change=spoil(target, "B2", value)))
    assert np.isfinite(cube.values).all()
    band = 1
    assert cube.flags[(*PLACE, band)] & Flag.DEFECT
    assert any("B2: 1 value (0.05 %) is not a finite number" in text for text in warnings)
    elsewhere = np.ones(cube.values.shape, bool)
    elsewhere[(*PLACE, band)] = False
    assert np.array_equal(cube.values[elsewhere], clean.values[elsewhere])
    assert np.array_equal(cube.flags[elsewhere], clean.flags[elsewhere])
    # Replaced from neighbours of 0.5: noise of 5 counts in 3000.
    assert abs(cube.values[(*PLACE, band)] - 0.5) < 0.01


@pytest.mark.parametrize("target", LEVELS)
def test_a_band_without_a_finite_value_is_refused(tmp_path, target):
    folder = campaign(tmp_path, change=spoil(target, "B3", np.nan, ...))
    with pytest.raises(CalibrationRefused) as refused:
        developed(folder)
    (problem,) = refused.value.problems
    assert (problem.code, problem.field) == ("E_VALUE", "pixels")
    assert "B3.tif" in problem.file and problem.found and problem.expected and problem.fix


def test_nan_in_a_line_scan_stays_where_it_is(tmp_path):
    rng = np.random.default_rng(2)
    for target, level in LEVELS.items():
        cube = rng.normal(level, 5, (30, 20, 4)).astype(np.float32)
        if target == "panel":
            cube[7, 5, 2] = np.nan
        for path in (tmp_path / f"{target}.raw",):
            path.write_bytes(np.ascontiguousarray(cube.transpose(0, 2, 1)).tobytes())
        (tmp_path / f"{target}.hdr").write_text(
            "ENVI\nsamples = 20\nlines = 30\nbands = 4\ndata type = 4\ninterleave = bil\n"
            "wavelength = {400, 500, 600, 700}\n"
        )
    keys = KEYS.replace('"bands"', '"cube"').replace("vis/{target}/{band}.tif", "{target}.hdr")
    (tmp_path / "campaign.toml").write_text(
        keys.replace('bands = ["B1", "B2", "B3"]', "").replace("BITS", "")
    )
    cube, warnings = developed(tmp_path)
    lost = Flag.DEFECT | Flag.OUTSIDE
    assert np.argwhere(cube.flags & lost == lost).tolist() == [[7, 5, 2]]
    assert np.isfinite(cube.values).all()
    assert any("1 value" in text and "not a finite number" in text for text in warnings)


def test_8_bit_frames_where_12_are_said_are_refused_once_with_their_number(tmp_path):
    folder = campaign(
        tmp_path, bits="bits = 12", dtype=np.uint16, change=lambda f, *_: (f >> 4).astype(np.uint8)
    )
    with pytest.raises(CalibrationRefused) as refused:
        developed(folder)
    (problem,) = refused.value.problems  # once, with how many files it is
    assert problem.code == "E_BITS" and "in 9 files" in problem.message
    assert problem.field == "cameras.vis.bits"
    assert "uint8" in problem.found and "4095" in problem.expected and problem.fix


def test_codes_beyond_the_declared_bits_are_refused(tmp_path):
    folder = campaign(
        tmp_path, bits="bits = 12", dtype=np.uint16, change=spoil("panel", "B1", 4096)
    )
    with pytest.raises(CalibrationRefused) as refused:
        developed(folder)
    (problem,) = refused.value.problems
    assert (problem.code, problem.found, problem.expected) == ("E_BITS", 4096, "at most 4095")
    assert problem.file.endswith("B1.tif") and "bits = 13" in problem.fix


def test_codes_at_the_upper_end_of_16_bits_are_read_where_saturation_says_so(tmp_path):
    folder = campaign(
        tmp_path,
        bits="bits = 12\nsaturation = 65520",
        dtype=np.uint16,
        change=lambda f, *_: f * np.uint16(16),
    )
    _, warnings = developed(folder)
    assert not any("bits" in text for text in warnings)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda f, *_: f >> 4, "no code exceeds"),
        (
            lambda f, *_: np.round((f >> 4) * (4095 / 255)).astype(np.uint16),
            "8 bits were stretched to 12",
        ),
    ],
    ids=["low", "stretched"],
)
def test_16_bit_files_of_8_bit_codes_are_warned_about(tmp_path, change, said):
    def spread(frame, target, band):
        if target == "dark":
            return change(np.full_like(frame, 96))
        ramp = np.linspace(0.4, 1, frame.size).reshape(frame.shape)
        return change((frame * ramp).astype(np.uint16), target, band)

    _, warnings = developed(campaign(tmp_path, bits="bits = 12", dtype=np.uint16, change=spread))
    assert any(said in text for text in warnings), warnings


def test_frames_of_12_bits_raise_no_doubt(tmp_path):
    _, warnings = developed(campaign(tmp_path, bits="bits = 12", dtype=np.uint16))
    assert not any("bits" in text for text in warnings)


def test_five_faults_of_a_campaign_file_are_told_at_once(tmp_path):
    campaign(tmp_path)
    path = tmp_path / "campaign.toml"
    path.write_text(
        path.read_text()
        .replace('reference = "vis"', 'reference = "viz"\nlicense = "CC0"')
        .replace('kind = "bands"', 'kind = "bands"\nblack = "dark"\nscan = "mirror"')
        .replace("reflectance = 1.0", 'reflectance = "board.csv"')
    )
    with pytest.raises(CampaignInvalid) as refused:
        load_campaign(path)
    assert {p.field for p in refused.value.problems} == {
        "campaign.reference.camera",
        "campaign.license",
        "cameras.vis.black",
        "cameras.vis.scan",
        "targets.white.reflectance",
    }


def test_five_bad_frames_are_told_in_one_report(tmp_path):
    campaign(tmp_path)
    frames = tmp_path / "vis"
    whole = (frames / "panel/B1.tif").read_bytes()
    bad = {
        "panel/B1.tif": whole[:900],
        "panel/B3.tif": b"",
        "white/B1.tif": b"\x89HDF\r\n\x1a\n" + whole,
        "white/B2.tif": b"no image",
        "dark/B2.tif": whole[:7],
    }
    for name, data in bad.items():
        (frames / name).write_bytes(data)
    done = CliRunner().invoke(app, ["build", str(tmp_path), "--json"])
    assert done.exit_code == 1
    report = json.loads(done.stdout)
    named = {p["file"].replace("\\", "/").split("vis/")[1] for p in report["problems"] if p["file"]}
    assert named == set(bad)
    assert all(p["found"] and p["expected"] and p["fix"] for p in report["problems"])


def test_a_fault_in_another_camera_is_told_though_the_reference_is_lost_too(tmp_path):
    campaign(tmp_path)
    path = tmp_path / "campaign.toml"
    path.write_text(
        path.read_text() + '[cameras.irr]\nkind = "image"\nfiles = "irr/{target}.tif"\n'
    )
    (tmp_path / "irr").mkdir()
    (tmp_path / "irr/panel.tif").write_bytes(b"no image")
    (tmp_path / "vis/panel/B2.tif").write_bytes(b"")
    from levkas.building import build, summarise

    report = summarise(list(build(tmp_path)), tmp_path / "database")
    files = {str(p.file).rsplit("/", 2)[-2:][1] for p in report.problems if p.file}
    assert {"panel.tif", "B2.tif"} <= files


def test_the_reading_of_a_clean_campaign_raises_nothing(tmp_path):
    try:
        developed(campaign(tmp_path))
    except Refused as refused:  # pragma: no cover
        pytest.fail(str(refused))
