"""Stacks of maps of X-ray fluorescence: what other programs write is read, and what is damaged is refused by name."""

import numpy as np
import pytest

from levkas.readers.frames import UnreadableCapture, files_of, kind_of, read_facts, read_frame

COUNTS = np.arange(2 * 3 * 4, dtype=np.float32).reshape(2, 3, 4)
"""(lines, samples, maps)."""
NAMES = ("Pb_L", "Hg_L", "Cu_K", "Fe_K")


def ripple(folder, values=COUNTS, record="image", order="big-endian", **keys):
    kinds = {"i": "signed", "u": "unsigned", "f": "float"}
    found = {
        "key": "value", "width": values.shape[1], "height": values.shape[0], "depth": values.shape[2], "offset": 5,
        "data-length": values.itemsize, "data-type": kinds[values.dtype.kind], "byte-order": order, "record-by": record,
    } | keys  # fmt: skip
    (folder / "icon.rpl").write_text("".join(f"{key}\t{value}\n" for key, value in found.items()))
    stored = np.moveaxis(values, -1, 0) if record == "image" else values
    swapped = stored.astype(values.dtype.newbyteorder(">" if order == "big-endian" else "<"))
    (folder / "icon.raw").write_bytes(b"12345" + swapped.tobytes())
    return folder / "icon.rpl"


def refused_field(path):
    with pytest.raises(UnreadableCapture) as refused:
        read_facts(path)
    (problem,) = refused.value.problems
    assert problem.file == str(path) and problem.fix
    return problem.field


@pytest.mark.parametrize("record", ["image", "vector"])
@pytest.mark.parametrize("dtype", ["u1", "i4", "f4"])
def test_a_ripple_stack_is_read_in_any_order_and_type(tmp_path, dtype, record):
    for order in ("big-endian", "little-endian"):
        path = ripple(tmp_path, COUNTS.astype(dtype), record, order)
        assert kind_of(path) == "ripple" and read_facts(path).shape == (2, 3, 4)
        values = read_frame(path)
        assert values.dtype == np.dtype(dtype) and np.array_equal(values, COUNTS)
    assert [file.name for file in files_of(path)] == ["icon.rpl", "icon.raw"]


@pytest.mark.parametrize(
    ("keys", "field"),
    [
        ({"width": "many"}, "width"),
        ({"data-length": 3}, "data-type, data-length"),
        ({"record-by": "dont-care"}, "record-by"),
        ({"depth": 5}, "width, height, maps"),
    ],
)
def test_a_header_that_cannot_be_right_is_refused_by_its_key(tmp_path, keys, field):
    assert refused_field(ripple(tmp_path, **keys)) == field


def test_numbers_that_are_not_there_are_refused(tmp_path):
    path = ripple(tmp_path)
    (tmp_path / "icon.raw").write_bytes((tmp_path / "icon.raw").read_bytes()[:60])
    assert refused_field(path) == "width, height, maps"
    (tmp_path / "icon.raw").unlink()
    assert refused_field(path) == "width, height, maps"


def test_maps_of_an_hdf5_file_of_pymca_are_read_and_links_are_not_followed(tmp_path):
    h5py = pytest.importorskip("h5py")
    path = tmp_path / "icon.h5"
    with h5py.File(tmp_path / "other.h5", "w") as other:
        other["secret"] = COUNTS[..., 0]
    with h5py.File(path, "w") as file:
        results = file.create_group("icon/xrf_fit/results")
        for k, name in enumerate(NAMES):
            results[f"parameters/{name}"] = COUNTS[..., k]
            results[f"uncertainties/{name}"] = COUNTS[..., k]
        results["parameters/energy"] = np.arange(9.0)
        results["parameters/Au_L"] = h5py.ExternalLink("other.h5", "secret")
    facts = read_facts(path)
    assert (facts.kind, facts.shape) == ("hdf5", (2, 3, 4))
    order = [NAMES.index(name) for name in facts.band_names]
    assert np.array_equal(read_frame(path), COUNTS[..., order])


def test_hdf5_of_no_one_cube_and_no_one_group_of_maps_is_refused(tmp_path):
    h5py = pytest.importorskip("h5py")
    with h5py.File(tmp_path / "icon.h5", "w") as file:
        file["cube"] = COUNTS
    assert refused_field(tmp_path / "icon.h5") == "format"
    with h5py.File(tmp_path / "icon.h5", "a") as file:
        for entry in ("one", "two"):
            file[f"{entry}/results/parameters/Pb"] = COUNTS[..., 0]
    assert refused_field(tmp_path / "icon.h5") == "format"
