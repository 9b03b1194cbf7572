"""Captures of a campaign by the files that are there: a row each, and what needs more than a row."""

from itertools import product
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


def envi(path, wavelengths=(400, 500, 600)):
    path.parent.mkdir(parents=True, exist_ok=True)
    np.zeros((4, len(wavelengths), 6), "<u2").tofile(path.with_suffix(".raw"))
    path.write_text(
        f"ENVI\nsamples = 6\nlines = 4\nbands = {len(wavelengths)}\ndata type = 12\ninterleave = bil\n"
        f"wavelength = {{{', '.join(map(str, wavelengths))}}}\n"
    )


def lay(folder, lines):
    """Write the files of a listing: ``raw/{dark,white}/{450,550}nm.tif``; ``| pages=3`` or ``| samples=3`` behind it."""
    for line in filter(None, map(str.strip, lines.splitlines())):
        names, _, options = line.partition(" | ")
        keys = {key: int(n) for key, _, n in (o.partition("=") for o in options.split()) if key}
        parts = [
            part.split(",") for part in names.replace("{", "\0").replace("}", "\0").split("\0")
        ]
        for one in product(
            *([",".join(part)] if not i % 2 else part for i, part in enumerate(parts))
        ):
            path = folder / "".join(one)
            envi(path) if path.suffix == ".hdr" else touch(folder, "".join(one), **keys)


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
CUBE = '[cameras.vis]\nkind = "cube"\nfiles = "raw/{target}*.hdr"\n'
MOSAIC = '[cameras.vis]\nkind = "mosaic"\nfiles = "raw/{target}/*.tif"\n'
NAMED = '[cameras.vis]\nkind = "bands"\nfiles = "raw/{target}/{band}.tif"\n'
PAGED = '[cameras.vis]\nkind = "bands"\nfiles = "raw/{target}.tif"\n'
EXPOSED = VIS.replace("{wavelength}nm*", "{wavelength}nm_{exposure}ms")
SOFT = '[setups.soft.cameras.vis]\nfiles = "soft/{target}/{wavelength}nm.tif"\n'
CCDS = '[cameras.vis]\nkind = "sensors"\nfiles = "raw/{target}/{sensor}_{shot}.tif"\n' + "".join(
    f'[[cameras.vis.sensors]]\nname = "ccd{n}"\npattern = "GBRG"\nbands = ["R{n}", "G{n}", "B{n}"]\n'
    for n in (1, 2)
)
CCDS += '[[cameras.vis.sensors]]\nname = "ccd3"\nbands = ["IR"]\nalign = [[1, 0, 2], [0, 1, 3]]\n'
UNNAMED = CCDS.replace('bands = ["R1", "G1", "B1"]\n', "").replace(
    'bands = ["R2", "G2", "B2"]\n', ""
)
BOTH = 'dark = "dark"\nwhite = "white"\n'
WHOLE = "raw/{dark,white,icon1}/{450,550}nm.tif"
THREE = "raw/{dark,white,icon1}/ccd{1,2,3}_{0,1}.tif"
TWO = ("450 nm", "550 nm")

