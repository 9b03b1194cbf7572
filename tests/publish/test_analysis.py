"""Analyses that `levkas publish --analyse` makes: names, pictures, files, and what is said of them."""

import json
import re
from urllib.parse import unquote

import numpy as np
import pytest

import levkas
from levkas.core.digests import hash_file, hash_tree
from levkas.core.flags import MARKS
from levkas.core.problems import Refused
from levkas.database.tiff_pages import open_pages
from levkas.database.validation import validate
from levkas.publish import run
from levkas.publish.analysis_names import parse_analyses

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
    "text",
    [
        "infrared",
        "ratio:700",
        "ratio:700/800/900",
        "all",
        "ratio:A/B,",
        "infrared-visible:3",
        "--check",
    ],
)
def test_a_name_that_is_none_is_refused(text):
    (problem,) = problems_of(lambda: parse_analyses([text]))
    assert problem.code == "E_VALUE" and problem.field == "--analyse" and problem.fix


def test_names_may_be_repeated_joined_and_in_capitals():
    found = parse_analyses(["ratio: 700 / 1000 nm", "ratio:700/1000 nm", "Infrared-visible"])
    assert [a.text for a in found] == ["ratio:700/1000 nm", "infrared-visible"]


@pytest.mark.parametrize("text", ["ratio:700/1000", "ratio:R1/B", "infrared-visible"])
def test_what_no_layer_has_bands_for_is_refused_before_anything_is_written(database, make, text):
    (problem,) = problems_of(lambda: make(text))
    assert text in problem.message
    assert not database.with_name("database.published").exists()
    (checked,) = run.check(database, analyse=[text]).problems
    assert checked == problem


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
        sound = ((one.levkas.flags.values | other.levkas.flags.values) & untrusted) == 0
        with np.errstate(all="ignore"):
            ratio = one.values.astype(float) / other.values
        assert np.array_equal(np.isfinite(made), sound & (other.values > 0))
        assert np.allclose(made[np.isfinite(made)], ratio[np.isfinite(made)], rtol=1e-6)
    assert validate(folder).ok
    record = json.loads((folder / f"{PLACE}vis.ratio-718-R.json").read_text())
    assert record["sha256"] == hash_file(folder / f"{PLACE}vis.ratio-718-R.tif")
    graph = {
        e["@id"]: e for e in json.loads((folder / "ro-crate-metadata.json").read_text())["@graph"]
    }
    action = graph[f"#{PLACE}vis.ratio-718-R.json"]
    assert {"@id": "objects/icon1/icon1_vis.tif"} in action["object"]
    assert {"@id": f"{PLACE}vis.ratio-718-R.tif"} in action["result"]
    assert record["title"] == "720 nm / R" and list(record["inputs"]) == [
        "../icon1_vis.tif",
        "../icon1_rgb.tif",
    ]


def test_the_viewer_shows_every_analysis_with_what_black_and_white_are(make):
    folder = make("ratio:R/B")
    page = (folder / "viewer/objects/icon1/index.html").read_text(encoding="utf-8")
    text = re.search(r'<script type="application/json" id="record">(.*?)</script>', page)[1]
    layers = {layer["name"]: layer for layer in json.loads(text)["layers"]}
    shown = {p["key"]: p for p in layers["rgb"]["pictures"] if p["kind"] == "analysis"}
    assert list(shown) == ["ratio-R-B"]
    assert shown["ratio-R-B"]["legend"]["least"] in shown["ratio-R-B"]["note"]
    home = folder / "viewer/objects/icon1"
    assert all((home / p["folder"] / str(p["most"])).is_dir() for p in shown.values())
    links = [unquote(link) for link in re.findall(r'href="([^"#]+)"', page)]
    assert "../../../objects/icon1/analysis/icon1_rgb.ratio-R-B.tif" in links
    assert all((home / link).is_file() for link in links if ":" not in link)


@pytest.mark.slow
def test_the_same_bytes_for_any_number_of_threads(make, monkeypatch):
    made = []
    for threads in ("1", "3"):
        monkeypatch.setenv("LEVKAS_THREADS", threads)
        made.append(hash_tree(make("ratio:R/B")))
    assert made[0] == made[1]


def test_ratios_of_bands_that_differ_in_signs_alone_are_two():
    texts = ["ratio:IR+/R,ratio:IR-/R", "ratio:A-B/C", "ratio:A/B-C", "ratio:R 1/2", "ratio:R/1 2"]
    found = parse_analyses(texts)
    assert len(found) == 6 and len({one.name for one in found}) == 6
    assert all(re.fullmatch(r"[A-Za-z0-9._=-]+", one.name) for one in found)
