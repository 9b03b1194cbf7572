"""What is written is what is read: any shape, any numbers, in the formats that a database is made of."""

import shutil
import tempfile
from pathlib import Path

import numpy as np
import pytest
import spectral
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

import levkas
from levkas.core.cube import Band, Cube, band_labels
from levkas.core.rounding import round_sigma
from levkas.database.layers import Layer, write_layer, write_tiffs
from levkas.database.validation import validate
from levkas.publish.export.envi import write_envi
from levkas.publish.export.layer import ExportLayer

SHAPES = st.tuples(st.integers(1, 9), st.integers(1, 9), st.integers(1, 4))
FLOATS = st.floats(width=32, allow_nan=True, allow_infinity=True)


@st.composite
def cubes(draw):
    shape = draw(SHAPES)
    values = draw(arrays.arrays(np.float32, shape, elements=FLOATS))
    flags = draw(arrays.arrays(np.uint8, shape))
    sigma = draw(st.none() | arrays.arrays(np.float32, shape, elements=st.floats(0, 8, width=32)))
    centres = draw(
        st.none()
        | st.lists(st.integers(300, 2500), min_size=shape[2], max_size=shape[2], unique=True)
    )
    if centres is None:
        bands = tuple(Band(f"C{i}") for i in range(shape[2]))
    else:
        labels = band_labels(centres)
        bands = tuple(Band(t, float(w)) for t, w in zip(labels, centres, strict=True))
    return Cube(values, flags, None if sigma is None else round_sigma(sigma), bands)


def same(one, other):
    assert one.dtype == other.dtype and one.shape == other.shape
    numbers = np.array_equal(one, other, equal_nan=one.dtype.kind == "f")
    assert numbers and np.array_equal(np.signbit(one[one == 0]), np.signbit(other[other == 0]))


@pytest.mark.slow
@pytest.mark.parametrize("zarr", [True, False])
@settings(max_examples=25, deadline=None)
@given(cube=cubes(), scale=st.just(float("nan")) | st.floats(0.01, 100))
def test_a_layer_opens_as_it_was_written_from_zarr_and_from_tiff(zarr, cube, scale):
    with tempfile.TemporaryDirectory() as folder:
        write_layer(folder, Layer("icon", "cam", px_per_mm=scale), cube)
        if not zarr:
            shutil.rmtree(Path(folder, "zarr"))
        opened = levkas.open(folder)["icon"]["cam"]
        same(opened.values, cube.values)
        same(opened.levkas.flags.values, cube.flags)
        if cube.sigma is None:
            assert opened.levkas.sigma is None
        else:
            same(opened.levkas.sigma.values, cube.sigma)
        assert list(opened.band.values) == cube.labels
        known = [band.wavelength for band in cube.bands]
        assert np.array_equal(opened.wavelength.values, known, equal_nan=True)


@settings(max_examples=25, deadline=None)
@given(
    st.one_of(
        arrays.arrays(np.float32, SHAPES, elements=FLOATS),
        arrays.arrays(np.uint8, SHAPES),
    ),
    st.text(st.characters(exclude_categories=("Cs",)), max_size=30),
)
def test_a_spectral_tiff_gives_cube_wavelengths_picture_and_text_again(cube, text):
    waves = [400.0 + 10 * i for i in range(cube.shape[2])]
    picture = np.full((*cube.shape[:2], 3), 7, np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        levkas.write_stiff(Path(folder) / "x.tif", cube, waves, picture, text)
        read, centres, shown, reported = levkas.read_stiff(Path(folder) / "x.tif")
        same(read, cube)
        same(shown, picture)
        assert list(centres) == waves and (reported == text or not text.strip())


@settings(max_examples=15, deadline=None)
@given(cubes())
def test_envi_gives_the_same_numbers_again(cube):
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "objects/icon"
        write_tiffs(root / "icon_cam", Layer("icon", "cam"), cube)
        layer = ExportLayer.read(Path(folder), "icon", "cam", "")
        written = write_envi(layer, Path(folder))
        image = spectral.open_image(str(written[1]))
        found = np.array(image.open_memmap())
        same(found.reshape(cube.values.shape), cube.values)


def test_a_published_folder_that_lost_or_gained_a_file_is_found_out(database, publish):
    folder = publish(database)
    (folder / "objects/icon1/icon1_vis.tif").unlink()
    (folder / "objects/icon1/new.tif").write_bytes(b"x")
    assert {p.code for p in validate(folder).problems} == {"E_MISSING", "E_EXTRA"}
