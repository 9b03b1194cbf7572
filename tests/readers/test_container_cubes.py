"""Cubes in HDF5 and MATLAB files, written by h5py and scipy; the truth is the array that was written."""

import numpy as np
import pytest
from scipy.io import savemat

from levkas.readers.frames import UnreadableCapture, read_facts, read_frame

h5py = pytest.importorskip("h5py")
CUBE = np.random.default_rng(4).integers(0, 4000, (5, 7, 4)).astype(np.uint16)
WAVES = (450.0, 550.0, 650.5, 720.0)


def write_hdf5(path, axes=(0, 1, 2), name="scan/reflectance", waves=("scan/Wavelength", WAVES)):
    with h5py.File(path, "w") as file:
        file.create_dataset(name, data=CUBE.transpose(axes), compression="gzip")
        file["scan/other"] = np.arange(5)
        if waves:
            file[waves[0]] = waves[1]
    return path


def write_matlab_73(path, waves=True):
    """As MATLAB does: a block of its own before HDF5, and the axes the other way round."""
    with h5py.File(path, "w", userblock_size=512) as file:
        file["cube"] = CUBE.transpose(2, 1, 0)
        if waves:
            file["wavelengths"] = np.array([WAVES]).T
    with path.open("r+b") as file:
        file.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(124) + b"\0\x02IM")
    return path


def write_matlab_5(path, **more):
    savemat(path, {"cube": CUBE, "name": "icon", **more}, do_compression=True)
    return path


@pytest.mark.parametrize("axes", [(0, 1, 2), (2, 0, 1)])
def test_the_axis_of_the_bands_of_an_hdf5_cube_is_known_by_its_wavelengths(tmp_path, axes):
    path = write_hdf5(tmp_path / "icon.h5", axes)
    facts = read_facts(path)
    assert (facts.shape, facts.dtype, facts.wavelengths) == (CUBE.shape, "uint16", WAVES)
    assert np.array_equal(read_frame(path), CUBE)


@pytest.mark.parametrize("write", [write_matlab_73, write_matlab_5])
def test_a_cube_of_matlab_has_the_order_that_matlab_shows(tmp_path, write):
    path = write(tmp_path / "icon.mat")
    assert read_facts(path).shape == CUBE.shape
    assert np.array_equal(read_frame(path), CUBE) and read_frame(path).dtype == np.uint16


def test_wavelengths_in_micrometres_and_in_bands_of_the_challenges_are_nanometres(tmp_path):
    um = write_matlab_5(tmp_path / "um.mat", wl=np.array(WAVES) / 1000)
    assert read_facts(um).wavelengths == WAVES
    named = write_matlab_5(tmp_path / "bands.mat", bands=np.array(WAVES))
    assert read_facts(named).wavelengths == WAVES
    counted = write_matlab_5(tmp_path / "counted.mat", bands=np.arange(1, 5))
    assert read_facts(counted).wavelengths is None


@pytest.mark.parametrize(
    ("more", "match"),
    [({"white": CUBE}, "not one cube"), ({"cube": CUBE[..., 0]}, "no cube")],
)
def test_a_file_with_none_or_several_cubes_is_refused_by_their_names(tmp_path, more, match):
    with pytest.raises(UnreadableCapture, match=match) as refused:
        read_facts(write_matlab_5(tmp_path / "icon.mat", **more))
    assert "ENVI" in refused.value.problems[0].fix


def test_a_cut_mat_file_and_a_link_out_of_an_hdf5_file_are_refused(tmp_path):
    path = write_matlab_5(tmp_path / "icon.mat")
    path.write_bytes(path.read_bytes()[:200])
    with pytest.raises(UnreadableCapture):
        read_frame(path)
    write_hdf5(tmp_path / "other.h5")
    with h5py.File(tmp_path / "linked.h5", "w") as file:
        file["cube"] = h5py.ExternalLink("other.h5", "scan/reflectance")
        file["wavelengths"] = WAVES
    with pytest.raises(UnreadableCapture, match="no cube"):
        read_facts(tmp_path / "linked.h5")
