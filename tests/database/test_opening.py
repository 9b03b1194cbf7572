import json
import shutil
import subprocess
import sys

import numpy as np
import pytest
import xarray

import levkas
from levkas.core.cube import Band, Cube
from levkas.core.digests import hash_file, hash_tree
from levkas.core.problems import Refused
from levkas.core.rounding import round_sigma
from levkas.database.catalogue import COLUMNS, DatabaseRefused, read_catalogue, write_catalogue
from levkas.database.credits import Credits
from levkas.database.layers import Layer, centres_of, write_layer
from levkas.database.spectral_tiff import read_stiff


def cube_of(bands, *, seed=0, sigma=True, shape=(60, 80)):
    rng = np.random.default_rng(seed)
    values = rng.normal(0.5, 0.2, (*shape, len(bands))).astype(np.float32)
    flags = rng.integers(0, 128, values.shape, dtype=np.uint8)
    return Cube(values, flags, 0.01 * np.abs(values) if sigma else None, tuple(bands))


VIS = cube_of([Band(f"{nm} nm", float(nm), 7.0) for nm in range(400, 721, 40)])
RGB = cube_of([Band(c) for c in "RGB"], seed=1)
LAMP = cube_of([Band(c) for c in "RGB"], seed=2, sigma=False)


def build(folder):
    facts = {"px_per_mm": 12.5, "credits": Credits("Ikone", "Müller")}
    jobs = [
        (Layer("icon1", "vis", **facts), VIS),
        (Layer("icon1", "d80", centroids={"R": 600.0, "G": 540.0, "B": 460.0}), RGB),
        (Layer("icon1", "d80", "45-degree"), LAMP),
    ]
    entries = [write_layer(folder, layer, cube)[0] for layer, cube in jobs]
    write_catalogue(folder, entries)
    return folder


@pytest.fixture(scope="module")
def database(tmp_path_factory):
    return build(tmp_path_factory.mktemp("db"))


@pytest.fixture(params=["zarr", "tiff"])
def opened(request, database, tmp_path):
    """The same database with Zarr, and without it."""
    if request.param == "zarr":
        return levkas.open(database)
    shutil.copytree(database / "objects", tmp_path / "objects")
    shutil.copy(database / "catalogue.csv", tmp_path)
    return levkas.open(tmp_path)


def test_a_layer_is_a_lazy_labelled_array(opened):
    cube = opened["icon1"]["vis"]
    assert isinstance(cube, xarray.DataArray)
    assert (cube.dims, cube.shape, cube.dtype) == (("y", "x", "band"), (60, 80, 9), np.float32)
    assert not cube.variable._in_memory
    assert cube.band.values.tolist() == VIS.labels
    assert cube.wavelength.values.tolist() == [b.wavelength for b in VIS.bands]
    assert cube.fwhm.values.tolist() == [7.0] * 9
    assert cube.attrs["quantity"] == "reflectance"
    assert (cube.attrs["object"], cube.attrs["camera"]) == ("icon1", "vis")
    assert cube.attrs["px_per_mm"] == 12.5
    np.testing.assert_array_equal(cube.levkas.flags.values, VIS.flags)
    sigma = cube.sel(band="400 nm")[10:20, 3].levkas.sigma
    np.testing.assert_array_equal(sigma.values, round_sigma(VIS.sigma)[10:20, 3, 0])
    np.testing.assert_array_equal(cube.values, VIS.values)


def test_the_sigma_of_an_older_layer_does_not_stay(tmp_path):
    layer = Layer("icon1", "d80")
    write_layer(tmp_path / "over", layer, RGB)
    for folder in ("over", "afresh"):
        write_layer(tmp_path / folder, layer, LAMP)
    assert hash_tree(tmp_path / "over") == hash_tree(tmp_path / "afresh")


def test_every_way_of_selecting_reads_what_numpy_would(opened):
    cube, whole = opened["icon1"]["vis"], VIS.values
    np.testing.assert_array_equal(cube.sel(band="560 nm").values, whole[:, :, 4])
    np.testing.assert_array_equal(cube[10, 20].values, whole[10, 20])
    np.testing.assert_array_equal(cube[-1, ::-7, [8, 0, 0]].values, whole[-1, ::-7][:, [8, 0, 0]])
    np.testing.assert_array_equal(cube[5:5].values, whole[5:5])
    np.testing.assert_array_equal(
        cube[::3, 4:50:5][1:, ::-1, 2].values, whole[::3, 4:50:5][1:, ::-1, 2]
    )
    rows, columns = xarray.DataArray([3, 50, 3], dims="p"), xarray.DataArray([0, 79, 5], dims="p")
    np.testing.assert_array_equal(cube[rows, columns].values, whole[[3, 50, 3], [0, 79, 5]])
    np.testing.assert_array_equal((cube[:2] * 2).values, whole[:2] * 2)


