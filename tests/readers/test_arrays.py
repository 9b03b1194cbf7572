"""Arrays and cubes in containers of other programs: what is accepted of them is read, and of all else not a byte."""

import io
import struct
import zipfile
import zlib

import numpy as np
import pytest
from scipy.io import savemat

from levkas.readers.arrays import read_hdf5, read_npy, read_npz
from levkas.readers.facts import UnreadableCapture
from levkas.readers.frames import read_facts, read_frame

SHAPE = (7, 10, 12)
CUBE = np.random.default_rng(3).normal(size=SHAPE).astype(np.float32)


@pytest.fixture
def h5py():
    return pytest.importorskip("h5py")


# --- HDF5 ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"chunks": (7, 10, 1), "compression": "gzip"},
        {"chunks": (3, 4, 5), "shuffle": True, "compression": "gzip"},
        {"maxshape": (None, 10, 12), "chunks": (16, 10, 12), "compression": 9},
    ],
    ids=str,
)
def test_a_data_set_is_read_as_h5py_reads_it(h5py, tmp_path, options):
    with h5py.File(tmp_path / "a.h5", "w", userblock_size=512) as file:
        file.create_dataset("cube", data=(CUBE * 100).astype("f4"), **options)
        expected = file["cube"][()]
    found = read_hdf5(tmp_path / "a.h5", "cube", (7, None, 12))
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == expected.dtype


def elsewhere(h5py, folder):
    with h5py.File(folder / "other.h5", "w") as other:
        other["cube"] = np.ones(SHAPE, np.float32)
    return str(folder / "other.h5")


def external_storage(h5py, folder, file):
    (folder / "secret").write_bytes(b"s" * 4 * 840)
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_external(str(folder / "secret").encode(), 0, 4 * 840)
    space = h5py.h5s.create_simple(SHAPE)
    h5py.h5d.create(file.id, b"cube", h5py.h5t.IEEE_F32LE, space, plan)


def external_link(h5py, folder, file):
    file["cube"] = h5py.ExternalLink(elsewhere(h5py, folder), "cube")


def virtual_data_set(h5py, folder, file):
    layout = h5py.VirtualLayout(SHAPE, np.float32)
    layout[...] = h5py.VirtualSource(elsewhere(h5py, folder), "cube", SHAPE)
    file.create_virtual_dataset("cube", layout)


def bomb(h5py, folder, file):
    data = file.create_dataset("cube", SHAPE, np.float32, chunks=SHAPE, compression="gzip")
    data.id.write_direct_chunk((0, 0, 0), zlib.compress(bytes(200 << 20)))


def missing_chunks(h5py, folder, file):
    file.create_dataset("cube", SHAPE, np.float32, chunks=(7, 5, 6))[:, :5] = 1


@pytest.mark.parametrize(
    "make",
    [
        *(external_storage, external_link, virtual_data_set, bomb, missing_chunks),
        lambda h5py, folder, file: file.create_dataset("cube", SHAPE, np.float32),  # never written
        lambda h5py, folder, file: file.create_dataset("cube", SHAPE, h5py.string_dtype()),
    ],
)
def test_hdf5_that_leads_elsewhere_or_lacks_numbers_is_refused(h5py, tmp_path, make):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        make(h5py, tmp_path, file)
    with pytest.raises(UnreadableCapture) as said:
        read_hdf5(tmp_path / "a.h5", "cube", SHAPE)
    (problem,) = said.value.problems
    assert problem.file == str(tmp_path / "a.h5") and problem.fix


# --- .npy and .npz -------------------------------------------------------------------------------


@pytest.mark.parametrize("order", "CF")
def test_an_npy_is_read_as_numpy_reads_it(tmp_path, order):
    np.save(tmp_path / "a.npy", np.asarray(CUBE, order=order))
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy", SHAPE), CUBE)
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy", (None, 10, None)), CUBE)


def header(shape, kind="<f4"):
    text = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text


def npy(array):
    data = io.BytesIO()
    np.save(data, array)
    return data.getvalue()


def npz(*members):
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", compression=zipfile.ZIP_DEFLATED) as archive:
        for name, content in members:
            archive.writestr(name, content)
    return data.getvalue()


