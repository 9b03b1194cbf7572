"""Every change of a campaign of every kind, one at a time, and what `status` finds stale for it.

Every raw file changed by one byte at the same size and time of modification, every key of campaign.toml, tables,
roles and exposures, files renamed. What should be stale is written down here by hand, apart from the code that
decides it. A few in an ordinary run; `make exhaustive` takes all.
"""

from __future__ import annotations

import os
import shutil
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from levkas.building import build, status, summarise
from levkas.campaign import methods

sys.path.insert(0, str(Path(__file__).parent))
from every_kind import make

EVERY, FEW = bool(os.environ.get("LEVKAS_EVERY_CASE")), 5
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
    """Yield kind, name, change and what should be stale, for every key that can be said otherwise."""
    key = "a key of campaign.toml"
    raised = {s for s in all_of("calibrate", *CALIBRATED) if not s.startswith("two")} | {*PAGES}
    expected = {
        "campaign.title": (stated('"Every kind"', '"All kinds"'), {*END, "two report"}),
        "campaign.creator": (stated('"A. Maker"', '"B. Maker"'), CREDITS),
        "campaign.date": (stated("2019-08-29", "2019-08-30"), CREDITS),
        "campaign.licence": (stated("CC0-1.0", "CC-BY-4.0"), CREDITS),
        "campaign.reference": (stated('"G" }', '"R" }'), GRID),
        "campaign.setup": (stated('licence', 'setup = "normal"\nlicence'), {"catalogue"}),
        "grid.rotate": (stated("[targets]", "[grid]\nrotate = 90\n[targets]"), GRID),
        "grid.mirror": (stated("[targets]", "[grid]\nmirror = true\n[targets]"), GRID),
        "grid.size": (stated("[targets]", "[grid]\nsize = [100, 80]\n[targets]"), GRID),
        "grid.region": (stated("[targets]", "[grid]\nregion = [9, 9, 90, 90]\n[targets]"), GRID),
        "cameras.colour.pattern": (
            stated('"RGGB"', '"BGGR"'), of_frames("colour") | {"colour camera"}),
        "cameras.colour.reference_band": (
            stated('"RGGB"', '"RGGB"\nreference_band = "R"'), stages("colour", "register") | {*END}),
        "cameras.colour.bits": (
            stated('colour.csv"\nbits = 12', 'colour.csv"\nbits = 13'),
            of_frames("colour") | {"colour camera"}),
        "cameras.colour.black": (
            stated('bits = 12\nblack = 60\n[cameras.twin]', 'bits = 12\nblack = 61\n[cameras.twin]'),
            of_frames("colour") | {"colour camera"}),
        "cameras.colour.saturation": (
            stated('bits = 12\nblack = 60\n[cameras.twin]',
                 'saturation = 4000\nbits = 12\nblack = 60\n[cameras.twin]'),
            of_frames("colour") | {"colour camera"}),
        "cameras.colour.demosaic": (
            stated('"RGGB"', '"RGGB"\ndemosaic = "bilinear"'), of_frames("colour")),
        "cameras.colour.white": (stated('"RGGB"', '"RGGB"\nwhite = []'), of_frames("colour")),
        "cameras.colour.dark": (stated('"RGGB"', '"RGGB"\ndark = []'), of_frames("colour")),
        "cameras.colour.registration": (
            stated("[registration]", "[cameras.colour.registration]\nstop = 2.0\n[registration]"),
            stages("colour", "register") | {*END}),
        "cameras.filters.exposures": (
            stated('"exposures.csv"', '"exposures.csv"\nexposures = "best"'),
            of_frames("filters") | of_frames("filters@raking")),
        "cameras.scan.denoise": (
            stated("wavelengths = [500, 600]", 'wavelengths = [500, 600]\ndenoise = "hysime"'),
            of_frames("scan")),
        "cameras.scan.wavelengths": (
            stated("wavelengths = [500, 600]", "wavelengths = [500, 610]"),
            of_frames("scan") | {"scan camera"}),
        "cameras.twin.sensors.bands": (
            stated('bands = ["F"]', 'bands = ["E"]'), of_frames("twin") | {"twin camera"}),
        "targets.white.reflectance": (stated('"white.csv"', "0.9"), raised),
        "objects.one.title": (stated('"The first"', '"The foremost"'), DESCRIBED),
        "objects.one.rights": (stated("size_mm", 'rights = "All"\nsize_mm'), DESCRIBED),
        "objects.one.medium": (stated("size_mm", 'medium = "oil"\nsize_mm'), {*END}),
        "objects.one.size_mm": (stated("[120, 100]", "[60, 50]"), DESCRIBED),
        "setups.raking.title": (stated('"Raking light"', '"Side light"'), {"catalogue"}),
        "setups.raking.spectrum": (stated('spectrum = "lamp.csv"\n', ""), {"catalogue"}),
        "registration.order": (stated("[registration]", "[registration]\nstop = 2.0"), GRID),
        "publication": (
            stated("[registration]", "[publication]\nversion = '2'\n[registration]"), {"catalogue"}),
    }  # fmt: skip
    for name, (change, stale) in expected.items():
        yield key, name, change, stale
    both = of_frames("filters") | of_frames("filters@raking")
    yield (
        "a table beside it",
        "sensitivity",
        table("colour.csv", "500,0,1", "500,0,2"),
        of_frames("colour") | {"colour camera"},
    )
    yield "a table beside it", "white", table("white.csv", "0.97", "0.96"), raised
    yield "a table beside it", "lamp", table("lamp.csv", "1.5", "1.6"), {"catalogue"}
    yield (
        "a table beside it",
        "control points",
        lambda f: (f / "one_xray.csv").write_text(
            "reference_x,reference_y,target_x,target_y\n9,9,9,9\n"
        ),
        stages("xray", "register") | {*END},
    )
    edit = "[objects.one.cameras.xray]\nadded = [[20, 20, 21, 21]]\n"
    yield (
        "a table beside it",
        "edits.toml",
        lambda f: (f / "edits.toml").write_text("version = 1\n" + edit),
        stages("xray", "register") | {*END},
    )
    for target in ("one", "dark", "white"):  # under both setups: the manifest has no folders
        line = f"{target}_500nm.tif,0.1"
        yield "an exposure in the manifest", line, table("exposures.csv", line, f"{line}5"), both
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