def spoil_sigma(folder, how):
    """Damage the sigma of icon1/vis, as TIFF and as Zarr."""
    tiff, array = folder / "objects/icon1/icon1_vis.sigma.tif", folder / "zarr/icon1.zarr/vis/sigma"
    if how == "missing":
        tiff.unlink()
        shutil.rmtree(array, ignore_errors=True)
        return
    for path in (tiff, array / "zarr.json"):
        if path.is_file():
            content = path.read_bytes()
            spoilt = content[: len(content) // 2] if how == "cut" else b"no picture" + content[10:]
            path.write_bytes(spoilt)


@pytest.mark.parametrize(
    ("form", "how"),
    [("zarr", "damaged"), ("zarr", "missing"), ("tiff", "cut"), ("tiff", "missing")],
)
def test_a_sigma_that_cannot_be_read_is_refused_and_not_unknown(tmp_path, form, how):
    folder = build(tmp_path)
    if form == "tiff":
        shutil.rmtree(folder / "zarr")
    spoil_sigma(folder, how)
    thing = levkas.open(folder)["icon1"]
    with pytest.raises(Refused):
        _ = thing["vis"].levkas.sigma.values
    assert thing["d80", "45-degree"].levkas.sigma is None


def test_tag_65000_holds_centres_or_centroids_or_numbers(database):
    folder = database / "objects" / "icon1"
    cube, centres, rgb, text = read_stiff(folder / "icon1_vis.tif")
    np.testing.assert_array_equal(cube, VIS.values)
    assert centres.tolist() == [b.wavelength for b in VIS.bands]
    assert rgb.shape == (60, 80, 3)
    assert '"rendering": "sRGB under D65' in text
    cube, centres, _, _ = read_stiff(folder / "icon1_d80.tif")
    assert centres.tolist() == [460.0, 540.0, 600.0]  # by rising wavelength, as the format has it
    np.testing.assert_array_equal(cube, RGB.values[..., ::-1])
    assert centres_of(RGB.bands, {"B": 460.0, "R": 600.0}) == [0, 1, 2]
    mixed = (*RGB.bands, Band("IR", 850.0))
    assert centres_of(mixed, {"R": 600.0, "G": 540.0, "B": 460.0})[2:] == [460.0, 850.0]
    cube, centres, _, text = read_stiff(folder / "icon1_d80_45-degree.tif")
    assert centres.tolist() == [0, 1, 2]
    assert '"bands": ["R", "G", "B"]' in text


def test_the_catalogue_is_read_as_it_was_written(database):
    entries = read_catalogue(database)
    assert [(e.camera, e.setup, e.bands) for e in entries] == [
        ("d80", "", 3),
        ("d80", "45-degree", 3),
        ("vis", "", 9),
    ]
    assert entries[2].sha256 == hash_file(database / "objects/icon1/icon1_vis.tif")
    assert (entries[2].px_per_mm, entries[2].width, entries[2].height) == (12.5, 80, 60)
    assert np.isnan(entries[0].px_per_mm)
    text = (database / "catalogue.csv").read_bytes().decode()
    assert (
        text.splitlines()[0]
        == "object,camera,setup,bands,width,height,px_per_mm,quantity,verdict,sha256"
    )
    assert "\r" not in text


def test_a_damaged_catalogue_lists_all_its_faults(tmp_path):
    rows = [",".join(COLUMNS), "a,b,,x,1,1,,reflectance,accept,0", "a,b"]
    (tmp_path / "catalogue.csv").write_text("\n".join(rows))
    with pytest.raises(DatabaseRefused) as info:
        levkas.open(tmp_path)
    assert [p.field for p in info.value.problems] == ["line 2", "line 3"]


def test_two_builds_write_the_same_bytes(database, tmp_path, monkeypatch):
    monkeypatch.setenv("LEVKAS_THREADS", "1")
    assert hash_tree(build(tmp_path)) == hash_tree(database)


def test_a_spectrum_is_read_without_loading_what_only_writing_needs(tmp_path):
    build(tmp_path / "db")
    code = (
        "import sys; sys.modules['dask'] = None\n"  # where it is installed xarray loads scipy by it
        "import levkas; levkas.open(sys.argv[1])['icon1']['vis'][3, 4].values\n"
        "print([m for m in ('numba', 'scipy', 'imagecodecs', 'cv2') if m in sys.modules])"
    )
    command = [sys.executable, "-c", code, str(tmp_path / "db")]
    run = subprocess.run(command, capture_output=True, text=True, check=True)
    assert run.stdout.strip() == "[]"


@pytest.mark.parametrize("name", ["band", "wavelength", "values"])
def test_pixels_and_labels_that_are_damaged_or_missing_are_refused(tmp_path, name):
    build(tmp_path / "db")
    chunk = tmp_path / "db/zarr/icon1.zarr/vis" / name / ("c/0/0/0" if name == "values" else "c/0")
    data = bytearray(chunk.read_bytes())
    data[len(data) // 2] ^= 1
    chunk.write_bytes(data)
    with pytest.raises(DatabaseRefused):
        _ = levkas.open(tmp_path / "db")["icon1"].dataset("vis")[name].values
    chunk.unlink()
    with pytest.raises(DatabaseRefused) as refused:
        _ = levkas.open(tmp_path / "db")["icon1"].dataset("vis")[name].values
    assert refused.value.problems[0].file == str(chunk)


@pytest.mark.parametrize(
    "change",
    [
        lambda r: r["codecs"].append({"name": "numcodecs.lzma", "configuration": {}}),
        lambda r: r.update(codecs=[r["codecs"][0]] * 40),
        lambda r: r.update(storage_transformers=[{"name": "elsewhere"}]),
    ],
)
def test_only_listed_codecs_and_types_of_zarr_are_read(database, tmp_path, change):
    shutil.copytree(database, tmp_path / "db")
    path = tmp_path / "db/zarr/icon1.zarr/vis/values/zarr.json"
    record = json.loads(path.read_text())
    change(record)
    path.write_text(json.dumps(record))
    with pytest.raises(DatabaseRefused):
        levkas.open(tmp_path / "db")["icon1"]["vis"].values  # noqa: B018 -- reads
