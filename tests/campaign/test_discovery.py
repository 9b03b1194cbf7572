from pathlib import Path

import numpy as np
import pytest
import tifffile

from levkas.campaign.campaign import load_campaign
from levkas.campaign.discovery.find_captures import find_captures
from levkas.core.problems import Refused

EXAMPLES = Path(__file__).resolve().parents[2] / "examples"


def touch(folder, *names, pages=None, samples=None):
    shape = (*((pages,) if pages else ()), 4, 6, *((samples,) if samples else ()))
    for name in names:
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        photometric = "rgb" if samples == 3 else "minisblack"
        tifffile.imwrite(path, np.zeros(shape, np.uint16), photometric=photometric)


def envi(folder, name, wavelengths=(400, 500, 600)):
    path = folder / name
    path.parent.mkdir(parents=True, exist_ok=True)
    np.zeros((4, len(wavelengths), 6), "<u2").tofile(path.with_suffix(".raw"))
    path.with_suffix(".hdr").write_text(
        f"ENVI\nsamples = 6\nlines = 4\nbands = {len(wavelengths)}\ndata type = 12\ninterleave = bil\n"
        f"wavelength = {{{', '.join(map(str, wavelengths))}}}\n"
    )


def campaign(folder, cameras, targets='dark = "dark"\nwhite = "white"', reference="vis"):
    text = (
        f'[campaign]\nreference = {{ camera = "{reference}" }}\n{cameras}\n[targets]\n{targets}\n'
    )
    (folder / "campaign.toml").write_text(text)
    return load_campaign(folder)


def found_in(folder, *args, **more):
    captures, refusals = find_captures(campaign(folder, *args, **more))
    assert not refusals, refusals
    return captures


def problem_of(folder, *args, key=("icon1", "vis", ""), **more):
    _, refusals = find_captures(campaign(folder, *args, **more))
    (problem,) = refusals[key].problems
    assert problem.file and problem.field and problem.expected and problem.fix
    return problem


VIS = '[cameras.vis]\nkind = "bands"\nfiles = "raw/{target}/{wavelength}nm*.tif"\n'
PHOTO = '[cameras.photo]\nkind = "image"\nfiles = "photo/{target}.tif"\n'


def bands(folder, target, wavelengths=(450, 550), suffix="", root="raw"):
    touch(folder, *(f"{root}/{target}/{w}nm{suffix}.tif" for w in wavelengths))


def whole(folder, *objects):
    for target in ("dark", "white", *(objects or ("icon1",))):
        bands(folder, target)


# --- bands ------------------------------------------------------------------------------------


def test_a_band_is_a_file_with_its_own_dark_and_white(tmp_path):
    whole(tmp_path)
    (capture,) = found_in(tmp_path, VIS)
    assert capture.object == "icon1" and capture.layer == "vis"
    (sensor,) = capture.sensors
    assert [b.label for b in capture.bands] == ["450 nm", "550 nm"]
    assert [b.wavelength for b in capture.bands] == [450.0, 550.0]
    for frames in (sensor.object, sensor.dark, sensor.white):
        assert [(f.band, f.path.name) for f in frames] == [
            ("450 nm", "450nm.tif"),
            ("550 nm", "550nm.tif"),
        ]


def test_a_missing_band_is_named_as_the_folder_lacks_it(tmp_path):
    centres = [w for w in range(400, 730, 10) if w not in (470, 480)]
    for target in ("dark", "white", "icon1"):
        bands(tmp_path, target, centres)
    keys = VIS + "wavelengths = { start = 400, stop = 720, step = 10 }\n"
    problem = problem_of(tmp_path, keys)
    assert problem.code == "E_BAND_MISSING" and (problem.found, problem.expected) == (31, 33)
    assert problem.message == (
        "vis: 400–720 nm by 10 nm is 33 bands, the folder has 31 (missing 470, 480 nm)"
    )


def test_a_band_too_many_is_named(tmp_path):
    whole(tmp_path)
    problem = problem_of(tmp_path, VIS + "wavelengths = [450]\n")
    assert problem.code == "E_BAND_COUNT" and "not declared: 550 nm" in problem.message


def test_without_declared_wavelengths_an_object_has_the_bands_of_the_others(tmp_path):
    whole(tmp_path, "icon1", "icon2")
    (tmp_path / "raw/icon2/550nm.tif").unlink()
    captures, refusals = find_captures(campaign(tmp_path, VIS))
    assert [c.object for c in captures] == ["icon1"]
    problem = refusals["icon2", "vis", ""].problems[0]
    assert problem.code == "E_BAND_MISSING" and "missing 550 nm" in problem.message
    (tmp_path / "raw/icon1/550nm.tif").unlink()  # now only the white tells
    assert len(find_captures(campaign(tmp_path, VIS))[1]) == 2
    assert len(found_in(tmp_path, VIS + "wavelengths = [450]\n")) == 2


