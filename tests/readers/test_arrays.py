"""Containers of other programs: what is accepted of them is read, and of all else not a byte."""

import contextlib
import io
import struct
import zipfile
import zlib

import numpy as np
import pytest

from levkas.readers.arrays import opening_npz, read_hdf5, read_npy
from levkas.readers.facts import UnreadableCapture

SHAPE = (7, 10, 12)


@pytest.fixture
def cube():
    return np.random.default_rng(3).normal(size=SHAPE).astype(np.float32)


# --- HDF5 ----------------------------------------------------------------------------------------


@pytest.fixture
def h5py():
    return pytest.importorskip("h5py")


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"chunks": (3, 4, 5)},
        {"chunks": (7, 10, 1), "compression": "gzip"},
        {"chunks": (2, 10, 12), "compression": "gzip", "shuffle": True},
        {"chunks": (3, 4, 5), "shuffle": True},
        {"dtype": ">i2"},
        {"maxshape": (None, 10, 12), "chunks": (16, 10, 12), "compression": 9},
    ],
    ids=str,
)
def test_a_data_set_is_read_as_h5py_reads_it(h5py, tmp_path, cube, options):
    with h5py.File(tmp_path / "a.h5", "w", userblock_size=512) as file:
        file.create_dataset("cube", data=(cube * 100).astype(options.get("dtype", "f4")), **options)
        expected = file["cube"][()]
    found = read_hdf5(tmp_path / "a.h5", "cube", (7, None, 12))
    np.testing.assert_array_equal(found, expected)
    assert found.dtype == expected.dtype


def external_storage(h5py, folder, file):
    (folder / "secret").write_bytes(b"s" * 4 * 840)
    plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
    plan.set_external(str(folder / "secret").encode(), 0, 4 * 840)
    space = h5py.h5s.create_simple(SHAPE)
    h5py.h5d.create(file.id, b"cube", h5py.h5t.IEEE_F32LE, space, plan)


def external_link(h5py, folder, file):
    with h5py.File(folder / "other.h5", "w") as other:
        other["cube"] = np.ones(SHAPE, np.float32)
    file["cube"] = h5py.ExternalLink(str(folder / "other.h5"), "cube")


def virtual_data_set(h5py, folder, file):
    with h5py.File(folder / "other.h5", "w") as other:
        other["cube"] = np.ones(SHAPE, np.float32)
    layout = h5py.VirtualLayout(SHAPE, np.float32)
    layout[...] = h5py.VirtualSource(str(folder / "other.h5"), "cube", SHAPE)
    file.create_virtual_dataset("cube", layout)


def soft_link(h5py, folder, file):
    file["other"] = np.ones(SHAPE, np.float32)
    file["cube"] = h5py.SoftLink("/other")


def other_filter(h5py, folder, file):
    file.create_dataset("cube", data=np.ones(SHAPE, np.float32), compression="lzf")


def missing_chunks(h5py, folder, file):
    file.create_dataset("cube", SHAPE, np.float32, chunks=(7, 5, 6))[:, :5] = 1


def never_written(h5py, folder, file):
    file.create_dataset("cube", SHAPE, np.float32)


def bomb(h5py, folder, file):
    data = file.create_dataset("cube", SHAPE, np.float32, chunks=SHAPE, compression="gzip")
    data.id.write_direct_chunk((0, 0, 0), zlib.compress(bytes(200 << 20)))


def huge_chunk(h5py, folder, file):
    chunks, sides = (1 << 15, 1 << 10, 12), (None, None, None)
    file.create_dataset("cube", SHAPE, np.float32, maxshape=sides, chunks=chunks)


def texts(h5py, folder, file):
    file.create_dataset("cube", SHAPE, h5py.string_dtype())


def references(h5py, folder, file):
    file.create_dataset("cube", SHAPE, h5py.ref_dtype)


def group(h5py, folder, file):
    file.create_group("cube")


def other_shape(h5py, folder, file):
    file.create_dataset("cube", (1 << 20, 1 << 20, 1 << 20), np.float64, chunks=(1, 1, 1))


def no_shape(h5py, folder, file):
    file["cube"] = h5py.Empty("f4")


def nothing(h5py, folder, file):
    file["other"] = 3


@pytest.mark.parametrize(
    "make",
    [external_storage, external_link, virtual_data_set, soft_link, other_filter, missing_chunks,
     never_written, bomb, huge_chunk, texts, references, group, other_shape, no_shape, nothing],
)  # fmt: skip
def test_hdf5_that_leads_elsewhere_or_lacks_numbers_is_refused(h5py, tmp_path, make):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        make(h5py, tmp_path, file)
    with pytest.raises(UnreadableCapture) as said:
        read_hdf5(tmp_path / "a.h5", "cube", SHAPE)
    (problem,) = said.value.problems
    assert problem.file == str(tmp_path / "a.h5") and problem.fix


def test_a_damaged_hdf5_is_refused_and_never_crashes(h5py, tmp_path, cube):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file.create_dataset("cube", data=cube, chunks=(7, 5, 6), compression="gzip")
    data, rng = bytearray((tmp_path / "a.h5").read_bytes()), np.random.default_rng(1)
    for _ in range(60):
        spoilt = bytearray(data)
        for place in rng.integers(0, len(data), 3):
            spoilt[place] = rng.integers(256)
        (tmp_path / "b.h5").write_bytes(spoilt[: rng.integers(1, len(data) + 1)])
        with contextlib.suppress(UnreadableCapture):
            assert read_hdf5(tmp_path / "b.h5", "cube", SHAPE).shape == SHAPE


