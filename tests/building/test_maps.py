"""A campaign with a stack of element maps beside a photograph is built without a click."""

import shutil

import cv2
import numpy as np
import pytest
import tifffile
from cameras import developed
from scipy import ndimage

import levkas
from levkas.building import build, summarise
from levkas.core.text import read_json

CAMPAIGN = """
[campaign]
reference = {{ camera = "photo", band = "G" }}
[cameras.photo]
kind = "image"
files = "photo/{{target}}.png"
[cameras.cam]
kind = "maps"
files = "xrf/{{target}}.{suffix}"
[targets]
objects = ["icon1"]
"""
COARSE, NAMES = 8, ("Pb_L", "Hg_L", "Cu_K", "Ar_K")


def paint():
    """Four pigments in patches, (4, h, w) of 0 and 1."""
    rng = np.random.default_rng(3)
    fields = [
        sum(ndimage.gaussian_filter(rng.normal(size=(720, 900)), s) * s for s in (7, 20, 50))
        for _ in range(4)
    ]
    return (np.stack(fields).argmax(0) == np.arange(4)[:, None, None]).astype(float)


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A photograph of 900 x 720 px, and four maps of it of 112 x 90 px, of which one holds noise."""
    folder, rng, layers = tmp_path_factory.mktemp("maps"), np.random.default_rng(1), paint()
    for part in ("photo", "xrf"):
        (folder / part).mkdir()
    tones = np.array([[0.75, 0.5, 0.2, 0.1], [0.7, 0.2, 0.4, 0.1], [0.65, 0.15, 0.3, 0.12]])
    colours = np.moveaxis(np.einsum("ck,khw->chw", tones, layers), 0, -1)
    colours *= 1 + rng.normal(0, 0.03, colours.shape)
    codes = (255 * colours.clip(0, 1)).astype(np.uint8)
    cv2.imwrite(str(folder / "photo/icon1.png"), codes)
    blocks = layers[:3, :720, :896].reshape(3, 90, COARSE, 112, COARSE).mean((2, 4))
    maps = rng.poisson(15 * (0.2 + np.concatenate([blocks, 0 * blocks[:1]]))).astype(np.float32)
    stack = {"photometric": "minisblack", "metadata": None}
    tifffile.imwrite(folder / "xrf/icon1.tif", maps, **stack)
    named = f'tif"\nbands = {list(NAMES)}'
    (folder / "campaign.toml").write_text(CAMPAIGN.replace('{suffix}"', named).format())
    return folder


@pytest.fixture(scope="module")
def files(campaign, tmp_path_factory):
    """The same maps in a file each: ``Pb_L.tif``, ``Hg_L.tif`` and so on in the object's folder."""
    folder = tmp_path_factory.mktemp("files")
    (folder / "xrf/icon1").mkdir(parents=True)
    for name, plane in zip(NAMES, tifffile.imread(campaign / "xrf/icon1.tif"), strict=True):
        cv2.imwrite(str(folder / f"xrf/icon1/{name.replace('_', '-')}.tif"), plane)
    (folder / "photo").symlink_to(campaign / "photo")
    text = CAMPAIGN.format(suffix="tif").replace("{target}.tif", "{target}/{band}.tif")
    (folder / "campaign.toml").write_text(text)
    return folder


def test_maps_in_a_file_each_are_those_of_a_stack(campaign, files):
    whole, apart = (developed(folder, "icon1").cube for folder in (campaign, files))
    names = [band.label.replace("-", "_") for band in apart.bands]
    order = [names.index(name) for name in NAMES]
    np.testing.assert_array_equal(apart.values[..., order], whole.values)
    assert tuple(whole.labels) == NAMES


def test_a_map_of_another_size_is_refused_by_its_name(files, tmp_path):
    (tmp_path / "xrf").mkdir()
    shutil.copytree(files / "xrf/icon1", tmp_path / "xrf/icon1")
    shutil.copytree(files / "photo", tmp_path / "photo")
    shutil.copy(files / "campaign.toml", tmp_path)
    cv2.imwrite(str(tmp_path / "xrf/icon1/Hg-L.tif"), np.ones((90, 111), np.float32))
    assert "Hg-L" in developed(tmp_path, "icon1").problems[0].file


@pytest.mark.slow
def test_a_stack_of_maps_is_built_on_to_the_photograph(campaign):
    report = summarise(build(campaign))
    assert report.ok, report.text
    record = read_json(campaign / "database/objects/icon1/registration/cam.json")
    assert record["verdict"]["decision"] != "refuse"
    maps = [band["transform"] for band in record["bands"].values()]
    assert len(maps) == 4 and all(one == maps[0] for one in maps)
    layer = levkas.open(campaign / "database")["icon1"]["cam"]
    assert layer.values.shape[-2:] == (720, 900) or layer.values.shape[:2] == (720, 900)
    from levkas.geometry import from_dict

    points = np.array([[100.0, 100.0], [450.0, 350.0], [800.0, 600.0]])
    expected = (points + 0.5) / COARSE - 0.5
    errors = np.linalg.norm(from_dict(maps[0])(points) - expected, axis=1)
    assert errors.max() < 0.3