def test_named_bands_stand_in_the_declared_order_with_the_declared_centres(tmp_path):
    touch(tmp_path, "raw/icon1/red.tif", "raw/icon1/blue.tif")
    keys = '[cameras.vis]\nkind = "bands"\nfiles = "raw/{target}/{band}.tif"\n'
    (capture,) = found_in(tmp_path, keys, "")
    assert [b.label for b in capture.bands] == ["blue", "red"]
    keys += 'bands = ["red", "blue"]\nwavelengths = [650, 450]\n'
    (capture,) = found_in(tmp_path, keys, "")
    assert [(b.label, b.wavelength) for b in capture.bands] == [("red", 650.0), ("blue", 450.0)]
    assert [f.band for f in capture.sensors[0].object] == ["red", "blue"]


def test_two_files_for_one_band_are_refused_unless_they_are_shots(tmp_path):
    whole(tmp_path)
    bands(tmp_path, "icon1", (550,), "_again")
    problem = problem_of(tmp_path, VIS)
    assert problem.code == "E_BAND_TWICE" and "550nm_again.tif" in problem.found
    assert "{shot}" in problem.fix
    (capture,) = found_in(tmp_path, VIS.replace("nm*", "nm{shot}"))
    assert len(capture.sensors[0].object) == 3


def test_templates_without_a_band_serve_all_and_those_of_other_bands_are_left_out(tmp_path):
    bands(tmp_path, "icon1")
    bands(tmp_path, "white", (450, 550, 650))
    touch(tmp_path, "raw/dark/1.tif", "raw/dark/2.tif")
    keys = '[cameras.vis]\nkind = "bands"\nwavelengths = [450, 550]\n'
    keys += 'files = ["raw/{target}/{wavelength}nm.tif", "raw/{target}/{shot}.tif"]\n'
    (capture,) = found_in(tmp_path, keys)
    assert [f.band for f in capture.sensors[0].white] == ["450 nm", "550 nm"]
    assert [(f.band, f.shot) for f in capture.sensors[0].dark] == [(None, "1"), (None, "2")]


def test_a_band_without_its_white_is_refused(tmp_path):
    whole(tmp_path)
    (tmp_path / "raw/white/550nm.tif").unlink()
    problem = problem_of(tmp_path, VIS)
    assert problem.code == "E_TEMPLATE_MISSING" and problem.found == "none for 550 nm"


def test_several_exposures_are_an_error_unless_one_says_what_to_do(tmp_path):
    text = VIS.replace("{wavelength}nm*", "{wavelength}nm_{exposure}ms")
    for target in ("dark", "white", "icon1"):
        bands(tmp_path, target, (550,), "_10ms")
    bands(tmp_path, "icon1", (550,), "_40ms")
    problem = problem_of(tmp_path, text)
    assert (
        problem.code == "E_EXPOSURES"
        and problem.found == "0.01 s, 0.04 s"
        and '"best"' in problem.fix
    )
    (capture,) = found_in(tmp_path, text + 'exposures = "merge"\n')
    assert [f.exposure_s for f in capture.sensors[0].object] == [0.01, 0.04]


def test_pages_of_a_tiff_are_bands(tmp_path):
    touch(tmp_path, "raw/white.tif", "raw/icon1.tif", pages=3)
    touch(tmp_path, "raw/dark.tif")
    text = '[cameras.vis]\nkind = "bands"\nfiles = "raw/{target}.tif"\n'
    (capture,) = found_in(tmp_path, text + "wavelengths = [450, 550, 650]\n")
    (sensor,) = capture.sensors
    assert [(f.band, f.page) for f in sensor.object] == [
        ("450 nm", 0),
        ("550 nm", 1),
        ("650 nm", 2),
    ]
    assert [f.page for f in sensor.white] == [0, 1, 2] and [f.page for f in sensor.dark] == [None]
    assert problem_of(tmp_path, text + "wavelengths = [450, 550]\n").code == "E_BAND_COUNT"


# --- mosaics and sensors ----------------------------------------------------------------------