ROWS = {
    "a band a file": (WHOLE, VIS, BOTH, {"icon1/vis": (*TWO, 2, 2, 2)}),
    "a band too many": (WHOLE, VIS + "wavelengths = [450]\n", BOTH, {"icon1/vis": "E_BAND_COUNT"}),
    "an object lacks a band of the others": (
        f"{WHOLE}\nraw/icon2/450nm.tif", VIS, BOTH, {"icon1/vis": (*TWO, 2, 2, 2), "icon2/vis": "E_BAND_MISSING"},
    ),
    "a band of the white alone": (
        "raw/{dark,white}/{450,550}nm.tif\nraw/icon1/450nm.tif", VIS, BOTH, {"icon1/vis": "E_BAND_MISSING"},
    ),
    "names of bands": ("raw/icon1/{red,blue}.tif", NAMED, "", {"icon1/vis": ("blue", "red", 2, 0, 0)}),
    "names in the declared order": (
        "raw/icon1/{red,blue}.tif", NAMED + 'bands = ["red", "blue"]\nwavelengths = [650, 450]\n', "",
        {"icon1/vis": ("red", "blue", 2, 0, 0)},
    ),
    "two files for a band": (f"{WHOLE}\nraw/icon1/550nm_again.tif", VIS, BOTH, {"icon1/vis": "E_BAND_TWICE"}),
    "two shots of a band": (
        f"{WHOLE}\nraw/icon1/550nm_again.tif", VIS.replace("nm*", "nm{shot}"), BOTH, {"icon1/vis": (*TWO, 3, 2, 2)},
    ),
    "a dark of all bands, and a white of other bands": (
        "raw/icon1/{450,550}nm.tif\nraw/white/{450,550,650}nm.tif\nraw/dark/{1,2}.tif",
        VIS.replace('"raw/{target}/{wavelength}nm*.tif"', '["raw/{target}/{wavelength}nm.tif", "raw/{target}/{shot}.tif"]')
        + "wavelengths = [450, 550]\n", BOTH, {"icon1/vis": (*TWO, 2, 2, 2)},
    ),
    "a band without its white": (
        "raw/{dark,icon1}/{450,550}nm.tif\nraw/white/450nm.tif", VIS, BOTH, {"icon1/vis": "E_TEMPLATE_MISSING"},
    ),
    "several exposures": (
        "raw/{dark,white,icon1}/550nm_10ms.tif\nraw/icon1/550nm_40ms.tif", EXPOSED, BOTH, {"icon1/vis": "E_EXPOSURES"},
    ),
    "exposures to merge": (
        "raw/{dark,white,icon1}/550nm_10ms.tif\nraw/icon1/550nm_40ms.tif", EXPOSED + 'exposures = "merge"\n', BOTH,
        {"icon1/vis": ("550 nm", 2, 1, 1)},
    ),
    "pages are bands, a dark serves all": (
        "raw/{white,icon1}.tif | pages=3\nraw/dark.tif", PAGED + "wavelengths = [450, 550, 650]\n", BOTH,
        {"icon1/vis": (*TWO, "650 nm", 3, 1, 3)},
    ),
    "fewer bands than pages": (
        "raw/icon1.tif | pages=3", PAGED + "wavelengths = [450, 550]\n", "", {"icon1/vis": "E_BAND_COUNT"},
    ),
    "a mosaic that nothing states": ("raw/icon1/{1,2}.tif", MOSAIC, "", {"icon1/vis": "E_VALUE"}),
    "shots of a mosaic": (
        "raw/{dark,white,icon1}/{1,2}.tif", MOSAIC + 'pattern = "BGGR"\n', BOTH, {"icon1/vis": ("R", "G", "B", 2, 2, 2)},
    ),
    "channels of several sensors": (
        THREE, CCDS, BOTH, {"icon1/vis": ("R1", "G1", "B1", "R2", "G2", "B2", "IR", 6, 6, 6)},
    ),
    "sensors with the same channels": (THREE, UNNAMED, BOTH, {"icon1/vis": "E_BAND_TWICE"}),
    "a cube's header has its bands": (
        "raw/{dark,white,icon1_10,icon1_9}.hdr", CUBE, BOTH + 'objects = ["icon1"]',
        {"icon1/vis": ("400 nm", "500 nm", "600 nm", 2, 1, 1)},
    ),
    "wavelengths near the header's": (
        "raw/icon1.hdr", CUBE + "wavelengths = [401, 501, 601]\n", "", {"icon1/vis": ("401 nm", "501 nm", "601 nm", 1, 0, 0)},
    ),
    "a wavelength that is not the header's": (
        "raw/icon1.hdr", CUBE + "wavelengths = [400, 500, 900]\n", "", {"icon1/vis": "E_VALUE"},
    ),
    "pages of a cube": (
        "raw/icon1.tif | pages=3", CUBE.replace(".hdr", ".tif") + "wavelengths = [401, 402, 403]\n", "",
        {"icon1/vis": ("401 nm", "402 nm", "403 nm", 1, 0, 0)},
    ),
    "pages of colours": ("raw/icon1.tif | pages=2 samples=3", CUBE.replace(".hdr", ".tif"), "", {"icon1/vis": "E_BAND_COUNT"}),
    "images need no templates": (
        f"{WHOLE}\nphoto/{{icon1,dark}}.tif | samples=3\nxray/icon1.tif", VIS + PHOTO + PHOTO.replace("photo", "xray"), BOTH,
        {"icon1/vis": (*TWO, 2, 2, 2), "icon1/photo": ("R", "G", "B", 1, 0, 0), "icon1/xray": ("grey", 1, 0, 0)},
    ),
    "a declared dark that is not there": (
        "raw/{white,icon1}/{450,550}nm.tif", VIS, BOTH, {"icon1/vis": "E_TEMPLATE_MISSING"},
    ),
    "no dark, as declared": ("raw/{white,icon1}/{450,550}nm.tif", VIS + "dark = []\n", BOTH, {"icon1/vis": (*TWO, 2, 0, 2)}),
    "templates of the camera's own names": (
        "raw/{icon1,cap_on}/{450,550}nm.tif", VIS + 'dark = "cap_on"\nwhite = []\n', BOTH, {"icon1/vis": (*TWO, 2, 2, 0)},
    ),
    "a setup has its white and the camera's dark": (
        f"{WHOLE}\nsoft/{{white,icon1}}/{{450,550}}nm.tif", VIS + SOFT, BOTH,
        {"icon1/vis": (*TWO, 2, 2, 2), "icon1/vis@soft": (*TWO, 2, 2, 2)},
    ),
    "a setup without a white of its own": (
        f"{WHOLE}\nsoft/icon1/{{450,550}}nm.tif", VIS + SOFT, BOTH,
        {"icon1/vis": (*TWO, 2, 2, 2), "icon1/vis@soft": "E_TEMPLATE_MISSING"},
    ),
    "setups in the pattern": (
        "raw/{plain,soft}/{dark,white,icon1}/{450,550}nm.tif",
        VIS.replace("raw/", "raw/{setup}/") + "[setups.soft.cameras.vis]\n", BOTH,
        {"icon1/vis": (*TWO, 2, 2, 2), "icon1/vis@soft": (*TWO, 2, 2, 2)},
    ),
    "two setups of which none is the default": (
        "raw/{plain,soft}/{dark,white,icon1}/{450,550}nm.tif", VIS.replace("raw/", "raw/{setup}/"), BOTH, {"icon1/vis": "E_VALUE"},
    ),
    "no reference image": (
        f"{WHOLE}\nphoto/{{icon1,icon2}}.tif", VIS + PHOTO, BOTH,
        {"icon1/vis": (*TWO, 2, 2, 2), "icon1/photo": ("grey", 1, 0, 0), "icon2/vis": "E_NO_FRAMES",
         "icon2/photo": ("grey", 1, 0, 0)},
    ),
    "a camera that saw one object promised no other": (
        "raw/{dark,white,icon1,icon2}/{450,550}nm.tif\nphoto/icon1.tif", VIS + PHOTO, BOTH,
        {"icon1/vis": (*TWO, 2, 2, 2), "icon1/photo": ("grey", 1, 0, 0), "icon2/vis": (*TWO, 2, 2, 2)},
    ),
    "a camera that saw nothing": (
        WHOLE, VIS + PHOTO, BOTH + 'objects = ["icon1"]', {"icon1/vis": (*TWO, 2, 2, 2), "icon1/photo": "E_NO_FRAMES"},
    ),
    "facts promise an object": (
        WHOLE, VIS + '[objects.icon7]\ntitle = "Lost"\n', BOTH, {"icon1/vis": (*TWO, 2, 2, 2), "icon7/vis": "E_NO_FRAMES"},
    ),
    "charts are no objects": (
        "raw/{dark,white,icon1,macbeth}/{450,550}nm.tif", VIS, BOTH + 'charts = { macbeth = "ColorChecker24" }',
        {"icon1/vis": (*TWO, 2, 2, 2)},
    ),
    "an earlier database is no raw data": (
        f"{WHOLE}\ndatabase/icon9/450nm.tif\ndatabase.kept/icon8/450nm.tif", VIS.replace("raw/{target}", "**/{target}"), BOTH,
        {"icon1/vis": (*TWO, 2, 2, 2)},
    ),
    **{
        f"wavelengths in {unit or 'what is plausible'}": (
            f"raw/icon1/{names}.tif", VIS.replace("{wavelength}nm*", f"{before}{{wavelength}}{unit}"), "",
            {"icon1/vis": ("450 nm", "1050 nm", 2, 0, 0)},
        )
        for before, unit, names in (("", "um", "{0.450,1.05}um"), ("", "nm", "{450,1050}nm"), ("w", "", "w{0.45,1.05}"))
    },
    **{
        f"no wavelength: {name}": (
            f"raw/icon1/{name}.tif", VIS.replace("{wavelength}nm*", pattern), "", {"icon1/vis": "E_VALUE"},
        )
        for pattern, name in (("{wavelength}um", "450um"), ("{wavelength}nm", "0.45nm"), ("F{wavelength}", "F3"))
    },
}  # fmt: skip


