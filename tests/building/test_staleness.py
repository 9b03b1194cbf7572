"""Every change of a campaign of every kind, one at a time: what `status` finds stale for it, and that building on ends in the
bytes of building anew.

Every raw file changed by one byte at the same size and time of modification, keys, tables, roles and exposures, files renamed. What
should be stale is written down here by hand, apart from the code that decides it. A third in an ordinary run; `make exhaustive`
takes all. All keys of the schema are changed one by one in a campaign that is not built.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import pytest
import toy
from toy import ended

from levkas.building import status
from levkas.building.build_records import CATALOGUE, Key
from levkas.building.catalogue import imprint_of
from levkas.building.graph import ordered
from levkas.building.hashes import Hashes
from levkas.building.inputs import (
    CALIBRATION,
    REGISTRATION,
    Inputs,
    declared,
    limited,
    of_report,
    without,
)
from levkas.building.plan import read_plan
from levkas.building.records_file import NAME
from levkas.campaign import campaign as campaign_module
from levkas.campaign.schema import tables
from levkas.core.digests import hash_tree, stamp_of
from levkas.registration import methods

EVERY, FEW = bool(os.environ.get("LEVKAS_EVERY_CASE")), 3
Change = Callable[[Path], None]

CALIBRATED = ("filters", "filters@raking", "colour", "twin", "scan")
OTHERS = ("xray", *CALIBRATED)
LAYERS = ("photo", *OTHERS)
PAGES = tuple(f"{name} camera" for name in ("filters", "colour", "twin", "scan"))
END = ("one report", "catalogue")


def stages(layer: str, first: str = "calibrate", name: str = "one") -> set[str]:
    """Return the stages of a layer from one on."""
    every = ["calibrate", "register", "resample"]
    return {f"{name}/{layer} {stage}" for stage in every[every.index(first) :]}


def of_frames(layer: str) -> set[str]:
    """Return what hangs on the frames of a layer; the reference's lead all others."""
    found = stages(layer) | {*END}
    if layer == "photo":
        found |= {s for other in OTHERS for s in stages(other, "register")}
    if layer == "filters":
        found |= {"one/filters@raking resample"}
    if layer in CALIBRATED:
        found |= {f"{layer.partition('@')[0]} camera"}
    return found


def all_of(first: str, *layers: str) -> set[str]:
    """Return the stages of several layers of both objects from one on, their pages and the catalogue."""
    found = {s for layer in layers for s in stages(layer, first)}
    return found | stages("photo", first, "two") | {"one report", "two report", "catalogue"}


GRID = all_of("register", *LAYERS)
DESCRIBED = {f"one/{layer} describe" for layer in LAYERS} | {*END}
CREDITS = DESCRIBED | {"two/photo describe", "two report"}


def stated(before: str, after: str) -> Change:
    """Change campaign.toml."""

    def change(folder: Path) -> None:
        path = folder / "campaign.toml"
        text = path.read_text()
        assert before in text, before
        path.write_text(text.replace(before, after, 1))

    return change


def table(name: str, before: str, after: str) -> Change:
    """Change a table beside it."""

    def change(folder: Path) -> None:
        text = (folder / name).read_text()
        assert before in text
        (folder / name).write_text(text.replace(before, after, 1))

    return change


def flipped(path: Path) -> Change:
    """Change the last byte of a file, where size and time of modification do not show it."""

    def change(folder: Path) -> None:
        file, before = folder / path, (folder / path).stat()
        data = bytearray(file.read_bytes())
        data[-1] ^= 1
        file.write_bytes(data)
        os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))

    return change


def swapped(one: str, other: str) -> Change:
    """Swap two files."""

    def change(folder: Path) -> None:
        data = (folder / one).read_bytes()
        (folder / one).write_bytes((folder / other).read_bytes())
        (folder / other).write_bytes(data)

    return change