def test_shots_of_a_mosaic_are_all_the_files_of_a_target(tmp_path):
    touch(tmp_path, *(f"raw/{t}/{n}.tif" for t in ("dark", "white", "icon1") for n in (1, 2)))
    keys = '[cameras.vis]\nkind = "mosaic"\nfiles = "raw/{target}/*.tif"\n'
    assert "pattern" in problem_of(tmp_path, keys).field  # neither we nor the file know the mosaic
    (capture,) = found_in(tmp_path, keys + 'pattern = "BGGR"\n')
    assert [b.label for b in capture.bands] == ["R", "G", "B"]
    assert [len(f) for f in (capture.sensors[0].object, capture.sensors[0].white)] == [2, 2]


def test_narrow_channels_of_a_mosaic_have_the_declared_centres(tmp_path):
    touch(tmp_path, "raw/icon1.tif")
    keys = '[cameras.vis]\nkind = "mosaic"\nfiles = "raw/{target}.tif"\npattern = [["a", "b"], ["c", "d"]]\n'
    (capture,) = found_in(tmp_path, keys + "wavelengths = [400, 500, 600, 700]\n", "")
    assert [(b.label, b.wavelength) for b in capture.bands] == [
        ("a", 400),
        ("b", 500),
        ("c", 600),
        ("d", 700),
    ]
    assert problem_of(tmp_path, keys + "wavelengths = [400]\n", "").code == "E_BAND_COUNT"


CCDS = '[cameras.vis]\nkind = "sensors"\nfiles = "raw/{target}/{sensor}_{shot}.tif"\n' + "".join(
    f'[[cameras.vis.sensors]]\nname = "ccd{n}"\npattern = "GBRG"\nbands = ["R{n}", "G{n}", "B{n}"]\n'
    for n in (1, 2)
)
CCDS += '[[cameras.vis.sensors]]\nname = "ccd3"\nbands = ["IR"]\nalign = [[1, 0, 2], [0, 1, 3]]\n'


def three(folder):
    for target in ("dark", "white", "icon1"):
        touch(folder, *(f"raw/{target}/ccd{n}_{shot}.tif" for n in (1, 2, 3) for shot in (0, 1)))


def test_channels_of_two_mosaics_keep_names_of_their_own(tmp_path):
    three(tmp_path)
    (capture,) = found_in(tmp_path, CCDS)
    assert [b.label for b in capture.bands] == ["R1", "G1", "B1", "R2", "G2", "B2", "IR"]
    assert capture.sensors[0].pattern == (("G1", "B1"), ("R1", "G1"))
    assert [len(s.white) for s in capture.sensors] == [2, 2, 2]
    assert {f.sensor for s in capture.sensors[1:2] for f in (*s.object, *s.dark)} == {"ccd2"}
    assert capture.sensors[2].align == ((1, 0, 2), (0, 1, 3))


def test_every_sensor_that_lacks_something_is_named(tmp_path):
    three(tmp_path)
    for name in (
        "raw/icon1/ccd1_0.tif",
        "raw/icon1/ccd1_1.tif",
        "raw/white/ccd3_0.tif",
        "raw/white/ccd3_1.tif",
    ):
        (tmp_path / name).unlink()
    _, refusals = find_captures(campaign(tmp_path, CCDS))
    reported = refusals["icon1", "vis", ""].problems
    assert [p.code for p in reported] == ["E_BAND_MISSING", "E_TEMPLATE_MISSING"]
    assert "ccd1" in reported[0].message and "ccd3" in reported[1].message


def test_sensors_with_the_same_channels_are_refused(tmp_path):
    three(tmp_path)
    keys = CCDS.replace('bands = ["R1", "G1", "B1"]\n', "").replace(
        'bands = ["R2", "G2", "B2"]\n', ""
    )
    assert problem_of(tmp_path, keys).found == "R, G, B"


# --- cubes and images -------------------------------------------------------------------------

CUBE = '[cameras.vis]\nkind = "cube"\nfiles = "raw/{target}*.hdr"\n'


def test_a_header_says_the_bands_of_a_cube_and_strips_stay_in_natural_order(tmp_path):
    for name in ("dark", "white", "icon1_10", "icon1_9"):
        envi(tmp_path, f"raw/{name}")
    (capture,) = found_in(tmp_path, CUBE, 'dark = "dark"\nwhite = "white"\nobjects = ["icon1"]')
    assert [b.label for b in capture.bands] == ["400 nm", "500 nm", "600 nm"]
    assert [f.path.stem for f in capture.sensors[0].object] == ["icon1_9", "icon1_10"]
    assert [f.page for f in capture.sensors[0].object] == [None, None]


PASSES = CUBE.replace('"raw/{target}*.hdr"', '["raw/{target}_{column}.hdr", "raw/{target}.hdr"]')


