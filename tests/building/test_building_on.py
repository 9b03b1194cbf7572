"""For every change of a campaign, building on ends in the bytes of building anew."""

import difflib
import json
import os
import shutil

import numpy as np
import pytest
import tifffile
from typer.testing import CliRunner

from levkas.building import build, status, summarise
from levkas.cli import app
from levkas.core.digests import hash_tree
from levkas.database.catalogue import read_catalogue
from levkas.database.validation import validate


@pytest.fixture(scope="module")
def built(tmp_path_factory, make_every_kind):
    folder = make_every_kind(
        tmp_path_factory.mktemp("every") / "campaign", cameras=("photo", "filters", "colour")
    )
    report = summarise(build(folder))
    assert report.ok, report.text
    return folder


@pytest.fixture
def campaign(built, tmp_path):
    return shutil.copytree(built, tmp_path / "campaign")


def says(old, new):
    """Change campaign.toml."""

    def change(folder):
        path = folder / "campaign.toml"
        assert old in path.read_text(), old
        path.write_text(path.read_text().replace(old, new))

    return change


def adds(text):
    return lambda folder: (folder / "campaign.toml").open("a").write(text)


def replaces(name, old, new):
    """Change a table beside it."""

    def change(folder):
        text = (folder / name).read_text()
        assert old in text
        (folder / name).write_text(text.replace(old, new))

    return change


def renames(old, new):
    return lambda folder: (folder / old).rename(folder / new)


def lightens(name):
    """Change the pixels of a frame."""

    def change(folder):
        path = folder / name
        tifffile.imwrite(path, tifffile.imread(path) + np.uint16(3))

    return change


def swaps(one, other):
    def change(folder):
        (folder / one).rename(folder / "kept aside")
        (folder / other).rename(folder / one)
        (folder / "kept aside").rename(folder / other)

    return change


def cuts(name):
    return lambda folder: (folder / name).write_bytes((folder / name).read_bytes()[:500])


COLOUR = (
    '[cameras.colour]\nkind = "mosaic"\nfiles = "colour/{target}.tif"\npattern = "RGGB"\n'
    'sensitivity = "colour.csv"\nbits = 12\nblack = 60\n'
)
SETUP = (
    '[setups.raking]\ntitle = "Raking light"\nspectrum = "lamp.csv"\n'
    'cameras = { filters = { files = "raking/{target}_{wavelength}nm.tif" } }\n'
)
NEAR, FAR = (
    f'[[cameras.twin.sensors]]\nname = "{name}"\nbands = ["{band}"]\n'
    for name, band in (("near", "N"), ("far", "F"))
)
#: Changes side by side where each shows in files that the others leave alone.
CHANGES = {
    "creator, rotation, publication, a setup's title, a sensitivity": [
        says('creator = "A. Maker"', 'creator = "B. Maker"'),
        adds("[grid]\nrotate = 90\n[publication]\ncreators = ['C. Maker']\n"),
        says('title = "Raking light"', 'title = "Light from the side"'),
        replaces("colour.csv", "500,0,1,0", "500,0,0.5,0"),
    ],
    "licence, mirror, an object's size": [
        says('licence = "CC0-1.0"', 'licence = "CC-BY-4.0"'),
        adds("[grid]\nmirror = true\n"),
        says("size_mm = [120, 100]", "size_mm = [240, 200]"),
    ],
    "an object's title, the published size": [
        says('title = "The first"', 'title = "The foremost"'),
        adds("[grid]\nsize = [120, 100]\n"),
    ],
    "date, region": [
        says("date = 2019-08-29", "date = 2019-08-30"),
        adds("[grid]\nregion = [10, 12, 200, 150]\nrotate = 0\n"),
    ],
    "the campaign's title, a band, bits, exposures, the lamp's spectrum": [
        says('title = "Every kind"', 'title = "All kinds"'),
        says('pattern = "RGGB"', 'pattern = "RGGB"\nreference_band = "R"'),
        says('manifest = "exposures.csv"\nbits = 12', 'manifest = "exposures.csv"\nbits = 13'),
        replaces("exposures.csv", "white_500nm.tif,0.1", "white_500nm.tif,0.2"),
        replaces("lamp.csv", "800,1.5", "800,1.4"),
    ],
    "black, sensitivity and spectrum taken away, the white's reflectance": [
        says('sensitivity = "colour.csv"\nbits = 12\nblack = 60', "bits = 12\nblack = 61"),
        says('spectrum = "lamp.csv"\n', ""),
        replaces("white.csv", "800,0.97", "800,0.9"),
    ],
    "pattern, the frames of a filter, no white under raking light": [
        says('pattern = "RGGB"', 'pattern = "BGGR"'),
        lightens("filters/one_600nm.tif"),
        says("black = 60\n[cameras.colour]", "black = 60\nwhite = []\ndark = []\n[cameras.colour]"),
    ],
    "a camera and an object removed": [
        says(COLOUR, ""),
        says('objects = ["one", "two"]', 'objects = ["one"]'),
    ],
    "a camera and an object renamed, a setup removed": [
        says("[cameras.colour]", "[cameras.hue]"),
        says(SETUP, ""),
        says('objects = ["one", "two"]', 'objects = ["one", "deux"]'),
        renames("photo/two.png", "photo/deux.png"),
    ],
    "whites swapped": [swaps("filters/white_500nm.tif", "filters/white_600nm.tif")],
    "cameras and objects in another order": [
        says(COLOUR, ""),
        says("[cameras.filters]", f"{COLOUR}[cameras.filters]"),
        says('objects = ["one", "two"]', 'objects = ["two", "one"]'),
    ],
    "another reference band": [says('band = "G"', 'band = "R"')],
}
QUICK = ("whites swapped",)
"""Those that the fast tests hold."""
OF_A_KIND = (
    *("licence, mirror, an object's size", "an object's title, the published size"),
    *("date, region", "another reference band", "a camera and an object removed"),
    "the campaign's title, a band, bits, exposures, the lamp's spectrum",
    "pattern, the frames of a filter, no white under raking light",
)
"""Those that differ from others only in the keys; test_staleness.py says of every key what it makes stale."""


