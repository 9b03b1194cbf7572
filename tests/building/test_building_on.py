"""Real campaigns: built on they end in the bytes of building anew, and where all is fresh nothing is done.

`test_staleness.py` says of every key what it makes stale, with stages that write a line.
"""

import difflib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tifffile
import toy
from typer.testing import CliRunner

from levkas.building import build, status, summarise
from levkas.cli import app
from levkas.core.digests import hash_tree
from levkas.core.problems import Refused
from levkas.database.catalogue import COLUMNS, read_catalogue
from levkas.database.pixel_frames import map_points
from levkas.database.validation import validate
from levkas.publish.run import check, publish

OUTLINE = "outline = [[-0.5, -0.5], [239.5, -0.5], [239.5, 199.5], [-0.5, 199.5]]"


@pytest.fixture(scope="module")
def built(tmp_path_factory, make_every_kind):
    folder = tmp_path_factory.mktemp("every") / "campaign"
    make_every_kind(folder, cameras=("photo", "filters", "colour"))
    says("size_mm", f"{OUTLINE}\nsize_mm")(folder)
    adds("[database]\nnative = true\n")(folder)
    report = summarise(build(folder))
    assert report.ok, report.text
    return folder


@pytest.fixture
def campaign(built, tmp_path):
    return Path(shutil.copytree(built, tmp_path / "campaign"))


def says(old, new, file="campaign.toml"):
    """Change campaign.toml, or a table beside it."""

    def change(folder):
        text = (folder / file).read_text()
        assert old in text, old
        (folder / file).write_text(text.replace(old, new))

    return change


def adds(text):
    return lambda folder: (folder / "campaign.toml").open("a").write(text)


def lightens(name):
    """Change the pixels of a frame."""

    def change(folder):
        path = folder / name
        tifffile.imwrite(path, tifffile.imread(path) + np.uint16(3))

    return change


COLOUR = (
    '[cameras.colour]\nkind = "mosaic"\nfiles = "colour/{target}.tif"\npattern = "RGGB"\n'
    'sensitivity = "colour.csv"\nbits = 12\nblack = 60\n'
)
#: Changes side by side where each shows in files that the others leave alone.
CHANGES = {
    "turned, another sensitivity, lamp and title": [
        adds("[grid]\nrotate = 90\n[publication]\ncreators = ['C. Maker']\n"),
        says('title = "Raking light"', 'title = "Light from the side"'),
        says("800,1.5", "800,1.4", "lamp.csv"),
        says("500,0,1,0", "500,0,0.5,0", "colour.csv"),
    ],
    "a region, bits, exposures, a dark, the white's reflectance": [
        adds("[grid]\nregion = [10, 12, 200, 150]\n"),
        says('pattern = "RGGB"', 'pattern = "RGGB"\nreference_band = "R"'),
        says('manifest = "exposures.csv"\nbits = 12', 'manifest = "exposures.csv"\nbits = 13'),
        says("white_500nm.tif,0.1", "white_500nm.tif,0.2", "exposures.csv"),
        lightens("filters/dark_600nm.tif"),
        says("800,0.97", "800,0.9", "white.csv"),
    ],
    "cameras in another order, an object removed, another reference band": [
        says(COLOUR, ""),
        says("[cameras.filters]", f"{COLOUR}[cameras.filters]"),
        says('objects = ["one", "two"]', 'objects = ["one"]'),
        says('band = "G"', 'band = "R"'),
    ],
}


def differences(one, other):
    """Return the files of two databases that differ; of provenance what differs in it."""
    ours, theirs = hash_tree(one), hash_tree(other)
    names = sorted(n for n in {**ours, **theirs} if ours.get(n) != theirs.get(n))
    lines = []
    for name in (n for n in names if n.endswith("provenance.json")):
        texts = [(folder / name).read_text("utf-8").splitlines() for folder in (one, other)]
        lines += [line for line in difflib.unified_diff(*texts, n=0) if line[0] in "+-"][:12]
    return names + lines