def test_passes_of_a_scanner_with_a_column_in_their_names_are_tiles(tmp_path):
    for name in ("dark", "white", "icon1_10", "icon1_9"):
        envi(tmp_path, f"raw/{name}")
    touch(tmp_path, "photo/icon1.tif", samples=3)
    targets = 'dark = "dark"\nwhite = "white"\nobjects = ["icon1"]'
    captures = found_in(tmp_path, PASSES + PHOTO, targets, reference="photo")
    (scan,) = [capture for capture in captures if capture.camera == "vis"]
    assert [part.tile for part in scan.tiles] == ["c9", "c10"]
    for part in scan.tiles:
        ((one,),) = [sensor.object for sensor in part.sensors]
        assert one.path.stem == f"icon1_{part.tile[1:]}"
        assert part.sensors[0].white and part.sensors[0].dark


def test_passes_of_a_reference_cannot_be_tiles(tmp_path):
    with pytest.raises(Refused) as refused:
        campaign(tmp_path, PASSES)
    (problem,) = refused.value.problems
    assert problem.field == "cameras.vis.files" and "{tile}" in problem.expected


def test_what_a_header_says_is_checked_against_what_is_declared(tmp_path):
    envi(tmp_path, "raw/icon1")
    found_in(tmp_path, CUBE + "wavelengths = { start = 401, stop = 601, step = 100 }\n", "")
    problem = problem_of(
        tmp_path, CUBE + "wavelengths = { start = 400, stop = 700, step = 100 }\n", ""
    )
    assert problem.code == "E_BAND_COUNT" and "400–700 nm by 100 nm is 4 bands" in problem.message
    problem = problem_of(tmp_path, CUBE + "wavelengths = [400, 500, 900]\n", "")
    assert problem.code == "E_VALUE" and "600 nm" in problem.found


def test_a_white_of_another_number_of_bands_is_refused(tmp_path):
    envi(tmp_path, "raw/icon1")
    envi(tmp_path, "raw/white", (400, 500))
    problem = problem_of(tmp_path, CUBE, 'white = "white"')
    assert problem.code == "E_BAND_COUNT" and "white.hdr" in problem.file


def test_pages_of_a_tiff_are_the_bands_of_a_cube(tmp_path):
    touch(tmp_path, "raw/icon1.tif", pages=3)
    (capture,) = found_in(
        tmp_path, CUBE.replace(".hdr", ".tif") + "wavelengths = [401, 402, 403]\n", ""
    )
    assert [b.label for b in capture.bands] == ["401 nm", "402 nm", "403 nm"]
    assert len(capture.sensors[0].object) == 1


def test_a_truncated_cube_refuses_its_own_capture_only(tmp_path):
    envi(tmp_path, "raw/icon1")
    envi(tmp_path, "raw/icon2")
    (tmp_path / "raw/icon1.raw").write_bytes(b"short")
    captures, refusals = find_captures(campaign(tmp_path, CUBE, ""))
    assert [c.object for c in captures] == ["icon2"] and list(refusals) == [("icon1", "vis", "")]


def test_an_image_needs_no_templates_and_has_one_or_three_channels(tmp_path):
    whole(tmp_path)
    touch(tmp_path, "photo/icon1.tif", "photo/dark.tif", samples=3)
    touch(tmp_path, "xray/icon1.tif")
    cameras = VIS + PHOTO + PHOTO.replace("photo", "xray")
    captures = found_in(tmp_path, cameras)
    assert [[b.label for b in c.bands] for c in captures[1:]] == [["R", "G", "B"], ["grey"]]
    assert captures[1].sensors[0].dark == ()


def test_two_images_of_one_object_are_refused(tmp_path):
    touch(tmp_path, "photo/icon1_a.tif", "photo/icon1_b.tif")
    keys = PHOTO.replace("{target}", "{target}_*")
    problem = problem_of(
        tmp_path, keys, 'objects = ["icon1"]', reference="photo", key=("icon1", "photo", "")
    )
    assert problem.code == "E_BAND_TWICE"


# --- templates --------------------------------------------------------------------------------


def test_a_declared_template_that_is_not_there_is_refused_and_never_switched_off(tmp_path):
    bands(tmp_path, "white")
    bands(tmp_path, "icon1")
    problem = problem_of(tmp_path, VIS)
    assert problem.code == "E_TEMPLATE_MISSING"
    assert problem.found == "icon1, white" and problem.fix == "Add the frames."
    (capture,) = found_in(tmp_path, VIS + "dark = []\n")
    assert capture.sensors[0].dark == () and len(capture.sensors[0].white) == 2


def test_a_camera_may_have_templates_of_its_own_names(tmp_path):
    bands(tmp_path, "icon1")
    bands(tmp_path, "cap_on")
    (capture,) = found_in(tmp_path, VIS + 'dark = "cap_on"\nwhite = []\n')
    assert len(capture.sensors[0].dark) == 2 and capture.object == "icon1"


