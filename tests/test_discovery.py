import numpy as np
import pytest
import tifffile

from levkas.campaign import load_campaign
from levkas.discovery import find_captures
from levkas.patterns import find, natural
from levkas.problems import Refused


def touch(folder, *names):
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        tifffile.imwrite(path, np.zeros((4, 6), np.uint16))


def campaign(folder, cameras, targets='dark = "dark"\nwhite = "white"', reference="vis"):
    text = (
        f'[campaign]\nreference = {{ camera = "{reference}" }}\n{cameras}\n[targets]\n{targets}\n'
    )
    (folder / "campaign.toml").write_text(text)
    return load_campaign(folder)


VIS = '[cameras.vis]\nkind = "bands"\nfiles = "raw/{target}/{wavelength}nm*.tif"\n'


def bands(folder, target, wavelengths=(450, 550), suffix=""):
    touch(folder, *(f"raw/{target}/{w}nm{suffix}.tif" for w in wavelengths))


def whole(folder):
    for target in ("dark", "white", "icon1"):
        bands(folder, target)


def test_a_band_is_a_file_with_its_own_dark_and_white(tmp_path):
    whole(tmp_path)
    (capture,), refusals = find_captures(campaign(tmp_path, VIS))
    assert not refusals and capture.object == "icon1" and capture.layer == "vis"
    (sensor,) = capture.sensors
    assert [b.label for b in capture.bands] == ["450 nm", "550 nm"]
    assert [(f.band, f.path.name) for f in sensor.white] == [
        ("450 nm", "450nm.tif"),
        ("550 nm", "550nm.tif"),
    ]


def test_the_order_of_the_file_system_does_not_matter(tmp_path):
    names = [f"raw/icon1/DSC_{n}.tif" for n in (10, 9, 100, 1)]
    touch(tmp_path, *names)
    found = find(tmp_path, ["raw/{target}/DSC_{shot}.tif"])
    assert [f.shot for f in found] == ["1", "9", "10", "100"]
    assert sorted(["b10", "b9"], key=natural) == ["b9", "b10"]


@pytest.mark.parametrize(
    ("text", "seconds"), [("250ms", 0.25), ("3s", 3.0), ("0.5", 0.5), ("40us", 4e-5)]
)
def test_the_exposure_takes_its_unit_from_what_follows(tmp_path, text, seconds):
    unit = text.lstrip("0123456789.")
    touch(tmp_path, f"a_{text}.tif")
    (found,) = find(tmp_path, ["{target}_{exposure}" + unit + ".tif"])
    assert found.exposure_s == pytest.approx(seconds)


def test_a_missing_band_is_named(tmp_path):
    whole(tmp_path)
    text = VIS + "wavelengths = { start = 450, stop = 650, step = 100 }\n"
    _, refusals = find_captures(campaign(tmp_path, text))
    (problem,) = refusals["icon1", "vis", ""].problems
    assert problem.code == "E_BAND_MISSING" and "650 nm missing" in problem.message
    assert (problem.found, problem.expected) == (2, 3) and "wavelengths" in problem.field


def test_two_files_for_one_band_are_refused_unless_they_are_shots(tmp_path):
    whole(tmp_path)
    bands(tmp_path, "icon1", (550,), "_again")
    _, refusals = find_captures(campaign(tmp_path, VIS))
    (problem,) = refusals["icon1", "vis", ""].problems
    assert problem.code == "E_BAND_TWICE" and "550nm_again.tif" in problem.found
    shots = VIS.replace("nm*", "nm{shot}")
    (capture,), refusals = find_captures(campaign(tmp_path, shots))
    assert not refusals and len(capture.sensors[0].object) == 3


def test_a_declared_template_that_is_not_there_is_refused_with_the_way_out(tmp_path):
    bands(tmp_path, "white")
    bands(tmp_path, "icon1")
    _, refusals = find_captures(campaign(tmp_path, VIS))
    (problem,) = refusals["icon1", "vis", ""].problems
    assert problem.code == "E_TEMPLATE_MISSING" and "dark = []" in problem.fix
    (capture,), refusals = find_captures(campaign(tmp_path, VIS + "dark = []\n"))
    assert not refusals and capture.sensors[0].dark == ()


def test_an_object_without_a_reference_image_is_refused_and_the_other_is_found(tmp_path):
    whole(tmp_path)
    touch(tmp_path, "photo/icon1.tif", "photo/icon2.tif")
    photo = '[cameras.photo]\nkind = "image"\nfiles = "photo/{target}.tif"\n'
    targets = 'dark = "dark"\nwhite = "white"\nobjects = ["icon1", "icon2"]'
    captures, refusals = find_captures(campaign(tmp_path, VIS + photo, targets))
    assert [(c.object, c.camera) for c in captures] == [
        ("icon1", "vis"),
        ("icon1", "photo"),
        ("icon2", "photo"),
    ]
    assert list(refusals) == [("icon2", "vis", "")]
    assert refusals["icon2", "vis", ""].problems[0].code == "E_NO_FRAMES"


