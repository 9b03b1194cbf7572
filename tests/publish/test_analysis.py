"""Analyses that `levkas publish --analyse` makes: names, pictures, files, and what is said of them."""

import json
import re
from urllib.parse import unquote

import numpy as np
import pytest
from typer.testing import CliRunner

import levkas
from levkas.core.digests import hash_file, hash_tree
from levkas.core.flags import MARKS
from levkas.core.problems import Refused
from levkas.database.tiff_pages import open_pages
from levkas.database.validation import validate
from levkas.publish import run
from levkas.publish.analysis_names import parse_analyses

from .crate_rules import check_crate

PLACE = "objects/icon1/analysis/icon1_"


@pytest.fixture
def make(database, publish):
    def make(*names, **options):
        return publish(database, analyse=names, **{"iiif": False, **options})

    return make


def problems_of(action):
    with pytest.raises(Refused) as refused:
        action()
    return refused.value.problems


@pytest.mark.parametrize(
    ("text", "hint"),
    [
        ("mfn", "'mnf'"),
        ("PCS", "'pca'"),
        ("infrared", "'infrared-visible'"),
        ("ratios:700/1000", "'ratio'"),
        ("ratio:700", "ratio:700/1000"),
        ("ratio:700/800/900", "ratio:700/1000"),
        ("pca,,mnf", "--analyse all"),
        ("pca:3", "'pca'"),
        ("--check", "--analyse all"),
    ],
)
def test_a_name_that_is_none_is_refused_with_the_one_that_may_be_meant(text, hint):
    (problem,) = problems_of(lambda: parse_analyses([text]))
    assert problem.code == "E_VALUE" and problem.field == "--analyse"
    assert hint in problem.fix and "infrared-visible" in problem.expected


def test_names_may_be_repeated_joined_and_in_capitals():
    found = parse_analyses(["PCA, ratio: 700 / 1000 nm", "pca", "ratio:700/1000 nm", "all"])
    assert [a.text for a in found] == ["pca", "ratio:700/1000 nm", "mnf", "infrared-visible"]
    assert [a.required for a in found] == [True, True, False, False]


@pytest.mark.parametrize(
    ("text", "found"),
    [
        ("ratio:700/1000", "the nearest is 720 nm of vis"),
        ("ratio:R1/B", "no band 'R1': Did you mean 'R'?"),
        ("infrared-visible", "no such layer"),
    ],
)
def test_what_no_layer_has_bands_for_is_refused_before_anything_is_written(
    database, make, text, found
):
    (problem,) = problems_of(lambda: make(text))
    assert found in problem.found and text in problem.message and "ratio:700/1000" in problem.fix
    assert not database.with_name("database.published").exists()
    (checked,) = run.check(database, analyse=[text]).problems
    assert checked == problem


def test_components_are_data_with_a_record_of_their_making(make, database):
    folder = make("all")
    assert validate(folder).ok and check_crate(folder) == []
    layer = levkas.open(database)["icon1"]["vis"]
    for name, method in (("pca", "pca"), ("mnf", "mnf")):
        record = json.loads((folder / f"{PLACE}vis.{name}.json").read_text(encoding="utf-8"))
        tiff = folder / f"{PLACE}vis.{name}.tif"
        found = layer.components(method)
        assert record["loadings"] == found.loadings.tolist() and record["pixels"] == found.pixels
        assert record["sha256"] == hash_file(tiff)
        assert record["inputs"] == {
            "../icon1_vis.tif": hash_file(folder / "objects/icon1/icon1_vis.tif")
        }
        pixels = open_pages(tiff).read()
        sound = (layer.flags.values == 0).all(2)
        expected = (layer.values.astype(float) - found.mean) @ found.loadings[:6].T
        assert pixels.shape == (90, 120, 6) and np.array_equal(np.isfinite(pixels).all(2), sound)
        assert np.allclose(pixels[sound], expected[sound], rtol=1e-5, atol=1e-5)
    assert record["source"] == "https://doi.org/10.1109/36.3001"
    assert record["noise"]["from"] == "sigma" and len(record["snr"]) == 11
    graph = {
        e["@id"]: e for e in json.loads((folder / "ro-crate-metadata.json").read_text())["@graph"]
    }
    for name in (f"{PLACE}vis.mnf.tif", f"{PLACE}vis.mnf.json"):
        assert graph[name]["sha256"] == hash_file(folder / name)
    action = graph[f"#{PLACE}vis.mnf.json"]
    assert {"@id": "objects/icon1/icon1_vis.tif"} in action["object"]
    assert {"@id": f"{PLACE}vis.mnf.tif"} in action["result"]
    assert "objects/OBJECT/analysis/" in (folder / "README.md").read_text()
    assert "minimum-noise fractions" in (folder / "ro-crate-preview.html").read_text()
    # What no layer has bands for is not among all.
    assert not list(folder.glob("**/*infrared-visible*"))