@pytest.mark.slow
def test_exactly_what_depends_on_a_change_is_stale(tmp_path):
    campaign = make(tmp_path / "campaign")
    report = summarise(build(campaign))
    assert report.ok, report.text
    every = [*changes_of_files(campaign), *changes_of_keys()]
    for number, (kind, name, change, stale) in enumerate(
        every[:: 1 if EVERY else len(every) // FEW]
    ):
        copy = shutil.copytree(campaign, tmp_path / f"copy {number}")
        assert all(step.state == "fresh" for step in status(copy).stages)
        list(build(copy))  # stamps of the copy
        change(copy)
        found = {step.label for step in status(copy).stages if step.state == "stale"}
        done = {step.label for step in build(copy) if step.state == "done"}
        assert found == stale, (kind, name)
        assert done <= found, (kind, name)
        shutil.rmtree(copy)


def test_changed_code_of_an_installed_method_makes_what_it_registered_stale(
    plates, tmp_path, monkeypatch
):
    module = tmp_path / "my_method.py"
    module.write_text("STEP = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setitem(methods._MODULES, methods.DEFAULT_METHOD, "my_method")
    found = []
    for text in ("STEP = 1\n", "STEP = 2\n"):
        module.write_text(text)
        methods.code_of.cache_clear()
        found.append(methods.code_of(methods.DEFAULT_METHOD))
    stale = {step.label: step.why for step in status(plates).stages if step.state == "stale"}
    methods.code_of.cache_clear()
    assert found[0] != found[1]
    assert {label for label in stale if label.endswith("register")} == {
        "one/photo register", "one/infrared register"
    }  # fmt: skip
    assert "code of the registration method" in stale["one/photo register"]
    assert not any(label.endswith("calibrate") for label in stale)