def changes_of_files(folder: Path) -> Iterator[tuple[str, str, Change, set[str]]]:
    """Yield kind, name, change and what should be stale, for every raw file of a campaign."""
    for path in sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file()):
        part = path.parts[0]
        if part.startswith("database") or len(path.parts) < 2:
            continue
        layer = "filters@raking" if part == "raking" else part
        stale = of_frames(layer)
        if part == "photo" and path.stem == "two":
            stale = stages("photo", name="two") | {"two report", "catalogue"}
        if part == "filters" and path.stem.startswith("dark"):
            stale = stale | of_frames("filters@raking")
        yield "a byte of a file", str(path), flipped(path), stale


def changes_of_keys() -> Iterator[tuple[str, str, Change, set[str]]]:
    """Yield kind, name, change and what should be stale, for a key of every kind and every table."""
    key = "a key of campaign.toml"
    raised = {s for s in all_of("calibrate", *CALIBRATED) if not s.startswith("two")} | {*PAGES}
    colour = of_frames("colour") | {"colour camera"}
    expected = {
        "campaign.licence": (stated("CC0-1.0", "CC-BY-4.0"), CREDITS),
        "campaign.reference": (stated('"G" }', '"R" }'), GRID),
        "campaign.setup": (stated('licence', 'setup = "normal"\nlicence'), {"catalogue"}),
        "grid.rotate": (stated("[targets]", "[grid]\nrotate = 90\n[targets]"), GRID),
        "cameras.colour.pattern": (stated('"RGGB"', '"BGGR"'), colour),
        "cameras.colour.bits": (stated('colour.csv"\nbits = 12', 'colour.csv"\nbits = 13'), colour),
        "cameras.colour.white": (stated('"RGGB"', '"RGGB"\nwhite = []'), colour),
        "cameras.colour.dark": (stated('"RGGB"', '"RGGB"\ndark = []'), of_frames("colour")),
        "cameras.colour.registration": (
            stated("[registration]", "[cameras.colour.registration]\nstop = 2.0\n[registration]"),
            stages("colour", "register") | {*END}),
        "cameras.twin.sensors.bands": (
            stated('bands = ["F"]', 'bands = ["E"]'), of_frames("twin") | {"twin camera"}),
        "targets.white.reflectance": (stated('"white.csv"', "0.9"), raised),
        "objects.one.medium": (stated("size_mm", 'medium = "oil"\nsize_mm'), {*END}),
        "objects.one.size_mm": (stated("[120, 100]", "[60, 50]"), DESCRIBED),
        "setups.raking.spectrum": (stated('spectrum = "lamp.csv"\n', ""), of_frames("filters@raking")),
    }  # fmt: skip
    for name, (change, stale) in expected.items():
        yield key, name, change, stale
    both = of_frames("filters") | of_frames("filters@raking")
    points = "reference_x,reference_y,target_x,target_y\n9,9,9,9\n"
    edits = "version = 1\n[objects.one.cameras.xray]\nadded = [[20, 20, 21, 21]]\n"
    by_points = stages("xray", "register") | {*END}
    beside = {
        "sensitivity": (
            table("colour.csv", "500,0,1", "500,0,2"), of_frames("colour") | {"colour camera"}),
        "white": (table("white.csv", "0.97", "0.96"), raised),
        "lamp": (table("lamp.csv", "1.5", "1.6"), of_frames("filters@raking")),
        "control points": (lambda f: (f / "one_xray.csv").write_text(points), by_points),
        "edits.toml": (lambda f: (f / "edits.toml").write_text(edits), by_points),
    }  # fmt: skip
    for target in ("one", "dark", "white"):  # under both setups: the manifest has no folders
        line = f"{target}_500nm.tif,0.1"
        beside[line] = table("exposures.csv", line, f"{line}5"), both
    for name, (change, stale) in beside.items():
        yield "a table beside it", name, change, stale
    dark = stated('dark = "dark"', 'dark = "white"')

    def roles(folder: Path) -> None:
        dark(folder)
        stated('names = "white"', 'names = "dark"')(folder)

    # Raking light has no dark of its own to be the white: that capture is refused, and its light unknown.
    yield "roles swapped", "dark and white", roles, raised - stages("filters@raking")
    pair = "scan/dark.raw", "scan/white.raw"
    yield "roles swapped", "data of two cubes", swapped(*pair), of_frames("scan")

    def renamed(folder: Path) -> None:
        for path in sorted((folder / "twin").iterdir()):
            path.rename(path.with_name("new_" + path.name))
        stated("twin/{target}", "twin/new_{target}")(folder)

    yield "files renamed", "of one camera", renamed, of_frames("twin")


