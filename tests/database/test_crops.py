"""A crop of a layer knows where in the grid it lies: its maps and regions are those of the whole there, or are refused."""

import pickle

import numpy as np
import pytest
import xarray

import levkas
from levkas.core.cube import Band, Cube
from levkas.core.files import write_json
from levkas.database.catalogue import write_catalogue
from levkas.database.layers import Layer, write_layer
from levkas.database.regions import RegionRefused
from levkas.geometry.transforms import Affine, Composed

SHAPE = (60, 80, 3)
GRID = Composed(Affine(np.array([[0.0, 1, 5], [-1, 0, 90]])), Affine.scaling(2.0))
NIR = Affine(np.array([[1.7, 0.1, 12], [-0.1, 1.6, 9]]))


@pytest.fixture(scope="module")
def layers(tmp_path_factory):
    """An object on a turned grid by two cameras."""
    folder, rng = tmp_path_factory.mktemp("crops"), np.random.default_rng(3)
    reference = {"camera": "vis", "band": "550 nm", "size": [600, 600]}
    entries = []
    for camera, native in (("vis", Affine.identity()), ("nir", NIR)):
        bands = tuple(Band(f"{nm} nm", float(nm)) for nm in (450, 550, 650))
        values = (0.4 + 0.1 * rng.standard_normal(SHAPE)).astype(np.float32)
        flags = (rng.random(SHAPE) < 0.05).astype(np.uint8) * 2
        cube = Cube(values, flags, np.abs(values) / 50, bands, "reflectance")
        entries.append(write_layer(folder, Layer("icon1", camera), cube)[0])
        record = {
            "reference": reference, "target": f"{camera}:550 nm", "camera": camera,
            "verdict": {"decision": "accept", "reasons": []},
            "bands": {band.label: {"transform": native.to_dict(), "size": [1600, 1600]} for band in bands},
            "grid": {"transform": GRID.to_dict(), "size": [80, 60]},
        }  # fmt: skip
        write_json(folder / f"objects/icon1/registration/{camera}.json", record)
    write_catalogue(folder, entries)
    return levkas.open(folder)["icon1"]


POINTS = np.array([[3.0, 4.0], [0.0, 0.0], [2.5, 7.25]])


POLYGON = [(22.5, 12.0), (44.0, 14.0), (30.0, 34.5)]
CROPS = {
    "crop": lambda a: a[10:40, 20:50],
    "of a crop": lambda a: a.isel(x=slice(20, None)).isel(x=slice(3, None), y=slice(5, 30)),
    "thinned": lambda a: a.isel(x=slice(20, 60, 2), y=slice(10, 50, 3)),
    "turned": lambda a: a.isel(x=slice(50, 20, -1), y=slice(10, 40)),
    "uneven": lambda a: a.isel(x=[21, 25, 28, 40], y=[11, 13, 30]),
    "a band": lambda a: a.isel(band=0, x=slice(20, 50), y=slice(10, 40)),
    "pickled": lambda a: pickle.loads(pickle.dumps(a.isel(x=slice(20, 50), y=slice(10, 40)))),
}


@pytest.mark.parametrize("crop", CROPS)
def test_places_are_the_x_and_y_of_the_array(layers, crop):
    part, record = CROPS[crop](layers["vis"]), layers["vis"].levkas.transform("grid", "nir")
    x, y = (a.ravel() for a in np.meshgrid(part.x.values, part.y.values))
    places = np.stack([x, y], 1).astype(float)
    there = part.levkas.transform("grid", "nir")(places)
    np.testing.assert_allclose(there, record(places), atol=1e-9)
    assert np.isfinite(there).all()
    np.testing.assert_allclose(part.levkas.transform("nir", "grid")(there), places, atol=1e-6)
    np.testing.assert_allclose(
        part.levkas.transform("grid", "nir").inverse(there), places, atol=1e-6
    )
    # The same pixels by their own x and y, from values that are read at once.
    inside = _inside(POLYGON, x, y).reshape(part.sizes["y"], part.sizes["x"])
    values, flags = (np.atleast_3d(a.values)[inside] for a in (part, part.levkas.flags))
    found = part.levkas.region(POLYGON)
    assert int(found["pixels"]) == inside.sum() > 0
    means = [v[f == 0].mean() for v, f in zip(values.T, flags.T, strict=True)]
    np.testing.assert_allclose(found["mean"], means, rtol=1e-6)


def _inside(polygon, x, y):
    """By half planes; the corners of the triangle go round it with the sun."""
    sides = [
        (bx - ax) * (y - ay) - (by - ay) * (x - ax) > 0
        for (ax, ay), (bx, by) in zip(polygon, polygon[1:] + polygon[:1], strict=True)
    ]
    return np.all(sides, axis=0)