def test_a_ratio_takes_its_second_band_from_a_layer_of_the_same_light(make, database):
    folder = make("ratio:R/B,ratio:718/R")
    views = levkas.open(database)["icon1"]
    rgb, vis = views["rgb"], views["vis"]
    untrusted = ~np.uint8(sum(flag for flag, mark in MARKS.items() if mark.trusted))
    for name, one, other in (
        ("rgb.ratio-R-B", rgb.sel(band="R"), rgb.sel(band="B")),
        ("vis.ratio-718-R", vis.sel(band="720 nm"), rgb.sel(band="R")),
    ):
        made = open_pages(folder / f"{PLACE}{name}.tif").read_page(0)
        sound = ((one.flags.values | other.flags.values) & untrusted) == 0
        with np.errstate(all="ignore"):
            ratio = one.values.astype(float) / other.values
        assert np.array_equal(np.isfinite(made), sound & (other.values > 0))
        assert np.allclose(made[np.isfinite(made)], ratio[np.isfinite(made)], rtol=1e-6)
    record = json.loads((folder / f"{PLACE}vis.ratio-718-R.json").read_text())
    assert record["title"] == "720 nm / R" and list(record["inputs"]) == [
        "../icon1_vis.tif",
        "../icon1_rgb.tif",
    ]
    assert record["pictures"][0]["note"].startswith("720 nm of vis, over R of rgb. Black is ")


def test_the_viewer_shows_every_analysis_with_what_black_and_white_are(make):
    folder = make("pca,mnf,ratio:R/B")
    page = (folder / "viewer/objects/icon1/index.html").read_text(encoding="utf-8")
    text = re.search(r'<script type="application/json" id="record">(.*?)</script>', page)[1]
    layers = {layer["name"]: layer for layer in json.loads(text)["layers"]}
    shown = {p["key"]: p for p in layers["rgb"]["pictures"] if p["kind"] == "analysis"}
    assert list(shown) == ["pca-1", "pca-2", "pca-3", "mnf-1", "mnf-2", "mnf-3", "ratio-R-B"]
    assert "% of the variance" in shown["pca-1"]["note"] and "Violet" in shown["pca-1"]["note"]
    assert "over that of the noise" in shown["mnf-1"]["note"]
    assert shown["ratio-R-B"]["legend"]["least"] in shown["ratio-R-B"]["note"]
    home = folder / "viewer/objects/icon1"
    assert all((home / p["folder"] / str(p["most"])).is_dir() for p in shown.values())
    links = [unquote(link) for link in re.findall(r'href="([^"#]+)"', page)]
    assert "../../../objects/icon1/analysis/icon1_rgb.pca.tif" in links
    assert all((home / link).is_file() for link in links if ":" not in link)


@pytest.mark.slow
def test_the_same_bytes_for_any_number_of_threads(make, monkeypatch):
    made = []
    for threads in ("1", "3"):
        monkeypatch.setenv("LEVKAS_THREADS", threads)
        made.append(hash_tree(make("all,ratio:R/B")))
    assert made[0] == made[1]


def test_a_layer_that_has_no_components_is_left_out_and_that_is_said(database, publish):
    import tifffile

    from levkas.database.manifest import write_manifest
    from levkas.database.tiff_pages import open_pages

    path = database / "objects/icon2/icon2_rgb.flags.tif"
    with tifffile.TiffFile(path) as tiff:
        where = [(p.dataoffsets[0], p.databytecounts[0]) for p in tiff.pages]
    assert where and open_pages(path).shape[2] == 3
    flags = np.full((64, 48), 2, np.uint8)
    tifffile.imwrite(path, np.stack([flags] * 3), photometric="minisblack")
    write_manifest(database)
    steps = run.publish(database, analyse=["pca"], iiif=False)
    report = run.summarise(steps)
    note, _ = report.left_out  # the other: a database alone has no declarations
    assert (
        note
        == "icon2/rgb, principal components: too few pixels or bands for components: 0 valid pixels of 3 bands"
    )
    assert note in report.text and report.to_dict()["left_out"][0] == note
    assert not (report.output / "objects/icon2/analysis/icon2_rgb.pca.tif").exists()


def test_the_command_line_makes_them(database):
    from levkas.cli import app

    done = CliRunner().invoke(app, ["publish", str(database), "--analyse", "pca", "--no-iiif"])
    assert done.exit_code == 0, done.output
    assert (database.with_name("database.published") / f"{PLACE}rgb.pca.tif").is_file()
    wrong = CliRunner().invoke(app, ["publish", str(database), "--analyse", "pcs"])
    assert wrong.exit_code == 1 and "Did you mean 'pca'?" in wrong.output


def test_ratios_of_bands_that_differ_in_signs_alone_are_two():
    texts = ["ratio:IR+/R,ratio:IR-/R", "ratio:A-B/C", "ratio:A/B-C", "ratio:R 1/2", "ratio:R/1 2"]
    found = parse_analyses(texts)
    assert len(found) == 6 and len({one.name for one in found}) == 6
    assert all(re.fullmatch(r"[A-Za-z0-9._=-]+", one.name) for one in found)