def marks(what):
    kind = pytest.mark.exhaustive if what in OF_A_KIND else pytest.mark.slow
    return () if what in QUICK else kind


def differences(one, other):
    """Return the files of two databases that differ; of provenance what differs in it."""
    ours, theirs = hash_tree(one), hash_tree(other)
    names = sorted(n for n in {**ours, **theirs} if ours.get(n) != theirs.get(n))
    return [*names, *(line for name in names for line in lines_that_differ(one, other, name))]


def lines_that_differ(one, other, name):
    paths = [folder / name for folder in (one, other)]
    if not (name.endswith("provenance.json") and all(path.is_file() for path in paths)):
        return []
    texts = [path.read_text("utf-8").splitlines() for path in paths]
    return [line for line in difflib.unified_diff(*texts, n=0) if line[0] in "+-"][:12]


@pytest.mark.slow
@pytest.mark.parametrize("what", [pytest.param(one, marks=marks(one)) for one in CHANGES])
def test_building_on_ends_in_the_bytes_of_building_anew(campaign, what):
    for change in CHANGES[what]:
        change(campaign)
    stale = [step.label for step in status(campaign).stages if step.state != "fresh"]
    assert stale
    on = summarise(build(campaign))
    anew = summarise(build(campaign, output=campaign / "anew"))
    assert on.ok == anew.ok
    passing = ("removed", "describe")
    done = {s.label for s in on.stages if s.state == "done" and s.key.stage != "removed"}
    assert done <= {*stale}  # pages of cameras, too, whose measurements nobody knows yet
    assert differences(campaign / "database", campaign / "anew") == []
    left = status(campaign)
    assert left.ok == on.ok
    if on.ok:
        assert {step.state for step in left.stages} == {"fresh"}
        states = [s.label for s in on.stages if s.key.stage not in passing]
        assert sorted(s.label for s in left.stages) == sorted(states)


#: Everything that is written about pixels and changes none of them.
FACTS = (
    says('title = "Every kind"', 'title = "All kinds"'),
    says('creator = "A. Maker"', 'creator = "B. Maker"'),
    says("date = 2019-08-29", "date = 2019-08-30"),
    says('licence = "CC0-1.0"', 'licence = "CC-BY-4.0"'),
    says('title = "The first"', 'title = "The foremost"\nrights = "All"\nmedium = "oil"'),
    says("size_mm = [120, 100]", "size_mm = [60, 50]"),
    says('title = "Raking light"', 'title = "Light from the side"'),
    adds("[publication]\ncreators = ['C. Maker']\n"),
)
WHOLE = "outline = [[-0.5, -0.5], [239.5, -0.5], [239.5, 199.5], [-0.5, 199.5]]"