# --- setups -----------------------------------------------------------------------------------


def test_a_setup_has_its_own_white_and_falls_back_to_the_dark_of_the_camera(tmp_path):
    whole(tmp_path)
    for target in ("white", "icon1"):
        bands(tmp_path, target, root="soft")
    text = VIS + '[setups.soft.cameras.vis]\nfiles = "soft/{target}/{wavelength}nm.tif"\n'
    captures = found_in(tmp_path, text)
    assert [c.layer for c in captures] == ["vis", "vis@soft"]
    (sensor,) = captures[1].sensors
    assert "soft" in str(sensor.white[0].path) and "raw" in str(sensor.dark[0].path)
    bands(tmp_path, "dark", root="soft")
    assert "soft" in str(found_in(tmp_path, text)[1].sensors[0].dark[0].path)


def test_a_setup_without_a_white_of_its_own_is_refused(tmp_path):
    whole(tmp_path)
    bands(tmp_path, "icon1", root="soft")
    text = VIS + '[setups.soft.cameras.vis]\nfiles = "soft/{target}/{wavelength}nm.tif"\n'
    captures, refusals = find_captures(campaign(tmp_path, text))
    assert [c.layer for c in captures] == ["vis"]
    problem = refusals["icon1", "vis", "soft"].problems[0]
    assert problem.code == "E_TEMPLATE_MISSING" and "soft/{target}" in problem.expected


def test_setups_may_stand_in_the_pattern(tmp_path):
    for setup in ("plain", "soft"):
        for target in ("dark", "white", "icon1"):
            bands(tmp_path, target, root=f"raw/{setup}")
    text = VIS.replace("raw/", "raw/{setup}/")
    _, refusals = find_captures(campaign(tmp_path, text))
    assert refusals["icon1", "vis", ""].problems[0].found == "plain, soft"
    captures = found_in(tmp_path, text + "[setups.soft.cameras.vis]\n")
    assert [c.layer for c in captures] == ["vis", "vis@soft"]
    assert {f.setup for f in captures[1].sensors[0].object} == {"soft"}
    assert [c.layer for c in found_in(tmp_path, text + "[setups.soft]\n")] == ["vis", "vis@soft"]


# --- objects ----------------------------------------------------------------------------------


def test_an_object_without_a_reference_image_is_refused_and_the_other_is_found(tmp_path):
    whole(tmp_path)
    touch(tmp_path, "photo/icon1.tif", "photo/icon2.tif")
    for objects in ("", 'objects = ["icon1", "icon2"]'):
        targets = f'dark = "dark"\nwhite = "white"\n{objects}'
        captures, refusals = find_captures(campaign(tmp_path, VIS + PHOTO, targets))
        assert [c for c in captures if c.object == "icon1"] and list(refusals) == [
            ("icon2", "vis", "")
        ]
        problem = refusals["icon2", "vis", ""].problems[0]
        assert problem.code == "E_NO_FRAMES" and problem.found == "captured by photo"
    targets = 'dark = "dark"\nwhite = "white"\nobjects = ["icon1"]'
    assert [c.camera for c in found_in(tmp_path, VIS + PHOTO, targets)] == ["vis", "photo"]


def test_a_camera_that_saw_one_object_promised_no_other(tmp_path):
    whole(tmp_path, "icon1", "icon2")
    touch(tmp_path, "photo/icon1.tif")
    captures = found_in(tmp_path, VIS + PHOTO)
    assert [(c.object, c.camera) for c in captures] == [
        ("icon1", "vis"),
        ("icon1", "photo"),
        ("icon2", "vis"),
    ]


def test_a_camera_that_saw_nothing_shows_its_pattern_and_the_nearest_names(tmp_path):
    whole(tmp_path)
    touch(tmp_path, "photo/Icon-1.tiff", "photo/ikon1.tif", "photo/readme.tif", "photo/notes.tif")
    problem = problem_of(
        tmp_path,
        VIS + PHOTO,
        'dark = "dark"\nwhite = "white"\nobjects = ["icon1"]',
        key=("icon1", "photo", ""),
    )
    assert problem.code == "E_NO_FRAMES" and problem.expected == "photo/{target}.tif"
    names = problem.found.split(", ")
    assert set(names[:2]) == {"ikon1.tif", "Icon-1.tiff"} and len(names) == 3


def test_a_misspelt_object_is_told_which_one_there_is(tmp_path):
    whole(tmp_path)
    targets = 'dark = "dark"\nwhite = "white"\nobjects = ["icno1"]'
    problem = problem_of(tmp_path, VIS, targets, key=("icno1", "vis", ""))
    assert problem.fix == "Did you mean 'icon1'?" and "icon1" in problem.found


