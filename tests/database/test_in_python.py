"""What a person does with a layer in a notebook: colours, differences, spectral angle, its picture; and the paths that open it."""

import colour
import numpy as np
import pytest
import xarray
from PIL import Image

import levkas
from levkas.core.cube import Band, Cube
from levkas.core.problems import Refused
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.validation import validate

NM = np.arange(400.0, 701.0, 20.0)
AZURITE = 0.1 + 0.5 * np.exp(-0.5 * ((NM - 470) / 40) ** 2)
OCHRE = 0.05 + 0.6 / (1 + np.exp(-(NM - 580) / 20))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory):
    """A campaign folder with a built database: azurite left, ochre right; and a colour camera with its sensitivities."""
    folder = tmp_path_factory.mktemp("campaign")
    (folder / "campaign.toml").write_text(
        '[campaign]\nreference = { camera = "vis" }\noutput = "out"\n'
        '[cameras.vis]\nkind = "cube"\nfiles = "{target}.hdr"\n[targets]\nobjects = ["panel"]\n'
    )
    values = np.where(np.arange(30)[None, :, None] < 15, AZURITE, OCHRE) * np.ones((20, 1, 1))
    flags = np.zeros(values.shape, np.uint8)
    flags[:2] = levkas.Flag.SATURATED
    narrow = tuple(Band(f"{nm:g} nm", float(nm)) for nm in NM)
    broad = tuple(Band(c) for c in "RGB")
    jobs = [("vis", values, flags, narrow), ("d80", values[..., :3], flags[..., :3], broad)]
    rows = [
        write_layer(folder / "out", Layer("panel", name, px_per_mm=10.0), Cube(v.astype(np.float32), f, None, bands), verdict="warn")[0]
        for name, v, f, bands in jobs
    ]  # fmt: skip
    write_catalogue(folder / "out", rows)
    place = folder / "out/cameras/d80"
    place.mkdir(parents=True)
    lines = [
        f"{nm}," + ",".join(str(float(abs(nm - at) <= 30)) for at in (620, 540, 460))
        for nm in range(400, 701, 10)
    ]
    (place / "sensitivity.csv").write_text("\n".join(["nm,R,G,B", *lines, ""]))
    return folder


@pytest.fixture
def panel(campaign):
    return levkas.open(campaign)["panel"]


def test_a_campaign_s_folder_and_file_mean_its_database(campaign):
    one = levkas.open(campaign / "out")
    for path in (campaign, str(campaign), campaign / "campaign.toml"):
        assert levkas.open(path).path == one.path.resolve()
        assert validate(path).checked == validate(campaign / "out").checked > 0
    with pytest.raises(Refused):
        levkas.open(campaign / "nothing")


def test_a_difference_is_between_places_and_with_a_library(panel):
    layer = panel["vis"]
    assert float(layer.levkas.delta_e(layer).max()) == 0.0
    moved = layer[:, ::-1].assign_coords(x=layer.x.values)
    apart = layer.levkas.delta_e(moved)
    pair = colour.delta_E(layer.levkas.lab()[5, 3].values, layer.levkas.lab()[5, 20].values)
    np.testing.assert_allclose(apart.values, pair, rtol=1e-6)
    assert layer[4:9].levkas.delta_e(moved).sizes == {"y": 5, "x": 30}


def test_the_spectral_angle_finds_the_pigment_at_any_level(panel):
    coords = {"spectrum": ["azurite"], "wavelength": np.arange(390.0, 691.0, 1.0)}
    fine = np.interp(coords["wavelength"], NM, 0.3 * AZURITE)
    angle = panel["vis"].levkas.spectral_angle(
        xarray.DataArray(fine[None], coords, ("spectrum", "wavelength"))
    )
    assert angle.dims == ("y", "x") and float(angle[:, :15].max()) < 1e-3
    known = NM <= 690
    expected = np.arccos(
        AZURITE[known]
        @ OCHRE[known]
        / np.linalg.norm(AZURITE[known])
        / np.linalg.norm(OCHRE[known])
    )
    np.testing.assert_allclose(angle[:, 15:].values, expected, rtol=1e-3)
    same = panel["vis"].levkas.spectral_angle(panel["vis"].isel(y=4, x=20))
    assert float(same[:, 15:].max()) < 1e-3 < float(same[:, :15].min())


def test_a_rendering_is_the_published_picture_and_bands_without_colour_are_refused(panel, campaign):
    layer = panel["vis"]
    shown = layer.levkas.render()
    with Image.open(campaign / "out/objects/panel/panel_vis.png") as picture:
        assert np.abs(shown.values.astype(int) - np.asarray(picture)).max() <= 1
    assert layer.isel(x=3).levkas.render("A").dims == ("y", "rgb")
    for wrong in (panel["d80"], layer[:, :, :2]):
        with pytest.raises(Refused):
            wrong.levkas.lab()


def test_channels_have_the_width_of_their_sensitivity(panel):
    np.testing.assert_allclose(panel["d80"].fwhm.values, [70.0, 70.0, 70.0])
    assert np.isnan(panel["vis"].fwhm.values).all()
    np.testing.assert_allclose(panel["d80"].levkas.flags.fwhm.values, [70.0, 70.0, 70.0])


def test_a_dataset_says_where_on_the_object_in_mm(panel):
    from rasterio.crs import CRS

    data = panel.dataset("vis").isel(x=slice(10, 15))
    assert data.x_mm.values.tolist() == [1.0, 1.1, 1.2, 1.3, 1.4]
    assert data["values"].attrs["grid_mapping"] == "grid: x_mm y_mm"
    assert "grid of the object" in CRS.from_wkt(data["grid"].attrs["crs_wkt"]).to_wkt()