def test_several_exposures_are_an_error_unless_one_says_what_to_do(tmp_path):
    text = VIS.replace("{wavelength}nm*", "{wavelength}nm_{exposure}ms")
    for target in ("dark", "white", "icon1"):
        bands(tmp_path, target, (550,), "_10ms")
    bands(tmp_path, "icon1", (550,), "_40ms")
    _, refusals = find_captures(campaign(tmp_path, text))
    (problem,) = refusals["icon1", "vis", ""].problems
    assert problem.code == "E_EXPOSURES" and '"best"' in problem.fix
    (capture,), refusals = find_captures(campaign(tmp_path, text + 'exposures = "merge"\n'))
    assert not refusals and sorted(f.exposure_s for f in capture.sensors[0].object) == [0.01, 0.04]


def test_pages_of_a_tiff_are_bands(tmp_path):
    for target in ("dark", "white", "icon1"):
        path = tmp_path / f"raw/{target}.tif"
        path.parent.mkdir(exist_ok=True)
        tifffile.imwrite(path, np.zeros((3, 4, 6), np.uint16), photometric="minisblack")
    text = (
        '[cameras.vis]\nkind = "bands"\nfiles = "raw/{target}.tif"\nwavelengths = [450, 550, 650]\n'
    )
    (capture,), refusals = find_captures(campaign(tmp_path, text))
    assert not refusals and [f.page for f in capture.sensors[0].object] == [0, 1, 2]
    assert len(capture.sensors[0].dark) == 3
    _, refusals = find_captures(campaign(tmp_path, text.replace(", 650", "")))
    assert refusals["icon1", "vis", ""].problems[0].code == "E_BAND_COUNT"


def test_channels_of_two_mosaics_keep_names_of_their_own(tmp_path):
    for target in ("dark", "white", "icon1"):
        touch(tmp_path, *(f"raw/{target}/ccd{n}_0.tif" for n in (1, 2, 3)))
    text = '[cameras.vis]\nkind = "sensors"\nfiles = "raw/{target}/{sensor}_{shot}.tif"\n'
    for n in (1, 2):
        text += f'[[cameras.vis.sensors]]\nname = "ccd{n}"\npattern = "GBRG"\nbands = ["R{n}", "G{n}", "B{n}"]\n'
    text += '[[cameras.vis.sensors]]\nname = "ccd3"\nbands = ["IR"]\n'
    (capture,), refusals = find_captures(campaign(tmp_path, text))
    assert not refusals
    assert [b.label for b in capture.bands] == ["R1", "G1", "B1", "R2", "G2", "B2", "IR"]
    assert capture.sensors[0].pattern == (("G1", "B1"), ("R1", "G1"))
    assert [len(s.white) for s in capture.sensors] == [1, 1, 1]


def test_a_setup_has_its_own_white_and_falls_back_to_the_dark_of_the_camera(tmp_path):
    whole(tmp_path)
    for target in ("white", "icon1"):
        touch(tmp_path, f"soft/{target}/450nm.tif", f"soft/{target}/550nm.tif")
    text = VIS + '[setups.soft.cameras.vis]\nfiles = "soft/{target}/{wavelength}nm.tif"\n'
    captures, refusals = find_captures(campaign(tmp_path, text))
    assert not refusals and [c.layer for c in captures] == ["vis", "vis@soft"]
    (sensor,) = captures[1].sensors
    assert "soft" in str(sensor.white[0].path) and "raw" in str(sensor.dark[0].path)


def test_a_campaign_without_any_object_shows_the_pattern_and_what_is_there(tmp_path):
    touch(tmp_path, "raw/dark/450nm.tif", "raw/white/450nm.tif")
    with pytest.raises(Refused, match=r"dark, white") as refused:
        find_captures(campaign(tmp_path, VIS))
    assert refused.value.problems[0].code == "E_NO_FRAMES"


def test_the_foreign_campaign_is_found_whole(two_paintings):
    from pathlib import Path

    root = Path(__file__).resolve().parents[1] / "examples" / "two-paintings"
    text = (root / "campaign.toml").read_text()
    assert "../../../shared/campaigns" in text
    captures, refusals = find_captures(load_campaign(root))
    if not captures:
        pytest.skip("the example's relative path does not lead to the campaign here")
    assert not refusals and len(captures) == 12
    assert (
        sum(len(c.bands) for c in captures if c.object == "icon1" and not c.setup)
        == 16 + 11 + 7 + 3 + 25
    )
