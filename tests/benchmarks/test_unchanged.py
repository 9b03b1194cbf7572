"""The comparison of two databases finds a planted difference of each kind, and no other."""

import importlib
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
import tifffile
import zarr
from PIL import Image

BENCHMARKS = Path(__file__).resolve().parents[2] / "benchmarks"
LAYER, ARRAY = "objects/o/o_c", "zarr/o.zarr/c"
RECORD = "objects/o/registration/c.json"
VALUES = np.linspace(0.1, 0.9, 2 * 6 * 5, dtype=np.float32).reshape(2, 6, 5)


@pytest.fixture
def tool(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("unchanged")


def write_array(folder, values, chunks=(6, 5, 2)):
    shutil.rmtree(folder, ignore_errors=True)
    zarr.create_array(folder, data=values, chunks=chunks)


def write_json(path, **keys):
    path.write_text(json.dumps(keys), encoding="utf-8")


@pytest.fixture
def pair(tmp_path):
    """Two equal databases of one layer."""
    old = tmp_path / "old"
    (old / "objects/o/registration").mkdir(parents=True)
    tifffile.imwrite(old / f"{LAYER}.tif", VALUES, description="a title")
    tifffile.imwrite(old / f"{LAYER}.sigma.tif", VALUES / 100)
    tifffile.imwrite(old / f"{LAYER}.flags.tif", np.zeros(VALUES.shape, np.uint8))
    Image.fromarray(np.full((6, 5), 90, np.uint8)).save(old / f"{LAYER}.png")
    cube = np.moveaxis(VALUES, 0, -1)
    for name, values in (("values", cube), ("sigma", cube / 100), ("flags", np.uint8(0 * cube))):
        write_array(old / ARRAY / name, values)
    write_json(old / RECORD, levkas="1", verdict="accept", moved=0.25, reasons=["117 of 117 agree"])
    write_json(old / "objects/o/provenance.json", code="abc", frames="0" * 16, bits=12)
    (old / "catalogue.csv").write_text(f"object,verdict,sha256\no,accept,{'a' * 64}\n")
    (old / "objects/o/report.html").write_text("<p>0.25 px</p>")
    new = tmp_path / "new"
    shutil.copytree(old, new)
    return old, new


def changed(values, amount):
    result = values.copy()
    result[1, 2, 1] += amount
    return result


def rewrite(path, old, new):
    path.write_text(path.read_text(encoding="utf-8").replace(old, new), encoding="utf-8")


CUBE = np.moveaxis(VALUES, 0, -1)
PLANTED = {
    "value": (lambda d: tifffile.imwrite(d / f"{LAYER}.tif", changed(VALUES, 1e-3),
                                         description="a title"), f"{LAYER}.tif", "values"),
    "nan": (lambda d: tifffile.imwrite(d / f"{LAYER}.tif", changed(VALUES, np.nan),
                                       description="a title"), f"{LAYER}.tif", "values"),
    "title": (lambda d: tifffile.imwrite(d / f"{LAYER}.tif", VALUES, description="another"),
              f"{LAYER}.tif", "record"),
    "sigma": (lambda d: tifffile.imwrite(d / f"{LAYER}.sigma.tif", changed(VALUES / 100, 1e-4)),
              f"{LAYER}.sigma.tif", "sigma"),
    "flag": (lambda d: tifffile.imwrite(d / f"{LAYER}.flags.tif",
                                        changed(np.zeros(VALUES.shape, np.uint8), 4)),
             f"{LAYER}.flags.tif", "flags"),
    "preview": (lambda d: Image.fromarray(np.full((6, 5), 95, np.uint8)).save(d / f"{LAYER}.png"),
                f"{LAYER}.png", "preview"),
    "value in Zarr": (lambda d: write_array(d / ARRAY / "values", changed(CUBE, 1e-3)),
                      f"{ARRAY}/values", "values"),
    "flag in Zarr": (lambda d: write_array(d / ARRAY / "flags", changed(np.uint8(0 * CUBE), 1)),
                     f"{ARRAY}/flags", "flags"),
    "missing file": (lambda d: (d / f"{LAYER}.sigma.tif").unlink(), f"{LAYER}.sigma.tif", "missing"),
    "missing array": (lambda d: shutil.rmtree(d / ARRAY / "sigma"), f"{ARRAY}/sigma", "missing"),
    "verdict": (lambda d: rewrite(d / RECORD, "accept", "refuse"), RECORD, "record"),
    "missing key": (lambda d: rewrite(d / RECORD, '"moved"', '"gone"'), RECORD, "missing"),
    "verdict in the catalogue": (lambda d: rewrite(d / "catalogue.csv", "accept", "warn"),
                                 "catalogue.csv", "record"),
    "damaged": (lambda d: (d / f"{LAYER}.tif").write_bytes(b"II*"), f"{LAYER}.tif", "unreadable"),
}  # fmt: skip


@pytest.mark.parametrize("name", PLANTED)
def test_a_planted_difference_is_found(name, pair, tool):
    plant, file, kind = PLANTED[name]
    plant(pair[1])
    for exact in (False, True):
        failing = [d for d in tool.compare_databases("x", *pair, exact=exact) if d.fails]
        assert [(d.file, d.kind) for d in failing] == [(file, kind)]


def test_how_far_a_value_is_off_is_measured(pair, tool):
    PLANTED["value"][0](pair[1])
    (found,) = tool.compare_databases("x", *pair, exact=False)
    place = VALUES[1, 2, 1]
    assert found.size == pytest.approx(1e-3 - (place + 1e-3) * tool.STORED_STEP, rel=1e-3)
    assert found.sigmas == pytest.approx(0.1 / place, rel=1e-3)
    assert found.detail.startswith("1 pixels, largest 0.001")


@pytest.mark.parametrize(
    ("plant", "kind"),
    [
        (lambda d: rewrite(d / RECORD, "0.25", "0.26"), "numbers"),
        (lambda d: rewrite(d / RECORD, "117 of 117", "116 of 117"), "numbers"),
        (lambda d: rewrite(d / RECORD, "{", '{"more": 1, '), "new"),
        (lambda d: rewrite(d / "objects/o/report.html", "px", "pixels"), "text"),
        (lambda d: (d / "more.txt").write_text("new"), "new"),
        (lambda d: tifffile.imwrite(d / f"{LAYER}.tif", changed(VALUES, 1e-6),
                                    description="a title"), "values"),
    ],
)  # fmt: skip
def test_a_small_or_grown_difference_is_listed_and_fails_by_bytes_only(plant, kind, pair, tool):
    plant(pair[1])
    for exact in (False, True):
        (found,) = tool.compare_databases("x", *pair, exact=exact)
        assert found.kind == kind and not found.fails


def test_another_layout_of_the_same_values_differs_by_bytes_only(pair, tool):
    new = pair[1]
    tifffile.imwrite(new / f"{LAYER}.tif", VALUES, description="a title", compression="zlib")
    write_array(new / ARRAY / "values", CUBE, chunks=(3, 5, 2))
    assert list(tool.compare_databases("x", *pair, exact=False)) == []
    found = list(tool.compare_databases("x", *pair, exact=True))
    assert [(d.file, d.kind) for d in found] == [
        (f"{LAYER}.tif", "bytes"),
        (f"{ARRAY}/values", "bytes"),
    ]


def test_versions_and_hashes_are_excluded(pair, tool):
    new = pair[1]
    rewrite(new / "objects/o/provenance.json", "abc", "def")
    rewrite(new / "objects/o/provenance.json", "0" * 16, "9" * 16)
    rewrite(new / RECORD, '"1"', '"2"')
    rewrite(new / "catalogue.csv", "a" * 64, "b" * 64)
    assert list(tool.compare_databases("x", *pair, exact=False)) == []
    found = list(tool.compare_databases("x", *pair, exact=True))
    assert {d.file for d in found} == {RECORD, "catalogue.csv"}


def test_equal_databases_are_equal(pair, tool):
    assert list(tool.compare_databases("x", *pair, exact=True)) == []


@pytest.fixture
def unchanged(monkeypatch):
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return importlib.import_module("unchanged")


def test_the_code_of_a_commit_is_unpacked_once(unchanged, tmp_path):
    if not (unchanged.HERE / ".git").exists():
        pytest.skip("no history: these sources come without git")
    source = unchanged.unpack("HEAD", tmp_path)
    assert (source / "levkas/__init__.py").is_file()
    assert source == unchanged.unpack("HEAD", tmp_path)


def test_limits_of_streamed_scans_are_found_whatever_stands_beside_them(unchanged, monkeypatch):
    import levkas.stages.parts
    import levkas.stages.scans

    for module, name in (
        (levkas.stages.scans, "STREAMED_SAMPLES"),
        (levkas.stages.parts, "BUFFER_BYTES"),
    ):
        monkeypatch.setattr(module, name, getattr(module, name))  # restored in the end
    exec(unchanged.STREAMED, {})
    assert levkas.stages.scans.STREAMED_SAMPLES == 0
    assert levkas.stages.parts.BUFFER_BYTES == 3_000_000