@pytest.mark.parametrize("name", ROWS)
def test_captures_and_refusals_follow_from_the_files(tmp_path, name):
    lines, cameras, targets, expected = ROWS[name]
    lay(tmp_path, lines)
    captures, refusals = find_captures(campaign(tmp_path, cameras, targets))
    found = {
        f"{c.object}/{c.layer}": (*(b.label for b in c.bands), *counts(c)[1:]) for c in captures
    }
    for (target, camera, setup), refused in refusals.items():
        assert all(p.file and p.field and p.fix for p in refused.problems)
        found[f"{target}/{camera}{'@' * bool(setup)}{setup}"] = refused.problems[0].code
    assert found == expected


def test_a_missing_band_is_named_as_the_folder_lacks_it(tmp_path):
    lay(tmp_path, f"raw/{{dark,white,icon1}}/{{{','.join(map(str, range(400, 730, 10)))}}}nm.tif")
    for lost in (470, 480):
        (tmp_path / f"raw/icon1/{lost}nm.tif").unlink()
    problem = problem_of(tmp_path, VIS + "wavelengths = { start = 400, stop = 720, step = 10 }\n")
    assert problem.code == "E_BAND_MISSING" and (problem.found, problem.expected) == (31, 33)
    assert "470, 480 nm" in problem.message


