import json
import sys
from typing import get_args, get_type_hints

import numpy as np
import pytest
import rasterio
import spectral
import tifffile
import xarray
from PIL import Image
from typer.testing import CliRunner

import levkas
from levkas.cli import app
from levkas.cli.publish import export as command
from levkas.database.spectral_tiff import read_tiff_pages
from levkas.publish.export import export
from levkas.publish.export.layer import ExportLayer, ExportRefused
from levkas.publish.export.run import FORMS

WAVES = (420.0, 500.5, 610.0, 700.0)


def truth(database, stem="icon1_vis", kind=""):
    name = stem.split("_")[0]
    return read_tiff_pages(database / f"objects/{name}/{stem}{kind}.tif")


def exported(database, form, folder):
    return [path for step in export(database, form, output=folder) for path in step.files]


def same(one, other):
    assert one.dtype == other.dtype
    assert np.array_equal(one, other, equal_nan=one.dtype.kind == "f")


def test_envi_is_read_by_spectral_python_and_by_our_own_reader(database, tmp_path):
    from levkas.readers.frames import read_facts, read_frame

    exported(database, "envi", tmp_path)
    image = spectral.open_image(str(tmp_path / "icon1_vis.hdr"))
    same(np.asarray(image.load()), truth(database))
    assert image.bands.centers == list(WAVES) and image.bands.bandwidths == [10.0] * 4
    assert image.metadata["band names"][1] == "500.5 nm"
    same(np.asarray(image[5, 7]).ravel(), truth(database)[5, 7])
    same(np.asarray(read_frame(tmp_path / "icon1_vis.hdr")), truth(database))
    assert list(read_facts(tmp_path / "icon1_vis.hdr").wavelengths) == list(WAVES)
    flags = spectral.open_image(str(tmp_path / "icon1_vis_flags.hdr"))
    same(np.asarray(flags.open_memmap()), truth(database, kind=".flags"))
    assert "wavelength" not in spectral.open_image(str(tmp_path / "icon1_rgb.hdr")).metadata


def test_gdal_leaves_out_of_an_envi_export_what_lies_outside_the_frame(database, tmp_path):
    exported(database, "envi", tmp_path)
    for kind in ("", "_sigma"):
        with rasterio.open(tmp_path / f"icon1_vis{kind}.img") as image:
            assert np.isnan(image.nodata)
            same(image.read_masks(1) > 0, np.isfinite(truth(database, kind=".sigma")[..., 0]))
    with rasterio.open(tmp_path / "icon1_vis_flags.img") as image:
        assert image.nodata is None


def test_photoshop_gets_a_layer_a_camera_with_its_name_and_coverage(database, tmp_path):
    psd = pytest.importorskip("psdtags")
    exported(database, "photoshop", tmp_path)
    path = tmp_path / "icon1_layers.tif"
    layers = psd.TiffImageSourceData.fromtiff(path).layers.layers
    assert [layer.name for layer in layers] == ["rgb", "rgb soft", "vis"]
    published = np.asarray(Image.open(database / "objects/icon1/icon1_vis.png").convert("RGB"))
    alpha, *colours = (channel.data for channel in layers[2].channels)
    np.testing.assert_array_equal(np.dstack(colours), published)
    assert (alpha[:2, :3] == 0).all() and (alpha[2:] == 255).all()
    assert {(one.rectangle.top, one.rectangle.left) for one in layers} == {(0, 0)}
    beneath = np.asarray(Image.open(path))  # what programs without layers show: the first
    np.testing.assert_array_equal(
        beneath, np.asarray(Image.open(database / "objects/icon1/icon1_rgb.png").convert("RGB"))
    )
    with tifffile.TiffFile(path) as tiff:
        assert b"sRGB" in tiff.pages[0].iccprofile and tiff.pages[0].tags["XResolution"].value == (
            40,
            1,
        )
    assert sorted(p.name for p in tmp_path.glob("*.tif")) == [
        "icon1_layers.tif",
        "icon2_layers.tif",
    ]


def by_gdal(folder, form, stem, kind):
    """Read a layer as GDAL, QGIS and rasterio do: pixels, the pixel at a place in mm, and what the bands are called."""
    tail = "" if kind == "values" else f"_{kind}"
    name = {
        "netcdf": f"netcdf:{folder / stem}.nc:{kind}",
        "qgis": f"{folder / stem}{tail}.tif",
        "envi": f"{folder / stem}{tail}.img",
    }[form]
    with rasterio.open(name) as image:
        pixels = np.moveaxis(image.read(), 0, 2)
        labels, tags = image.descriptions, [image.tags(k) for k in image.indexes]
        centres = [tag.get("wavelength", tag.get("NETCDF_DIM_band")) for tag in tags]
        if form == "netcdf" and stem.endswith("rgb"):
            labels = image.tags()["band#flag_meanings"].split()
        elif form == "netcdf":
            assert image.tags()["band#units"] == "nm"
            labels = [f"{centre} nm" for centre in centres]
        if form == "envi":  # without a place: rows are counted from the top
            return pixels, None, [label.partition(" (")[0] for label in labels], centres
        return pixels, image.index(7 * 0.25, -5 * 0.25), list(labels), centres


