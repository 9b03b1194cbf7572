import io
import json

import iiif_prezi3
import numpy as np
import pytest
from PIL import Image

from levkas.core.digests import hash_tree
from levkas.publish.iiif import cut_tiles, never_html
from levkas.publish.publication import LOCAL

from .iiif_rules import check_iiif, tile_names


@pytest.fixture(scope="module")
def picture():
    y, x = np.mgrid[0:701, 0:1103]
    return np.stack([x % 256, y % 256, (x + y) // 8 % 256], -1).astype(np.uint8)


@pytest.mark.parametrize("size", [(1103, 701), (512, 512), (513, 100), (90, 60), (1, 1)])
def test_every_tile_that_a_viewer_may_ask_for_is_there(picture, size):
    files = dict(cut_tiles(picture[: size[1], : size[0]], "https://example.org/x"))
    info = json.loads(files["info.json"])
    assert (info["width"], info["height"]) == size
    wanted = set(tile_names(info)) | {
        f"full/{s['width']},{s['height']}/0/default.jpg" for s in info["sizes"]
    }
    assert wanted <= set(files)
    for name in wanted:
        expected = tuple(int(n) for n in name.split("/")[1].split(","))
        assert Image.open(io.BytesIO(files[name])).size == expected, name


def test_tiles_at_full_size_are_the_picture(picture):
    smooth = np.asarray(Image.fromarray(picture).resize((140, 90)).resize((1103, 701)))
    files = dict(cut_tiles(smooth, "x"))
    tile = Image.open(io.BytesIO(files["512,0,512,512/512,512/0/default.jpg"]))
    apart = np.abs(np.asarray(tile).astype(int) - smooth[:512, 512:1024]).mean()
    assert apart < 2
    whole = Image.open(io.BytesIO(files["full/max/0/default.jpg"]))
    assert b"acsp" in whole.info["icc_profile"]


def test_tiles_are_the_same_at_any_time(picture):
    assert list(cut_tiles(picture, "x")) == list(cut_tiles(picture, "x"))


@pytest.fixture
def folder(database, publish):
    return publish(database, url="https://example.org/icons")


def test_the_library_reads_manifest_and_collection_again(folder):
    manifest = iiif_prezi3.Manifest(**json.loads((folder / "iiif/icon1/manifest.json").read_text()))
    (canvas,) = manifest.items
    assert (canvas.width, canvas.height) == (120, 90)
    record = json.loads(manifest.json())
    assert record["items"][0]["label"] == record["label"] == {"none": ["The icon1"]}
    body = json.loads(manifest.json())["items"][0]["items"][0]["items"][0]["body"]
    assert body["type"] == "Choice"
    labels = [item["label"]["en"][0].split(":")[0] for item in body["items"]]
    assert labels == ["vis", "rgb"]  # the reference camera's first
    collection = iiif_prezi3.Collection(**json.loads((folder / "iiif/collection.json").read_text()))
    listed = json.loads(collection.json())["items"]
    assert [m["label"]["none"][0] for m in listed] == ["The icon1", "The icon2"]


def test_all_addresses_are_below_the_one_that_was_given_and_lead_to_files(folder):
    assert check_iiif(folder / "iiif", "https://example.org/icons/iiif") == []
    text = (folder / "iiif/icon1/manifest.json").read_text()
    assert "https://example.org/icons/iiif/icon1/vis/full/max/0/default.jpg" in text
    assert '"rights": "http://creativecommons.org/licenses/by/4.0/"' in text
    for name in ("icon1/manifest.json", "collection.json"):
        record = json.loads((folder / "iiif" / name).read_text())
        reported = record["requiredStatement"]["value"]["none"]
        assert reported[0].startswith("Painter, Ada (2019). Icons of Levkas.")
        assert reported[1].startswith(
            "Licence: Creative Commons Attribution 4.0 International <https"
        )
        leads = [one["id"] for one in [*record["homepage"], *record["seeAlso"]]]
        base = "https://example.org/icons/"
        assert all((folder / lead.removeprefix(base)).is_file() for lead in leads)
        assert base + "catalogue.csv" in leads


def broken(path, change):
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))


BREAKS = {
    "a tile is missing": lambda f: (f / "icon1/vis/full/120,90/0/default.jpg").unlink(),
    "no label": lambda f: broken(f / "icon1/manifest.json", lambda m: m.pop("label")),
    "no canvas": lambda f: broken(f / "icon1/manifest.json", lambda m: m.update(items=[])),
    "no size": lambda f: broken(f / "icon1/manifest.json", lambda m: m["items"][0].update(width=0)),
    "an address elsewhere": lambda f: broken(
        f / "icon2/manifest.json", lambda m: m.update(id="https://evil.example/m.json")
    ),
    "another target": lambda f: broken(
        f / "icon1/manifest.json",
        lambda m: m["items"][0]["items"][0]["items"][0].update(target="https://x/y"),
    ),
    "not listed": lambda f: broken(f / "collection.json", lambda c: c["items"].pop()),
    "level 2": lambda f: broken(f / "icon1/vis/info.json", lambda i: i.update(profile="level2")),
}


@pytest.mark.parametrize("name", BREAKS)
def test_each_broken_rule_is_found(folder, name):
    BREAKS[name](folder / "iiif")
    problems = check_iiif(folder / "iiif", "https://example.org/icons/iiif")
    assert problems and all(p.code == "E_IIIF" and p.field for p in problems)


def test_without_an_address_it_is_that_of_a_server_on_this_machine(database, publish):
    folder = publish(database)
    assert check_iiif(folder / "iiif", LOCAL + "iiif") == []


def test_it_can_be_left_out(database, publish):
    assert not (publish(database, iiif=False) / "iiif").exists()


def test_a_title_that_looks_like_html_is_never_taken_for_it(database, publish):
    from levkas.database.manifest import write_manifest

    evil = "<img src=x onerror=alert(1)>"
    (database / "objects/icon1/object.toml").write_text(
        f'title = "{evil}"\nmedium = "{evil}"\n', encoding="utf-8"
    )
    write_manifest(database)
    folder = publish(database)
    record = json.loads((folder / "iiif/icon1/manifest.json").read_text())
    assert all(v[:1] != "<" for m in record["metadata"] for v in m["value"]["none"])
    assert "<img" not in (folder / "README.md").read_text()
    assert never_html(evil) == " " + evil
    assert hash_tree(folder)
