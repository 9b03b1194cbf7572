"""OME-Zarr scenes: where they say that native pixels lie, by code that knows numpy and Zarr alone."""

import json
import shutil

import cv2
import ngff_zarr
import numpy as np
import pytest
import zarr

from levkas.core.cube import Band, Cube
from levkas.core.digests import hash_tree
from levkas.core.disk import WriteRefused
from levkas.core.problems import Refused
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer, write_tiffs
from levkas.database.pixel_frames import map_points
from levkas.database.spectral_tiff import read_tiff_pages
from levkas.geometry.grid import Grid
from levkas.geometry.transforms import Affine, Composed, Homography, Lens
from levkas.publish.export import export

from .rfc5 import lead

SIZES = {"photo": (420, 340), "ir": (700, 530)}
TOLERANCE_PX = 0.011
"""0.01 px of the grid is what a field may be off by in the middle of a cell; the rest is float32."""
TILTED = Homography(np.array([[1.61, 0.05, 12.0], [-0.04, 1.53, 6.0], [2e-5, -3e-5, 1.0]]))


def lens(k):
    return Lens(np.array([350.0, 265.0]), 350.0, radial=(k, 0.004))


MAPS = {
    "photo": dict.fromkeys("RGB", Affine.identity()),
    "ir": {
        "850 nm": Composed(TILTED, lens(-0.02)),
        "900 nm": Composed(TILTED, lens(-0.02)),
        "940 nm": Composed(TILTED, lens(-0.021)),
    },
}


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    """Two cameras with native pixels, registered by maps that are written down; the grid is turned and finer than the reference."""
    root = tmp_path_factory.mktemp("scene") / "database"
    grid = Grid(SIZES["photo"], rotate=90, output=(510, 630))
    rng, entries = np.random.default_rng(8), []
    for camera, maps in MAPS.items():
        waves = [float(b.split()[0]) if b[0].isdigit() else np.nan for b in maps]
        bands = tuple(Band(label, wave) for label, wave in zip(maps, waves, strict=True))
        quantity = "counts" if camera == "photo" else "reflectance"
        for size, write in ((grid.size, "layer"), (SIZES[camera], "native")):
            values = rng.random((size[1], size[0], 3), np.float32)
            cube = Cube(values, np.zeros(values.shape, np.uint8), None, bands, quantity)
            layer = Layer("icon1", camera, "", px_per_mm=5.0)
            if write == "layer":
                entries.append(write_layer(root, layer, cube)[0])
            else:
                folder = root / "objects/icon1/native"
                folder.mkdir(parents=True, exist_ok=True)
                write_tiffs(folder / f"icon1_{camera}", layer, cube)
        target = {"camera": camera, "setup": "", "band": next(iter(maps))}
        record = {
            "object": "icon1", "camera": camera, "setup": "", "method": "levkas",
            "reference": {"camera": "photo", "setup": "", "band": "G"}, "target": target,
            "grid": {"transform": grid.transform.to_dict(), "size": list(grid.size), "px_per_mm": 5.0},
            "verdict": {"decision": "accept", "reasons": [], "next_step": "", "numbers": {}},
            "bands": {band: {"transform": one.to_dict(), "size": list(SIZES[camera])}
                      for band, one in maps.items()},
        }  # fmt: skip
        folder = root / "objects/icon1/registration"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{camera}.json").write_text(json.dumps(record))
    write_catalogue(root, entries)
    return root


@pytest.fixture(scope="module")
def scene(database, tmp_path_factory):
    folder = tmp_path_factory.mktemp("out")
    (step,) = (s for s in export(database, "ngff", output=folder) if s.files)
    assert [path.name for path in step.files] == ["icon1.ome.zarr"]
    return step.files[0]


def read(scene):
    root = zarr.open_group(scene, mode="r")
    ome = root.attrs["ome"]
    assert ome["version"] == "0.6"
    return root, ome["scene"]


def images_of(root):
    """Where each band lies: its frame as `levkas map` calls it, its image and its channel."""
    return [
        (f"{root[path].attrs['ome']['multiscales'][0]['name'].partition(':')[0]}:{c['label']}", path, i)
        for path in root.group_keys()
        if "ome" in root[path].attrs
        for i, c in enumerate(root[path].attrs["ome"]["omero"]["channels"])
    ]  # fmt: skip