def test_facts_promise_an_object(tmp_path):
    whole(tmp_path)
    _, refusals = find_captures(campaign(tmp_path, VIS + '[objects.icon7]\ntitle = "Lost"\n'))
    assert list(refusals) == [("icon7", "vis", "")]


def test_charts_are_no_objects(tmp_path):
    whole(tmp_path, "icon1", "macbeth")
    targets = 'dark = "dark"\nwhite = "white"\ncharts = { macbeth = "ColorChecker24" }'
    assert [c.object for c in found_in(tmp_path, VIS, targets)] == ["icon1"]


def test_a_campaign_without_any_object_says_what_there_is(tmp_path):
    touch(tmp_path, "raw/dark/450nm.tif", "raw/white/450nm.tif")
    with pytest.raises(Refused, match=r"only dark, white") as refused:
        find_captures(campaign(tmp_path, VIS))
    assert refused.value.problems[0].code == "E_NO_FRAMES"


def test_a_reference_band_that_is_not_there_is_refused(tmp_path):
    whole(tmp_path)
    problem = problem_of(tmp_path, VIS, reference='vis", band = "551 nm')
    assert problem.code == "E_BAND_MISSING" and problem.field == "campaign.reference.band"
    assert (
        problem_of(tmp_path, VIS + 'reference_band = "G"\n').field == "cameras.vis.reference_band"
    )


def test_the_database_of_an_earlier_build_is_not_taken_for_raw_frames(tmp_path):
    whole(tmp_path)
    touch(tmp_path, "database/icon9/450nm.tif", "database.kept/icon8/450nm.tif")
    captures = found_in(tmp_path, VIS.replace("raw/{target}", "**/{target}"))
    assert [c.object for c in captures] == ["icon1"]


# --- real captures ----------------------------------------------------------------------------


def example(name, tmp_path, shared):
    """An example's campaign.toml with its frames looked for where they are here."""
    text = (EXAMPLES / name / "campaign.toml").read_text(encoding="utf-8")
    for folder, place in shared.items():
        assert f"../../../shared/{folder}/" in text
        text = text.replace(f"../../../shared/{folder}", place.as_posix())
    (tmp_path / "campaign.toml").write_text(text, encoding="utf-8")
    captures, refusals = find_captures(load_campaign(tmp_path))
    assert not refusals, refusals
    return captures


def counts(capture):
    """Bands, and frames of object, dark and white over all sensors."""
    kinds = ("object", "dark", "white")
    return len(capture.bands), *(sum(len(getattr(s, k)) for s in capture.sensors) for k in kinds)


def test_the_foreign_campaign_is_found_whole(tmp_path, two_paintings):
    captures = example("two-paintings", tmp_path, {"campaigns": two_paintings.parent})
    for name in ("icon1", "icon2"):
        mine = {c.layer: counts(c) for c in captures if c.object == name}
        assert mine == {
            "lctf-vis": (16, 16, 16, 16),
            "lctf-nir": (11, 11, 11, 11),
            "msbs": (7, 6, 9, 9),
            "d80": (3, 2, 3, 3),
            "v10": (25, 1, 1, 1),
            "d80@45-degree": (3, 2, 3, 3),
        }
    assert captures[0].layer == "lctf-vis" and captures[5].layer == "d80@45-degree"
    files = {f.path for c in captures for s in c.sensors for f in (*s.object, *s.dark, *s.white)}
    there = [p for p in (two_paintings / "raw").rglob("*") if p.suffix in (".tif", ".hdr")]
    assert {p.resolve() for p in files} == {p.resolve() for p in there}


def test_the_filter_wheel_has_seven_bands_of_seven_exposures_and_darks_of_its_session(
    tmp_path, real_data
):
    (capture,) = example("filterwheel-disks", tmp_path, {"data": real_data})
    assert counts(capture) == (7, 49, 14, 0)
    (sensor,) = capture.sensors
    assert sensor.pattern == (("G", "B"), ("R", "G"))
    times = [0.025, 0.05, 0.1, 0.25, 0.5, 2.0, 3.916]
    for band in capture.bands:
        assert [f.exposure_s for f in sensor.object if f.band == band.label] == times
    assert sorted({f.exposure_s for f in sensor.dark}) == times
    assert not [f for f in sensor.dark if f.path.name.startswith("d2_")]


def test_the_silios_board_has_nine_channels_and_the_kinect_three(tmp_path, real_data):
    silios, kinect = example("silios-kinect", tmp_path, {"data": real_data})
    assert counts(silios) == (9, 1, 1, 1) and counts(kinect) == (3, 1, 0, 0)


