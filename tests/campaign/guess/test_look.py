import json
import tomllib

import cv2
import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.campaign.guess import LookRefused, look, write_campaign
from levkas.cli import app

WAVES = (450, 550, 650)


def scene(seed=1, *, shape=(60, 80)):
    """A picture without grain, shares of one."""
    coarse = np.random.default_rng(seed).random((shape[0] // 6 + 2, shape[1] // 6 + 2))
    return cv2.resize(coarse, shape[::-1], interpolation=cv2.INTER_CUBIC).clip(0.05, 1)


class Folder:
    """Writes small frames that look like what they are named, 12 bits of 16."""

    def __init__(self, root):
        self.root, self.rng = root, np.random.default_rng(0)

    def dark(self, name, **options):
        self.write(name, self.rng.normal(64, 2, (60, 80)), **options)

    def white(self, name, **options):
        even = 3500 * (1 - 0.2 * np.linspace(-1, 1, 80) ** 2) * np.ones((60, 1))
        self.write(name, even + self.rng.normal(0, 8, (60, 80)), **options)

    def object(self, name, seed=1, **options):
        self.write(name, 64 + 2500 * scene(seed) + self.rng.normal(0, 6, (60, 80)), **options)

    def all(self, pattern, **options):
        """A dark, a white and two objects; ``{}`` stands for the target."""
        self.dark(pattern.replace("{}", "dark"), **options)
        self.white(pattern.replace("{}", "white"), **options)
        self.object(pattern.replace("{}", "icon1"), 1, **options)
        self.object(pattern.replace("{}", "icon2"), 2, **options)

    def write(self, name, counts, *, bayer=False, shift=0, pages=1, **tags):
        if bayer:
            counts = 64 + (counts - 64) * np.tile([[0.7, 1.0], [1.0, 0.55]], (30, 40))
        values = np.clip(counts, 0, 4095).astype(np.uint16) << shift
        path = self._path(name)
        values = values if pages == 1 else np.stack([values] * pages)
        tifffile.imwrite(path, values, photometric="minisblack", metadata=None, **tags)

    def picture(self, name, seed=1, *, channels=3, shape=(60, 80)):
        planes = np.stack([255 * scene(seed + i, shape=shape) for i in range(channels)], -1)
        cv2.imwrite(str(self._path(name)), planes.astype(np.uint8).squeeze())

    def _path(self, name):
        path = self.root / name
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


@pytest.fixture
def folder(tmp_path):
    root = tmp_path / "studio"
    root.mkdir()
    return Folder(root)


def found(root, proposal=None):
    """Look, write, load and find: what a build would see, camera by camera."""
    proposal = proposal or look(root)
    write_campaign(proposal)
    captures, refusals = find_captures(load_campaign(root))
    return proposal, {(c.object, c.layer): c for c in captures}, refusals


def labels(captures, key):
    return [band.label for band in captures[key].bands]


# --- layouts of folders and names -------------------------------------------------------------


def test_a_folder_a_camera_and_a_target_with_everything_in_names(folder):
    for nm in WAVES:
        folder.all(f"lctf/{{}}/{nm}nm.tif")
    for shot in range(2):
        folder.all(f"d80/{{}}/DSC_{shot:04d}.tif", bayer=True)
        folder.object(f"45-degree/d80/icon1/DSC_{shot:04d}.tif", bayer=True)
        folder.white(f"45-degree/d80/white/DSC_{shot:04d}.tif", bayer=True)
    proposal, captures, refusals = found(folder.root)
    assert not refusals
    assert set(captures) == {(o, c) for o in ("icon1", "icon2") for c in ("lctf", "d80")} | {
        ("icon1", "d80@45-degree")
    }
    said = proposal.to_dict()
    assert said["campaign"]["reference"] == {"camera": "lctf", "band": "550 nm"}
    assert said["cameras"]["lctf"]["files"] == "lctf/{target}/{wavelength}nm.tif"
    assert said["cameras"]["lctf"]["wavelengths"] == {"start": 450, "stop": 650, "step": 100}
    assert said["cameras"]["d80"]["kind"] == "mosaic"
    assert said["cameras"]["d80"]["bits"] == 12
    assert said["targets"]["dark"] == "dark"
    assert said["setups"]["45-degree"]["cameras"]["d80"]["files"].startswith("45-degree/d80/")
    assert len(captures["icon1", "d80"].sensors[0].object) == 2


@pytest.mark.parametrize(
    ("name", "pattern"),
    [
        ("{}-{nm}nm-01.tif", "{target}-{wavelength}nm-{shot}.tif"),
        ("{}_{nm}.tif", "{target}_{wavelength}.tif"),
        ("a/{}/{nm} nm.TIF", "a/{target}/{wavelength} nm.TIF"),
        ("{nm}nm/{}.tif", "{wavelength}nm/{target}.tif"),
        ("msi/{}/{}_w{nm}nm_exp.tif", "msi/{target}/{target}_w{wavelength}nm_exp.tif"),
    ],
)
def test_targets_and_wavelengths_are_found_wherever_they_stand(folder, name, pattern):
    for nm in WAVES:
        folder.all(name.replace("{nm}", str(nm)))
    proposal, captures, refusals = found(folder.root)
    (camera,) = proposal.to_dict()["cameras"].values()
    assert (camera["kind"], camera["files"]) == ("bands", pattern)
    assert not refusals
    assert {name for name, _ in captures} == {"icon1", "icon2"}
    assert all(c.sensors[0].dark and c.sensors[0].white for c in captures.values())


def test_numbers_of_sensors_shots_and_bands_are_told_apart(folder):
    for shot in range(2):
        for number in (1, 2):
            folder.all(f"msbs/{{}}_ccd{number}_{shot:03d}.tif", bayer=number == 1)
    for number in range(1, 5):
        folder.all(f"msi/{{}}/band{number:02d}.tif")
    proposal, captures, refusals = found(folder.root)
    assert not refusals
    cameras = proposal.to_dict()["cameras"]
    assert cameras["msbs"]["files"] == "msbs/{target}_{sensor}_{shot}.tif"
    assert [s["name"] for s in cameras["msbs"]["sensors"]] == ["ccd1", "ccd2"]
    assert labels(captures, ("icon1", "msbs")) == ["R1", "G1", "B1", "ccd2"]
    assert cameras["msi"]["files"] == "msi/{target}/{band}.tif"
    assert labels(captures, ("icon1", "msi")) == ["band01", "band02", "band03", "band04"]
    assert any("sensitivity of ccd2" in text for text in proposal.unknown)


@pytest.mark.parametrize(("seeds", "objects"), [((5, 5), {"icon"}), ((5, 6), {"icon_0", "icon_1"})])
def test_frames_that_differ_in_a_number_are_shots_or_objects_as_they_look(folder, seeds, objects):
    for number, seed in enumerate(seeds):
        folder.dark(f"a/dark_{number}.tif")
        folder.white(f"a/flat_{number}.tif")
        folder.object(f"a/icon_{number}.tif", seed=seed)
    proposal, captures, refusals = found(folder.root)
    assert not refusals
    assert {name for name, _ in captures} == objects
    assert all(len(c.sensors[0].dark) == 2 for c in captures.values())
    assert ("{shot}" in proposal.text) == (len(objects) == 1)


def test_templates_in_a_tree_of_their_own_find_their_camera(folder):
    for nm in WAVES:
        folder.object(f"images/icon1/{nm}nm.tif")
        folder.white(f"calibration/white/{nm}nm.tif")
        folder.dark(f"calibration/dark/{nm}nm.tif")
    proposal, captures, refusals = found(folder.root)
    assert not refusals
    assert len(proposal.cameras) == 1
    (sensor,) = next(iter(captures.values())).sensors
    assert (len(sensor.object), len(sensor.dark), len(sensor.white)) == (3, 3, 3)


def test_two_lightings_of_one_camera_are_setups(folder):
    for light in ("diffuse", "45deg"):
        folder.all(f"{light}/d80/{{}}/001.tif", bayer=True)
    proposal, captures, _ = found(folder.root)
    assert {c.layer for c in captures.values()} == {"d80", "d80@45deg"}
    assert "'diffuse' is assumed to be the default" in proposal.text


def test_photograph_reflectogram_and_radiograph_are_plain_images(folder):
    for name in ("panel1", "panel2"):
        folder.picture(f"photo/{name}.jpg")
        folder.object(f"irr/{name}.tif")
        folder.picture(f"xray/{name}.png", channels=1, shape=(70, 90))
    proposal, captures, refusals = found(folder.root)
    assert not refusals
    assert {camera.kind for camera in proposal.cameras} == {"image"}
    assert proposal.to_dict()["campaign"]["reference"]["camera"] == "photo"
    assert len(captures) == 6


@pytest.mark.parametrize("names", [("{}_vis.jpg", "{}_irr.tif"), ("{}/vis.jpg", "{}/irr.tif")])
def test_kinds_of_photographs_in_names_are_cameras(folder, names):
    for name in ("icon", "saint_nicholas"):
        folder.picture(names[0].format(name))
        folder.object(names[1].format(name))
    _, captures, refusals = found(folder.root)
    assert not refusals
    assert set(captures) == {(o, c) for o in ("icon", "saint_nicholas") for c in ("vis", "irr")}


def test_three_pictures_alone_are_of_the_object_that_the_folder_is_named_after(folder):
    folder.picture("photo.jpg")
    folder.object("irr.tif")
    folder.picture("xray.png", channels=1)
    _, captures, refusals = found(folder.root)
    assert not refusals
    assert set(captures) == {("studio", camera) for camera in ("photo", "irr", "xray")}


def test_an_infrared_written_out_is_a_picture_of_that_object_too(folder):
    folder.picture("photograph.jpg")
    others = ("infrared", "ultraviolet", "xray")
    for name in others:
        folder.picture(f"{name}.png", channels=1)
    _, captures, refusals = found(folder.root)
    assert not refusals
    assert set(captures) == {("studio", c) for c in ("photograph", *others)}


# --- what headers and numbers tell ------------------------------------------------------------


def test_darks_and_whites_without_names_are_known_by_their_histograms(folder):
    frames = (folder.dark, folder.dark, folder.white, folder.object)
    for number, frame in enumerate(frames):
        frame(f"IMG_{number:04d}.tif", bayer=True)
    folder.object("IMG_0004.tif", seed=9, bayer=True)
    proposal, captures, _ = found(folder.root)
    said = proposal.to_dict()["targets"]
    assert (said["dark"], said["white"]) == (["0000", "0001"], "0002")
    assert {name for name, _ in captures} == {"0003", "0004"}
    assert any("0002 is assumed to be a white" in text for text in proposal.unknown)


def test_twelve_bits_at_the_upper_end_of_sixteen_have_their_saturation(folder):
    for nm in WAVES:
        folder.all(f"{{}}/{nm}nm.tif", shift=4)
    (camera,) = look(folder.root).to_dict()["cameras"].values()
    assert (camera["saturation"], camera.get("bits")) == (65520, None)


def test_dim_frames_leave_the_bits_open(folder):
    folder.write("dark/550nm.tif", folder.rng.normal(64, 2, (60, 80)))
    folder.write("icon/550nm.tif", 100 + 600 * scene() + folder.rng.normal(0, 2, (60, 80)))
    proposal = look(folder.root)
    (camera,) = proposal.to_dict()["cameras"].values()
    assert "bits" not in camera
    assert any("bit depth" in text for text in proposal.unknown)


def test_codes_that_pile_up_below_the_bits_are_the_saturation(folder):
    folder.write("dark/550nm.tif", folder.rng.normal(64, 2, (60, 80)))
    white = 4200 * (1 - 0.3 * np.linspace(-1, 1, 80) ** 2) + folder.rng.normal(0, 30, (60, 80))
    folder.write("white/550nm.tif", white.clip(0, 3600))
    folder.write("icon/550nm.tif", 100 + 3000 * scene() + folder.rng.normal(0, 20, (60, 80)))
    (camera,) = look(folder.root).to_dict()["cameras"].values()
    assert (camera["bits"], camera["saturation"]) == (12, 3600)


def test_pages_are_bands_and_exposures_are_chosen_from(folder):
    folder.all("nir/{}.tif", pages=4)
    for milliseconds in (10, 100):
        for nm in WAVES:
            folder.dark(f"vis/dark/{nm}nm_{milliseconds}ms.tif")
            folder.object(f"vis/icon1/{nm}nm_{milliseconds}ms.tif")
    proposal, captures, refusals = found(folder.root)
    cameras = proposal.to_dict()["cameras"]
    assert not refusals
    assert len(captures["icon1", "nir"].bands) == 4
    assert cameras["vis"]["exposures"] == "best"
    assert "exposures" not in cameras["nir"]
    assert cameras["vis"]["white"] == []


def test_a_camera_raw_says_its_mosaic_itself(folder):
    for name, counts in (("dark", 70), ("white", 3000), ("icon", 900)):
        frame = np.full((64, 96), counts, np.uint16)
        tags = [
            (33421, "H", 2, (2, 2), True),
            (33422, "B", 4, bytes([2, 1, 1, 0]), True),
            (50706, "B", 4, bytes([1, 4, 0, 0]), True),
            (50708, "s", 0, "Test", True),
            (50714, "H", 1, 64, True),
            (50717, "H", 1, 4095, True),
            (50721, "2i", 9, (1, 1, 0, 1, 0, 1, 0, 1, 1, 1, 0, 1, 0, 1, 0, 1, 1, 1), True),
        ]
        path = folder._path(f"{name}/DSC_1.dng")
        tifffile.imwrite(path, frame, photometric=32803, metadata=None, extratags=tags)
    proposal = look(folder.root)
    (camera,) = proposal.to_dict()["cameras"].values()
    assert (camera["kind"], "pattern" in camera, "bits" in camera) == ("mosaic", False, False)
    assert not any("red or blue" in text for text in proposal.unknown)


def test_tables_beside_the_captures_are_used(folder):
    folder.all("raw/d80/{}/DSC_1.tif", bayer=True)
    (folder.root / "white.csv").write_text("wavelength,white\n400,0.97\n500,0.98\n")
    (folder.root / "d80_sensitivity.csv").write_text("wavelength,R,G,B\n400,0,0,1\n500,0,1,0\n")
    (folder.root / "d80_notes.csv").write_text("who,when\nme,today\n")
    proposal, _, refusals = found(folder.root)
    said = proposal.to_dict()
    assert not refusals
    assert said["targets"]["white"] == {"names": "white", "reflectance": "white.csv"}
    assert said["cameras"]["d80"]["sensitivity"] == "d80_sensitivity.csv"


# --- what cannot be told ----------------------------------------------------------------------


def test_what_is_missing_or_odd_is_said_and_not_guessed(folder):
    for nm in WAVES:
        folder.white(f"c/dark/{nm}nm.tif")
        folder.dark(f"c/white/{nm}nm.tif")
        folder.object(f"c/icon1/{nm}nm.tif")
    folder.object("c/icon2/450nm.tif")
    (folder.root / "c/icon1/700nm.tif").write_bytes(b"II*\0junk")
    folder.write("c/dark/900nm.tif", np.full((30, 30), 64))
    proposal = look(folder.root)
    unknown, left_out = "\n".join(proposal.unknown), "\n".join(proposal.left_out)
    assert "darks and whites are swapped" in unknown
    assert "icon2/c would be refused" in unknown
    assert "c/icon1/700nm.tif" in left_out
    assert "c/dark/900nm.tif: dark of 30x30" in left_out
    assert all(
        text.split(":")[0] in proposal.text for text in (*proposal.unknown, *proposal.left_out)
    )


def test_every_guess_of_a_camera_has_its_reason_beside_it(folder):
    folder.all("d80/{}/DSC_1.tif", bayer=True)
    text = look(folder.root).text
    for key in ("kind", "pattern", "bits", "dark", "white", "objects", "reference"):
        above, line = next(
            (a, b)
            for a, b in zip(text.splitlines(), text.splitlines()[1:], strict=False)
            if b.startswith(f"{key} = ")
        )
        assert "#" in line or above.startswith("#"), line


def test_names_that_no_pattern_can_hold_do_not_break_it(folder):
    for nm in WAVES:
        folder.all(f"x{{y}}/{{}}/{nm}nm a*b.tif")
        folder.object(f"x{{y}}/icon@1/{nm}nm a*b.tif")
    proposal, captures, _ = found(folder.root)
    assert {name for name, _ in captures} == {"icon1", "icon2"}
    assert any("icon@1" in text for text in proposal.unknown)


def test_a_folder_without_captures_is_refused_with_what_there_is(tmp_path):
    (tmp_path / "notes.csv").write_text("a,b\n")
    (tmp_path / "bad.tif").write_bytes(b"nothing")
    with pytest.raises(LookRefused, match=r"1 \.csv") as refused:
        look(tmp_path)
    assert "bad.tif" in refused.value.problems[0].found
    Folder(tmp_path).dark("dark/1.tif")
    with pytest.raises(LookRefused, match="all captures here are darks or whites"):
        look(tmp_path)


def test_a_campaign_that_is_there_is_never_written_over(folder):
    folder.all("a/{}/550nm.tif")
    proposal = look(folder.root)
    path = write_campaign(proposal)
    with pytest.raises(LookRefused, match="already"):
        write_campaign(proposal)
    assert path.read_text(encoding="utf-8") == proposal.text
    assert look(folder.root).text == proposal.text


def test_the_command_shows_and_writes_only_when_told(folder):
    folder.all("a/{}/550nm.tif")
    run = CliRunner().invoke(app, ["look", str(folder.root)])
    assert run.exit_code == 0
    assert tomllib.loads(run.stdout)["cameras"]["a"]["kind"] == "bands"
    assert not (folder.root / "campaign.toml").exists()
    assert run.stderr == ("Nothing was written. Use --write to write it.\nLeft unknown: 1 thing.\n")
    run = CliRunner().invoke(app, ["look", str(folder.root), "--write", "--json"])
    report = json.loads(run.stdout)
    assert (run.exit_code, report["ok"], report["command"]) == (0, True, "look")
    assert report["campaign"] == tomllib.loads((folder.root / "campaign.toml").read_text())
    run = CliRunner().invoke(app, ["look", str(folder.root), "--write", "--json"])
    assert (run.exit_code, json.loads(run.stdout)["problems"][0]["code"]) == (1, "E_EXISTS")


# --- real captures, and a campaign by another generator ---------------------------------------


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
    assert not any("refused" in text for text in proposal.unknown)


def test_a_filter_wheel_is_guessed_and_the_darks_of_another_session_left_out(real_data):
    proposal = look(real_data / "filterwheel-disks")
    (camera,) = proposal.to_dict()["cameras"].values()
    # The README gives the sensor as GBRG; the trap is d2_, whose frames are 342 high, not 344.
    assert (camera["kind"], camera["pattern"], camera["exposures"]) == ("bands", "GBRG", "best")
    assert camera["files"] == [
        "frames/d1_{target}_{wavelength}nm_{exposure}ms_*.tif",
        "dark/d1_{target}_{exposure}ms_*.tif",
    ]
    assert camera["wavelengths"] == {"start": 400, "stop": 700, "step": 50}
    assert "14 files" in proposal.left_out[0]
    assert proposal.objects == ("disks32cmV2",)


def test_a_nine_band_mosaic_and_a_photograph_are_told_apart(real_data):
    proposal = look(real_data / "silios-kinect")
    cameras = proposal.to_dict()["cameras"]
    kinds = {name: camera["kind"] for name, camera in cameras.items()}
    assert kinds == {"kinect-hd-rgb": "image", "multispectral-camera": "mosaic"}
    assert len(cameras["multispectral-camera"]["pattern"]) == 3
    said = proposal.to_dict()["targets"]
    assert (said["dark"], said["white"]) == ("dark", "flat")
    assert proposal.objects == ("board", "burst", "scene1", "scene2")


def test_five_lenses_are_sensors_by_their_headers(real_data):
    proposal = look(real_data / "rededge-5lens")
    (camera,) = proposal.to_dict()["cameras"].values()
    assert camera["files"] == "IMG_{target}_{sensor}.tif"
    bands = [s["bands"] for s in camera["sensors"]]
    assert bands == [["Blue"], ["Green"], ["Red"], ["NIR"], ["Red edge"]]
    assert "exposures" not in camera
    assert proposal.objects == ("0000", "0001")


def test_a_line_scan_is_a_cube_with_its_templates(real_data):
    proposal = look(real_data / "envi-linescan")
    (camera,) = proposal.to_dict()["cameras"].values()
    assert (camera["kind"], camera["files"]) == ("cube", "{target}.hdr")
    assert proposal.to_dict()["targets"]["dark"] == "dark_reference_crop"
    assert proposal.to_dict()["campaign"]["reference"]["band"].startswith("5")


@pytest.mark.parametrize(
    ("said", "about", "unknown"),
    [
        (("tint = 10", "tint = 10", "tint = 20"), "dark 0.01 s, white 0.01 s, object 0.02 s", None),
        (
            ("tint = 10", "", "tint = {10, 30}"),
            "dark 0.01 s, object 0.01 to 0.03 s",
            "exposure of white frames",
        ),
        (("exposure = 10", "exposure = 10", "exposure = 10"), None, None),
        (("exposure = 10", "exposure = 10", "exposure = 20"), None, "'exposure = 20'"),
    ],
)
def test_exposures_that_headers_state_are_said_and_doubted(tmp_path, said, about, unknown):
    for (name, level), text in zip(
        {"dark": 60, "white": 3000, "icon1": 900}.items(), said, strict=True
    ):
        codes = np.random.default_rng(level).normal(level, 9, (12, 40, 2)).clip(0).astype("<u2")
        (tmp_path / f"{name}.raw").write_bytes(codes.tobytes())
        keys = (
            "samples = 40\nlines = 12\nbands = 2\ninterleave = bip\ndata type = 12\nbyte order = 0"
        )
        header = f"ENVI\n{keys}\nwavelength = {{500, 600}}\n{text}\n"
        (tmp_path / f"{name}.hdr").write_text(header)
    proposal = look(tmp_path)
    assert (f"Exposures: {about}." in proposal.text) if about else "Exposures" not in proposal.text
    doubts = [one for one in proposal.unknown if "exposure" in one]
    assert [unknown in one for one in doubts] == ([True] if unknown else [])


def test_pictures_without_any_order_are_objects_and_the_doubt_is_said(real_data):
    for name, count in (("paintings", 3), ("stain-landmarks", 8)):
        proposal = look(real_data / name)
        assert (len(proposal.cameras), len(proposal.objects)) == (1, count)
        assert "show the same object" in proposal.unknown[0]
    with pytest.raises(LookRefused, match="spectral library"):
        look(real_data / "spectra")


# --- files that no camera takes, and pictures that are no shots ---------------------------------


@pytest.mark.parametrize(
    ("names", "lost"),
    [
        (("vis", "shot1", "ColorChecker"), {"shot1", "ColorChecker"}),
        (("a", "b", "c-grey"), {"c-grey"}),
    ],
)
def test_every_file_that_the_proposal_does_not_take_is_listed_as_unknown(folder, names, lost):
    for k, name in enumerate(names):
        folder.picture(f"{name}.tif", 7 * k, channels=1 if "grey" in name or "vis" in names else 3)
    proposal = look(folder.root)
    assert {n for n in names if any(f"{n}.tif" in line for line in proposal.unknown)} == lost


def test_a_camera_raw_beside_a_header_of_its_name_is_not_lost(folder):
    folder.object("icon.tif")
    (folder.root / "icon.hdr").write_text("no header")
    (folder.root / "icon.nef").write_bytes(b"no raw")
    told = look(folder.root).left_out
    assert all(any(name in line for line in told) for name in ("icon.hdr", "icon.nef"))


def lit(folder, name, light):
    codes = 255 * np.clip(light * scene(3, shape=(90, 120)), 0, 1) ** (1 / 2.2)
    cv2.imwrite(str(folder._path(name)), np.repeat(codes[..., None], 3, 2).astype(np.uint8))


def answers(proposal):
    (camera,) = proposal.cameras
    return [(one.objects, one.keys["files"].value if one.keys else "") for one in camera.choices]


@pytest.mark.parametrize("listed", [True, False])
def test_pictures_of_a_dome_are_asked_for(folder, listed):
    """An .lp file lists them; without it their light tells that they are no shots."""
    across = np.linspace(0, 1, 120)
    for k in range(6):
        lit(folder, f"dome/coin_{k + 1}.tif", 0.4 + 0.6 * (across if k % 2 else 1 - across))
    if listed:
        rows = "".join(f"coin_{k + 1}.jpg 0.{k} -0.5 7e-1\n" for k in range(6))
        (folder.root / "dome/coin.lp").write_text(f"6\n{rows}")
    each, one = answers(look(folder.root))
    assert each[0] == tuple(f"coin_{k + 1}" for k in range(6)) and one[0] == ("coin_4",)


def test_a_bracket_is_asked_for(folder):
    for k, times in enumerate((0.25, 1, 4)):
        lit(folder, f"panel/DSC_{k + 1}.tif", times)
    each, one = answers(look(folder.root))
    assert each[0] == ("1", "2", "3") and one[0] == ("2",)


def test_a_bracket_with_darks_and_whites_is_asked_for_with_both_patterns(folder):
    for k, times in enumerate((0.25, 0.5, 1)):
        folder.dark(f"dark/{k}.tif")
        folder.white(f"white/{k}.tif")
        light = 64 + 2500 * times * scene() + folder.rng.normal(0, 6, (60, 80))
        folder.write(f"icon/{k}.tif", light)
    proposal = look(folder.root)
    assert answers(proposal) == [
        (("icon",), "{target}/{shot}.tif"),
        (("icon",), "{target}/1.tif"),
    ]
    assert not any(".tif" in line for line in proposal.unknown[1:])  # the first answer takes all


def test_shots_under_a_lamp_that_warms_up_are_no_question(folder):
    for k in range(3):
        noise = np.random.default_rng(k).normal(1, 0.01, (90, 120))
        lit(folder, f"panel/DSC_{k + 1}.tif", (0.8 + 0.02 * k) * noise)
    proposal = look(folder.root)
    assert proposal.cameras[0].keys["files"].value == "{target}/DSC_{shot}.tif"
    assert not proposal.cameras[0].choices and not proposal.unknown