@pytest.fixture(scope="module")
def built(tmp_path_factory):
    with pytest.MonkeyPatch.context() as patch:
        toy.install(patch)
        folder = toy.make(tmp_path_factory.mktemp("every") / "campaign")
        assert {step.state for step in ended(folder).values()} == {"done"}
        yield folder


def test_exactly_what_depends_on_a_change_is_stale_and_building_on_ends_as_building_anew(
    built, tmp_path
):
    every = [*changes_of_files(built), *changes_of_keys()]
    assert len(every) > 50
    for number, (kind, name, change, stale) in enumerate(every[:: 1 if EVERY else FEW]):
        copy = shutil.copytree(built, tmp_path / f"copy {number}")
        change(copy)
        found = {step.label for step in status(copy).stages if step.state == "stale"}
        assert found == stale, (kind, name)
        steps = ended(copy)
        assert {label for label, step in steps.items() if step.state == "done"} <= found, name
        if all(step.state != "refused" for step in steps.values()):  # one that is refused stays
            ended(copy, output=copy / "anew")
            assert hash_tree(copy / "database") == hash_tree(copy / "anew"), (kind, name)
            assert {step.state for step in status(copy).stages} == {"fresh"}, name
        shutil.rmtree(copy)


FIRST = {
    tables.CALIBRATE: "calibrate",
    tables.LIGHT: "calibrate",
    tables.NATIVE: "calibrate",
    tables.REGISTER: "register",
}
"""What reads a key first of the stages of a capture."""
OF_PAGES = {tables.FACT, tables.REPORT, tables.CAMERA, tables.LIGHT, tables.NATIVE}


@pytest.fixture(scope="module")
def plan(built):
    """Of a campaign in which every table is there, and the colour camera has a chart for its white."""
    plan = read_plan(built)
    colour = plan.campaign.cameras["colour"].model_copy(
        update={"white": tables.ChartWhite(chart="c")}
    )
    full = {
        "grid": tables.GridKeys(), "cameras": plan.campaign.cameras | {"colour": colour},
        "setups": plan.campaign.setups | {"default": tables.Setup()},
    }  # fmt: skip
    return replace(plan, campaign=plan.campaign.model_copy(update=full))


def changes_of(table, where=()):
    """Yield path, reader and a changed copy of a table, for every key of it and of the tables in it."""
    for key in type(table).model_fields:
        value = getattr(table, key)
        if isinstance(value, tables.Table):
            inner = ((path, by, {key: made}) for path, by, made in changes_of(value, (*where, key)))
        elif isinstance(value, dict) and any(isinstance(v, tables.Table) for v in value.values()):
            inner = (
                (path, by, {key: {**value, name: made}})
                for name, one in value.items()
                for path, by, made in changes_of(one, (*where, key, name))
            )
        elif key in ("path", "root", "edits", "name"):
            continue
        else:
            inner = [((*where, key), table.reader_of(key), {key: other(key, value)})]
        yield from ((path, by, table.model_copy(update=update)) for path, by, update in inner)


def other(key, value):
    """Return another value of a key; of a table of names one of what the campaign has."""
    match value:
        case bool():
            return not value
        case int() | float():
            return value + 1
        case tuple():
            return (*value, "other")
        case dict():
            return value | {name: {"colour": [[1, 2, 3, 4]]} for name in ("one", "c")}
    return 8.0 if key in ("reject", "stop") else f"{value} other"


