"""Stages that are refused: the others go on, what an earlier build finished stays and is marked, and `status` says what a build will do.

*Only campaign.toml removes.* Stages here write a line of text (`toy`).
"""

import shutil

import pytest
import toy
from toy import ended, heal, spoil

from levkas.building import build, camera_reports, report_pages, run, status, summarise
from levkas.building.catalogue import AGAIN
from levkas.core.digests import hash_tree
from levkas.core.files import write_json
from levkas.core.problems import Refused
from levkas.database.catalogue import ESTIMATED, Entry, read_catalogue, write_catalogue
from levkas.database.layout import MADE_OF, LayerId

CAMERAS = ("photo", "filters", "colour", "scan")
LAYERS = {"photo", "filters", "filters@raking", "colour", "scan"}


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        toy.install(patch)
        folder = toy.make(tmp_path_factory.mktemp("every") / "campaign", cameras=CAMERAS)
        assert {step.state for step in ended(folder).values()} == {"done"}
    return folder


@pytest.fixture
def campaign(built, tmp_path, toys):
    return toy.copied(built, tmp_path / "campaign")


@pytest.fixture
def new(built, tmp_path, toys):
    """A campaign that was never built."""
    folder = toy.copied(built, tmp_path / "campaign")
    for name in ("database", "database.kept"):
        shutil.rmtree(folder / name)
    return folder


def states(steps, *wanted):
    return {s.label: s.state for s in steps if s.state in wanted}


def say(folder, old, new):
    path = folder / "campaign.toml"
    assert old in path.read_text()
    path.write_text(path.read_text().replace(old, new))


#: What raises in a stage of the colour camera → the code of the refusal, and whether it is recorded and reported.
RAISED = {
    "E_MATCHES": ("E_MATCHES", True, False),
    "ZeroDivisionError": ("E_INTERNAL", True, True),
    "RecursionError": ("E_INTERNAL", True, True),
    "MemoryError": ("E_MEMORY", False, False),
}


@pytest.mark.parametrize("what", RAISED)
@pytest.mark.parametrize("stage", ["calibrate", "register", "resample"])
def test_whatever_a_stage_raises_refuses_its_capture_alone(new, what, stage):
    code, recorded, reported = RAISED[what]
    spoil(new / "colour/one.tif", stage, what)
    steps = ended(new)
    assert states(steps.values(), "refused") == {f"one/colour {stage}": "refused"}
    (problem,) = steps[f"one/colour {stage}"].problems
    assert problem.code == code and str(new) in problem.file
    report = new / f"database.kept/one/colour/{stage}.error.txt"
    assert report.is_file() == reported
    assert not reported or (str(report) in problem.fix and "Traceback" in report.read_text())
    assert not [*(new / "database").rglob("one_colour.tif")]
    assert {
        e.layer.name for e in read_catalogue(new / "database") if e.object == "one"
    } == LAYERS - {"colour"}
    page = (new / "database/objects/one/report.html").read_text()
    assert code in page and str(new) not in page
    told = status(new)
    if recorded:
        assert states(told.stages, "refused", "stale") == {f"one/colour {stage}": "refused"}
        assert list(told.problems) == [problem]
        assert not states(ended(new).values(), "done")
    heal(new / "colour/one.tif")
    assert not states(ended(new).values(), "refused") and not [*new.rglob("*.error.txt")]
    assert {step.state for step in status(new).stages} == {"fresh"}


def unmount(folder):
    (folder / "filters").rename(folder / "away")


def lose_the_reference(folder):
    (folder / "photo/one.png").rename(folder / "away.png")


FAULTS = {
    "a frame cannot be read": (
        lambda folder: spoil(folder / "colour/one.tif", "calibrate", "E_TRUNCATED"), {"colour"}),
    "a folder is away": (unmount, {"filters", "filters@raking"}),
    "the reference is away": (lose_the_reference, LAYERS),
    "another painting": (
        lambda folder: spoil(folder / "filters/one_500nm.tif", "register", "E_MATCHES"), {"filters"}),
    "a layer that cannot be written": (
        lambda folder: spoil(folder / "scan/one.raw", "resample", "E_DISK_FULL"), {"scan"}),
}  # fmt: skip


def of_layers(folder, layers):
    """Return the hashes of the files of some layers of object one."""
    ids = [LayerId.parse("one", name) for name in layers]
    starts = tuple(f"{start}{end}" for one in ids for start, end in (
        (one.path, "."), (one.record, "."), (one.group, "/")))  # fmt: skip
    return {n: sha for n, sha in hash_tree(folder / "database").items() if n.startswith(starts)}


def earlier(folder):
    return {e.layer.name for e in read_catalogue(folder / "database") if e.earlier}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_layer_that_cannot_be_made_today_stays_and_is_marked(campaign, fault, tmp_path):
    what, layers = FAULTS[fault]
    before, whole = of_layers(campaign, layers), hash_tree(campaign / "database")
    away = shutil.copytree(campaign, tmp_path / "as it was")
    what(campaign)
    report = summarise(build(campaign))
    assert not report.ok and earlier(campaign) == layers
    assert of_layers(campaign, layers) == before
    assert not (campaign / "database.removed").exists()
    refused = {
        s.key.layer: s for s in report.stages if s.state == "refused" and s.key.object == "one"
    }
    assert {*refused} == layers and all(s.earlier for s in refused.values())
    page = (campaign / "database/objects/one/report.html").read_text()
    assert all(f'"{name}"' in page for name in layers)
    full = fault == "a layer that cannot be written"  # the next time may be another
    for again in (status(campaign), summarise(build(campaign))) if not full else ():
        assert {s.state for s in again.stages} == {"fresh", "refused"}
    for path in (p for p in away.rglob("*") if p.is_file() and "database" not in str(p)):
        (campaign / path.relative_to(away)).parent.mkdir(exist_ok=True)
        shutil.copy2(path, campaign / path.relative_to(away))
    mended = ended(campaign)
    assert not states(mended.values(), "refused") and not earlier(campaign)
    assert hash_tree(campaign / "database") == whole