def test_facts_are_written_anew_and_no_pixel_is_computed(make_every_kind, tmp_path):
    folder = make_every_kind(tmp_path / "campaign", ("one",), ("photo", "colour"))
    says("size_mm", f"{WHOLE}\nsize_mm")(folder)
    adds("[database]\nnative = true\n")(folder)
    assert summarise(build(folder)).ok
    for change in FACTS:
        change(folder)
    described = {f"one/{name} describe" for name in ("photo", "colour")}
    stale = {step.label for step in status(folder).stages if step.state == "stale"}
    assert stale == {*described, "one report", "catalogue"}
    done = [step.label for step in build(folder) if step.state == "done"]
    assert sorted(done) == sorted(stale)
    list(build(folder, output=folder / "anew"))
    assert differences(folder / "database", folder / "anew") == []
    database = folder / "database"
    for path in (database / "objects/one").rglob("*.tif"):
        with tifffile.TiffFile(path) as tiff:
            tags = tiff.pages[0].tags
            assert (tags["Artist"].value, tags["Copyright"].value) == ("B. Maker", "All")
            native = path.parent.name == "native"
            assert native or tags["XResolution"].value[0] / tags["XResolution"].value[1] == 40.0
    assert {entry.px_per_mm for entry in read_catalogue(database)} == {4.0}
    assert validate(database).ok and all(s.state == "fresh" for s in status(folder).stages)


def test_a_damaged_layer_is_built_again_and_not_described(campaign):
    path = campaign / "database/objects/one/one_photo.tif"
    before, data, stat = hash_tree(campaign / "database"), bytearray(path.read_bytes()), path.stat()
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    for change in (FACTS[1], says('creator = "B. Maker"', 'creator = "A. Maker"')):
        change(campaign)
        assert summarise(build(campaign)).ok
    assert hash_tree(campaign / "database") == before


@pytest.mark.slow
def test_sensors_and_setups_in_another_order_end_in_the_bytes_of_building_anew(
    make_every_kind, tmp_path
):
    folder = make_every_kind(tmp_path / "campaign", ("one",), ("photo", "filters", "twin"))
    lower = SETUP.replace("[setups.raking]", "[setups.lower]").replace("Raking", "Lower")
    says(SETUP, SETUP + lower)(folder)
    assert summarise(build(folder)).ok
    sensors, setups = says(NEAR + FAR, FAR + NEAR), says(SETUP + lower, lower + SETUP)
    for changes in ((sensors, setups), (says(lower + SETUP, SETUP + lower),)):
        for change in changes:
            change(folder)
        assert not all(step.state == "fresh" for step in status(folder).stages)
        list(build(folder))
        list(build(folder, output=folder / "anew"))
        assert differences(folder / "database", folder / "anew") == []


@pytest.mark.slow
def test_a_camera_that_comes_back_is_built_again_to_the_same_bytes(campaign):
    before = hash_tree(campaign / "database")
    text = (campaign / "campaign.toml").read_text()
    says(COLOUR, "")(campaign)
    assert "1 layer and 1 camera are no longer in the campaign" in status(campaign).text
    report = summarise(build(campaign))
    assert "1 layer and 1 camera are no longer in the campaign" in report.text
    moved = hash_tree(campaign / "database.removed/1")
    gone = {
        name: sha for name, sha in before.items() if name not in hash_tree(campaign / "database")
    }
    assert moved == gone and "cameras/colour/camera.json" in moved
    (campaign / "campaign.toml").write_text(text)
    assert summarise(build(campaign)).ok
    assert hash_tree(campaign / "database") == before


def test_what_a_campaign_no_longer_has_is_kept_where_that_is_asked(campaign):
    before = hash_tree(campaign / "database")
    says('objects = ["one", "two"]', 'objects = ["one"]')(campaign)
    report = summarise(build(campaign, keep_removed=True))
    assert report.ok and "1 layer and 1 object are no longer in the campaign" in report.text
    assert hash_tree(campaign / "database") == before
    assert not (campaign / "database.removed").exists()
    assert summarise(build(campaign)).ok
    assert not list((campaign / "database").rglob("*two*"))


def test_a_build_of_one_object_moves_nothing_of_others(campaign):
    before = hash_tree(campaign / "database")
    says(COLOUR, "")(campaign)
    assert summarise(build(campaign, objects=["two"])).ok
    there = hash_tree(campaign / "database")
    assert before.keys() == there.keys()


def test_a_file_that_levkas_did_not_make_is_never_moved(campaign):
    foreign = campaign / "database/objects/two/notes.txt"
    foreign.write_text("by hand")
    says('objects = ["one", "two"]', 'objects = ["one"]')(campaign)
    assert summarise(build(campaign)).ok
    assert [p for p in (campaign / "database/objects/two").rglob("*") if p.is_file()] == [foreign]