def test_the_rededge_panel_has_five_sensors_whose_files_say_their_wavelengths(tmp_path, real_data):
    (capture,) = example("rededge", tmp_path, {"data": real_data})
    assert counts(capture) == (5, 5, 0, 0)
    assert [b.wavelength for b in capture.bands] == [475.0, 560.0, 668.0, 840.0, 717.0]


def test_the_line_scan_has_580_bands_by_its_header(tmp_path, real_data):
    (capture,) = example("envi-linescan", tmp_path, {"data": real_data})
    assert counts(capture) == (580, 1, 1, 1)
    assert (capture.bands[0].label, capture.bands[-1].wavelength) == ("367 nm", 1048.421)


def test_a_manifest_tells_the_exposures_that_names_do_not(tmp_path):
    from levkas.campaign.discovery.file_index import read_exposures

    for name in ("dark", "white", "icon1"):
        (tmp_path / "raw").mkdir(exist_ok=True)
        tifffile.imwrite(tmp_path / f"raw/{name}.tif", np.zeros((4, 6), np.uint16))
    (tmp_path / "times.csv").write_text("file,exposure_s\nraw/icon1.tif,0.25\nwhite.tif,0.125\n")
    (tmp_path / "campaign.toml").write_text(
        '[campaign]\nreference = { camera = "mono" }\n'
        '[cameras.mono]\nkind = "sensors"\nmanifest = "times.csv"\n'
        '[[cameras.mono.sensors]]\nname = "a"\nfiles = "raw/{target}.tif"\n'
        '[targets]\ndark = "dark"\nwhite = { names = "white", reflectance = 0.98 }\n'
    )
    (capture,), refusals = find_captures(load_campaign(tmp_path))
    (sensor,) = capture.sensors
    assert not refusals
    assert [f.exposure_s for f in (*sensor.object, *sensor.white, *sensor.dark)] == [
        0.25,
        0.125,
        None,
    ]
    (tmp_path / "times.csv").write_text("file,exposure_s\nraw/icon1.tif,long\n")
    with pytest.raises(Refused, match="line 2 of the manifest"):
        read_exposures(tmp_path / "times.csv")


@pytest.mark.parametrize(
    ("file", "expected"),
    [
        ("photo/Icon2.tif", "photo/icon2.tif"),
        ("Photo/icon2.tif", "photo/icon2.tif"),
        ("photo/icon2_Visible.tif", "photo/icon2_visible.tif"),
    ],
)
@pytest.mark.parametrize("objects", ['objects = ["icon1", "icon2"]', ""])
def test_a_file_in_other_upper_and_lower_case_is_refused_with_both_spellings(
    tmp_path, file, expected, objects
):
    suffix = "_visible" if "isible" in file else ""
    touch(tmp_path, "uv/icon1.tif", "uv/icon2.tif", f"photo/icon1{suffix}.tif", file)
    photo = PHOTO.replace("{target}", f"{{target}}{suffix}")
    keys = photo + '[cameras.uv]\nkind = "image"\nfiles = "uv/{target}.tif"\n'
    captures, refusals = find_captures(campaign(tmp_path, keys, objects, reference="uv"))
    named = [c.object for c in captures if c.camera == "photo"]
    if objects or file[-9:] != "Icon2.tif":
        assert named == ["icon1"]
        (problem,) = refusals["icon2", "photo", ""].problems
        assert (problem.found, problem.expected) == (file, expected)
    else:  # an object of its own, which has no reference image
        assert list(refusals) == [("Icon2", "uv", "")]


def test_an_object_that_is_only_there_in_another_case_is_refused(tmp_path):
    touch(tmp_path, "photo/icon1.tif", "Photo/icon2.tif")
    captures, refusals = find_captures(campaign(tmp_path, PHOTO, "", reference="photo"))
    assert [c.object for c in captures] == ["icon1"]
    assert refusals["icon2", "photo", ""].problems[0].found == "Photo/icon2.tif"


def test_files_beside_the_frames_in_another_case_are_no_fault_of_a_capture_that_is_whole(tmp_path):
    touch(tmp_path, "photo/icon1.tif", "Photo/icon1.tif", "photo/Icon3.tif")
    captures, refusals = find_captures(
        campaign(tmp_path, PHOTO, 'objects = ["icon1"]', reference="photo")
    )
    assert ([c.object for c in captures], refusals) == (["icon1"], {})


# --- what files state of their bands -------------------------------------------------------------