def test_a_layer_stays_where_what_is_kept_was_deleted_and_goes_with_its_file(campaign):
    names = {e.layer for e in read_catalogue(campaign / "database")}
    shutil.rmtree(campaign / "database.kept")
    spoil(campaign / "colour/one.tif", "calibrate", "E_TRUNCATED")
    (campaign / "scan").rename(campaign / "away")
    assert not summarise(build(campaign)).ok
    assert {e.layer for e in read_catalogue(campaign / "database")} == names
    (campaign / "database/objects/one/one_scan.tif").unlink()
    summarise(build(campaign))
    assert {e.layer for e in read_catalogue(campaign / "database")} == names - {
        LayerId("one", "scan")
    }


def broken(*args, **options):
    raise TypeError("a page that cannot be drawn")


def test_a_page_or_the_catalogue_that_cannot_be_made_is_refused_and_the_rest_is_there(new):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(report_pages, "write_report", broken)
        patch.setattr(camera_reports, "write_camera_page", broken)
        patch.setattr(run, "write_catalogue_of", broken)
        steps = ended(new)
    pages = {
        "one report",
        "two report",
        "colour camera",
        "filters camera",
        "scan camera",
        "catalogue",
    }
    assert {*states(steps.values(), "refused")} == pages
    assert {steps[label].problems[0].code for label in pages} == {"E_INTERNAL"}
    assert (new / "database/objects/one/one_filters.tif").is_file()
    assert {*states(status(new).stages, "refused")} == pages - {"catalogue"}
    assert not states(ended(new).values(), "refused") and not [*new.rglob("*.error.txt")]


# --- what campaign.toml no longer names, and what no build made


def test_what_a_campaign_no_longer_has_is_moved_out_and_comes_back(campaign):
    database, whole = campaign / "database", hash_tree(campaign / "database")
    foreign = database / "objects/two/notes.txt"
    foreign.write_text("by hand")
    text = (campaign / "campaign.toml").read_text()
    say(campaign, '["one", "two"]', '["one"]')
    start = text.index("[cameras.colour]")
    colour = text[start : text.index("[cameras.", start + 5)]
    say(campaign, colour, "")
    assert states(status(campaign).stages, "stale").keys() >= {"removed", "catalogue"}
    assert ended(campaign, objects=["one"])["removed"].state == "done"  # of object one only
    assert (database / "objects/two/two_photo.tif").is_file()
    ended(campaign)
    moved = {
        **hash_tree(campaign / "database.removed/1"),
        **hash_tree(campaign / "database.removed/2"),
    }
    gone = {n for n in whole if n not in hash_tree(database)}
    assert moved.keys() == gone and "cameras/colour/camera.json" in gone
    assert [p for p in (database / "objects/two").rglob("*") if p.is_file()] == [foreign]
    foreign.unlink()
    (campaign / "campaign.toml").write_text(text)
    ended(campaign)
    assert hash_tree(database) == whole


def test_files_by_others_are_named_and_the_manifest_follows_them(campaign):
    notes, manifest = campaign / "database/notes.txt", campaign / "database/manifest-sha256.txt"
    notes.write_text("what the owner asked for")
    assert states(status(campaign).stages, "stale") == {"catalogue": "stale"}
    for _ in range(2):  # also where nothing is stale
        assert any("notes.txt" in warning for warning in summarise(build(campaign)).warnings)
        assert "notes.txt" in manifest.read_text()
    notes.unlink()
    assert not any("notes.txt" in warning for warning in summarise(build(campaign)).warnings)
    assert "notes.txt" not in manifest.read_text()


def test_a_layer_made_from_others_is_marked_with_its_source_and_goes_with_its_object(campaign):
    database = campaign / "database"
    entries = read_catalogue(database)
    for name in ("one", "two"):
        (source,) = (e for e in entries if e.layer == LayerId(name, "photo"))
        row = Entry(
            name, "guess", "", 2, 24, 20, float("nan"), "reflectance", "warn", "0" * 64, ESTIMATED
        )
        record = {"kind": ESTIMATED, "sources": {"photo": source.sha256}}
        write_json(database / f"{row.layer.path}{MADE_OF}", record)
        (database / f"{row.layer.path}.tif").write_text("guessed")
        write_catalogue(database, [*read_catalogue(database), row])
    ended(campaign)

    def derived():
        return {e.object: bool(e.earlier) for e in read_catalogue(database) if e.kind == ESTIMATED}

    assert derived() == {"one": False, "two": False}
    photo = campaign / "photo/one.png"
    photo.write_bytes(photo.read_bytes() + b"brighter")
    report = summarise(build(campaign))
    assert any(AGAIN in warning for warning in report.warnings)
    assert derived() == {"one": True, "two": False}
    assert {step.state for step in status(campaign).stages} == {"fresh"}
    say(campaign, '["one", "two"]', '["one"]')
    ended(campaign)
    assert derived() == {"one": True} and not [*database.rglob("*two*")]


@pytest.mark.parametrize("wanted", ["ono", "One"])
def test_an_unknown_object_is_refused_with_the_known_ones(campaign, wanted):
    with pytest.raises(Refused) as refused:
        list(build(campaign, objects=[wanted]))
    (problem,) = refused.value.problems
    assert (problem.field, problem.found, problem.expected) == ("--object", wanted, "one, two")
