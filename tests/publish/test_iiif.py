import io
import json

import iiif_prezi3
import numpy as np
import pytest
from PIL import Image

from levkas.publish.iiif import cut_tiles, never_html
from levkas.publish.publication import LOCAL


def tile_names(info):
    """Yield every tile that a viewer may ask for, as the Image API lays them out."""
    width, height, (tiles,) = info["width"], info["height"], info["tiles"]
    side = tiles["width"]
    for factor in tiles["scaleFactors"]:
        for y in range(0, height, side * factor):
            for x in range(0, width, side * factor):
                w, h = min(side * factor, width - x), min(side * factor, height - y)
                region = "full" if (w, h) == (width, height) else f"{x},{y},{w},{h}"
                yield f"{region}/{-(-w // factor)},{-(-h // factor)}/0/default.jpg"


@pytest.fixture(scope="module")
def picture():
    y, x = np.mgrid[0:701, 0:1103]
    return np.stack([x % 256, y % 256, (x + y) // 8 % 256], -1).astype(np.uint8)


@pytest.mark.parametrize("size", [(1103, 701), (513, 100), (1, 1)])
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


def addresses(record):
    """Every id of a record that is an address."""
    if isinstance(record, list):
        return [found for part in record for found in addresses(part)]
    if not isinstance(record, dict):
        return []
    own = [record[k] for k in ("id", "@id") if str(record.get(k, "")).startswith("http")]
    return own + [found for part in record.values() for found in addresses(part)]


@pytest.mark.parametrize("url", ["https://example.org/icons/", ""])
def test_all_addresses_are_below_the_one_that_was_given_and_lead_to_files(database, publish, url):
    folder = publish(database, url=url)
    base = url or LOCAL
    for path in sorted(folder.glob("iiif/**/*.json")):
        record = json.loads(path.read_text())
        assert record["id"].startswith(base) and record["type"]
        for one in addresses(record):
            if not one.startswith(base):
                assert one.startswith(("https://creativecommons.org", "http://creativecommons.org"))
                continue
            inside = folder / one.removeprefix(base).partition("#")[0]
            assert inside.exists() or "/canvas" in one or "/page" in one or "/annotation" in one, (
                one
            )
        if path.name == "info.json":
            assert record["profile"] == "level0"
            assert all((path.parent / name).is_file() for name in tile_names(record))
    text = (folder / "iiif/icon1/manifest.json").read_text()
    assert '"rights": "http://creativecommons.org/licenses/by/4.0/"' in text
    listed = json.loads((folder / "iiif/collection.json").read_text())["items"]
    assert [one["id"] for one in listed] == [
        f"{base}iiif/{name}/manifest.json" for name in ("icon1", "icon2")
    ]


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