@pytest.mark.parametrize("region", [{"rectangle": (25, 15, 34, 22)}, {"circle": (30, 20, 4)}])
def test_the_uncertainty_of_a_crop_is_that_of_the_whole_there(layers, region):
    whole, part = layers["vis"], layers["vis"][10:40, 20:50]
    assert part.levkas.uncertainty(**region).identical(whole.levkas.uncertainty(**region))
    beside = {"rectangle": (21, 11, 24, 14)}
    assert part.levkas.uncertainty(**region, beside=beside, of="difference").identical(
        whole.levkas.uncertainty(**region, beside=beside, of="difference")
    )


@pytest.mark.parametrize("apart", ["thinned", "turned", "uneven", "one row", "none"])
def test_pixels_that_are_no_neighbours_have_no_uncertainty_of_a_mean(layers, apart):
    one = {"one row": lambda a: a.isel(y=20), "none": lambda a: a[:0]}
    with pytest.raises(RegionRefused) as said:
        (CROPS | one)[apart](layers["vis"]).levkas.uncertainty(circle=(30, 20, 4))
    (problem,) = said.value.problems
    assert problem.code == "E_REGION" and problem.field in ("x", "y")


LOST = [
    lambda a, b: a.isel(x=3, drop=True),
    lambda a, b: a.assign_coords(x=a.x / 2),
    lambda a, b: a - b,
    lambda a, b: xarray.concat([a, b], "band"),
]


@pytest.mark.parametrize("lose", LOST)
def test_an_array_whose_places_or_layer_are_lost_has_no_flags_and_no_map(layers, lose):
    lost = lose(layers["vis"], layers["nir"]).levkas
    for ask in (lambda: lost.flags, lambda: lost.transform("grid", "nir")):
        with pytest.raises(ValueError):
            ask()


SAME = {
    "turned": lambda a: a.transpose("band", "x", "y"),
    "thinned": lambda a: a.thin(x=3),
    "where": lambda a: a.where(a > 0.4),
    "sorted": lambda a: a.sortby("wavelength", ascending=False),
    "points": lambda a: a.isel(
        x=xarray.DataArray([7, 2, 2], dims="p"), y=xarray.DataArray([1, 0, 50], dims="p")
    ),
    "joined": lambda a: xarray.concat([a[40:], a[:9]], "y"),
    "one after the other": lambda a: (
        a[3:].compute().transpose("x", "band", "y").astype(float)[5:40:2]
    ),
}


@pytest.mark.parametrize("how", SAME)
def test_flags_and_sigma_follow_the_pixels(layers, how):
    whole = layers["vis"]
    # Each pixel's own number, sent the same way, says which pixel it is.
    number = whole.copy(data=np.arange(whole.size, dtype=float).reshape(whole.shape)).astype(float)
    made = SAME[how](whole)
    which = SAME[how](number).values
    if how == "where":  # numbers above 0.4
        which = number.values
    flags, sigma = made.levkas.flags, made.levkas.sigma
    assert flags.dims == sigma.dims == made.dims
    assert flags.dtype == np.uint8 and flags.coords.keys() == made.coords.keys()
    np.testing.assert_array_equal(
        flags.values, whole.levkas.flags.values.ravel()[which.astype(int)]
    )
    np.testing.assert_array_equal(
        sigma.values, whole.levkas.sigma.values.ravel()[which.astype(int)]
    )


@pytest.mark.parametrize("change", [lambda a: a + 0.001, np.log])
def test_computed_values_keep_flags_and_regions_and_lose_sigma(layers, change):
    whole = layers["vis"]
    made = change(whole)
    np.testing.assert_array_equal(made.levkas.flags.values, whole.levkas.flags.values)
    assert made.levkas.region(circle=(35, 25, 6))["n"].equals(
        whole.levkas.region(circle=(35, 25, 6))["n"]
    )
    np.testing.assert_array_equal(
        made.levkas.transform("grid", "nir")(POINTS), whole.levkas.transform("grid", "nir")(POINTS)
    )
    with pytest.raises(ValueError):
        _ = made.levkas.sigma


def test_a_layer_is_one_dataset_of_values_flags_and_sigma(layers):
    data = layers.dataset("vis")
    assert list(data) == ["values", "flags", "sigma"] and data.attrs["Conventions"].startswith(
        "CF-"
    )
    part = data.isel(x=slice(5, 20), y=slice(9, 12))
    np.testing.assert_array_equal(part["values"].levkas.flags.values, part["flags"].values)
    assert data["flags"].attrs["flag_meanings"].split()[0] == "outside"
    assert data["values"].attrs["units"] == data["sigma"].attrs["units"] == "1"
    assert data.wavelength.attrs["units"] == "nm" and "standard_name" in data.wavelength.attrs
    assert not data["values"].variable._in_memory and not data["sigma"].variable._in_memory