@pytest.mark.slow
@pytest.mark.parametrize("what", CHANGES)
def test_building_on_ends_in_the_bytes_of_building_anew(campaign, what):
    for change in CHANGES[what]:
        change(campaign)
    stale = {step.label for step in status(campaign).stages if step.state != "fresh"}
    on = summarise(build(campaign))
    assert on.ok and summarise(build(campaign, output=campaign / "anew")).ok
    assert {s.label for s in on.stages if s.state == "done"} <= stale
    assert differences(campaign / "database", campaign / "anew") == []
    assert {step.state for step in status(campaign).stages} == {"fresh"}
    kept, anew = (campaign / f"{name}.kept/templates" for name in ("database", "anew"))
    if anew.is_dir():  # of several objects
        assert {path.name for path in kept.iterdir()} == {path.name for path in anew.iterdir()}


#: Everything that is written about pixels and changes none of them.
FACTS = (
    says('title = "Every kind"', 'title = "All kinds"'),
    says('creator = "A. Maker"', 'creator = "B. Maker"'),
    says('licence = "CC0-1.0"', 'licence = "CC-BY-4.0"'),
    says('title = "The first"', 'title = "The foremost"\nrights = "All"\nmedium = "oil"'),
    says("size_mm = [120, 100]", "size_mm = [60, 50]"),
)


@pytest.mark.slow
def test_facts_are_written_anew_and_no_pixel_is_computed(campaign):
    for change in FACTS:
        change(campaign)
    done = {step.key.stage for step in build(campaign) if step.state == "done"}
    assert done == {"describe", "report", "catalogue"}
    list(build(campaign, output=campaign / "anew"))
    database = campaign / "database"
    assert differences(database, campaign / "anew") == []
    for path in (database / "objects/one").rglob("*.tif"):
        with tifffile.TiffFile(path) as tiff:
            tags = tiff.pages[0].tags
            assert (tags["Artist"].value, tags["Copyright"].value) == ("B. Maker", "All")
            native = path.parent.name == "native"
            assert native or tags["XResolution"].value[0] / tags["XResolution"].value[1] == 40.0
    assert {e.px_per_mm for e in read_catalogue(database) if e.object == "one"} == {4.0}
    assert validate(database).ok and all(s.state == "fresh" for s in status(campaign).stages)


@pytest.mark.parametrize("region", ["[500, 500, 50, 50]", "[-100, -100, 20, 20]", "[0, 0, 1e9, 9]"])
def test_a_region_off_the_frame_is_refused(campaign, region):
    adds(f"[grid]\nregion = {region}\n")(campaign)
    (problem,) = {p for p in summarise(build(campaign)).problems if p.field == "grid.region"}
    assert problem.file == str(campaign / "campaign.toml")
    assert "240 x 200" in problem.expected


@pytest.mark.slow
def test_points_are_mapped_by_the_grid_that_was_built(campaign):
    points = np.array([[20.0, 30.0], [100.0, 100.0]])
    place = {"source": "grid", "target": "photo"}
    adds("[grid]\nregion = [10, 12, 200, 150]\n")(campaign)
    before = map_points(campaign / "database", "one", points, **place)  # nothing was built yet
    assert np.allclose(before, points, atol=1e-6)
    assert summarise(build(campaign)).ok
    after = map_points(campaign / "database", "one", points, **place)
    assert np.allclose(after, points + np.array([10, 12]), atol=1e-6)


def test_a_threshold_of_another_method_is_said_once_by_build_and_status(tmp_path, toys):
    folder = toy.make(tmp_path / "campaign", ("one",), ("photo", "xray"))
    plain = status(folder).warnings
    adds("[registration]\nstop = 0.8\n[cameras.xray.registration]\nreject = 40.0\n")(folder)
    found = [warning for warning in status(folder).warnings if warning not in plain]
    fields = ("cameras.xray.registration.reject", "registration.stop")
    assert [field in warning for field, warning in zip(fields, sorted(found), strict=True)] == [
        True
    ] * 2
    report = summarise(build(folder))
    assert report.ok and all(report.warnings.count(text) == 1 for text in found)