# --- .npy ----------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", "CF")
def test_an_npy_is_read_as_numpy_reads_it(tmp_path, cube, order):
    np.save(tmp_path / "a.npy", np.asarray(cube, order=order))
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy", SHAPE), cube)
    np.testing.assert_array_equal(read_npy(tmp_path / "a.npy", (None, 10, None)), cube)


def header(shape, kind="<f4", version=b"\x01\x00"):
    text = f"{{'descr': {kind!r}, 'fortran_order': False, 'shape': {shape}, }}".encode()
    return b"\x93NUMPY" + version + struct.pack("<H", len(text)) + text


@pytest.mark.parametrize(
    ("data", "code"),
    [
        (header((1400, 1000, 1000)), "E_SIZE"),
        (header(SHAPE) + bytes(4 * 840 - 1), "E_UNREADABLE"),
        (header(SHAPE) + bytes(4 * 840 + 1), "E_UNREADABLE"),
        (header((-7, -10, 12)) + bytes(4 * 840), "E_UNREADABLE"),
        (header(SHAPE, "|O") + bytes(8 * 840), "E_UNREADABLE"),
        (header(SHAPE, "<c16") + bytes(16 * 840), "E_UNREADABLE"),
        (header(SHAPE, "<U90000"), "E_UNREADABLE"),
        (header(SHAPE, version=b"\x09\x00"), "E_UNREADABLE"),
        (b"\x93NUMPY", "E_UNREADABLE"),
        (b"", "E_UNREADABLE"),
    ],
)
def test_an_npy_that_is_not_what_is_expected_is_refused_unread(tmp_path, data, code):
    path = tmp_path / "a.npy"
    path.write_bytes(data)
    if code == "E_SIZE":
        with path.open("r+b") as file:  # sparse: it takes no space
            file.truncate(len(data) + 5_600_000_000)
    with pytest.raises(UnreadableCapture) as said:
        read_npy(path, SHAPE)
    assert [p.code for p in said.value.problems] == [code]


# --- .npz ----------------------------------------------------------------------------------------


def packed(path, members, **options):
    with zipfile.ZipFile(path, "w", **options) as archive:
        for name, data in members:
            archive.writestr(name, data)
    return path


def npy(array):
    data = io.BytesIO()
    np.save(data, array)
    return data.getvalue()


def test_members_of_an_npz_are_read_when_they_are_taken(tmp_path, cube):
    np.savez_compressed(tmp_path / "a.npz", cube=cube, name="wiener", flag=True)
    with opening_npz(tmp_path / "a.npz", most=1 << 20) as arrays:
        np.testing.assert_array_equal(arrays["cube"], cube)
        assert str(arrays["name"]) == "wiener" and bool(arrays["flag"])
        assert set(arrays) == {"cube", "name", "flag"}
        arrays.require_all_taken()


def test_a_foreign_member_is_refused_and_not_decompressed(tmp_path):
    made = [("a.npy", npy(np.ones(3))), ("b.npy", b"not an array" + bytes(30 << 20))]
    path = packed(tmp_path / "a.npz", made, compression=zipfile.ZIP_DEFLATED)
    with (
        pytest.raises(UnreadableCapture, match="foreign members: b"),
        opening_npz(path, most=1 << 20) as arrays,
    ):
        assert arrays["a"].tolist() == [1, 1, 1]
        arrays.require_all_taken()


@pytest.mark.parametrize(
    "members",
    [
        [("a.npy", npy(np.zeros(1 << 20)))],
        [("a.npy", npy(np.array(["x" * 2000])))],
        [("a.npy", npy(np.zeros(3)) + b"more")],
        [("a.npy", header((1 << 40,)))],
        [("a.npy", b"")],
        [("b.npy", npy(np.zeros(3)))],
        [(f"{k}.npy", npy(np.zeros(1))) for k in range(65)],
    ],
)
def test_an_npz_whose_members_are_too_large_or_no_numbers_is_refused(tmp_path, members):
    path = packed(tmp_path / "a.npz", members, compression=zipfile.ZIP_DEFLATED)
    with pytest.raises(UnreadableCapture), opening_npz(path, most=1 << 20) as arrays:
        arrays["a"]


def test_a_member_that_is_larger_than_it_declares_is_refused(tmp_path):
    path = tmp_path / "a.npz"
    packed(path, [("a.npy", npy(np.zeros(1 << 20)))], compression=zipfile.ZIP_DEFLATED)
    data, size = path.read_bytes(), len(npy(np.zeros(1 << 20)))
    path.write_bytes(data.replace(struct.pack("<I", size), struct.pack("<I", 128 + 24)))
    with pytest.raises(UnreadableCapture), opening_npz(path, most=1 << 10) as arrays:
        arrays["a"]


@pytest.mark.parametrize("compression", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_other_compressions_of_an_npz_are_refused(tmp_path, compression):
    path = packed(tmp_path / "a.npz", [("a.npy", npy(np.ones(3)))], compression=compression)
    with pytest.raises(UnreadableCapture, match="unknown method"), opening_npz(path, most=99) as a:
        a["a"]