def test_what_belongs_together_stands_together(tmp_path):
    """Frames have the labels of their bands, sensors their own frames, strips their natural order, tiles their names."""
    lay(
        tmp_path,
        f"{WHOLE}\nraw/icon1_{{10,9}}.hdr\nraw/{{dark,white}}.hdr\nphoto/icon1.tif | samples=3",
    )
    (capture,) = found_in(tmp_path, VIS)
    for frames in (capture.sensors[0].object, capture.sensors[0].dark, capture.sensors[0].white):
        assert [(f.band, f.path.name) for f in frames] == [
            ("450 nm", "450nm.tif"),
            ("550 nm", "550nm.tif"),
        ]
    targets = BOTH + 'objects = ["icon1"]'
    (scan,) = found_in(tmp_path, CUBE, targets)
    assert [f.path.stem for f in scan.sensors[0].object] == ["icon1_9", "icon1_10"]
    passes = CUBE.replace(
        '"raw/{target}*.hdr"', '["raw/{target}_{column}.hdr", "raw/{target}.hdr"]'
    )
    captures = found_in(tmp_path, passes + PHOTO, targets, reference="photo")
    tiles = next(c for c in captures if c.camera == "vis").tiles
    assert [part.tile for part in tiles] == ["c9", "c10"]
    assert all(part.sensors[0].white and part.sensors[0].dark for part in tiles)
    with pytest.raises(Refused) as refused:  # passes of the reference are strips
        campaign(tmp_path, passes)
    assert [p.field for p in refused.value.problems] == ["cameras.vis.files"]
    lay(tmp_path, THREE)
    (capture,) = found_in(tmp_path, CCDS)
    assert capture.sensors[0].pattern == (("G1", "B1"), ("R1", "G1"))
    assert {f.sensor for s in capture.sensors[1:2] for f in (*s.object, *s.dark)} == {"ccd2"}
    assert capture.sensors[2].align == ((1, 0, 2), (0, 1, 3))