@pytest.mark.slow
def test_a_damaged_layer_is_built_again_and_not_described(campaign):
    path = campaign / "database/objects/one/one_colour.tif"
    before, data, stat = hash_tree(campaign / "database"), bytearray(path.read_bytes()), path.stat()
    data[len(data) // 2] ^= 1
    path.write_bytes(data)
    os.utime(path, ns=(stat.st_atime_ns, stat.st_mtime_ns))
    for change in (FACTS[1], says('creator = "B. Maker"', 'creator = "A. Maker"')):
        change(campaign)
        assert summarise(build(campaign)).ok
    assert hash_tree(campaign / "database") == before


def standing(output):
    """Inode, size and time of every file and folder of a database and of what is kept beside it."""
    roots = (output, output.with_name(output.name + ".kept"))
    paths = [path for root in roots for path in (root, *root.rglob("*"))]
    stats = [path.stat() for path in paths]
    return {p: (s.st_ino, s.st_size, s.st_mtime_ns) for p, s in zip(paths, stats, strict=True)}


SECOND = """
import json, sys
from levkas.building import build, status, summarise
report = summarise(build(sys.argv[1])) if sys.argv[2] == "build" else status(sys.argv[1])
assert report.ok and {step.state for step in report.stages} == {"fresh"}
heavy = ("cv2", "numba", "rawpy", "zarr", "scipy")
print(json.dumps([name for name in heavy if name in sys.modules]))
"""


@pytest.mark.parametrize("command", ["build", pytest.param("status", marks=pytest.mark.slow)])
def test_a_second_build_has_nothing_to_do_writes_nothing_and_loads_no_heavy_module(built, command):
    list(build(built))  # hashes of what was just written are recorded
    before = standing(built / "database")
    line = [sys.executable, "-c", SECOND, str(built), command]
    said = subprocess.run(line, check=True, capture_output=True, text=True)
    assert json.loads(said.stdout) == []
    assert standing(built / "database") == before


def test_status_and_build_count_the_same_stages_and_build_says_where(built):
    told = [CliRunner().invoke(app, [name, str(built), "--json"]) for name in ("build", "status")]
    made, looked = (json.loads(result.stdout) for result in told)
    assert made["output"] == str(built / "database")
    assert sorted(map(str, looked["stages"])) == sorted(map(str, made["stages"]))
    assert looked["layers"] == made["layers"]
    (photo,) = (row for row in made["layers"] if (row["object"], row["camera"]) == ("two", "photo"))
    (colour,) = (row for row in made["layers"] if row["camera"] == "colour")
    assert photo["verdict"] == "accept" and photo["held_out_px"] is None
    assert colour["held_out_px"] < 0.5 and 0 < colour["checked_share"] <= 1 and colour["reasons"]


def test_the_database_has_the_files_of_the_contract(built):
    folder = built / "database/objects/one"
    names = {p.relative_to(folder).as_posix() for p in folder.rglob("*") if p.is_file()}
    wanted = [f"one_{name}{ending}" for name in ("photo", "colour", "filters_raking")
              for ending in (".tif", ".flags.tif", ".png")]  # fmt: skip
    wanted += [
        "registration/colour.json",
        "registration/colour.matches.csv",
        "one_colour.sigma.tif",
    ]
    assert {*wanted, "report.html", "object.toml", "provenance.json"} <= names
    record = json.loads((folder / "registration/colour.json").read_text())
    parts = {"method", "reference", "target", "verdict", "model", "bands", "errors", "trace"}
    assert parts <= record.keys()
    header = (built / "database/catalogue.csv").read_text().splitlines()[0]
    assert header == ",".join(COLUMNS)


@pytest.mark.slow
def test_what_is_stale_or_of_an_earlier_build_is_not_published_in_silence(campaign):
    assert check(campaign).ok
    path = campaign / "colour/one.tif"
    path.write_bytes(path.read_bytes()[:300])
    for fields in ({None}, {"earlier"}):
        problems = check(campaign).problems
        with pytest.raises(Refused) as refused:
            list(publish(campaign, iiif=False))
        codes = {p.code for p in refused.value.problems}
        assert codes <= {p.code for p in problems}
        if "earlier" in fields:
            (problem,) = (p for p in refused.value.problems if p.field == "earlier")
            assert problem.code == "E_STALE"
        list(build(campaign))
    (row,) = (e for e in read_catalogue(campaign / "database") if e.earlier)
    assert row.camera == "colour"
    line = ["publish", str(campaign), "--no-iiif", "--without", "one/colour"]
    assert CliRunner().invoke(app, line).exit_code == 0
    assert validate(campaign / "database.published").ok
    left = {e.layer.name for e in read_catalogue(campaign / "database.published")}
    assert left == {"photo", "filters", "filters@raking"}
