"""What headers, tables and codes tell, what is doubted, and real captures."""

import json
import tomllib

import cv2
import h5py
import numpy as np
import pytest
import tifffile
from scipy.io import savemat
from typer.testing import CliRunner

from levkas.campaign.guess import LookRefused, look, write_campaign
from levkas.cli import app

from .conftest import SHAPE, painting, shares_of, taken, write

DNG = [
    (33421, "H", 2, (2, 2), True), (33422, "B", 4, bytes([2, 1, 1, 0]), True), (50706, "B", 4, bytes([1, 4, 0, 0]), True),
    (50708, "s", 0, "Test", True), (50714, "H", 1, 64, True), (50717, "H", 1, 4095, True),
    (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
]  # fmt: skip


def camera_of(proposal):
    (camera,) = proposal.to_dict()["cameras"].values()
    return camera


# --- headers, tables and codes ----------------------------------------------------------------


def test_a_camera_raw_says_its_mosaic_itself(tmp_path):
    for name, counts in (("dark", 70), ("white", 3000), ("icon", 900)):
        (tmp_path / name).mkdir()
        frame = np.full((64, 96), counts, np.uint16)
        path = tmp_path / name / "DSC_1.dng"
        tifffile.imwrite(path, frame, photometric=32803, metadata=None, extratags=DNG)
    camera = camera_of(look(tmp_path))
    assert (camera["kind"], "pattern" in camera, "bits" in camera) == ("mosaic", False, False)


def test_codes_that_pile_up_below_the_bits_are_the_saturation_and_dim_ones_leave_the_bits_open(
    tmp_path,
):
    rng = np.random.default_rng(0)
    levels = {"dark": (64, 2), "icon": (100 + 3000 * painting(1), 20)}
    white = 4200 * (1 - 0.3 * np.linspace(-1, 1, SHAPE[1]) ** 2) * np.ones(SHAPE)
    for name, (level, noise) in {**levels, "white": (white, 30)}.items():
        counts = rng.normal(level, noise, SHAPE).clip(0, 3600).astype(np.uint16)
        tifffile.imwrite(tmp_path / f"{name}_550nm.tif", counts, photometric="minisblack")
    camera = camera_of(look(tmp_path))
    assert (camera["bits"], camera["saturation"]) == (12, 3600)
    (tmp_path / "white_550nm.tif").unlink()
    dim = rng.normal(100 + 600 * painting(1), 2).astype(np.uint16)
    tifffile.imwrite(tmp_path / "icon_550nm.tif", dim, photometric="minisblack")
    assert "bits" not in camera_of(look(tmp_path))


@pytest.mark.parametrize("form", ["h5", "mat"])
def test_cubes_in_files_of_arrays_are_scans_of_their_wavelengths(tmp_path, form):
    waves = np.arange(400.0, 701, 100)
    for name in ("dark", "white", "panel"):
        shares = np.repeat(shares_of(name)[..., None], 4, 2)
        cube = {"cube": (90 + 3300 * shares).round().astype(np.uint16), "wavelengths": waves}
        if form == "mat":
            savemat(tmp_path / f"{name}.mat", cube)
            continue
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            for key, values in cube.items():
                file[key] = values
    (tmp_path / "notes.mat").write_bytes(b"no arrays")
    proposal = look(tmp_path)
    assert camera_of(proposal)["kind"] == "cube"
    (bands,) = taken(tmp_path, proposal.text).values()
    assert len(bands) == 4


@pytest.mark.parametrize(
    ("said", "stated", "doubted"),
    [
        (("tint = 10", "tint = 10", "tint = 20"), True, False),
        (("tint = 10", "", "tint = {10, 30}"), True, True),
        (("exposure = 10", "exposure = 10", "exposure = 10"), False, False),
        (("exposure = 10", "exposure = 10", "exposure = 20"), False, True),
    ],
)
def test_exposures_that_headers_state_are_said_and_doubted(tmp_path, said, stated, doubted):
    levels = {"dark": 60, "white": 3000, "icon1": 900}
    for (name, level), text in zip(levels.items(), said, strict=True):
        codes = np.random.default_rng(level).normal(level, 9, (12, 40, 2)).clip(0).astype("<u2")
        (tmp_path / f"{name}.raw").write_bytes(codes.tobytes())
        (tmp_path / f"{name}.hdr").write_text(
            "ENVI\nsamples = 40\nlines = 12\nbands = 2\ninterleave = bip\ndata type = 12\nbyte order = 0\n"
            f"wavelength = {{500, 600}}\n{text}\n"
        )
    (camera,) = look(tmp_path).cameras
    assert any(one.startswith("Exposures") for one in camera.about) == stated
    assert any("exposure" in one for one in camera.unknown) == doubted


# --- what is doubted, left out or asked ---------------------------------------------------------


def test_what_is_missing_or_odd_is_named_and_not_guessed(studio):
    folder = studio("c/{dark=white,white=dark,icon1}/{450,550,650}nm.tif\nc/icon2/450nm.tif")
    (folder / "c/icon1/700nm.tif").write_bytes(b"II*\0junk")
    write(folder / "c/dark/900nm.tif", np.zeros((30, 30)))
    proposal = look(folder)
    assert any("swapped" in one for one in proposal.unknown)
    assert any("icon2/c" in one for one in proposal.unknown)
    left_out = "\n".join(proposal.left_out)
    assert "c/icon1/700nm.tif" in left_out and "c/dark/900nm.tif" in left_out
    lines = proposal.text.splitlines()
    for key in ("kind", "dark", "white", "objects", "reference"):  # every guess has its reason
        at = next(n for n, line in enumerate(lines) if line.startswith(f"{key} = "))
        assert "#" in lines[at] or lines[at - 1].startswith("#"), key


@pytest.mark.parametrize(
    "names", ["page_{uv=icon,white=icon}.tif\ndark.tif", "{dark,white=icon,icon}.tif"]
)
def test_a_white_that_may_be_none_is_doubted(studio, names):
    assert any("white" in one and "whether" in one for one in look(studio(names)).unknown)


def test_names_that_no_pattern_can_hold_do_not_break_it(studio):
    proposal = look(studio("x(y)/{dark,white,icon1,icon@1}/{450,550,650}nm a*b.tif"))
    assert "icon1" in proposal.objects and "icon@1" not in proposal.objects
    assert any("icon@1" in text for text in proposal.unknown)


@pytest.mark.parametrize(
    ("lines", "lost"),
    [
        ("{vis=}.png\n{shot1,ColorChecker}.png", {"shot1", "ColorChecker"}),
        ("{a,b}.jpg\nc-grey.png", {"c-grey"}),
    ],
)
def test_every_file_that_the_proposal_does_not_take_is_listed(studio, lines, lost):
    folder = studio(lines)
    told = "\n".join(look(folder).unknown)
    assert {p.stem for p in folder.iterdir() if p.name in told} == lost


def lit(path, light):
    path.parent.mkdir(parents=True, exist_ok=True)
    codes = 255 * np.clip(light * painting(3), 0, 1) ** (1 / 2.2)
    cv2.imwrite(str(path), np.repeat(codes[..., None], 3, 2).astype(np.uint8))


def test_pictures_under_several_lights_or_exposures_are_asked_for_and_shots_are_not(tmp_path):
    across = np.linspace(0, 1, SHAPE[1])
    for k, times in enumerate((0.25, 1, 4)):
        lit(tmp_path / f"dome/coin_{k + 1}.tif", 0.4 + 0.6 * (across if k % 2 else 1 - across))
        lit(tmp_path / f"bracket/panel/DSC_{k + 1}.tif", times)
        noise = np.random.default_rng(k).normal(1, 0.01, SHAPE)
        lit(tmp_path / f"shots/panel/DSC_{k + 1}.tif", (0.8 + 0.02 * k) * noise)
    asked = {
        name: sum(": whether" in text for text in look(tmp_path / name).unknown)
        for name in ("dome", "bracket", "shots")
    }
    assert asked == {"dome": 1, "bracket": 1, "shots": 0}


def test_a_bracket_with_darks_and_whites_is_asked_for(tmp_path):
    for k, times in enumerate((0.25, 0.5, 1)):
        for name in ("dark", "white", "icon"):
            write(tmp_path / name / f"{k}.tif", (times if name == "icon" else 1) * shares_of(name))
    (camera,) = look(tmp_path).cameras
    assert any("icon/0.tif" in text for text in camera.unknown)


# --- the file and the command --------------------------------------------------------------------


def test_a_campaign_that_is_there_is_never_written_over(studio):
    folder = studio("a/{dark,white,icon}_{450,550,650}nm.tif")
    proposal = look(folder)
    path = write_campaign(proposal)
    with pytest.raises(LookRefused) as refused:
        write_campaign(proposal)
    assert refused.value.problems[0].code == "E_EXISTS"
    assert path.read_text(encoding="utf-8") == proposal.text == look(folder).text


def test_the_command_shows_and_writes_only_when_told(studio):
    folder = studio("a/{dark,white,icon}/550nm.tif")
    run = CliRunner().invoke(app, ["look", str(folder)])
    assert run.exit_code == 0 and tomllib.loads(run.stdout)["cameras"]["a"]["kind"] == "bands"
    assert not (folder / "campaign.toml").exists()
    run = CliRunner().invoke(app, ["look", str(folder), "--write", "--json"])
    report = json.loads(run.stdout)
    assert (run.exit_code, report["ok"], report["command"]) == (0, True, "look")
    assert report["campaign"] == tomllib.loads((folder / "campaign.toml").read_text())
    run = CliRunner().invoke(app, ["look", str(folder), "--write", "--json"])
    assert (run.exit_code, json.loads(run.stdout)["problems"][0]["code"]) == (1, "E_EXISTS")


# --- real captures, and a campaign by another generator ------------------------------------------


@pytest.mark.slow
def test_two_paintings_are_guessed_as_a_person_described_them(two_paintings):
    proposal = look(two_paintings / "raw")
    said = proposal.to_dict()
    cameras = said["cameras"]
    assert {name: camera["kind"] for name, camera in cameras.items()} == {
        "d80": "mosaic", "lctf-nir": "bands", "lctf-vis": "bands", "msbs": "sensors", "v10": "cube",
    }  # fmt: skip
    assert said["campaign"]["reference"] == {"camera": "lctf-vis", "band": "550 nm"}
    assert all(camera["bits"] == 12 for camera in cameras.values())
    # The README of the campaign says RGGB, and which sensors have a mosaic.
    assert cameras["d80"]["pattern"] == "RGGB"
    assert [s.get("pattern") for s in cameras["msbs"]["sensors"]] == ["RGGB", "RGGB", None]
    assert cameras["lctf-vis"]["wavelengths"] == {"start": 410, "stop": 710, "step": 20}
    assert said["targets"] == {"dark": "dark", "white": "white", "objects": ["icon1", "icon2"]}
    assert list(said["setups"]["45-degree"]["cameras"]) == ["d80"]


def test_a_filter_wheel_is_guessed_and_the_darks_of_another_session_left_out(real_data):
    proposal = look(real_data / "filterwheel-disks")
    camera = camera_of(proposal)
    # The trap is d2_, whose frames are 342 high, not 344; of the mosaic, GBRG, its README alone knows.
    assert (camera["kind"], camera["exposures"]) == ("bands", "best")
    assert any("mosaic" in text for text in proposal.unknown)
    assert camera["files"] == [
        "frames/d1_{target}_{wavelength}nm_{exposure}ms_*.tif",
        "dark/d1_{target}_{exposure}ms_*.tif",
    ]
    assert camera["wavelengths"] == {"start": 400, "stop": 700, "step": 50}
    assert proposal.objects == ("disks32cmV2",) and len(proposal.left_out) == 1


def test_a_nine_band_mosaic_and_a_photograph_are_told_apart(real_data):
    proposal = look(real_data / "silios-kinect")
    cameras = proposal.to_dict()["cameras"]
    assert cameras["kinect-hd-rgb"]["kind"] == "image"
    assert cameras["multispectral-camera"]["kind"] == "mosaic"
    assert len(cameras["multispectral-camera"]["pattern"]) == 3
    said = proposal.to_dict()["targets"]
    assert (said["dark"], said["white"]) == ("dark", "flat")
    assert proposal.objects == ("board", "burst", "scene1", "scene2")


def test_five_lenses_are_sensors_by_their_headers(real_data):
    proposal = look(real_data / "rededge-5lens")
    camera = camera_of(proposal)
    assert camera["files"] == "IMG_{target}_{sensor}.tif" and "exposures" not in camera
    bands = [s["bands"] for s in camera["sensors"]]
    assert bands == [["Blue"], ["Green"], ["Red"], ["NIR"], ["Red edge"]]
    assert proposal.objects == ("0000", "0001")


def test_a_line_scan_is_a_cube_with_its_templates(real_data):
    proposal = look(real_data / "envi-linescan")
    camera = camera_of(proposal)
    assert (camera["kind"], camera["files"]) == ("cube", "{target}.hdr")
    assert proposal.to_dict()["targets"]["dark"] == "dark_reference_crop"


def test_eight_bands_of_a_page_are_asked_for_and_pictures_without_order_are_objects(real_data):
    bands = next(c.choices[0] for c in look(real_data / "manuscript-8bands").cameras if c.choices)
    assert bands.keys["bands"].value == tuple(f"F{n}s" for n in range(1, 9))
    for name, count in (("paintings", 3), ("stain-landmarks", 8)):
        proposal = look(real_data / name)
        assert (len(proposal.cameras), len(proposal.objects)) == (1, count)
        assert proposal.unknown
    with pytest.raises(LookRefused) as refused:
        look(real_data / "spectra")
    assert refused.value.problems[0].code == "E_NO_FRAMES"