def test_every_sensor_that_lacks_something_is_named(tmp_path):
    lay(tmp_path, THREE)
    for lost in (*tmp_path.glob("raw/icon1/ccd1*"), *tmp_path.glob("raw/white/ccd3*")):
        lost.unlink()
    _, refusals = find_captures(campaign(tmp_path, CCDS))
    reported = refusals["icon1", "vis", ""].problems
    assert [p.code for p in reported] == ["E_BAND_MISSING", "E_TEMPLATE_MISSING"]
    assert "ccd1" in reported[0].message and "ccd3" in reported[1].message


def test_a_campaign_without_any_object_says_what_there_is(tmp_path):
    lay(tmp_path, "raw/{dark,white}/450nm.tif")
    with pytest.raises(Refused) as refused:
        find_captures(campaign(tmp_path, VIS))
    (problem,) = refused.value.problems
    assert problem.code == "E_NO_FRAMES" and "dark, white" in problem.found


def test_a_reference_band_that_is_not_there_is_refused(tmp_path):
    lay(tmp_path, WHOLE)
    problem = problem_of(tmp_path, VIS, reference='vis", band = "551 nm')
    assert (problem.code, problem.field) == ("E_BAND_MISSING", "campaign.reference.band")
    assert (
        problem_of(tmp_path, VIS + 'reference_band = "G"\n').field == "cameras.vis.reference_band"
    )


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


def test_the_rededge_panel_has_five_sensors_whose_files_say_their_wavelengths(tmp_path, real_data):
    (capture,) = example("rededge", tmp_path, {"data": real_data})
    assert counts(capture) == (5, 5, 0, 0)
    assert [b.wavelength for b in capture.bands] == [475.0, 560.0, 668.0, 840.0, 717.0]


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
    with pytest.raises(Refused) as refused:
        read_exposures(tmp_path / "times.csv")
    assert refused.value.problems[0].field == "exposure_s"


@pytest.mark.parametrize(
    ("file", "expected"),
    [
        ("photo/Icon2.tif", "photo/icon2.tif"),
        ("Photo/icon2.tif", "photo/icon2.tif"),
        ("photo/icon2_Visible.tif", "photo/icon2_visible.tif"),
    ],
)
@pytest.mark.parametrize("objects", ['objects = ["icon1", "icon2"]'])
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


# --- what files state of their bands -------------------------------------------------------------


def labelled(folder, labels):
    """Write a TIFF whose pages ImageJ has labelled."""
    path = folder / "raw/icon1.tif"
    path.parent.mkdir(parents=True, exist_ok=True)
    pages = np.zeros((len(labels), 4, 6), np.uint16)
    tifffile.imwrite(path, pages, imagej=True, metadata={"Labels": labels})


PAGES = CUBE.replace(".hdr", ".tif")
PAGES_OF_BANDS = VIS.replace("/{wavelength}nm*", "*")


@pytest.mark.parametrize("keys", [PAGES, PAGES_OF_BANDS], ids=["cube", "bands"])
def test_wavelengths_of_pages_are_their_own(tmp_path, keys):
    labelled(tmp_path, ["650 nm", "550 nm", "450 nm"])
    (capture,) = found_in(tmp_path, keys, "")
    assert [(b.label, b.wavelength) for b in capture.bands] == [
        ("650 nm", 650.0),
        ("550 nm", 550.0),
        ("450 nm", 450.0),
    ]


@pytest.mark.parametrize("keys", [PAGES, PAGES_OF_BANDS], ids=["cube", "bands"])
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
    envi(tmp_path / "raw/icon1.hdr", (0.01, 0.02, 0.03))
    problem = problem_of(tmp_path, CUBE, "")
    assert "0.01 to 0.03" in problem.found and "wavelengths" in problem.fix
    (capture,) = found_in(tmp_path, CUBE + "wavelengths = [400, 500, 600]\n", "")
    assert capture.bands[0].wavelength == 400