def test_transformations_as_written_lead_where_levkas_map_leads_there_and_back(database, scene):
    root, described = read(scene)
    bands = images_of(root)
    assert sorted(frame for frame, _, _ in bands) == sorted(
        f"{camera}:{band}" for camera, maps in MAPS.items() for band in maps
    )
    rng = np.random.default_rng(2)
    for frame, path, channel in bands:
        size = np.array(SIZES[frame.partition(":")[0]])
        native = rng.uniform(-0.4, size - 0.6, (3000, 2))
        truth = map_points(database, "icon1", native, source=frame, target="grid")
        seen = np.isfinite(truth).all(1)
        assert seen.sum() > 1000
        points = np.column_stack([np.full(len(native), float(channel)), native[:, ::-1]])[seen]
        native = path, "native"
        there = lead(root, described, points, native, "grid")
        assert np.array_equal(there[:, 0], points[:, 0])
        assert np.abs(there[:, :0:-1] - truth[seen]).max() < TOLERANCE_PX
        back = lead(root, described, there, "grid", native)
        # 1.8 px of the infrared frame lie on a pixel of the grid, and both ways have their error.
        assert np.abs(back - points).max() < 4 * TOLERANCE_PX


def test_pixels_are_the_native_ones_and_halves_lie_in_the_middle_of_theirs(database, scene):
    root, _ = read(scene)
    for frame, path, channel in images_of(root):
        camera, _, label = frame.partition(":")
        labels = list(MAPS[camera])
        cube = read_tiff_pages(database / f"objects/icon1/native/icon1_{camera}.tif")
        plane = root[path]["0"][channel]
        assert np.array_equal(plane, cube[..., labels.index(label)])
        (one,) = root[path].attrs["ome"]["multiscales"]
        for dataset in one["datasets"][1:]:
            scale, shift = (
                list(t.values())[1]
                for t in dataset["coordinateTransformations"][0]["transformations"]
            )
            level = root[path][dataset["path"]]
            n = round(scale[2])
            assert np.allclose(level[channel][0, 0], plane[:n, :n].mean(), rtol=1e-5)
            assert shift == [0.0, (n - 1) / 2, (n - 1) / 2]  # the mean of 0 … n - 1


def test_bands_that_share_a_map_are_one_image_and_the_grid_is_known_in_millimetres(scene):
    root, described = read(scene)
    assert {path for _, path, _ in images_of(root)} == {"photo", "ir_band-001", "ir_band-003"}
    assert root["ir_band-001/0"].shape[0] == 2 and root["photo/0"].shape == (3, 340, 420)
    pixel = [[1.0, 10.0, 15.0]]
    assert np.allclose(lead(root, described, pixel, "grid", "object"), [[1.0, 2.0, 3.0]])


def test_a_scene_is_replaced_as_a_whole_only_where_that_is_asked_for(database, tmp_path):
    def write(**options):
        return [p for s in export(database, "ngff", output=tmp_path, **options) for p in s.files]

    (path,) = write(cameras=["ir"])
    (path / "notes.txt").write_text("three years")
    with pytest.raises(WriteRefused):
        write()
    assert hash_tree(write(overwrite=True)[0]) == hash_tree(write(overwrite=True)[0])
    assert not (path / "notes.txt").exists()


def test_a_database_without_native_pixels_is_refused_with_the_key_that_keeps_them(
    database, tmp_path
):
    bare = shutil.copytree(database, tmp_path / "bare")
    shutil.rmtree(bare / "objects/icon1/native")
    with pytest.raises(Refused) as refused:
        list(export(bare, "ngff", output=tmp_path / "out"))
    assert refused.value.problems[0].fix
    assert not list((tmp_path / "out").glob("*.ome.zarr"))


@pytest.mark.slow
def test_native_pixels_are_calibrated_where_the_campaign_is_given(make_plates, tmp_path):
    from levkas.building import build

    folder = make_plates(tmp_path / "campaign", ("one",))
    list(build(folder))
    with pytest.raises(Refused):
        list(export(folder / "database", "ngff", output=tmp_path / "out"))
    before = hash_tree(folder / "database")
    files = [p for s in export(folder, "ngff", output=tmp_path / "out") for p in s.files]
    root = zarr.open_group(files[0], mode="r")
    (raw,) = (folder / "photo").glob("one.*")
    picture = cv2.imread(str(raw))[..., ::-1]
    photo = {label: root[path]["0"][i] for frame, path, i in images_of(root)
             for camera, _, label in [frame.partition(":")] if camera == "photo"}  # fmt: skip
    assert np.array_equal(np.dstack([photo[c] for c in "RGB"]), picture)
    assert hash_tree(folder / "database") == before


def test_another_library_finds_the_scene_valid_and_its_pixels_and_names(database, scene):
    read = ngff_zarr.from_ome_zarr(str(scene), kind="scene", validate=True)
    assert sorted(read.images) == ["ir_band-001", "ir_band-003", "photo"]
    for path, found in read.images.items():
        camera = path.partition("_")[0]
        cube = read_tiff_pages(database / f"objects/icon1/native/icon1_{camera}.tif")
        labels = [channel.label for channel in found.metadata.omero.channels]
        assert list(found.images[0].dims) == ["c", "y", "x"] and set(labels) <= set(MAPS[camera])
        for k, label in enumerate(labels):
            pixel = found.images[0].data[k, 205, 111]
            assert float(pixel) == cube[205, 111, list(MAPS[camera]).index(label)]