def labelled(folder, labels):
    """Write a TIFF whose pages ImageJ has labelled."""
    path = folder / "raw/icon1.tif"
    path.parent.mkdir(parents=True, exist_ok=True)
    pages = np.zeros((len(labels), 4, 6), np.uint16)
    tifffile.imwrite(path, pages, imagej=True, metadata={"Labels": labels})


PAGES = CUBE.replace(".hdr", ".tif")
PAGED = VIS.replace("/{wavelength}nm*", "*")


@pytest.mark.parametrize("keys", [PAGES, PAGED], ids=["cube", "bands"])
def test_wavelengths_of_pages_are_their_own(tmp_path, keys):
    labelled(tmp_path, ["650 nm", "550 nm", "450 nm"])
    (capture,) = found_in(tmp_path, keys, "")
    assert [(b.label, b.wavelength) for b in capture.bands] == [
        ("650 nm", 650.0),
        ("550 nm", 550.0),
        ("450 nm", 450.0),
    ]


@pytest.mark.parametrize("keys", [PAGES, PAGED], ids=["cube", "bands"])
@pytest.mark.parametrize(
    "declared", ["wavelengths = [450, 550, 650]", 'bands = ["450 nm", "550", "650nm"]']
)
def test_bands_declared_in_another_order_than_the_pages_are_refused(tmp_path, keys, declared):
    labelled(tmp_path, ["650 nm", "550 nm", "450 nm"])
    problem = problem_of(tmp_path, f"{keys}{declared}\n", "")
    assert problem.code == "E_VALUE" and "650 nm" in problem.found and "450 nm" in problem.expected


def test_names_declared_in_another_order_than_the_pages_are_refused(tmp_path):
    labelled(tmp_path, ["IR", "R", "UV"])
    problem = problem_of(tmp_path, PAGES + 'bands = ["UV", "R", "IR"]\n', "")
    assert (problem.found, problem.expected) == ("IR, R, UV", "UV, R, IR")
    found_in(tmp_path, PAGES + 'bands = ["ir", "R", "uv"]\n', "")
    found_in(tmp_path, PAGES + 'bands = ["long", "middle", "short"]\n', "")
    found_in(tmp_path, PAGES + 'bands = ["UV", "R", "IR"]\noverrule = ["bands"]\n', "")


def test_wavelengths_that_cannot_be_are_refused_unless_others_are_declared(tmp_path):
    envi(tmp_path, "raw/icon1", (0.01, 0.02, 0.03))
    problem = problem_of(tmp_path, CUBE, "")
    assert "0.01 to 0.03" in problem.found and "wavelengths" in problem.fix
    (capture,) = found_in(tmp_path, CUBE + "wavelengths = [400, 500, 600]\n", "")
    assert capture.bands[0].wavelength == 400


@pytest.mark.parametrize(
    ("pattern", "names", "centres"),
    [
        ("{wavelength}um.tif", ["0.450um.tif", "1.05um.tif"], [450, 1050]),
        ("{wavelength}nm.tif", ["450nm.tif", "1050nm.tif"], [450, 1050]),
        ("{wavelength}.tif", ["450.tif", "1050.tif"], [450, 1050]),
        ("w{wavelength}.tif", ["w0.45.tif", "w1.05.tif"], [450, 1050]),
    ],
)
def test_a_wavelength_in_a_name_is_in_the_unit_behind_it(tmp_path, pattern, names, centres):
    touch(tmp_path, *(f"raw/icon1/{name}" for name in names))
    (capture,) = found_in(tmp_path, VIS.replace("{wavelength}nm*.tif", pattern), "")
    assert [band.wavelength for band in capture.bands] == centres


@pytest.mark.parametrize(
    ("pattern", "name"),
    [
        ("{wavelength}um.tif", "450um"),
        ("{wavelength}nm.tif", "0.45nm"),
        ("F{wavelength}.tif", "F3"),
    ],
)
def test_a_number_that_is_no_wavelength_in_its_unit_is_refused(tmp_path, pattern, name):
    touch(tmp_path, f"raw/icon1/{name}.tif")
    problem = problem_of(tmp_path, VIS.replace("{wavelength}nm*.tif", pattern), "")
    assert problem.code == "E_VALUE" and name in problem.file and "{band}" in problem.fix


def test_pages_of_colours_are_no_bands(tmp_path):
    path = tmp_path / "raw/icon1.tif"
    path.parent.mkdir()
    tifffile.imwrite(path, np.zeros((2, 4, 6, 3), np.uint8), photometric="rgb")
    problem = problem_of(tmp_path, PAGES, "")
    assert problem.code == "E_BAND_COUNT" and "2 pages of 3 samples" in problem.found