def test_files_by_others_are_named_and_the_manifest_follows_them(campaign):
    assert "notes.txt" not in summarise(build(campaign)).text
    notes = campaign / "database/notes.txt"
    notes.write_text("what the owner asked for")
    assert "catalogue: stale" in status(campaign).text
    for _ in range(2):  # also where nothing is stale
        report = summarise(build(campaign))
        assert report.ok and "notes.txt in the database: Levkas has no record" in report.text
        assert "notes.txt in the database" in status(campaign).text
    assert validate(campaign / "database").ok
    notes.unlink()
    assert "notes.txt" not in summarise(build(campaign)).text
    assert validate(campaign / "database").ok


def _refused_default(folder):
    """The default lighting's picture becomes another painting's: its registration is refused."""
    rng = np.random.default_rng(8)
    for band in (500, 600):
        tifffile.imwrite(
            folder / f"filters/one_{band}nm.tif", rng.integers(80, 3000, (200, 240), np.uint16)
        )


@pytest.mark.slow
def test_status_of_a_second_setup_whose_default_one_is_refused(campaign):
    _refused_default(campaign)
    report = summarise(build(campaign))
    built = {step.label: step.state for step in report.stages}
    assert built.get("one/filters register") == "refused", report.text
    assert built["one/filters@raking resample"] == "fresh", report.text
    states = {step.label: step.state for step in status(campaign).stages}
    assert states["one/filters register"] == "refused"
    assert states["one/filters@raking resample"] == "fresh"


def test_status_and_build_count_the_same_stages_and_build_says_where(campaign):
    result = CliRunner().invoke(app, ["build", str(campaign), "--json"])
    built = json.loads(result.stdout)
    assert built["output"] == str(campaign / "database")
    looked = json.loads(CliRunner().invoke(app, ["status", str(campaign), "--json"]).stdout)
    assert sorted(map(str, looked["stages"])) == sorted(map(str, built["stages"]))


@pytest.mark.slow
def test_a_refusal_in_a_database_is_the_same_wherever_the_campaign_stands(campaign, tmp_path):
    for name in ("database", "database.kept"):
        shutil.rmtree(campaign / name)
    cuts("colour/one.tif")(campaign)
    says(
        '"filters/{target}_{wavelength}nm.tif"\nmanifest',
        '"{setup}/{target}_{wavelength}nm.tif"\nmanifest',
    )(campaign)
    renames("filters", "day")(campaign)
    shutil.copytree(campaign / "day", campaign / "noon")
    assert not summarise(build(campaign)).ok
    elsewhere = tmp_path / "elsewhere"
    for name in ("database", "database.kept"):
        (campaign / name).rename(tmp_path / name)
    shutil.copytree(campaign, elsewhere)
    for name in ("database", "database.kept"):
        (tmp_path / name).rename(campaign / name)
    build_anew = summarise(build(elsewhere))
    assert not build_anew.ok
    assert differences(campaign / "database", elsewhere / "database") == []
    page = (campaign / "database/objects/one/report.html").read_text()
    assert "colour/one.tif" in page and str(tmp_path) not in page


@pytest.mark.slow
def test_the_page_of_an_object_follows_what_a_refusal_found(campaign):
    says('kind = "bands"\nfiles = "filters/', 'kind = "bands"\nfiles = "{setup}/')(campaign)
    renames("filters", "day")(campaign)
    shutil.copytree(campaign / "day", campaign / "noon")
    assert not summarise(build(campaign)).ok
    states = {step.label: step.why for step in status(campaign).stages}
    assert states["one report"] == ""
    shutil.copytree(campaign / "day", campaign / "night")
    assert "one report: stale" in status(campaign).text
    assert not summarise(build(campaign)).ok
    assert "day, night, noon" in (campaign / "database/objects/one/report.html").read_text()


@pytest.mark.slow
def test_templates_that_no_calibration_is_made_with_any_more_are_removed(campaign):
    folder = campaign / "database.kept" / "templates"
    before = {path.name for path in folder.iterdir()}
    lightens("filters/dark_500nm.tif")(campaign)
    assert summarise(build(campaign)).ok
    after = {path.name for path in folder.iterdir()}
    assert len(after) == len(before) and after != before
    assert {step.state for step in build(campaign)} == {"fresh"}
    assert {path.name for path in folder.iterdir()} == after