@pytest.mark.parametrize("form", ["netcdf", "qgis", "envi"])
@pytest.mark.parametrize(("camera", "labels"), [("vis", WAVES), ("rgb", "RGB")])
def test_gdal_shows_each_export_upright_with_places_names_and_wavelengths(
    database, tmp_path, form, camera, labels
):
    exported(database, form, tmp_path)
    for kind in ("values", "flags", "sigma"):
        there = truth(database, f"icon1_{camera}", "" if kind == "values" else f".{kind}")
        pixels, place, names, centres = by_gdal(tmp_path, form, f"icon1_{camera}", kind)
        same(pixels, there)
        assert place in (None, (5, 7))
        assert names == [f"{one:g} nm" if camera == "vis" else one for one in labels]
        if camera == "vis":
            assert [*map(float, centres)] == list(WAVES)


@pytest.mark.parametrize("camera", ["vis", "rgb"])
def test_xarray_finds_labels_wavelengths_and_places_in_a_netcdf(database, tmp_path, camera):
    exported(database, "netcdf", tmp_path)
    path = tmp_path / f"icon1_{camera}.nc"
    there = {
        kind: truth(database, f"icon1_{camera}", end)
        for kind, end in {"values": "", "flags": ".flags", "sigma": ".sigma"}.items()
    }
    with xarray.open_dataset(path, engine="h5netcdf") as dataset:
        for kind, cube in there.items():
            same(dataset[kind].transpose("y", "x", "band").values, cube)
        pixel = dataset["values"].sel(x=7 * 0.25, y=-5 * 0.25)
        assert np.array_equal(pixel.values, there["values"][5, 7])
        names, centres = dataset["label"].values.tolist(), dataset["wavelength"].values
        assert names == [f"{one:g} nm" for one in WAVES] if camera == "vis" else names == [*"RGB"]
        assert centres.tolist() == list(WAVES) if camera == "vis" else np.isnan(centres).all()
        assert list(dataset["flags"].attrs["flag_masks"]) == [1, 2, 4, 8, 16, 32, 64, 128]


def test_the_command_offers_every_form():
    assert get_args(get_type_hints(command)["form"]) == tuple(FORMS)


def test_only_what_was_asked_for_is_written(database, tmp_path):
    words = f"--for envi --object icon1 --camera rgb -o {tmp_path} --json"
    result = CliRunner().invoke(app, ["export", str(database), *words.split()])
    record = json.loads(result.stdout)
    assert result.exit_code == 0 and record["ok"]
    written = [f.split("/")[-1] for f in record["files"]]
    assert {"icon1_rgb.img", "icon1_rgb_soft.img"} <= {*written}
    assert all(name.startswith("icon1_rgb") for name in written)


@pytest.mark.parametrize("wrong", [{"objects": ["icon9"]}, {"cameras": ["d80"]}])
def test_an_unknown_name_is_refused_with_those_there_are(database, tmp_path, wrong):
    with pytest.raises(ExportRefused) as refused:
        list(export(database, "envi", output=tmp_path, **wrong))
    assert refused.value.problems[0].expected in ("icon1, icon2", "rgb, vis")


def test_an_export_into_the_database_is_refused(database):
    with pytest.raises(ExportRefused) as refused:
        list(export(database, "envi", output=database / "envi"))
    assert refused.value.problems[0].code == "E_UNWRITABLE"


def test_hostile_band_labels_do_not_break_a_header(database):
    from levkas.publish.export.envi import spell_header
    from levkas.publish.export.qgis import spell_metadata

    layer = ExportLayer.read(database, "icon1", "rgb", "")
    bands = tuple(levkas.Band(t) for t in ("R}\nbands = 9", "<b>&\x07", 'G,"'))
    hostile = ExportLayer("icon1", "rgb", "", bands, layer.facts, layer.path)
    text = spell_header(hostile, "values", 4)
    assert text.count("}") == 3 and text.count("\nbands = ") == 1
    import xml.etree.ElementTree as ElementTree

    items = ElementTree.fromstring(spell_metadata(hostile))
    assert len([i for i in items if i.get("role") == "description"]) == 3


@pytest.mark.parametrize(("form", "library"), [("netcdf", "h5netcdf"), ("photoshop", "psdtags")])
def test_a_library_that_is_missing_is_named_with_what_to_install(
    database, tmp_path, monkeypatch, form, library
):
    monkeypatch.setitem(sys.modules, library, None)
    with pytest.raises(ExportRefused) as refused:
        list(export(database, form, output=tmp_path))
    assert library in str(refused.value.problems[0])