def first_readers(plan, path, by):
    """Return the tasks that a key makes stale by itself."""
    table, name = path[0], path[1]
    owner = {"cameras": "camera", "objects": "object", "setups": "setup"}.get(table)
    tasks = [task for task in plan.graph.values() if task.key.stage == FIRST.get(by)]
    if owner:
        name = "" if name == "default" else name
        tasks = [task for task in tasks if getattr(task.capture, owner) == name]
    if path[:2] == ("targets", "white") or by == tables.LIGHT:
        chart = "colour" if by == tables.LIGHT else ""
        tasks = [
            t for t in tasks if t.key.camera == chart or any(s.white for s in t.capture.sensors)
        ]
    if path[:2] == ("targets", "charts"):
        tasks = [task for task in tasks if task.key.camera == "colour"]
    if path[:2] == ("targets", "traps"):
        tasks = [task for task in tasks if task.key.object == "one"]
    if (
        "registration" in path
    ):  # what is no option of the method in use, or of points that there are none of, has no effect
        method = methods.method_of(plan.campaign.registration_of(tasks[0].key.camera))
        tasks = tasks if path[-1] in ("method", *method.options.model_fields) else []
    return {task.key for task in tasks}


def behind(graph, keys):
    """Return tasks and all that read what they make."""
    found = set(keys)
    for key, task in graph.items():
        if found & {*task.needs, *task.uses}:
            found.add(key)
    return {key for key in found if graph[key].capture}


def made_of(plan, hashes):
    """Return the fingerprints of all captures, of their pages, and what the catalogue says of the campaign."""
    records = SimpleNamespace(hashes=hashes)
    inputs = Inputs(plan.campaign, records)
    prints = {key: inputs.of(task, ()) for key, task in plan.graph.items() if task.capture}
    mine = [capture for capture in plan.captures if capture.object == "one"]
    rows = [SimpleNamespace(camera=c.camera, setup=c.setup) for c in plan.captures]
    pages = of_report(plan.campaign, "one", {}, mine, hashes)
    return prints, pages, imprint_of(plan.campaign, rows)


@pytest.mark.filterwarnings("ignore::UserWarning:pydantic")
def test_every_key_of_the_schema_makes_stale_exactly_what_reads_it(plan, monkeypatch):
    monkeypatch.setattr(campaign_module, "method_of", lambda keys: methods.METHODS["levkas"])
    hashes = Hashes(plan.campaign.root / "nowhere")
    stages, page, imprint = made_of(plan, hashes)
    every = [*changes_of(plan.campaign)]
    assert len(every) > 150
    wrong = []
    for path, by, campaign in every:
        now, page_now, imprint_now = made_of(replace(plan, campaign=campaign), hashes)
        differing = {key for key, prints in now.items() if prints != stages[key]}
        pixels = {key for key in differing if without(now[key]) != without(stages[key])}
        first = first_readers(plan, path, by) if by in FIRST else set()
        # Pixels that are published as well are those that were.
        expected = first if by == tables.NATIVE else behind(plan.graph, first)
        facts = set()
        if by == tables.FACT:
            mine = {k for k in stages if path[0] == "campaign" or k.object == path[1]}
            facts = {key for key in mine if key.stage != "calibrate"}
        elif by == tables.NATIVE:
            facts = {key for key in stages if key.stage == "calibrate"}
        mine = (path[0] != "objects" or path[1] == "one") and path[-1] != "edges"
        on_page = (by in OF_PAGES and mine) or path[:2] == ("campaign", "reference")
        if (pixels, differing, page_now != page) != (expected, expected | facts, on_page):
            wrong.append((path, by))
        if by == tables.CATALOGUE and imprint_now == imprint and "default" not in path:
            wrong.append((path, by))
    assert wrong == []


