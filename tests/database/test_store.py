import warnings

import numpy as np
import pytest
import xarray
from hypothesis import given, settings
from hypothesis import strategies as st

from levkas.core.cube import Band, Cube, Flag
from levkas.core.digests import hash_tree
from levkas.database import store
from levkas.database.store import chunks_of, write_index, writing_layer


def cube_of(height=70, width=90, bands=5, *, seed=0, sigma=True):
    rng = np.random.default_rng(seed)
    values = rng.normal(0.5, 0.2, (height, width, bands)).astype(np.float32)
    values[0, 0, 0] = np.nan
    labels = tuple(Band(f"{400 + 10 * i} nm", 400.0 + 10 * i, 7.0) for i in range(bands))
    flags = rng.integers(0, 128, values.shape, dtype=np.uint8)
    return Cube(values, flags, np.abs(values) if sigma else None, labels)


def write_layer_store(root, name, cube, *, attributes=None):
    facts = {"quantity": cube.quantity, **(attributes or {})}
    shape, noisy = cube.values.shape, cube.sigma is not None
    with writing_layer(
        root, name, shape=shape, bands=cube.bands, attributes=facts, sigma=noisy
    ) as layer:
        layer.write_rows(cube.values, cube.flags, cube.sigma)


def opened(root, name="cam", **options):
    return xarray.open_zarr(root, group=name, chunks=None, **options)


def test_xarray_opens_a_layer_with_its_labels(tmp_path):
    cube = cube_of()
    write_layer_store(
        tmp_path / "a.zarr", "cam@45", cube, attributes={"camera": "cam", "px_per_mm": 2.5}
    )
    write_index(tmp_path / "a.zarr")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        data = opened(tmp_path / "a.zarr", "cam@45")
    assert data["values"].dims == ("y", "x", "band")
    assert data.band.values.tolist() == cube.labels
    assert set(data.coords) == {"band", "wavelength", "fwhm"}
    np.testing.assert_array_equal(data["values"].values, cube.values)
    np.testing.assert_array_equal(data["flags"].values, cube.flags)
    np.testing.assert_array_equal(data["sigma"].values, cube.sigma)
    facts = {"quantity": "reflectance", "camera": "cam", "px_per_mm": 2.5}
    assert data["values"].attrs == {**facts, "sigma": True}  # without its array it is damaged
    one = data["values"].swap_dims(band="wavelength").sel(wavelength=420)
    np.testing.assert_array_equal(one.values, cube.values[:, :, 2])
    assert data["flags"].attrs["flag_masks"] == [int(f) for f in Flag]
    chunk = data["values"].encoding
    assert chunk["compressors"][-1].to_dict()["name"] == "crc32c"


@pytest.mark.slow
@settings(max_examples=15, deadline=None)
@given(
    st.tuples(st.integers(1, 60), st.integers(1, 40), st.integers(1, 20)),
    st.lists(st.integers(1, 30), min_size=1, max_size=6),
)
def test_blocks_of_any_height_give_the_bytes_of_the_whole(tmp_path_factory, shape, heights):
    folder = tmp_path_factory.mktemp("zarr")
    cube = cube_of(*shape)
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (("SIDE", 8), ("WIDE_SIDE", 16), ("SHARD_TARGET", 4096)):
            patch.setattr(store, name, value)
        write_layer_store(folder / "whole.zarr", "cam", cube)
        with writing_layer(
            folder / "parts.zarr",
            "cam",
            shape=shape,
            bands=cube.bands,
            attributes={"quantity": "reflectance"},
        ) as layer:
            row = 0
            while row < shape[0]:
                stop = row + heights[row % len(heights)]
                part = slice(row, stop)
                layer.write_rows(cube.values[part], cube.flags[part], cube.sigma[part])
                row = stop
    assert hash_tree(folder / "whole.zarr") == hash_tree(folder / "parts.zarr")
    data = opened(folder / "parts.zarr", consolidated=False)
    np.testing.assert_array_equal(data["values"].values, cube.values)


@pytest.mark.parametrize("shape", [(1040, 1392, 121), (100, 300000, 1000), (9, 9, 50000)])
def test_shards_are_below_the_limit_and_whole_chunks(shape):
    chunks, shards = chunks_of(shape)
    assert 4 * np.prod(shards, dtype=np.int64) <= 256_000_000
    assert all(s % c == 0 for s, c in zip(shards, chunks, strict=True))
    assert 4 * np.prod(chunks, dtype=np.int64) <= 2 << 20
    assert -(-shape[2] // chunks[2]) <= max(1, -(-shape[2] // 16))


def test_rows_that_are_missing_or_too_many_leave_no_layer(tmp_path):
    cube = cube_of()
    parts = (cube.values, cube.flags, cube.sigma)
    several = [[np.resize(part, (rows, 90, 5)) for part in parts] for rows in (60, 80)]
    facts = {"shape": (70, 90, 5), "bands": cube.bands, "attributes": {}}
    for given_ in (*several, parts[:2]):
        with pytest.raises(ValueError), writing_layer(tmp_path / "a.zarr", "cam", **facts) as layer:
            layer.write_rows(*given_)
    assert [p.name for p in (tmp_path / "a.zarr").iterdir()] == ["zarr.json"]


def test_a_new_layer_drops_the_index_and_takes_the_place_of_the_old(tmp_path):
    root = tmp_path / "a.zarr"
    write_layer_store(root, "cam", cube_of(20, 20, 3))
    write_index(root)
    write_layer_store(root, "cam", cube_of(30, 20, 3))
    assert opened(root, consolidated=False)["values"].shape == (30, 20, 3)
    assert b"consolidated" not in (root / "zarr.json").read_bytes()
    first = hash_tree(root)
    write_layer_store(root, "cam", cube_of(30, 20, 3))
    assert hash_tree(root) == first