@pytest.mark.parametrize(
    "data",
    [
        header((1400, 1000, 1000)),
        header(SHAPE) + bytes(4 * 840 - 1),
        header(SHAPE, "|O") + bytes(8 * 840),
        b"",
    ],
    ids=len,
)
def test_an_npy_that_is_not_what_is_expected_is_refused_unread(tmp_path, data):
    (tmp_path / "a.npy").write_bytes(data)
    with pytest.raises(UnreadableCapture):
        read_npy(tmp_path / "a.npy", SHAPE)


def test_arrays_of_an_npz_are_read_by_name(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", cube=CUBE, name="wiener", flag=True)
    arrays = read_npz(tmp_path / "a.npz", most=1 << 20)
    np.testing.assert_array_equal(arrays["cube"], CUBE)
    assert (str(arrays["name"]), bool(arrays["flag"])) == ("wiener", True)


SMALLER = npz(("a.npy", npy(np.zeros(1 << 20)))).replace(
    struct.pack("<I", len(npy(np.zeros(1 << 20)))), struct.pack("<I", 128 + 24)
)
"""A member that is larger than it declares."""


@pytest.mark.parametrize(
    "data",
    [
        npz(("a.npy", npy(np.zeros(1 << 20)))),
        npz(("a.npy", npy(np.array([{}], object)))),
        SMALLER,
    ],
    ids=len,
)
def test_an_npz_whose_members_are_too_large_or_no_numbers_is_refused(tmp_path, data):
    (tmp_path / "a.npz").write_bytes(data)
    with pytest.raises(UnreadableCapture):
        read_npz(tmp_path / "a.npz", most=1 << 20)


# --- cubes, by h5py and scipy --------------------------------------------------------------------

CODES = np.random.default_rng(4).integers(0, 4000, (5, 7, 4)).astype(np.uint16)
WAVES = (450.0, 550.0, 650.5, 720.0)


def write_hdf5(h5py, path, axes):
    with h5py.File(path, "w") as file:
        data = CODES.transpose(axes)
        file.create_dataset("scan/reflectance", data=data, compression="gzip")
        file["scan/other"], file["scan/Wavelength"] = np.arange(5), WAVES
    return path


def write_matlab_73(path):
    """As MATLAB does: a block of its own before HDF5, and the axes the other way round."""
    h5py = pytest.importorskip("h5py")
    with h5py.File(path, "w", userblock_size=512) as file:
        file["cube"], file["wavelengths"] = CODES.transpose(2, 1, 0), np.array([WAVES]).T
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\x02IM")
    return path


def write_matlab_5(path, **more):
    savemat(path, {"cube": CODES, "name": "icon", **more}, do_compression=True)
    return path


@pytest.mark.parametrize("axes", [(0, 1, 2), (2, 0, 1)])
def test_the_axis_of_the_bands_of_an_hdf5_cube_is_known_by_its_wavelengths(h5py, tmp_path, axes):
    path = write_hdf5(h5py, tmp_path / "icon.h5", axes)
    facts = read_facts(path)
    assert (facts.shape, facts.dtype, facts.wavelengths) == (CODES.shape, "uint16", WAVES)
    assert np.array_equal(read_frame(path), CODES)


@pytest.mark.parametrize("write", [write_matlab_73, write_matlab_5])
def test_a_cube_of_matlab_has_the_order_that_matlab_shows(tmp_path, write):
    path = write(tmp_path / "icon.mat")
    assert read_facts(path).shape == CODES.shape
    assert np.array_equal(read_frame(path), CODES) and read_frame(path).dtype == np.uint16


@pytest.mark.parametrize(
    ("more", "found"),
    [
        ({"wl": np.array(WAVES) / 1000}, WAVES),
        ({"bands": np.array(WAVES)}, WAVES),
        ({"bands": np.arange(1, 5)}, None),
    ],
)
def test_wavelengths_in_micrometres_are_nanometres_and_counted_bands_are_none(
    tmp_path, more, found
):
    assert read_facts(write_matlab_5(tmp_path / "a.mat", **more)).wavelengths == found


@pytest.mark.parametrize("more", [{"white": CODES}, {"cube": CODES[..., 0]}])
def test_a_file_with_none_or_several_cubes_is_refused(tmp_path, more):
    with pytest.raises(UnreadableCapture) as refused:
        read_facts(write_matlab_5(tmp_path / "icon.mat", **more))
    assert refused.value.problems[0].field == "format"