def test_a_stage_is_given_no_key_that_its_fingerprint_leaves_out(plan):
    marks = {mark for mark in vars(tables).values() if isinstance(mark, str) and mark.islower()}
    named = {"cameras": "colour", "objects": "one", "setups": "raking", "traps": "one"}
    for given in (CALIBRATION, REGISTRATION):
        found = {
            repr([*declared(limited(campaign, given), marks - {*given}, named)])
            for _, _, campaign in changes_of(plan.campaign)
        }
        assert len(found) == 1


def test_another_number_for_the_white_makes_what_it_scales_stale(built, tmp_path, toys):
    copy = shutil.copytree(built, tmp_path / "campaign")
    stated('"white.csv"', "0.9")(copy)
    ended(copy)
    stated("reflectance = 0.9", "reflectance = 0.8")(copy)
    stale = {step.label for step in status(copy).stages if step.state == "stale"}
    assert {label for label in stale if "calibrate" in label} == {
        f"one/{layer} calibrate" for layer in CALIBRATED
    }


def test_what_was_built_is_fresh_and_a_damaged_product_is_made_again(built, tmp_path, toys):
    copy = shutil.copytree(built, tmp_path / "campaign")
    assert {step.state for step in ended(copy).values()} == {"fresh"} and not toys.computed
    before, database = hash_tree(copy / "database"), copy / "database"
    for name in ("one_photo.tif", "registration/colour.json", "registration/photo.json"):
        path = database / "objects/one" / name
        for damage in (path.unlink, partial(path.write_text, "damaged")):
            damage()
            assert any(step.state == "done" for step in ended(copy).values())
            assert hash_tree(database) == before, name
    shutil.rmtree(copy / "database.kept")
    assert {step.state for step in ended(copy).values()} == {"done"}
    assert hash_tree(database) == before


def test_what_a_stage_reads_again_is_checked_where_size_and_times_do_not_show_the_damage(
    built, tmp_path, monkeypatch
):
    copy = shutil.copytree(built, tmp_path / "campaign")
    ended(copy)
    before = hash_tree(copy / "database")
    for name in ("registration/photo.json", "registration/colour.json", "one_photo.tif"):
        path = copy / "database/objects/one" / name
        flip_a_bit(path, copy / "database.kept")
        for late in ("one_colour.tif", "one_filters.tif"):  # so that the last stage is due
            (copy / "database/objects/one" / late).unlink()
        steps = ended(copy)
        assert any("damaged" in step.why for step in steps.values()), name
        assert hash_tree(copy / "database") == before, name


def flip_a_bit(path, kept):
    """Damage one file as a disk does: neither size nor times nor inode tell."""
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 4
    path.write_bytes(data)
    hashes = Hashes(kept / NAME)
    hashes._learn(path, (*stamp_of(path), hashes.known(path)[-1]), old_enough=True)
    hashes.save()


def test_tasks_stand_behind_what_they_read(built):
    plan = read_plan(built)
    graph, places = plan.graph, {key: place for place, key in enumerate(plan.graph)}
    for key, task in graph.items():
        assert all(places[before] < places[key] for before in (*task.needs, *task.uses))
    assert [*graph][-1] == CATALOGUE
    reads = {
        Key("one", c, "", s)
        for c, s in (("xray", "calibrate"), ("photo", "calibrate"), ("photo", "register"))
    }
    assert set(graph[Key("one", "xray", "", "register")].needs) == reads
    of_one = ordered(graph, [key for key in graph if key.object == "one"])
    assert {task.key.object for task in of_one} == {"one"}


def test_changed_code_of_an_installed_method_makes_what_it_registered_stale(
    built, tmp_path, monkeypatch
):
    module = tmp_path / "my_method.py"
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(methods._MODULES, methods.DEFAULT_METHOD, "my_method")
    found = []
    for text in ("STEP = 1\n", "STEP = 2\n"):
        module.write_text(text)
        methods.code_of.cache_clear()
        found.append(methods.code_of(methods.DEFAULT_METHOD))
    stale = {step.key.stage for step in status(built).stages if step.state == "stale"}
    methods.code_of.cache_clear()
    assert found[0] != found[1]
    assert stale == {"register", "resample", "report", "catalogue"}
